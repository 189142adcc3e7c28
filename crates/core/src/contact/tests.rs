//! States against closed forms, balances, and derivatives against differences.

use faer::Mat;

use super::*;

const STIFFNESS: f64 = 2e7;

/// A rigid block of half length 1 with `c` contact springs along its base, pressed by `F` at height 0 above its centre;
/// friction acts `arm` below the point about which moments are taken. It translates and tilts: gap `ρ_0 + ρ_1 x`.
fn block(c: usize, arm: f64, law: PressureLaw) -> Statics {
    let place = |k: usize| -1.0 + 2.0 * k as f64 / (c - 1) as f64;
    Statics::new(StaticsParts {
        law,
        area: vec![1.0; c],
        gap_m: vec![0.0; c],
        response: StaticResponse {
            normal_flexibility: Mat::zeros(c, c),
            sliding_flexibility: Mat::zeros(c, c),
            gap_per_load: vec![0.0; c],
            rigid: RigidMotions {
                normal: Mat::from_fn(c, 2, |k, motion| if motion == 0 { 1.0 } else { place(k) }),
                sliding: Mat::from_fn(c, 2, |_, motion| if motion == 0 { 0.0 } else { arm }),
                load: vec![-1.0, 0.0],
            },
        },
        measured: MeasuredLoad::Back,
    })
    .unwrap()
}

fn linear() -> PressureLaw {
    PressureLaw::Linear { stiffness: STIFFNESS }
}

/// Moment about the centre: `Σ N_k x_k = -μ arm F`. With closures linear in `x` and only the pairs `k ≤ last` closed, two
/// sums over these give translation and tilt in closed form; which pairs are closed follows from the sign of the closures.
fn expected_block(c: usize, arm: f64, mu: f64, load: f64) -> Vec<f64> {
    let place = |k: usize| -1.0 + 2.0 * k as f64 / (c - 1) as f64;
    for closed in (2..=c).rev() {
        let sum = |power: i32| (0..closed).map(|k| place(k).powi(power)).sum::<f64>() * STIFFNESS;
        let (s0, s1, s2) = (sum(0), sum(1), sum(2));
        let determinant = s0 * s2 - s1 * s1;
        let moment = -mu * arm * load;
        // δ = α + β x with Σ k δ = F and Σ k δ x = M.
        let alpha = (s2 * load - s1 * moment) / determinant;
        let beta = (s0 * moment - s1 * load) / determinant;
        let force: Vec<f64> = (0..c).map(|k| STIFFNESS * (alpha + beta * place(k)).max(0.0)).collect();
        if (0..c).all(|k| (force[k] > 0.0) == (k < closed)) {
            return force;
        }
    }
    unreachable!("no set of closed pairs fits")
}

/// The block tips when the centre of pressure, at `-μ arm`, reaches the last pair, at -1.
#[test]
fn a_rigid_block_against_the_closed_form() {
    let (c, arm, load) = (9, 1.7, 320.0);
    let statics = block(c, arm, linear());
    for mu in [0.0, 0.05, 0.1, 0.2, 0.31, 0.4, 0.5, 0.55, 0.58] {
        let state = statics.state(load, mu).unwrap();
        let expected = expected_block(c, arm, mu, load);
        for (found, expected) in state.force_n.iter().zip(&expected) {
            assert!((found - expected).abs() < 1e-10 * load, "{mu}: {:?}, {expected:?}", state.force_n);
        }
        assert_eq!(state.pairs_closed(), expected.iter().filter(|force| **force > 0.0).count());
    }
    let error = statics.state(load, 0.7).unwrap_err();
    let StaticsError::NoEquilibrium { friction_coefficient, end, .. } = error else { panic!("{error}") };
    assert_eq!(end, PathEnd::Tips);
    assert!((friction_coefficient - 1.0 / arm).abs() < 1e-10, "{friction_coefficient}");
}

/// One pair on a spring whose wedge turns friction into normal force: `(1/k + g (1 - μ τ)) N = F a`, so that
/// `N = F a / (1/k + g - g τ μ)`, which has no bound at `μ = (1 + 1/(k g)) / τ`. The measured contact force needs the
/// back force `F = N (1/k + g - g τ μ) / a`, which vanishes there.
#[test]
fn a_wedge_jams_where_its_closed_form_does() {
    let (g, tau, a, load) = (3e-8, 1.9, -2.5e-8, 500.0);
    for measured in [MeasuredLoad::Back, MeasuredLoad::Contact] {
        let parts = StaticsParts {
            law: linear(),
            area: vec![1.0],
            gap_m: vec![0.0],
            response: StaticResponse {
                normal_flexibility: Mat::from_fn(1, 1, |_, _| g),
                sliding_flexibility: Mat::from_fn(1, 1, |_, _| -g * tau),
                gap_per_load: vec![a],
                rigid: RigidMotions { normal: Mat::zeros(1, 0), sliding: Mat::zeros(1, 0), load: vec![] },
            },
            measured,
        };
        let statics = Statics::new(parts).unwrap();
        let flexibility = |mu: f64| 1.0 / STIFFNESS + g - g * tau * mu;
        for mu in [-0.4, 0.0, 0.3, 0.6, 1.0, 1.4] {
            let state = statics.state(load, mu).unwrap();
            let (force, back) = match measured {
                MeasuredLoad::Back => (-load * a / flexibility(mu), load),
                MeasuredLoad::Contact => (load, -load * flexibility(mu) / a),
            };
            assert!((state.force_n[0] / force - 1.0).abs() < 1e-12, "{measured:?} {mu}: {state:?}");
            assert!((state.back_force_n / back - 1.0).abs() < 1e-12, "{measured:?} {mu}: {state:?}");
        }
        let jam = (1.0 + 1.0 / (STIFFNESS * g)) / tau;
        assert!(statics.state(load, jam - 1e-6).is_ok());
        let error = statics.state(load, jam + 1e-3).unwrap_err();
        let StaticsError::NoEquilibrium { friction_coefficient, end, .. } = error else { panic!("{error}") };
        assert_eq!(end, PathEnd::Jams, "{measured:?}");
        assert!((friction_coefficient / jam - 1.0).abs() < 1e-10, "{friction_coefficient} {jam}");
    }
}
