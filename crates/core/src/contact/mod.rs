//! Contact between pad and disc that can open: contact laws, and the state of steady sliding at a load and a friction
//! coefficient.
//!
//! ```text
//! δ + h + F a + (G_nn + s μ G_nt) N + B_n Φ_r ρ = 0      closure of every pair
//! N_k = A_k p(δ_k)                                       contact law
//! F p_r + (B_n Φ_r + s μ B_t Φ_r)ᵀ N = 0                 balance of free-floating parts
//! ```
//!
//! [`PressureLaw`] is `p`, [`Statics`] holds the rest, [`Statics::state`] solves for the closures `δ`, the contact forces
//! `N`, the rigid motions `ρ` and, where the contact force is what a rig measures, the force `F` on the pad's back.

mod anchors;
mod equations;
mod factors;
mod law;
mod newton;
mod path;
mod response;
mod shape;
mod spline;
mod statics;
#[cfg(test)]
mod tests;

pub use law::{LawError, LawValue, PressureLaw, Smoothness};
pub use response::{FreeModes, ResponseError, RigidMotions, StaticResponse, TruncatedResponse};
pub use shape::ShapeError;
pub use spline::{PressureTable, TableError};
pub use statics::{MeasuredLoad, PathEnd, StateSlope, Statics, StaticsError, StaticsParts, SteadyState};
