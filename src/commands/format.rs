//! Formats results as text.

use std::fmt::Write;

use crate::contact::SteadyState;
use crate::physics::{OperatingPoint, StabilityMap, Summary};
use crate::rig::Rig;
pub use crate::text::number::significant;

/// The conditions in one line, with the state of the contact.
fn conditions(rig: &Rig, point: &OperatingPoint) -> String {
    let OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient } = point;
    let mut text = format!(
        "{}: {normal_load_n} N, {disc_speed_rad_s} rad/s, friction coefficient {friction_coefficient}{}\n",
        rig.name,
        temperature(rig)
    );
    rig.notes(point).for_each(|note| text += &format!("{note}\n"));
    text
}

/// The temperature of a rig that has one, after other conditions.
pub fn temperature(rig: &Rig) -> String {
    rig.temperature_c().map(|celsius| format!(", {celsius} °C")).unwrap_or_default()
}

/// Pairs closed and contact force, as a line of text.
pub fn contact(state: &SteadyState) -> String {
    format!(
        "contact: {} of {} pairs closed, contact force {} N\n",
        state.pairs_closed(),
        state.force_n.len(),
        significant(state.contact_force_n(), 6)
    )
}

/// A prediction as a table.
pub fn prediction(rig: &Rig, point: &OperatingPoint, summary: &Summary, state: Option<&SteadyState>) -> String {
    let mut text = conditions(rig, point);
    text += &state.map(contact).unwrap_or_default();
    text += "\n  id   frequency     growth rate  damping ratio  pad share  residual\n";
    text += "              Hz             1/s                                     \n";
    for mode in &summary.modes {
        let root = &mode.root;
        let pad = if root.pad_participation.is_nan() { "-".into() } else { format!("{:.3}", root.pad_participation) };
        let mark = if root.is_unstable(rig.instability_threshold) { "  unstable" } else { "" };
        let _ = writeln!(
            text,
            "{:>4}  {:>10}  {:>14}  {:>13}  {pad:>9}  {:>8.1e}{mark}",
            mode.id,
            significant(root.frequency_hz(), 7),
            significant(root.growth_rate_per_s(), 6),
            significant(root.damping_ratio(), 5),
            root.residual,
        );
    }
    if !summary.nonoscillatory_growth_per_s.is_empty() {
        let growth: Vec<String> = summary.nonoscillatory_growth_per_s.iter().map(|&g| significant(g, 6)).collect();
        let _ = writeln!(text, "\nroots that do not oscillate, growth in 1/s: {}", growth.join(", "));
    }
    let _ = match (summary.unstable_modes, summary.max_growth_rate_per_s) {
        (0, _) | (_, None) => writeln!(text, "\nstable"),
        (count, Some(growth)) => {
            writeln!(text, "\n{count} unstable, growth up to {} 1/s", significant(growth, 6))
        }
    };
    text
}

/// Windows of instability as a table.
pub fn windows(rig: &Rig, map: &StabilityMap, mu_max: f64) -> String {
    let OperatingPoint { normal_load_n, disc_speed_rad_s, .. } = map.point;
    let mut text = format!("{}: {normal_load_n} N, {disc_speed_rad_s} rad/s{}\n", rig.name, temperature(rig));
    rig.notes(&map.point).for_each(|note| text += &format!("{note}\n"));
    match map.critical_friction() {
        None => {
            let _ = writeln!(text, "stable for friction coefficients 0 to {mu_max}");
        }
        Some(critical) => {
            let _ = writeln!(text, "critical friction coefficient {critical:.12}\n");
            text += "              from                to   frequency  kind         modes\n";
            text += "                                              Hz                    \n";
            for window in &map.windows {
                let to = window.mu_to.map_or_else(|| format!("> {mu_max}"), |to| format!("{to:.12}"));
                let ids: Vec<String> = window.mode_ids.iter().map(u32::to_string).collect();
                let _ = writeln!(
                    text,
                    "{:>18.12}{to:>18}  {:>10}  {:<11}  {}",
                    window.mu_from,
                    significant(window.frequency_hz, 7),
                    window.kind.name(),
                    ids.join(" + "),
                );
            }
        }
    }
    if let Some(end) = &map.sliding_ends {
        let _ = writeln!(text, "\nno steady sliding beyond friction coefficient {:.6}: {}", end.mu, end.reason);
    }
    let _ = writeln!(text, "\nwindows narrower than {:.2e} may have been missed", map.resolution);
    if !map.complete {
        text += "the search was cut short: some intervals are coarser than that\n";
    }
    text
}

/// `1 root`, `2 roots`.
pub fn count(number: usize, noun: &str) -> String {
    format!("{number} {noun}{}", if number == 1 { "" } else { "s" })
}
