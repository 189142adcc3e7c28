//! Pages beside a node under load: times and memory.

use std::collections::HashMap;
use std::io::Read;
use std::time::Duration;

use super::{Shown, alone, measures};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording};

/// No page, one, twenty of which one never reads, and none again, in one run.
#[test]
fn pages_do_not_slow_the_node() {
    if !measures() {
        return;
    }
    let _alone = alone();
    const PHASE: Duration = Duration::from_secs(5);
    let directory = tempfile::tempdir().unwrap();
    let shown = Shown::demo(&["nine-dof-case-2", "--rate", "1000", "--record", directory.path().to_str().unwrap()]);
    std::thread::sleep(Duration::from_secs(1));
    let wall_ns = || std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_nanos() as u64;
    let stop = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let mut pages = vec![];
    let mut stalled = None;
    let mut phases = vec![];
    for count in [0, 1, 20] {
        while pages.len() + usize::from(stalled.is_some()) < count {
            let mut page = shown.listen();
            if count == 20 && stalled.is_none() {
                stalled = Some(page);
                continue;
            }
            let stop = stop.clone();
            pages.push(std::thread::spawn(move || {
                let mut buffer = vec![0; 1 << 16];
                while !stop.load(std::sync::atomic::Ordering::Relaxed) && page.read(&mut buffer).unwrap() > 0 {}
            }));
        }
        std::thread::sleep(Duration::from_millis(300));
        let from = wall_ns();
        std::thread::sleep(PHASE);
        phases.push((count, from, wall_ns()));
    }
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    pages.drain(..).for_each(|page| page.join().unwrap());
    drop(stalled);
    std::thread::sleep(Duration::from_millis(300));
    let from = wall_ns();
    std::thread::sleep(PHASE);
    phases.push((0, from, wall_ns()));
    shown.stop();

    // From hearing an input to publishing its prediction, as recorded.
    let session = std::fs::read_dir(directory.path()).unwrap().next().unwrap().unwrap().path();
    let mut received = HashMap::new();
    let mut latencies: Vec<Vec<f64>> = vec![vec![]; phases.len()];
    for entry in Recording::open(&session).unwrap().messages() {
        match entry.message {
            Recorded::Known(Payload::OperatingPoint(input)) => drop(received.insert(input.seq, entry.log_time_ns)),
            Recorded::Known(Payload::Prediction(prediction)) => {
                let Some(&at) = received.get(&prediction.input_seq) else { continue };
                if let Some(phase) = phases.iter().position(|&(_, from, to)| (from..to).contains(&at)) {
                    latencies[phase].push(entry.log_time_ns.saturating_sub(at) as f64 * 1e-3);
                }
            }
            _ => {}
        }
    }
    let reason: Vec<(usize, f64, f64, f64)> = phases
        .iter()
        .zip(&mut latencies)
        .map(|((count, ..), latencies)| {
            latencies.sort_by(f64::total_cmp);
            let quantile = |q: f64| latencies[(q * (latencies.len() - 1) as f64) as usize];
            (*count, latencies.len() as f64 / PHASE.as_secs_f64(), quantile(0.5), quantile(0.99))
        })
        .collect();
    for (count, rate, median, p99) in &reason {
        println!("{count:>2} pages: {rate:.0} predictions/s, latency {median:.0} us median, {p99:.0} us p99");
    }
    for (count, rate, median, _) in &reason {
        // A machine busy with something else delays some inputs past the end of a phase.
        assert!((950.0..1050.0).contains(rate), "{count} pages: {rate} predictions/s");
        // Twice what it is without a page is more than any machine's noise and less than any wait for a page.
        assert!(*median < 2.0 * reason[0].2 + 100.0, "{count} pages: {median} us, without {} us", reason[0].2);
    }
}

/// Resident memory of a node at 1 kHz with three pages that read and one that does not, every minute for ten.
#[test]
fn memory_is_flat_with_pages_attached() {
    if !measures() {
        return;
    }
    let _alone = alone();
    let shown = Shown::demo(&["nine-dof-case-2", "--rate", "1000", "--vibration", "0.36:0.33"]);
    let _stalled = shown.listen();
    for _ in 0..3 {
        let mut page = shown.listen();
        // Until the node ends.
        std::thread::spawn(move || {
            let mut buffer = vec![0; 1 << 16];
            while page.read(&mut buffer).is_ok_and(|count| count > 0) {}
        });
    }
    let resident_kb = || -> f64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", shown.child.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
        line.trim().trim_end_matches(" kB").parse().unwrap()
    };
    let mut minutes = vec![];
    for minute in 1..=10 {
        std::thread::sleep(Duration::from_secs(60));
        for path in ["/history.json", "/events.json", "/map.json?number=1"] {
            assert_eq!(shown.get(path).0, 200);
        }
        minutes.push(resident_kb());
        println!("{minute:>2} min: {:.1} MB resident", minutes[minutes.len() - 1] / 1024.0);
    }
    shown.stop();
    let (first, last) = (minutes[4], minutes[9]);
    assert!(last - first < 0.02 * first, "{first} kB after 5 minutes, {last} kB after 10");
}
