//! From full models to reduced ones: modes of substructures and of systems, and projections on them.
//!
//! Dense, for substructures written out in a rig file: the symmetric problem
//!
//! ```text
//! K φ = ω² M φ,   M = L Lᵀ,   (L⁻¹ K L⁻ᵀ) y = ω² y,   φ = L⁻ᵀ y,   Φᵀ M Φ = I
//! ```
//!
//! by [`free_interface_modes`]; [`whiten`] makes `M = I` of a whole system without leaving anything out. Sparse, for
//! systems of finite-element matrices: [`normal_modes`] by nested dissection, a supernodal `L Lᵀ` and shift-invert block
//! Lanczos with thick restart, the count of modes proven by the inertia of `K - σ M`; [`project_sparse`] takes each term
//! to the basis; [`Analysed::residual`] finds what the modes left out still do at the contact; [`keep_modes`] does both
//! for all parts of a model.
//! A [`FullModel`] is what all of it starts from; [`FullSolver`] finds the roots of the full model itself, to compare
//! with and to make a [`parametric_basis`] of, on which it keeps them.
//!
//! [`compare_roots`] and [`full_windows`] say how far a reduced model is from it.
//!
//! Pure: no clock, file, bus, log or serialisation.

mod compare;
mod contact_solver;
mod coverage;
mod dense;
mod error;
mod full_model;
mod full_order;
mod full_problem;
mod krylov_schur;
mod lanczos;
mod matching;
mod normal_modes;
mod operating_box;
mod ordering;
mod parametric;
mod pencil;
mod project;
mod residual;
mod schur;
mod sparse;
mod substructures;
#[cfg(test)]
mod test_models;

pub use compare::{
    CompareError, Comparison, Judged, WindowComparison, compare_roots, compare_windows, full_windows, reduced_roots,
};
pub use dense::{ModeSelection, Modes, Whitening, free_interface_modes, whiten};
pub use error::{GIB, ReductionError};
pub use full_model::{FullContact, FullModel, FullPart, Projected, SparseRow, SparseTerm};
pub use full_order::{CoveredDisc, FullProgress, FullRoot, FullSolver, FullSpectrum, FullVectors};
pub use matching::{Counted, RootMatch, match_roots};
pub use normal_modes::{Analysed, Progress, SparseModes, Wanted, lowest_modes, normal_modes};
pub use operating_box::OperatingBox;
pub use parametric::{HeldOut, ParametricBasis, ParametricRequest, ParametricStep, parametric_basis};
pub use project::{project_dense, project_sparse};
pub use residual::{InertiaBy, Residual};
pub use sparse::{SparseMatrix, is_symmetric, weighted_sum};
pub use substructures::{Kept, Substructure, keep_modes};

/// Two mirrored entries of a symmetric matrix may differ by this times the largest entry: what printing with 13 digits
/// leaves. Such matrices are taken as the mean of both triangles.
pub const SYMMETRY_TOLERANCE: f64 = 1e-12;

/// A pivot of the mass matrix must exceed this times its own diagonal entry.
pub const DEFINITE_TOLERANCE: f64 = 1e-13;

/// `ω²` may fall below zero by this times the largest `ω²`: rounding of a rigid-body motion, taken as 0.
pub const SEMIDEFINITE_TOLERANCE: f64 = 1e-10;
