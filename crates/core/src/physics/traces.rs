//! Traces of a model's matrices: sums of its roots and of their squares, known without solving.

use faer::Mat;

use super::model::{KnownTerm, Model};
use super::operating_point::OperatingPoint;

/// Precomputed traces of a model's matrices: at an operating point only the laws are evaluated.
#[derive(Clone, Debug)]
pub struct Traces {
    stiffness: Vec<f64>,
    damping: Vec<f64>,
    /// `tr(A B)` for every pair of terms, for stiffness and for damping.
    stiffness_products: Mat<f64>,
    damping_products: Mat<f64>,
    /// `tr(Aᵀ B)` for every pair of terms.
    stiffness_norms: Mat<f64>,
    damping_norms: Mat<f64>,
}

/// Sums of the roots and norms of the matrices at an operating point, known exactly without solving.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exact {
    /// Sums over all roots of the first and second power. Undamped, of `λ²`: `-tr K` and `tr K²`. Damped, of `λ`,
    /// conjugates and static roots included: `-tr C` and `tr C² - 2 tr K`.
    pub powers: [f64; 2],
    /// Frobenius norms of `I`, `C` and `K`.
    pub norms: [f64; 3],
    /// Error bounds of `powers`: 0 where they follow from the laws of the terms. NaN where nothing is known.
    pub errors: [f64; 2],
}

impl Exact {
    /// Nothing is known: no set of roots agrees with it.
    pub const UNKNOWN: Self = Self { powers: [f64::NAN; 2], norms: [f64::NAN; 3], errors: [f64::NAN; 2] };

    /// Sums and norms of the matrices `K` and `C`.
    pub fn of(stiffness: &Mat<f64>, damping: &Mat<f64>, damped: bool) -> Self {
        let norms = [(stiffness.nrows() as f64).sqrt(), damping.norm_l2(), stiffness.norm_l2()];
        let powers = if damped {
            [-trace(damping), trace_of_product(damping, damping) - 2.0 * trace(stiffness)]
        } else {
            [-trace(stiffness), trace_of_product(stiffness, stiffness)]
        };
        Self { powers, norms, errors: [0.0; 2] }
    }
}

/// `tr A`.
pub(super) fn trace(m: &Mat<f64>) -> f64 {
    (0..m.nrows()).map(|i| m[(i, i)]).sum()
}

/// `tr(A B)`.
pub(super) fn trace_of_product(a: &Mat<f64>, b: &Mat<f64>) -> f64 {
    (0..a.nrows()).map(|j| (0..a.nrows()).map(|i| a[(j, i)] * b[(i, j)]).sum::<f64>()).sum()
}

impl Traces {
    /// Precomputes the traces of all terms and products of terms.
    pub fn new(model: &Model) -> Self {
        let all = |terms: &[KnownTerm]| terms.iter().map(|k| trace(&k.term.matrix)).collect::<Vec<f64>>();
        let inner = |a: &Mat<f64>, b: &Mat<f64>| -> f64 {
            (0..a.nrows()).map(|j| (0..a.nrows()).map(|i| a[(i, j)] * b[(i, j)]).sum::<f64>()).sum()
        };
        let pairs = |terms: &[KnownTerm], of: &dyn Fn(&Mat<f64>, &Mat<f64>) -> f64| {
            Mat::from_fn(terms.len(), terms.len(), |i, j| of(&terms[i].term.matrix, &terms[j].term.matrix))
        };
        Self {
            stiffness: all(&model.stiffness),
            damping: all(&model.damping),
            stiffness_products: pairs(&model.stiffness, &trace_of_product),
            damping_products: pairs(&model.damping, &trace_of_product),
            stiffness_norms: pairs(&model.stiffness, &inner),
            damping_norms: pairs(&model.damping, &inner),
        }
    }

    /// Sums and norms at `p`. With a contact state they are unknown: they would take the state. A chart of such a
    /// model holds its own.
    pub fn at(&self, model: &Model, p: &OperatingPoint) -> Exact {
        if model.statics().is_some() {
            return Exact::UNKNOWN;
        }
        let weighted = |terms: &[KnownTerm], traces: &[f64]| -> f64 {
            terms.iter().zip(traces).map(|(known, trace)| model.coefficient(&known.term.law, p) * trace).sum()
        };
        let squared = |terms: &[KnownTerm], products: &Mat<f64>| -> f64 {
            let weight = |k: usize| model.coefficient(&terms[k].term.law, p);
            let row = |i: usize| (0..terms.len()).map(|j| weight(j) * products[(i, j)]).sum::<f64>();
            (0..terms.len()).map(|i| weight(i) * row(i)).sum()
        };
        let norm = |terms: &[KnownTerm], norms: &Mat<f64>| squared(terms, norms).max(0.0).sqrt();
        let trace_k = weighted(&model.stiffness, &self.stiffness);
        let powers = if model.is_damped(p) {
            let trace_c = weighted(&model.damping, &self.damping);
            [-trace_c, squared(&model.damping, &self.damping_products) - 2.0 * trace_k]
        } else {
            [-trace_k, squared(&model.stiffness, &self.stiffness_products)]
        };
        let norms = [
            (model.dimension as f64).sqrt(),
            norm(&model.damping, &self.damping_norms),
            norm(&model.stiffness, &self.stiffness_norms),
        ];
        Exact { powers, norms, errors: [0.0; 2] }
    }
}
