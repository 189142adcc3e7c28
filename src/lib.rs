//! Predicts friction-induced instability of a pad-on-disc tribometer from its operating conditions.
//!
//! - [`rig`] reads rig files; [`full_model`] reads the finite-element models that [`reduction`] reduces to rigs.
//! - [`physics`] computes roots, stability maps, window ends and charts.
//! - [`session`] turns inputs and session events into predictions, as a pure step.
//! - [`analysis`] predicts, sweeps and finds windows over given conditions.
//! - [`node`] runs a session on a [`bus`] and records it ([`recording`]); [`offline`] runs one without buses.
//! - [`sound`] detects squeal in sampled sound or acceleration.
//! - [`display`] shows a node or a recording; [`figures`] draws; [`evidence`] measures and reproduces.
//! - [`study`] computes many cases of a rig or full model, or of many recordings, in one table.
//! - [`commands`] contains the commands.
//!
//! `ARCHITECTURE.md` describes the rooms and their invariants.

/// Writes a line to standard error through [`text::notes::line`].
macro_rules! note {
    ($($text:tt)*) => { $crate::text::notes::line(format_args!($($text)*)) };
}

pub use squealcast_core::{contact, fem, physics, proof, reduction};
pub use squealcast_msgs as msgs;

pub mod analysis;
pub mod bus;
pub mod commands;
pub mod display;
pub mod evidence;
pub mod export;
pub mod figures;
pub mod files;
pub mod foxglove;
pub mod full_model;
pub mod import;
pub mod node;
pub mod offline;
mod random;
pub mod recording;
pub mod rig;
pub mod session;
pub mod simulator;
pub mod sound;
pub mod study;
pub mod system;
mod text;
