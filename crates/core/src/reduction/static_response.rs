//! Static response of a full model's parts to contact forces and to the load, without contact springs.
//!
//! ```text
//! G_nn = B_n K⁺ B_nᵀ,   G_nt = B_n K⁺ B_tᵀ,   a = B_n K⁺ p
//! ```
//!
//! summed over the parts. `K⁺` is `K⁻¹` of a supported part. Of a free-floating part it is the elastic part of the
//! response: loads are made orthogonal to the rigid motions `Φ_r` and solved with `A = K + s M`,
//!
//! ```text
//! X = A⁻¹ (F - M Φ_r Φ_rᵀ F),   K⁺ F = X + s A⁻¹ M X + O(s²/ω⁴)
//! ```
//!
//! with `s` a millionth of the lowest elastic `ω²`. Gyroscopic and spin terms are omitted.

use faer::Mat;

use super::checked::definite;
use super::engine::Engine;
use super::full_model::{FullModel, SparseRow};
use super::normal_modes::{Analysed, Wanted};
use super::sparse::{SparseMatrix, symmetric_times};
use super::{FullPart, ReductionError};
use crate::contact::{RigidMotions, StaticResponse};

/// Largest `ω²` of a rigid motion (a rounding error), relative to the largest ratio of diagonal entries of stiffness and
/// mass.
const RIGID: f64 = 1e-12;
/// The shift `s`, relative to the lowest elastic `ω²`.
const SHIFT: f64 = 1e-6;
/// Number of contact rows solved at a time.
const TOGETHER: usize = 32;

impl FullModel {
    /// The static response between contact pairs, solved by `engine`, and to `load`, the generalised force of a load of 1 N over the rows of
    /// all parts. `None` for a model without contact pairs.
    ///
    /// # Errors
    /// [`ReductionError`]: `Memory` if it needs more than `memory_limit_bytes` in addition to what is already held; those of
    /// a factorisation and, for free-floating parts, of their modes.
    pub fn static_response(
        &self,
        engine: &dyn Engine,
        load: &SparseRow,
        memory_limit_bytes: Option<usize>,
    ) -> Result<Option<StaticResponse>, ReductionError> {
        let Some(contact) = &self.contact else { return Ok(None) };
        let c = contact.normal.len();
        let mut sum = StaticResponse {
            normal_flexibility: Mat::zeros(c, c),
            sliding_flexibility: Mat::zeros(c, c),
            gap_per_load: vec![0.0; c],
            rigid: RigidMotions { normal: Mat::zeros(c, 0), sliding: Mat::zeros(c, 0), load: vec![] },
        };
        for (part, offset) in self.parts.iter().zip(self.offsets()) {
            let range = offset..offset + part.mass.nrows();
            let within = |row: &SparseRow| -> SparseRow {
                let inside = row.iter().filter(|(index, _)| range.contains(index));
                inside.map(|&(index, weight)| (index - offset, weight)).collect()
            };
            let rows = [&contact.normal, &contact.sliding].map(|rows| rows.iter().map(within).collect::<Vec<_>>());
            add_part(engine, part, &rows, &within(load), memory_limit_bytes, &mut sum)?;
        }
        let flexibility = &mut sum.normal_flexibility;
        for j in 0..c {
            for i in 0..j {
                let mean = 0.5 * (flexibility[(i, j)] + flexibility[(j, i)]);
                (flexibility[(i, j)], flexibility[(j, i)]) = (mean, mean);
            }
        }
        Ok(Some(sum))
    }
}

