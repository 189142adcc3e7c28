//! Windows of instability in the friction coefficient, with ends accurate to 1e-10.
//!
//! The end of a coalescence is found on the discriminant of its pair, `d = ((λ₁² - λ₂²)/2)²`. The discriminant is
//! analytic and crosses zero with a nonzero slope; the growth rate starts like a square root there, so its zero would
//! depend on the threshold. For a damped mode the zero of `σ` itself is found. A static root crosses `λ² = 0`, in a
//! damped model `λ = 0`.

use std::collections::BTreeMap;

use faer::c64;

use super::model::Model;
use super::solver::Solver;
use super::spectrum::{Root, Spectrum, Vectors};
use super::stability_map::{MapError, MapOptions, Node, StabilityMap, mirror};
use super::steady_contact::Jumps;
use super::tracking::{Continuation, tracked};

/// Cause of an instability.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum WindowKind {
    /// Two undamped modes merge and one of the two grows (flutter).
    Coalescence,
    /// The growth rate of a damped mode crosses zero.
    ZeroGrowth,
    /// A static root grows (divergence).
    Divergence,
}

impl WindowKind {
    /// Name of the kind in output.
    pub fn name(self) -> &'static str {
        match self {
            Self::Coalescence => "coalescence",
            Self::ZeroGrowth => "zero_growth",
            Self::Divergence => "divergence",
        }
    }
}

/// An interval of the friction coefficient in which a mode or a pair of modes is unstable.
#[derive(Clone, Debug, PartialEq)]
pub struct Window {
    /// Identities: the pair of a coalescence; the mode of a zero growth; the root of a divergence, or empty if static
    /// roots are not followed.
    pub mode_ids: Vec<u32>,
    /// Friction coefficient at which it begins.
    pub mu_from: f64,
    /// Friction coefficient at which it ends; `None` if it is still open at the upper end of the range.
    pub mu_to: Option<f64>,
    /// Frequency at its lower end, Hz; 0 for divergence.
    pub frequency_hz: f64,
    /// Frequency at its upper end, Hz; `None` if it is still open at the upper end of the range.
    pub frequency_to_hz: Option<f64>,
    /// The cause of the instability.
    pub kind: WindowKind,
}

/// Number of points inside an interval at which an interpolated quantity is sampled.
const SAMPLES: usize = 9;
/// An interval is free of merging if the interpolated discriminant keeps at least this share of its smaller end
/// value.
const CLEARANCE: f64 = 0.25;

/// Whether the interval between two neighbouring spectra hides nothing: no pair merges without the ends showing it,
/// and no growth rate crosses its threshold and returns.
///
/// Pair discriminants and growth rates are interpolated by cubics through values and sensitivities at both ends. Where
/// contact pairs open or close in the interval, roots jump: see [`Jumps`].
pub(super) fn is_resolved(
    left: &Spectrum,
    right: &Spectrum,
    link: &Continuation,
    jumps: &Jumps,
    options: &MapOptions,
) -> bool {
    let step = right.point.friction_coefficient - left.point.friction_coefficient;
    let branches: Vec<(usize, usize)> = (0..tracked(right))
        .filter_map(|j| link.source[j].map(|i| (i, j)))
        .filter(|&(i, j)| is_judged(&left.roots[i], options) || is_judged(&right.roots[j], options))
        .collect();
    let no_hidden_growth = |&(i, j): &(usize, usize)| {
        left.undamped || growth_is_resolved(left, i, right, j, step, options.instability_threshold, jumps.of(i, j))
    };
    branches.iter().all(|branch| partner_is_kept(left, right, branch, link))
        && branches.iter().all(no_hidden_growth)
        && branches.iter().enumerate().all(|(k, &first)| {
            branches[..k].iter().all(|&second| pair_is_resolved(left, right, first, second, step, jumps))
        })
}

