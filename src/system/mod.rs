//! The machine: its clocks and its memory, as reported by Linux.

pub mod clock;
pub mod memory;
