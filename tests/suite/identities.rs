//! A mode keeps its identity wherever it is shown: solved, read off a chart, in the map, as a shape.

use std::sync::Arc;

use squealcast::display::shape::shape;
use squealcast::msgs::{Header, OperatingPoint, Prediction, Time};
use squealcast::physics::{MapOptions, Solver};
use squealcast::proof::identities::compare;
use squealcast::rig::{EMBEDDED, Rig};
use squealcast::session::computed::{session_chart, session_map};
use squealcast::session::settings::Settings;
use squealcast::session::{Event, Session, chart_options, map_options};

/// Every embedded rig but those whose charts take long.
fn rigs() -> impl Iterator<Item = Rig> {
    let slow = ["tribometer-80+80", "tribometer-lining"];
    let quick = EMBEDDED.into_iter().filter(move |embedded| !slow.contains(&embedded.name));
    quick.map(|embedded| Rig::load(embedded.name).expect("an embedded rig"))
}

#[test]
fn charted_modes_of_embedded_rigs_have_the_identities_of_solved_ones() {
    for rig in rigs() {
        let chart = session_chart(&rig, 2, &|| true).expect("it can be charted");
        let mapped = MapOptions { windows: false, ..map_options(&rig) };
        let found = compare(&rig.model, &mapped, &chart_options(&rig), &chart, [1, 250], 3).expect("it is solved");
        assert_eq!(found.different, 0, "{}: {found:?}", rig.name);
        assert!(found.charted > 200 && 100 * found.by_shape <= found.modes, "{}: {found:?}", rig.name);
    }
}

fn input(seq: u64, rig: &Rig, friction_coefficient: f64) -> Event {
    Event::Input(OperatingPoint {
        header: Header { stamp: Time::from_ns(1_000_000 * seq as i64), ..Default::default() },
        seq,
        normal_load_n: rig.reference.normal_load_n,
        disc_speed_rad_s: rig.reference.disc_speed_rad_s,
        friction_coefficient,
    })
}

/// The fastest growing mode of a charted prediction of the default rig is the same mode as a shape, and in a session that solves.
#[test]
fn the_shape_of_a_charted_mode_is_that_of_the_mode() {
    let rig = Arc::new(Rig::load(EMBEDDED[0].name).expect("an embedded rig"));
    let mut solver = Solver::new(rig.model.dimension());
    let map = Arc::new(session_map(&rig, &mut solver, &rig.reference).expect("it can be mapped"));
    let chart = Arc::new(session_chart(&rig, 2, &|| true).expect("it can be charted"));
    let start = || {
        let mut session = Session::new(rig.clone(), Settings::for_rig(&rig));
        session.step(Event::MapReady(map.clone())).expect("no setting is changed");
        session
    };
    let (mut solved, mut charted) = (start(), start());
    charted.step(Event::ChartReady(chart)).expect("no setting is changed");
    let mut growing = 0;
    for (seq, mu) in [0.40, 0.55, 0.63, 0.70, 0.85, 0.95].into_iter().enumerate() {
        let predict = |session: &mut Session| -> Prediction {
            session.step(input(seq as u64, &rig, mu)).expect("an input").publish.expect("it is answered").clone()
        };
        let (off_chart, dense) = (predict(&mut charted), predict(&mut solved));
        assert_eq!(off_chart.modes.len(), dense.modes.len());
        for mode in &off_chart.modes {
            let same = |hz: f64| (hz - mode.frequency_hz).abs() <= 1e-6 * hz;
            let other = dense.modes.iter().find(|other| other.id == mode.id);
            assert!(other.is_some_and(|other| same(other.frequency_hz)), "mu {mu}: {mode:?} {other:?}");
            if mode.growth_rate_per_s > 1.0 {
                let shape = shape(&rig, &mut solver, Some(&map), &rig.reference.with_friction(mu), mode.id).unwrap();
                assert!(same(shape.frequency_hz) && shape.growth_rate_per_s > 1.0, "mu {mu}: {mode:?}");
                growing += 1;
            }
        }
    }
    assert_eq!(charted.counters().charted, 6);
    assert!(growing > 0, "something grows");
}
