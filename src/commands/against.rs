//! Squeal in sound against the predictions of a recording.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::anyhow;
use clap::Args;

use super::recordings::{open_last, without_predictions};
use super::{finite, not_negative, positive};
use crate::msgs::Prediction;
use crate::offline::score::add;
use crate::recording::message::Payload;
use crate::recording::reader::{Recorded, Recording};
use crate::sound::Squeal;
use crate::sound::matching::{Criteria, Listened, Meeting, Predictions, Verdict};

/// The predictions that squeal is compared with
#[derive(Clone, Debug, Args)]
pub struct AgainstArgs {
    /// Compare with the predictions of this recording: hits, misses, false alarms
    #[arg(long, value_name = "RECORDING")]
    against: Option<PathBuf>,
    /// Time of the first sample after the stamp of the first prediction, s
    #[arg(long, value_name = "S", value_parser = finite, default_value = "0", allow_negative_numbers = true, requires = "against")]
    offset_s: f64,
    /// Frequencies match within this share of the predicted frequency
    #[arg(long, value_name = "SHARE", value_parser = positive, default_value = "0.05", requires = "against")]
    frequency_tolerance: f64,
    /// Times match within this tolerance, s
    #[arg(long, value_name = "S", value_parser = not_negative, default_value = "0.5", requires = "against")]
    time_tolerance_s: f64,
}

/// Recorded predictions.
pub struct Against {
    predictions: Predictions,
    criteria: Criteria,
    /// Time of the first sample, ns.
    pub start_ns: i64,
}

/// Squeals of a channel with their comparison.
pub struct Met<'a> {
    pub squeals: &'a [Squeal],
    pub meeting: Meeting,
}

impl AgainstArgs {
    /// The recorded predictions, if any are asked for.
    ///
    /// # Errors
    /// The recording cannot be read or holds no predictions.
    pub fn read(&self) -> anyhow::Result<Option<Against>> {
        let Some(path) = &self.against else { return Ok(None) };
        let (path, recording) = open_last(path)?;
        let predictions = read_predictions(&recording);
        let Some((first_ns, _)) = predictions.span_ns() else {
            return Err(without_predictions(&path, &recording));
        };
        let criteria = Criteria {
            frequency_tolerance: self.frequency_tolerance,
            time_tolerance_s: self.time_tolerance_s,
            ..Criteria::default()
        };
        let start_ns = first_ns.saturating_add((self.offset_s * 1e9).round() as i64);
        Ok(Some(Against { predictions, criteria, start_ns }))
    }
}

/// The squealing modes of all predictions of a recording.
fn read_predictions(recording: &Recording) -> Predictions {
    let mut predictions = Predictions::default();
    for_each_prediction(recording, |prediction| add(&mut predictions, prediction));
    predictions
}

/// Calls `each` with the predictions of a recording.
pub fn for_each_prediction(recording: &Recording, mut each: impl FnMut(&Prediction)) {
    for entry in recording.messages() {
        if let Recorded::Known(Payload::Prediction(prediction)) = entry.message {
            each(&prediction);
        }
    }
}

