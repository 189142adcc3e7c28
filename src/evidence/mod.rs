//! Evidence for the method: run time against error, and the tables and figures of the paper.

pub mod bench;
pub mod reproduce;
