use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;

use super::recordings::{Recordings, without_predictions};
use super::{Outcome, not_negative, positive, print, write_file};
use crate::msgs::schema::Topic;
use crate::offline::score::MetChannel;
use crate::offline::score_table::{Row, Sum, met};
use crate::sound::matching::Criteria;
use crate::text::terminal::printable;

const EXAMPLES: &str = "\
Examples:
  squealcast score sessions                       every recording of a folder
  squealcast score a b --channel microphone       one microphone of several
  squealcast score sessions --csv scores.csv      the table as CSV";

/// Score the predictions of recordings against the squeal in their sound: one table of hits, misses and false alarms
///
/// Each channel is judged by itself, so a squeal that two microphones received counts in the row of each. A recording has
/// sound if its node received samples, or if `predict-log --sound` made it.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    #[command(flatten)]
    recordings: Recordings,
    /// Score only this channel [default: all]
    #[arg(long, value_name = "NAME")]
    channel: Option<String>,
    /// Frequencies match within this share of the predicted frequency
    #[arg(long, value_name = "SHARE", value_parser = positive, default_value = "0.05")]
    frequency_tolerance: f64,
    /// Times match within this tolerance, s
    #[arg(long, value_name = "S", value_parser = not_negative, default_value = "0.5")]
    time_tolerance_s: f64,
    /// Write the table as CSV to this file, - for standard output
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The output of `score --json`.
#[derive(Serialize)]
struct Report {
    criteria: Criteria,
    rows: Vec<Row>,
    total: Row,
    /// Recordings without sound.
    without_sound: Vec<String>,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let criteria = Criteria {
            frequency_tolerance: self.frequency_tolerance,
            time_tolerance_s: self.time_tolerance_s,
            ..Criteria::default()
        };
        let (mut rows, mut total, mut without_sound) = (vec![], Sum::default(), vec![]);
        let mut outcome = Outcome::Done;
        for path in self.recordings.paths()? {
            let (met, found) = self.meet(&path, &criteria)?;
            outcome = outcome.max(found);
            let name = path.display().to_string();
            if met.is_empty() {
                note!("{name}: holds no sound in the time of its predictions");
                without_sound.push(name.clone());
            }
            for met in &met {
                if !met.has_samples {
                    note!("{name}: without samples; `{}` is taken to have been received all the time", met.channel);
                }
                let mut sum = Sum::default();
                sum.add(met);
                total.add(met);
                rows.push(Row { recording: name.clone(), channel: met.channel.clone(), ..sum.row() });
            }
        }
        let report = Report { criteria, rows, total: total.row(), without_sound };
        if let Some(path) = &self.csv {
            write_file(path, &csv(&report.rows)?)?;
        }
        if self.json {
            print(&(serde_json::to_string(&report)? + "\n"))?;
        } else if self.csv.as_deref() != Some(Path::new("-")) {
            print(&text(&report))?;
        }
        Ok(outcome)
    }

    /// The comparison of the channels of a recording.
    fn meet(&self, path: &Path, criteria: &Criteria) -> anyhow::Result<(Vec<MetChannel>, Outcome)> {
        let recording = self.recordings.open(path)?;
        if recording.topics().name_of(Topic::Prediction).is_none() {
            return Err(without_predictions(path, &recording));
        }
        let (mut met, lost) = met(&recording, criteria);
        met.retain(|met| self.channel.as_ref().is_none_or(|channel| *channel == met.channel));
        Ok((met, if lost { Outcome::Differences } else { Outcome::Done }))
    }
}

fn text(report: &Report) -> String {
    let Criteria { frequency_tolerance, time_tolerance_s, .. } = report.criteria;
    let mut text = format!(
        "frequencies within {} %, times within {time_tolerance_s} s; slots of {} s\n\n\
         {:>9}  {:>5} {:>6} {:>6}  {:>9} {:>6}  {:>9}  {:>6} {:>23}  {:>17}  {:>8}  recording, channel\n\
         {:>9}  {:>5} {:>6} {:>6}  {:>9} {:>6}  {:>9}  {:>6} {:>23}  {:>17}  {:>8}\n",
        100.0 * frequency_tolerance,
        report.total.slot_s,
        "judged",
        "hits",
        "misses",
        "recall",
        "confirmed",
        "false",
        "precision",
        "MCC",
        "slots: hit/miss/false/-",
        "lead: least/most",
        "median",
        "s",
        "",
        "",
        "",
        "",
        "alarms",
        "",
        "",
        "",
        "s",
        "s",
    );
    let named = |row: &Row| format!("{}, {}", printable(&row.recording), printable(&row.channel));
    for row in &report.rows {
        text += &line(row, &named(row));
    }
    if report.rows.len() != 1 {
        text += &line(&report.total, &format!("total of {} rows", report.rows.len()));
    }
    let Row { harmonics, squeals_not_judged, predictions_not_judged, .. } = &report.total;
    let _ = writeln!(
        text,
        "\nnot judged: {squeals_not_judged} squeals, {predictions_not_judged} predicted squeals; {harmonics} harmonics"
    );
    text
}

fn line(row: &Row, name: &str) -> String {
    let share = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.3}"));
    let seconds = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
    let Row { slots_hit, slots_missed, slots_false_alarm, slots_quiet, .. } = row;
    format!(
        "{:>9.2}  {:>5} {:>6} {:>6}  {:>9} {:>6}  {:>9}  {:>6} {:>23}  {:>17}  {:>8}  {name}\n",
        row.judged_s,
        row.hits,
        row.misses,
        share(row.recall),
        row.confirmed,
        row.false_alarms,
        share(row.precision),
        share(row.mcc),
        format!("{slots_hit}/{slots_missed}/{slots_false_alarm}/{slots_quiet}"),
        format!("{}/{}", seconds(row.least_lead_s), seconds(row.longest_lead_s)),
        seconds(row.median_lead_s),
    )
}

fn csv(rows: &[Row]) -> anyhow::Result<Vec<u8>> {
    let mut writer = csv::Writer::from_writer(vec![]);
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    Ok(writer.into_inner()?)
}
