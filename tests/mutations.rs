//! Every reader of bytes from outside against mutations of sound files: it must answer each within 256 MiB and 10 s.
//!
//! Each reader runs in a separate process, whose allocations are counted; as many run at a time as there are processors.
//! Mutations are drawn from a seeded generator and not guided by coverage, which needs a compiler that instruments every
//! crate. `SQUEALCAST_FUZZ_S` is how many seconds each reader gets, and `SQUEALCAST_FUZZ_SEED` the seed. Arguments name
//! readers.

#[allow(dead_code)]
#[path = "suite/program/mod.rs"]
mod program;
#[path = "mutations/targets.rs"]
mod targets;

use std::alloc::{GlobalAlloc, Layout, System};
use std::path::Path;
use std::process::{Command, ExitCode};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use targets::{TARGETS, Target};

/// Bytes that a reader may hold at a time in addition to its input.
const MOST_BYTES: usize = 256 << 20;
/// Time limit for one input, on the slowest machine.
const LONGEST: Duration = Duration::from_secs(10);
/// Seconds for each reader unless the environment says otherwise.
const SECONDS: f64 = 1.0;
/// A process for the reader named by the next argument.
const CHILD: &str = "--reader";

/// The system's allocator, which knows how much is allocated and was at most.
struct Counting;

static ALLOCATED: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

fn grow(bytes: usize) {
    let now = ALLOCATED.fetch_add(bytes, Ordering::Relaxed) + bytes;
    PEAK.fetch_max(now, Ordering::Relaxed);
}

unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        grow(layout.size());
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        ALLOCATED.fetch_sub(layout.size(), Ordering::Relaxed);
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        grow(size);
        ALLOCATED.fetch_sub(layout.size(), Ordering::Relaxed);
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>().as_slice() {
        [CHILD, name] => {
            let target = TARGETS.iter().find(|target| target.name == *name).expect("a reader");
            mutate(target);
            ExitCode::SUCCESS
        }
        names => {
            // What `cargo test` passes on for the harness of other tests is not for this one.
            let wanted = |target: &&Target| {
                let mut names = names.iter().filter(|name| !name.starts_with('-')).peekable();
                names.peek().is_none() || names.any(|name| "mutations".contains(*name) || target.name.contains(*name))
            };
            if names.contains(&"--list") {
                return ExitCode::SUCCESS;
            }
            all(TARGETS.iter().filter(wanted).map(|target| target.name).collect())
        }
    }
}

/// Runs the readers of these names, each in a separate process.
fn all(names: Vec<&'static str>) -> ExitCode {
    let waiting = Mutex::new(names);
    let failed = Mutex::new(vec![]);
    let here = std::env::current_exe().expect("this program");
    // In memory where there is such a place: recovery waits for the disk.
    let folder = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a temporary folder");
    let side_by_side = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..side_by_side {
            scope.spawn(|| {
                loop {
                    let Some(name) = waiting.lock().expect("no thread panics").pop() else { return };
                    let status = Command::new(&here)
                        .args([CHILD, name])
                        .env("TMPDIR", folder.path())
                        .status()
                        .expect("this program");
                    if !status.success() {
                        eprintln!("{name}: {status}");
                        failed.lock().expect("no thread panics").push(name);
                    }
                }
            });
        }
    });
    let failed = failed.into_inner().expect("no thread panics");
    println!(
        "test result: {}",
        if failed.is_empty() { "ok".to_owned() } else { format!("FAILED: {}", failed.join(", ")) }
    );
    if failed.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Feeds a reader mutations for as long as it is to take.
fn mutate(target: &Target) {
    let variable = |name: &str| std::env::var(name).ok();
    let seconds =
        variable("SQUEALCAST_FUZZ_S").map_or(SECONDS, |text| text.parse().expect("SQUEALCAST_FUZZ_S: seconds"));
    let seed = variable("SQUEALCAST_FUZZ_SEED").map_or(1, |text| text.parse().expect("SQUEALCAST_FUZZ_SEED: a number"));
    let seeds = seeds(target.name);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut count, mut most, mut longest) = (0_u64, 0, Duration::ZERO);
    // First the file without mutation: it must be read without an error.
    let mut next = seeds.clone();
    let started = Instant::now();
    while started.elapsed().as_secs_f64() < seconds || !next.is_empty() {
        let input = next.pop().unwrap_or_else(|| mutated(&mut random, &seeds));
        let before = ALLOCATED.load(Ordering::Relaxed);
        PEAK.store(before, Ordering::Relaxed);
        let begun = Instant::now();
        let ended = std::panic::catch_unwind(|| (target.read)(&input));
        let took = begun.elapsed();
        let bytes = PEAK.load(Ordering::Relaxed).saturating_sub(before);
        let wrong = match ended {
            Err(_) => Some("panicked".to_owned()),
            Ok(()) if bytes > MOST_BYTES => Some(format!("took {bytes} bytes, at most {MOST_BYTES}")),
            Ok(()) if took > LONGEST => Some(format!("took {took:?}, at most {LONGEST:?}")),
            Ok(()) => None,
        };
        if let Some(wrong) = wrong {
            let kept = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{}-{seed}-{count}", target.name));
            std::fs::write(&kept, &input).expect("the input can be kept");
            eprintln!("{}: {wrong} at input {count} of seed {seed}, kept as {}", target.name, kept.display());
            std::process::exit(1);
        }
        (count, most, longest) = (count + 1, bytes.max(most), took.max(longest));
    }
    let (name, mib) = (target.name, most as f64 / f64::from(1 << 20));
    println!("{name:>14}: {count:>8} inputs in {:.0?}, each within {longest:.1?} and {mib:.1} MiB", started.elapsed());
}

