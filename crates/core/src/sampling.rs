//! Points that fill a box evenly, however many are drawn.

/// The radical inverse of `index`: its digits in `base`, mirrored at the radix point (van der Corput 1935; Halton
/// 1960).
pub fn radical_inverse(mut index: usize, base: usize) -> f64 {
    let (mut value, mut digit) = (0.0, 1.0 / base as f64);
    while index > 0 {
        value += digit * (index % base) as f64;
        index /= base;
        digit /= base as f64;
    }
    value
}
