//! Substructures to their modes and residuals, side by side where memory allows.

use std::sync::mpsc;

use super::normal_modes::{Analysed, Progress, SparseModes, Wanted};
use super::{ReductionError, Residual, SparseMatrix};

/// A substructure with its contact interface free.
#[derive(Clone, Copy, Debug)]
pub struct Substructure<'a> {
    /// How errors and progress name it.
    pub name: &'a str,
    /// `M`, `n×n`, kg.
    pub mass: &'a SparseMatrix,
    /// `K`, `n×n`, N/m.
    pub stiffness: &'a SparseMatrix,
    /// The rows of its degrees of freedom at the contact; `None` is one that is held.
    pub rows: &'a [Option<usize>],
    /// Which modes to keep.
    pub wanted: Wanted,
}

/// What is kept of a substructure.
#[derive(Clone, Debug)]
pub struct Kept {
    pub modes: SparseModes,
    /// What the modes left out do at the contact, if it was asked for.
    pub residual: Option<Residual>,
}

/// Modes of every part, and residuals `with_residual`: one thread for each part where all of them together stay below
/// `memory_limit_bytes`, else one part after the other. The result does not depend on that.
///
/// `progress` hears which part does what.
///
/// # Errors
/// Those of [`Analysed::modes`] and [`Analysed::residual`]; `Memory` before anything is factored.
pub fn keep_modes(
    parts: &[Substructure<'_>],
    with_residual: bool,
    memory_limit_bytes: Option<usize>,
    progress: &mut dyn FnMut(usize, Progress),
) -> Result<Vec<Kept>, ReductionError> {
    let analysed: Vec<Analysed<'_>> = side_by_side(parts, true, progress, &|part, hear| {
        hear(Progress::Analysing);
        Analysed::new(part.name, part.mass, part.stiffness)
    })?;
    let held: usize = analysed.iter().map(Analysed::held_bytes).sum();
    let work = |index: usize, wanted: Wanted| {
        let count = match wanted {
            Wanted::Lowest(count) | Wanted::Counted { modes: count, .. } => count,
            Wanted::Below(_) => 0,
        };
        let one = &analysed[index];
        let residual = if with_residual { one.bytes_for_residual(count) } else { 0 };
        // The modes of the parts that are done stay.
        one.bytes_for(count).max(residual)
    };
    let together = |wanted: &[Wanted], progress: &mut dyn FnMut(usize, Progress)| -> Result<bool, ReductionError> {
        let needs: Vec<usize> = wanted.iter().enumerate().map(|(index, &wanted)| work(index, wanted)).collect();
        for (index, need) in needs.iter().enumerate() {
            let factor_entries = analysed[index].factor_entries();
            progress(index, Progress::Analysed { factor_entries, bytes: held + need });
        }
        let Some(limit) = memory_limit_bytes else { return Ok(true) };
        let largest = needs.iter().enumerate().max_by_key(|(_, need)| **need);
        if let Some((index, need)) = largest
            && held + need > limit
        {
            let what = parts[index].name.to_owned();
            return Err(ReductionError::Memory { what, bytes: held + need, limit });
        }
        Ok(held + needs.iter().sum::<usize>() <= limit)
    };
    let mut wanted: Vec<Wanted> = parts.iter().map(|part| part.wanted).collect();
    let mut at_once = together(&wanted, progress)?;
    if wanted.iter().any(|wanted| matches!(wanted, Wanted::Below(_))) {
        let indices: Vec<usize> = (0..parts.len()).collect();
        wanted = side_by_side(&indices, at_once, progress, &|&index, hear| match parts[index].wanted {
            Wanted::Below(below_rad_s) => {
                let modes = analysed[index].count_below(below_rad_s)?;
                hear(Progress::Counted { modes, below: below_rad_s * below_rad_s });
                Ok(Wanted::Counted { modes, below_rad_s })
            }
            wanted => Ok(wanted),
        })?;
        at_once = together(&wanted, progress)?;
    }
    let indices: Vec<usize> = (0..parts.len()).collect();
    side_by_side(&indices, at_once, progress, &|&index, hear| {
        let modes = analysed[index].modes(wanted[index], None, hear)?;
        let residual = with_residual.then(|| analysed[index].residual(&modes, parts[index].rows, hear)).transpose()?;
        Ok(Kept { modes, residual })
    })
}

/// `work` on every item, on threads of their own if `at_once`; what they report is heard here, on one thread.
fn side_by_side<T: Sync, R: Send>(
    items: &[T],
    at_once: bool,
    progress: &mut dyn FnMut(usize, Progress),
    work: &(dyn Fn(&T, &mut dyn FnMut(Progress)) -> Result<R, ReductionError> + Sync),
) -> Result<Vec<R>, ReductionError> {
    if !at_once {
        return items.iter().enumerate().map(|(index, item)| work(item, &mut |p| progress(index, p))).collect();
    }
    std::thread::scope(|scope| {
        let (told, heard) = mpsc::channel();
        let workers: Vec<_> = items
            .iter()
            .enumerate()
            .map(|(index, item)| {
                let told = told.clone();
                // Where nobody hears it any more nothing is lost with it.
                scope.spawn(move || {
                    work(item, &mut |p| {
                        let _ = told.send((index, p));
                    })
                })
            })
            .collect();
        drop(told);
        heard.iter().for_each(|(index, p)| progress(index, p));
        workers
            .into_iter()
            .map(|worker| worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            .collect()
    })
}
