//! Linear elastic finite elements: 8-node bricks on structured meshes, assembled to sparse matrices.
//!
//! ```text
//! K = Σ_e ∫ Bᵀ D B dV + Σ springs      stiffness, N/m
//! M = Σ_e ∫ ρ Nᵀ N dV                  consistent mass, kg
//! ```
//!
//! [`brick`] computes the element matrices, with the incompatible modes of Wilson and Taylor. A [`Mesh`] holds nodes,
//! bricks and hanging nodes; a [`Block`] is a structured piece of it. A [`Structure`] adds supports and springs and is
//! assembled; [`Structure::turning`] gives the matrices of one that turns about an axis. [`tribometer`] is the reference
//! rig.
//!
//! Pure: no clock, file, bus, log or serialisation.

mod brick;
mod mesh;
mod structure;
pub mod tribometer;
mod turning;

pub use brick::{BrickMatrices, brick};
pub use mesh::{Block, Brick, Component, Extent, Mesh, SOLID, stations};
pub use structure::{Assembled, Spring, Structure};
pub use turning::{Axis, Turning, TurningError};

/// An isotropic, linearly elastic material.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Density `ρ`, kg/m³, above 0.
    pub density_kg_per_m3: f64,
    /// Young's modulus `E`, Pa, above 0.
    pub young_pa: f64,
    /// Poisson's ratio `ν`, between -1 and 0.5.
    pub poisson: f64,
}

/// Error of a finite-element model, with the offending value. Nodes and bricks are counted from 0.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FemError {
    /// A material constant is outside its range.
    #[error("{component}: {field} is {value}, expected {limit}")]
    Material {
        /// Name of the component.
        component: String,
        /// Field of [`Material`].
        field: &'static str,
        /// The value found.
        value: f64,
        /// The range expected.
        limit: &'static str,
    },
    /// A brick is turned inside out or has no volume.
    #[error("brick {brick} of {component}: the Jacobian is {value:.3e} m^3, expected more than 0")]
    Inverted {
        /// Index of the brick.
        brick: usize,
        /// Name of its component.
        component: String,
        /// Smallest determinant of its Jacobian, m³.
        value: f64,
    },
    /// A node belongs to no brick and would move freely.
    #[error("node {node} is in no brick")]
    Loose {
        /// Index of the node.
        node: usize,
    },
    /// A spring has no positive stiffness.
    #[error("spring {spring}: the stiffness is {value} N/m, expected a finite number above 0")]
    Spring {
        /// Index of the spring.
        spring: usize,
        /// Its stiffness, N/m.
        value: f64,
    },
    /// Fewer degrees of freedom than the coarsest mesh has.
    #[error("{value} degrees of freedom requested, expected at least {limit}")]
    Size {
        /// Number asked for.
        value: usize,
        /// Size of the coarsest mesh.
        limit: usize,
    },
}

impl Material {
    /// Lamé's constants `λ = E ν / ((1 + ν)(1 - 2ν))` and `G = E / (2 (1 + ν))`, Pa, as `(λ, G)`.
    pub fn lame_pa(&self) -> (f64, f64) {
        let shear = self.young_pa / (2.0 * (1.0 + self.poisson));
        (2.0 * shear * self.poisson / (1.0 - 2.0 * self.poisson), shear)
    }

    fn check(&self, component: &str) -> Result<(), FemError> {
        let refuse =
            |field, value, limit| Err(FemError::Material { component: component.to_owned(), field, value, limit });
        let positive = |value: f64| value.is_finite() && value > 0.0;
        if !positive(self.density_kg_per_m3) {
            return refuse("density_kg_per_m3", self.density_kg_per_m3, "a finite number above 0");
        }
        if !positive(self.young_pa) {
            return refuse("young_pa", self.young_pa, "a finite number above 0");
        }
        if !(self.poisson > -1.0 && self.poisson < 0.5) {
            return refuse("poisson", self.poisson, "more than -1 and less than 0.5");
        }
        Ok(())
    }
}
