//! Chebyshev expansions of the traces and norms of the matrices of a model with a contact state.
//!
//! Without a contact state, the traces at an operating point follow from the laws of the terms in a few operations. With
//! one, the state would have to be solved first, which takes longer than a charted prediction. The traces are therefore
//! expanded over boxes as well, but independently of the roots: from other points, from the matrices alone without an
//! eigenvalue problem, and with error bounds of their own. A root that is missing or counted twice is still detected.

use faer::Mat;

use super::pieces::Pieces;
use super::tree::{self, Branch};
use super::{Axis, MAX_AXES, NotCharted};
use crate::chebyshev::{nodes, polynomials, transform};
use crate::physics::model::Model;
use crate::physics::model_error::ModelError;
use crate::physics::operating_point::OperatingPoint;
use crate::physics::traces::Exact;
use crate::sampling::radical_inverse;

/// Number of expanded quantities: two sums of powers, and the norms of `C` and `K`.
const QUANTITIES: usize = 4;
/// Number of nodes along each axis, by the number of axes.
const NODES: [usize; MAX_AXES + 1] = [1, 17, 13, 9];
/// Largest number of nodes along an axis.
const MOST_NODES: usize = 17;
/// Largest estimated error of an expansion, relative to the quantity; of the first sum, to `|C|` if that is larger: the sum
/// of a gyroscopic matrix vanishes.
const TOLERANCE: f64 = 1e-10;
/// Factor by which error bounds exceed estimated errors.
const SAFETY: f64 = 4.0;
/// Number of points at which each expansion is checked.
const HELD_OUT: usize = 3;

/// Expansions over a box.
#[derive(Clone, Debug, PartialEq)]
struct Expanded {
    low: [f64; MAX_AXES],
    high: [f64; MAX_AXES],
    /// Products of Chebyshev polynomials, the first axis running fastest; one quantity after the other.
    coefficients: Vec<f64>,
    /// Error bounds of the two sums of powers.
    errors: [f64; 2],
}

/// The tree of boxes.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Totals {
    axes: usize,
    dimension: usize,
    branches: Vec<Branch>,
    leaves: Vec<Expanded>,
}

/// The model and the box of the expansions.
pub(super) struct Domain<'a> {
    pub model: &'a Model,
    pub axes: &'a [Axis],
    pub low: [f64; MAX_AXES],
    pub high: [f64; MAX_AXES],
    /// The conditions that have no axis are those of this point.
    pub base: OperatingPoint,
    /// Boxes with a smaller share of the coordinates are not split.
    pub smallest_share: f64,
}

impl Totals {
    /// Expands the totals of a model. `go_on` is called before every box; `None` once it returns false.
    pub fn build(domain: &Domain<'_>, go_on: &mut dyn FnMut() -> bool) -> Option<Self> {
        let (axes, dimension) = (domain.axes.len(), domain.model.dimension());
        let mut totals = Self { axes, dimension, branches: vec![Branch::Dense], leaves: vec![] };
        let mut open = vec![(0, domain.low, domain.high)];
        while let Some((slot, low, high)) = open.pop() {
            if !go_on() {
                return None;
            }
            totals.branches[slot] = match domain.expand(&low, &high) {
                Ok(leaf) => {
                    totals.leaves.push(leaf);
                    Branch::Leaf(totals.leaves.len() - 1)
                }
                Err(axis) if domain.share(&low, &high) > domain.smallest_share => {
                    let at = 0.5 * (low[axis] + high[axis]);
                    let (mut middle_low, mut middle_high) = (low, high);
                    (middle_low[axis], middle_high[axis]) = (at, at);
                    let below = totals.branches.len();
                    totals.branches.extend([Branch::Dense, Branch::Dense]);
                    open.extend([(below, low, middle_high), (below + 1, middle_low, high)]);
                    Branch::Split { axis, at, below, above: below + 1 }
                }
                Err(_) => Branch::Dense,
            };
        }
        Some(totals)
    }

    /// Number of axes.
    pub fn axes(&self) -> usize {
        self.axes
    }

