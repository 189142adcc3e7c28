//! Tests of a node without a recorder.

use super::status::Status;
use super::*;
use crate::bus::Bus;
use crate::session::computed::{session_chart, session_map};

#[test]
fn the_newest_input_of_a_long_backlog_is_predicted_on_either_bus() {
    const COUNT: u64 = 8000;
    let rig = Arc::new(Rig::load("nine-dof-case-2").expect("embedded"));
    let settings = Settings { warn_margin: 0.3, ..Settings::for_rig(&rig) };
    let watch = Watch::default();
    let (mut node, inlet) = Node::new(rig, settings, watch.clone());
    for seq in 0..COUNT {
        let message = msgs::OperatingPoint {
            header: Header { stamp: Time::from_ns(1_000_000_000 + seq as i64), ..Default::default() },
            seq,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient: 0.3 + 1e-6 * seq as f64,
        };
        for bus in [Bus::Ros2, Bus::Shm] {
            assert!(inlet.input(Received::now(bus, message.clone()), false), "room");
        }
    }
    inlet.stop();
    // Pretend that a prediction takes 10 ms: at most ten inputs may then wait.
    node.worker.prediction_times.note(Duration::from_millis(10));
    node.run(Outputs::default());
    let seen = watch.snapshot();
    assert_eq!(seen.settings.map(|settings| settings.warn_margin), Some(0.3), "of the settings, not of the rig");
    assert_eq!(seen.prediction.expect("one").input_seq, COUNT - 1);
    assert_eq!((seen.counters.solved, seen.passed_over), (1, COUNT - 1));
}

/// Window ends are computed for a map that may no longer be in force when they are ready.
#[test]
fn window_ends_of_a_replaced_map_are_discarded() {
    let rig = Arc::new(Rig::load("nine-dof-case-2").expect("embedded"));
    let (mut node, _inlet) = Node::new(rig.clone(), Settings::for_rig(&rig), Watch::default());
    let worker = &mut node.worker;
    let mut solver = crate::physics::Solver::new(rig.model.dimension());
    let mut map = || Arc::new(session_map(&rig, &mut solver, &rig.reference).expect("mapped"));
    let (former, present) = (map(), map());
    for map in [&former, &present] {
        worker.computed(&Request::Map(rig.reference), None, Ok(Some(Event::MapReady(map.clone()))));
    }
    for (of, taken) in [(&former, 0), (&present, 1)] {
        let ends = Event::EndsReady(Arc::new(of.ends.clone()));
        worker.computed(&Request::Ends(rig.reference), Some(of), Ok(Some(ends)));
        assert_eq!(worker.statistics.ends, taken);
    }
}

/// With a chart, inputs are predicted on the thread that received them. Inputs that need a dense solve are queued,
/// and later inputs do not overtake them.
#[test]
fn an_input_is_answered_past_the_queue_but_overtakes_none() {
    let rig = Arc::new(Rig::load("nine-dof-case-2").expect("embedded"));
    let watch = Watch::default();
    let (node, inlet) = Node::new(rig.clone(), Settings::for_rig(&rig), watch.clone());
    let chart = Arc::new(session_chart(&rig, 1, &|| true).expect("charted"));
    assert!(inlet.send(Incoming::Chart { rig, chart: Ok(chart) }));
    let mut samples = vec![];
    watch.take_samples(&mut samples);
    let thread = std::thread::spawn(move || node.run(Outputs::default()));
    let (mut seq, mut at_once, mut all) = (0, 0, vec![]);
    let mut ask = |disc_speed_rad_s: f64| {
        let message = msgs::OperatingPoint {
            header: Header { stamp: Time::from_ns(1_000_000_000 + seq as i64), ..Default::default() },
            seq,
            normal_load_n: 500.0,
            disc_speed_rad_s,
            friction_coefficient: 0.3 + 1e-6 * seq as f64,
        };
        assert!(inlet.input(Received::now(Bus::Shm, message), seq % 7 != 0));
        seq += 1;
        at_once += u32::from(watch.snapshot().prediction.is_some_and(|answer| answer.input_seq == seq - 1));
        // Only a few inputs wait, so that none is passed over. Now and then none waits, so that the next can be
        // predicted at once.
        let may_wait = if seq % 3 == 0 { 0 } else { 20 };
        while all.len() + may_wait < seq as usize {
            assert_eq!(watch.take_samples(&mut samples), 0);
            all.append(&mut samples);
            std::thread::sleep(Duration::from_micros(50));
        }
        at_once
    };
    // On a busy machine the node's thread may hold the lock at every attempt, so try until it does not.
    let begun = Instant::now();
    let mut asked = 0;
    while ask(if asked % 10 == 9 { -13.0 } else { 13.0 }) <= 100 || asked < 1000 {
        // Every tenth input has the opposite direction of rotation, which the chart does not cover.
        asked += 1;
        assert!(begun.elapsed() < Duration::from_secs(60), "hardly any was answered at once");
    }
    inlet.stop();
    thread.join().expect("it ended");
    watch.take_samples(&mut samples);
    all.append(&mut samples);
    assert!(all.iter().map(|sample| sample.input_seq).eq(0..seq), "{} of {seq} answered in order", all.len());
}

