//! Modes and residuals of several substructures: small ones in parallel, large ones one after the other on all cores.

use super::engine::{Engine, Progress};
use super::normal_modes::{Analysed, SparseModes, Wanted};
use super::threads::on_threads;
use super::{ReductionError, Residual, SparseMatrix};

/// Bytes that the parts may take for all of them to be solved at once, one thread each. Above that, threads share the work
/// on one part, and less memory is held: at 900 000 degrees of freedom a third less, for a twelfth more time.
const AT_ONCE: usize = 2 << 30;

/// A substructure with its contact interface free.
#[derive(Clone, Copy, Debug)]
pub struct Substructure<'a> {
    /// Name in errors and progress.
    pub name: &'a str,
    /// `M`, `n×n`, kg.
    pub mass: &'a SparseMatrix,
    /// `K`, `n×n`, N/m.
    pub stiffness: &'a SparseMatrix,
    /// Rows of its degrees of freedom at the contact; `None` denotes a fixed one.
    pub rows: &'a [Option<usize>],
    /// Which modes to keep.
    pub wanted: Wanted,
}

/// Modes and residuals kept of a substructure.
#[derive(Clone, Debug)]
pub struct Kept {
    /// The lowest modes.
    pub modes: SparseModes,
    /// Residual flexibility and inertia of the truncated modes, if requested.
    pub residual: Option<Residual>,
}

/// Computes the modes of every part by `engine` and, if `with_residual`, the residuals of the truncated modes.
///
/// Small parts run in parallel, one thread each, if all of them together fit in `memory_limit_bytes` in addition to the
/// given matrices; others one after the other. The result is the same.
///
/// `progress` receives the index of a part and its progress.
///
/// # Errors
/// Those of [`Analysed::modes`] and [`Analysed::residual`]; `Memory` before any factorisation.
pub fn keep_modes(
    engine: &dyn Engine,
    parts: &[Substructure<'_>],
    with_residual: bool,
    memory_limit_bytes: Option<usize>,
    progress: &mut dyn FnMut(usize, Progress),
) -> Result<Vec<Kept>, ReductionError> {
    let analysed: Vec<Analysed<'_>> = side_by_side(parts, true, progress, &|part, report| {
        report(Progress::Analysing);
        let contact = if with_residual { part.rows } else { &[] };
        Analysed::with_contact(engine, part.name, part.mass, part.stiffness, contact)
    })?;
    let held: usize = analysed.iter().map(Analysed::held_bytes).sum();
    let work = |index: usize, wanted: Wanted| {
        let (count, one) = (count_of(wanted), &analysed[index]);
        one.bytes_for(count).max(if with_residual { one.bytes_for_residual(count) } else { 0 })
    };
    // Whether the parts are solved at once: if they fit in memory.
    let plan = |wanted: &[Wanted], progress: &mut dyn FnMut(usize, Progress)| -> Result<bool, ReductionError> {
        let needs: Vec<usize> = wanted.iter().enumerate().map(|(index, &wanted)| work(index, wanted)).collect();
        for (index, need) in needs.iter().enumerate() {
            let factor_entries = analysed[index].factor_entries();
            progress(index, Progress::Analysed { factor_entries, bytes: held + need });
        }
        let fits = |bytes: usize| memory_limit_bytes.is_none_or(|limit| bytes <= limit);
        // A foreign engine solves one after the other: its ranks need the memory.
        let together = needs.iter().sum::<usize>();
        if !engine.foreign() && together <= AT_ONCE && fits(held + together) {
            return Ok(true);
        }
        // Modes of finished parts stay in memory.
        let modes = |index: usize| size_of::<f64>() * parts[index].mass.nrows() * count_of(wanted[index]);
        let largest = (0..needs.len()).max_by_key(|&index| needs[index]).unwrap_or(0);
        let bytes = held + needs.get(largest).unwrap_or(&0) + (0..parts.len()).map(modes).sum::<usize>();
        if fits(bytes) {
            return Ok(false);
        }
        let what = parts[largest].name.to_owned();
        Err(ReductionError::Memory { what, bytes, limit: memory_limit_bytes.unwrap_or(usize::MAX) })
    };
    let mut wanted: Vec<Wanted> = parts.iter().map(|part| part.wanted).collect();
    let mut at_once = plan(&wanted, progress)?;
    if wanted.iter().any(|wanted| matches!(wanted, Wanted::Below(_))) {
        let indices: Vec<usize> = (0..parts.len()).collect();
        wanted = side_by_side(&indices, at_once, progress, &|&index, report| match parts[index].wanted {
            Wanted::Below(below_rad_s) => {
                let below = below_rad_s * below_rad_s;
                let (modes, by) = analysed[index].count_below(below, memory_limit_bytes)?;
                report(Progress::Counted { modes, below, by });
                Ok(Wanted::Counted { modes, below_rad_s })
            }
            wanted => Ok(wanted),
        })?;
        at_once = plan(&wanted, progress)?;
    }
    let indices: Vec<usize> = (0..parts.len()).collect();
    side_by_side(&indices, at_once, progress, &|&index, report| {
        // Its memory need has been reported already.
        let mut report = |p: Progress| {
            if !matches!(p, Progress::Analysed { .. }) {
                report(p);
            }
        };
        let limit = memory_limit_bytes.filter(|_| engine.foreign());
        let (modes, shift, factor) =
            analysed[index].modes_and_factor(wanted[index], with_residual, limit, &mut report)?;
        let residual = with_residual
            .then(|| analysed[index].residual_at(shift, factor, &modes, parts[index].rows, &mut report))
            .transpose()?;
        Ok(Kept { modes, residual })
    })
}

