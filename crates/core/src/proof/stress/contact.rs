//! Extremes of contact states: pairs that open and close, and loads, speeds and friction coefficients at their limits.
//!
//! | extreme | what happens |
//! |---|---|
//! | one of twelve pairs closed, or none | that pair carries the load; without any, friction changes nothing |
//! | beside a pair that opens | roots jump or kink, forces do not |
//! | friction at which the pad jams or the state turns back | from there on no state: an error, never a root |
//! | a law without tangent at zero load | the tangent, and with it the contact, vanishes with the load |
//! | load or speed towards zero | as without a contact state |
//! | rotation reversed | that of the opposite friction coefficient, to the last bit |

use std::sync::Arc;

use super::{Case, Checked, REFERENCE, distances, text};
use crate::contact::{PathEnd, PressureLaw, Statics, StaticsError, StaticsParts};
use crate::physics::{ContactLaw, Model, OperatingPoint, Situation};
use crate::proof::synthetic::{Parts, STIFFNESS_N_PER_M, Synthetic, parts, statics};

const PAIRS: usize = 12;
/// Closure under the reference load if every pair is alike, m.
const CLOSURE_M: f64 = 500.0 / STIFFNESS_N_PER_M;
const LINEAR: PressureLaw = PressureLaw::Linear { stiffness: STIFFNESS_N_PER_M / PAIRS as f64 };
/// Without a tangent at closure 0.
const POWER: PressureLaw = PressureLaw::Power {
    stiffness: STIFFNESS_N_PER_M / PAIRS as f64,
    reference_m: CLOSURE_M,
    exponent: 2.0,
    roughness_m: 0.0,
};
const ROUGH: PressureLaw = PressureLaw::Exponential { pressure: 0.1 * 500.0 / PAIRS as f64, roughness_m: CLOSURE_M };

/// Friction that falls with speed and damps lateral motion.
const SLIPPING: ContactLaw =
    ContactLaw { exponent: 0.0, reference_n: 500.0, slope_s_per_m: -0.02, lateral_damping: true, stribeck: None };

/// All cases of contact states.
pub(super) fn cases() -> Vec<Case> {
    vec![
        Case::new("contact states: one of 12 pairs closed", one_pair),
        Case::new("contact states: all pairs open", all_open),
        Case::new("contact states: 1e-16 to 1e-2 beside pairs that open", beside_openings),
        Case::new("contact states: friction up to jamming and beyond", jamming),
        Case::new("contact states: load towards zero, laws with and without tangent", vanishing_load),
        Case::new("contact states: speed towards zero and reversed", reversed),
    ]
}

/// A synthetic rig with its parts and statics.
struct Rig {
    parts: Parts,
    statics: Arc<Statics>,
}

impl Rig {
    /// With gaps from 0 at the first pair to `gap_m` at the last one.
    fn new(law: &PressureLaw, gap_m: f64, contact_law: ContactLaw, seed: u64) -> Result<Self, String> {
        let synthetic = Synthetic { modes: 20, pairs: PAIRS, damping_ratio: 5e-3, contact_law, seed };
        let parts = parts(&synthetic).map_err(text)?;
        let statics = Arc::new(statics(&parts, law.clone(), gap_m).map_err(text)?);
        Ok(Self { parts, statics })
    }

    fn model(&self) -> Result<Model, String> {
        let Parts { free, pairs, .. } = &self.parts;
        free.clone().with_steady_contact(pairs, self.statics.clone(), None).map_err(text)
    }

    /// Closed pairs at the reference load and a friction coefficient; `None` without a state.
    fn closed(&self, mu: f64) -> Option<Vec<bool>> {
        let state = self.statics.state(REFERENCE.normal_load_n, mu).ok()?;
        Some(state.force_n.iter().map(|force| *force > 0.0).collect())
    }
}

fn one_pair() -> Result<String, String> {
    let mut checked = Checked::default();
    for law in [LINEAR, POWER] {
        let rig = Rig::new(&law, 1.0, ContactLaw::default(), 5)?;
        let model = rig.model()?;
        for step in 0..=10 {
            let p = REFERENCE.with_friction(0.1 * f64::from(step));
            let state = rig.statics.state(p.normal_load_n, p.friction_coefficient).map_err(text)?;
            if state.pairs_closed() != 1 {
                return Err(format!("{p:?}: {} pairs are closed", state.pairs_closed()));
            }
            checked.solve(&model, &p)?;
        }
    }
    Ok(checked.said())
}

fn all_open() -> Result<String, String> {
    let mut checked = Checked::default();
    let mut rig = Rig::new(&LINEAR, 1.0, SLIPPING, 5)?;
    let apart = StaticsParts { gap_m: vec![1.0; PAIRS], ..rig.statics.parts().clone() };
    rig.statics = Arc::new(Statics::new(apart).map_err(text)?);
    let model = rig.model()?;
    let free = checked.solve(&rig.parts.free, &OperatingPoint { normal_load_n: 0.0, ..REFERENCE })?;
    for step in 0..=10 {
        let found = checked.solve(&model, &REFERENCE.with_friction(0.1 * f64::from(step)))?;
        let both = free.roots.iter().zip(&found.roots);
        if let Some((free, found)) = both.into_iter().find(|(free, found)| free.lambda != found.lambda) {
            return Err(format!("friction coefficient 0.{step}: {found:?}, without contact {free:?}"));
        }
    }
    Ok(format!("as without contact to the last bit; {}", checked.said()))
}