/// Before the first input nothing is published. Later a silence is published once, as a FAULT, and the next input
/// ends it.
#[test]
fn silence_is_a_fault_once_after_the_first_input_and_none_before() {
    let rig = Arc::new(Rig::load("nine-dof-case-2").expect("embedded"));
    let watch = Watch::default();
    let settings = Settings { silence_timeout_s: 0.02, ..Settings::for_rig(&rig) };
    let (mut node, inlet) = Node::new(rig, settings, watch.clone());
    node.worker.next_diagnostics = Instant::now();
    let thread = std::thread::spawn(move || node.run(Outputs::default()));
    let (mut samples, mut all) = (vec![], vec![]);
    watch.take_samples(&mut samples);
    let mut wait_for = |count: usize| -> Vec<(Status, u64)> {
        let begun = Instant::now();
        while all.len() < count {
            assert!(begun.elapsed() < Duration::from_secs(60), "{all:?}");
            watch.take_samples(&mut samples);
            all.extend(samples.drain(..).map(|sample| (sample.status, sample.input_seq)));
            std::thread::sleep(Duration::from_millis(1));
        }
        all.clone()
    };
    let input = |seq: u64| {
        let header = Header { stamp: Time::from_ns(1_000_000_000 + seq as i64), ..Default::default() };
        let point = msgs::OperatingPoint {
            header,
            seq,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient: 0.2,
        };
        assert!(inlet.send(Incoming::Input(Received::now(Bus::Shm, point))), "it runs");
    };
    // Several times the silence timeout.
    std::thread::sleep(Duration::from_millis(200));
    input(7);
    assert_eq!(wait_for(2), [(Status::Ok, 7), (Status::NoData, 7)], "the input is the first that is published");
    std::thread::sleep(Duration::from_millis(100));
    input(8);
    let found = wait_for(4);
    assert_eq!(found[2..], [(Status::Ok, 8), (Status::NoData, 8)], "one FAULT for each silence");
    inlet.stop();
    thread.join().expect("it ended");
}

/// Inputs older than half a second are passed over, except the newest.
#[test]
fn old_inputs_are_passed_over_but_for_the_newest() {
    let rig = Arc::new(Rig::load("nine-dof-case-2").expect("embedded"));
    let watch = Watch::default();
    let (node, inlet) = Node::new(rig.clone(), Settings::for_rig(&rig), watch.clone());
    let mut old = Received::now(Bus::Shm, msgs::OperatingPoint::default());
    while clock::monotonic_ns().saturating_sub(old.at.monotonic_ns) <= LATEST.as_nanos() as u64 {
        std::thread::sleep(Duration::from_millis(10));
    }
    for seq in 0..3 {
        old.message = msgs::OperatingPoint {
            seq,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient: 0.2,
            ..Default::default()
        };
        assert!(inlet.input(old.clone(), false), "room");
    }
    inlet.stop();
    node.run(Outputs::default());
    let seen = watch.snapshot();
    assert_eq!((seen.passed_over, seen.prediction.expect("one").input_seq), (2, 2));
}
