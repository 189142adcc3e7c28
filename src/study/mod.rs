//! Studies of the method itself: run time against error, and the tables and figures of the paper.

pub mod bench;
pub mod reproduce;
