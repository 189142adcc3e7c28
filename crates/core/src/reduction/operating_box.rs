//! A box of operating points and well-distributed points in it.

use super::ReductionError;
use crate::physics::OperatingPoint;
use crate::sampling::radical_inverse;

/// Ratio of the ends of a range above which it is sampled uniformly in the logarithm.
const GEOMETRIC_ABOVE: f64 = 3.0;

/// Closed ranges of the operating conditions. A range may be a single value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OperatingBox {
    /// Lowest and highest friction coefficient.
    pub friction_coefficient: [f64; 2],
    /// Lowest and highest normal load, N, above 0.
    pub normal_load_n: [f64; 2],
    /// Lowest and highest disc speed, rad/s, both of one sign: at 0 the contact does not slide.
    pub disc_speed_rad_s: [f64; 2],
}

impl OperatingBox {
    fn ranges(&self) -> [(&'static str, [f64; 2]); 3] {
        [
            ("friction_coefficient", self.friction_coefficient),
            ("normal_load_n", self.normal_load_n),
            ("disc_speed_rad_s", self.disc_speed_rad_s),
        ]
    }

    /// Checks that every range is finite and ascending, that the load is above 0 and that the speed does not change
    /// sign.
    ///
    /// # Errors
    /// [`ReductionError::Range`].
    pub fn check(&self) -> Result<(), ReductionError> {
        let refuse = |what: &str, [low, high]: [f64; 2], limit: &str| {
            Err(ReductionError::Range { what: what.to_owned(), low, high, limit: limit.to_owned() })
        };
        for (what, [low, high]) in self.ranges() {
            if !(low.is_finite() && high.is_finite() && low <= high) {
                return refuse(what, [low, high], "two finite numbers in ascending order");
            }
        }
        if self.normal_load_n[0] <= 0.0 {
            return refuse("normal_load_n", self.normal_load_n, "more than 0");
        }
        let [low, high] = self.disc_speed_rad_s;
        if low <= 0.0 && high >= 0.0 {
            return refuse("disc_speed_rad_s", [low, high], "a range on one side of 0");
        }
        Ok(())
    }

    /// The same box with load or speed, if flagged, replaced by the middle of its range, for models that do not depend
    /// on it.
    pub fn without(&self, load: bool, speed: bool) -> Self {
        let middle = self.at([0.5; 3]);
        let mut smaller = *self;
        if load {
            smaller.normal_load_n = [middle.normal_load_n; 2];
        }
        if speed {
            smaller.disc_speed_rad_s = [middle.disc_speed_rad_s; 2];
        }
        smaller
    }

    /// Number of ranges wider than a single value.
    pub fn widths(&self) -> usize {
        self.ranges().iter().filter(|(_, [low, high])| low < high).count()
    }

    /// The point with the normalised coordinates `unit`, each from 0 to 1, in the order friction, load, speed.
    pub fn at(&self, unit: [f64; 3]) -> OperatingPoint {
        let along = |[low, high]: [f64; 2], u: f64| {
            if low * high > 0.0 && (high / low).max(low / high) > GEOMETRIC_ABOVE {
                // Return the end exactly, regardless of rounding in the power.
                if u == 1.0 { high } else { low * (high / low).powf(u) }
            } else {
                low + u * (high - low)
            }
        };
        OperatingPoint {
            friction_coefficient: along(self.friction_coefficient, unit[0]),
            normal_load_n: along(self.normal_load_n, unit[1]),
            disc_speed_rad_s: along(self.disc_speed_rad_s, unit[2]),
        }
    }

    /// The corners of the box, each once, then its middle.
    pub fn corners_and_middle(&self) -> Vec<OperatingPoint> {
        let mut points: Vec<OperatingPoint> = vec![];
        let corners = (0..8_u8).map(|corner| [0, 1, 2].map(|axis| f64::from((corner >> axis) & 1)));
        for unit in corners.chain([[0.5; 3]]) {
            let point = self.at(unit);
            if !points.contains(&point) {
                points.push(point);
            }
        }
        points
    }

    /// `count` points of the Halton sequence in bases 2, 3 and 5, starting at index `first`. They are well distributed
    /// and never repeat.
    pub fn spread(&self, first: usize, count: usize) -> Vec<OperatingPoint> {
        (first..first + count).map(|index| self.at([2, 3, 5].map(|base| radical_inverse(index + 1, base)))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOX: OperatingBox =
        OperatingBox { friction_coefficient: [0.0, 1.0], normal_load_n: [50.0, 2000.0], disc_speed_rad_s: [6.0, 60.0] };

    #[test]
    fn points_lie_in_the_box_and_are_all_different() {
        let mut points = BOX.corners_and_middle();
        assert_eq!(points.len(), 9);
        // The middle of a range sampled in the logarithm is the geometric mean.
        assert!((points[8].normal_load_n - 316.227766016838).abs() < 1e-9);
        points.extend(BOX.spread(0, 40));
        for (k, p) in points.iter().enumerate() {
            assert!((50.0..=2000.0).contains(&p.normal_load_n) && (6.0..=60.0).contains(&p.disc_speed_rad_s), "{p:?}");
            assert!((0.0..=1.0).contains(&p.friction_coefficient) && !points[..k].contains(p), "{p:?}");
        }
        assert_eq!(BOX.without(true, true).corners_and_middle().len(), 3);
    }

    #[test]
    fn ranges_that_mean_nothing_are_refused() {
        assert!(BOX.check().is_ok());
        for (wrong, what) in [
            (OperatingBox { normal_load_n: [0.0, 10.0], ..BOX }, "normal_load_n is 0 to 10, expected more than 0"),
            (OperatingBox { disc_speed_rad_s: [-1.0, 1.0], ..BOX }, "disc_speed_rad_s is -1 to 1, expected a range"),
            (
                OperatingBox { friction_coefficient: [1.0, 0.5], ..BOX },
                "friction_coefficient is 1 to 0.5, expected two",
            ),
            (OperatingBox { friction_coefficient: [0.0, f64::NAN], ..BOX }, "friction_coefficient is 0 to NaN"),
        ] {
            let message = wrong.check().unwrap_err().to_string();
            assert!(message.contains(what), "{message}");
        }
    }
}
