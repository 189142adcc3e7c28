//! A recording as one self-contained HTML file.

use std::fmt::Write;

use super::comparison::{Comparison, Judged, Verdict};
use super::contact::contact;
use super::curves::Curves;
use super::events::{Event, EventColumn, EventKind, EventMoment, Events, MomentColumn, iso, seconds};
use super::recorded::Recorded;
use super::sound_report;
use crate::figures::contact as contact_figure;
use crate::figures::html::{escaped, facts, figure, page, section};
use crate::figures::plot;
use crate::msgs::{SessionEvent, SessionEventKind};
use crate::node::status::Status;
use crate::session::conditions;
use crate::sound::matching::median;

/// Number of stability maps drawn.
const WORST: usize = 3;
/// Number of events listed; all of them are in the CSV file.
pub(super) const LISTED: usize = 500;

/// Settings recorded in this initial time are those the session started with, s.
const STARTING_S: f64 = 0.5;

/// The origin of the recording, as the report states it.
#[derive(Clone, Debug)]
pub struct Origin {
    pub file: String,
    pub version: Option<String>,
}

/// Writes the report as HTML.
///
/// # Errors
/// A figure cannot be drawn.
pub fn report(recorded: &Recorded, origin: &Origin) -> Result<String, plot::PlotError> {
    let rig = &recorded.rig;
    let (from_s, to_s) = recorded.span_s().unwrap_or((0.0, 0.0));
    let title = format!("{}, {}", rig.name, iso(from_s));
    let mut html = format!("<h1>Session report</h1>\n<p class=\"lead\">{}</p>\n", escaped(&title));
    if recorded.simulated {
        html += "<p class=\"lead\">Conditions of a rig simulator, not of a rig.</p>\n";
    }
    html += &verdict(recorded, to_s);
    html += &section("Session", &session(recorded, origin, from_s, to_s));
    html += &section(
        "Conditions and predictions",
        &figure(
            &plot::history("", &recorded.history, from_s, recorded.vibration.criteria().threshold_db)?,
            "Smallest and largest value in each stretch of time; shaded where squeal was predicted. Dots are \
             frequencies at which squeal was measured.",
        ),
    );
    html += &section("Events", &events(&recorded.events, from_s));
    html += &sound_report::sections(recorded, from_s)?;
    let measured = recorded.comparison().map_or_else(
        || {
            "<p>The recording holds no measured vibration (topic /rig/vibration): nothing to compare with.</p>\n"
                .to_owned()
        },
        |found| comparison(&found, recorded.vibration.count(), from_s),
    );
    html += &section("Prediction against measurement", &measured);
    html += &section("Maps, charts and settings during the session", &session_events(recorded, from_s));
    let mut maps = String::new();
    let mut drawn = vec![];
    for event in worst(&recorded.events) {
        let Some(peak) = event.peak else { continue };
        let at_s = peak.time_s;
        let number = recorded.map_number(at_s).max(1);
        // One figure for each map, at its worst moment.
        if drawn.len() == WORST || drawn.contains(&number) {
            continue;
        }
        drawn.push(number);
        let Some(map) = recorded.stability_map(number) else { continue };
        let curves = Curves::new(&map, rig.band_max_hz);
        let caption = format!(
            "Event {}, {:.2} s after the start: {:.1} N, {:.3} rad/s, critical friction coefficient {}. The line marks \
             the friction coefficient of the fastest growth.",
            event.number,
            at_s - from_s,
            map.point.normal_load_n,
            map.point.disc_speed_rad_s,
            map.critical_friction().map_or_else(|| "none".to_owned(), |mu| format!("{mu:.6}")),
        );
        let mu = peak.friction_coefficient.unwrap_or(0.0);
        let last = curves.mu.last().copied().unwrap_or(1.0);
        let wanted = [1.6 * curves.critical_friction.unwrap_or(last), 1.15 * mu, 0.05];
        let to = wanted.into_iter().filter(|mu| mu.is_finite()).fold(0.0, f64::max).min(last);
        maps += &figure(&plot::map("", &curves, to, Some(mu))?, &escaped(&caption));
    }
    if maps.is_empty() {
        maps = match worst(&recorded.events).is_empty() {
            true => "<p>No mode was predicted to squeal.</p>\n",
            false => "<p>The recording names no stability map.</p>\n",
        }
        .to_owned();
    }
    html += &section("Stability maps at the worst moments", &maps);
    html += &contacts(recorded, from_s, to_s)?;
    html += &section("Error bounds", &error_bounds(recorded));
    html += &section("Skipped work and damage", &skipped(recorded));
    html += &section("Rig", &format!("<pre>{}</pre>\n", escaped(&rig.describe())));
    Ok(page(&format!("squealcast report: {title}"), &html))
}

