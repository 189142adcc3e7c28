//! Every reader of bytes from outside, as a function that must return for any bytes: with a value or an error, never a panic,
//! and within the ceilings of `squealcast::files::input_file`.

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use squealcast::bus::params_file;
use squealcast::full_model::FullModelFile;
use squealcast::import::tribometer_log::{Field, LogOptions};
use squealcast::import::wav::Wav;
use squealcast::import::{samples_csv, tribometer_log, uff58};
use squealcast::msgs::schema::Topic;
use squealcast::physics::chart::Scratch;
use squealcast::physics::{Chart, OperatingPoint, Traces};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::Recording;
use squealcast::recording::recover::recover;
use squealcast::rig::{Rig, RigFile, matrix_market, npz, read_pressures, scale, uff};
use squealcast::simulator::Profile;
use squealcast::study::{Cell, Column, Kind, Reader, Study, Table, Writer};
use tempfile::TempDir;

/// A reader by name.
pub struct Target {
    pub name: &'static str,
    pub read: fn(&[u8]),
}

pub const TARGETS: [Target; 19] = [
    Target {
        name: "npz",
        read: |bytes| {
            let _ = npz::read("a.npz", bytes);
            let _ = npz::read_pair_residual("a.npz", bytes, 2);
            let _ = npz::read_static_response("a.npz", bytes, 2);
        },
    },
    Target { name: "uff", read: |bytes| drop(uff::read("a.unv", bytes)) },
    Target {
        name: "matrix_market",
        read: |bytes| {
            if let Ok(listed) = matrix_market::read("a.mtx", bytes)
                && listed.columns == listed.rows
                && listed.entries.len() >= listed.rows
            {
                let _ = listed.to_sparse("a.mtx");
            }
        },
    },
    Target {
        name: "rig",
        read: |bytes| {
            if let Ok(rig) = Rig::from_files(&[RigFile { name: "rig.toml".to_owned(), bytes: bytes.to_vec() }]) {
                let _ = rig.at_temperature(150.0);
            }
        },
    },
    Target { name: "pressures", read: |bytes| drop(read_pressures("a.csv", bytes)) },
    Target { name: "scale", read: |bytes| drop(scale::parse(&String::from_utf8_lossy(bytes))) },
    Target { name: "full_model", read: full_model },
    Target { name: "profile", read: |bytes| drop(Profile::load(&file("profile.toml", bytes))) },
    Target {
        name: "parameters",
        read: |bytes| {
            let _ = params_file::read(&file("parameters.yaml", bytes), "/", "squealcast");
        },
    },
    Target { name: "configuration", read: |bytes| drop(squealcast::commands::read_config(&file("run.toml", bytes))) },
    Target {
        name: "log",
        read: |bytes| {
            let text = tribometer_log::decode_text(bytes);
            let _ = tribometer_log::parse(&text, &LogOptions::default());
            let options = LogOptions {
                columns: vec![(Field::NormalLoadN, "-Fz".to_owned())],
                constants: vec![(Field::DiscSpeedRadS, 13.0)],
                times_restart: true,
                skip_bad_lines: true,
                ..LogOptions::default()
            };
            let _ = tribometer_log::parse(&text, &options);
        },
    },
    Target { name: "wav", read: wav },
    Target { name: "uff58", read: |bytes| drop(uff58::read("a.uff", bytes)) },
    Target { name: "samples_csv", read: |bytes| drop(samples_csv::read("a.csv", bytes)) },
    Target { name: "study", read: |bytes| drop(Study::read("study.toml", bytes, FOLDER.path())) },
    Target {
        name: "study_table",
        read: |bytes| {
            if let Ok(reader) = Reader::new("table.parquet", bytes.to_vec()) {
                let _ = reader.read_all();
            }
        },
    },
    Target { name: "recording", read: recording },
    Target {
        name: "cdr",
        read: |bytes| {
            if let Some((topic, bytes)) = bytes.split_first() {
                let _ = Payload::from_cdr(Topic::ALL[usize::from(*topic) % Topic::ALL.len()], bytes);
            }
        },
    },
    // Behind the checksum of its file, which mutations would never get past.
    Target { name: "chart", read: chart },
];

static FOLDER: LazyLock<TempDir> = LazyLock::new(|| tempfile::tempdir().expect("a temporary folder"));

fn file(name: &str, bytes: &[u8]) -> PathBuf {
    let path = FOLDER.path().join(name);
    std::fs::write(&path, bytes).expect("a file in the temporary folder");
    path
}