impl Against {
    /// Compares the squeals of a channel, which was listened to for `duration_s`.
    ///
    /// # Errors
    /// There is no time in which there are both sound and predictions.
    pub fn meet<'a>(&self, squeals: &'a [Squeal], duration_s: f64, band_hz: [f64; 2]) -> anyhow::Result<Met<'a>> {
        let (from_ns, to_ns) = (self.start_ns, self.start_ns.saturating_add((duration_s * 1e9) as i64));
        let meeting =
            self.predictions.meet(squeals, &Listened { from_ns, to_ns, band_hz }, &self.criteria).ok_or_else(|| {
                anyhow!("--against: sound and predictions have no time in common; --offset-s shifts the sound")
            })?;
        Ok(Met { squeals, meeting })
    }

    /// The comparison as a table.
    pub fn text(&self, met: &Met) -> String {
        let Met { squeals, meeting } = met;
        let Criteria { frequency_tolerance, time_tolerance_s, .. } = meeting.criteria;
        let seconds = |ns: i64| ns.saturating_sub(self.start_ns) as f64 * 1e-9;
        let mut text = format!(
            "\nagainst the predictions, frequencies within {} %, times within {time_tolerance_s} s\n",
            100.0 * frequency_tolerance
        );
        if !squeals.is_empty() {
            text += "\n  no       onset   frequency  verdict     mode   predicted    growth  predicted      lead\n";
            text += "               s          Hz                         Hz       1/s        1/s         s\n";
        }
        for (squeal, verdict) in squeals.iter().zip(&meeting.verdicts) {
            let _ = write!(
                text,
                "{:>4}  {:>10.4}  {:>10.2}  {:<10}",
                squeal.number,
                seconds(squeal.onset_ns),
                squeal.frequency_hz,
                name(verdict)
            );
            if let Verdict::Hit { mode_id, predicted_hz, predicted_growth_rate_per_s, lead_s } = verdict {
                let growth = squeal.growth.map_or("-".to_owned(), |growth| format!("{:.1}", growth.rate_per_s));
                let _ = write!(
                    text,
                    "{mode_id:>6}  {predicted_hz:>10.2}  {growth:>8}  {predicted_growth_rate_per_s:>9.1}  {lead_s:>8.2}"
                );
            }
            text += "\n";
        }
        for predicted in meeting.false_alarms.iter().map(|&index| &self.predictions.squeals()[index]) {
            let _ = writeln!(
                text,
                "false alarm: mode {}, {:.2} to {:.2} Hz, from {:.2} to {:.2} s, growth up to {:.1} 1/s",
                predicted.mode_id,
                predicted.low_hz,
                predicted.high_hz,
                seconds(predicted.from_ns),
                seconds(predicted.to_ns),
                predicted.growth_rate_per_s
            );
        }
        text + &scores(meeting)
    }
}

fn name(verdict: &Verdict) -> &'static str {
    match verdict {
        Verdict::Hit { .. } => "hit",
        Verdict::Miss => "miss",
        Verdict::Harmonic => "harmonic",
        Verdict::NotJudged => "not judged",
    }
}

/// Every score with its counts.
fn scores(meeting: &Meeting) -> String {
    let Meeting { score, slots, slot_s, .. } = meeting;
    let shown = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.3}"));
    let mut text = format!(
        "\nrecall     {}: {} of {} squeals were predicted\n\
         precision  {}: {} of {} predicted squeals were found\n\
         MCC        {}: of slots of {slot_s} s, {} hits, {} misses, {} false alarms, {} quiet\n\
         not judged {} squeals, {} predicted squeals; {} harmonics\n",
        shown(score.recall()),
        score.hits,
        score.hits + score.misses,
        shown(score.precision()),
        score.confirmed,
        score.confirmed + score.false_alarms,
        shown(slots.mcc()),
        slots.hits,
        slots.misses,
        slots.false_alarms,
        slots.quiet,
        meeting.squeals_not_judged,
        meeting.predictions_not_judged,
        meeting.harmonics,
    );
    let leads = meeting.leads_s();
    if let (Some(least), Some(most)) = (leads.first(), leads.last()) {
        let median = leads[leads.len() / 2];
        let _ = writeln!(text, "lead       {least:.2} to {most:.2} s, median {median:.2} s, of {} hits", leads.len());
    }
    let judged = meeting.modes.iter().filter(|(_, score)| score.hits + score.confirmed + score.false_alarms > 0);
    for (mode, score) in judged {
        let _ = writeln!(
            text,
            "mode {mode:>5}  {} squeals; predicted {} times, found {} times, {} false alarms",
            score.hits,
            score.confirmed + score.false_alarms,
            score.confirmed,
            score.false_alarms
        );
    }
    text
}
