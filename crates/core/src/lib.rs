//! Complex eigenvalue analysis of a pad in sliding contact with a disc: models, roots, windows of instability, charts,
//! full finite-element models and their reduction.
//!
//! Pure: no file, clock, bus, log or serialisation is in here, and none in the dependency tree.

pub mod fem;
pub mod physics;
pub mod reduction;
#[cfg(test)]
mod spoil;
