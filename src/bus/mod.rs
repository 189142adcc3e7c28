//! The buses a node receives conditions from and publishes predictions on: shared memory, and ROS 2 over DDS and over Zenoh.
//!
//! [`Bus`] lists them. Each implements [`Connection`], which is all that the node and the commands know of a bus once it
//! is joined; what a bus receives goes to a [`Sink`].

mod connection;
pub mod lifecycle;
pub mod log;
mod managed;
pub mod params_file;
pub mod qos_overrides;
pub mod received;
pub mod ros2;
pub mod ros_args;
pub mod shm;
mod shm_connection;
mod shm_place;
pub mod shm_waveform;
mod sockets;
mod type_descriptions;
pub mod zenoh;

pub use connection::{BusError, Connection, Outgoing, Report, Sink};
pub use received::{Counts, Received};
pub use shm_connection::ShmConnection;

use crate::msgs::listed;

listed! {
    /// The bus over which a message was received. Buses are joined and published to in this order.
    pub enum Bus {
        /// Shared memory (iceoryx2). First, because its readers wait for a prediction.
        Shm,
        /// ROS 2 over DDS.
        Ros2,
        /// ROS 2 over Zenoh.
        Zenoh,
        /// No bus: the rig simulator of `demo`, in this process.
        Simulator,
    }
}

impl Bus {
    /// Its name in diagnostics.
    pub fn name(self) -> &'static str {
        match self {
            Self::Shm => "shm",
            Self::Ros2 => "ros2",
            Self::Zenoh => "zenoh",
            Self::Simulator => "simulator",
        }
    }
}
