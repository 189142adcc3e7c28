//! Tests of the laws of a disc that turns in the frame of the pad.

use faer::Mat;

use super::law::{ContactLaw, Law, Parameter};
use super::model::{Model, Term};
use super::operating_point::OperatingPoint;
use super::solver::Solver;
use super::spectrum::Vectors;

/// A particle on springs in a frame that turns with `Ω`: `ẍ - 2Ωẏ + (k_x - Ω²) x = 0`,
/// `ÿ + 2Ωẋ + (k_y - Ω²) y = 0`. With `k_x = k_y = ω₀²` its frequencies are `ω₀ ± Ω` for both signs of `Ω`. The
/// derivative of `K` and `C` by the speed is exact, at rest too.
#[test]
fn a_particle_in_a_turning_frame_has_two_circling_motions() {
    let skew = faer::mat![[0.0, -2.0], [2.0, 0.0]];
    let constant = Term { matrix: faer::mat![[1e4, 0.0], [0.0, 1e4]], law: Law::Constant };
    let spin = Term { matrix: faer::mat![[-1.0, 0.0], [0.0, -1.0]], law: Law::DiscSpeed { power: 2 } };
    let gyroscopic = Term { matrix: skew.clone(), law: Law::DiscSpeed { power: 1 } };
    let model = Model::new(2, vec![constant, spin], vec![gyroscopic], ContactLaw::default(), None).unwrap();
    assert_eq!(model.depends_on_load_and_speed(), (false, true));
    assert!(!model.depends_on_load_over_speed_only());
    for speed in [0.0, 13.0, -13.0, 60.0] {
        let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: speed, friction_coefficient: 0.3 };
        assert_eq!(model.is_damped(&p), speed != 0.0);
        let spectrum = Solver::new(2).solve(&model, &p, Vectors::Both).unwrap();
        for (root, expected) in spectrum.modes().iter().zip([100.0 - speed.abs(), 100.0 + speed.abs()]) {
            // Rounding of `λ²` of a double root at rest.
            assert!((root.lambda.im - expected).abs() < 1e-10 && root.lambda.re.abs() < 1e-10, "{root:?}");
        }
        let (mut k, mut c) = (Mat::zeros(2, 2), Mat::zeros(2, 2));
        model.assemble_derivative(&p, Parameter::Speed, &mut k, &mut c).unwrap();
        assert_eq!((k[(0, 0)], k[(0, 1)], &c), (-2.0 * speed, 0.0, &skew));
        for parameter in [Parameter::Friction, Parameter::Load, Parameter::ContactStiffness] {
            model.assemble_derivative(&p, parameter, &mut k, &mut c).unwrap();
            assert_eq!((k.norm_max(), c.norm_max()), (0.0, 0.0));
        }
    }
}

/// The derivatives of `Ω^p x T_k(x / r)` by speed and friction agree with central differences, whose error is
/// about `h²` times the third derivative, and the law vanishes where nothing slides.
#[test]
fn the_expansion_over_friction_times_the_speed_has_its_derivatives() {
    let model = Model::new(1, vec![], vec![], ContactLaw::default(), None).unwrap();
    for (power, degree) in [(1, 0), (1, 3), (2, 2)] {
        let law = Law::DiscSpeedChebyshev { power, degree, range: 1.0 };
        let value = |speed: f64, mu: f64| {
            let p = OperatingPoint { normal_load_n: 1.0, disc_speed_rad_s: speed, friction_coefficient: mu };
            (model.coefficient(&law, &p), p)
        };
        for (speed, mu) in [(13.0, 0.3), (-7.0, 0.6)] {
            let p = value(speed, mu).1;
            let by_speed = (value(speed + 1e-4, mu).0 - value(speed - 1e-4, mu).0) / 2e-4;
            let by_friction = (value(speed, mu + 1e-5).0 - value(speed, mu - 1e-5).0) / 2e-5;
            let scale = 1.0 + by_speed.abs() + by_friction.abs();
            assert!((model.derivative(&law, &p, Parameter::Speed) - by_speed).abs() < 1e-6 * scale);
            assert!((model.derivative(&law, &p, Parameter::Friction) - by_friction).abs() < 1e-6 * scale);
        }
        assert_eq!(value(0.0, 0.3).0, 0.0);
    }
}
