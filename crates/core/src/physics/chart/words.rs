//! Serialisation of a chart as 64-bit words, for storing, comparing and hashing.

use super::cluster::MAX_SIZE;
use super::fit::Basis;
use super::lateral::Speeds;
use super::totals::Totals;
use super::{Axis, Branch, Channels, Chart, Cluster, Leaf, MAX_AXES, REMAINDERS};

/// Format version: incremented when the meaning of the words or the result of a build changes.
pub const FORMAT: u64 = 8;

/// The source files that determine the result of a build. Stored charts are keyed by them, so a chart of an older
/// builder is never used.
pub const BUILDER: [&str; 41] = [
    include_str!("build.rs"),
    include_str!("channels.rs"),
    include_str!("cluster.rs"),
    include_str!("derivatives.rs"),
    include_str!("fit.rs"),
    include_str!("lateral.rs"),
    include_str!("leaf.rs"),
    include_str!("mod.rs"),
    include_str!("pairing.rs"),
    include_str!("pieces.rs"),
    include_str!("samples.rs"),
    include_str!("totals.rs"),
    include_str!("tree.rs"),
    include_str!("words.rs"),
    include_str!("../decoupled.rs"),
    include_str!("../dense_eigen.rs"),
    include_str!("../flexible_contact.rs"),
    include_str!("../law.rs"),
    include_str!("../model.rs"),
    include_str!("../model_error.rs"),
    include_str!("../operating_point.rs"),
    include_str!("../solver.rs"),
    include_str!("../spectrum.rs"),
    include_str!("../steady_contact.rs"),
    include_str!("../stribeck.rs"),
    include_str!("../traces.rs"),
    include_str!("../../contact/anchors.rs"),
    include_str!("../../contact/equations.rs"),
    include_str!("../../contact/factors.rs"),
    include_str!("../../contact/law.rs"),
    include_str!("../../contact/mod.rs"),
    include_str!("../../contact/newton.rs"),
    include_str!("../../contact/path.rs"),
    include_str!("../../contact/response.rs"),
    include_str!("../../contact/shape.rs"),
    include_str!("../../contact/spline.rs"),
    include_str!("../../contact/statics.rs"),
    include_str!("../tracking.rs"),
    include_str!("../../chebyshev.rs"),
    include_str!("../../product.rs"),
    include_str!("../../sampling.rs"),
];

const AXES: [Axis; 5] = [Axis::Friction, Axis::Load, Axis::Speed, Axis::LoadOverSpeed, Axis::LateralDamping];

impl Chart {
    /// The complete content of the chart: charts with equal words give equal predictions.
    pub fn words(&self) -> Vec<u64> {
        let mut words = vec![FORMAT, u64::from(self.undamped), self.solves as u64, self.axes.len() as u64];
        words.extend(self.axes.iter().map(|axis| *axis as u64));
        words.push(self.basis.degree() as u64);
        words.extend(self.low.iter().chain(&self.high).map(|x| x.to_bits()));
        words.extend(self.speeds.iter().flat_map(|speeds| [speeds.low, speeds.high]).map(f64::to_bits));
        words.push(self.branches.len() as u64);
        for branch in &self.branches {
            words.extend(branch.words());
        }
        words.push(self.leaves.len() as u64);
        for leaf in &self.leaves {
            let numbers = leaf.low.iter().chain(&leaf.high).chain(&leaf.remainder_errors);
            words.extend(numbers.map(|x| x.to_bits()));
            for channels in [&leaf.functions, &leaf.auxiliary] {
                words.extend(channels.widths.iter().map(|&width| width as u64));
            }
            words.extend([leaf.tracked as u64, leaf.clusters.len() as u64]);
            for cluster in &leaf.clusters {
                let share = cluster.share.map_or(0, |share| share as u64 + 1);
                words.extend([cluster.size() as u64, cluster.channel as u64, share]);
                words.extend(cluster.errors.iter().map(|error| error.to_bits()));
            }
            let coefficients = leaf.functions.coefficients.iter().chain(&leaf.auxiliary.coefficients);
            words.extend(coefficients.map(|x| x.to_bits()));
        }
        words.extend(self.totals.iter().flat_map(Totals::words));
        words
    }

