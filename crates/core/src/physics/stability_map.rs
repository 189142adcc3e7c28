//! Stability map: the roots followed over the friction coefficient at one load and speed. Its nodes are dense enough
//! that every root keeps its identity and that no window of instability wider than the stated resolution is missed
//! between two nodes.

use faer::c64;

use super::critical::{self, Window};
use super::ends::{Ends, NearestEnd};
use super::model::Model;
use super::model_error::ModelError;
use super::numbering::Numbering;
use super::operating_point::OperatingPoint;
use super::solver::Solver;
use super::spectrum::{SolveError, Spectrum, Vectors};
use super::steady_contact::Jumps;
use super::tracking::{Continuation, continue_roots, tracked};

/// Number of equal intervals the range of friction coefficients is divided into before refinement.
const FIRST_INTERVALS: usize = 32;
/// Maximum number of halvings: the resolution is `range / 2^20`.
const HALVINGS: i32 = 20;
/// Maximum number of nodes; if refinement would need more, the map is marked incomplete.
const MAX_NODES: usize = 20_000;

/// Range and options of a stability map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapOptions {
    /// Lowest friction coefficient, at most 0 because identities are assigned at 0.
    pub mu_min: f64,
    /// Highest friction coefficient, at least 0.
    pub mu_max: f64,
    /// Upper limit of the band, Hz: modes above it are followed but not judged.
    pub band_max_hz: Option<f64>,
    /// A root is unstable if `σ` exceeds this times `|λ|`.
    pub instability_threshold: f64,
    /// Whether to compute the windows and their ends. Without them the identities are the same, from fewer solves.
    pub windows: bool,
}

/// Why a map could not be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MapError {
    /// A solve failed.
    #[error("at friction coefficient {mu}: {source}")]
    Solve {
        /// The friction coefficient.
        mu: f64,
        /// Why.
        source: SolveError,
    },
    /// The range is not finite or does not contain 0.
    #[error("friction coefficients {mu_min}..{mu_max}: expected a finite range that contains 0")]
    Range {
        /// Lowest friction coefficient.
        mu_min: f64,
        /// Highest friction coefficient.
        mu_max: f64,
    },
}

/// A solved point of the map.
#[derive(Clone, Debug)]
pub struct Node {
    /// The spectrum, with friction sensitivities.
    pub spectrum: Spectrum,
    /// Identity of each root; `None` for the static roots of a damped model, which are not followed.
    pub ids: Vec<Option<u32>>,
}

impl Node {
    /// The friction coefficient of the node.
    pub fn mu(&self) -> f64 {
        self.spectrum.point.friction_coefficient
    }

    /// Index of the root with identity `id`.
    pub fn find(&self, id: u32) -> Option<usize> {
        self.ids.iter().position(|&other| other == Some(id))
    }
}

/// The roots and windows of instability of a rig over the friction coefficient, at one load and speed.
#[derive(Clone, Debug)]
pub struct StabilityMap {
    /// Load and speed of the map; the friction coefficient is not used.
    pub point: OperatingPoint,
    /// Solved points, ascending in friction coefficient.
    pub nodes: Vec<Node>,
    pub(super) numbering: Numbering,
    /// Upper limit of the band, Hz: modes above it are followed but not judged.
    pub(super) band_max_hz: Option<f64>,
    /// Windows of instability, ascending in their lower end; empty unless requested.
    pub windows: Vec<Window>,
    /// Ends of the windows, with their derivatives with respect to load and speed.
    pub ends: Ends,
    /// Windows narrower than this in friction coefficient may be missed.
    pub resolution: f64,
    /// False if refinement stopped at the maximum number of nodes.
    pub complete: bool,
    /// Where steady sliding ends inside the range; the map ends there.
    pub sliding_ends: Option<SlidingEnd>,
}

/// The friction coefficient beyond which a contact has no state of steady sliding.
#[derive(Clone, Debug, PartialEq)]
pub struct SlidingEnd {
    /// The largest friction coefficient that has a state, to the resolution of the map.
    pub mu: f64,
    /// Why there is none beyond it.
    pub reason: ModelError,
}