    /// The totals at coordinates `x`.
    ///
    /// # Errors
    /// [`NotCharted::NotConverged`] where they are not expanded.
    pub fn at(&self, x: &[f64; MAX_AXES]) -> Result<Exact, NotCharted> {
        let leaf = &self.leaves[tree::find(&self.branches, x).ok_or(NotCharted::NotConverged)?];
        Ok(leaf.at(x, self.axes, self.dimension))
    }

    /// The complete content.
    pub fn words(&self) -> Vec<u64> {
        let mut words = vec![self.axes as u64, self.dimension as u64, self.branches.len() as u64];
        for branch in &self.branches {
            words.extend(branch.words());
        }
        words.push(self.leaves.len() as u64);
        for leaf in &self.leaves {
            let numbers = leaf.low.iter().chain(&leaf.high).chain(&leaf.errors).chain(&leaf.coefficients);
            words.extend(numbers.map(|number| number.to_bits()));
        }
        words
    }

    /// The totals of [`Self::words`]; `None` if the words do not describe any.
    pub fn from_words(words: &[u64]) -> Option<Self> {
        let number = |word: &u64| usize::try_from(*word).ok();
        let ([axes, dimension, count], mut words) = words.split_first_chunk::<3>()?;
        let (axes, dimension, count) = (number(axes)?, number(dimension)?, number(count)?);
        if axes == 0 || axes > MAX_AXES || count == 0 || count > words.len() / 4 {
            return None;
        }
        let mut branches = vec![];
        for k in 0..count {
            let (branch, rest) = words.split_first_chunk::<4>()?;
            words = rest;
            branches.push(Branch::from_words(*branch, k, count, axes)?);
        }
        let (leaf_count, mut words) = words.split_first()?;
        let size = 2 * MAX_AXES + 2 + QUANTITIES * NODES[axes].pow(axes as u32);
        if words.len() % size != 0 || words.len() / size != number(leaf_count)? {
            return None;
        }
        let mut leaves = vec![];
        while !words.is_empty() {
            let (leaf, rest) = words.split_at(size);
            words = rest;
            let numbers: Vec<f64> = leaf.iter().map(|word| f64::from_bits(*word)).collect();
            let corner = |from: usize| std::array::from_fn(|k| numbers[from + k]);
            leaves.push(Expanded {
                low: corner(0),
                high: corner(MAX_AXES),
                errors: [numbers[2 * MAX_AXES], numbers[2 * MAX_AXES + 1]],
                coefficients: numbers[2 * MAX_AXES + 2..].to_vec(),
            });
        }
        let known = branches.iter().all(|branch| branch.is_within(leaves.len()) && *branch != Branch::Pending);
        known.then_some(Self { axes, dimension, branches, leaves })
    }
}

impl Expanded {
    fn at(&self, x: &[f64; MAX_AXES], axes: usize, dimension: usize) -> Exact {
        let count = NODES[axes];
        let mut tables = [[0.0; MOST_NODES]; MAX_AXES];
        for (k, table) in tables[..axes].iter_mut().enumerate() {
            polynomials(2.0 * (x[k] - self.low[k]) / (self.high[k] - self.low[k]) - 1.0, &mut table[..count]);
        }
        let row = |coefficients: &[f64]| -> f64 { coefficients.iter().zip(&tables[0]).map(|(c, t)| c * t).sum() };
        let mut values = [0.0; QUANTITIES];
        for (value, coefficients) in values.iter_mut().zip(self.coefficients.chunks_exact(count.pow(axes as u32))) {
            for (index, coefficients) in coefficients.chunks_exact(count).enumerate() {
                let mut weight = row(coefficients);
                let mut left = index;
                for table in &tables[1..axes] {
                    weight *= table[left % count];
                    left /= count;
                }
                *value += weight;
            }
        }
        let [first, second, damping, stiffness] = values;
        let norms = [(dimension as f64).sqrt(), damping.max(0.0), stiffness.max(0.0)];
        Exact { powers: [first, second], norms, errors: self.errors }
    }
}

