//! The part of a report on sound: spectrograms, scores, growth rates and the applications of the brake.

use std::fmt::Write;

use super::applications::{Application, applications, at};
use super::heard::{SquealInSound, SquealsInSound};
use super::history::{Bin, History};
use super::recorded::{MOST_SPECTROGRAMS, Recorded};
use super::report::{LISTED, optional};
use crate::figures::html::{escaped, facts, figure, section};
use crate::figures::plot::PlotError;
use crate::figures::spectrogram::{Overlay, Scatter, scatter, spectrogram};
use crate::offline::score::MetChannel;
use crate::sound::matching::{Criteria, median};
use crate::sound::spectrogram::Spectrogram;

/// Applications listed in the table.
const APPLICATIONS_LISTED: usize = 100;
/// Predicted frequencies that differ by less than this are drawn as one line: half a row of the picture, Hz.
const SAME_HZ: f64 = 25.0;
/// Steps of the occurrence above the threshold, dB.
const LEVEL_STEPS_DB: [f64; 6] = [0.0, 5.0, 10.0, 15.0, 20.0, 30.0];

/// The sections on sound; none without sound.
///
/// # Errors
/// A figure cannot be drawn.
pub fn sections(recorded: &Recorded, from_s: f64) -> Result<String, PlotError> {
    let squeals = &recorded.squeals_in_sound;
    if squeals.iter().len() == 0 && recorded.spectrograms.is_empty() {
        return Ok(String::new());
    }
    let mut sound = String::new();
    for (name, shown) in &recorded.spectrograms {
        sound += &channel_figure(recorded, name, shown, from_s)?;
    }
    if recorded.spectrograms.is_empty() {
        sound += "<p>The samples were not recorded: no spectrogram.</p>\n";
    } else if recorded.spectrograms.len() == MOST_SPECTROGRAMS {
        let _ = writeln!(sound, "<p>Spectrograms of the first {MOST_SPECTROGRAMS} channels.</p>");
    }
    let mut html = section("Sound", &sound);
    if squeals.iter().len() > 0 {
        html += &section("Squeal in sound", &squeals_in_sound(squeals, from_s));
    }
    let met = recorded.heard_and_predicted.meet(&Criteria::default());
    html += &section("Predictions against sound", &scores(recorded, &met, from_s)?);
    html += &section("Applications of the brake (after SAE J2521)", &brake_applications(recorded, from_s)?);
    Ok(html)
}

/// Stretches in which a mode was predicted to be unstable, with its frequency.
fn predicted(history: &History, from_s: f64) -> Vec<(f64, f64, f64)> {
    let bin_s = history.bin_ns() as f64 * 1e-9;
    let mut done: Vec<(f64, f64, f64)> = vec![];
    // The stretch of each mode of the bin before.
    let mut open: Vec<(i64, (f64, f64, f64))> = vec![];
    for bin in history.bins() {
        let (from, to) = (bin.index as f64 * bin_s - from_s, (bin.index + 1) as f64 * bin_s - from_s);
        let continued = |stretch: &(i64, (f64, f64, f64)), hz: f64| {
            stretch.0 + 1 == bin.index && (stretch.1.2 - hz).abs() < SAME_HZ
        };
        let mut next = vec![];
        for hz in bin.unstable.into_iter().flatten().map(|mode| f64::from(mode.0)) {
            match open.iter().position(|stretch| continued(stretch, hz)) {
                Some(index) => {
                    let (_, (start, _, first_hz)) = open.swap_remove(index);
                    next.push((bin.index, (start, to, first_hz)));
                }
                None => next.push((bin.index, (from, to, hz))),
            }
        }
        done.extend(open.drain(..).map(|stretch| stretch.1));
        open = next;
    }
    done.extend(open.into_iter().map(|stretch| stretch.1));
    done
}

