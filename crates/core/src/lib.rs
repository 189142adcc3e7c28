//! Complex eigenvalue analysis of a pad in sliding contact with a disc: models, roots, windows of instability, charts,
//! full finite-element models and their reduction.
//!
//! The crate is pure: there is no file, clock, bus, log or serialisation in it or in its dependency tree.

mod chebyshev;
pub mod contact;
pub mod fem;
pub mod physics;
#[cfg(any(test, feature = "proof"))]
pub mod proof;
pub mod reduction;
mod sampling;
#[cfg(test)]
mod spoil;
