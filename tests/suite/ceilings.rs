//! Files that claim more than they contain, unpack to far more than their size, or are no regular files: the program refuses them
//! by name, at once, and within 256 MiB of private memory. More than that would end it with a signal, which no test here
//! takes for an answer.

use std::ffi::OsStr;
use std::io::{Cursor, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::program::{self, Run, Running, ended, folder, promised, run, text, until, write};
use npyz::zip::ZipWriter;
use npyz::zip::write::FileOptions;

const LIMIT_KIB: &str = "262144";

/// The program with at most 256 MiB of data: heap and everything else that is private and can be written to.
fn limited<S: AsRef<OsStr>>(args: impl IntoIterator<Item = S>) -> Command {
    let mut command = Command::new("sh");
    command.args(["-c", &format!("ulimit -d {LIMIT_KIB} && exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_squealcast")]);
    command.args(args).current_dir(std::env::temp_dir()).stdin(Stdio::null());
    command
}

fn answer<S: AsRef<OsStr>>(args: impl IntoIterator<Item = S>) -> Run {
    let started = Instant::now();
    let run = ended(limited(args).output().expect("the program starts"));
    promised("refused", started.elapsed(), Duration::from_secs(1));
    assert!(run.stderr.len() + run.stdout.len() < 100_000, "{} bytes of errors", run.stderr.len());
    run
}

#[track_caller]
fn refused<S: AsRef<OsStr>>(args: impl IntoIterator<Item = S>, why: &str) {
    answer(args).exits(1).complains(why);
}

// --- rigs ------------------------------------------------------------------------------------------------------------

const MODAL: &str = r#"name = "x"
[pad]
modal = "pad.npz"
[[contact_patch]]
axis_point_m = [0.0, 0.0, 0.0]
axis_direction = [0.0, 0.0, 1.0]
normal = [0.0, 0.0, 1.0]
stiffness_n_per_m = 1e5
"#;

/// An archive with one array of zeros per entry: its claimed shape, and how many bytes there are.
fn archive(entries: &[(&str, &str, usize)]) -> Vec<u8> {
    let mut bytes = Cursor::new(vec![]);
    let mut zip = ZipWriter::new(&mut bytes);
    for (name, shape, there) in entries {
        zip.start_file(format!("{name}.npy"), FileOptions::default()).expect("an entry");
        let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape}), }}");
        let header = format!("{header:<117}\n");
        zip.write_all(b"\x93NUMPY\x01\x00").expect("memory");
        zip.write_all(&(header.len() as u16).to_le_bytes()).expect("memory");
        zip.write_all(header.as_bytes()).expect("memory");
        zip.write_all(&vec![0; *there]).expect("memory");
    }
    zip.finish().expect("memory");
    drop(zip);
    bytes.into_inner()
}

/// Makes every size in the central directory of an archive 4 GiB: what its arrays claim seems to be there.
fn with_lying_sizes(mut bytes: Vec<u8>) -> Vec<u8> {
    let entries: Vec<usize> = (0..bytes.len() - 4).filter(|&at| bytes[at..at + 4] == *b"PK\x01\x02").collect();
    for at in entries {
        bytes[at + 24..at + 28].copy_from_slice(&0xffff_fffe_u32.to_le_bytes());
    }
    bytes
}

