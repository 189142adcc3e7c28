use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use clap::Args;
use serde::Serialize;

use super::against::{Against, AgainstArgs};
use super::{Outcome, finite, not_negative, positive, print, write_file};
use crate::import::samples::SampleFile;
use crate::sound::matching::Meeting;
use crate::sound::spectrum::{Spectra, frame_length};
use crate::sound::waveform::stamp_ns;
use crate::sound::{Channel, Counts, Detection, Detector, Quantity, Sensitivity, Settings, Squeal, Unit};
use crate::text::terminal::printable;

const EXAMPLES: &str = "\
Examples:
  squealcast hear test.wav --sensitivity '0.05 FS/Pa'              full scale is 20 Pa
  squealcast hear test.wav --calibration calibrator.wav            94 dB, recorded likewise
  squealcast hear test.wav --unit Pa --band-hz 2000:16000          samples in Pa, 2 to 16 kHz
  squealcast hear pad.wav --unit g --channel 2 --threshold-db 130  an accelerometer, dB re 1 µm/s²
  squealcast hear test.wav --unit Pa --against sessions/test       hits, misses and false alarms";

/// Find squeal in a file of samples: onset, end, frequency, level and growth rate of every tone that is loud enough. The
/// defaults are those of SAE J2521: at least 70 dB(A) between 1.25 and 16 kHz
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// WAV file of any length (16, 24 or 32 bits, integers or floats), Universal File with time histories (datasets 58),
    /// or CSV file with a header such as `time [s],microphone [Pa]`
    file: PathBuf,
    /// Analyse this channel, counted from 1 [default: all]
    #[arg(long, value_name = "N")]
    channel: Option<u16>,
    #[command(flatten)]
    calibration: CalibrationArgs,
    #[command(flatten)]
    detection: DetectionArgs,
    #[command(flatten)]
    against: AgainstArgs,
    /// Write the squeals as CSV to this file, - for standard output
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// What the samples of a file mean
#[derive(Clone, Debug, Args)]
pub struct CalibrationArgs {
    /// Unit of the samples: FS (parts of full scale), V, Pa, m/s² or g [default: as the file says; of a WAV file, FS]
    #[arg(long, value_name = "UNIT")]
    unit: Option<Unit>,
    /// Output of the sensor, such as '0.05 FS/Pa', '50 mV/Pa' or '100 mV/g'; once for all channels, or repeated for each
    #[arg(long, value_name = "VALUE")]
    sensitivity: Vec<Sensitivity>,
    /// File of a sound calibrator, recorded with the same settings, instead of --sensitivity
    #[arg(long, value_name = "FILE", conflicts_with = "sensitivity")]
    calibration: Option<PathBuf>,
    /// Level of the calibrator
    #[arg(long, value_name = "DB", value_parser = finite, default_value = "94", requires = "calibration")]
    calibration_db: f64,
}

/// What counts as squeal
#[derive(Clone, Copy, Debug, Args)]
pub struct DetectionArgs {
    /// Least level, dB(A) re 20 µPa or dB re 1 µm/s²
    #[arg(long, value_name = "DB", value_parser = finite, default_value = "70", allow_negative_numbers = true)]
    threshold_db: f64,
    /// Lowest and highest frequency
    #[arg(long, value_name = "FROM:TO", value_parser = band, default_value = "1250:16000")]
    band_hz: [f64; 2],
    /// Least level above the noise around the tone, dB
    #[arg(long, value_name = "DB", value_parser = positive, default_value = "12")]
    prominence_db: f64,
    /// Least duration, s
    #[arg(long, value_name = "S", value_parser = not_negative, default_value = "0.1")]
    min_duration_s: f64,
}

impl DetectionArgs {
    pub fn settings(&self) -> Settings {
        let Self { threshold_db, band_hz, prominence_db, min_duration_s } = *self;
        Settings { threshold_db, band_hz, prominence_db, min_duration_s, ..Default::default() }
    }
}

