//! Reduction of full models.

use std::ffi::OsString;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::PathBuf;

use pyo3::exceptions::PyKeyboardInterrupt;
use pyo3::prelude::*;
use squealcast::commands::{Stopped, reduce_quietly};

use crate::errors::ReductionError;
use crate::rig::Rig;
use crate::run::interruptible;

/// Reduces a full model to a rig file that `Rig.load` and the node can run, as `squealcast reduce` does.
///
/// By default the basis consists of the full model's own vectors over a range of conditions, such that every root in the
/// band is within `tolerance`; with `modes` or `cutoff_hz`, of the lowest free-interface modes of pad and disc. The rig is
/// compared with the full model at held-out operating points, and its file holds the result, `[reduction]`.
///
/// Parameters
/// ----------
/// full : path
///     The full model: TOML with sparse matrices.
/// output : path
///     Rig file to write; its arrays are written next to it.
/// tolerance : float, optional
///     Largest relative error of a root on the basis [default: 1e-6].
/// range : str, optional
///     Conditions for which the basis is valid, such as "mu=0:1,speed=6:60,load=50:2000".
/// modes : str, optional
///     Modes of pad and disc to keep, such as "80+80".
/// cutoff_hz : float, optional
///     Keep the modes of pad and disc below this frequency, Hz.
/// residual : bool
///     With modes: whether residual flexibility represents the truncated ones.
/// compact : bool
///     Store residual flexibility between this model's contact pairs only.
/// points : int
///     Held-out operating points of the comparison; 0 omits it.
/// memory_gib : float, optional
///     Memory that may be used, GiB.
///
/// Returns the rig, and whether it has the same modes and windows as the full model at the held-out points. Raises
/// `ReductionError` with the text of the program. Ctrl-C ends it; nothing is written then.
///
/// >>> squealcast.reduce("missing.toml", "rig.toml")
/// Traceback (most recent call last):
/// squealcast.ReductionError: missing.toml: ...
#[pyfunction]
#[pyo3(signature = (full, output, *, tolerance = None, range = None, modes = None, cutoff_hz = None, residual = true, compact = false, points = 3, memory_gib = None))]
#[allow(clippy::too_many_arguments)] // as many as Python gives names to
pub fn reduce(
    py: Python<'_>,
    full: PathBuf,
    output: PathBuf,
    tolerance: Option<f64>,
    range: Option<String>,
    modes: Option<String>,
    cutoff_hz: Option<f64>,
    residual: bool,
    compact: bool,
    points: usize,
    memory_gib: Option<f64>,
) -> PyResult<(Rig, bool)> {
    let mut words = vec![OsString::from(format!("--points={points}"))];
    let number = |value: Option<f64>| value.map(|value| value.to_string());
    let options = [
        ("tolerance", number(tolerance)),
        ("range", range),
        ("modes", modes),
        ("cutoff-hz", number(cutoff_hz)),
        ("memory-gib", number(memory_gib)),
    ];
    words.extend(options.into_iter().filter_map(|(name, value)| Some(format!("--{name}={}", value?).into())));
    words.extend((!residual).then(|| "--no-residual".into()));
    words.extend(compact.then(|| "--compact".into()));
    words.extend(["--output".into(), output.clone().into_os_string(), "--".into(), full.into_os_string()]);
    let reduced = interruptible(py, |stopped| {
        let reduced = catch_unwind(AssertUnwindSafe(|| reduce_quietly(&words, stopped.clone())));
        match reduced {
            Ok(reduced) => reduced.map_err(Some),
            Err(payload) if payload.is::<Stopped>() => Err(None),
            Err(payload) => resume_unwind(payload),
        }
    })?;
    match reduced {
        // From its file, so that its chart is kept beside it.
        Ok((rig, complete)) => Ok((Rig::new(squealcast::rig::Rig { path: Some(output), ..rig }), complete)),
        Err(Some(text)) => Err(ReductionError::new_err(text)),
        Err(None) => Err(PyKeyboardInterrupt::new_err("stopped")),
    }
}
