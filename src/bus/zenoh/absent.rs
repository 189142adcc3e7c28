//! A program built without Zenoh.

use super::Receivers;
use crate::bus::Connection;
use crate::bus::lifecycle::State;
use crate::bus::managed::Changed;
use crate::bus::ros2::member::Member;
use crate::bus::ros2::{Parameters, Ros2Error, Ros2Options};

/// # Errors
/// Always [`Ros2Error::NoZenoh`].
pub fn member(
    _: &Ros2Options,
    _: Receivers,
    _: Parameters,
    _: State,
    _: Changed,
) -> Result<Box<dyn Member>, Ros2Error> {
    Err(Ros2Error::NoZenoh)
}

/// # Errors
/// Always [`Ros2Error::NoZenoh`].
pub fn rig(_: &Ros2Options) -> Result<Box<dyn Connection>, Ros2Error> {
    Err(Ros2Error::NoZenoh)
}

/// # Errors
/// Always [`Ros2Error::NoZenoh`].
pub fn replay(_: &Ros2Options) -> Result<Box<dyn Connection>, Ros2Error> {
    Err(Ros2Error::NoZenoh)
}
