//! Pairing of the roots of a reduced model with those of the full one: errors, missed and invented roots.

use faer::c64;

/// Largest distance of paired roots, relative to `|λ|`.
const SAME: f64 = 1e-2;
/// Growth rate above which a static root counts, relative to the end of the band: slower ones are hardly told from
/// rigid-body motion.
const STATIC: f64 = 1e-3;

/// Region of the complex plane in which roots are compared.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Counted {
    /// Highest angular frequency, rad/s.
    pub band_rad_s: f64,
    /// Lowest growth rate, 1/s; negative for decaying roots.
    pub growth_floor_per_s: f64,
}

impl Counted {
    /// Whether a root oscillates within the band and its growth rate is above the floor, or is static and grows.
    pub fn counts(&self, lambda: c64) -> bool {
        let oscillates = lambda.im > 0.0 && lambda.im <= self.band_rad_s && lambda.re > self.growth_floor_per_s;
        oscillates || lambda.im == 0.0 && lambda.re > STATIC * self.band_rad_s
    }
}

/// Result of pairing the roots of two models.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RootMatch {
    /// Counted full roots with a partner, and the error `|Δλ|/|λ|` of each.
    pub errors: Vec<(c64, f64)>,
    /// Counted full roots without a partner.
    pub missed: Vec<c64>,
    /// Counted reduced roots without a partner.
    pub invented: Vec<c64>,
}

impl RootMatch {
    /// Largest error; infinite if a root was missed or invented.
    pub fn worst(&self) -> f64 {
        if !self.missed.is_empty() || !self.invented.is_empty() {
            return f64::INFINITY;
        }
        self.errors.iter().map(|(_, error)| *error).fold(0.0, f64::max)
    }
}

/// Pairs items one to one, nearest first. `near` lists candidate pairs `(distance, one, other)`, `full` is the number
/// of items on the first side. Returns the partner of each of them.
pub(super) fn pair_off(mut near: Vec<(f64, usize, usize)>, full: usize) -> Vec<Option<usize>> {
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut partners = vec![None; full];
    for (_, one, other) in near {
        if partners[one].is_none() && !partners.contains(&Some(other)) {
            partners[one] = Some(other);
        }
    }
    partners
}

/// Pairs roots one to one, nearest first.
///
/// `full`, `reduced`: all roots with `ω > 0`, and static ones that grow. Full roots should extend slightly beyond the band,
/// so that a root near its end finds its partner on the other side.
pub fn match_roots(full: &[c64], reduced: &[c64], counted: Counted) -> RootMatch {
    let distance = |i: usize, j: usize| (full[i] - reduced[j]).norm() / full[i].norm();
    let near = (0..full.len())
        .flat_map(|i| (0..reduced.len()).map(move |j| (distance(i, j), i, j)))
        .filter(|(error, ..)| *error <= SAME)
        .collect();
    let partners = pair_off(near, full.len());
    let mut comparison = RootMatch::default();
    for (i, (&lambda, partner)) in full.iter().zip(&partners).enumerate() {
        match partner {
            _ if !counted.counts(lambda) => {}
            Some(j) => comparison.errors.push((lambda, distance(i, *j))),
            None => comparison.missed.push(lambda),
        }
    }
    let alone = |(j, lambda): &(usize, &c64)| counted.counts(**lambda) && !partners.contains(&Some(*j));
    comparison.invented.extend(reduced.iter().enumerate().filter(alone).map(|(_, lambda)| *lambda));
    comparison
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_static_root_counts_if_it_grows() {
        let counted = Counted { band_rad_s: 1e4, growth_floor_per_s: -20.0 };
        let static_root = |growth: f64| c64::new(growth, 0.0);
        assert!(counted.counts(static_root(100.0)));
        assert!(!counted.counts(static_root(1.0)) && !counted.counts(static_root(-1.0)));
        let found = match_roots(&[static_root(100.0)], &[static_root(100.1)], counted);
        assert!((found.worst() - 1e-3).abs() < 1e-12);
        assert_eq!(match_roots(&[static_root(100.0)], &[], counted).missed, [static_root(100.0)]);
    }

    #[test]
    fn errors_missed_and_invented_roots_are_counted_separately() {
        let root = |sigma: f64, omega: f64| c64::new(sigma, omega);
        let full = [root(1.0, 100.0), root(-3.0, 100.0), root(-500.0, 900.0), root(0.0, 2000.0), root(2.0, 1000.0)];
        let reduced =
            [root(-3.0, 100.001), root(1.0, 100.0), root(5.0, 700.0), root(-19.0, 2020.0), root(-1.0, 3000.0)];
        let counted = Counted { band_rad_s: 2010.0, growth_floor_per_s: -20.0 };
        let found = match_roots(&full, &reduced, counted);
        // The roots at 2000 and 2020 are 0.0138 apart, too far for a pair.
        assert_eq!(found.missed, [root(0.0, 2000.0), root(2.0, 1000.0)]);
        assert_eq!(found.invented, [root(5.0, 700.0)]);
        assert_eq!(found.errors.len(), 2);
        assert!((found.errors[1].1 - 0.001 / full[1].norm()).abs() < 1e-12 && found.errors[0].1 == 0.0);
        assert_eq!(found.worst(), f64::INFINITY);
        let found = match_roots(&full[..2], &reduced[..2], counted);
        assert!((found.worst() - 0.001 / full[1].norm()).abs() < 1e-12);
    }
}
