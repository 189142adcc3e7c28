//! The certificate of a rig: how far it is from the full model it was reduced from.

use serde::{Deserialize, Serialize};

/// Certificate of a rig: its errors against the full model at held-out points. The table `[reduction]` of a rig file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Certificate {
    /// `content_hash` of the full model.
    pub full_model_hash: String,
    /// How the rig was reduced, as text.
    #[serde(default)]
    pub method: String,
    /// Upper end of the compared band, Hz.
    pub band_hz: f64,
    /// Number of held-out operating points.
    pub points: usize,
    /// Largest `|Δf| / f`.
    pub max_frequency_error: f64,
    /// Largest `|Δσ|`, 1/s.
    pub max_growth_error_per_s: f64,
    /// Largest `|Δλ| / |λ|`.
    pub max_relative_error: f64,
    /// Largest difference of the force of a contact pair, relative to the largest force; `None` if the pairs are always
    /// closed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_force_error: Option<f64>,
    /// Contact pairs that are closed in one of the two and open in the other, summed over all points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pairs_differ: Option<usize>,
    /// Number of pairs of load and speed at which windows of instability were compared.
    #[serde(default)]
    pub windows_compared_at: usize,
    /// Largest difference between the ends of corresponding windows; `None` if no windows correspond.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub critical_friction_error: Option<f64>,
    /// Missed: unstable modes, summed over all points, and windows that only the full model has.
    pub missed: usize,
    /// Invented: unstable modes, summed over all points, and windows that only the rig has.
    pub invented: usize,
    /// Modes of the full model, stable or not, without a partner in the rig, summed over all points.
    #[serde(default)]
    pub unpaired: usize,
}

impl Certificate {
    /// Whether rig and full model have the same modes, unstable modes and windows in the band.
    pub fn is_complete(&self) -> bool {
        self.missed == 0 && self.invented == 0 && self.unpaired == 0 && !self.max_relative_error.is_nan()
    }

    /// The certificate in one line of text.
    pub fn summary(&self) -> String {
        let (critical, what) = match (self.windows_compared_at, self.critical_friction_error) {
            (0, _) => (", windows of instability not compared".to_owned(), "unstable modes"),
            (_, Some(error)) => (format!(", critical friction {error:.1e}"), "unstable modes or windows"),
            (_, None) => (String::new(), "unstable modes or windows"),
        };
        let unpaired = match self.unpaired {
            0 => String::new(),
            count => format!(", {count} modes without a partner"),
        };
        let contact = match (self.max_force_error, self.pairs_differ) {
            (Some(error), Some(0)) => format!(", contact forces {error:.1e}, the same pairs closed"),
            (Some(error), differ) => {
                format!(", contact forces {error:.1e}, {} pairs not closed in both", differ.unwrap_or(0))
            }
            (None, _) => String::new(),
        };
        format!(
            "reduction  errors at {} held-out points up to {} Hz: frequency {:.1e} relative, growth rate {:.1e} 1/s\
             {critical}{contact}; {} {what} missed, {} invented{unpaired}",
            self.points,
            self.band_hz,
            self.max_frequency_error,
            self.max_growth_error_per_s,
            self.missed,
            self.invented
        )
    }
}