fn band(text: &str) -> Result<[f64; 2], String> {
    let (from, to) = text.split_once(':').ok_or("expected two frequencies in Hz, FROM:TO")?;
    let band = [not_negative(from)?, positive(to)?];
    if band[0] < band[1] { Ok(band) } else { Err(format!("{} is not less than {}", band[0], band[1])) }
}

/// Samples of each channel that are read at a time.
const BLOCK: usize = 1 << 16;
/// A calibrator is steady: 80 % of its frames are within this range, dB.
const STEADY_DB: f64 = 1.0;

/// The squeals of a channel.
struct Heard {
    channel: u16,
    name: String,
    sample_rate_hz: f64,
    duration_s: f64,
    quantity: Quantity,
    band_hz: [f64; 2],
    frame_s: f64,
    latency_s: f64,
    squeals: Vec<Squeal>,
    counts: Counts,
}

/// A squeal in the output; a line of the CSV file.
#[derive(Clone, Copy, Debug, Serialize)]
struct Row {
    channel: u16,
    number: u64,
    onset_s: f64,
    end_s: f64,
    cut_at_onset: bool,
    cut_at_end: bool,
    frequency_hz: f64,
    level_db: f64,
    peak_level_db: f64,
    prominence_db: f64,
    growth_rate_per_s: Option<f64>,
    growth_rate_low_per_s: Option<f64>,
    growth_rate_high_per_s: Option<f64>,
    harmonic_order: Option<u32>,
    harmonic_of: Option<u64>,
}

/// The output of `hear --json`.
#[derive(Serialize)]
struct Report<'a> {
    file: String,
    encoding: &'a str,
    /// Of the first channel.
    sample_rate_hz: f64,
    /// Of the longest channel.
    duration_s: f64,
    missing_bytes: u64,
    threshold_db: f64,
    channels: Vec<ChannelReport>,
}

#[derive(Serialize)]
struct ChannelReport {
    channel: u16,
    /// Empty if the file gives none.
    name: String,
    sample_rate_hz: f64,
    level_unit: &'static str,
    band_hz: [f64; 2],
    frame_s: f64,
    latency_s: f64,
    samples: u64,
    not_finite: u64,
    squeals: Vec<Row>,
    #[serde(skip_serializing_if = "Option::is_none")]
    against: Option<Scores>,
}

/// Scores with the counts they come from.
#[derive(Serialize)]
struct Scores {
    precision: Option<f64>,
    recall: Option<f64>,
    mcc: Option<f64>,
    #[serde(flatten)]
    meeting: Meeting,
}

impl Heard {
    /// The squeals with times since the first sample, which was taken at `start_ns`.
    fn rows(&self, start_ns: i64) -> impl Iterator<Item = Row> {
        self.squeals.iter().map(move |squeal| Row::new(self.channel, squeal, start_ns))
    }
}

impl Scores {
    fn of(meeting: Meeting) -> Self {
        let (precision, recall, mcc) = (meeting.score.precision(), meeting.score.recall(), meeting.slots.mcc());
        Self { precision, recall, mcc, meeting }
    }
}