/// Whether the partner of a branch changes at most once within the interval. A coupled pair may separate or two
/// single roots may merge. A change from one partner to another takes a separation and a merging, which must lie in
/// different intervals.
fn partner_is_kept(left: &Spectrum, right: &Spectrum, &(i, j): &(usize, usize), link: &Continuation) -> bool {
    let before = mirror(left, i);
    let after = mirror(right, j).map(|partner| link.source[partner]);
    match (before, after) {
        (None, None) => true,
        (Some(before), Some(after)) => after == Some(before),
        // They merged: the partner must have been single too.
        (None, Some(after)) => after.is_some_and(|after| mirror(left, after).is_none()),
        // They separated: the partner must be single now too.
        (Some(before), None) => {
            let now = link.source.iter().position(|&source| source == Some(before));
            now.is_some_and(|now| mirror(right, now).is_none())
        }
    }
}

/// Whether the frequency of a root lies in the band.
fn is_judged(root: &Root, options: &MapOptions) -> bool {
    options.band_max_hz.is_none_or(|max_hz| root.frequency_hz() <= max_hz)
}

/// Whether two branches stay far apart, or their interpolated discriminant stays away from zero or crosses it exactly
/// once.
fn pair_is_resolved(
    left: &Spectrum,
    right: &Spectrum,
    first: (usize, usize),
    second: (usize, usize),
    step: f64,
    jumps: &Jumps,
) -> bool {
    let ends = [(left, first.0, second.0), (right, first.1, second.1)];
    let jump = jumps.of(first.0, first.1) + jumps.of(second.0, second.1);
    let far = |&(spectrum, i, j): &(&Spectrum, usize, usize)| {
        let reach = step * (spectrum.friction_sensitivity[i].norm() + spectrum.friction_sensitivity[j].norm()) + jump;
        (spectrum.roots[i].square - spectrum.roots[j].square).norm() > 4.0 * reach
    };
    if ends.iter().all(far) {
        return true;
    }
    let [(d_left, slope_left), (d_right, slope_right)] = ends.map(|(spectrum, i, j)| {
        let half = 0.5 * (spectrum.roots[i].square - spectrum.roots[j].square);
        let half_slope = 0.5 * (spectrum.friction_sensitivity[i] - spectrum.friction_sensitivity[j]);
        (half * half, 2.0 * half * half_slope)
    });
    match jumps.pairs() {
        0 => {}
        1 => return parts_are_resolved([d_left, slope_left * step], [d_right, slope_right * step]),
        _ => return false,
    }
    let samples: Vec<c64> =
        (1..=SAMPLES).map(|k| hermite(d_left, slope_left, d_right, slope_right, step, fraction(k))).collect();
    let least = samples.iter().map(|d| d.norm()).fold(f64::INFINITY, f64::min);
    if least >= CLEARANCE * d_left.norm().min(d_right.norm()) {
        return true;
    }
    // A real discriminant that changes sign crosses zero; exactly once if it is monotonic.
    let real = |d: c64| d.im.abs() <= 1e-9 * d.norm();
    let rises = (d_right.re - d_left.re).signum();
    let mut path = vec![d_left.re];
    path.extend(samples.iter().map(|d| d.re));
    path.push(d_right.re);
    real(d_left)
        && real(d_right)
        && d_left.re * d_right.re < 0.0
        && path.windows(2).all(|pair| (pair[1] - pair[0]) * rises > 0.0)
}

/// Whether a discriminant that jumps once in an interval keeps away from zero on both sides of the jump, wherever it
/// is. Given are its value at each end, and its change over the interval if it did not jump.
fn parts_are_resolved(left: [c64; 2], right: [c64; 2]) -> bool {
    let keeps = |[value, change]: [c64; 2]| change.norm() <= (1.0 - CLEARANCE) * value.norm();
    keeps(left) && keeps(right)
}

