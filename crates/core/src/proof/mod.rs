//! Proof of the numerics for tests, benchmarks and `squealcast bench`: reference roots to thirty digits, extreme
//! cases, synthetic rigs, comparisons at held-out points. No prediction is computed here, and no code
//! that predicts depends on this module. Only tests and the feature `proof` compile it.

pub mod held_out;
pub mod identities;
pub mod reference;
pub mod stress;
pub mod synthetic;
