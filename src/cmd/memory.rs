//! How much memory a command may take: what is asked for, or what the machine has to spare.

use std::path::Path;

use anyhow::{Context, bail};

use crate::full_model::FullModelFile;
use crate::io::memory::{available_bytes, peak_bytes, resident_bytes};
use crate::reduction::{FullProgress, FullSolver, GIB};

/// What may be taken beside what this process holds now, in bytes; `None` where the system does not say.
///
/// # Errors
/// Reading the full model took more than the GiB asked for.
pub fn room(asked_gib: Option<f64>, full: &Path) -> anyhow::Result<Option<usize>> {
    let Some(gib) = asked_gib else { return Ok(available_bytes()) };
    let peak_gib = peak_bytes().map_or(0.0, |bytes| bytes as f64 / GIB);
    if peak_gib > gib {
        bail!("{}: reading it took {peak_gib:.2} GiB of memory, more than the {gib:.2} GiB allowed", full.display());
    }
    Ok(Some(((gib * GIB) as usize).saturating_sub(resident_bytes().unwrap_or(0))))
}

/// What solves `full` itself.
///
/// # Errors
/// A model that cannot be analysed, or not within `room`.
pub fn solver<'a>(
    full: &'a FullModelFile,
    room: Option<usize>,
    progress: &mut dyn FnMut(FullProgress),
) -> anyhow::Result<FullSolver<'a>> {
    FullSolver::new(&full.name, &full.model, room, progress).with_context(|| full.path.display().to_string())
}