/// Whether the growth rate of one branch stays on its side of the threshold or crosses it exactly once.
fn growth_is_resolved(
    left: &Spectrum,
    i: usize,
    right: &Spectrum,
    j: usize,
    step: f64,
    threshold: f64,
    jump: f64,
) -> bool {
    let slope = |spectrum: &Spectrum, k: usize| spectrum.friction_sensitivity[k] / (2.0 * spectrum.roots[k].lambda);
    let (from, to) = (left.roots[i].lambda, right.roots[j].lambda);
    let (slope_from, slope_to) = (slope(left, i), slope(right, j));
    // The error of the trapezoidal rule serves as the uncertainty of the cubic through the same data.
    let off = (to - from - 0.5 * step * (slope_from + slope_to)).re.abs();
    // A jump of `λ²`, as one of `λ`.
    let off = if jump > 0.0 { off + jump / (2.0 * from.norm().min(to.norm())) } else { off };
    let limit = threshold * from.norm().max(to.norm());
    let samples = (1..=SAMPLES).map(|k| hermite(from, slope_from, to, slope_to, step, fraction(k)).re);
    match (from.re > limit, to.re > limit) {
        (false, false) => samples.fold(f64::NEG_INFINITY, f64::max) + 2.0 * off <= limit.max(from.re).max(to.re),
        (true, true) => samples.fold(f64::INFINITY, f64::min) - 2.0 * off > 0.0,
        _ => off <= 0.5 * (to.re - from.re).abs(),
    }
}

/// Position of sample `k` in the interval, as a fraction of its length.
fn fraction(k: usize) -> f64 {
    k as f64 / (SAMPLES + 1) as f64
}

/// Cubic Hermite interpolation: values and slopes at both ends of an interval of length `step`, evaluated at fraction
/// `s`.
fn hermite(a: c64, slope_a: c64, b: c64, slope_b: c64, step: f64, s: f64) -> c64 {
    let r = 1.0 - s;
    a * (r * r * (1.0 + 2.0 * s)) + b * (s * s * (3.0 - 2.0 * s)) + (slope_a * r - slope_b * s) * (step * s * r)
}

/// How a followed root is unstable at a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Behaviour {
    /// Flutter of a pair; contains the other member's identity.
    Coupled(u32),
    /// A single mode grows.
    Growing,
    /// A static root grows.
    Diverging,
}

/// A sequence of neighbouring nodes at which a root or pair is unstable in the same way.
#[derive(Clone, Copy, Debug)]
struct Stretch {
    first: usize,
    last: usize,
    /// The largest `σ/|λ|` at these nodes.
    growth: f64,
    /// Whether the root is in the band at one of these nodes at least. The window then extends beyond the edge of the
    /// band too.
    judged: bool,
}

/// All windows of instability of a map, with their ends located by root finding.
pub(super) fn windows(
    model: &Model,
    solver: &mut Solver,
    map: &StabilityMap,
    options: &MapOptions,
) -> Result<Vec<Window>, MapError> {
    let mut stretches: BTreeMap<(WindowKind, Vec<u32>), Vec<Stretch>> = BTreeMap::new();
    for (k, node) in map.nodes.iter().enumerate() {
        for (id, behaviour, root) in unstable(node) {
            let growth = root.lambda.re / root.lambda.norm();
            let judged = is_judged(root, options);
            let key = match behaviour {
                Behaviour::Coupled(partner) => (WindowKind::Coalescence, vec![id.min(partner), id.max(partner)]),
                Behaviour::Growing => (WindowKind::ZeroGrowth, vec![id]),
                Behaviour::Diverging => (WindowKind::Divergence, vec![id]),
            };
            let list = stretches.entry(key).or_default();
            match list.last_mut() {
                Some(stretch) if stretch.last + 1 >= k => {
                    stretch.last = k;
                    stretch.growth = stretch.growth.max(growth);
                    stretch.judged |= judged;
                }
                _ => list.push(Stretch { first: k, last: k, growth, judged }),
            }
        }
    }
    let mut polish = Polish { model, solver, map, options };
    let mut windows = vec![];
    for ((kind, ids), list) in stretches {
        for stretch in list.into_iter().filter(|s| s.judged && s.growth > options.instability_threshold) {
            let (mu_from, start) = polish.end(kind, &ids, stretch.first, stretch.first.checked_sub(1))?;
            let after = Some(stretch.last + 1).filter(|&k| k < map.nodes.len());
            let to = match after {
                Some(_) => Some(polish.end(kind, &ids, stretch.last, after)?),
                None => None,
            };
            let frequency = |hz: f64| if kind == WindowKind::Divergence { 0.0 } else { hz };
            windows.push(Window {
                mode_ids: ids.clone(),
                mu_from,
                mu_to: to.map(|(mu, _)| mu),
                frequency_hz: frequency(start),
                frequency_to_hz: to.map(|(_, hz)| frequency(hz)),
                kind,
            });
        }
    }
    windows.extend(polish.damped_divergence()?);
    windows.sort_by(|a, b| a.mu_from.total_cmp(&b.mu_from).then(a.mode_ids.cmp(&b.mode_ids)));
    Ok(windows)
}

