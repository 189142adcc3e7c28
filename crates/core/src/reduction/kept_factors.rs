//! Factors of the parts of a full model at a few shifts, kept as memory allows.

use super::ReductionError;
use super::contact_solver::{PartBytes, Parts, Shifted};
use super::precision::Precision;

/// Largest number of shifts whose factors are kept.
const MOST_KEPT: usize = 4;

/// The parts of a full model and their factors. Factors do not depend on the operating point.
pub(super) struct KeptFactors<'a> {
    pub parts: Parts<'a>,
    /// The oldest first.
    kept: Vec<Shifted>,
    /// Largest number of them.
    most: usize,
    pub precision: Precision,
}

impl<'a> KeptFactors<'a> {
    pub fn new(parts: Parts<'a>) -> Self {
        Self { parts, kept: vec![], most: 1, precision: Precision::Double }
    }

    /// Keeps as many factors as `limit` bytes allow besides the `rest`, and returns the bytes needed with one. If one in
    /// double precision does not fit, all are kept in single precision from now on.
    pub fn make_room(&mut self, limit: usize, rest: &dyn Fn(PartBytes) -> usize) -> usize {
        let needed = |precision: Precision| {
            let bytes = self.parts.bytes(precision);
            (rest(bytes), bytes.factors)
        };
        let (mut beside, mut factor) = needed(self.precision);
        if beside + factor > limit && self.precision == Precision::Double {
            (beside, factor) = needed(Precision::Single);
            if beside + factor <= limit {
                self.precision = Precision::Single;
                self.kept.clear();
            }
        }
        self.most = (limit.saturating_sub(beside) / factor.max(1)).clamp(1, MOST_KEPT);
        let surplus = self.kept.len().saturating_sub(self.most);
        self.kept.drain(..surplus);
        beside + factor
    }

    /// Index of the factors of `K - square M`, and their precision if they were made now.
    pub fn at(&mut self, square: f64) -> Result<(usize, Option<Precision>), ReductionError> {
        if let Some(index) = self.kept.iter().position(|shifted| shifted.square == square) {
            return Ok((index, None));
        }
        if self.kept.len() >= self.most {
            self.kept.remove(0);
        }
        self.kept.push(self.parts.at(square, self.precision)?);
        Ok((self.kept.len() - 1, Some(self.precision)))
    }

    /// The factors at an index.
    pub fn get(&self, index: usize) -> &Shifted {
        &self.kept[index]
    }

    /// The factors of `K - square M`, if they are kept.
    pub fn find(&self, square: f64) -> Option<&Shifted> {
        self.kept.iter().find(|shifted| shifted.square == square)
    }

    /// Drops the factors at an index.
    pub fn drop(&mut self, index: usize) {
        self.kept.remove(index);
    }
}

#[cfg(test)]
mod tests {
    use super::super::full_order::tests::touching;
    use super::*;
    use crate::physics::ContactLaw;

    #[test]
    fn as_many_factors_are_kept_as_memory_allows() {
        let model = touching(60, 0.0, ContactLaw::default());
        let mut kept = KeptFactors::new(Parts::new(&model).unwrap());
        let factor = kept.parts.bytes(Precision::Double).factors;
        let none = |_: PartBytes| 0;
        assert_eq!(kept.make_room(2 * factor, &none), factor);
        let made = [1e4, 2e4, 1e4, 3e4, 2e4].map(|square| kept.at(square).unwrap().1);
        let double = Some(Precision::Double);
        assert_eq!(made, [double, double, None, double, None]);
        // The newest stays.
        kept.make_room(factor, &none);
        assert!(kept.find(3e4).is_some() && kept.find(2e4).is_none());
        // What fits in neither precision changes nothing.
        assert!(kept.make_room(1, &none) > 1 && kept.find(3e4).is_some());
        assert!(kept.make_room(factor - 1, &none) < factor && kept.find(3e4).is_none());
        assert_eq!(kept.at(3e4).unwrap().1, Some(Precision::Single));
    }
}