/// Friction coefficients up to 1.5 at which a pair opens or closes, to the last bit: the number just before it.
fn openings(rig: &Rig) -> Vec<f64> {
    let mut found = vec![];
    for step in 0..300 {
        let (mut low, mut high) = (5e-3 * f64::from(step), 5e-3 * f64::from(step + 1));
        let (Some(before), Some(after)) = (rig.closed(low), rig.closed(high)) else { break };
        if before == after {
            continue;
        }
        loop {
            let middle = 0.5 * (low + high);
            if middle <= low || middle >= high {
                break;
            }
            match rig.closed(middle) {
                Some(closed) if closed == before => low = middle,
                _ => high = middle,
            }
        }
        found.push(low);
    }
    found
}

fn beside_openings() -> Result<String, String> {
    let mut checked = Checked::default();
    let mut count = 0;
    for seed in 0..12 {
        let rig = Rig::new(&[LINEAR, POWER][seed as usize % 2], 2.0 * CLOSURE_M, ContactLaw::default(), seed)?;
        let model = rig.model()?;
        for at in openings(&rig) {
            let forces = |mu: f64| rig.statics.state(REFERENCE.normal_load_n, mu).map_err(text);
            let here = forces(at)?;
            let slope = here.per_friction.force.iter().fold(0.0_f64, |largest, slope| largest.max(slope.abs()));
            for off in distances() {
                checked.solve(&model, &REFERENCE.with_friction(at + off))?;
                let there = forces(at + off)?;
                let change = here.force_n.iter().zip(&there.force_n).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                // A tangent that jumps changes the slope, by no more than a few times here.
                let limit = 10.0 * (slope + here.load_n) * off.abs() + 1e-10 * here.load_n;
                if change > limit {
                    return Err(format!("{at} + {off:e}: a force changes by {change:e} N, limit {limit:e} N"));
                }
            }
            count += 1;
        }
    }
    if count < 4 {
        return Err(format!("{count} openings, expected at least 4"));
    }
    Ok(format!("{count} openings; {}", checked.said()))
}

fn jamming() -> Result<String, String> {
    let mut checked = Checked::default();
    let mut ends: Vec<(f64, PathEnd)> = vec![];
    for seed in 0..40 {
        let rig = Rig::new(&[LINEAR, POWER, ROUGH][seed as usize % 3], 0.0, ContactLaw::default(), seed)?;
        let Err(StaticsError::NoEquilibrium { friction_coefficient: end, end: why, .. }) =
            rig.statics.state(REFERENCE.normal_load_n, 20.0)
        else {
            continue;
        };
        let model = rig.model()?;
        for share in [0.5, 0.9, 0.99, 0.999, 1.0 - 1e-6] {
            checked.solve(&model, &REFERENCE.with_friction(share * end))?;
        }
        for beyond in [1.0 + 1e-6, 1.001, 2.0, 100.0] {
            if let Ok(spectrum) = checked.solve(&model, &REFERENCE.with_friction(beyond * end)) {
                return Err(format!("seed {seed}: {} roots at {beyond} times {end}", spectrum.roots.len()));
            }
        }
        ends.push((end, why));
    }
    let [jam, turn] = [PathEnd::Jams, PathEnd::Turns].map(|why| ends.iter().filter(|(_, end)| *end == why).count());
    if jam < 3 || turn < 3 {
        return Err(format!("{jam} rigs jam and {turn} turn back, expected at least 3 of each"));
    }
    let first = ends.iter().fold(f64::INFINITY, |first, (end, _)| first.min(*end));
    Ok(format!("{jam} rigs jam, {turn} turn back, from a friction coefficient of {first:.2} on; {}", checked.said()))
}

fn vanishing_load() -> Result<String, String> {
    let mut checked = Checked::default();
    for law in [LINEAR, POWER, ROUGH] {
        let rig = Rig::new(&law, 0.0, SLIPPING, 5)?;
        let model = rig.model()?;
        let mut before = f64::INFINITY;
        for decade in (-100..=3).rev().filter(|decade| *decade > -20 || decade % 20 == 0) {
            let p = OperatingPoint { normal_load_n: 10f64.powi(decade), ..REFERENCE };
            checked.solve(&model, &p)?;
            let force = rig.statics.state(p.normal_load_n, p.friction_coefficient).map_err(text)?.contact_force_n();
            // The exponential law pushes without a load, so its force tends to a constant, known to the residual.
            if force > before * (1.0 + 1e-9) {
                return Err(format!("{law:?}: the contact force grows to {force:e} N at a load of 1e{decade} N"));
            }
            before = force;
        }
        checked.solve(&model, &OperatingPoint { normal_load_n: 0.0, ..REFERENCE })?;
    }
    Ok(checked.said())
}

fn reversed() -> Result<String, String> {
    let mut checked = Checked::default();
    for law in [LINEAR, POWER, ROUGH] {
        let rig = Rig::new(&law, 2.0 * CLOSURE_M, SLIPPING, 5)?;
        let model = rig.model()?;
        for speed in [60.0, 1.0, 0.1, 0.0100001, 0.01, 0.009999, 1e-300, 0.0] {
            for mu in [0.0, 0.35] {
                let at = |sign: f64, mu: f64| OperatingPoint {
                    disc_speed_rad_s: sign * speed,
                    friction_coefficient: mu,
                    ..REFERENCE
                };
                checked.solve(&model, &at(1.0, mu))?;
                let [backwards, opposite] = [at(-1.0, mu), at(1.0, -mu)];
                let backwards_state = model.at(&backwards).map_err(text)?;
                let opposite_state = model.at(&opposite).map_err(text)?;
                let forces = |state: &Situation| state.state().map(|state| state.force_n.clone());
                if forces(&backwards_state) != forces(&opposite_state) {
                    return Err(format!("{backwards:?} and {opposite:?} have different forces"));
                }
                checked.solve(&model, &backwards)?;
            }
        }
    }
    Ok(checked.said())
}