/// The window of instability whose end is nearest to the present friction coefficient: the one that squeals, or
/// would squeal next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NextWindow<'a> {
    /// The window, with the identities of its modes (a merging pair or a single mode) and its kind.
    pub window: &'a Window,
    /// Frequency at the nearest end, at the load and speed of the map, Hz; 0 for divergence.
    pub frequency_hz: f64,
    /// The nearest end: its friction coefficient, the margin and the error bound of both.
    pub end: NearestEnd,
}

impl StabilityMap {
    /// Maps `model` at the load and speed of `point`.
    ///
    /// # Errors
    /// [`MapError::Range`], [`MapError::Solve`].
    pub fn build(
        model: &Model,
        solver: &mut Solver,
        point: &OperatingPoint,
        options: &MapOptions,
    ) -> Result<Self, MapError> {
        let mut map = Self::of_windows(model, solver, point, options)?;
        if options.windows {
            map.ends = Ends::of_map(model, solver, &map)?;
        }
        Ok(map)
    }

    /// The same without [`Self::ends`], whose derivatives need further solves.
    ///
    /// # Errors
    /// Those of [`Self::build`].
    pub fn of_windows(
        model: &Model,
        solver: &mut Solver,
        point: &OperatingPoint,
        options: &MapOptions,
    ) -> Result<Self, MapError> {
        let MapOptions { mu_min, mu_max, .. } = *options;
        if !(mu_min.is_finite() && mu_max.is_finite() && mu_min <= 0.0 && mu_max >= 0.0) {
            return Err(MapError::Range { mu_min, mu_max });
        }
        let grid = first_grid(mu_min, mu_max, FIRST_INTERVALS);
        let resolution = (mu_max - mu_min) * 0.5f64.powi(HALVINGS);
        let (grid, sliding_ends) = with_states(model, point, grid, resolution)?;
        let mut solve = |mu: f64| {
            let result = solver.solve(model, &point.with_friction(mu), Vectors::Both);
            result.map_err(|source| MapError::Solve { mu, source })
        };
        let mut ahead: Vec<Spectrum> = grid.into_iter().rev().map(&mut solve).collect::<Result<_, _>>()?;
        let mut spectra = Vec::with_capacity(ahead.len());
        let mut links: Vec<Continuation> = vec![];
        let mut complete = true;
        spectra.extend(ahead.pop());
        while let (Some(left), Some(right)) = (spectra.last(), ahead.last()) {
            let (from, to) = (left.point.friction_coefficient, right.point.friction_coefficient);
            let link = continue_roots(left, right);
            let jumps = Jumps::between(model, left, right);
            let resolved = link.clear && critical::is_resolved(left, right, &link, &jumps, options);
            let full = spectra.len() + ahead.len() >= MAX_NODES;
            if resolved || to - from <= resolution || full {
                complete &= resolved || !full;
                links.push(link);
                spectra.extend(ahead.pop());
            } else {
                ahead.push(solve(0.5 * (from + to))?);
            }
        }
        let nodes = identify_all(spectra, &links);
        let ends = Ends { point: *point, windows: vec![] };
        let (numbering, band_max_hz) = (Numbering::new(&nodes), options.band_max_hz);
        let (point, windows) = (*point, vec![]);
        let mut map = Self { point, nodes, numbering, band_max_hz, windows, ends, resolution, complete, sliding_ends };
        if options.windows {
            map.windows = critical::windows(model, solver, &map, options)?;
        }
        Ok(map)
    }

    /// Identities of the roots of `spectrum`, assigned by shape. `spectrum` must be solved at the map's load and
    /// speed or close to them. The search for window ends uses them to follow a pair; modes that are shown get their
    /// identities from [`StabilityMap::ids`].
    pub(crate) fn identify(&self, spectrum: &Spectrum) -> Vec<Option<u32>> {
        let mu = spectrum.point.friction_coefficient;
        let after = self.nodes.partition_point(|node| node.mu() < mu);
        let nearest = match (after.checked_sub(1).and_then(|k| self.nodes.get(k)), self.nodes.get(after)) {
            (Some(left), Some(right)) => Some(if mu - left.mu() <= right.mu() - mu { left } else { right }),
            (left, right) => left.or(right),
        };
        match nearest {
            Some(node) if node.spectrum.undamped == spectrum.undamped => continued_ids(node, spectrum),
            _ => (0..spectrum.roots.len() as u32).map(Some).collect(),
        }
    }

