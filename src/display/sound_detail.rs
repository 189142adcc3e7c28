//! A part of a spectrogram in detail, from samples that are read again from their recording.

use crate::msgs::{MAX_WAVEFORM_SAMPLES, Waveform};
use crate::recording::message::Payload;
use crate::recording::reader::{Recorded as Content, Recording};
use crate::sound::search::channel_of;
use crate::sound::spectrogram::{Part, Spectrogram};
use crate::sound::waveform::stamp_ns;

use super::time_line::TimeLine;

/// Interval between noted moments, ns of log time.
const EVERY_NS: i64 = 1_000_000_000;
/// Allowance for samples that come later than those of another channel, ns.
const LATE_NS: i64 = 2_000_000_000;
/// Columns of a part.
const COLUMNS: usize = 2400;
/// The most samples of a channel in a part.
const MOST_SAMPLES: f64 = 8e6;

/// Where in a recording the samples of a time are.
#[derive(Debug, Default)]
pub struct SampleIndex {
    noted: Vec<Noted>,
}

/// A moment at which samples were recorded.
#[derive(Debug)]
struct Noted {
    log_ns: i64,
    /// Of the first sample of a block, on the time line of the page.
    time_ns: i64,
    line: TimeLine,
}

impl SampleIndex {
    /// Notes that a block recorded at a log time has its place on the time line.
    pub fn note(&mut self, log_ns: i64, time_ns: i64, line: TimeLine) {
        let known = |last: &Noted| log_ns.saturating_sub(last.log_ns) < EVERY_NS && last.line.runs_as(&line);
        if !self.noted.last().is_some_and(known) {
            self.noted.push(Noted { log_ns, time_ns, line });
        }
    }

    /// Log times between which the samples of a stretch of time were recorded.
    fn log_times_ns(&self, from_ns: i64, to_ns: i64) -> (i64, i64) {
        let first = self.noted.partition_point(|noted| noted.time_ns < from_ns);
        let last = self.noted.partition_point(|noted| noted.time_ns <= to_ns);
        let log_ns = |at: Option<usize>| at.and_then(|at| self.noted.get(at)).map(|noted| noted.log_ns);
        (log_ns(first.checked_sub(1)).unwrap_or(0), log_ns(Some(last)).unwrap_or(i64::MAX))
    }

    /// The place of a block on the time line.
    fn time_ns(&self, block: &Waveform, log_ns: i64) -> Option<i64> {
        let after = self.noted.partition_point(|noted| noted.log_ns <= log_ns);
        let noted = self.noted.get(after.checked_sub(1)?)?;
        Some(noted.line.of_stamp(block.header.stamp, log_ns))
    }

    /// A part of the spectrogram of a channel, `whole`, in detail; `None` if it is too long or there are no samples.
    pub fn detail(&self, recording: &Recording, whole: &Spectrogram, part: Part) -> Option<Spectrogram> {
        let length_s = (part.to_ns - part.from_ns) as f64 * 1e-9;
        let part = Part { high_hz: part.high_hz.min(whole.top_hz()), ..part };
        if length_s > longest_part_s(whole) || part.low_hz >= part.high_hz {
            return None;
        }
        let mut detail = Spectrogram::part(whole.channel(), whole.band_hz(), part, COLUMNS).ok()?;
        let rate_hz = whole.channel().sample_rate_hz;
        // Blocks are as long as a message may be, and may be recorded at their end.
        let slack_ns = LATE_NS.saturating_add(stamp_ns(0, MAX_WAVEFORM_SAMPLES as u64, rate_hz));
        let (from_log, to_log) =
            self.log_times_ns(part.from_ns.saturating_sub(slack_ns), part.to_ns.saturating_add(slack_ns));
        for entry in recording.messages_around(from_log.max(0) as u64..=to_log.max(0) as u64) {
            let Content::Known(Payload::Waveform(block)) = entry.message else { continue };
            if block.channel != whole.channel().name || channel_of(&block).as_ref() != Ok(whole.channel()) {
                continue;
            }
            let log_ns = i64::try_from(entry.log_time_ns).unwrap_or(i64::MAX);
            let Some(start_ns) = self.time_ns(&block, log_ns) else { continue };
            let index = |time_ns: i64| {
                let samples = time_ns.saturating_sub(start_ns) as f64 * 1e-9 * rate_hz;
                (samples.round().max(0.0) as usize).min(block.samples.len())
            };
            let (first, end) = (index(part.from_ns), index(part.to_ns));
            if first < end {
                detail.push(stamp_ns(start_ns, first as u64, rate_hz), &block.samples[first..end]);
            }
        }
        Some(detail)
    }
}

/// Length up to which a part of a spectrogram is shown in detail, s.
pub fn longest_part_s(whole: &Spectrogram) -> f64 {
    MOST_SAMPLES / whole.channel().sample_rate_hz
}