/// The unstable followed roots of a node: identity, behaviour and root.
fn unstable(node: &Node) -> impl Iterator<Item = (u32, Behaviour, &Root)> {
    (0..tracked(&node.spectrum)).filter_map(|k| {
        let root = &node.spectrum.roots[k];
        if root.lambda.re <= 0.0 {
            return None;
        }
        let behaviour = match mirror(&node.spectrum, k).and_then(|partner| node.ids[partner]) {
            Some(partner) => Behaviour::Coupled(partner),
            None if root.oscillates() => Behaviour::Growing,
            None => Behaviour::Diverging,
        };
        Some((node.ids[k]?, behaviour, root))
    })
}

/// Locates the ends of windows between two nodes.
struct Polish<'a> {
    model: &'a Model,
    solver: &'a mut Solver,
    map: &'a StabilityMap,
    options: &'a MapOptions,
}

impl Polish<'_> {
    /// Friction coefficient and frequency (Hz) of the end of a window between node `inside` and its neighbour
    /// `outside`.
    fn end(
        &mut self,
        kind: WindowKind,
        ids: &[u32],
        inside: usize,
        outside: Option<usize>,
    ) -> Result<(f64, f64), MapError> {
        let map = self.map;
        let inner = &map.nodes[inside];
        let value_inside = quantity(kind, ids, inner);
        let here = (inner.mu(), value_inside.map_or(0.0, |(_, hz)| hz));
        let (Some(outer), Some((f_inside, _))) = (outside.map(|k| &map.nodes[k]), value_inside) else {
            return Ok(here);
        };
        // A divergence that begins where a flutter pair merges on the real axis: its end is the merging point of the
        // pair.
        let merging = mirror_pair(outer, ids);
        let (kind, ids) = match (kind, &merging) {
            (WindowKind::Divergence, Some(pair)) => (WindowKind::Coalescence, pair.as_slice()),
            (WindowKind::Coalescence | WindowKind::ZeroGrowth | WindowKind::Divergence, _) => (kind, ids),
        };
        let f_inside =
            if merging.is_some() { quantity(kind, ids, inner).map_or(f_inside, |(f, _)| f) } else { f_inside };
        let Some((f_outside, _)) = quantity(kind, ids, outer) else { return Ok(here) };
        if f_inside * f_outside > 0.0 {
            return Ok(here); // partners changed without a merging: no end to polish
        }
        let (solver, model) = (&mut *self.solver, self.model);
        let evaluate = |mu: f64| -> Result<(f64, f64), MapError> {
            let spectrum = solver
                .solve(model, &map.point.with_friction(mu), Vectors::Right)
                .map_err(|source| MapError::Solve { mu, source })?;
            let node = Node { ids: map.identify(&spectrum), spectrum };
            // Within rounding of a merging point the roots may appear merged or separate; the discriminant is the
            // same for both.
            Ok(quantity(kind, ids, &node).unwrap_or((0.0, here.1)))
        };
        bracketed_root(evaluate, (outer.mu(), f_outside), (inner.mu(), f_inside))
    }

    /// Windows of static divergence of a damped model, whose static roots are not followed. A window is an interval
    /// in which at least a given number of static roots grow; each end is found by bisection on that number.
    fn damped_divergence(&mut self) -> Result<Vec<Window>, MapError> {
        let threshold = self.options.instability_threshold;
        let growing = |spectrum: &Spectrum| {
            let statics = &spectrum.roots[tracked(spectrum)..];
            statics.iter().filter(|root| root.is_unstable(threshold)).count()
        };
        let counts: Vec<usize> = self.map.nodes.iter().map(|node| growing(&node.spectrum)).collect();
        let mut windows: Vec<Window> = vec![];
        let mut open: Vec<usize> = vec![]; // indices of windows, one for each growing root
        let mut before = 0;
        for (k, &count) in counts.iter().enumerate() {
            for level in before.min(count)..before.max(count) {
                let mu = match k.checked_sub(1) {
                    None => self.map.nodes[0].mu(),
                    Some(previous) => {
                        let rises = count > before;
                        let bracket = (self.map.nodes[previous].mu(), self.map.nodes[k].mu());
                        let (solver, model, point) = (&mut *self.solver, self.model, self.map.point);
                        bisect(bracket, |mu| {
                            let spectrum = solver
                                .solve(model, &point.with_friction(mu), Vectors::Right)
                                .map_err(|source| MapError::Solve { mu, source })?;
                            Ok((growing(&spectrum) > level) == rises)
                        })?
                    }
                };
                if count > before {
                    open.push(windows.len());
                    let kind = WindowKind::Divergence;
                    windows.push(Window {
                        mode_ids: vec![],
                        mu_from: mu,
                        mu_to: None,
                        frequency_hz: 0.0,
                        frequency_to_hz: None,
                        kind,
                    });
                } else if let Some(index) = open.pop() {
                    (windows[index].mu_to, windows[index].frequency_to_hz) = (Some(mu), Some(0.0));
                }
            }
            before = count;
        }
        Ok(windows)
    }
}