fn channel_figure(recorded: &Recorded, name: &str, shown: &Spectrogram, from_s: f64) -> Result<String, PlotError> {
    let squeals = recorded.squeals_in_sound.iter().filter(|squeal| squeal.channel == name);
    let frame = |squeal: &SquealInSound| {
        let end_s = squeal.end_s.unwrap_or(squeal.onset_s + 0.1);
        (squeal.onset_s - from_s, end_s - from_s, squeal.frequency_hz)
    };
    let overlay = Overlay { predicted: predicted(&recorded.history, from_s), squeals: squeals.map(frame).collect() };
    let [low, high] = shown.band_hz();
    let unit = shown.quantity().level_unit();
    let threshold_db = recorded.sound_settings.threshold_db;
    let caption = format!(
        "Channel {}: highest levels of short-time spectra in columns of {:.2} s and rows of {:.0} Hz, in colours over 80 dB. \
         Light blue: frequencies predicted to be unstable. White frames: {} squeals found. Below: the highest level between \
         {low} and {high} Hz in {unit}, and the threshold of {threshold_db} dB.",
        escaped(name),
        shown.column_ns() as f64 * 1e-9,
        (shown.top_hz() - shown.bottom_hz()) / shown.rows() as f64,
        overlay.squeals.len(),
    );
    Ok(figure(&spectrogram(shown, &overlay, from_s, threshold_db)?, &caption))
}

/// The squeals found in samples while the session ran, and the predictions they were compared with then.
fn squeals_in_sound(squeals: &SquealsInSound, from_s: f64) -> String {
    let mut html =
        "<table><thead><tr><th>channel</th><th>no.</th><th>onset, s</th><th>end, s</th><th>frequency, Hz</th>\
                    <th>level</th><th>growth, 1/s</th><th>prediction</th><th>mode</th><th>predicted, Hz</th>\
                    <th>predicted growth, 1/s</th></tr></thead><tbody>\n"
            .to_owned();
    for squeal in squeals.iter().take(LISTED) {
        let cells = [
            escaped(&squeal.channel),
            squeal.number.to_string(),
            format!("{:.3}", squeal.onset_s - from_s),
            squeal.end_s.map_or_else(|| "lasts".to_owned(), |end_s| format!("{:.3}", end_s - from_s)),
            format!("{:.1}", squeal.frequency_hz),
            format!("{:.1} {}", squeal.level_db, squeal.level_unit),
            optional(squeal.growth_rate_per_s),
            squeal.verdict.to_owned(),
            squeal.mode_id.map_or_else(|| "–".to_owned(), |id| id.to_string()),
            optional(squeal.predicted_frequency_hz),
            optional(squeal.predicted_growth_rate_per_s),
        ];
        let cells: String = cells.iter().map(|cell| format!("<td>{cell}</td>")).collect();
        let _ = writeln!(html, "<tr>{cells}</tr>");
    }
    html += "</tbody></table>\n";
    let count = squeals.iter().len();
    if count > LISTED {
        let _ = writeln!(html, "<p>{} more in the recording.</p>", count - LISTED);
    }
    html
}

