//! Adapters between the node and the outside: buses, clocks, files and recordings. They contain neither physics nor
//! session logic.

pub mod bag;
pub mod chart_file;
pub mod clock;
pub mod heard;
pub mod import;
pub mod memory;
pub mod message;
pub mod pace;
pub mod params_file;
pub mod record_walker;
pub mod recorded_topics;
pub mod recorder;
pub mod recording;
pub mod recording_file;
pub mod recover;
pub mod ros2;
pub mod ros_args;
pub mod shm;
mod shm_place;
pub mod tribometer_log;
pub mod whole_file;

pub use heard::{Bus, Heard};
