//! Predicts friction-induced instability of a pad-on-disc tribometer from its operating conditions.

/// A line on standard error; that nobody is there to read it is no error.
#[cfg(feature = "node")]
macro_rules! note {
    ($($text:tt)*) => { drop(std::io::Write::write_fmt(&mut std::io::stderr(), format_args!("{}\n", format_args!($($text)*)))) };
}

#[cfg(feature = "node")]
mod ahead;
#[cfg(feature = "node")]
pub mod bench;
#[cfg(feature = "node")]
pub mod certificate;
#[cfg(feature = "node")]
pub mod cmd;
#[cfg(feature = "node")]
pub mod display;
#[cfg(feature = "node")]
pub mod export;
pub mod fem;
#[cfg(feature = "node")]
pub mod full_model;
#[cfg(feature = "node")]
mod hex;
#[cfg(feature = "node")]
pub mod html;
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
pub mod reproduce;
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