impl Domain<'_> {
    /// Share of all coordinates that lie in a box.
    fn share(&self, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES]) -> f64 {
        (0..self.axes.len()).map(|k| (high[k] - low[k]) / (self.high[k] - self.low[k])).product()
    }

    /// The quantities at coordinates `x`.
    fn quantities(&self, x: &[f64; MAX_AXES], matrices: &mut [Mat<f64>; 2]) -> Result<[f64; QUANTITIES], ModelError> {
        let mut p = self.base;
        self.axes.iter().zip(x).for_each(|(axis, &x)| axis.place(&mut p, x));
        let [stiffness, damping] = matrices;
        self.model.assemble(&p, stiffness, damping)?;
        let Exact { powers, norms, .. } = Exact::of(stiffness, damping, self.model.is_damped(&p));
        Ok([powers[0], powers[1], norms[1], norms[2]])
    }

    /// Expands over a box. The error is the axis to split along.
    fn expand(&self, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES]) -> Result<Expanded, usize> {
        let axes = self.axes.len();
        let width = |k: usize| (high[k] - low[k]) / (self.high[k] - self.low[k]);
        let longest = (0..axes).max_by(|&a, &b| width(a).total_cmp(&width(b))).unwrap_or(0);
        let pieces = Pieces::new(self.model, self.axes, self.base);
        if let Some(axis) = pieces.and_then(|pieces| pieces.broken(low, high, longest)) {
            return Err(axis);
        }
        let (count, points) = (NODES[axes], nodes(NODES[axes]));
        let all = count.pow(axes as u32);
        let place = |unit: [f64; MAX_AXES]| -> [f64; MAX_AXES] {
            std::array::from_fn(|k| if k < axes { low[k] + 0.5 * (unit[k] + 1.0) * (high[k] - low[k]) } else { 0.0 })
        };
        let n = self.model.dimension();
        let mut matrices = [Mat::zeros(n, n), Mat::zeros(n, n)];
        let mut values = vec![0.0; QUANTITIES * all];
        let mut largest = [0.0f64; QUANTITIES];
        for index in 0..all {
            let unit = std::array::from_fn(|k| points[index / count.pow(k as u32) % count]);
            let found = self.quantities(&place(unit), &mut matrices).map_err(|_| longest)?;
            for (k, value) in found.into_iter().enumerate() {
                values[k * all + index] = value;
                largest[k] = largest[k].max(value.abs());
            }
        }
        let [first, _, damping, _] = &mut largest;
        *first = first.max(*damping);
        transform(&mut values, count, axes);
        // Terms of the two highest degrees along an axis.
        let tail = |quantity: usize, axis: usize| -> f64 {
            let high = |index: &usize| index / count.pow(axis as u32) % count >= count - 2;
            (0..all).filter(high).map(|index| values[quantity * all + index].abs()).sum()
        };
        let rounding = 64.0 * f64::EPSILON * n as f64;
        let mut errors = [0.0; 2];
        let mut worst = (0.0, longest);
        for (quantity, &largest) in largest.iter().enumerate() {
            let missing: f64 = (0..axes).map(|axis| tail(quantity, axis)).sum();
            let limit = TOLERANCE * largest;
            if missing.is_nan() || missing > limit {
                let along = |axis: &usize| tail(quantity, *axis);
                let axis = (0..axes).max_by(|a, b| along(a).total_cmp(&along(b))).unwrap_or(longest);
                if missing.is_nan() || missing / limit > worst.0 {
                    worst = (missing / limit, axis);
                }
            }
            if let Some(error) = errors.get_mut(quantity) {
                *error = SAFETY * missing + rounding * largest;
            }
        }
        if worst.0 != 0.0 {
            return Err(worst.1);
        }
        let leaf = Expanded { low: *low, high: *high, coefficients: values, errors };
        for index in 1..=HELD_OUT {
            let unit = std::array::from_fn(|k| 2.0 * radical_inverse(index, [2, 3, 5][k]) - 1.0);
            let found = self.quantities(&place(unit), &mut matrices).map_err(|_| longest)?;
            let expanded = leaf.at(&place(unit), axes, n);
            if (0..2).any(|k| (expanded.powers[k] - found[k]).abs() > leaf.errors[k]) {
                return Err(longest);
            }
        }
        Ok(leaf)
    }
}
