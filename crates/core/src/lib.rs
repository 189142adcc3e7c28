//! Complex eigenvalue analysis of a pad in sliding contact with a disc: models, roots, windows of instability, charts,
//! full finite-element models and their reduction.
//!
//! # The problem
//!
//! A pad is pressed against a rotating disc. Friction makes the stiffness matrix unsymmetric: as the friction
//! coefficient `μ` rises, the frequencies of two modes can merge, and from there on one of them grows. That is squeal.
//!
//! ```text
//! (λ² I + λ C(p) + K(p)) x = 0,   λ = σ + iω,   p = (normal load, disc speed, friction coefficient)
//! ```
//!
//! A mode grows if `σ > 0`. Units are SI, angular frequencies rad/s; coordinates are mass-normalised, `M = I`.
//!
//! # From an operating point to a prediction
//!
//! A [`Model`](physics::Model) is a sum of constant matrices, each times a scalar [`Law`](physics::Law) of the operating
//! point. A [`Solver`](physics::Solver) gives all roots at one point, with error bounds:
//!
//! ```
//! use faer::mat;
//! use squealcast_core::physics::{ContactLaw, Law, Model, OperatingPoint, Solver, Term, Vectors};
//!
//! // K = diag(ω₁², ω₂²) + μ [[0, b], [-b, 0]], rad²/s²
//! let natural = Term { matrix: mat![[3.9e7, 0.0], [0.0, 4.1e7]], law: Law::Constant };
//! let friction = Term { matrix: mat![[0.0, 2e6], [-2e6, 0.0]], law: Law::FrictionStiffness };
//! let model = Model::new(2, vec![natural, friction], vec![], ContactLaw::default(), None)?;
//!
//! let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.6 };
//! let spectrum = Solver::new(model.dimension()).solve(&model, &p, Vectors::Both)?;
//! let growth_per_s = spectrum.roots.iter().map(|root| root.lambda.re).fold(f64::MIN, f64::max);
//! // λ² = -4e7 ± i √(1.2e6² - 1e6²)
//! assert!((growth_per_s - 52.4386).abs() < 1e-3);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Where instability begins
//!
//! A [`StabilityMap`](physics::StabilityMap) follows every root over the friction coefficient at one load and speed. It
//! gives modes their identities and holds the windows of instability. The two modes above merge at `μ = (ω₂² - ω₁²) / 2b`:
//!
//! ```
//! # use faer::mat;
//! # use squealcast_core::physics::{ContactLaw, Law, Model, OperatingPoint, Solver, Term};
//! use squealcast_core::physics::{MapOptions, StabilityMap};
//! # let natural = Term { matrix: mat![[3.9e7, 0.0], [0.0, 4.1e7]], law: Law::Constant };
//! # let friction = Term { matrix: mat![[0.0, 2e6], [-2e6, 0.0]], law: Law::FrictionStiffness };
//! # let model = Model::new(2, vec![natural, friction], vec![], ContactLaw::default(), None)?;
//! # let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.6 };
//! let options = MapOptions {
//!     mu_min: 0.0,
//!     mu_max: 1.0,
//!     band_max_hz: None,
//!     instability_threshold: 1e-6,
//!     windows: true,
//! };
//! let map = StabilityMap::build(&model, &mut Solver::new(model.dimension()), &p, &options)?;
//! let critical = map.critical_friction().expect("one window");
//! assert!((critical - 0.5).abs() < 1e-9);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Predictions in microseconds
//!
//! A [`Chart`](physics::Chart) holds the roots over a box of conditions as polynomials. It is built once and evaluated
//! without an eigenvalue solve; every evaluation is checked against the exact traces of the matrix:
//!
//! ```
//! # use faer::mat;
//! # use squealcast_core::physics::{ContactLaw, Law, Model, OperatingPoint, Term};
//! use squealcast_core::physics::Traces;
//! use squealcast_core::physics::chart::{Scratch, build::{ChartOptions, build}};
//! # let natural = Term { matrix: mat![[3.9e7, 0.0], [0.0, 4.1e7]], law: Law::Constant };
//! # let friction = Term { matrix: mat![[0.0, 2e6], [-2e6, 0.0]], law: Law::FrictionStiffness };
//! # let model = Model::new(2, vec![natural, friction], vec![], ContactLaw::default(), None)?;
//! # let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.6 };
//! let options = ChartOptions {
//!     low: OperatingPoint { friction_coefficient: 0.0, normal_load_n: 100.0, disc_speed_rad_s: 1.0 },
//!     high: OperatingPoint { friction_coefficient: 1.0, normal_load_n: 900.0, disc_speed_rad_s: 20.0 },
//!     band_max_hz: None,
//!     tolerance: 1e-8,
//!     smallest_share: 1e-3,
//!     max_solves: 1000,
//!     threads: 1,
//! };
//! let chart = build(&model, &options, &|_share_done| true)?;
//! let (traces, mut scratch, mut roots) = (Traces::new(&model), Scratch::default(), vec![]);
//! chart.evaluate(&p, traces.at(&model, &p), &mut scratch, &mut roots)?;
//! let growth_per_s = roots.iter().map(|root| root.lambda.re).fold(f64::MIN, f64::max);
//! assert!((growth_per_s - 52.4386).abs() < 1e-2);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # From sparse matrices to a model
//!
//! [`reduction`] makes a model of tens of coordinates from finite-element matrices. The lowest modes of a part, here of a
//! chain of 50 masses of 1 kg with springs of 1e6 N/m, whose `j`th frequency is `2 √(k/m) sin(jπ / 2n)`:
//!
//! ```
//! use faer::sparse::Triplet;
//! use squealcast_core::reduction::{SparseMatrix, lowest_modes};
//!
//! let n = 50;
//! let mass: Vec<_> = (0..n).map(|i| Triplet::new(i, i, 1.0)).collect();
//! let mut stiffness = vec![];
//! for i in 1..n {
//!     stiffness.extend([(i - 1, i - 1, 1e6), (i, i, 1e6), (i, i - 1, -1e6), (i - 1, i, -1e6)]);
//! }
//! let stiffness: Vec<_> = stiffness.into_iter().map(|(i, j, k)| Triplet::new(i, j, k)).collect();
//! let sparse = |entries: &[_]| SparseMatrix::try_new_from_triplets(n, n, entries).expect("entries within the matrix");
//!
//! let modes = lowest_modes("chain", &sparse(&mass), &sparse(&stiffness), 4)?;
//! let omega = |j: usize| 2e3 * (j as f64 * std::f64::consts::PI / (2 * n) as f64).sin();
//! assert!((modes.omega_squared[3].sqrt() / omega(3) - 1.0).abs() < 1e-9);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Where to go
//!
//! - [`physics`]: operating point, model, solver, stability map, window ends, sensitivities, chart
//! - [`contact`]: states of steady sliding of a contact that can open
//! - [`reduction`]: full models, their modes and roots, bases that hold over a range of conditions, comparison
//! - [`fem`]: brick elements and the reference tribometer
//! - `examples/predict_from_matrices.rs`: a model of modes and contact pairs, from matrices in memory
//! - `examples/reduce_sparse_matrices.rs`: a full model from sparse matrices, reduced and compared
//!
//! Matrices are those of the crate `faer`. The crate is pure: there is no file, clock, bus, log or serialisation in it or
//! in its dependency tree.

#![warn(missing_docs)]

mod chebyshev;
pub mod contact;
pub mod fem;
pub mod physics;
mod product;
#[cfg(any(test, feature = "proof"))]
pub mod proof;
pub mod reduction;
mod sampling;
#[cfg(test)]
mod spoil;