    /// The window that contains the friction coefficient of `point`, or the nearest one, with its nearest end. `ends`
    /// are the ends of this map's windows, at the map's load and speed or carried to those of `point`. `None` if
    /// there are no windows.
    pub fn next_window(&self, ends: &Ends, point: &OperatingPoint) -> Option<NextWindow<'_>> {
        let end = ends.nearest(point)?;
        let window = self.windows.get(end.window)?;
        let frequency_hz = if end.is_start { window.frequency_hz } else { window.frequency_to_hz.unwrap_or(f64::NAN) };
        Some(NextWindow { window, frequency_hz, end })
    }

    /// The smallest friction coefficient at which a window begins.
    pub fn critical_friction(&self) -> Option<f64> {
        self.windows.iter().map(|window| window.mu_from).reduce(f64::min)
    }

    /// The bits of every number a prediction can depend on: maps with equal words give equal predictions.
    pub fn words(&self) -> Vec<u64> {
        let mut words = vec![];
        for node in &self.nodes {
            words.push(node.mu().to_bits());
            for (root, id) in node.spectrum.roots.iter().zip(&node.ids) {
                words.extend([root.lambda.re.to_bits(), root.lambda.im.to_bits(), id.map_or(u64::MAX, u64::from)]);
            }
        }
        for window in &self.windows {
            words.extend([window.mu_from.to_bits(), window.mu_to.map_or(u64::MAX, f64::to_bits)]);
        }
        words.extend(self.sliding_ends.iter().map(|end| end.mu.to_bits()));
        words.extend(self.ends.words());
        words
    }
}

/// The friction coefficients of the initial nodes, ascending: an equidistant grid to which 0 is added.
fn first_grid(mu_min: f64, mu_max: f64, intervals: usize) -> Vec<f64> {
    let step = (mu_max - mu_min) / intervals as f64;
    let mut grid: Vec<f64> = (0..=intervals).map(|k| mu_min + step * k as f64).collect();
    grid[intervals] = mu_max;
    grid.push(0.0);
    grid.sort_by(f64::total_cmp);
    grid.dedup_by(|a, b| (*a - *b).abs() < 1e-9 * step);
    // Removing duplicates keeps the first of two nearly equal values, but the grid must contain 0 exactly.
    grid.iter_mut().filter(|mu| mu.abs() < 1e-9 * step).for_each(|mu| *mu = 0.0);
    grid.dedup();
    grid
}

/// The values of an ascending `grid` up to the first one without a state of steady sliding; the last one is then where
/// the states end, to the `resolution`.
fn with_states(
    model: &Model,
    point: &OperatingPoint,
    mut grid: Vec<f64>,
    resolution: f64,
) -> Result<(Vec<f64>, Option<SlidingEnd>), MapError> {
    if model.statics().is_none() {
        return Ok((grid, None));
    }
    let failed = |mu: f64| model.at(&point.with_friction(mu)).err();
    let Some((first, mut reason)) = grid.iter().enumerate().find_map(|(k, &mu)| Some((k, failed(mu)?))) else {
        return Ok((grid, None));
    };
    let (mut sound, mut without) = match first.checked_sub(1) {
        Some(before) if grid[first] > 0.0 => (grid[before], grid[first]),
        _ => return Err(MapError::Solve { mu: grid[first], source: reason.into() }),
    };
    while without - sound > resolution {
        let middle = 0.5 * (sound + without);
        match failed(middle) {
            Some(error) => (without, reason) = (middle, error),
            None => sound = middle,
        }
    }
    grid.truncate(first);
    if grid.last().is_some_and(|&last| last < sound) {
        grid.push(sound);
    }
    Ok((grid, Some(SlidingEnd { mu: sound, reason })))
}