    /// The chart of [`Chart::words`]; `None` if the words do not describe a chart.
    pub fn from_words(words: &[u64]) -> Option<Self> {
        let mut words = Reader(words);
        if words.next()? != FORMAT {
            return None;
        }
        let (undamped, solves) = (words.next()? != 0, words.count(usize::MAX)?);
        let axes: Vec<Axis> = (0..words.count(MAX_AXES)?).map(|_| words.axis()).collect::<Option<_>>()?;
        let basis = Basis::for_axes(axes.len());
        if words.count(usize::MAX)? != basis.degree() {
            return None;
        }
        let (low, high) = (words.numbers()?, words.numbers()?);
        let speeds = match axes.contains(&Axis::LateralDamping) {
            true => Some(Speeds { low: words.number()?, high: words.number()? }),
            false => None,
        };
        let count = words.count(words.0.len())?;
        let branches: Vec<Branch> = (0..count).map(|k| words.branch(k, count, axes.len())).collect::<Option<_>>()?;
        let leaves: Vec<Leaf> =
            (0..words.count(words.0.len())?).map(|_| words.leaf(&basis, undamped)).collect::<Option<_>>()?;
        let known = branches.iter().all(|branch| branch.is_within(leaves.len()));
        let totals = match words.0 {
            [] => None,
            words => Some(Totals::from_words(words).filter(|totals| totals.axes() == axes.len())?),
        };
        let whole = known && count > 0;
        whole.then_some(Self { axes, low, high, speeds, basis, branches, leaves, undamped, solves, totals })
    }
}

/// The words not read yet.
struct Reader<'a>(&'a [u64]);

impl Reader<'_> {
    fn next(&mut self) -> Option<u64> {
        let (&first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(first)
    }

    fn count(&mut self, most: usize) -> Option<usize> {
        usize::try_from(self.next()?).ok().filter(|&count| count <= most)
    }

    fn number(&mut self) -> Option<f64> {
        self.next().map(f64::from_bits)
    }

    fn numbers<const N: usize>(&mut self) -> Option<[f64; N]> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.number()?;
        }
        Some(numbers)
    }

    fn axis(&mut self) -> Option<Axis> {
        AXES.get(self.count(AXES.len())?).copied()
    }

    fn branch(&mut self, k: usize, count: usize, axes: usize) -> Option<Branch> {
        Branch::from_words([self.next()?, self.next()?, self.next()?, self.next()?], k, count, axes)
    }

    fn leaf(&mut self, basis: &Basis, undamped: bool) -> Option<Leaf> {
        let (low, high, remainder_errors) = (self.numbers()?, self.numbers()?, self.numbers()?);
        let (functions, auxiliary) = (self.widths(basis)?, self.widths(basis)?);
        if auxiliary[0] < REMAINDERS {
            return None;
        }
        let tracked = self.count(usize::MAX)?;
        let count = self.count(self.0.len())?;
        let clusters = (0..count).map(|_| self.cluster(functions[0], auxiliary[0], undamped)).collect::<Option<_>>()?;
        let (functions, auxiliary) = (self.channels(basis, functions)?, self.channels(basis, auxiliary)?);
        Some(Leaf { low, high, clusters, tracked, functions, auxiliary, remainder_errors })
    }

    fn widths(&mut self, basis: &Basis) -> Option<Vec<usize>> {
        let most = self.0.len();
        let widths: Vec<usize> = (0..=basis.degree()).map(|_| self.count(most)).collect::<Option<_>>()?;
        widths.windows(2).all(|pair| pair[0] >= pair[1]).then_some(widths)
    }

    fn channels(&mut self, basis: &Basis, widths: Vec<usize>) -> Option<Channels> {
        let count: usize = widths.iter().enumerate().map(|(degree, width)| basis.of_degree(degree).len() * width).sum();
        if count > self.0.len() {
            return None;
        }
        let coefficients = (0..count).map(|_| self.number()).collect::<Option<_>>()?;
        Some(Channels { widths, coefficients })
    }

    fn cluster(&mut self, functions: usize, auxiliary: usize, undamped: bool) -> Option<Cluster> {
        let size = self.count(MAX_SIZE)?;
        let channel = self.count(functions)?;
        let share = self.count(auxiliary)?.checked_sub(1);
        let errors = (0..size).map(|_| self.number()).collect::<Option<_>>()?;
        let parts = if undamped { 1 } else { 2 };
        (size > 0 && channel + size * parts <= functions).then_some(Cluster { channel, errors, share })
    }
}
