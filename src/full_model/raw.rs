//! The serde form of full models: every key, checked only for its type.

use serde::Deserialize;

use crate::rig::raw::{OneOrMany, RawContactState, RawPatch, RawSystem, define_file, with_common_tables};

with_common_tables!(define_file! {
    /// A whole full model: the common tables of a rig file, and either parts or a system.
    RawFullModel {
        pad: Option<RawPart>,
        disc: Option<RawPart>,
        contact_patch: Option<Vec<RawPatch>>,
        contact_state: Option<RawContactState>,
        system: Option<RawSystem>,
    }
});

/// `[pad]` or `[disc]`: the matrices of a substructure with its contact interface free.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawPart {
    pub stiffness: String,
    pub mass: String,
    pub nodes: String,
    pub rows: Option<String>,
    pub interface_nodes: Vec<u64>,
    pub damping_ratio: Option<OneOrMany>,
    #[serde(default)]
    pub rayleigh_alpha_per_s: f64,
    #[serde(default)]
    pub rayleigh_beta_s: f64,
    /// Refused unless it is 0: a complex stiffness has no real equation of motion.
    #[serde(default)]
    pub loss_factor: f64,
    pub gyroscopic: Option<String>,
    pub spin: Option<String>,
    pub stress_stiffening: Option<String>,
    #[serde(default)]
    pub units: Units,
}

/// Units of matrices and coordinates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
pub enum Units {
    /// N/m, kg, m.
    #[default]
    #[serde(rename = "m-kg-s")]
    MetreKilogram,
    /// N/mm, t, mm.
    #[serde(rename = "mm-t-s")]
    MillimetreTonne,
}

impl Units {
    /// Factor that converts matrices to N/m and kg.
    pub fn of_matrices(self) -> f64 {
        if self == Self::MetreKilogram { 1.0 } else { 1e3 }
    }

    /// Factor that converts coordinates to m.
    pub fn of_lengths(self) -> f64 {
        if self == Self::MetreKilogram { 1.0 } else { 1e-3 }
    }
}
