//! Tests of the session.

use super::*;
use crate::physics::{ContactLaw, CustomLaw, Law, Term};

/// Case 2 of the paper's 9-degree-of-freedom model: unstable from 0.35592805826058 on.
fn session() -> Session {
    let rig = Arc::new(Rig::load("nine-dof-case-2").expect("an embedded rig"));
    let settings = Settings::for_rig(&rig);
    Session::new(rig, settings)
}

fn conditions(seq: u64, load: f64, speed: f64, mu: f64) -> Event {
    Event::Input(msgs::OperatingPoint {
        header: Header { stamp: Time::from_ns(1_000_000_000 + 1_000_000 * seq as i64), ..Default::default() },
        seq,
        normal_load_n: load,
        disc_speed_rad_s: speed,
        friction_coefficient: mu,
    })
}

fn friction(seq: u64, mu: f64) -> Event {
    conditions(seq, 500.0, 13.0, mu)
}

fn predict(session: &mut Session, event: Event) -> Prediction {
    let effects = session.step(event).expect("no setting is changed");
    effects.publish.expect("every input is answered").clone()
}

fn with_map(mut session: Session) -> Session {
    let point = session.rig.reference;
    let map = StabilityMap::build(&session.rig.model, &mut session.solver, &point, &map_options(&session.rig));
    session.step(Event::MapReady(Arc::new(map.expect("the rig can be mapped")))).unwrap();
    session
}

#[test]
fn margin_is_pending_until_the_map_is_there() {
    let mut session = session();
    let effects = session.step(friction(0, 0.3)).unwrap();
    assert!(matches!(effects.request, Some(Request::Map(_))));
    let pending = predict(&mut session, friction(1, 0.31));
    assert!(pending.friction_margin.is_nan() && pending.reason == "margin pending");
    let mut session = with_map(session);
    let effects = session.step(friction(2, 0.3)).unwrap();
    assert_eq!(effects.request, None, "the rig knows no load or speed");
    let ready = predict(&mut session, friction(3, 0.2));
    assert!((ready.friction_margin - (0.35592805826058 - 0.2)).abs() < 1e-10 && ready.reason.is_empty());
    assert!((ready.critical_friction - 0.35592805826058).abs() < 1e-10);
}

/// Friction acts along the direction of rotation, so that the windows differ with it.
#[test]
fn a_map_holds_for_one_direction_of_rotation() {
    let mut session = with_map(session());
    assert!(predict(&mut session, conditions(0, 500.0, 13.0, 0.3)).friction_margin > 0.05);
    let back = predict(&mut session, conditions(1, 500.0, -13.0, 0.3));
    assert!(back.friction_margin.is_nan() && back.reason.ends_with("margin pending"), "{back:?}");
    let effects = session.step(conditions(2, 500.0, -13.0, 0.31)).unwrap();
    assert!(
        matches!(effects.request, Some(Request::Map(point)) if point.disc_speed_rad_s == -13.0),
        "{:?}",
        effects.request
    );
}

#[test]
fn levels_follow_margin_and_damping_ratio_with_hysteresis() {
    let mut session = with_map(session());
    let mut level_at = |seq, mu| predict(&mut session, friction(seq, mu)).level;
    assert_eq!(level_at(0, 0.30), level::OK);
    assert_eq!(level_at(1, 0.32), level::WARN, "margin 0.036 is below 0.05");
    assert_eq!(level_at(2, 0.40), level::SQUEAL);
    // Near the merging point ζ = -√(c (μ - μc)). Between -1e-3 and -5e-4 the level depends on the previous one
    // (hysteresis).
    let mut fresh = self::session();
    let between = (0..40_000).map(|k| (k, 0.355928 + 1e-8 * k as f64)).find(|&(k, mu)| {
        let worst = |p: Prediction| p.modes.iter().map(|mode| mode.damping_ratio).fold(f64::INFINITY, f64::min);
        (-0.9e-3..-0.6e-3).contains(&worst(predict(&mut fresh, friction(k, mu))))
    });
    let (_, mu) = between.expect("growth rates are continuous");
    assert_eq!(level_at(3, mu), level::SQUEAL, "coming from above");
    assert_eq!(level_at(4, 0.2), level::OK);
    assert_eq!(level_at(5, mu), level::WARN, "coming from below");
}

