//! Allocations of a prediction: a charted one allocates nothing, except the first.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::Arc;

use squealcast::msgs::shm::{Form, PredictionForm};
use squealcast::msgs::{self, Header, OperatingPoint, Time};
use squealcast::physics::{ContactLaw, Solver};
use squealcast::proof::synthetic::{Synthetic, rig};
use squealcast::rig::Rig;
use squealcast::session::computed::session_chart;
use squealcast::session::settings::Settings;
use squealcast::session::{Event, Session, map_options};

/// The system's allocator, which counts for each thread.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

fn count() {
    // While a thread ends its counter is gone already.
    let _ = ALLOCATIONS.try_with(|allocations| allocations.set(allocations.get() + 1));
}

unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn synthetic(modes: usize) -> Arc<Rig> {
    let model = rig(&Synthetic { modes, pairs: 12, damping_ratio: 0.0, contact_law: ContactLaw::default(), seed: 1 });
    let like = Rig::load("nine-dof-case-2").expect("embedded");
    Arc::new(Rig { model: model.expect("well formed"), band_max_hz: Some(5000.0), mu_max: 1.0, ..like })
}

fn condition(seq: u64) -> Event {
    Event::Input(OperatingPoint {
        header: Header { stamp: Time::from_ns(1_000_000 * seq as i64), ..Default::default() },
        seq,
        normal_load_n: 500.0,
        disc_speed_rad_s: 13.0,
        friction_coefficient: 0.002 * (seq % 500) as f64 + 1e-4,
    })
}

/// Allocations of a session's step and of both encodings: of the conditions that were solved, and of the others.
fn allocations(session: &mut Session, bytes: &mut Vec<u8>, seqs: std::ops::Range<u64>) -> [u64; 2] {
    let events: Vec<Event> = seqs.map(condition).collect();
    let mut counted = [0; 2];
    for event in events {
        let solved_before = session.counters().solved;
        let before = ALLOCATIONS.get();
        let prediction = session.step(event).expect("no setting is changed").publish.expect("every input is answered");
        let form = PredictionForm::from_message(prediction).expect("it fits");
        assert!(form.mode_count > 0);
        msgs::write_cdr(prediction, bytes).expect("it is encoded");
        let allocations = ALLOCATIONS.get() - before;
        counted[usize::from(session.counters().solved == solved_before)] += allocations;
    }
    counted
}

fn session(rig: &Arc<Rig>) -> Session {
    let mut session = Session::new(rig.clone(), Settings::for_rig(rig));
    let mut solver = Solver::new(rig.model.dimension());
    let map = squealcast::physics::StabilityMap::build(&rig.model, &mut solver, &rig.reference, &map_options(rig));
    session.step(Event::MapReady(Arc::new(map.expect("it can be mapped")))).expect("no setting");
    session
}

/// 500 conditions from one end of the chart to the other, twice: the second time everything has its room.
#[test]
fn a_charted_condition_allocates_nothing() {
    let rig = synthetic(24);
    let mut session = session(&rig);
    let chart = session_chart(&rig, 2, &|| true).expect("it can be charted");
    session.step(Event::ChartReady(Arc::new(chart))).expect("no setting");
    let mut bytes = vec![];
    let [_, first] = allocations(&mut session, &mut bytes, 0..500);
    let [_, counted] = allocations(&mut session, &mut bytes, 500..1000);
    let counters = session.counters();
    assert!(counters.charted > 900, "the chart answers: {counters:?}");
    assert!(first > 0 && counted == 0, "{first} at first, then {counted} allocations: {counters:?}");
}

/// Conditions that did not move.
#[test]
fn a_reused_condition_allocates_nothing() {
    let rig = synthetic(8);
    let mut session = session(&rig);
    session.step(Event::Parameter { name: "dead_band_friction".to_owned(), value: 10.0 }).expect("known");
    let mut bytes = vec![];
    allocations(&mut session, &mut bytes, 0..1);
    assert_eq!(allocations(&mut session, &mut bytes, 1..500), [0, 0]);
    assert_eq!(session.counters().reused, 499);
}

/// A dense solve allocates vectors of roots and shapes, whose number does not grow with the number of conditions.
#[test]
fn a_solved_condition_allocates_the_same_every_time() {
    let rig = synthetic(24);
    let mut session = session(&rig);
    let mut bytes = vec![];
    allocations(&mut session, &mut bytes, 0..500);
    let (second, third) =
        (allocations(&mut session, &mut bytes, 500..1000), allocations(&mut session, &mut bytes, 1000..1500));
    println!("{} allocations for a dense solve", second[0] as f64 / 500.0);
    assert_eq!(second, third);
}