/// The coupled pair at `node` that contains the single identity in `ids`, if there is one.
fn mirror_pair(node: &Node, ids: &[u32]) -> Option<Vec<u32>> {
    let [id] = *ids else { return None };
    let partner = mirror(&node.spectrum, node.find(id)?)?;
    let partner = node.ids[partner]?;
    Some(vec![id.min(partner), id.max(partner)])
}

/// The quantity whose zero ends a window of `kind`, and the frequency in Hz, at a node; `None` if a root is not found
/// there.
fn quantity(kind: WindowKind, ids: &[u32], node: &Node) -> Option<(f64, f64)> {
    let root = |id: u32| node.find(id).map(|k| node.spectrum.roots[k]);
    match (kind, ids) {
        (WindowKind::Coalescence, &[first, second]) => {
            let (a, b) = (root(first)?.square, root(second)?.square);
            let half = 0.5 * (a - b);
            let mean = 0.5 * (a + b);
            Some(((half * half).re, (-mean.re).max(0.0).sqrt() / std::f64::consts::TAU))
        }
        (WindowKind::ZeroGrowth, &[id]) => root(id).map(|r| (r.lambda.re, r.frequency_hz())),
        (WindowKind::Divergence, &[id]) => root(id).map(|r| (r.square.re, 0.0)),
        (WindowKind::Coalescence | WindowKind::ZeroGrowth | WindowKind::Divergence, _) => None,
    }
}

/// Zero of a continuous function between two points of opposite sign, by inverse quadratic interpolation, secant and
/// bisection (Brent 1973, chapter 4), to 1e-14 of the larger end. `evaluate` returns the function and a second value
/// (the frequency); the result is the zero and the second value there.
fn bracketed_root(
    mut evaluate: impl FnMut(f64) -> Result<(f64, f64), MapError>,
    (mut a, mut fa): (f64, f64),
    (mut b, mut fb): (f64, f64),
) -> Result<(f64, f64), MapError> {
    let tolerance = 1e-14 * a.abs().max(b.abs()).max(1e-3);
    let (mut c, mut fc) = (a, fa);
    let mut step = b - a;
    let mut before = step;
    let mut extra = evaluate(b)?.1;
    for _ in 0..100 {
        if fb * fc > 0.0 {
            (c, fc) = (a, fa);
            step = b - a;
            before = step;
        }
        if fc.abs() < fb.abs() {
            (a, b, c) = (b, c, b);
            (fa, fb, fc) = (fb, fc, fb);
        }
        let half = 0.5 * (c - b);
        if half.abs() <= tolerance || fb == 0.0 {
            break;
        }
        let s = fb / fa;
        let (mut p, mut q) = if a == c {
            (2.0 * half * s, 1.0 - s)
        } else {
            let (q, r) = (fa / fc, fb / fc);
            (s * (2.0 * half * q * (q - r) - (b - a) * (r - 1.0)), (q - 1.0) * (r - 1.0) * (s - 1.0))
        };
        if p > 0.0 {
            q = -q;
        }
        p = p.abs();
        let interpolates = before.abs() > tolerance
            && fa.abs() > fb.abs()
            && 2.0 * p < (3.0 * half * q - (tolerance * q).abs()).min((before * q).abs());
        (before, step) = if interpolates { (step, p / q) } else { (half, half) };
        (a, fa) = (b, fb);
        b += if step.abs() > tolerance { step } else { tolerance.copysign(half) };
        (fb, extra) = evaluate(b)?;
    }
    Ok((b, extra))
}