#[test]
fn bad_and_stale_inputs_are_faults_without_modes() {
    let mut session = session();
    predict(&mut session, friction(10, 0.3));
    let cases = [
        (conditions(11, f64::NAN, 13.0, 0.3), "normal_load_n is NaN"),
        (conditions(12, 500.0, f64::INFINITY, 0.3), "disc_speed_rad_s is inf"),
        (conditions(13, 2e6, 13.0, 0.3), "normal_load_n is 2000000, expected 0 to 1000000"),
        (conditions(14, 500.0, 13.0, 2.5), "friction_coefficient is 2.5, expected 0 to 2"),
        (friction(5, 0.3), "stamp runs backward by 0.009000 s"),
        (Event::Silence { stamp: Time::from_ns(5_000_000_000) }, "stale: no input for 1 s"),
    ];
    for (event, reason) in cases {
        let fault = predict(&mut session, event);
        assert_eq!(fault.level, level::FAULT);
        assert!(fault.reason.contains(reason), "`{}` does not contain `{reason}`", fault.reason);
        assert!(fault.modes.is_empty() && fault.friction_margin.is_nan() && !fault.reused);
    }
    assert_eq!(predict(&mut session, friction(15, 0.3)).level, level::OK, "the next good input is predicted");
}

#[test]
fn conditions_within_the_dead_band_reuse_the_previous_prediction() {
    let mut session = with_map(session());
    let first = predict(&mut session, friction(0, 0.3));
    let second = predict(&mut session, friction(1, 0.3));
    assert!(!first.reused && second.reused);
    assert_eq!(second.input_seq, 1);
    // Compared as text, because NaN does not equal itself.
    assert_eq!(format!("{:?}", second.modes), format!("{:?}", first.modes));
    assert!(!predict(&mut session, friction(2, 0.3001)).reused, "the default dead-band is exact equality");
    session.step(Event::Parameter { name: "dead_band_friction".to_owned(), value: 0.01 }).unwrap();
    assert!(!predict(&mut session, friction(3, 0.3)).reused, "a changed setting is no reason to reuse");
    assert!(predict(&mut session, friction(4, 0.309)).reused);
    assert!(
        !predict(&mut session, friction(5, 0.311)).reused,
        "measured from what was solved, not from what was reused"
    );
    let counters = session.counters();
    assert_eq!((counters.solved, counters.charted, counters.reused, counters.faults), (4, 0, 2, 0));
}

/// The contact of this rig stiffens with load. Between two loads at which the window ends were computed, the error of
/// the margin is within its bound; at those loads the margin is exact.
#[test]
fn the_margin_follows_the_load_and_is_exact_where_it_rests() {
    use crate::proof::synthetic::{Synthetic, rig};
    let law = crate::physics::ContactLaw { exponent: 0.4, ..Default::default() };
    let model = rig(&Synthetic { modes: 24, pairs: 12, damping_ratio: 0.0, contact_law: law, seed: 1 }).unwrap();
    let like = Rig::load("nine-dof-case-2").expect("embedded");
    let rig = Arc::new(Rig { model, band_max_hz: None, mu_max: 2.0, ..like });
    let session = Session::new(rig.clone(), Settings::for_rig(&rig));
    let mut session = with_map(session);
    let mut solver = Solver::new(rig.model.dimension());
    let mut exact_at = |load: f64| {
        let point = OperatingPoint { normal_load_n: load, ..rig.reference };
        StabilityMap::build(&rig.model, &mut solver, &point, &map_options(&rig)).unwrap().windows[0].mu_from
    };
    let (mut seq, mut largest) = (0, 0.0f64);
    for load in [498.0, 501.0, 502.0] {
        let truth = exact_at(load);
        let mut asked = None;
        for _ in 0..300 {
            seq += 1;
            // The friction coefficient changes a little, so that no prediction is reused.
            let input = conditions(seq, load, 13.0, 1e-4 * (seq % 10) as f64);
            let effects = session.step(input).unwrap();
            let prediction = effects.publish.unwrap();
            let off = (prediction.critical_friction - truth).abs();
            assert!(off <= prediction.friction_margin_error + 1e-12, "{load} N: {off} {prediction:?}");
            if let Some(Request::Ends(point)) = effects.request {
                largest = largest.max(off);
                assert!(asked.replace(point).is_none(), "{load} N: requested once");
                let map = session.map().cloned().unwrap();
                let ends = Ends::carried(&rig.model, &mut session.solver, &map, &point).unwrap().unwrap();
                session.step(Event::EndsReady(Arc::new(ends))).unwrap();
            }
        }
        assert!(asked.is_some(), "{load} N");
        let rests = predict(&mut session, conditions(seq + 1, load, 13.0, 1e-3));
        assert!((rests.critical_friction - truth).abs() < 1e-10 && rests.friction_margin_error < 1e-10, "{rests:?}");
        seq += 1;
    }
    assert!(largest > 1e-10, "worth testing: extrapolation is off by {largest}");
}

