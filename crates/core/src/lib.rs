//! Complex eigenvalue analysis of a pad in sliding contact with a disc: models, roots, windows of instability, charts,
//! full finite-element models and their reduction.
//!
//! The crate is pure: there is no file, clock, bus, log or serialisation in it or in its dependency tree.

pub mod fem;
pub mod physics;
pub mod reduction;
#[cfg(test)]
mod spoil;