#[test]
fn archives_that_unpack_to_far_more_than_they_are_are_refused() {
    let folder = folder();
    let rig = write(folder.path(), "rig.toml", MODAL);
    let check = |pad: Vec<u8>, why: &str| {
        std::fs::write(folder.path().join("pad.npz"), pad).expect("the archive");
        refused(["check", &rig], why);
    };
    check(
        archive(&[("omega_rad_s", "268435456,", 64)]),
        "has shape (268435456) but 192 bytes; expected all its values",
    );
    let claims = with_lying_sizes(archive(&[("omega_rad_s", "268435456,", 64)]));
    check(claims, "with which the archive unpacks to 2147483648 bytes; expected at most 67108864 bytes");
    // 72 MiB of zeros that are really there.
    let zeros = archive(&[("omega_rad_s", "9437184,", 72 << 20)]);
    assert!(zeros.len() < 200_000);
    check(zeros, "with which the archive unpacks to 75497472 bytes; expected at most 67108864 bytes");
    // Modes for a model of 20000 x 20000, which would be 3.2 GB each of its matrices.
    let modes = [("omega_rad_s", "20000,", 160_000), ("nodes_m", "1, 3", 24), ("phi", "1, 3, 20000", 480_000)];
    check(archive(&modes), "`modes` is 20000 in number, expected at most 3000");
    // A shape is checked against the other arrays before its values are unpacked.
    let phi = [("omega_rad_s", "1,", 8), ("nodes_m", "1, 3", 24), ("phi", "4096, 3, 4096", 64)];
    check(
        with_lying_sizes(archive(&phi)),
        "`phi` has shape (4096, 3, 4096); expected (1, 3, 1), by nodes_m and omega_rad_s",
    );
    // Three arrays of 32 MiB: each alone would do.
    let many = [
        ("omega_rad_s", "2048,", 8 * 2048),
        ("nodes_m", "683, 3", 24 * 683),
        ("phi", "683, 3, 2048", 24 * 683 * 2048),
        ("mass_share", "2048, 2048", 8 * 2048 * 2048),
    ];
    check(archive(&many), "`mass_share` has shape (2048, 2048), with which the archive unpacks to 67158");
}

/// A matrix of 40 bytes that is referred to often enough to take days.
#[test]
fn systems_of_too_many_matrices_are_refused() {
    let folder = folder();
    write(folder.path(), "M.mtx", "%%MatrixMarket matrix array real general\n1 1\n1\n");
    let term = "[[system.stiffness]]\nmatrix = \"M.mtx\"\n";
    let system = format!("name = \"x\"\n[system]\nmass = \"M.mtx\"\n{}", term.repeat(20_000));
    let system = write(folder.path(), "rig.toml", &system);
    refused(["check", &system], "`system.stiffness` is 20000 in number, expected at most 100");
    refused(["full", &system, "--mu", "0.4"], "`system.stiffness` is 20000 in number, expected at most 100");
    let patch = MODAL.split_once("[[contact_patch]]").expect("a patch").1;
    let patches = format!("{}{}", MODAL, format!("[[contact_patch]]{patch}").repeat(5_000));
    let one = archive(&[("omega_rad_s", "1,", 8), ("nodes_m", "1, 3", 24), ("phi", "1, 3, 1", 24)]);
    std::fs::write(folder.path().join("pad.npz"), one).expect("the archive");
    refused(
        ["check", &write(folder.path(), "rig.toml", &patches)],
        "`contact_patch` is 5001 in number, expected at most 100",
    );
}

#[test]
fn tables_too_long_too_deep_or_too_many_are_refused() {
    let folder = folder();
    let check = |content: &str, why: &str| refused(["check", &write(folder.path(), "rig.toml", content)], why);
    check(&"#".repeat(3 << 20), "is 3145728 bytes long, expected at most 1048576");
    check(&format!("a = {}", "[".repeat(1_000_000)), "recurs");
    check(&format!("a = {}1{}", "{b=".repeat(200_000), "}".repeat(200_000)), "recurs");
    check(&format!("a = [{}]", "1,".repeat(524_000)), "unknown key `a`");
    check(&(0..80_000).map(|k| format!("a{k} = 1\n")).collect::<String>(), "unknown key `a0`");
    let args = ["run", "nine-dof", "--no-shm", "--no-display", "--domain", "77", "--ros-args", "--params-file"];
    let parameters = |content: &str, why: &str| {
        let file = write(folder.path(), "parameters.yaml", content);
        refused(args.iter().copied().chain([file.as_str()]), why);
    };
    parameters(&"#".repeat(2 << 20), "is 2097152 bytes long, expected at most 1048576");
    parameters(&format!("{}{}", "[".repeat(100_000), "]".repeat(100_000)), "recursion limit exceeded");
    parameters(&"- ".repeat(100_000), "line 1: nested too deep");
}