/// A charted and a solved prediction at the same conditions: same identities, same level, every value within its error
/// bound.
#[test]
fn a_chart_predicts_the_same_as_a_solve() {
    let (mut solved, mut charted) = (with_map(session()), with_map(session()));
    let chart = crate::physics::chart::build::build(&charted.rig.model, &chart_options(&charted.rig), &|_| true);
    charted.step(Event::ChartReady(Arc::new(chart.expect("the rig can be charted")))).unwrap();
    for seq in 0..400 {
        let mu = 0.005 * seq as f64 + 1e-4;
        let (a, b) = (predict(&mut solved, friction(seq, mu)), predict(&mut charted, friction(seq, mu)));
        assert_eq!((a.level, a.unstable_modes, a.modes.len()), (b.level, b.unstable_modes, b.modes.len()), "{mu}");
        for (a, b) in a.modes.iter().zip(&b.modes) {
            assert_eq!(a.id, b.id, "{mu}");
            let frequency = (a.frequency_hz - b.frequency_hz).abs();
            assert!(frequency <= a.frequency_error_hz + b.frequency_error_hz, "{mu}: {a:?} {b:?}");
            let growth = (a.growth_rate_per_s - b.growth_rate_per_s).abs();
            assert!(growth <= a.growth_rate_error_per_s + b.growth_rate_error_per_s, "{mu}: {a:?} {b:?}");
            assert!(b.frequency_error_hz < 1e-6 * b.frequency_hz, "a bound that says something: {b:?}");
        }
    }
    assert_eq!((charted.counters().charted, charted.counters().solved), (400, 0));
    let backwards = predict(&mut charted, conditions(1000, 500.0, -13.0, 0.3));
    assert!(charted.counters().solved == 1 && backwards.modes.len() == 9, "the other direction is solved");
    assert!(backwards.reason.contains("not charted here: solved"), "{}", backwards.reason);
}

#[test]
fn settings_are_validated() {
    let mut session = session();
    let set = |session: &mut Session, name: &str, value| {
        session.step(Event::Parameter { name: name.to_owned(), value }).map(drop).map_err(|e| e.to_string())
    };
    assert!(set(&mut session, "warn_margin", f64::NAN).unwrap_err().contains("`warn_margin` = NaN: expected"));
    assert!(set(&mut session, "dead_band_load_n", -1.0).unwrap_err().contains("0 to 1000000"));
    assert!(set(&mut session, "volume", 11.0).unwrap_err().contains("no parameter `volume`; there are warn_margin"));
    assert_eq!(session.settings().warn_margin, 0.05, "nothing was changed");
    assert_eq!(set(&mut session, "warn_margin", 0.1), Ok(()));
}

#[test]
fn a_contact_that_does_not_slide_is_said_to() {
    let mut session = with_map(session());
    let still = predict(&mut session, conditions(0, 500.0, 0.005, 1.0));
    assert_eq!((still.level, still.unstable_modes), (level::OK, 0));
    assert!(still.reason.contains("not sliding") && still.friction_margin.is_nan());
    let open = predict(&mut session, conditions(1, 0.0, 13.0, 1.0));
    assert!(open.reason.contains("contact open") && open.unstable_modes == 0);
}

/// The level is OK down to 0.0501 below a window and WARN from 0.0499 on. The margin is the distance to the nearest
/// end.
#[test]
fn the_margin_warns_below_its_limit_and_not_before() {
    let mut session = with_map(session());
    for (seq, below, expected) in [(0, 0.0501, level::OK), (1, 0.0499, level::WARN), (2, 0.0375, level::WARN)] {
        let found = predict(&mut session, friction(seq, 0.35592805826058 - below));
        assert_eq!(found.level, expected, "{below}: {}", found.reason);
        assert_eq!(found.reason.is_empty(), expected == level::OK, "{}", found.reason);
        if expected == level::WARN {
            assert_eq!(found.reason, format!("friction margin {below:.4} below 0.05"));
        }
    }
}

