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

/// Numbers in (-1, 1) that depend on `seed` and two places.
fn scatter(seed: u64, i: usize, j: usize) -> f64 {
    let mut word =
        seed ^ (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (j as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F);
    for _ in 0..3 {
        word ^= word >> 31;
        word = word.wrapping_mul(0xD6E8_FEB8_6659_FD93);
    }
    word ^= word >> 32;
    (word >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

fn laws() -> Vec<PressureLaw> {
    let power = |exponent, roughness_m| PressureLaw::Power { stiffness: 2e7, reference_m: 2e-6, exponent, roughness_m };
    let table = [0.0, 1e-6, 2e-6, 4e-6, 1e-5, 1e-3];
    vec![
        linear(),
        power(1.5, 0.0),
        power(2.0, 0.0),
        power(2.0, 3e-7),
        PressureLaw::Exponential { pressure: 1.0, roughness_m: 5e-7 },
        PressureLaw::Table(PressureTable::new(&table, &[0.0, 3.0, 12.0, 60.0, 400.0, 1e5]).unwrap()),
        PressureLaw::Table(PressureTable::new(&table, &[1.0, 5.0, 12.0, 60.0, 400.0, 1e5]).unwrap()),
    ]
}

/// A pad of `c` pairs with a few elastic modes, two rigid motions (translation and tilt) or none, and gaps of some
/// micrometres.
fn random(seed: u64, c: usize, law: PressureLaw, floating: bool, measured: MeasuredLoad) -> Statics {
    let modes = c + 2;
    let place = |k: usize| if c == 1 { 0.0 } else { -1.0 + 2.0 * k as f64 / (c - 1) as f64 };
    let rigid = if floating { 2 } else { 0 };
    let squared: Vec<f64> = (0..rigid)
        .map(|_| 0.0)
        .chain((0..modes).map(|j| 2e7 * (1.0 + 3.0 * j as f64 * (1.0 + scatter(seed, 7, j)))))
        .collect();
    let n = squared.len();
    let normal = Mat::from_fn(c, n, |k, j| match j {
        0 if floating => 1.0,
        1 if floating => place(k),
        // The first elastic mode presses all pairs together.
        j if j == rigid => 1.0 + 0.2 * scatter(seed, k, j),
        j => scatter(seed, k, j),
    });
    let sliding = Mat::from_fn(c, n, |k, j| match j {
        0 if floating => 0.0,
        1 if floating => 0.4,
        j => 0.7 * scatter(seed, k + 100, j),
    });
    let load: Vec<f64> = (0..n)
        .map(|j| match j {
            0 if floating => -1.0,
            1 if floating => 0.1,
            j if j == rigid => -1.0,
            j => 0.3 * scatter(seed, 900, j),
        })
        .collect();
    let modes = FreeModes { omega_squared: &squared, normal: normal.as_ref(), sliding: sliding.as_ref(), load: &load };
    let response = StaticResponse::from_modes(&modes, None).unwrap();
    Statics::new(StaticsParts {
        law,
        area: (0..c).map(|k| 1.0 + 0.3 * scatter(seed, k, 31)).collect(),
        gap_m: (0..c).map(|k| 2e-6 * scatter(seed, k, 77)).collect(),
        response,
        measured,
    })
    .unwrap()
}

/// The largest imbalance of closures (relative to the largest term), of forces and moments on rigid motions, and of the
/// measured contact force. Written out from the equations, with loops of its own.
fn imbalance(statics: &Statics, state: &SteadyState) -> f64 {
    let StaticsParts { law, area, gap_m, response, measured } = statics.parts();
    let (c, force) = (statics.pairs(), state.back_force_n);
    let mut worst = 0.0f64;
    let mut largest = 0.0f64;
    let mut left = 0.0f64;
    for k in 0..c {
        let mut terms = vec![state.closure_m[k], gap_m[k], force * response.gap_per_load[k]];
        for j in 0..c {
            let flexibility =
                response.normal_flexibility[(k, j)] + state.friction * response.sliding_flexibility[(k, j)];
            terms.push(flexibility * state.force_n[j]);
        }
        terms.extend(state.rigid.iter().enumerate().map(|(j, amplitude)| response.rigid.normal[(k, j)] * amplitude));
        left = left.max(terms.iter().sum::<f64>().abs());
        largest = largest.max(terms.iter().map(|term| term.abs()).sum());
        let expected = area[k] * law.at(state.closure_m[k]).pressure;
        assert_eq!(state.force_n[k], expected);
    }
    worst = worst.max(left / largest);
    for j in 0..state.rigid.len() {
        let terms: Vec<f64> = (0..c)
            .map(|k| {
                let along = response.rigid.normal[(k, j)] + state.friction * response.rigid.sliding[(k, j)];
                along * state.force_n[k]
            })
            .chain([force * response.rigid.load[j]])
            .collect();
        worst = worst.max(terms.iter().sum::<f64>().abs() / terms.iter().map(|term| term.abs()).sum::<f64>());
    }
    if *measured == MeasuredLoad::Contact {
        worst = worst.max((state.contact_force_n() / state.load_n - 1.0).abs());
    }
    worst
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(200))]

    /// Every returned state balances. A sum of `c` terms is accurate to a few `c` rounding errors; forces magnify these by
    /// `k δ/N`.
    #[test]
    fn every_state_balances_forces_and_moments(
        seed in 0u64..1_000_000, c in 1usize..12, law in 0usize..7, floating: bool, contact: bool,
        load in 0.01f64..300.0, mu in -0.6f64..0.6,
    ) {
        let measured = if contact { MeasuredLoad::Contact } else { MeasuredLoad::Back };
        let statics = random(seed, c, laws()[law].clone(), floating && c > 1, measured);
        match statics.state(load, mu) {
            Ok(state) => {
                let left = imbalance(&statics, &state);
                proptest::prop_assert!(left < 1e-11, "{left:e}, claimed {:e}", state.residual);
            }
            Err(StaticsError::NoEquilibrium { friction_coefficient, .. }) => {
                proptest::prop_assert!(friction_coefficient.abs() <= mu.abs());
            }
            Err(error) => proptest::prop_assert!(false, "{error}"),
        }
    }
}

/// Central differences of converged states: a step of 1e-5 leaves a truncation error of about 1e-8 of the value for laws
/// that vary over a roughness height, and the states' own 1e-13 divided by the step.
#[test]
fn derivatives_agree_with_differences_of_states() {
    let mut compared = 0;
    for (index, law) in laws().into_iter().enumerate() {
        for (floating, measured) in
            [(false, MeasuredLoad::Back), (true, MeasuredLoad::Back), (false, MeasuredLoad::Contact)]
        {
            let statics = random(17 + index as u64, 6, law.clone(), floating, measured);
            let (load, mu) = (40.0, 0.21);
            let state = statics.state(load, mu).unwrap();
            for (slope, [low, high], step) in [
                (&state.per_load, [(load * (1.0 - 1e-5), mu), (load * (1.0 + 1e-5), mu)], load * 2e-5),
                (&state.per_friction, [(load, mu - 1e-5), (load, mu + 1e-5)], 2e-5),
            ] {
                let [low, high] = [low, high].map(|(load, mu)| statics.state(load, mu).unwrap());
                let close = |found: &[f64], low: &[f64], high: &[f64], of: &[f64], what: &str| {
                    let largest = found.iter().chain(of).fold(0.0f64, |most, value| most.max(value.abs()));
                    for k in 0..found.len() {
                        let difference = (high[k] - low[k]) / step;
                        assert!(
                            (found[k] - difference).abs() < 2e-6 * largest,
                            "{law:?} {floating} {measured:?} {what} {k}: {} {difference}",
                            found[k]
                        );
                    }
                };
                close(&slope.closure, &low.closure_m, &high.closure_m, &[], "closure");
                close(&slope.force, &low.force_n, &high.force_n, &[], "force");
                close(&slope.tangent, &low.tangent_n_per_m, &high.tangent_n_per_m, &[1.0], "tangent");
                close(&[slope.back_force], &[low.back_force_n], &[high.back_force_n], &[1e-3], "back force");
                close(&slope.rigid, &low.rigid, &high.rigid, &[], "rigid");
                compared += 1;
            }
        }
    }
    assert_eq!(compared, 42);
}

/// With a linear law and no gaps all forces are proportional to the load and closed pairs do not change.
#[test]
fn a_linear_law_without_gaps_scales_with_the_load() {
    let mut parts = random(5, 8, linear(), false, MeasuredLoad::Back).parts().clone();
    parts.gap_m.fill(0.0);
    let statics = Statics::new(parts).unwrap();
    let [small, large] = [1e-9, 1e3].map(|load| statics.state(load, 0.3).unwrap());
    assert_eq!(small.pairs_closed(), large.pairs_closed());
    for (small, large) in small.force_n.iter().zip(&large.force_n) {
        assert!((small / 1e-9 - large / 1e3).abs() < 1e-12);
    }
}

#[test]
fn limits_of_load_and_gap() {
    let parts = |law: PressureLaw, gap: f64, floating: bool| {
        let mut parts = random(3, 5, law, floating, MeasuredLoad::Back).parts().clone();
        parts.gap_m.fill(gap);
        Statics::new(parts).unwrap()
    };
    // A supported pad that the load does not bring into contact: all open, no force, no tangent.
    for law in laws() {
        let statics = parts(law.clone(), 1e-2, false);
        let state = statics.state(1.0, 0.4).unwrap();
        assert!(state.force_n.iter().sum::<f64>() < 1e-9, "{law:?}");
        if law.opens() {
            assert_eq!(state.pairs_closed(), 0);
            assert!(state.tangent_n_per_m.iter().all(|tangent| *tangent == 0.0));
            // At load 0 the closures are the gaps.
            let state = statics.state(0.0, 0.4).unwrap();
            assert!(state.closure_m.iter().all(|closure| *closure == -1e-2), "{state:?}");
        }
    }
    // Without gaps and load, power laws have zero tangent; the state exists and balances.
    for law in laws() {
        let statics = parts(law, 0.0, false);
        for load in [0.0, 1e-12, 1e-6] {
            let state = statics.state(load, 0.4).unwrap();
            assert!(imbalance(&statics, &state) < 1e-11, "{load}");
        }
    }
    // A floating pad needs a load.
    let floating = parts(linear(), 0.0, true);
    for load in [0.0, -1.0] {
        assert!(matches!(floating.state(load, 0.1), Err(StaticsError::Condition { what: "load", .. })));
    }
    assert!(floating.state(1e-12, 0.1).is_ok());
    assert!(matches!(floating.state(f64::NAN, 0.1), Err(StaticsError::Condition { .. })));
}

/// One pair carries everything once the others are far apart; then a second one closes at a load that the first one's
/// closure gives, and states on either side of that load, 1e-12 apart, agree.
#[test]
fn a_second_pair_closes_at_the_load_of_its_gap() {
    let gap = 3e-6;
    let statics = Statics::new(StaticsParts {
        law: linear(),
        area: vec![1.0; 2],
        gap_m: vec![0.0, gap],
        response: StaticResponse {
            normal_flexibility: Mat::zeros(2, 2),
            sliding_flexibility: Mat::zeros(2, 2),
            gap_per_load: vec![0.0; 2],
            rigid: RigidMotions { normal: Mat::from_fn(2, 1, |_, _| 1.0), sliding: Mat::zeros(2, 1), load: vec![-1.0] },
        },
        measured: MeasuredLoad::Back,
    })
    .unwrap();
    let closes = STIFFNESS * gap;
    let states = [0.5, 1.0 - 1e-12, 1.0 + 1e-12, 2.0].map(|share| statics.state(share * closes, 0.0).unwrap());
    assert_eq!(states.each_ref().map(SteadyState::pairs_closed), [1, 1, 2, 2]);
    assert!((states[1].force_n[0] - states[2].force_n[0]).abs() < 1e-11 * closes);
    assert!((states[3].force_n[0] - 1.5 * closes).abs() < 1e-12 * closes);
    assert!((states[3].force_n[1] - 0.5 * closes).abs() < 1e-12 * closes);
}

/// States started from anchors are those continued from `s_mu = 0`, and repeated solutions have the same bits.
#[test]
fn anchors_change_states_by_rounding_only() {
    for (index, law) in laws().into_iter().enumerate() {
        for (floating, measured) in
            [(false, MeasuredLoad::Back), (true, MeasuredLoad::Back), (false, MeasuredLoad::Contact)]
        {
            let plain = random(40 + index as u64, 7, law.clone(), floating, measured);
            let anchored =
                plain.clone().with_anchors(&[10.0, 20.0, 40.0, 80.0], &[-0.3, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4]);
            assert!(anchored.anchors() > 20, "{law:?}: {}", anchored.anchors());
            for k in 0..30 {
                let (load, mu) = (8.0 + 3.1 * f64::from(k), 0.45 * f64::from(k % 7) / 7.0 - 0.1);
                let (Ok(expected), found) = (plain.state(load, mu), anchored.state(load, mu)) else { continue };
                let found = found.unwrap();
                assert_eq!(found, anchored.state(load, mu).unwrap());
                assert!(imbalance(&anchored, &found) < 1e-11);
                let largest = expected.force_n.iter().fold(0.0f64, |most, force| most.max(*force));
                for (found, expected) in found.force_n.iter().zip(&expected.force_n) {
                    assert!((found - expected).abs() < 1e-9 * largest, "{law:?} {load} {mu}: {found} {expected}");
                }
                let slopes = found.per_friction.force.iter().zip(&expected.per_friction.force);
                let largest = slopes.clone().fold(0.0f64, |most, (_, slope)| most.max(slope.abs()));
                for (found, expected) in slopes {
                    assert!((found - expected).abs() < 1e-8 * largest, "{law:?} {load} {mu}: {found} {expected}");
                }
            }
        }
    }
}

/// A floating pad, crowned by 2 micrometres and elastic like a half-space, has a state at every load, whichever pairs it
/// closes; neighbouring loads close as many or more.
#[test]
fn a_crowned_pad_has_a_state_at_every_load() {
    let (across, along, pitch) = (8, 13, 2e-3);
    let c = across * along;
    let place = |k: usize| {
        [(k % across) as f64 - 0.5 * (across - 1) as f64, (k / across) as f64 - 0.5 * (along - 1) as f64]
            .map(|x| pitch * x)
    };
    for law in
        [linear(), PressureLaw::Power { stiffness: STIFFNESS, reference_m: 1e-5, exponent: 2.0, roughness_m: 0.0 }]
    {
        let distance = |i: usize, j: usize| (place(i)[0] - place(j)[0]).hypot(place(i)[1] - place(j)[1]);
        let statics = Statics::new(StaticsParts {
            law,
            area: vec![1.0; c],
            gap_m: (0..c).map(|k| 2e-6 * (place(k)[1] / (0.5 * along as f64 * pitch)).powi(2)).collect(),
            response: StaticResponse {
                normal_flexibility: Mat::from_fn(c, c, |i, j| {
                    1.0 / (std::f64::consts::PI * 2e9 * if i == j { 0.28 * pitch } else { distance(i, j) })
                }),
                sliding_flexibility: Mat::zeros(c, c),
                gap_per_load: vec![0.0; c],
                rigid: RigidMotions {
                    normal: Mat::from_fn(c, 3, |k, j| if j == 0 { 1.0 } else { place(k)[j - 1] / pitch }),
                    sliding: Mat::from_fn(c, 3, |_, j| if j == 2 { 4.0 } else { 0.0 }),
                    load: vec![-1.0, 0.0, 0.0],
                },
            },
            measured: MeasuredLoad::Back,
        })
        .unwrap();
        let mut before = 0;
        for step in 0..40 {
            let load = 30.0 * 1.15f64.powi(step);
            let state = statics.state(load, 0.0).unwrap();
            assert!(imbalance(&statics, &state) < 1e-11);
            assert!(state.pairs_closed() >= before, "{load} N: {} after {before}", state.pairs_closed());
            before = state.pairs_closed();
        }
        assert_eq!(before, c);
    }
}
