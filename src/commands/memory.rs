//! The memory that a command may use: the amount given, or what the machine has available.

use std::path::Path;

use anyhow::{Context, bail};

use crate::full_model::FullModelFile;
use crate::reduction::{Engine, FullProgress, FullSolver, GIB, Progress};
use crate::system::memory::{available_bytes, keep_freed, peak_bytes, resident_bytes, return_freed};

/// Keeps freed memory in the process unless the command is given an amount of memory: faster, but up to a twentieth more
/// memory.
pub fn keep_freed_unless(asked_gib: Option<f64>) {
    if asked_gib.is_none() {
        keep_freed();
    }
}

/// Returns freed memory to the system after the steps of a part's modes that free much of it. Kept in gaps between
/// arrays that stay, it would add to the peak.
pub fn return_freed_by(step: &Progress) {
    if let Progress::Analysed { .. } | Progress::Factored { .. } | Progress::Counted { .. } = step {
        return_freed();
    }
}

/// Memory that may be used in addition to what this process holds now, bytes; `None` if the system does not report it.
///
/// # Errors
/// Reading the full model took more than the amount given.
pub fn room(asked_gib: Option<f64>, full: &Path) -> anyhow::Result<Option<usize>> {
    return_freed();
    let Some(gib) = asked_gib else { return Ok(available_bytes()) };
    let peak_gib = peak_bytes().map_or(0.0, |bytes| bytes as f64 / GIB);
    if peak_gib > gib {
        bail!("{}: reading it took {peak_gib:.2} GiB of memory, more than the {gib:.2} GiB allowed", full.display());
    }
    Ok(Some(((gib * GIB) as usize).saturating_sub(resident_bytes().unwrap_or(0))))
}

/// The solver for the full model `full`, by `engine`.
///
/// # Errors
/// The model cannot be analysed, or not within `room`.
pub fn solver<'a>(
    engine: &'a dyn Engine,
    full: &'a FullModelFile,
    room: Option<usize>,
    progress: &mut dyn FnMut(FullProgress),
) -> anyhow::Result<FullSolver<'a>> {
    FullSolver::by(engine, &full.name, &full.model, room, progress).with_context(|| full.path.display().to_string())
}