/// Critical friction coefficient, margin and error refer to the same end: the nearest one of the union of windows.
#[test]
fn critical_friction_is_the_end_that_the_margin_is_measured_to() {
    let mut session = with_map(session());
    let map = session.map().cloned().unwrap();
    let (mut inside, mut outside) = (0, 0);
    for seq in 0..200 {
        let mu = 0.01 * seq as f64 + 1e-3;
        let found = predict(&mut session, friction(seq, mu));
        let next = map.next_window(&map.ends, &session.rig.reference.with_friction(mu)).expect("there are windows");
        let said = (found.critical_friction, found.friction_margin, found.friction_margin_error);
        assert_eq!(said, (next.end.mu, next.end.margin, next.end.error), "mu {mu}");
        let in_one = map.windows.iter().any(|w| w.mu_from <= mu && w.mu_to.is_none_or(|to| mu <= to));
        let distance = (found.critical_friction - mu).abs();
        assert_eq!(found.friction_margin, if in_one { -distance } else { distance }, "mu {mu}");
        let ends = map.windows.iter().flat_map(|w| [Some(w.mu_from), w.mu_to]).flatten();
        let nearest = ends.map(|end| (end - mu).abs()).fold(f64::INFINITY, f64::min);
        // Ends covered by another window do not count.
        assert!(distance >= nearest - 1e-12, "mu {mu}");
        *(if in_one { &mut inside } else { &mut outside }) += 1;
    }
    assert!(inside > 20 && outside > 20, "{inside} {outside}");
}

#[test]
fn a_reason_names_the_limit_that_decides() {
    let mut session = with_map(session());
    session.step(Event::Parameter { name: "squeal_hysteresis".to_owned(), value: 0.5 }).unwrap();
    let squeals = predict(&mut session, friction(0, 0.4));
    assert!(squeals.level == level::SQUEAL && squeals.reason.ends_with(" below -0.001"), "{}", squeals.reason);
    // Far below the window no mode grows, but the hysteresis keeps the level.
    let held = predict(&mut session, friction(1, 0.2));
    assert!(
        held.level == level::SQUEAL && held.reason.ends_with("damping ratio 0, squeal ends at 0.499"),
        "{}",
        held.reason
    );
}

/// If several modes squeal, the reason names the fastest growing one, as the prediction does.
#[test]
fn the_reason_names_the_fastest_of_the_modes_that_squeal() {
    // Growth rates 1, 3 and 2 1/s. The slowest growing mode has the lowest frequency and the most negative damping
    // ratio.
    let mut session = of(decoupled(&[(10.0, -2.0), (1000.0, -6.0), (2000.0, -4.0)]));
    let found = predict(&mut session, friction(0, 0.3));
    assert_eq!(found.level, level::SQUEAL);
    assert!(found.reason.starts_with("mode 1 at 159.15 Hz: damping ratio -0.00300 below"), "{}", found.reason);
    assert!((found.worst_frequency_hz - 159.15).abs() < 0.01 && (found.max_growth_rate_per_s - 3.0).abs() < 1e-9);
}

/// A session whose rig has decoupled coordinates `λ² + c λ + ω² = 0`, given as `(ω, c)`.
fn decoupled(modes: &[(f64, f64)]) -> Model {
    let n = modes.len();
    let diagonal = |of: &dyn Fn(usize) -> f64| Term {
        matrix: faer::Mat::from_fn(n, n, |i, j| if i == j { of(i) } else { 0.0 }),
        law: Law::Constant,
    };
    let (stiffness, damping) = (diagonal(&|k| modes[k].0 * modes[k].0), diagonal(&|k| modes[k].1));
    Model::new(n, vec![stiffness], vec![damping], ContactLaw::default(), None).expect("well formed")
}

fn of(model: Model) -> Session {
    let like = Rig::load("nine-dof-case-2").expect("embedded");
    let rig = Arc::new(Rig { model, band_max_hz: None, ..like });
    Session::new(rig.clone(), Settings::for_rig(&rig))
}

/// With more modes than a message can hold, the fastest decaying ones are omitted.
#[test]
fn above_64_modes_the_slowest_growing_are_left_out() {
    let modes: Vec<(f64, f64)> = (0..66).map(|k| (100.0 + k as f64, if k % 40 == 7 { 5.0 } else { 1.0 })).collect();
    let found = predict(&mut of(decoupled(&modes)), friction(0, 0.3));
    let ids: Vec<u32> = found.modes.iter().map(|mode| mode.id).collect();
    let expected: Vec<u32> = (0..66).filter(|k| k % 40 != 7).collect();
    assert_eq!(ids, expected);
}

