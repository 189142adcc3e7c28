//! Model reduction: real modes of substructures and systems, and projection of full models on a basis.
//!
//! Dense, for substructures whose matrices are written in a rig file, the symmetric problem
//!
//! ```text
//! K φ = ω² M φ,   M = L Lᵀ,   (L⁻¹ K L⁻ᵀ) y = ω² y,   φ = L⁻ᵀ y,   Φᵀ M Φ = I
//! ```
//!
//! is solved by [`free_interface_modes`]. [`whiten`] transforms a whole system to `M = I` without truncation.
//!
//! Sparse, for finite-element matrices: [`normal_modes`] finds the lowest modes by nested dissection, a supernodal
//! Cholesky factor `L Lᵀ`, and shift-invert block Lanczos with thick restart. The inertia of `K - σ M` proves that no
//! mode was missed. [`project_sparse`] projects a term on the basis. [`Analysed::residual`] computes residual
//! flexibility and inertia, the quasi-static response of the truncated modes at the contact. [`keep_modes`] does both
//! for all parts of a model.
//!
//! Factors and modes come from an [`Engine`]: [`OwnEngine`], or one that runs elsewhere, whose results are checked.
//!
//! A [`FullModel`] is the input to all of this. [`FullSolver`] finds complex eigenvalues of the full model itself, as a
//! reference for comparisons and as samples for a [`parametric_basis`].
//!
//! [`compare_roots`] and [`full_windows`] measure the error of a reduced model.
//!
//! Pure: no clock, file, bus, log or serialisation.

mod balance;
mod checked;
mod compare;
mod contact_solver;
mod coverage;
mod dense;
mod elimination_tree;
mod engine;
mod error;
mod front_blocks;
mod fronts;
mod full_model;
mod full_order;
mod full_problem;
mod full_root;
mod full_state;
mod full_windows;
mod kept_factors;
mod krylov;
mod krylov_schur;
mod lanczos;
mod ldlt;
mod matching;
mod normal_modes;
mod operating_box;
mod ordering;
mod own_engine;
mod parametric;
mod pencil;
mod precision;
mod probed;
mod project;
mod refinement;
mod residual;
mod schur;
mod sparse;
mod static_response;
mod threads;
mod triangle;
mod unit_loads;

mod substructures;
#[cfg(test)]
mod test_models;

pub(crate) use balance::balanced_displacement;
pub use compare::{CompareError, Comparison, Judged, WindowComparison, compare_roots, compare_windows, reduced_roots};
pub use dense::{ModeSelection, Modes, Whitening, free_interface_modes, whiten};
pub use engine::{ComplexSparseMatrix, CountedBy, Eigenpairs, Engine, Factor, Lowest, Progress};
pub use error::{GIB, ReductionError};
pub use full_model::{
    FullContact, FullModel, FullPart, FullSteady, ModalDamping, PartMatrices, PartTurning, Projected, SparseRow,
    SparseTerm,
};
pub use full_order::FullSolver;
pub use full_root::{CoveredDisc, FullProgress, FullRoot, FullSpectrum, FullVectors};
pub use full_windows::full_windows;
pub use matching::{Counted, RootMatch, match_roots};
pub use normal_modes::{Analysed, SparseModes, Wanted, lowest_modes, normal_modes};
pub use operating_box::OperatingBox;
pub use own_engine::OwnEngine;
pub use parametric::{HeldOut, ParametricBasis, ParametricRequest, ParametricStep, parametric_basis};
pub use pencil::Pencil;
pub use precision::Precision;
use project::project_dense;
pub use project::project_sparse;
pub use residual::Residual;
pub use sparse::{Asymmetry, SparseMatrix, first_asymmetry, is_symmetric, weighted_sum};

pub use substructures::{Kept, Substructure, keep_modes};
pub use threads::{on_threads, threads_for};

/// Largest difference of two mirrored entries of a symmetric matrix, relative to its largest entry; it allows for
/// matrices printed with 13 digits. Such matrices are replaced by the mean of both triangles.
pub const SYMMETRY_TOLERANCE: f64 = 1e-12;

/// A Cholesky pivot of the mass matrix must exceed this times the diagonal entry of its row.
pub const DEFINITE_TOLERANCE: f64 = 1e-13;

/// Largest negative `ω²`, relative to the largest `ω²`. Values in this range are rounding errors of rigid-body modes
/// and count as 0.
pub const SEMIDEFINITE_TOLERANCE: f64 = 1e-10;