/// Hits, misses and false alarms of every channel, each score with its counts, and measured values over predicted ones.
fn scores(recorded: &Recorded, met: &[MetChannel], from_s: f64) -> Result<String, PlotError> {
    if met.is_empty() {
        return Ok("<p>Sound and predictions have no time in common: nothing to compare.</p>\n".to_owned());
    }
    let mut html = String::new();
    for met in met {
        let _ = writeln!(html, "<h3>Channel {}</h3>", escaped(&met.channel));
        html += &facts(score_rows(met));
        let predicted = recorded.heard_and_predicted.predictions().squeals();
        for alarm in met.meeting.false_alarms.iter().take(LISTED).filter_map(|&index| predicted.get(index)) {
            let seconds = |ns: i64| ns as f64 * 1e-9 - from_s;
            let _ = writeln!(
                html,
                "<p>False alarm: mode {}, {:.1} to {:.1} Hz, from {:.2} to {:.2} s.</p>",
                alarm.mode_id,
                alarm.low_hz,
                alarm.high_hz,
                seconds(alarm.from_ns),
                seconds(alarm.to_ns)
            );
        }
    }
    let Criteria { frequency_tolerance, time_tolerance_s, .. } = met[0].meeting.criteria;
    let _ = writeln!(
        html,
        "<p>A squeal is a <em>hit</em> if a mode was predicted to squeal within {} % of its frequency and {time_tolerance_s} s \
         of its time, else a <em>miss</em>; a predicted squeal without one is a <em>false alarm</em>. Each channel is judged \
         by itself.</p>",
        100.0 * frequency_tolerance
    );
    let pairs =
        |of: fn(&SquealInSound) -> Option<(f64, f64)>| recorded.squeals_in_sound.iter().filter_map(of).collect();
    let growth: Vec<(f64, f64)> = pairs(|squeal| squeal.predicted_growth_rate_per_s.zip(squeal.growth_rate_per_s));
    let frequency: Vec<(f64, f64)> = pairs(|squeal| Some((squeal.predicted_frequency_hz?, squeal.frequency_hz)));
    if !frequency.is_empty() {
        let caption = format!(
            "Measured over predicted values of {} hits, of {} of them the growth rate at the onset. The line marks equal \
             values.",
            frequency.len(),
            growth.len()
        );
        let panel = |x_label, y_label, points| Scatter { x_label, y_label, points, line: true };
        let panels = [
            panel("predicted growth rate, 1/s", "measured, 1/s", growth),
            panel("predicted frequency, Hz", "measured, Hz", frequency),
        ];
        html += &figure(&scatter(&panels)?, &caption);
    }
    Ok(html)
}

fn score_rows(met: &MetChannel) -> Vec<(&'static str, String)> {
    let (score, slots) = (&met.meeting.score, &met.meeting.slots);
    let share = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
    let leads = met.meeting.leads_s();
    let lead = match (leads.first(), leads.last(), median(&leads)) {
        (Some(least), Some(most), Some(median)) => {
            format!("{least:.2} s to {most:.2} s, median {median:.2} s, of {} hits", leads.len())
        }
        _ => "–".to_owned(),
    };
    let judged = if met.has_samples { "" } else { "; the samples were not recorded, so all of it counts as received" };
    vec![
        ("judged", format!("{:.2} s with sound and predictions{judged}", met.judged_s)),
        ("recall", format!("{}: {} hits, {} misses", share(score.recall()), score.hits, score.misses)),
        (
            "precision",
            format!(
                "{}: {} predicted squeals found, {} false alarms",
                share(score.precision()),
                score.confirmed,
                score.false_alarms
            ),
        ),
        (
            "MCC",
            format!(
                "{}: of slots of {} s, {} hits, {} misses, {} false alarms, {} quiet",
                share(slots.mcc()),
                met.meeting.slot_s,
                slots.hits,
                slots.misses,
                slots.false_alarms,
                slots.quiet
            ),
        ),
        ("lead", lead),
        (
            "not judged",
            format!(
                "{} squeals, {} predicted squeals; {} harmonics",
                met.meeting.squeals_not_judged, met.meeting.predictions_not_judged, met.meeting.harmonics
            ),
        ),
    ]
}

