//! Predicts friction-induced instability of a pad-on-disc tribometer from its operating conditions.
//!
//! - [`rig`] reads rig files; [`full_model`] reads the finite-element models that [`reduction`] reduces to rigs.
//! - [`physics`] computes roots, stability maps, window ends and charts.
//! - [`session`] turns inputs and session events into predictions, as a pure step; [`settings`] are its parameters.
//! - [`node`] runs a session on the buses, clocks and files of [`io`], with the messages of [`wire`].
//! - [`display`] shows a node or a recording; [`cmd`] contains the commands.
//!
//! `ARCHITECTURE.md` describes the layers and their invariants.

/// Writes a line to standard error through [`notes::line`].
macro_rules! note {
    ($($text:tt)*) => { $crate::notes::line(format_args!($($text)*)) };
}

pub use squealcast_core::{fem, physics, reduction};

mod ahead;
pub mod bench;
pub mod certificate;
pub mod cmd;
pub mod display;
pub mod export;
pub mod full_model;
mod hex;
pub mod html;
pub mod input_file;
pub mod io;
pub mod node;
mod notes;
mod number;
pub mod offline;
pub mod plot;
pub mod reproduce;
pub mod rig;
pub mod session;
pub mod settings;
pub mod simulator;
mod terminal;
pub mod verify;
pub mod wire;
