//! Stability prediction: operating point, contact, model, complex eigenvalues, critical friction, mode tracking.
//!
//! Pure: no clock, file, bus, log or serialisation. Everything is SI, angular frequencies in rad/s.

pub mod chart;
pub(crate) mod critical;
mod decoupled;
mod dense_eigen;
pub(crate) mod ends;
mod flexible_contact;
pub mod identification;
pub(crate) mod law;
pub(crate) mod model;
pub(crate) mod model_error;
pub(crate) mod numbering;
pub(crate) mod operating_point;
pub mod sensitivity;
pub(crate) mod solver;
pub(crate) mod spectrum;
pub mod stability_map;
mod steady_contact;
#[cfg(test)]
mod steady_tests;
mod stribeck;
pub(crate) mod summary;
#[cfg(test)]
pub(crate) mod test_models;
mod traces;
pub(crate) mod tracking;
#[cfg(test)]
mod turning;

pub use chart::{Chart, NotCharted};
pub use critical::{Window, WindowKind};
pub use ends::{Bounded, End, Ends, NearestEnd};
pub use flexible_contact::ResidualFlexibility;
pub use law::{ContactLaw, CustomLaw, Law, Parameter};
pub use model::{ContactPairs, Model, Structure, Term};
pub use model_error::ModelError;
pub use numbering::Census;
pub use operating_point::{ContactState, OperatingPoint, SLIDING_SPEED_RAD_S};
pub use solver::Solver;
pub use spectrum::{Root, RootError, SolveError, Spectrum, Vectors};
pub use stability_map::{MapError, MapOptions, NextWindow, StabilityMap};
pub use steady_contact::Situation;
pub(crate) use steady_contact::relaxation_s;
pub use stribeck::Stribeck;
pub use summary::{Mode, Summary};
pub use traces::{Exact, Traces};
