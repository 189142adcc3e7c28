//! The message with the sensitivities of a prediction to conditions and contact.

use crate::msgs::{Derivatives, Header, ModeSensitivity, PairSensitivity, Prediction, Sensitivity, sensitivity_law};
use crate::physics::sensitivity::{Change, of_roots};
use crate::physics::{End, Ends, OperatingPoint, Solver, StabilityMap, Vectors};
use crate::rig::Rig;

/// A request for the sensitivities of a prediction.
#[derive(Clone, Debug)]
pub struct Question {
    pub header: Header,
    pub input_seq: u64,
    pub point: OperatingPoint,
    /// Identities of the modes of the prediction.
    pub ids: Vec<u32>,
}

impl Question {
    /// A request for `prediction`, made at `point`.
    pub fn new(prediction: &Prediction, point: OperatingPoint) -> Self {
        let ids = prediction.modes.iter().map(|mode| mode.id).collect();
        Self { header: prediction.header.clone(), input_seq: prediction.input_seq, point, ids }
    }
}

/// Computes the requested sensitivities by a dense solve. `map` gives the identities of modes, `ends` the window ends.
///
/// # Errors
/// Why they cannot be computed, as text.
pub fn answer(
    rig: &Rig,
    solver: &mut Solver,
    question: &Question,
    map: Option<&StabilityMap>,
    ends: Option<&Ends>,
) -> Result<Sensitivity, String> {
    let point = &question.point;
    let spectrum = solver.solve(&rig.model, point, Vectors::Right).map_err(|error| error.to_string())?;
    let ids = match map {
        Some(map) => map.ids(&spectrum),
        None => (0..spectrum.roots.len() as u32).map(Some).collect(),
    };
    let id = |k: usize| ids[k].unwrap_or(k as u32);
    let chosen: Vec<usize> = (0..spectrum.mode_count).filter(|&k| question.ids.contains(&id(k))).collect();
    let found = of_roots(&rig.model, &spectrum, &chosen).map_err(|error| error.to_string())?;
    let known = |mut derivatives: [f64; 5]| {
        if !rig.model.is_linear_in_contact() {
            derivatives[3..].fill(f64::NAN);
        }
        Derivatives::new(derivatives)
    };
    let mut message = Sensitivity {
        header: question.header.clone(),
        input_seq: question.input_seq,
        normal_load_n: point.normal_load_n,
        disc_speed_rad_s: point.disc_speed_rad_s,
        friction_coefficient: point.friction_coefficient,
        nearest_window_end: f64::NAN,
        nearest_window_end_derivatives: Derivatives::UNKNOWN,
        ..Default::default()
    };
    let nearest = ends.and_then(|ends| ends.nearest(point).map(|nearest| (ends, nearest)));
    if let Some((end, mu)) = nearest.and_then(|(ends, nearest)| Some((ends.end(&nearest)?, nearest.mu))) {
        message.nearest_window_end = mu;
        message.nearest_window_end_derivatives = end_derivatives(rig, end);
    }
    for root in found {
        let mode = ModeSensitivity { id: id(root.root), ..Default::default() };
        message.modes.push(match root.change {
            Change::Linear(slope) => ModeSensitivity {
                law: sensitivity_law::LINEAR,
                frequency_hz: known(slope.map(|slope| slope.im / std::f64::consts::TAU)),
                growth_rate_per_s: known(slope.map(|slope| slope.re)),
                ..mode
            },
            Change::SquareRoot { .. } => ModeSensitivity {
                law: sensitivity_law::SQUARE_ROOT,
                frequency_hz: Derivatives::UNKNOWN,
                growth_rate_per_s: Derivatives::UNKNOWN,
                ..mode
            },
        });
        let Change::SquareRoot { partner, pair } = root.change else { continue };
        let (first_id, second_id) = (id(root.root).min(id(partner)), id(root.root).max(id(partner)));
        if message.pairs.iter().any(|pair| pair.first_id == first_id) {
            continue; // listed with the other mode of the pair
        }
        message.pairs.push(PairSensitivity {
            first_id,
            second_id,
            squares: spectrum.undamped,
            mean_real: pair.mean.re,
            mean_imaginary: pair.mean.im,
            discriminant_real: pair.discriminant.re,
            discriminant_imaginary: pair.discriminant.im,
            mean_real_derivatives: known(pair.mean_slope.map(|slope| slope.re)),
            mean_imaginary_derivatives: known(pair.mean_slope.map(|slope| slope.im)),
            discriminant_real_derivatives: known(pair.discriminant_slope.map(|slope| slope.re)),
            discriminant_imaginary_derivatives: known(pair.discriminant_slope.map(|slope| slope.im)),
        });
    }
    Ok(message)
}

/// The derivatives of a window end, as the message carries them.
pub fn end_derivatives(rig: &Rig, end: &End) -> Derivatives {
    let [load, speed, stiffness, damping] = end.slope;
    let contact = |slope: f64| if rig.model.is_linear_in_contact() { slope } else { f64::NAN };
    Derivatives::new([0.0, load, speed, contact(stiffness), contact(damping)])
}