/// The contact at the worst moments, or at the last one if nothing squealed, for a rig with a contact state.
///
/// # Errors
/// A figure cannot be drawn.
fn contacts(recorded: &Recorded, from_s: f64, to_s: f64) -> Result<String, plot::PlotError> {
    if recorded.rig.model.statics().is_none() {
        return Ok(String::new());
    }
    let mut moments: Vec<f64> =
        worst(&recorded.events).iter().take(WORST).filter_map(|e| Some(e.peak?.time_s)).collect();
    if moments.is_empty() {
        moments.push(to_s);
    }
    let mut html = String::new();
    for time_s in moments {
        let Some(input) = recorded.moment(time_s).and_then(|moment| moment.input.as_ref()) else { continue };
        let after_s = time_s - from_s;
        match contact(&recorded.rig, &conditions(input)) {
            Ok(contact) => {
                let caption = format!(
                    "{after_s:.2} s after the start: {:.1} N, {:.3} rad/s, friction coefficient {:.4}. {} of {} pairs \
                     closed; they carry {:.1} N in all, with {:.1} N on the back of the pad.",
                    contact.normal_load_n,
                    contact.disc_speed_rad_s,
                    contact.friction_coefficient,
                    contact.pairs_closed,
                    contact.force_n.len(),
                    contact.contact_force_n,
                    contact.back_force_n
                );
                for face in contact.faces() {
                    html += &figure(&contact_figure::draw(&face)?, &escaped(&caption));
                }
            }
            Err(reason) => html += &format!("<p>{after_s:.2} s after the start: {}.</p>\n", escaped(&reason)),
        }
    }
    Ok(section("Contact", &html))
}

/// One sentence that summarises the recording.
fn verdict(recorded: &Recorded, to_s: f64) -> String {
    let events = &recorded.events;
    let predictions = recorded.predictions();
    let faults = recorded.count(Status::Fault);
    let mut failed = match faults {
        0 => String::new(),
        _ => format!(
            "<p class=\"verdict fault\">{faults} of {predictions} predictions are faults: nothing is known of these \
             moments.</p>\n"
        ),
    };
    let silences: Vec<&Event> = events.iter().filter(|event| event.kind == EventKind::NoData).collect();
    if !silences.is_empty() {
        let lasted: f64 = silences.iter().map(|event| event.end_s.unwrap_or(to_s) - event.onset_s).sum();
        let count = silences.len();
        let times = if count == 1 { "once".to_owned() } else { format!("{count} times") };
        let _ = writeln!(failed, "<p class=\"verdict fault\">Inputs stopped {times}, for {lasted:.2} s in all.</p>");
    }
    let squeals: Vec<&Event> = events.iter().filter(|event| event.kind == EventKind::Squeal).collect();
    let known = recorded.counts.iter().any(|(status, &count)| status.is_known() && count > 0);
    let lasted: f64 = squeals.iter().map(|event| event.end_s.unwrap_or(to_s) - event.onset_s).sum();
    let worst = worst(events).into_iter().next();
    match worst {
        None if squeals.is_empty() && !known => {
            format!("<p class=\"verdict fault\">Nothing was predicted: no input was usable.</p>\n{failed}")
        }
        None if squeals.is_empty() => format!("<p class=\"verdict ok\">No squeal was predicted.</p>\n{failed}"),
        worst => {
            format!(
                "<p class=\"verdict squeal\">Squeal was predicted {} time{}, {lasted:.2} s in all{}.</p>\n",
                squeals.len(),
                if squeals.len() == 1 { "" } else { "s" },
                worst.and_then(|event| event.peak).map_or_else(String::new, |peak| format!(
                    "; worst in {} at {} Hz, growing by {} 1/s at μ = {}",
                    peak.mode_id.map_or_else(|| "static divergence".to_owned(), |id| format!("mode {id}")),
                    optional(peak.frequency_hz),
                    optional(peak.growth_rate_per_s),
                    optional(peak.friction_coefficient),
                ))
            ) + &failed
        }
    }
}