/// The point at which a condition, false at the first end and true at the second, changes, to 1e-13 of the larger
/// end.
fn bisect((mut a, mut b): (f64, f64), mut holds: impl FnMut(f64) -> Result<bool, MapError>) -> Result<f64, MapError> {
    let tolerance = 1e-13 * a.abs().max(b.abs());
    while (b - a).abs() > tolerance {
        let middle = 0.5 * (a + b);
        if middle == a || middle == b {
            break;
        }
        if holds(middle)? { b = middle } else { a = middle }
    }
    Ok(b)
}

#[cfg(test)]
mod tests {
    use faer::mat;

    use super::super::law::{ContactLaw, CustomLaw, Law};
    use super::super::model::Term;
    use super::super::operating_point::OperatingPoint;
    use super::super::test_models::{REFERENCE, hulten, nine_dof, random_rig};
    use super::*;

    fn map(model: &Model, mu_max: f64) -> StabilityMap {
        let options = MapOptions { mu_min: 0.0, mu_max, band_max_hz: None, instability_threshold: 1e-6, windows: true };
        let mut solver = Solver::new(model.dimension());
        StabilityMap::build(model, &mut solver, &REFERENCE, &options).expect("the model can be mapped")
    }

    fn starts(model: &Model, mu_max: f64) -> Vec<(f64, Vec<u32>, Option<f64>)> {
        let map = map(model, mu_max);
        eprintln!("{} nodes", map.nodes.len());
        map.windows.iter().map(|w| (w.mu_from, w.mode_ids.clone(), w.mu_to)).collect()
    }

    fn assert_starts(model: &Model, mu_max: f64, expected: &[(f64, [u32; 2])]) {
        let found = starts(model, mu_max);
        assert_eq!(found.len(), expected.len(), "{found:?}");
        for ((mu, ids, end), (expected_mu, expected_ids)) in found.into_iter().zip(expected) {
            assert!((mu - expected_mu).abs() < 1e-10, "{mu} is not {expected_mu}");
            assert_eq!((ids.as_slice(), end), (expected_ids.as_slice(), None));
        }
    }

    /// Expected values: 30-digit arithmetic on the same matrices. The modes meet at 14.598 too, but that is a
    /// crossing, not a bifurcation.
    #[test]
    fn nine_dof_critical_frictions() {
        assert_starts(&nine_dof(1.0, 1.0, 1.0), 20.0, &[(0.82001495938185, [1, 2]), (2.8222527641081, [4, 5])]);
        let case_2 = starts(&nine_dof(2.0, 2.0, 5.0), 20.0);
        assert!((case_2[0].0 - 0.35592805826058).abs() < 1e-10, "{case_2:?}");
        assert!((case_2[1].0 - 1.3372333350282).abs() < 1e-10, "{case_2:?}");
    }

    /// Routh-Hurwitz on the characteristic polynomial of Hultén's model, `s⁴ + A s³ + B s² + C s + D`: the limit of
    /// stability is `A B C = C² + A² D`; undamped, the discriminant in `s²` vanishes, `B² = 4 D`.
    fn hulten_closed_form(eta_1: f64, eta_2: f64) -> f64 {
        let (w1, w2) = (100.0 * std::f64::consts::TAU, 75.0 * std::f64::consts::TAU);
        let (c1, c2) = (eta_1 * w1, eta_2 * w2);
        let (a, b, c) = (c1 + c2, w1 * w1 + w2 * w2 + c1 * c2, c1 * w2 * w2 + c2 * w1 * w1);
        let d = if a == 0.0 { 0.25 * b * b } else { (a * b * c - c * c) / (a * a) };
        (d / (w1 * w2).powi(2) - 1.0).sqrt()
    }