// --- no files --------------------------------------------------------------------------------------------------------

#[test]
fn devices_and_pipes_are_refused_wherever_a_file_is_read() {
    let folder = folder();
    let pipe = text(&folder.path().join("pipe"));
    assert!(Command::new("mkfifo").arg(&pipe).status().expect("mkfifo is there").success());
    let out = text(&folder.path().join("out.mcap"));
    for (file, kind) in [("/dev/zero", "a device"), (pipe.as_str(), "a named pipe")] {
        let why = format!("is {kind}, expected a regular file");
        refused(["check", file], &why);
        refused(["full", file, "--mu", "0.4"], &why);
        refused(["identify", "nine-dof", "--targets", file], &why);
        refused(["import", file, "-o", &out], &why);
        refused(["replay", file, "--verify"], &why);
        refused(["recover", file], &why);
        refused(["report", file, "-o", &text(&folder.path().join("report"))], &why);
        refused(["simulate", "--no-ros", "--no-shm", "--profile", file], &why);
        let rig = write(folder.path(), "rig.toml", &MODAL.replace("pad.npz", file));
        refused(["check", &rig], &why);
        let args =
            ["run", "nine-dof", "--no-shm", "--no-display", "--domain", "77", "--ros-args", "--params-file", file];
        refused(args, &why);
    }
}

// --- recordings ------------------------------------------------------------------------------------------------------

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode], &(body.len() as u64).to_le_bytes()[..], body].concat()
}