fn session(recorded: &Recorded, origin: &Origin, from_s: f64, to_s: f64) -> String {
    let counted = Status::ALL.into_iter().filter(|&status| recorded.count(status) > 0);
    let counted: Vec<String> = counted.map(|status| format!("{} {}", status.name(), recorded.count(status))).collect();
    let mut rows = vec![
        ("recording", origin.file.clone()),
        ("from", iso(from_s)),
        ("to", format!("{} ({:.2} s)", iso(to_s), to_s - from_s)),
        ("rig", recorded.rig.name.clone()),
        ("rig hash", recorded.rig.content_hash.clone()),
        ("recorded by", origin.version.clone().unwrap_or_else(|| "not known".to_owned())),
        ("report by", format!("squealcast {}", env!("CARGO_PKG_VERSION"))),
        ("inputs", recorded.inputs.to_string()),
        ("predictions", format!("{} ({})", recorded.predictions(), counted.join(", "))),
    ];
    let settings = recorded.events_of(SessionEventKind::Parameter);
    let listed: Vec<String> = settings
        .map(|(time_ns, event)| match seconds(*time_ns) - from_s {
            late if late > STARTING_S => format!("{} = {} after {late:.2} s", event.name, event.value),
            _ => format!("{} = {}", event.name, event.value),
        })
        .collect();
    rows.push(("settings", listed.join("; ")));
    facts(rows)
}

fn events(events: &Events, from_s: f64) -> String {
    let count = events.iter().count();
    if count == 0 {
        return "<p>None.</p>\n".to_owned();
    }
    let [once @ .., last] = EventColumn::ALL;
    let heading = |column: EventColumn| column.heading().map(|text| format!("<th rowspan=\"2\">{text}</th>"));
    let before: String = once.into_iter().filter_map(heading).collect();
    let after = heading(last).unwrap_or_default();
    let headings: Vec<&str> = MomentColumn::ALL.into_iter().filter_map(MomentColumn::heading).collect();
    let (columns, of_moment) = (headings.len(), format!("<th>{}</th>", headings.join("</th><th>")));
    let mut html = format!(
        "<table><thead><tr>{before}<th colspan=\"{columns}\">onset</th><th colspan=\"{columns}\">fastest growth</th>\
         {after}</tr>\n<tr>{of_moment}{of_moment}</tr></thead><tbody>\n"
    );
    for event in events.iter().take(LISTED) {
        let cell = |column: EventColumn| event_cell(column, event, from_s);
        let peak = event.peak.map_or_else(|| vec!["–".to_owned(); columns], |peak| event_moment(&peak, from_s));
        let cells = once.into_iter().filter_map(cell).chain(event_moment(&event.onset, from_s)).chain(peak);
        let cells: String = cells.chain(cell(last)).map(|cell| format!("<td>{cell}</td>")).collect();
        let class = match event.kind {
            EventKind::Squeal => "squeal",
            EventKind::Fault | EventKind::NoData => "fault",
        };
        let _ = writeln!(html, "<tr class=\"{class}\">{cells}</tr>");
    }
    html += "</tbody></table>\n";
    if count > LISTED {
        let _ = writeln!(html, "<p>{} more in events.csv.</p>", count - LISTED);
    }
    html
}

