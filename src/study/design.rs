//! Designs: which values the parameters have in each case. The point of a case depends on the design and the number of the
//! case alone, so shards of a study need no coordination.

use super::sobol::{DIMENSIONS, Dimension};
use crate::msgs::listed;
use crate::random::Random;

/// Most cases of a study.
pub const MOST_CASES: u64 = 10_000_000;
/// Most cases times parameters of a Latin hypercube, whose orders are held in memory, 4 bytes each.
pub const MOST_PLACES: u64 = 20_000_000;
/// Most parameters of a study.
pub const MOST_PARAMETERS: usize = DIMENSIONS;

listed! {
    /// A kind of design, as study files name it.
    #[derive(serde::Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum DesignKind {
        /// Every combination of the values of all parameters; the last parameter varies fastest.
        Grid,
        /// Each parameter has one value in each of as many equal stretches of its range as there are cases.
        LatinHypercube,
        /// The points of Sobol's sequence.
        Sobol,
    }
}

/// A place in the range of a parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Coordinate {
    /// The value of this index of a list of values.
    Listed(usize),
    /// The share of the range, from 0 to below 1.
    Share(f64),
}

/// The points of a study.
#[derive(Clone, Debug)]
pub enum Design {
    /// Number of values of each parameter.
    Grid(Vec<usize>),
    /// The order of the stretches of each parameter.
    LatinHypercube { seed: u64, orders: Vec<Vec<u32>> },
    /// The dimension of each parameter, and the digits that a seed changes.
    Sobol { dimensions: Vec<(Dimension, u32)>, cases: u64 },
}

/// Streams of a seed below this number give the order of each parameter, those from it on the places within the stretches.
const PLACES: u64 = 1 << 32;

impl Design {
    /// Latin hypercube of `cases` cases.
    pub fn latin_hypercube(cases: u64, parameters: usize, seed: u64) -> Self {
        let order = |parameter: usize| {
            let mut random = Random::stream(seed, parameter as u64);
            let mut order: Vec<u32> = (0..cases as u32).collect();
            // Fisher and Yates.
            for last in (1..order.len()).rev() {
                order.swap(last, (random.uniform() * (last + 1) as f64) as usize);
            }
            order
        };
        Self::LatinHypercube { seed, orders: (0..parameters).map(order).collect() }
    }

    /// The first `cases` points of Sobol's sequence; a seed shifts all of them by the same digits, which keeps them as even.
    /// `parameters` is at most [`MOST_PARAMETERS`].
    pub fn sobol(cases: u64, parameters: usize, seed: Option<u64>) -> Self {
        let shift = |parameter: usize| {
            seed.map_or(0, |seed| (Random::stream(seed, parameter as u64).uniform() * f64::from(u32::MAX)) as u32)
        };
        let dimensions = (0..parameters).filter_map(|number| Some((Dimension::new(number)?, shift(number)))).collect();
        Self::Sobol { dimensions, cases }
    }

    pub fn cases(&self) -> u64 {
        match self {
            Self::Grid(counts) => counts.iter().fold(1_u64, |product, &count| product.saturating_mul(count as u64)),
            Self::LatinHypercube { orders, .. } => orders.first().map_or(0, |order| order.len() as u64),
            Self::Sobol { cases, .. } => *cases,
        }
    }

    /// The place of each parameter in a case below [`Design::cases`].
    pub fn point(&self, case: u64) -> Vec<Coordinate> {
        match self {
            Self::Grid(counts) => {
                let mut rest = case;
                let listed = counts.iter().rev().map(|&count| {
                    let index = rest % count as u64;
                    rest /= count as u64;
                    Coordinate::Listed(index as usize)
                });
                let mut point: Vec<Coordinate> = listed.collect();
                point.reverse();
                point
            }
            Self::LatinHypercube { seed, orders } => {
                let mut places = Random::stream(*seed, PLACES + case);
                let share = |order: &Vec<u32>| {
                    let stretch = f64::from(order[case as usize]);
                    Coordinate::Share(below_one((stretch + places.uniform()) / order.len() as f64))
                };
                orders.iter().map(share).collect()
            }
            Self::Sobol { dimensions, .. } => {
                let share = |(dimension, shift): &(Dimension, u32)| {
                    Coordinate::Share(f64::from(dimension.digits(case as u32) ^ shift) / 4_294_967_296.0)
                };
                dimensions.iter().map(share).collect()
            }
        }
    }
}

fn below_one(share: f64) -> f64 {
    share.min(1.0 - f64::EPSILON)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shares(design: &Design, parameter: usize) -> Vec<f64> {
        let share = |case| match design.point(case)[parameter] {
            Coordinate::Share(share) => share,
            Coordinate::Listed(index) => panic!("index {index}"),
        };
        (0..design.cases()).map(share).collect()
    }

    #[test]
    fn a_grid_has_every_combination_and_its_last_parameter_varies_fastest() {
        let grid = Design::Grid(vec![2, 3]);
        let points: Vec<Vec<Coordinate>> = (0..grid.cases()).map(|case| grid.point(case)).collect();
        let expected: Vec<Vec<Coordinate>> =
            (0..2).flat_map(|a| (0..3).map(move |b| vec![Coordinate::Listed(a), Coordinate::Listed(b)])).collect();
        assert_eq!(points, expected);
    }

    #[test]
    fn a_latin_hypercube_has_one_case_in_each_stretch_of_each_parameter() {
        let design = Design::latin_hypercube(100, 3, 7);
        for parameter in 0..3 {
            let mut stretches: Vec<usize> = shares(&design, parameter).iter().map(|u| (100.0 * u) as usize).collect();
            assert!(!stretches.is_sorted(), "in another order");
            stretches.sort_unstable();
            assert_eq!(stretches, (0..100).collect::<Vec<usize>>());
        }
        assert_ne!(shares(&design, 0), shares(&design, 1));
        assert_ne!(shares(&design, 0), shares(&Design::latin_hypercube(100, 3, 8), 0));
        assert_eq!(shares(&design, 0), shares(&Design::latin_hypercube(100, 3, 7), 0));
    }

    #[test]
    fn a_seed_shifts_sobol_points_and_keeps_one_in_each_stretch() {
        let (plain, shifted) = (Design::sobol(64, 2, None), Design::sobol(64, 2, Some(1)));
        assert_eq!(shares(&plain, 0)[..4], [0.0, 0.5, 0.75, 0.25]);
        let mut stretches: Vec<usize> = shares(&shifted, 1).iter().map(|u| (64.0 * u) as usize).collect();
        assert_ne!(shares(&plain, 1), shares(&shifted, 1));
        stretches.sort_unstable();
        assert_eq!(stretches, (0..64).collect::<Vec<usize>>());
    }
}