impl Row {
    fn new(channel: u16, squeal: &Squeal, start_ns: i64) -> Self {
        let seconds = |stamp_ns: i64| stamp_ns.saturating_sub(start_ns) as f64 * 1e-9;
        Self {
            channel,
            number: squeal.number,
            onset_s: seconds(squeal.onset_ns),
            end_s: seconds(squeal.end_ns),
            cut_at_onset: squeal.cut[0],
            cut_at_end: squeal.cut[1],
            frequency_hz: squeal.frequency_hz,
            level_db: squeal.level_db,
            peak_level_db: squeal.peak_level_db,
            prominence_db: squeal.prominence_db,
            growth_rate_per_s: squeal.growth.map(|growth| growth.rate_per_s),
            growth_rate_low_per_s: squeal.growth.map(|growth| growth.low_per_s),
            growth_rate_high_per_s: squeal.growth.map(|growth| growth.high_per_s),
            harmonic_order: squeal.harmonic.map(|harmonic| harmonic.order),
            harmonic_of: squeal.harmonic.map(|harmonic| harmonic.of),
        }
    }
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let mut samples = SampleFile::open(&self.file)?;
        let file = self.file.display();
        for omitted in samples.omitted() {
            note!("{file}: omitted {omitted}");
        }
        if let Some(channel) = self.channel {
            let channels = samples.channel_count() as u16;
            ensure!(
                (1..=channels).contains(&channel),
                "--channel is {channel}, expected 1 to the {channels} of {file}"
            );
        }
        let against = self.against.read()?;
        let start_ns = against.as_ref().map_or(0, |against| against.start_ns);
        let heard = self.detect(&mut samples, start_ns)?;
        let rows: Vec<Row> = heard.iter().flat_map(|heard| heard.rows(start_ns)).collect();
        if let Some(path) = &self.csv {
            write_file(path, &csv(&rows)?)?;
        }
        if self.json {
            print(&(serde_json::to_string(&self.report(&samples, &heard, against.as_ref())?)? + "\n"))?;
        } else if self.csv.as_deref() != Some(Path::new("-")) {
            print(&self.text(&samples, &heard, against.as_ref())?)?;
        }
        if samples.missing_bytes() == 0 {
            return Ok(Outcome::Done);
        }
        note!("{file}: {} bytes of samples are missing at its end", samples.missing_bytes());
        Ok(Outcome::Differences)
    }

    fn detect(&self, file: &mut SampleFile, start_ns: i64) -> anyhow::Result<Vec<Heard>> {
        let path = self.file.display().to_string();
        let settings = self.detection.settings();
        let wanted: Vec<u16> =
            (1..=file.channel_count() as u16).filter(|n| self.channel.is_none_or(|channel| channel == *n)).collect();
        let mut detectors = vec![];
        for &channel in &wanted {
            let index = usize::from(channel - 1);
            let channel = self.calibration.channel(file, index, channel.to_string()).with_context(|| path.clone())?;
            let detector = Detector::new(&channel, settings).with_context(|| path.clone())?;
            detectors.push((detector, vec![]));
        }
        let mut samples = vec![vec![]; file.channel_count()];
        let mut read = 0;
        loop {
            samples.iter_mut().for_each(Vec::clear);
            let count = file.read(BLOCK, &mut samples)?;
            if count == 0 {
                break;
            }
            for (&channel, (detector, found)) in wanted.iter().zip(&mut detectors) {
                let index = usize::from(channel - 1);
                // A channel may end before the others.
                if !samples[index].is_empty() {
                    detector.push(stamp_ns(start_ns, read, file.sample_rate_hz(index)), &samples[index], found);
                }
                // Announcements are for live use.
                found.retain(|detection| matches!(detection, Detection::Ended(_)));
            }
            read += count as u64;
        }
        let heard = wanted.into_iter().zip(detectors).map(|(channel, (mut detector, mut found))| {
            detector.finish(&mut found);
            let mut squeals: Vec<Squeal> = found.into_iter().filter_map(Detection::ended).collect();
            squeals.sort_by_key(|squeal| (squeal.onset_ns, squeal.number));
            let index = usize::from(channel - 1);
            Heard {
                channel,
                name: file.name(index).to_owned(),
                sample_rate_hz: file.sample_rate_hz(index),
                duration_s: file.duration_s(index),
                quantity: detector.quantity(),
                band_hz: detector.band_hz(),
                frame_s: detector.frame_s(),
                latency_s: detector.latency_s(),
                squeals,
                counts: detector.counts().clone(),
            }
        });
        Ok(heard.collect())
    }

    fn report(&self, file: &SampleFile, heard: &[Heard], against: Option<&Against>) -> anyhow::Result<Report<'static>> {
        let mut channels = vec![];
        for heard in heard {
            let met =
                against.map(|against| against.meet(&heard.squeals, heard.duration_s, heard.band_hz)).transpose()?;
            channels.push(ChannelReport {
                channel: heard.channel,
                name: heard.name.clone(),
                sample_rate_hz: heard.sample_rate_hz,
                level_unit: heard.quantity.level_unit(),
                band_hz: heard.band_hz,
                frame_s: heard.frame_s,
                latency_s: heard.latency_s,
                samples: heard.counts.samples,
                not_finite: heard.counts.not_finite,
                squeals: heard.rows(against.map_or(0, |against| against.start_ns)).collect(),
                against: met.map(|met| Scores::of(met.meeting)),
            });
        }
        Ok(Report {
            file: self.file.display().to_string(),
            encoding: file.format(),
            sample_rate_hz: file.sample_rate_hz(0),
            duration_s: duration_s(file),
            missing_bytes: file.missing_bytes(),
            threshold_db: self.detection.threshold_db,
            channels,
        })
    }

    fn text(&self, file: &SampleFile, heard: &[Heard], against: Option<&Against>) -> anyhow::Result<String> {
        let plural = |number: usize| if number == 1 { "" } else { "s" };
        let mut text = format!(
            "{}: {:.3} s, {} Hz, {}, {} channel{}\n",
            self.file.display(),
            duration_s(file),
            file.sample_rate_hz(0),
            file.format(),
            file.channel_count(),
            plural(file.channel_count()),
        );
        for heard in heard {
            let [low, high] = heard.band_hz;
            let count = heard.squeals.len();
            let _ = writeln!(
                text,
                "\nchannel {}{}: {count} squeal{} of at least {} {} between {low} and {high} Hz",
                heard.channel,
                if heard.name.is_empty() { String::new() } else { format!(" ({})", printable(&heard.name)) },
                plural(count),
                self.detection.threshold_db,
                heard.quantity.level_unit(),
            );
            let _ = writeln!(
                text,
                "frames of {:.1} ms; live, a squeal would be announced within {:.2} s",
                1e3 * heard.frame_s,
                heard.latency_s
            );
            if heard.counts.not_finite > 0 {
                let _ = writeln!(text, "{} samples are no numbers and were taken for 0", heard.counts.not_finite);
            }
            if count > 0 {
                text += "\n  no       onset         end   frequency   level    peak  growth rate  95 % confidence\n";
                text += "               s           s          Hz      dB      dB          1/s              1/s\n";
            }
            for row in heard.rows(against.map_or(0, |against| against.start_ns)) {
                text += &line(&row);
            }
            if let Some(against) = against {
                text += &against.text(&against.meet(&heard.squeals, heard.duration_s, heard.band_hz)?);
            }
        }
        Ok(text)
    }
}

