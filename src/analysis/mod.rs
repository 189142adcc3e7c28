//! Predictions, sweeps and windows of instability over given conditions, for commands and other programs: no stream of
//! inputs, no bus, no clock.

pub mod condition;
pub mod many;
pub mod sweep;

use std::sync::Arc;

use crate::contact::SteadyState;
use crate::physics::{MapError, MapOptions, OperatingPoint, SolveError, Solver, StabilityMap, Summary, Vectors};
use crate::rig::{OutOfLimits, Rig, RigError};
use crate::session::map_options;

/// Why conditions cannot be analysed.
#[derive(Debug, thiserror::Error)]
pub enum AnalysisError {
    #[error("{rig}: {source}")]
    Conditions { rig: String, source: OutOfLimits },
    #[error(transparent)]
    Rig(Box<RigError>),
    #[error(transparent)]
    Map(#[from] MapError),
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// The caller stopped it.
    #[error("stopped")]
    Stopped,
}

impl From<RigError> for AnalysisError {
    fn from(error: RigError) -> Self {
        Self::Rig(Box::new(error))
    }
}

/// Checks that `rig` accepts `point`.
///
/// # Errors
/// [`AnalysisError::Conditions`], with the name of the rig.
pub fn check(rig: &Rig, point: &OperatingPoint) -> Result<(), AnalysisError> {
    rig.limits.check(point).map_err(|source| AnalysisError::Conditions { rig: rig.name.clone(), source })
}

/// The modes at `point`, with identities from a map at its load and speed, and the contact state.
///
/// # Errors
/// [`AnalysisError::Solve`], [`AnalysisError::Map`].
pub fn predict(rig: &Rig, point: &OperatingPoint) -> Result<(Summary, Option<Arc<SteadyState>>), AnalysisError> {
    let mut solver = Solver::new(rig.model.dimension());
    let spectrum = solver.solve(&rig.model, point, Vectors::Right)?;
    let mu = point.friction_coefficient;
    let map = StabilityMap::build(&rig.model, &mut solver, point, &including(rig, mu, mu, false))?;
    let summary = Summary::of_spectrum(&spectrum, Some(&map), rig.band_max_hz, rig.instability_threshold);
    Ok((summary, spectrum.state))
}

/// Options of a map from which modes have the identities that they have in a session, over at least the friction
/// coefficients `from` to `to`.
fn including(rig: &Rig, from: f64, to: f64, windows: bool) -> MapOptions {
    let searched = map_options(rig);
    MapOptions { mu_min: from.min(searched.mu_min), mu_max: to.max(searched.mu_max), windows, ..searched }
}
