//! ROS 2 over Zenoh: the same node and the same rig as [`super::ros2`], for peers on `rmw_zenoh_cpp`.
//!
//! It follows the design document of rmw_zenoh: a topic is a key expression with the type and its hash, every endpoint
//! declares a liveliness token, and messages carry an attachment. ros2-client has a Zenoh side too, but announces all
//! types other than its own with a placeholder hash, which matches no peer.
//!
//! It is compiled with the feature `zenoh`, which is on by default. Without it everything here returns `Ros2Error::NoZenoh`.

#[cfg(not(feature = "zenoh"))]
mod absent;
#[cfg(feature = "zenoh")]
mod config;
#[cfg(feature = "zenoh")]
mod graph;
#[cfg(feature = "zenoh")]
mod linger;
#[cfg(feature = "zenoh")]
mod names;
#[cfg(feature = "zenoh")]
mod node;
#[cfg(feature = "zenoh")]
mod parameters;
#[cfg(feature = "zenoh")]
mod present;
#[cfg(feature = "zenoh")]
mod service_types;
#[cfg(feature = "zenoh")]
mod services;

#[cfg(not(feature = "zenoh"))]
pub use absent::{member, replay, rig};
#[cfg(feature = "zenoh")]
pub use present::{member, replay, rig};

use super::received::Received;
use crate::msgs::{OperatingPoint, Prediction, Temperature, Vibration, Waveform};

/// Whether this program was built with Zenoh.
pub const BUILT_IN: bool = cfg!(feature = "zenoh");

/// Takes one kind of message on a thread of Zenoh, which it must not block.
pub type Take<M> = Box<dyn FnMut(Received<M>) + Send>;

/// What a participant receives; it subscribes to nothing else.
#[derive(Default)]
pub struct Receivers {
    pub input: Option<Take<OperatingPoint>>,
    pub vibration: Option<Take<Vibration>>,
    pub temperature: Option<Take<Temperature>>,
    pub waveform: Option<Take<Waveform>>,
    pub prediction: Option<Take<Prediction>>,
}
