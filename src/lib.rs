//! Predicts friction-induced instability of a pad-on-disc tribometer from its operating conditions.

#[cfg(feature = "node")]
pub mod bench;
#[cfg(feature = "node")]
pub mod cmd;
#[cfg(feature = "node")]
pub mod display;
#[cfg(feature = "node")]
pub mod export;
pub mod fem;
#[cfg(feature = "node")]
pub mod full_model;