    #[test]
    fn hulten_critical_frictions() {
        for (eta_1, eta_2) in [(0.0, 0.0), (0.02, 0.02), (0.02, 0.10)] {
            let expected = hulten_closed_form(eta_1, eta_2);
            let found = starts(&hulten(eta_1, eta_2), 2.0);
            assert_eq!(found.len(), 1, "{found:?}");
            assert!((found[0].0 - expected).abs() < 1e-10, "{found:?} is not {expected}");
        }
    }

    /// Two modes that cross at `μ = m`, `K = [[4 + (μ-m), w], [-w, 4 - (μ-m)]]`: flutter for `(μ - m)² < w²`.
    fn crossing(m: f64, w: f64) -> Model {
        let term = |matrix, law| Term { matrix, law };
        let terms = vec![
            term(mat![[4.0 - m, w], [-w, 4.0 + m]], Law::Constant),
            term(mat![[1.0, 0.0], [0.0, -1.0]], Law::FrictionStiffness),
        ];
        Model::new(2, terms, vec![], ContactLaw::default(), None).expect("the model is well formed")
    }

    #[test]
    fn narrow_windows_are_found_and_true_crossings_are_not_windows() {
        for w in [1e-1, 1e-3, 1e-5] {
            let found = starts(&crossing(0.7, w), 2.0);
            assert_eq!(found.len(), 1, "{found:?}");
            // Rounding of `d` is 16 ε, its slope is 2w.
            let limit = 1e-10f64.max(16.0 * f64::EPSILON / w);
            assert!((found[0].0 - (0.7 - w)).abs() < limit, "{found:?}");
            assert!((found[0].2.unwrap() - (0.7 + w)).abs() < limit, "{found:?}");
        }
        assert!(starts(&crossing(0.7, 0.0), 2.0).is_empty());
        // Veering: a symmetric coupling keeps the two roots apart.
        let veering = Model::new(
            2,
            vec![
                Term { matrix: mat![[4.0 - 0.7, 1e-4], [1e-4, 4.0 + 0.7]], law: Law::Constant },
                Term { matrix: mat![[1.0, 0.0], [0.0, -1.0]], law: Law::FrictionStiffness },
            ],
            vec![],
            ContactLaw::default(),
            None,
        );
        assert!(starts(&veering.unwrap(), 2.0).is_empty());
    }

    /// A damped mode with growth rate `a - b (μ - m)²`: it grows for `|μ - m| < √(a/b)`. Both ends lie between two
    /// initial nodes, at which it decays.
    #[test]
    fn narrow_windows_of_damped_modes_are_found() {
        let (a, b, m) = (1e-4, 1.0, 0.71875);
        let law = Law::Custom(CustomLaw {
            text: "a - b (mu - m)^2".into(),
            evaluate: std::sync::Arc::new(move |p: &OperatingPoint| {
                -2.0 * (a - b * (p.friction_coefficient - m).powi(2))
            }),
            depends_on_load: false,
            depends_on_speed: false,
            depends_on_friction: true,
        });
        let stiffness = vec![Term { matrix: mat![[4.0]], law: Law::Constant }];
        let damping = vec![Term { matrix: mat![[1.0]], law }];
        let model = Model::new(1, stiffness, damping, ContactLaw::default(), None).expect("the model is well formed");
        let found = map(&model, 2.0).windows;
        let [window] = found.as_slice() else { panic!("{found:?}") };
        assert_eq!((window.kind, window.mode_ids.as_slice()), (WindowKind::ZeroGrowth, &[0][..]));
        let half: f64 = (a / b).sqrt();
        assert!((window.mu_from - (m - half)).abs() < 1e-10 && (window.mu_to.unwrap() - (m + half)).abs() < 1e-10);
        // At the ends the damping is zero, so `ω = 2` rad/s.
        for hz in [window.frequency_hz, window.frequency_to_hz.unwrap()] {
            assert!((hz - 2.0 / std::f64::consts::TAU).abs() < 1e-9, "{window:?}");
        }
    }