/// Numbers the roots at friction coefficient 0 and carries the identities along the links in both directions.
fn identify_all(spectra: Vec<Spectrum>, links: &[Continuation]) -> Vec<Node> {
    let start = spectra.iter().position(|s| s.point.friction_coefficient == 0.0).unwrap_or(0);
    let mut nodes: Vec<Node> =
        spectra.into_iter().map(|spectrum| Node { ids: vec![None; spectrum.roots.len()], spectrum }).collect();
    let Some(first) = nodes.get_mut(start) else { return nodes };
    let count = tracked(&first.spectrum);
    (0..count).for_each(|k| first.ids[k] = Some(k as u32));
    let mut next_id = count as u32;
    for k in start + 1..nodes.len() {
        let (before, after) = nodes.split_at_mut(k);
        let (from, to) = (&before[k - 1], &mut after[0]);
        to.ids = carry(from, &to.spectrum, |j| links[k - 1].source[j], &mut next_id);
    }
    for k in (0..start).rev() {
        let (before, after) = nodes.split_at_mut(k + 1);
        let (to, from) = (&mut before[k], &after[0]);
        let target = &links[k].source;
        to.ids = carry(from, &to.spectrum, |j| target.iter().position(|&source| source == Some(j)), &mut next_id);
    }
    nodes
}

/// Identities of the roots of `to`, continued from those of `from`. A root that continues none gets the next unused
/// number.
fn carry(from: &Node, to: &Spectrum, source: impl Fn(usize) -> Option<usize>, next_id: &mut u32) -> Vec<Option<u32>> {
    let mut ids: Vec<Option<u32>> = vec![None; to.roots.len()];
    for (j, id) in ids.iter_mut().enumerate().take(tracked(to)) {
        *id = source(j).and_then(|i| from.ids[i]);
        if id.is_none() {
            *id = Some(*next_id);
            *next_id += 1;
        }
    }
    settle_pairs(from, to, &mut ids);
    ids
}

/// Identities of the roots of `spectrum`, continued from those of `node` by shape.
fn continued_ids(node: &Node, spectrum: &Spectrum) -> Vec<Option<u32>> {
    let link = continue_roots(&node.spectrum, spectrum);
    // Roots that continue no root of the map get numbers that no root of the map has.
    let mut next_id = node.ids.iter().flatten().max().map_or(0, |id| id + 1_000_000);
    carry(node, spectrum, |j| link.source[j], &mut next_id)
}

/// Orders the two identities of a pair. After a merging point they cannot be distinguished by shape: while the pair is
/// coupled, the growing mode gets the lower identity; once the pair has separated, the lower frequency gets it.
fn settle_pairs(from: &Node, to: &Spectrum, ids: &mut [Option<u32>]) {
    for j in 0..tracked(to) {
        let Some(partner) = mirror(to, j).filter(|&partner| partner > j) else { continue };
        let was_coupled = ids[j].and_then(|id| from.find(id)).is_some_and(|i| mirror(&from.spectrum, i).is_some());
        let growing_is_lower = (to.roots[j].lambda.re > 0.0) == (ids[j] < ids[partner]);
        if !was_coupled && !growing_is_lower {
            ids.swap(j, partner);
        }
    }
    for i in 0..tracked(&from.spectrum) {
        let Some(partner) = mirror(&from.spectrum, i).filter(|&partner| partner > i) else { continue };
        let at = |k: usize| from.ids[k].and_then(|id| ids.iter().position(|&other| other == Some(id)));
        let (Some(a), Some(b)) = (at(i), at(partner)) else { continue };
        let separated = mirror(to, a).is_none() && mirror(to, b).is_none();
        if separated && (to.roots[a].lambda.im < to.roots[b].lambda.im) != (ids[a] < ids[b]) {
            ids.swap(a, b);
        }
    }
}

/// The mirror image `-λ̄` of root `j` at the imaginary axis: the other member of an undamped flutter pair.
pub(crate) fn mirror(spectrum: &Spectrum, j: usize) -> Option<usize> {
    let root = spectrum.roots[j];
    if !root.oscillates() || root.lambda.re == 0.0 {
        return None;
    }
    let image = c64::new(-root.lambda.re, root.lambda.im);
    let near = 1e-9 * root.lambda.norm();
    (0..spectrum.mode_count)
        .find(|&k| k != j && (spectrum.roots[k].lambda - image).norm() <= near.min(root.lambda.re.abs()))
}
