//! Connects the roots of two spectra: first by shape, then by predicted value, never by order.

use faer::c64;

use super::spectrum::Spectrum;

/// Overlap of shapes above which two roots are accepted as the same mode without refinement.
pub const CLEAR_OVERLAP: f64 = 0.8;

/// Overlap above which pairs are considered before all others.
const LARGE_OVERLAP: f64 = 0.5;

/// Relative distance `|z1 - z2| / (|z1| + |z2|)` up to which two roots are one multiple root. Its shapes are
/// arbitrary within their span.
const MULTIPLE: f64 = 1e-10;

/// The roots of a spectrum as continuations of those of another.
#[derive(Clone, Debug)]
pub struct Continuation {
    /// For each root of the later spectrum, the root of the earlier one that it continues.
    pub source: Vec<Option<usize>>,
    /// Whether every followed root has a counterpart with an overlap above [`CLEAR_OVERLAP`].
    pub clear: bool,
}

/// Number of roots that are followed: all `n` of an undamped spectrum, the modes of a damped one.
pub fn tracked(spectrum: &Spectrum) -> usize {
    if spectrum.undamped { spectrum.roots.len() } else { spectrum.mode_count }
}

/// Connects the roots of `from` to those of `to`, two spectra of one model at nearby operating points.
///
/// The score of a pair is `|xᵢᴴ yⱼ|² - |ẑᵢ - zⱼ| / (|ẑᵢ| + |zⱼ|)`. `ẑ` is the square of the root, extrapolated by its
/// friction sensitivity if that is known and predicts better. Pairs are accepted in descending order of score, each
/// root once.
pub fn continue_roots(from: &Spectrum, to: &Spectrum) -> Continuation {
    let (count_from, count_to) = (tracked(from), tracked(to));
    let overlap = from.shapes.get(.., ..count_from).adjoint() * to.shapes.get(.., ..count_to);
    let predicted = extrapolated(from, to.point.friction_coefficient);

    let score = |i: usize, j: usize| {
        let z = to.roots[j].square;
        // Near a merging point the sensitivity is unbounded and the value without extrapolation predicts better.
        let off = relative_distance(predicted[i], z).min(relative_distance(from.roots[i].square, z));
        (overlap[(i, j)].norm_sqr() - off, i, j)
    };
    let mut source = vec![None; to.roots.len()];
    let mut taken = vec![false; count_from];
    let mut clear = count_from == count_to;
    let mut left = count_from.min(count_to);
    // A score is at most the overlap. Pairs with a large overlap are few and nearly always connect all roots, so they
    // come first.
    for large in [true, false] {
        let pairs = (0..count_to).flat_map(|j| (0..count_from).map(move |i| (i, j)));
        let considered = pairs.filter(|&(i, j)| !large || overlap[(i, j)].norm_sqr() > LARGE_OVERLAP);
        let mut scores: Vec<(f64, usize, usize)> = considered.map(|(i, j)| score(i, j)).collect();
        scores.retain(|&(score, ..)| (score > LARGE_OVERLAP) == large);
        scores.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        for (_, i, j) in scores {
            if taken[i] || source[j].is_some() {
                continue;
            }
            source[j] = Some(i);
            taken[i] = true;
            left -= 1;
            clear &= overlap[(i, j)].norm_sqr() > CLEAR_OVERLAP || span_overlap(from, i, to, j) > CLEAR_OVERLAP;
        }
        if left == 0 {
            break;
        }
    }
    Continuation { source, clear }
}

/// The squares of the followed roots of `spectrum`, extrapolated to friction coefficient `mu`.
fn extrapolated(spectrum: &Spectrum, mu: f64) -> Vec<c64> {
    let step = mu - spectrum.point.friction_coefficient;
    (0..tracked(spectrum))
        .map(|i| {
            let sensitivity = spectrum.friction_sensitivity.get(i).copied().unwrap_or(c64::ZERO);
            spectrum.roots[i].square + sensitivity * step
        })
        .collect()
}

/// `|a - b| / (|a| + |b|)`; 0 if both are zero.
fn relative_distance(a: c64, b: c64) -> f64 {
    let scale = a.norm() + b.norm();
    let distance = (a - b).norm() / scale;
    if scale > 0.0 && distance.is_finite() { distance } else { 0.0 }
}

/// Overlap of shape `i` of `from` with the span of the shapes of `to` that belong to the same multiple root as root
/// `j`, by Gram-Schmidt orthogonalisation.
fn span_overlap(from: &Spectrum, i: usize, to: &Spectrum, j: usize) -> f64 {
    let n = to.shapes.nrows();
    let z = to.roots[j].square;
    let mut basis: Vec<Vec<c64>> = vec![];
    for k in (0..tracked(to)).filter(|&k| relative_distance(to.roots[k].square, z) <= MULTIPLE) {
        let mut vector: Vec<c64> = (0..n).map(|row| to.shapes[(row, k)]).collect();
        for _ in 0..2 {
            for unit in &basis {
                let along: c64 = unit.iter().zip(&vector).map(|(u, v)| u.conj() * v).sum();
                vector.iter_mut().zip(unit).for_each(|(v, u)| *v -= along * u);
            }
        }
        let norm = vector.iter().map(|v| v.norm_sqr()).sum::<f64>().sqrt();
        if norm > 1e-8 {
            vector.iter_mut().for_each(|v| *v /= norm);
            basis.push(vector);
        }
    }
    basis.iter().map(|unit| (0..n).map(|row| unit[row].conj() * from.shapes[(row, i)]).sum::<c64>().norm_sqr()).sum()
}