/// The applications with the occurrence of squeal in them, and levels over frequency and conditions.
fn brake_applications(recorded: &Recorded, from_s: f64) -> Result<String, PlotError> {
    let found = applications(&recorded.history, recorded.squeals_in_sound.iter());
    let bin_s = recorded.history.bin_ns() as f64 * 1e-9;
    let mut html = format!(
        "<p>An application is a stretch in which the load is at least 10 % of the session's highest and the speed at least \
         1 % of the fastest, known to {bin_s:.2} s; interruptions below 0.5 s are included. Its level is that of the loudest \
         squeal in it, of any channel.</p>\n"
    );
    if found.is_empty() {
        return Ok(html + "<p>None.</p>\n");
    }
    html += &occurrence(&found, recorded.sound_settings.threshold_db);
    html += &application_table(&found, from_s);
    let loud = || recorded.squeals_in_sound.iter().filter(|squeal| squeal.verdict != "harmonic");
    let over = |of: &dyn Fn(&SquealInSound) -> Option<f64>| -> Vec<(f64, f64)> {
        loud().filter_map(|squeal| Some((of(squeal)?, squeal.level_db))).collect()
    };
    if loud().next().is_some() {
        let middle = |index: usize| {
            move |squeal: &SquealInSound| {
                let range = |bin: &Bin| bin.ranges[index];
                let (low, high) = at(&recorded.history, squeal.onset_s).and_then(range)?;
                Some(0.5 * f64::from(low + high))
            }
        };
        let panel = |x_label, points| Scatter { x_label, y_label: "level, dB", points, line: false };
        let mut panels = vec![
            panel("frequency, Hz", over(&|squeal| Some(squeal.frequency_hz))),
            panel("disc speed, rad/s", over(&middle(1))),
            panel("normal load, N", over(&middle(0))),
            panel("friction coefficient", over(&middle(2))),
        ];
        let temperature = over(&|squeal| Some(recorded.history.temperature_before(squeal.onset_s)?.1));
        if !temperature.is_empty() {
            panels.push(panel("temperature, °C", temperature));
        }
        let caption =
            format!("Levels of {} squeals, over their frequency and the conditions at their onset.", loud().count());
        html += &figure(&scatter(&panels)?, &caption);
    }
    Ok(html)
}

/// The share of applications with a squeal of at least each level.
fn occurrence(found: &[Application], threshold_db: f64) -> String {
    let rows = LEVEL_STEPS_DB.map(|step| {
        let least_db = threshold_db + step;
        let loud = found.iter().filter(|application| application.level_db.is_some_and(|db| db >= least_db)).count();
        let share = 100.0 * loud as f64 / found.len() as f64;
        (format!("at least {least_db} dB"), format!("{share:.1} %: {loud} of {} applications", found.len()))
    });
    format!("<h3>Occurrence</h3>\n{}", facts(rows))
}

fn application_table(found: &[Application], from_s: f64) -> String {
    let with_temperature = found.iter().any(|application| application.temperature_c.is_some());
    let heading = if with_temperature { "<th>temperature, °C</th>" } else { "" };
    let mut html = format!(
        "<table><thead><tr><th>no.</th><th>from, s</th><th>duration, s</th><th>load, N</th><th>speed, rad/s</th>{heading}\
         <th>squeals</th><th>level, dB</th><th>frequency, Hz</th></tr></thead><tbody>\n"
    );
    let tenths = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.1}"));
    let range = |(low, high): (f32, f32)| format!("{low:.1} to {high:.1}");
    for (application, number) in found.iter().zip(1..).take(APPLICATIONS_LISTED) {
        let temperature = application.temperature_c.map_or("–".to_owned(), range);
        let mut cells = vec![
            number.to_string(),
            format!("{:.2}", application.from_s - from_s),
            format!("{:.2}", application.to_s - application.from_s),
            range(application.load_n),
            range(application.speed_rad_s),
        ];
        cells.extend(with_temperature.then_some(temperature));
        cells.extend([application.squeals.to_string(), tenths(application.level_db), tenths(application.frequency_hz)]);
        let cells: String = cells.iter().map(|cell| format!("<td>{cell}</td>")).collect();
        let _ = writeln!(html, "<tr>{cells}</tr>");
    }
    html += "</tbody></table>\n";
    if found.len() > APPLICATIONS_LISTED {
        let _ = writeln!(html, "<p>{} more.</p>", found.len() - APPLICATIONS_LISTED);
    }
    html
}
