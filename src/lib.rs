//! Predicts friction-induced instability of a pad-on-disc tribometer from its operating conditions.

#[cfg(feature = "node")]
pub mod cmd;
#[cfg(feature = "node")]
pub mod display;
#[cfg(feature = "node")]
pub mod io;
#[cfg(feature = "node")]
pub mod node;
#[cfg(feature = "node")]
pub mod offline;
pub mod physics;
#[cfg(feature = "node")]
pub mod plot;
pub mod reduction;
#[cfg(feature = "node")]
pub mod rig;
#[cfg(feature = "node")]
pub mod session;
#[cfg(feature = "node")]
pub mod settings;
#[cfg(feature = "node")]
pub mod simulator;
#[cfg(feature = "node")]
pub mod verify;
#[cfg(feature = "node")]
pub mod wire;
