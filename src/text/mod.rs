//! Text for people: numbers and hashes in words, text that is safe in a terminal, lines on standard error.

pub mod hex;
pub mod notes;
pub mod number;
pub mod terminal;
