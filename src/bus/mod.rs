//! The buses a node receives conditions from and publishes predictions on: shared memory and ROS 2.
//!
//! [`Bus`] lists them. Each implements [`Connection`], which is all that the node and the commands know of a bus once it
//! is joined; what a bus receives goes to a [`Sink`].

mod connection;
pub mod params_file;
pub mod received;
pub mod ros2;
pub mod ros_args;
pub mod shm;
mod shm_connection;
mod shm_place;

pub use connection::{BusError, Connection, Outgoing, Report, Sink};
pub use received::{Counts, Received};
pub use shm_connection::ShmConnection;

/// Defines the enum of buses with the list of all and their names.
macro_rules! buses {
    ($($(#[$doc:meta])* $bus:ident = $name:literal),+ $(,)?) => {
        /// The bus over which a message was received.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum Bus {
            $($(#[$doc])* $bus),+
        }

        impl Bus {
            /// All buses, in the order in which they are joined and published to.
            pub const ALL: [Self; [$($name),+].len()] = [$(Self::$bus),+];

            /// Its name in diagnostics.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$bus => $name),+
                }
            }
        }
    };
}

buses! {
    /// Shared memory (iceoryx2). First, because its readers wait for a prediction.
    Shm = "shm",
    /// ROS 2.
    Ros2 = "ros2",
    /// No bus: the rig simulator of `demo`, in this process.
    Simulator = "simulator",
}
