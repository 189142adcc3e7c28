//! The buses a node receives conditions from and publishes predictions on: shared memory and ROS 2.

pub mod params_file;
pub mod received;
pub mod ros2;
pub mod ros_args;
pub mod shm;
mod shm_place;

pub use received::{Bus, Received};
