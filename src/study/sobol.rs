//! Sobol's sequence (1967) with the direction numbers of Joe and Kuo ("Constructing Sobol sequences with better
//! two-dimensional projections", SIAM J. Sci. Comput. 30 (2008) 2635-2654; their file new-joe-kuo-6.21201). Points are in the
//! order of the Gray code (Antonov and Saleev 1979), as `scipy.stats.qmc.Sobol` gives them.

/// Number of dimensions.
pub const DIMENSIONS: usize = POLYNOMIALS.len() + 1;

/// Of every dimension after the first: the primitive polynomial over GF(2), its coefficients as bits, and the first direction
/// numbers, as many as its degree.
const POLYNOMIALS: [(u32, &[u32]); 63] = [
    (3, &[1]),
    (7, &[1, 3]),
    (11, &[1, 3, 1]),
    (13, &[1, 1, 1]),
    (19, &[1, 1, 3, 3]),
    (25, &[1, 3, 5, 13]),
    (37, &[1, 1, 5, 5, 17]),
    (41, &[1, 1, 5, 5, 5]),
    (47, &[1, 1, 7, 11, 19]),
    (55, &[1, 1, 5, 1, 1]),
    (59, &[1, 1, 1, 3, 11]),
    (61, &[1, 3, 5, 5, 31]),
    (67, &[1, 3, 3, 9, 7, 49]),
    (91, &[1, 1, 1, 15, 21, 21]),
    (97, &[1, 3, 1, 13, 27, 49]),
    (103, &[1, 1, 1, 15, 7, 5]),
    (109, &[1, 3, 1, 15, 13, 25]),
    (115, &[1, 1, 5, 5, 19, 61]),
    (131, &[1, 3, 7, 11, 23, 15, 103]),
    (137, &[1, 3, 7, 13, 13, 15, 69]),
    (143, &[1, 1, 3, 13, 7, 35, 63]),
    (145, &[1, 3, 5, 9, 1, 25, 53]),
    (157, &[1, 3, 1, 13, 9, 35, 107]),
    (167, &[1, 3, 1, 5, 27, 61, 31]),
    (171, &[1, 1, 5, 11, 19, 41, 61]),
    (185, &[1, 3, 5, 3, 3, 13, 69]),
    (191, &[1, 1, 7, 13, 1, 19, 1]),
    (193, &[1, 3, 7, 5, 13, 19, 59]),
    (203, &[1, 1, 3, 9, 25, 29, 41]),
    (211, &[1, 3, 5, 13, 23, 1, 55]),
    (213, &[1, 3, 7, 3, 13, 59, 17]),
    (229, &[1, 3, 1, 3, 5, 53, 69]),
    (239, &[1, 1, 5, 5, 23, 33, 13]),
    (241, &[1, 1, 7, 7, 1, 61, 123]),
    (247, &[1, 1, 7, 9, 13, 61, 49]),
    (253, &[1, 3, 3, 5, 3, 55, 33]),
    (285, &[1, 3, 1, 15, 31, 13, 49, 245]),
    (299, &[1, 3, 5, 15, 31, 59, 63, 97]),
    (301, &[1, 3, 1, 11, 11, 11, 77, 249]),
    (333, &[1, 3, 1, 11, 27, 43, 71, 9]),
    (351, &[1, 1, 7, 15, 21, 11, 81, 45]),
    (355, &[1, 3, 7, 3, 25, 31, 65, 79]),
    (357, &[1, 3, 1, 1, 19, 11, 3, 205]),
    (361, &[1, 1, 5, 9, 19, 21, 29, 157]),
    (369, &[1, 3, 7, 11, 1, 33, 89, 185]),
    (391, &[1, 3, 3, 3, 15, 9, 79, 71]),
    (397, &[1, 3, 7, 11, 15, 39, 119, 27]),
    (425, &[1, 1, 3, 1, 11, 31, 97, 225]),
    (451, &[1, 1, 1, 3, 23, 43, 57, 177]),
    (463, &[1, 3, 7, 7, 17, 17, 37, 71]),
    (487, &[1, 3, 1, 5, 27, 63, 123, 213]),
    (501, &[1, 1, 3, 5, 11, 43, 53, 133]),
    (529, &[1, 3, 5, 5, 29, 17, 47, 173, 479]),
    (539, &[1, 3, 3, 11, 3, 1, 109, 9, 69]),
    (545, &[1, 1, 1, 5, 17, 39, 23, 5, 343]),
    (557, &[1, 3, 1, 5, 25, 15, 31, 103, 499]),
    (563, &[1, 1, 1, 11, 11, 17, 63, 105, 183]),
    (601, &[1, 1, 5, 11, 9, 29, 97, 231, 363]),
    (607, &[1, 1, 5, 15, 19, 45, 41, 7, 383]),
    (617, &[1, 3, 7, 7, 31, 19, 83, 137, 221]),
    (623, &[1, 1, 1, 3, 23, 15, 111, 223, 83]),
    (631, &[1, 1, 5, 13, 31, 15, 55, 25, 161]),
    (637, &[1, 1, 3, 13, 25, 47, 39, 87, 257]),
];

/// Digits of a coordinate.
const BITS: usize = 32;

/// A dimension: what each binary digit of the Gray code of an index contributes.
#[derive(Clone, Debug)]
pub struct Dimension([u32; BITS]);

impl Dimension {
    /// The dimension of this number, below [`DIMENSIONS`].
    pub fn new(number: usize) -> Option<Self> {
        let mut digits = [0; BITS];
        let Some(before) = number.checked_sub(1) else {
            digits.iter_mut().enumerate().for_each(|(k, digit)| *digit = 1 << (BITS - 1 - k));
            return Some(Self(digits));
        };
        let &(polynomial, first) = POLYNOMIALS.get(before)?;
        let degree = first.len();
        for k in 0..BITS {
            digits[k] = if k < degree {
                first[k] << (BITS - 1 - k)
            } else {
                let seed = digits[k - degree] ^ (digits[k - degree] >> degree);
                let inner = (1..degree).filter(|j| polynomial >> (degree - j) & 1 == 1);
                inner.fold(seed, |sum, j| sum ^ digits[k - j])
            };
        }
        Some(Self(digits))
    }

    /// The coordinate of the point of this index: 32 binary digits after the point.
    pub fn digits(&self, index: u32) -> u32 {
        let gray = index ^ (index >> 1);
        let set = self.0.iter().enumerate().filter(|(k, _)| gray >> k & 1 == 1);
        set.fold(0, |sum, (_, digit)| sum ^ digit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_block_of_a_power_of_two_points_has_one_in_each_interval() {
        // What defines the sequence: of the first 2^k points, each interval of length 2^-k holds one, in every dimension.
        for number in 0..DIMENSIONS {
            let dimension = Dimension::new(number).unwrap();
            let mut intervals: Vec<u32> = (0..256).map(|index| dimension.digits(index) >> 24).collect();
            intervals.sort_unstable();
            assert_eq!(intervals, (0..256).collect::<Vec<u32>>(), "dimension {number}");
        }
        assert!(Dimension::new(DIMENSIONS).is_none());
    }
}