    /// Two damped modes that flutter for `(μ - m)² < w² - 4 c²`: at `λ = iω` the equation gives `ω² = 4` and
    /// `c ω = √(w² - (μ - m)²)`.
    #[test]
    fn damping_narrows_a_window_as_by_hand() {
        let (m, w, c) = (0.7, 1e-3, 4e-4);
        let undamped = crossing(m, w);
        let terms = undamped.stiffness.iter().map(|known| known.term.clone()).collect();
        let damping = vec![Term { matrix: mat![[c, 0.0], [0.0, c]], law: Law::Constant }];
        let model = Model::new(2, terms, damping, ContactLaw::default(), None).expect("the model is well formed");
        let found = map(&model, 2.0).windows;
        let [window] = found.as_slice() else { panic!("{found:?}") };
        // The ends are the zeros of the growth rate; the instability threshold does not move them.
        let half = (w * w - 4.0 * c * c).sqrt();
        assert!(
            (window.mu_from - (m - half)).abs() < 1e-9 && (window.mu_to.unwrap() - (m + half)).abs() < 1e-9,
            "{window:?}"
        );
    }

    /// While a pair is coupled, the growing mode has the lower identity; once it has separated, the lower frequency
    /// has it.
    #[test]
    fn a_pair_that_parts_keeps_its_identities_in_order() {
        let map = map(&crossing(0.7, 1e-2), 2.0);
        let (mut coupled, mut parted) = (0, 0);
        for node in &map.nodes {
            let [lower, upper] = [0, 1].map(|id| node.spectrum.roots[node.find(id).expect("both are followed")].lambda);
            if lower.re != 0.0 {
                assert!(lower.re > 0.0 && upper.re < 0.0, "mu {}: {lower} {upper}", node.mu());
                coupled += 1;
            } else {
                assert!(lower.im < upper.im, "mu {}: {lower} {upper}", node.mu());
                parted += usize::from(node.mu() > 0.7);
            }
        }
        assert!(coupled > 0 && parted > 5, "{coupled} {parted}");
    }

    /// `k = 1 - μ` diverges for `μ > 1`, with and without damping.
    #[test]
    fn static_divergence() {
        let term = |value: f64, law| Term { matrix: mat![[value]], law };
        for damping in [0.0, 0.3] {
            let model = Model::new(
                1,
                vec![term(1.0, Law::Constant), term(-1.0, Law::FrictionStiffness)],
                vec![term(damping, Law::Constant)],
                ContactLaw::default(),
                None,
            )
            .unwrap();
            let found = map(&model, 2.0).windows;
            assert_eq!(found.len(), 1, "{found:?}");
            assert_eq!((found[0].kind, found[0].mu_to), (WindowKind::Divergence, None));
            assert!((found[0].mu_from - 1.0).abs() < 1e-10, "{found:?}");
        }
    }

    /// A scan over the friction coefficient agrees with the windows of random rigs, undamped and damped: every
    /// unstable point lies in a window, and every point well inside a window is unstable.
    #[test]
    fn a_scan_agrees_with_the_windows() {
        let (mut windows, mut growing) = (0, 0);
        for seed in 0..60 {
            let damping = [0.0, 1e-3, 2e-2][seed as usize % 3];
            let model = random_rig(seed, 6 + seed as usize % 5, 3, damping);
            let map = map(&model, 2.0);
            assert!(map.complete);
            windows += map.windows.len();
            let mut solver = Solver::new(model.dimension());
            for k in 0..2000 {
                let mu = 1e-3 * f64::from(k) + 3.7e-5;
                let spectrum = solver.solve(&model, &REFERENCE.with_friction(mu), Vectors::Right).unwrap();
                let unstable = spectrum.roots.iter().any(|root| root.is_unstable(1e-6));
                let inside = |slack: f64| {
                    map.windows.iter().any(|w| mu > w.mu_from + slack && w.mu_to.is_none_or(|to| mu < to - slack))
                };
                assert!(!unstable || inside(-1e-9), "seed {seed}: {mu} grows in none of {:?}", map.windows);
                // Just inside an end the growth rate is positive but still below the instability threshold; hence
                // 1e-11.
                let grows = spectrum.roots.iter().any(|root| root.is_unstable(1e-11));
                assert!(grows || !inside(1e-5), "seed {seed}: {mu} does not grow in {:?}", map.windows);
                growing += usize::from(unstable);
            }
        }
        assert!(windows > 40 && growing > 4000, "the rigs are worth testing: {windows} windows, {growing} points");
    }
}
