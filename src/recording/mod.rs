//! Recordings: rosbag2 directories of MCAP files, written, read and repaired.

pub mod bag;
pub mod mcap_file;
pub mod message;
pub mod pace;
pub mod reader;
pub mod record_walker;
mod recorded_rig;
pub mod recorder;
pub mod recover;
pub mod topics;

pub use recorded_rig::{RecordedRigError, recorded_rig};