/// The cell for what an event has once; `None` if the column has no heading.
fn event_cell(column: EventColumn, event: &Event, from_s: f64) -> Option<String> {
    column.heading()?;
    Some(match column {
        EventColumn::Number => event.number.to_string(),
        EventColumn::Kind => event.kind.name().to_owned(),
        EventColumn::Onset => format!("{:.3}", event.onset_s - from_s),
        EventColumn::End => event.end_s.map_or_else(|| "lasts".to_owned(), |end_s| format!("{:.3}", end_s - from_s)),
        EventColumn::Duration => {
            event.end_s.map_or_else(|| "–".to_owned(), |end_s| format!("{:.3}", end_s - event.onset_s))
        }
        EventColumn::Interruptions => event.interruptions.to_string(),
        EventColumn::InputSeq => event.input_seq.to_string(),
        EventColumn::Reason => event.reason.as_deref().map_or_else(|| "–".to_owned(), escaped),
    })
}

/// Cells for a moment of an event, one for every column with a heading.
fn event_moment(moment: &EventMoment, from_s: f64) -> Vec<String> {
    let cell = |column: MomentColumn| match column {
        MomentColumn::Time => format!("{:.3}", moment.time_s - from_s),
        MomentColumn::Mode => moment.mode_id.map_or_else(|| "–".to_owned(), |id| id.to_string()),
        MomentColumn::Frequency => optional(moment.frequency_hz),
        MomentColumn::GrowthRate => optional(moment.growth_rate_per_s),
        MomentColumn::NormalLoad => optional(moment.normal_load_n),
        MomentColumn::DiscSpeed => optional(moment.disc_speed_rad_s),
        MomentColumn::Friction => optional(moment.friction_coefficient),
        MomentColumn::CriticalFriction => optional(moment.critical_friction),
    };
    MomentColumn::ALL.into_iter().filter(|column| column.heading().is_some()).map(cell).collect()
}

