//! Frequency weighting A of sound pressure.
//!
//! # Source
//! IEC 61672-1:2013, Electroacoustics, Sound level meters, annex E: the weighting as a product of poles, with the
//! approximate pole frequencies that the standard gives.

use super::Quantity;

/// Pole frequencies `f1` to `f4` of annex E, Hz.
const POLES_HZ: [f64; 4] = [20.60, 107.7, 737.9, 12_194.0];
/// Weighting before normalisation at 1 kHz, dB.
const AT_1_KHZ_DB: f64 = -2.000;

/// A-weighting of a tone of `frequency_hz`, dB; 0 dB at 1 kHz, minus infinity at 0 Hz.
///
/// `A(f) = 20 lg[f4² f⁴ / ((f² + f1²) √(f² + f2²) √(f² + f3²) (f² + f4²))] - A(1000)`
///
/// # Source
/// IEC 61672-1:2013, equation E.6.
pub fn a_weighting_db(frequency_hz: f64) -> f64 {
    let square = frequency_hz * frequency_hz;
    let [f1, f2, f3, f4] = POLES_HZ.map(|pole| pole * pole);
    let gain = f4 * square * square / ((square + f1) * ((square + f2) * (square + f3)).sqrt() * (square + f4));
    20.0 * gain.log10() - AT_1_KHZ_DB
}

/// Factor of the mean square of a tone of `frequency_hz`: A-weighting for sound pressure, 1 for acceleration.
pub fn power_weight(quantity: Quantity, frequency_hz: f64) -> f64 {
    match quantity {
        Quantity::SoundPressure => 10.0_f64.powf(0.1 * a_weighting_db(frequency_hz)),
        Quantity::Acceleration => 1.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// IEC 61672-1:2013, table 3: A-weighting at the nominal frequencies, and the acceptance limits of class 1, dB.
    /// The limit below is infinite at 10 Hz, 12.5 Hz and 20 kHz.
    #[rustfmt::skip]
    const TABLE: [(f64, f64, f64); 34] = [
        (-70.4, 3.0, f64::INFINITY), (-63.4, 2.5, f64::INFINITY), (-56.7, 2.0, 4.0), (-50.5, 2.0, 2.0),
        (-44.7, 2.0, 1.5), (-39.4, 1.5, 1.5), (-34.6, 1.0, 1.0), (-30.2, 1.0, 1.0), (-26.2, 1.0, 1.0),
        (-22.5, 1.0, 1.0), (-19.1, 1.0, 1.0), (-16.1, 1.0, 1.0), (-13.4, 1.0, 1.0), (-10.9, 1.0, 1.0),
        (-8.6, 1.0, 1.0), (-6.6, 1.0, 1.0), (-4.8, 1.0, 1.0), (-3.2, 1.0, 1.0), (-1.9, 1.0, 1.0), (-0.8, 1.0, 1.0),
        (0.0, 0.7, 0.7), (0.6, 1.0, 1.0), (1.0, 1.0, 1.0), (1.2, 1.0, 1.0), (1.3, 1.0, 1.0), (1.2, 1.0, 1.0),
        (1.0, 1.0, 1.0), (0.5, 1.5, 1.5), (-0.1, 1.5, 2.0), (-1.1, 1.5, 2.5), (-2.5, 2.0, 3.0), (-4.3, 2.0, 5.0),
        (-6.6, 2.5, 16.0), (-9.3, 3.0, f64::INFINITY),
    ];

    /// Table 3 holds at the exact frequencies `1000 · 10^(n/10)` Hz and is rounded to 0.1 dB, so the curve must be within
    /// 0.05 dB of it, and 1e-3 for the rounded constants of annex E: far within class 1.
    #[test]
    fn a_weighting_is_that_of_the_table_in_iec_61672() {
        for (n, (expected, above, below)) in (-20..).zip(TABLE) {
            let frequency_hz = 1000.0 * 10.0_f64.powf(0.1 * f64::from(n));
            let off = a_weighting_db(frequency_hz) - expected;
            assert!(off.abs() <= 0.051, "{frequency_hz} Hz: off by {off} dB");
            assert!(off < above && off > -below, "{frequency_hz} Hz: class 1 allows +{above} to -{below} dB");
        }
        assert!(a_weighting_db(1000.0).abs() < 1e-3);
        assert_eq!(a_weighting_db(0.0), f64::NEG_INFINITY);
    }
}
