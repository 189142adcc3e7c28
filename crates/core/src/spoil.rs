//! What a test spoils in what its own thread computes next, so that the check behind it is seen to hold.

use std::cell::Cell;

/// What is spoilt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Spoil {
    /// An eigenvalue of the unsymmetric dense problem is moved by a millionth of the matrix.
    Value,
    /// A right vector of the dense problem is turned.
    Vector,
    /// A converged mode of the Lanczos iteration is lost.
    Mode,
    /// A root that two discs cover is lost from one of them.
    Root,
    /// Only one shift may be taken.
    Shifts,
    /// Ends of windows of a full model may take one round.
    Rounds,
    /// No projection of a full model is good enough.
    Held,
}

thread_local! {
    static NOW: Cell<Option<Spoil>> = const { Cell::new(None) };
}

/// Whether this is spoilt now.
pub fn spoilt(what: Spoil) -> bool {
    NOW.get() == Some(what)
}

/// Runs `action` with something spoilt.
pub fn with<T>(what: Spoil, action: impl FnOnce() -> T) -> T {
    NOW.set(Some(what));
    let result = action();
    NOW.set(None);
    result
}