/// The section on hits, misses and false alarms, with definitions.
fn comparison(found: &Comparison, measurements: u64, from_s: f64) -> String {
    let criteria = &found.criteria;
    let (hits, misses, false_alarms) = (found.hits(), found.misses(), found.false_alarms.len());
    let share = |part: usize, rest: usize| match part + rest {
        0 => "–".to_owned(),
        all => format!("{part} of {all} ({:.1} %)", 100.0 * part as f64 / all as f64),
    };
    let leads = found.leads_s();
    let lead = match (leads.first(), leads.last(), median(&leads)) {
        (Some(first), Some(last), Some(median)) => format!("{median:.3} s median, {first:.3} s to {last:.3} s"),
        _ => "–".to_owned(),
    };
    let rows = [
        ("measurements", measurements.to_string()),
        ("hits", format!("{hits}: measured squeals that were predicted, {}", share(hits, misses))),
        ("misses", format!("{misses}: measured squeals that were not")),
        (
            "false alarms",
            format!(
                "{false_alarms}: predicted squeals that were not measured, {}",
                share(false_alarms, found.confirmed.len())
            ),
        ),
        ("not judged", format!("{}: predicted squeals during which nothing was measured", found.unjudged.len())),
        ("lead", format!("{lead}, from the predicted to the measured onset")),
    ];
    let mut html = facts(rows);
    let _ = writeln!(
        html,
        "<p>A <em>measured squeal</em> is a stretch of measurements of at least {} dB, with interruptions shorter than \
         0.25 s, that lasts at least {} s; its frequency is that of its loudest measurement. A <em>predicted squeal</em> \
         is a SQUEAL event of this report; its frequencies are the range of its unstable modes' frequencies. They match where \
         they overlap in time, the prediction widened by {} s at both ends, and where the measured frequency is within \
         {} % of one of those frequencies. A measured squeal with a match is a <em>hit</em>, one without a \
         <em>miss</em>; a predicted squeal without a match is a <em>false alarm</em>. The lead is negative where the \
         measured onset came first.</p>",
        criteria.threshold_db,
        criteria.least_duration_s,
        criteria.time_tolerance_s,
        100.0 * criteria.frequency_tolerance,
    );
    if !found.measured.is_empty() {
        html += "<table><thead><tr><th>no.</th><th>measured squeal</th><th>after, s</th><th>duration, s</th>\
                 <th>level, dB</th><th>frequency, Hz</th><th>predicted as</th><th>lead, s</th><th>frequency off, %</th>\
                 </tr></thead><tbody>\n";
    }
    for (k, Judged { squeal, verdict }) in (1..).zip(found.measured.iter().take(LISTED)) {
        let (kind, predicted) = match *verdict {
            Verdict::Hit { event, mode_id, lead_s, frequency_difference } => (
                "hit",
                [
                    format!("event {event}, mode {mode_id}"),
                    format!("{lead_s:.3}"),
                    format!("{:+.2}", 100.0 * frequency_difference),
                ],
            ),
            Verdict::OtherFrequency => ("miss", ["other frequencies".to_owned(), String::new(), String::new()]),
            Verdict::NotPredicted => ("miss", ["nothing".to_owned(), String::new(), String::new()]),
        };
        let measured = [
            k.to_string(),
            kind.to_owned(),
            format!("{:.3}", squeal.onset_s - from_s),
            format!("{:.3}", squeal.end_s - squeal.onset_s),
            format!("{:.1}", squeal.peak_db),
            number(squeal.frequency_hz),
        ];
        let cells: String = measured.iter().chain(&predicted).map(|cell| format!("<td>{cell}</td>")).collect();
        let _ = writeln!(html, "<tr class=\"{kind}\">{cells}</tr>");
    }
    if !found.measured.is_empty() {
        html += "</tbody></table>\n";
    }
    if found.measured.len() > LISTED {
        let _ = writeln!(html, "<p>{} more are not listed.</p>", found.measured.len() - LISTED);
    }
    if false_alarms > 0 {
        let numbers: Vec<String> = found.false_alarms.iter().take(LISTED).map(u64::to_string).collect();
        let _ = writeln!(html, "<p>False alarms: events {}.</p>", numbers.join(", "));
    }
    html
}

/// The section on maps, charts and changed settings.
fn session_events(recorded: &Recorded, from_s: f64) -> String {
    let row = |(time_ns, event): &(i64, SessionEvent)| {
        let after_s = seconds(*time_ns) - from_s;
        let (what, of) = match SessionEventKind::of(event)? {
            SessionEventKind::StabilityMap => {
                ("stability map ready", format!("{:.1} N, {:.3} rad/s", event.normal_load_n, event.disc_speed_rad_s))
            }
            SessionEventKind::Chart => ("chart ready", "later predictions are evaluated from it".to_owned()),
            SessionEventKind::Temperature => ("rig at another temperature", format!("{} °C", event.value)),
            SessionEventKind::Silence => ("silence", "no input came for too long".to_owned()),
            SessionEventKind::Parameter if after_s > STARTING_S => {
                ("setting", format!("{} = {}", event.name, event.value))
            }
            // The initial settings are in the table at the top.
            SessionEventKind::Parameter => return None,
            // Up to ten a second.
            SessionEventKind::WindowEnds => return None,
        };
        let hash = event.hash.get(..12).unwrap_or_default();
        let cells = [format!("{after_s:.3}"), what.to_owned(), escaped(&of), escaped(hash)];
        Some(cells.iter().map(|cell| format!("<td>{cell}</td>")).collect::<String>())
    };
    let rows: Vec<String> = recorded.session_events.iter().filter_map(row).collect();
    if rows.is_empty() {
        return "<p>None.</p>\n".to_owned();
    }
    let mut html =
        "<table><thead><tr><th>after, s</th><th>what</th><th>of</th><th>hash</th></tr></thead><tbody>\n".to_owned();
    for row in rows.iter().take(LISTED) {
        let _ = writeln!(html, "<tr>{row}</tr>");
    }
    html += "</tbody></table>\n";
    if rows.len() > LISTED {
        let _ = writeln!(html, "<p>{} more are not listed.</p>", rows.len() - LISTED);
    }
    html
}

