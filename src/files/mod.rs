//! Files: read under a size limit, written complete or not at all; charts on disk.

pub mod chart_file;
pub mod input_file;
pub mod whole_file;
