//! What a parametric basis must fulfil, and the progress of its construction.

use super::super::FullProgress;
use super::super::matching::Counted;
use super::super::operating_box::OperatingBox;
use crate::physics::OperatingPoint;

/// Requirements of a parametric basis.
#[derive(Clone, Debug)]
pub struct ParametricRequest {
    /// Box of operating points over which the basis must be valid.
    pub range: OperatingBox,
    /// Which roots must meet the tolerance.
    pub counted: Counted,
    /// Largest `|Δλ|/|λ|` of a counted root.
    pub tolerance: f64,
    /// Number of training points, at which the error is estimated, in addition to the corners and the middle of the
    /// box.
    pub training: usize,
    /// Number of further points at which a smaller basis must hold the roots of the sampled vectors. No solve of the full
    /// model is needed there.
    pub cutting: usize,
    /// Number of held-out points for validation.
    pub held_out: usize,
    /// Largest number of sampled points.
    pub most_samples: usize,
    /// Largest number of vectors in the basis.
    pub most_vectors: usize,
}

/// Progress of the construction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ParametricStep {
    /// Estimated bytes needed in addition to the memory in use before the solver was made.
    Planned {
        /// The bytes.
        bytes: usize,
    },
    /// Progress of a solve of the full model.
    Solving(FullProgress),
    /// The error has been estimated at `done` of `of` training points.
    Estimating {
        /// Number of points done.
        done: usize,
        /// Number of points in all.
        of: usize,
    },
    /// A solve of the full model at a sampled point starts.
    Sampling {
        /// The sampled point.
        point: OperatingPoint,
        /// Its number, from 1.
        sample: usize,
    },
    /// The sampled point has `roots` roots within band and growth floor, margins included, and the span now has
    /// `vectors` vectors. `true_over_estimate` is the largest ratio of true error to estimate at this point; NaN
    /// without estimates.
    Sampled {
        /// Number of roots.
        roots: usize,
        /// Number of vectors of the span.
        vectors: usize,
        /// Largest ratio of true error to estimate.
        true_over_estimate: f64,
    },
    /// The error has been estimated at all training points. `worst` is the largest scaled estimate of `|Δλ|/|λ|`.
    Estimated {
        /// Largest estimate, relative.
        worst: f64,
        /// Number of vectors of the span.
        vectors: usize,
    },
    /// A basis of `vectors` leading vectors has the error `worst` at the training and cutting points.
    Cut {
        /// Number of vectors kept.
        vectors: usize,
        /// Largest estimate with them, relative.
        worst: f64,
    },
    /// A held-out point, the `done`th of `of`, was solved and compared.
    HeldOut {
        /// The held-out point.
        point: OperatingPoint,
        /// Largest error there, relative.
        worst: f64,
        /// Number of points done.
        done: usize,
        /// Number of points in all.
        of: usize,
    },
}