/// Events with growing modes, in descending order of growth rate.
fn worst(events: &Events) -> Vec<&Event> {
    let growth = |event: &Event| event.peak.and_then(|peak| peak.growth_rate_per_s);
    let mut squeals: Vec<&Event> = events.iter().filter(|event| growth(event).is_some()).collect();
    squeals.sort_by(|a, b| growth(b).unwrap_or(0.0).total_cmp(&growth(a).unwrap_or(0.0)));
    squeals
}

/// A table of the largest error bounds of each mode over the session.
fn error_bounds(recorded: &Recorded) -> String {
    let mut bounds: std::collections::BTreeMap<u32, [f64; 3]> = std::collections::BTreeMap::new();
    for mode in recorded.moments.iter().flat_map(|moment| &moment.prediction.modes) {
        let largest = bounds.entry(mode.id).or_insert([f64::NAN; 3]);
        let found = [mode.residual, mode.frequency_error_hz, mode.growth_rate_error_per_s];
        for (largest, found) in largest.iter_mut().zip(found) {
            *largest = largest.max(found);
        }
    }
    let mut html = "<table><thead><tr><th>mode</th><th>largest residual</th><th>frequency, ± Hz</th>\
                    <th>growth rate, ± 1/s</th></tr></thead><tbody>\n"
        .to_owned();
    for (id, [residual, frequency, growth]) in &bounds {
        let shown = |value: f64| match value {
            0.0 => "0".to_owned(),
            _ if value.is_finite() => format!("{value:.2e}"),
            _ => "not computed".to_owned(),
        };
        let cells = [id.to_string(), shown(*residual), shown(*frequency), shown(*growth)];
        let cells: String = cells.iter().map(|cell| format!("<td>{cell}</td>")).collect();
        let _ = writeln!(html, "<tr>{cells}</tr>");
    }
    html += "</tbody></table>\n";
    if recorded.stride > 1 {
        let _ = writeln!(html, "<p>Of every {} predictions one was looked at for this table.</p>", recorded.stride);
    }
    html
}

fn skipped(recorded: &Recorded) -> String {
    let mut html = format!(
        "<p>{} inputs were not predicted; {} predictions were reused within the dead band.</p>\n",
        recorded.inputs.saturating_sub(recorded.answered),
        recorded.reused
    );
    let counted = recorded.counted.iter().flat_map(|counted| &counted.status).flat_map(|status| &status.values);
    let counted: Vec<(&str, &str)> = counted.map(|pair| (&*pair.key, &*pair.value)).collect();
    if !counted.is_empty() {
        html += "<p>Counters of the node at the end:</p>\n";
        html += &facts(counted);
    }
    if recorded.damage.is_empty() {
        html += "<p>The recording is complete.</p>\n";
    }
    for damage in &recorded.damage {
        let _ = writeln!(html, "<p>{}</p>", escaped(&damage.to_string()));
    }
    html
}

pub(super) fn optional(value: Option<f64>) -> String {
    number(value.unwrap_or(f64::NAN))
}

/// A number with at most six significant digits.
fn number(value: f64) -> String {
    if !value.is_finite() {
        return "–".to_owned();
    }
    let magnitude = if value == 0.0 { 0.0 } else { value.abs().log10().floor() };
    let decimals = (5.0 - magnitude).clamp(0.0, 8.0) as usize;
    let text = format!("{value:.decimals$}");
    match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_written_for_people() {
        assert_eq!(number(0.334_599_12), "0.334599");
        assert_eq!(number(500.0), "500");
        assert_eq!(number(1234567.0), "1234567");
        assert_eq!(number(f64::NAN), "–");
    }
}