/// The files of a full model of one node; the first byte selects the file that the rest represents.
const FULL_MODEL: [(&str, &str); 7] = [
    ("model.toml", include_str!("full_model.toml")),
    ("K.mtx", "%%MatrixMarket matrix coordinate real symmetric\n3 3 3\n1 1 2e6\n2 2 3e6\n3 3 4e6\n"),
    ("M.sti", "1 1 1.0\n2 2 1.0\n3 3 1.0\n"),
    ("nodes.inp", "*NODE, NSET=ALL\n7, 0.1, 0., 0.\n"),
    ("rows.csv", "node,direction\n7,x\n7,y\n7,z\n"),
    ("law.csv", "closure_m,pressure_pa\n0,0\n1e-6,1e4\n3e-6,9e4\n"),
    ("load.csv", "node,direction,force_n\n7,z,-0.8\n7,x,0.6\n"),
];

fn full_model(bytes: &[u8]) {
    let Some((which, bytes)) = bytes.split_first() else { return };
    for (k, (name, content)) in FULL_MODEL.iter().enumerate() {
        file(name, if k == usize::from(*which) % FULL_MODEL.len() { bytes } else { content.as_bytes() });
    }
    let _ = FullModelFile::load(&FOLDER.path().join("model.toml"));
}

/// The seeds of `full_model`.
pub fn full_models() -> Vec<Vec<u8>> {
    (0..).zip(FULL_MODEL).map(|(k, (_, content))| [&[k][..], content.as_bytes()].concat()).collect()
}

/// A table with a column of each kind.
pub fn study_table() -> Vec<u8> {
    let names = ["case", "load_n", "status", "modes_hz"].into_iter().zip(Kind::ALL);
    let columns: Vec<Column> = names.map(|(name, kind)| Column::new(name, kind)).collect();
    let mut table = Table::new(&columns);
    for case in 0..20 {
        let list = if case % 3 == 0 { Cell::Missing } else { Cell::List(vec![1.0; case]) };
        table.push(vec![Cell::count(case), Cell::Number(0.5), Cell::Text("done".to_owned()), list]);
    }
    let mut writer = Writer::new(&columns, &[("study".to_owned(), "name = 'a'".to_owned())]).expect("a schema");
    writer.write(&table).expect("memory");
    writer.finish().expect("memory")
}

/// Reads the samples too, as far as they are there.
fn wav(bytes: &[u8]) {
    let Ok(mut wav) = Wav::open("a.wav", Cursor::new(bytes)) else { return };
    let mut channels = vec![vec![]; usize::from(wav.channels)];
    while wav.read(4096, &mut channels).is_ok_and(|count| count > 0) {
        channels.iter_mut().for_each(Vec::clear);
    }
}

fn recording(bytes: &[u8]) {
    let path = file("a.mcap.active", bytes);
    read_recording(&path);
    let _ = recover(&path);
    for entry in std::fs::read_dir(FOLDER.path()).expect("the temporary folder").flatten() {
        let _ = std::fs::remove_file(entry.path());
    }
}

fn read_recording(path: &Path) {
    let Ok(recording) = Recording::open(path) else { return };
    let mut messages = recording.messages();
    messages.by_ref().for_each(drop);
    assert!(messages.damage().len() <= 200 && recording.damage().len() <= 200, "damage without an end");
}

fn chart(bytes: &[u8]) {
    let words: Vec<u64> = bytes.as_chunks::<8>().0.iter().map(|word| u64::from_le_bytes(*word)).collect();
    let Some(chart) = Chart::from_words(&words) else { return };
    let (mut scratch, mut modes) = (Scratch::default(), vec![]);
    for friction_coefficient in [0.0, 0.35, 1.0, 2.5] {
        let p = OperatingPoint { friction_coefficient, ..RIG.reference };
        let known = Traces::new(&RIG.model).at(&RIG.model, &p);
        let _ = chart.evaluate(&p, known, &mut scratch, &mut modes);
    }
}

static RIG: LazyLock<Rig> = LazyLock::new(|| Rig::load("nine-dof").expect("embedded"));

/// The seeds of `chart`.
pub fn charts() -> Vec<Vec<u8>> {
    let chart = squealcast::session::computed::session_chart(&RIG, 1, &|| true).expect("a chart");
    vec![chart.words().into_iter().flat_map(u64::to_le_bytes).collect()]
}