/// A sound input with some things wrong with it.
fn mutated(random: &mut ChaCha8Rng, seeds: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = seeds[random.random_range(0..seeds.len())].clone();
    for _ in 0..random.random_range(1..6) {
        if bytes.is_empty() {
            return bytes;
        }
        let at = random.random_range(0..bytes.len());
        let length = random.random_range(1..=(bytes.len() - at).min(64));
        match random.random_range(0..9) {
            0 => bytes[at] ^= 1 << random.random_range(0..8),
            1 => bytes[at] = random.random(),
            // Numbers at their limits, as lengths are.
            2 | 3 => {
                let value = [0, 1, 0x7f, 0xff, 0xffff, 0x7fff_ffff, 0xffff_ffff, u64::MAX >> 1, u64::MAX];
                let value = value[random.random_range(0..value.len())].to_le_bytes();
                let size = [1, 2, 4, 8][random.random_range(0..4)].min(bytes.len() - at);
                bytes[at..at + size].copy_from_slice(&value[..size]);
            }
            4 => drop(bytes.drain(at..at + length)),
            5 => {
                let again = bytes[at..at + length].repeat(random.random_range(1..40));
                bytes.splice(at..at, again);
            }
            6 => bytes.truncate(at),
            // A piece of another seed.
            7 => {
                let other = &seeds[random.random_range(0..seeds.len())];
                let from = random.random_range(0..=other.len().saturating_sub(1));
                let to = (from + length).min(other.len());
                bytes.splice(at..at + length, other[from..to].iter().copied());
            }
            _ => {
                const TEXT: &[&str] =
                    &["-", "1e999", "nan", "99999999999999999999", ",", ";", "\n", "\"", "[[", "{", "é", "\0", " 0 "];
                bytes.splice(at..at, TEXT[random.random_range(0..TEXT.len())].bytes());
            }
        }
    }
    if random.random_bool(0.01) {
        bytes.iter_mut().for_each(|byte| *byte = random.random());
    }
    bytes
}