/// Adds the response of one part. `normal` and `sliding` are the contact rows over its degrees of freedom.
fn add_part(
    engine: &dyn Engine,
    part: &FullPart,
    [normal, sliding]: &[Vec<SparseRow>; 2],
    load: &SparseRow,
    memory_limit_bytes: Option<usize>,
    sum: &mut StaticResponse,
) -> Result<(), ReductionError> {
    let analysed = Analysed::new(engine, &part.name, &part.mass, &part.stiffness)?;
    let pencil = &analysed.pencil;
    let n = pencil.dimension();
    // The factor, and for one set of loads: loads, responses, products and permuted copies, with rigid motions.
    let columns = size_of::<f64>() * n * (5 * TOGETHER + 12);
    let factor = if engine.foreign() { [0, 0] } else { [pencil.factor_bytes(), pencil.factoring_bytes()] };
    let bytes = pencil.held_bytes() + factor[0] + factor[1].max(columns);
    if let Some(limit) = memory_limit_bytes.filter(|limit| bytes > *limit) {
        return Err(ReductionError::Memory { what: format!("statics of {}", part.name), bytes, limit });
    }
    let diagonal = |matrix: &SparseMatrix, k: usize| matrix.get(k, k).copied().unwrap_or(0.0);
    let largest = (0..n).map(|k| diagonal(&part.stiffness, k) / diagonal(&part.mass, k)).fold(0.0, f64::max);
    let free = analysed.count_below(RIGID * largest, memory_limit_bytes)?.0;
    let (shift, modes) = if free == 0 {
        (0.0, Mat::zeros(n, 0))
    } else {
        let wanted = Wanted::Lowest((free + 1).min(n));
        let found = analysed.modes(wanted, memory_limit_bytes, &mut |_| {})?;
        // Nothing but rigid motions: any shift serves.
        let lowest = found.omega_squared.get(free).copied().unwrap_or(1.0);
        (SHIFT * lowest, found.phi.subcols(0, free).to_owned())
    };
    let factor = definite(engine, pencil, shift)?
        .ok_or_else(|| ReductionError::NoShift { what: part.name.clone(), value: shift })?;
    let along = |row: &SparseRow, x: &Mat<f64>, j: usize| -> f64 {
        row.iter().map(|&(index, weight)| weight * x[(index, j)]).sum()
    };
    let inertia_of_modes = symmetric_times(&part.mass, modes.as_ref());
    // Removes components of the rigid motions that rounding reintroduces.
    let freed = |mut x: Mat<f64>| {
        let back = inertia_of_modes.transpose() * &x;
        x -= &modes * back;
        x
    };
    let acting: Vec<usize> = (0..normal.len()).filter(|&k| !normal[k].is_empty()).collect();
    for chunk in acting.chunks(TOGETHER) {
        let mut x = Mat::<f64>::zeros(n, chunk.len());
        for (column, &k) in chunk.iter().enumerate() {
            for &(index, weight) in &normal[k] {
                x[(index, column)] += weight;
            }
        }
        if free > 0 {
            let kept = Mat::from_fn(free, chunk.len(), |mode, column| along(&normal[chunk[column]], &modes, mode));
            x -= &inertia_of_modes * kept;
        }
        factor.solve(&mut x, false)?;
        if free > 0 {
            x = freed(x);
            let mut again = symmetric_times(&part.mass, x.as_ref());
            factor.solve(&mut again, false)?;
            x += faer::Scale(shift) * freed(again);
        }
        for (column, &k) in chunk.iter().enumerate() {
            for i in 0..normal.len() {
                sum.normal_flexibility[(i, k)] += along(&normal[i], &x, column);
                // `K⁺` is symmetric: the gap at `k` by a sliding force at `i`.
                sum.sliding_flexibility[(k, i)] += along(&sliding[i], &x, column);
            }
            sum.gap_per_load[k] += along(load, &x, column);
        }
    }
    let before = sum.rigid.load.len();
    let appended = |old: &Mat<f64>, rows: &[SparseRow]| {
        Mat::from_fn(rows.len(), before + free, |k, j| {
            if j < before { old[(k, j)] } else { along(&rows[k], &modes, j - before) }
        })
    };
    sum.rigid.normal = appended(&sum.rigid.normal, normal);
    sum.rigid.sliding = appended(&sum.rigid.sliding, sliding);
    sum.rigid.load.extend((0..free).map(|mode| along(load, &modes, mode)));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::OwnEngine;
    use super::super::full_model::FullContact;
    use super::*;
    use crate::contact::{MeasuredLoad, PressureLaw, Statics, StaticsParts};
    use crate::physics::ContactLaw;
    use faer::linalg::solvers::Solve;
    use faer::sparse::Triplet;

    /// A chain of springs; fixed at its first mass if `held`. It is free otherwise.
    fn chain(name: &str, n: usize, spring: f64, held: bool) -> FullPart {
        let mass: Vec<_> = (0..n).map(|i| Triplet::new(i, i, 0.3 + 0.1 * (i as f64).cos())).collect();
        let mut stiffness: Vec<_> = (1..n)
            .flat_map(|i| {
                let k = spring * (1.0 + 0.2 * (i as f64).sin());
                [(i, i, k), (i - 1, i - 1, k), (i, i - 1, -k), (i - 1, i, -k)]
            })
            .map(|(i, j, value)| Triplet::new(i, j, value))
            .collect();
        if held {
            stiffness.push(Triplet::new(0, 0, spring));
        }
        let build = |triplets: &[_]| SparseMatrix::try_new_from_triplets(n, n, triplets).unwrap();
        FullPart { name: name.to_owned(), mass: build(&mass), stiffness: build(&stiffness) }
    }

    fn model(pad_held: bool) -> FullModel {
        let (pad, disc) = (chain("pad", 30, 3e7, pad_held), chain("disc", 45, 2e7, true));
        let contact = FullContact {
            normal: (0..4).map(|k| vec![(29 - 6 * k, 1.0), (30 + 44 - 9 * k, -1.0)]).collect(),
            sliding: (0..4).map(|k| vec![(27 - 5 * k, 0.8), (30 + 40 - 7 * k, -1.1)]).collect(),
            ..FullContact::default()
        };
        let (stiffness, damping, contact_law) = (vec![], vec![], ContactLaw::default());
        FullModel {
            parts: vec![pad, disc],
            stiffness,
            damping,
            contact: Some(contact),
            contact_law,
            modal_damping: vec![],
        }
    }

    /// The state by the static response, against the sparse matrices themselves: with its contact forces and its load, and
    /// contact springs for the closed pairs, the displacements of a dense solve have its closures.
    #[test]
    fn states_hold_on_the_full_matrices() {
        for held in [true, false] {
            let model = model(held);
            let contact = model.contact.as_ref().unwrap();
            let load: SparseRow = vec![(3, -0.4), (8, -0.6)];
            let response = model.static_response(&OwnEngine, &load, None).unwrap().unwrap();
            assert_eq!(response.rigid.load.len(), usize::from(!held));
            let law = PressureLaw::Linear { stiffness: 4e6 };
            let gap_m = vec![0.0, 1e-6, 4e-5, 2e-6];
            let area = vec![1.0; 4];
            let statics =
                Statics::new(StaticsParts { law, area, gap_m: gap_m.clone(), response, measured: MeasuredLoad::Back })
                    .unwrap();
            let (force, mu) = (200.0, 0.35);
            let state = statics.state(force, mu).unwrap();
            assert!((1..4).contains(&state.pairs_closed()), "{state:?}");
            let n = model.dimension();
            let mut matrix = Mat::<f64>::zeros(n, n);
            for (part, offset) in model.parts.iter().zip(model.offsets()) {
                let size = part.mass.nrows();
                matrix.submatrix_mut(offset, offset, size, size).copy_from(part.stiffness.to_dense());
            }
            let mut right = Mat::<f64>::zeros(n, 1);
            load.iter().for_each(|&(row, weight)| right[(row, 0)] += force * weight);
            for k in (0..4).filter(|&k| state.force_n[k] > 0.0) {
                let pushed: Vec<(usize, f64)> = contact.normal[k]
                    .iter()
                    .copied()
                    .chain(contact.sliding[k].iter().map(|&(row, weight)| (row, mu * weight)))
                    .collect();
                // N = -4e6 (h + B_n q).
                for &(i, a) in &pushed {
                    right[(i, 0)] -= a * 4e6 * gap_m[k];
                    contact.normal[k].iter().for_each(|&(j, b)| matrix[(i, j)] += a * 4e6 * b);
                }
            }
            let q = matrix.partial_piv_lu().solve(&right);
            let largest = state.closure_m.iter().fold(0.0f64, |most, closure| most.max(closure.abs()));
            for (k, initial) in gap_m.iter().enumerate() {
                let gap = initial + contact.normal[k].iter().map(|&(row, weight)| weight * q[(row, 0)]).sum::<f64>();
                // 1e-12 of the shift, and the condition of a chain of 75 springs.
                assert!((state.closure_m[k] + gap).abs() < 1e-9 * largest, "{held} {k}: {} {gap}", state.closure_m[k]);
            }
        }
    }
}