/// Number of wanted modes; 0 if not known yet.
fn count_of(wanted: Wanted) -> usize {
    match wanted {
        Wanted::Lowest(count) | Wanted::Counted { modes: count, .. } => count,
        Wanted::Below(_) => 0,
    }
}

/// Work on one item, which reports its progress to a callback.
type Work<'a, T, R> = dyn Fn(&T, &mut dyn FnMut(Progress)) -> Result<R, ReductionError> + Sync + 'a;

/// Runs `work` on every item, each on its own thread if `at_once`. Progress is reported on the calling thread.
fn side_by_side<T: Sync, R: Send>(
    items: &[T],
    at_once: bool,
    progress: &mut dyn FnMut(usize, Progress),
    work: &Work<'_, T, R>,
) -> Result<Vec<R>, ReductionError> {
    let numbered: Vec<(usize, &T)> = items.iter().enumerate().collect();
    let mut threads = vec![(); if at_once { items.len() } else { 1 }];
    let mut report = |(index, step): (usize, Progress)| progress(index, step);
    on_threads(&mut threads, &numbered, &mut report, &|(), (index, item), report| {
        work(item, &mut |step| report((*index, step)))
    })
}

#[cfg(test)]
mod tests {
    use super::super::OwnEngine;
    use super::*;
    use faer::sparse::Triplet;

    /// A free chain of equal masses.
    fn chain(n: usize, spring: f64) -> [SparseMatrix; 2] {
        let mass: Vec<_> = (0..n).map(|i| Triplet::new(i, i, 2.0)).collect();
        let stiffness: Vec<_> = (1..n)
            .flat_map(|i| [(i, i, 1.0), (i - 1, i - 1, 1.0), (i, i - 1, -1.0), (i - 1, i, -1.0)])
            .map(|(i, j, sign)| Triplet::new(i, j, sign * spring))
            .collect();
        [mass, stiffness].map(|triplets| SparseMatrix::try_new_from_triplets(n, n, &triplets).unwrap())
    }

    #[test]
    fn side_by_side_or_one_after_the_other_is_the_same() {
        let [pad, disc] = [chain(500, 100.0), chain(700, 300.0)];
        let rows = [Some(0), None, Some(499)];
        // `ω = 2 sqrt(k/m) sin(p π / 2n)` with p from 0. The cut-off lies between p = 11 and p = 12 of the disc: 12
        // modes are below it.
        let below = 2.0 * 150.0_f64.sqrt() * (11.5 * std::f64::consts::PI / 1400.0).sin();
        let owned = [("pad", pad, Wanted::Lowest(9)), ("disc", disc, Wanted::Below(below))];
        let parts: Vec<Substructure<'_>> = owned
            .iter()
            .map(|(name, [mass, stiffness], wanted)| Substructure {
                name,
                mass,
                stiffness,
                rows: &rows,
                wanted: *wanted,
            })
            .collect();
        let mut needs = vec![];
        let together = keep_modes(&OwnEngine, &parts, true, None, &mut |_, p| {
            if let Progress::Analysed { bytes, .. } = p {
                needs.push(bytes);
            }
        })
        .unwrap();
        assert_eq!(together.iter().map(|kept| kept.modes.omega_squared.len()).collect::<Vec<_>>(), [9, 12]);
        // Each part fits alone; both together do not.
        let limit = needs.iter().copied().max().unwrap() + 200_000;
        let mut order = vec![];
        let apart = keep_modes(&OwnEngine, &parts, true, Some(limit), &mut |part, p| {
            if matches!(p, Progress::Loaded { .. }) {
                order.push(part);
            }
        })
        .unwrap();
        assert_eq!(order, [0, 1]);
        for (one, other) in together.iter().zip(&apart) {
            assert_eq!(one.modes.omega_squared, other.modes.omega_squared);
            let [one, other] = [one, other].map(|kept| kept.residual.as_ref().unwrap());
            assert!((&one.flexibility - &other.flexibility).norm_max() < 1e-12 * one.flexibility.norm_max());
            assert!((&one.inertia - &other.inertia).norm_max() < 1e-6 * one.inertia.norm_max());
        }
        let mut factored = false;
        let refused = keep_modes(&OwnEngine, &parts, true, Some(limit / 4), &mut |_, p| {
            factored |= matches!(p, Progress::Factored { .. });
        });
        assert!(matches!(refused.unwrap_err(), ReductionError::Memory { .. }) && !factored);
    }
}