#[test]
fn static_divergence_squeals() {
    let term = |value: f64, law| Term { matrix: faer::mat![[value]], law };
    for damping in [0.0, 0.3] {
        let stiffness = vec![term(1.0, Law::Constant), term(-1.0, Law::FrictionStiffness)];
        let damping = vec![term(damping, Law::Constant)];
        let mut session = of(Model::new(1, stiffness, damping, ContactLaw::default(), None).unwrap());
        assert_eq!(predict(&mut session, friction(0, 0.9)).level, level::OK);
        let diverges = predict(&mut session, friction(1, 1.1));
        assert_eq!(diverges.level, level::SQUEAL);
        assert!(diverges.reason.contains("static divergence") && diverges.unstable_modes == 1, "{}", diverges.reason);
    }
}

/// Squeal by divergence ends with the same hysteresis as squeal by a growing mode: not before every damping ratio is above
/// the limit by it.
#[test]
fn squeal_by_divergence_ends_with_the_hysteresis() {
    // A coordinate that diverges above a friction coefficient of 1, and a mode with a damping ratio of -0.0008: between
    // -0.001, where squeal begins, and -0.0005, where it ends.
    let entry = |place: usize, value: f64, law| Term {
        matrix: faer::Mat::from_fn(2, 2, |i, j| if i == place && j == place { value } else { 0.0 }),
        law,
    };
    let stiffness =
        vec![entry(0, 1.0, Law::Constant), entry(0, -1.0, Law::FrictionStiffness), entry(1, 100.0, Law::Constant)];
    let damping = vec![entry(1, -0.016, Law::Constant)];
    let mut session = of(Model::new(2, stiffness, damping, ContactLaw::default(), None).unwrap());
    assert_eq!(predict(&mut session, friction(0, 0.9)).level, level::OK);
    assert_eq!(predict(&mut session, friction(1, 1.1)).level, level::SQUEAL);
    let held = predict(&mut session, friction(2, 0.9));
    assert!(held.level == level::SQUEAL && held.reason.contains(", squeal ends at -0.0005"), "{}", held.reason);
}

#[test]
fn a_second_has_less_than_a_thousand_million_nanoseconds() {
    let mut session = session();
    for (seq, nanosec, faulty) in [(0, 999_999_999, false), (1, 1_000_000_000, true), (2, u32::MAX, true)] {
        let Event::Input(mut input) = friction(seq, 0.3) else { unreachable!("an input") };
        input.header.stamp = Time { sec: 1, nanosec };
        let found = predict(&mut session, Event::Input(input));
        assert_eq!(found.level == level::FAULT, faulty, "{nanosec}: {}", found.reason);
        assert!(!faulty || found.reason == format!("stamp has {nanosec} ns within a second, expected less than 1e9"));
    }
}

#[test]
fn beyond_the_searched_range_there_is_no_margin() {
    let like = Rig::load("nine-dof-case-2").expect("embedded");
    let rig = Arc::new(Rig { mu_max: 1.0, ..like });
    let mut session = with_map(Session::new(rig.clone(), Settings::for_rig(&rig)));
    let within = predict(&mut session, friction(0, 0.999));
    assert!(within.friction_margin < 0.0 && within.critical_friction > 0.0);
    let beyond = predict(&mut session, friction(1, 1.001));
    assert!(
        beyond.friction_margin.is_nan() && beyond.critical_friction.is_nan() && beyond.friction_margin_error.is_nan()
    );
    assert!(beyond.reason.contains("friction coefficient beyond mu_max: no margin"), "{}", beyond.reason);
}

/// While the load changes, new window ends are requested at most ten times per second of stamps.
#[test]
fn ends_are_asked_for_at_most_ten_times_a_second() {
    use crate::proof::synthetic::{Synthetic, rig};
    let contact_law = ContactLaw { exponent: 0.4, ..Default::default() };
    let model = rig(&Synthetic { modes: 24, pairs: 12, damping_ratio: 0.0, contact_law, seed: 1 }).unwrap();
    let mut session = with_map(of(model));
    let mut asked = vec![];
    for seq in 0..350 {
        // Stamps 1 ms apart.
        let effects = session.step(conditions(seq, 500.5 + 1e-3 * seq as f64, 13.0, 0.1)).unwrap();
        asked.extend(matches!(effects.request, Some(Request::Ends(_))).then_some(seq));
    }
    assert_eq!(asked, [0, 100, 200, 300]);
}

