//! Converts a tribometer log to a recording of operating points and temperatures; reads files of sampled sound and acceleration.

pub mod samples;
pub mod samples_csv;
pub mod sound_blocks;
pub mod tribometer_log;
pub mod uff58;
pub mod wav;

use std::{
    collections::BTreeMap,
    io,
    path::{Path, PathBuf},
};

use mcap::records::Metadata;
use sha2::{Digest, Sha256};

use crate::files::input_file;
use crate::msgs::{Header, OperatingPoint, Temperature, Time, schema::Topic};
use crate::recording::mcap_file::{RecordingFile, WriteError};
use crate::recording::message::Payload;
use crate::sound::search::end_ns;
use crate::text::hex::hex;
use samples::SamplesError;
use sound_blocks::{Beside, SoundBlocks, join};
use tribometer_log::{LogError, LogOptions, Sample, TribometerLog};

/// Name of the metadata record that describes the origin of the recording. Its keys: `source`, `source_sha256`,
/// `squealcast_version`, `skipped_lines`, and for each quantity the column it was read from, after a `-` if with the
/// opposite sign, or its constant.
pub const METADATA_NAME: &str = "squealcast_import";

/// Options of an import.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImportOptions {
    pub log: LogOptions,
    /// Replace an existing recording.
    pub overwrite: bool,
}

/// Why an import failed.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    #[error("{}: {source}", .path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("{}: {source}", .path.display())]
    Log { path: PathBuf, source: LogError },
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(transparent)]
    Samples(#[from] SamplesError),
    #[error("{}: line values cannot be encoded: {reason}", .path.display())]
    Encode { path: PathBuf, reason: String },
}

/// Result of an import.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    pub path: PathBuf,
    pub messages: u64,
    /// First and last stamp, ns.
    pub span_ns: Option<(u64, u64)>,
    /// The parsed log.
    pub log: TribometerLog,
}

/// A log that was read.
#[derive(Clone, Debug, PartialEq)]
pub struct ReadLog {
    pub path: PathBuf,
    pub bytes: Vec<u8>,
    pub log: TribometerLog,
}

/// Writes the operating points (`/rig/operating_point`), and the temperatures (`/rig/temperature`), of the log `input` to the recording `output`, completely or not
/// at all.
///
/// # Errors
///
/// The log cannot be read or is invalid, or the output exists or cannot be written.
pub fn import(input: &Path, output: &Path, options: &ImportOptions) -> Result<Imported, ImportError> {
    let (bytes, log) = read_log(input, &options.log)?;
    let read = ReadLog { path: input.to_owned(), bytes, log };
    import_with_sound(read, &mut SoundBlocks::default(), output, options.overwrite)
}

/// As [`import`], of a log that was read, with blocks of samples (`/rig/waveform`) beside it.
///
/// # Errors
///
/// The output exists or cannot be written, or the samples cannot be read.
pub fn import_with_sound(
    read: ReadLog,
    sound: &mut SoundBlocks,
    output: &Path,
    overwrite: bool,
) -> Result<Imported, ImportError> {
    if output.exists() && !overwrite {
        return Err(WriteError::Exists { path: output.to_owned() }.into());
    }
    let mut file = RecordingFile::create_whole(output)?;
    if let Err(error) = write(&mut file, &read, sound) {
        file.abandon();
        return Err(error);
    }
    let summary = file.finish()?;
    Ok(Imported { path: output.to_owned(), messages: summary.messages(), span_ns: summary.span_ns, log: read.log })
}

/// Reads the log `input`; returns its bytes and the parsed log.
///
/// # Errors
///
/// The file cannot be read or is not a valid log.
pub fn read_log(input: &Path, options: &LogOptions) -> Result<(Vec<u8>, TribometerLog), ImportError> {
    let bytes = input_file::read(input, input_file::LOG)
        .map_err(|source| ImportError::Read { path: input.to_owned(), source })?;
    let log = tribometer_log::parse(&tribometer_log::decode_text(&bytes), options)
        .map_err(|source| ImportError::Log { path: input.to_owned(), source })?;
    Ok((bytes, log))
}

/// The message for sample number `seq`.
pub fn operating_point(seq: u64, sample: &Sample) -> OperatingPoint {
    OperatingPoint {
        header: Header { stamp: Time::from_ns(sample.stamp_ns), frame_id: String::new() },
        seq,
        normal_load_n: sample.normal_load_n,
        disc_speed_rad_s: sample.disc_speed_rad_s,
        friction_coefficient: sample.friction_coefficient,
    }
}

/// The temperature of a sample, if it has one.
pub fn temperature(sample: &Sample) -> Option<Temperature> {
    let header = Header { stamp: Time::from_ns(sample.stamp_ns), frame_id: String::new() };
    sample.temperature_c.map(|temperature| Temperature { header, temperature, variance: 0.0 })
}

fn write(file: &mut RecordingFile, read: &ReadLog, sound: &mut SoundBlocks) -> Result<(), ImportError> {
    let ReadLog { path, bytes, log } = read;
    let source = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let digest = hex(&Sha256::digest(bytes));
    let mut metadata = BTreeMap::from([
        ("source".to_owned(), source),
        ("source_sha256".to_owned(), digest),
        ("squealcast_version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("skipped_lines".to_owned(), log.skipped.to_string()),
    ]);
    for column in &log.columns {
        let sign = if column.reversed { "-" } else { "" };
        metadata.insert(column.field.name().to_owned(), format!("{sign}{}", column.header));
    }
    for (field, value) in &log.constants {
        metadata.insert(field.name().to_owned(), format!("constant {value}"));
    }
    file.write_metadata(&Metadata { name: METADATA_NAME.to_owned(), metadata })?;
    let channel = file.own_channel(Topic::OperatingPoint)?;
    let sound_channel = if sound.is_empty() { None } else { Some(file.own_channel(Topic::Waveform)?) };
    let with_temperature = log.samples.iter().any(|sample| sample.temperature_c.is_some());
    let heat_channel = if with_temperature { Some(file.own_channel(Topic::Temperature)?) } else { None };
    // The rig has the temperature of a line in the prediction for its conditions.
    let measured = (0_u64..).zip(&log.samples).flat_map(|(seq, sample)| {
        let heat = temperature(sample).map(Payload::Temperature);
        let payloads = heat.into_iter().chain([Payload::OperatingPoint(operating_point(seq, sample))]);
        payloads.map(|payload| (sample.stamp_ns, (sample.stamp_ns, payload)))
    });
    let mut sequences = BTreeMap::new();
    for entry in join(measured, sound) {
        let (channel, time_ns, payload) = match entry {
            Beside::Other((time_ns, payload @ Payload::Temperature(_))) => (heat_channel, time_ns, payload),
            Beside::Other((time_ns, payload)) => (Some(channel), time_ns, payload),
            Beside::Samples(block) => (sound_channel, end_ns(&block), Payload::Waveform(block)),
        };
        let Some(channel) = channel else { continue };
        let next: &mut u32 = sequences.entry(payload.topic()).or_default();
        let seq = *next;
        *next += 1;
        let cdr =
            payload.to_cdr().map_err(|error| ImportError::Encode { path: path.clone(), reason: error.to_string() })?;
        let time_ns = u64::try_from(time_ns).unwrap_or(0);
        file.write(channel, seq, time_ns, time_ns, &cdr)?;
    }
    sound.take_error().map_or(Ok(()), |error| Err(error.into()))
}