fn string(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

fn chunk(records: &[u8], claimed: u64) -> Vec<u8> {
    let compressed = zstd::bulk::compress(records, 1).expect("zstd");
    let body = [
        &[0; 16][..],
        &claimed.to_le_bytes(),
        &0_u32.to_le_bytes(),
        &string("zstd"),
        &(compressed.len() as u64).to_le_bytes(),
        &compressed,
    ];
    record(6, &body.concat())
}

/// A channel without a schema.
fn channel() -> Vec<u8> {
    record(4, &[&[1, 0, 0, 0][..], &string("/bomb"), &string("cdr"), &0_u32.to_le_bytes()].concat())
}

fn message(channel: u16, data: usize) -> Vec<u8> {
    record(5, &[&channel.to_le_bytes()[..], &[0; 20], &vec![0; data]].concat())
}

/// An unfinished recording of these records.
fn recording(records: &[Vec<u8>]) -> Vec<u8> {
    let head = record(1, &[string("ros2"), string("bomb")].concat());
    [mcap::MAGIC, &head, &records.concat()].concat()
}

/// Chunks of a million messages on a channel that is not there: 30 MiB of records each in some kilobytes.
fn strangers() -> Vec<u8> {
    let records = message(9, 0).repeat(1_000_000);
    recording(&vec![chunk(&records, records.len() as u64); 8])
}

#[test]
fn recordings_that_unpack_beyond_the_limit_are_refused_briefly() {
    let folder = folder();
    let path = folder.path().join("bomb.mcap");
    let file = text(&path);
    let recover = |bytes: &[u8], why: &str| {
        std::fs::write(&path, bytes).expect("the recording");
        let answer = answer(["recover", &file]).exits(3);
        assert!(answer.stdout.contains(why), "no {why:?} in {}", answer.stdout);
        for left in program::files_below(folder.path()) {
            std::fs::remove_file(left).expect("a file of this test");
        }
    };
    let bomb = strangers();
    assert!(bomb.len() < 100_000, "{}", bomb.len());
    recover(&bomb, "20 unreadable records; the rest of it is not read");
    let large = recording(&[chunk(&[0; 1000], 256 << 20)]);
    recover(&large, "chunk of 268435456 bytes, more than the limit of");
    // Messages as large as a chunk may be, one in each: they are returned one after another, not held all at once.
    let records = [channel(), message(1, 31 << 20)].concat();
    let many = recording(&vec![chunk(&records, records.len() as u64); 8]);
    recover(&many, "what follows is not read");
    std::fs::write(&path, &many).expect("the recording");
    answer(["replay", &file, "--verify"]).exits(1);
    // Schemas that are kept: 16 MiB of them at most.
    let schema = |id: u16| {
        record(
            3,
            &[&id.to_le_bytes()[..], &string(""), &string(""), &(1_000_000_u32).to_le_bytes(), &vec![0; 1_000_000]]
                .concat(),
        )
    };
    let schemas: Vec<Vec<u8>> = (1..=30).map(schema).collect();
    let schemas = schemas.concat();
    recover(&recording(&[chunk(&schemas, schemas.len() as u64)]), "schemas and channels of more than the limit");
}

/// A file that an earlier process left in the record directory does not prevent the node from starting, for any
/// content.
#[test]
fn leftovers_that_cannot_be_repaired_are_set_aside() {
    let folder = folder();
    let session = folder.path().join("old");
    std::fs::create_dir(&session).expect("the folder");
    std::fs::write(session.join("old_0.mcap.active"), strangers()).expect("the recording");
    std::fs::write(session.join("old_1.mcap.active"), [0; 5000]).expect("zeros, as after a power cut");
    let node = ["run", "nine-dof", "--no-ros", "--no-shm", "--no-chart", "--no-display", "--record"];
    let mut said = vec![];
    for sessions in 1..=2 {
        let running = Running::start(limited(node.iter().copied().chain([text(folder.path()).as_str()])));
        let aside = |name: &str| session.join(name).exists();
        let files = ["old_0.mcap.damaged", "old_1.mcap.damaged", "metadata.yaml"];
        until("the leftovers to be set aside", || files.iter().all(|name| aside(name)));
        until("the recording", || std::fs::read_dir(folder.path()).expect("the folder").count() == 1 + sessions);
        said.push(running.signal("INT").exits(0).stderr);
    }
    assert!(said[0].contains("old_0.mcap: restored 0 messages"), "{}", said[0]);
    assert!(said[0].contains("old_1.mcap.active: no recording, kept as"), "{}", said[0]);
    assert!(!said[1].contains("old_"), "named again: {}", said[1]);
    assert!(!Path::new(&session.join("old_0.mcap.active")).exists());
}

#[test]
fn an_interrupted_file_does_not_take_the_place_of_a_finished_one() {
    let folder = folder();
    let finished = write(folder.path(), "x.mcap", "finished");
    let interrupted = format!("{finished}.active");
    std::fs::write(&interrupted, recording(&[channel()])).expect("the recording");
    run(["recover", &interrupted]).exits(1).complains("cannot replace");
    assert_eq!(std::fs::read(&finished).expect("it stays"), b"finished");
    assert_eq!(std::fs::read(&interrupted).expect("it stays"), recording(&[channel()]));
}

// --- names -----------------------------------------------------------------------------------------------------------

#[test]
fn a_rigs_name_cannot_write_to_the_terminal() {
    let folder = folder();
    let nine = std::fs::read_to_string(program::launch("nine-dof.toml")).expect("the rig");
    let name = nine.lines().find(|line| line.starts_with("name")).expect("its name");
    let rig = nine.replace(name, "name = \"\\u001b]0;mine\\u0007\\u001b[2J\"");
    let rig = write(folder.path(), "rig.toml", &rig);
    for args in [&["check", &rig][..], &["critical", &rig], &["predict", &rig, "--mu", "0.4"], &["sweep", &rig]] {
        let ran = run(args);
        assert!(
            !ran.stdout.contains('\u{1b}') && !ran.stderr.contains('\u{1b}'),
            "{args:?}: {}",
            ran.stdout.escape_debug()
        );
    }
    run(["check", &rig]).exits(0).says("\\u{1b}]0;mine\\u{7}\\u{1b}[2J");
    let broken = write(folder.path(), "broken.toml", "\"\u{1b}[2J\" = 1\n");
    assert!(!run(["check", &broken]).exits(1).stderr.contains('\u{1b}'));
}