/// Sound inputs of a reader.
fn seeds(name: &str) -> Vec<Vec<u8>> {
    let project =
        |path: &str| std::fs::read(format!("{}/{path}", env!("CARGO_MANIFEST_DIR"))).expect("a file of the project");
    let text = |texts: &[&str]| texts.iter().map(|text| text.as_bytes().to_vec()).collect();
    match name {
        "npz" => {
            let side: [(&str, &[u64], &[f64]); 7] = [
                ("omega_rad_s", &[2], &[100.0, 200.0]),
                ("phi", &[1, 3, 2], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
                ("nodes_m", &[1, 3], &[0.1, 0.0, 0.0]),
                ("damping_ratio", &[2], &[0.01, 0.02]),
                ("mass_share", &[2, 2], &[1.0, 0.0, 0.0, 1.0]),
                ("residual_flexibility", &[3, 3], &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
                ("residual_inertia", &[3, 3], &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
            ];
            let pairs: [(&str, &[u64], &[f64]); 2] = [
                ("flexibility_normal", &[3], &[1.0, 0.0, 1.0]),
                ("flexibility_sliding", &[2, 2], &[1.0, 0.0, 0.0, 1.0]),
            ];
            vec![program::npz_bytes(&side), program::npz_bytes(&pairs)]
        }
        "uff" => text(&[include_str!("mutations/modes.unv")]),
        "matrix_market" => ["mass", "stiffness", "friction", "damping-1"]
            .map(|name| project(&format!("launch/rigs/hulten-{name}.mtx")))
            .into_iter()
            .chain(text_of_array())
            .collect(),
        "rig" => ["nine-dof", "nine-dof-3+2", "hoffmann", "hulten", "brake4669", "tribometer", "rough-pad"]
            .map(|name| project(&format!("launch/rigs/{name}.toml")))
            .into_iter()
            .chain([[project("launch/rigs/rough-pad.toml"), HEATED.to_vec()].concat()])
            .collect(),
        "pressures" => text(&["closure_m,pressure_pa\n0,0\n1e-6,1e4\n2e-6,4e4\n\n5e-6, 3e5\n"]),
        "scale" => text(&["friction_coefficient / 0.3 + 1", "-(normal_load_n/500)^0.5 * (1 - 2e-3*disc_speed_rad_s)"]),
        "full_model" => targets::full_models(),
        "profile" => text(&[
            "[[point]]\ntime_s = 0\nnormal_load_n = 1\ndisc_speed_rad_s = 1\nfriction_coefficient = 0.1\n[noise]\nnormal_load_n = 2\n",
        ]),
        "parameters" => {
            vec![project("launch/params.yaml"), b"/**: {ros__parameters: {a: &x 1, b: *x, c: {d: [1, 2]}}}\n".to_vec()]
        }
        "configuration" => vec![
            project("launch/squealcast.toml"),
            b"rig = 'x'\nno_ros = true\ndomain = 3\nros_args = ['-r', '__ns:=/left']\n[set]\nwarn_margin = 0.1\n"
                .to_vec(),
        ],
        "log" => text(&[
            "time_s,normal_load_n,disc_speed_rad_s,friction_coefficient\n0.0,500,13,0.35\n0.1,501,13,0.36\n",
            "Pruefstand 3\nZeit [s];Normalkraft [N];Drehzahl [1/min];Reibwert\n0,0;500,5;124;0,35\n0,1;501;124;0,36\n",
            "Time,Load,Speed,Friction force\n,N,rpm,N\n2026-01-01T00:00:00Z,500,124,170\n",
            "Fx,Fz,T,COF,temperature_c\ng,g,sec,,C\n9,-200,0.0,0.04,21\n9,-201,0.1,0.04,22\nStep 2\n9,-200,0.0,0.04,21\n",
        ]),
        "wav" => {
            let long = [b"RF64".as_slice(), &[255; 4], b"WAVEds64", &[28, 0, 0, 0], &[8; 28]].concat();
            let format = |bits: u8, block: u8| {
                let rest = [0x80, 0xbb, 0, 0, 0, 0, 0, 0, block, 0, bits, 0];
                [b"fmt ".as_slice(), &[16, 0, 0, 0, 1, 0, 2, 0], &rest].concat()
            };
            let data = [b"data".as_slice(), &[24, 0, 0, 0], &[7; 24]].concat();
            let mut float = vec![];
            squealcast::import::wav::write(&mut float, 51_200, &[0.5; 8]).expect("memory");
            let riff = [b"RIFF".as_slice(), &[60, 0, 0, 0], b"WAVE", &format(16, 4), &data].concat();
            vec![riff, [long, format(24, 6), data].concat(), float]
        }
        "uff58" => vec![project("tests/data/samples/text.uff"), project("tests/data/samples/binary.uff")],
        "samples_csv" => text(&[
            "time [s],microphone [Pa],load [N]\n0,0.5,1\n0.00002,-1e-3,1\n0.00004,2,1\n",
            "Zeit (ms);Mikrofon (Pa)\n0,00;1,5\n0,02;-2,5\n0,04;1\n",
        ]),
        "study" => ["nine-dof", "tribometer"].map(|name| project(&format!("launch/study/{name}.toml"))).into(),
        "study_table" => vec![targets::study_table()],
        "recording" => {
            let folder =
                std::fs::read_dir(format!("{}/recordings/ramp", env!("CARGO_MANIFEST_DIR"))).expect("a recording");
            let files = folder
                .flatten()
                .map(|entry| entry.path())
                .filter(|path| path.extension().is_some_and(|kind| kind == "mcap"));
            files.map(|path| std::fs::read(path).expect("a recording")).chain([plain_recording()]).collect()
        }
        "cdr" => (0..16).map(|topic| [&[topic, 0, 1, 0, 0][..], &[1; 200]].concat()).collect(),
        "chart" => targets::charts(),
        other => panic!("no sound inputs of {other}"),
    }
}

/// A table to be added to a rig.
const HEATED: &[u8] = b"\n[temperature]\nreference_c = 20.0\ncontact_stiffness = [[20.0, 1.0], [300.0, 0.5]]\n";

fn text_of_array() -> Option<Vec<u8>> {
    Some(b"%%MatrixMarket matrix array real skew-symmetric\n3 3\n1\n2\n3\n".to_vec())
}

/// A recording without compression and checksums, so that mutations reach what lies behind them.
fn plain_recording() -> Vec<u8> {
    let options =
        mcap::WriteOptions::new().compression(None).calculate_chunk_crcs(false).calculate_attachment_crcs(false);
    let mut output = std::io::Cursor::new(vec![]);
    let mut writer = options.create(&mut output).expect("memory");
    let attachment = mcap::Attachment {
        log_time: 1,
        create_time: 2,
        name: "rig.toml".to_owned(),
        media_type: String::new(),
        data: b"name = 1"[..].into(),
    };
    writer.attach(&attachment).expect("memory");
    let schema = writer.add_schema("squealcast_msgs/msg/OperatingPoint", "ros2msg", b"float64 x").expect("memory");
    let channel = writer.add_channel(schema, "/rig/operating_point", "cdr", &Default::default()).expect("memory");
    for n in 0..20 {
        let header =
            mcap::records::MessageHeader { channel_id: channel, sequence: n, log_time: n.into(), publish_time: 0 };
        writer.write_to_known_channel(&header, &[n as u8; 60]).expect("memory");
    }
    writer.finish().expect("memory");
    drop(writer);
    output.into_inner()
}