impl CalibrationArgs {
    /// What the samples of channel `index` of `file`, counted from 0, mean.
    ///
    /// # Errors
    /// Sensitivities for another number of channels; a calibrator that cannot be read or is not steady.
    pub fn channel(&self, file: &SampleFile, index: usize, name: String) -> anyhow::Result<Channel> {
        let unit = self.unit.or(file.unit(index)).unwrap_or(Unit::FullScale);
        let channels = file.channel_count();
        let sensitivity = match &self.sensitivity[..] {
            [] => self.calibrated(index, unit)?,
            [all] => Some(*all),
            each if each.len() == channels => Some(each[index]),
            each => {
                bail!("--sensitivity is given {} times, expected once or for each of {channels} channels", each.len())
            }
        };
        Ok(Channel { name, sample_rate_hz: file.sample_rate_hz(index), unit, sensitivity })
    }

    /// The sensitivity of a channel from the recording of a calibrator, if there is one.
    fn calibrated(&self, channel: usize, unit: Unit) -> anyhow::Result<Option<Sensitivity>> {
        let Some(path) = &self.calibration else { return Ok(None) };
        let file = path.display();
        if !matches!(unit, Unit::FullScale | Unit::Volt) {
            bail!("--calibration: the samples are in {unit}, which needs no calibrator");
        }
        let mut calibrator = SampleFile::open(path)?;
        let channels = calibrator.channel_count();
        // A calibrator is recorded microphone by microphone, or on all channels.
        let index = if channels == 1 { 0 } else { channel };
        ensure!(index < channels, "{file}: has {channels} channels and no channel {}", channel + 1);
        let length = frame_length(calibrator.sample_rate_hz(index));
        let mut spectra = Spectra::new(length);
        let mut powers = vec![];
        let mut samples = vec![vec![]; channels];
        while calibrator.read(length, &mut samples)? == length && samples[index].len() == length {
            let power = spectra.power(samples[index].iter().map(|&sample| f64::from(sample)));
            let inner = 1..power.len() - 1;
            let highest = inner.max_by(|&a, &b| power[a].total_cmp(&power[b])).unwrap_or(1);
            powers.push(spectra.tone(highest).power);
            samples.iter_mut().for_each(Vec::clear);
        }
        powers.sort_by(f64::total_cmp);
        let Some(&median) = powers.get(powers.len() / 2) else {
            bail!("{file}: has {} samples, expected at least {length}", samples[index].len());
        };
        let [low, high] = [powers.len() / 10, powers.len() - 1 - powers.len() / 10].map(|index| powers[index]);
        let range_db = 10.0 * (high / low).log10();
        if !(range_db <= STEADY_DB && median > 0.0) {
            bail!(
                "{file}: the level of its loudest tone varies by {range_db:.1} dB, expected a steady tone: {STEADY_DB} dB"
            );
        }
        let pressure = Quantity::SoundPressure.reference() * 10.0_f64.powf(0.05 * self.calibration_db);
        let value = median.sqrt() / pressure;
        Ok(Some(Sensitivity { value, output: unit, quantity: Quantity::SoundPressure }))
    }
}

