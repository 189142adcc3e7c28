//! The serde form of full models: every key, checked only for its type.

use serde::Deserialize;

use crate::rig::raw::{
    RawBand, RawChart, RawFriction, RawLimits, RawLoad, RawPatch, RawReference, RawRig, RawSearch, RawSystem,
    RawWarning, first_format,
};

/// A whole full model: the common tables of a rig file, and either parts or a system.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawFullModel {
    pub name: String,
    #[serde(default = "first_format")]
    pub format: i64,
    #[serde(default)]
    pub reference: RawReference,
    #[serde(default)]
    pub band: RawBand,
    #[serde(default)]
    pub search: RawSearch,
    #[serde(default)]
    pub friction: RawFriction,
    #[serde(default)]
    pub load: RawLoad,
    #[serde(default)]
    pub limits: RawLimits,
    #[serde(default)]
    pub warning: RawWarning,
    #[serde(default)]
    pub chart: RawChart,
    pub pad: Option<RawPart>,
    pub disc: Option<RawPart>,
    pub contact_patch: Option<Vec<RawPatch>>,
    pub system: Option<RawSystem>,
}

/// `[pad]` or `[disc]`: the matrices of a substructure with its contact interface free.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawPart {
    pub stiffness: String,
    pub mass: String,
    pub nodes: String,
    pub rows: Option<String>,
    pub interface_nodes: Vec<u64>,
    pub damping_ratio: Option<f64>,
    #[serde(default)]
    pub rayleigh_alpha_per_s: f64,
    #[serde(default)]
    pub rayleigh_beta_s: f64,
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

/// The tables that a full model does not share with rig files.
pub struct Own {
    pub name: String,
    pub pad: Option<RawPart>,
    pub disc: Option<RawPart>,
    pub patches: Option<Vec<RawPatch>>,
    pub system: Option<RawSystem>,
}

impl RawFullModel {
    /// Splits into the common tables, as a rig file without substructures, and the other tables.
    pub fn split(self) -> (RawRig, Own) {
        let own = Own {
            name: self.name.clone(),
            pad: self.pad,
            disc: self.disc,
            patches: self.contact_patch,
            system: self.system,
        };
        let common = RawRig {
            name: self.name,
            format: self.format,
            reference: self.reference,
            band: self.band,
            search: self.search,
            friction: self.friction,
            load: self.load,
            limits: self.limits,
            warning: self.warning,
            chart: self.chart,
            pad: None,
            disc: None,
            contact: None,
            contact_patch: None,
            system: None,
            residual: None,
            basis: None,
            reduction: None,
        };
        (common, own)
    }
}
