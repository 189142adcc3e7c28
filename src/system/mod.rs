//! The machine and the process: clocks and memory as reported by Linux, panics taken as results.

pub mod clock;
pub mod memory;
pub mod panics;
