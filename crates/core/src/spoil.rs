//! Falsifies a result inside a solver, in tests only and on the calling thread only, to show that the check behind it
//! notices.

use std::cell::Cell;

/// The result to falsify.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Spoil {
    /// Moves an eigenvalue of the unsymmetric dense problem by 1e-6 of the matrix norm.
    Value,
    /// Perturbs a right vector of the unsymmetric dense problem, or a mode of a sparse system.
    Vector,
    /// Perturbs an entry of a factor `L Lᵀ` or `L D Lᵀ`: by 1e-6 of itself in double precision, manyfold in single, whose
    /// solves are refined.
    Factor,
    /// Leaves the rows of one subtree out of the products of responses to loads.
    Share,
    /// Drops a converged mode of the Lanczos iteration.
    Mode,
    /// Drops a root that lies in the discs of two shifts from one of them.
    Root,
    /// Allows only one shift.
    Shifts,
    /// Allows the search for window ends of a full model only one round.
    Rounds,
    /// Lets no projection of a full model pass its accuracy check.
    Held,
}

thread_local! {
    static NOW: Cell<Option<Spoil>> = const { Cell::new(None) };
}

/// Whether `what` is to be falsified now.
pub fn spoilt(what: Spoil) -> bool {
    NOW.get() == Some(what)
}

/// Runs `action` with `what` falsified.
pub fn with<T>(what: Spoil, action: impl FnOnce() -> T) -> T {
    NOW.set(Some(what));
    let result = action();
    NOW.set(None);
    result
}