/// A panic of the solver turns that prediction into a FAULT and no other.
#[test]
fn a_panic_of_the_solver_is_a_fault() {
    let law = Law::Custom(CustomLaw {
        text: "panics at 0.5".to_owned(),
        evaluate: Arc::new(|p: &OperatingPoint| if p.friction_coefficient == 0.5 { panic!("on purpose") } else { 1.0 }),
        depends_on_load: false,
        depends_on_speed: false,
        depends_on_friction: true,
    });
    let stiffness = vec![Term { matrix: faer::mat![[4.0]], law }];
    let mut session = of(Model::new(1, stiffness, vec![], ContactLaw::default(), None).unwrap());
    assert_eq!(predict(&mut session, friction(0, 0.4)).level, level::OK);
    let fault = predict(&mut session, friction(1, 0.5));
    assert_eq!((fault.level, fault.modes.len()), (level::FAULT, 0));
    assert_eq!(fault.reason, "prediction failed: internal error in the solver");
    assert_eq!(predict(&mut session, friction(2, 0.6)).level, level::OK);
}

#[test]
fn embedded_rigs_take_the_documented_threshold_of_instability() {
    for embedded in crate::rig::EMBEDDED {
        assert_eq!(Rig::load(embedded.name).expect("embedded").instability_threshold, 1e-6, "{}", embedded.name);
    }
}

/// The paper's rig, whose contact softens to half its stiffness from 20 to 220 °C.
fn softening() -> Arc<Rig> {
    let mut files = Rig::load("nine-dof-case-2").expect("an embedded rig").files;
    files[0].bytes.extend(b"\n[temperature]\nreference_c = 20.0\ncontact_stiffness = [[20.0, 1.0], [220.0, 0.5]]\n");
    Arc::new(Rig::from_files(&files).expect("it follows the temperature"))
}

/// After the rig was replaced, everything is predicted as in a new session of that rig: map, chart and the spectra solved in
/// advance for the former rig are gone.
#[test]
fn a_rig_at_another_temperature_is_predicted_as_if_it_were_the_first() {
    let cold = softening();
    let hot = Arc::new(cold.at_temperature(120.0).expect("in range"));
    let settings = Settings::for_rig(&cold);
    let mut session = with_map(Session::new(cold.clone(), settings));
    let chart = crate::session::computed::session_chart(&cold, 1, &|| true).expect("charted");
    session.step(Event::ChartReady(Arc::new(chart))).unwrap();
    let before = predict(&mut session, friction(0, 0.3));
    assert!(before.friction_margin.is_finite() && session.counters().charted == 1);
    let ahead = session.solver.solve(&cold.model, &cold.reference.with_friction(0.31), Vectors::Both).expect("solved");
    session.hand_in(vec![ahead]);
    session.step(Event::RigReady(hot.clone())).unwrap();
    assert!(session.map().is_none() && session.ends().is_none());

    let mut fresh = Session::new(hot.clone(), settings);
    for (seq, mu) in [(1, 0.31), (2, 0.3)] {
        let predicted = predict(&mut session, friction(seq, mu));
        assert_eq!(format!("{predicted:?}"), format!("{:?}", predict(&mut fresh, friction(seq, mu))), "{mu}");
        assert!(predicted.friction_margin.is_nan() && predicted.reason.ends_with("margin pending"), "{predicted:?}");
    }
    let (mut session, mut fresh) = (with_map(session), with_map(fresh));
    let predicted = predict(&mut session, friction(3, 0.3));
    assert_eq!(format!("{predicted:?}"), format!("{:?}", predict(&mut fresh, friction(3, 0.3))));
    assert_ne!(predicted.critical_friction, before.critical_friction);
}

#[test]
fn a_rig_follows_the_temperature_outside_the_dead_band_only() {
    let rig = softening();
    let mut session = Session::new(rig.clone(), Settings::for_rig(&rig));
    let left = |session: &Session| [17.9, 18.0, 20.0, 22.0, 22.1].map(|celsius| session.leaves_temperature(celsius));
    assert_eq!(left(&session), [true, false, false, false, true]);
    session.step(Event::Parameter { name: "dead_band_temperature_k".to_owned(), value: 5.0 }).unwrap();
    assert_eq!(left(&session), [false; 5]);
    session.step(Event::RigReady(Arc::new(rig.at_temperature(30.0).expect("in range")))).unwrap();
    assert_eq!(left(&session), [true; 5], "of the present temperature");
    assert!(!self::session().leaves_temperature(500.0), "a rig that does not follow");
    assert!(!session.leaves_temperature(f64::NAN));
}