/// Length of the longest channel, s.
fn duration_s(file: &SampleFile) -> f64 {
    (0..file.channel_count()).map(|channel| file.duration_s(channel)).fold(0.0, f64::max)
}

fn line(row: &Row) -> String {
    let mut text = format!(
        "{:>4}  {:>10.4}  {:>10.4}  {:>10.2}  {:>6.1}  {:>6.1}",
        row.number, row.onset_s, row.end_s, row.frequency_hz, row.level_db, row.peak_level_db
    );
    match (row.growth_rate_per_s, row.growth_rate_low_per_s, row.growth_rate_high_per_s) {
        (Some(rate), Some(low), Some(high)) => {
            let _ = write!(text, "  {rate:>11.1}  {:>15}", format!("{low:.1} to {high:.1}"));
        }
        _ => text += &format!("  {:>11}  {:>15}", "-", "-"),
    }
    if let (Some(order), Some(of)) = (row.harmonic_order, row.harmonic_of) {
        let _ = write!(text, "  harmonic {order} of {of}");
    }
    for (cut, end) in [(row.cut_at_onset, "before"), (row.cut_at_end, "after")] {
        if cut {
            let _ = write!(text, "  goes on {end} the samples");
        }
    }
    text + "\n"
}

fn csv(rows: &[Row]) -> anyhow::Result<Vec<u8>> {
    let mut writer = csv::WriterBuilder::new().has_headers(false).from_writer(vec![]);
    writer.write_record([
        "channel",
        "number",
        "onset_s",
        "end_s",
        "cut_at_onset",
        "cut_at_end",
        "frequency_hz",
        "level_db",
        "peak_level_db",
        "prominence_db",
        "growth_rate_per_s",
        "growth_rate_low_per_s",
        "growth_rate_high_per_s",
        "harmonic_order",
        "harmonic_of",
    ])?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    Ok(writer.into_inner()?)
}
