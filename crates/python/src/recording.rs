//! Recordings as columns.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use numpy::Element;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use squealcast::display::comparison::Criteria;
use squealcast::display::recorded::Recorded as Display;
use squealcast::msgs::{Header, Mode, Prediction, SessionEventKind, heard_verdict};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{self, ReadOptions, Recorded};
use squealcast::recording::recorded_rig;

use crate::arrays::array;
use crate::errors::RecordingError;
use crate::rig::Rig;
use crate::run::interruptible;

/// A recording of a session: a rosbag2 directory or a single MCAP file, finished, interrupted or damaged.
///
/// Each method returns a dictionary of numpy arrays with one entry per message, in recorded order; `stamp_ns` is the time
/// of measurement, ns since the epoch, and `log_time_ns` the time of recording. `to_pandas` makes a table of one of them.
///
/// Parameters
/// ----------
/// path : str or path
///     The recording.
/// topics : list of str
///     Recorded topics to read instead of the node's own topics of the same types.
///
/// Raises `RecordingError`. Damage is no error but listed in `damage`; topics that cannot be read in `unread`.
///
/// >>> squealcast.Recording("missing")
/// Traceback (most recent call last):
/// squealcast.RecordingError: missing: No such file or directory (os error 2)
#[pyclass(frozen, module = "squealcast")]
pub struct Recording {
    path: PathBuf,
    recording: Arc<reader::Recording>,
}

type Columns<'py> = Bound<'py, PyDict>;

/// Sets a column of one value per message.
fn put<T: Element>(columns: &Columns<'_>, name: &str, values: Vec<T>) -> PyResult<()> {
    let shape = [values.len()];
    columns.set_item(name, array(columns.py(), values, &shape)?)
}

/// Sets a column of texts.
fn put_texts(columns: &Columns<'_>, name: &str, values: Vec<String>) -> PyResult<()> {
    let py = columns.py();
    let options = PyDict::new(py);
    options.set_item("dtype", "object")?;
    columns.set_item(name, py.import("numpy")?.call_method("array", (values,), Some(&options))?)
}

/// Messages of one topic with the time at which each was recorded.
type Logged<M> = Vec<(u64, M)>;

/// Columns with the times of messages.
fn timed<'py, M>(py: Python<'py>, messages: &Logged<M>, header: impl Fn(&M) -> &Header) -> PyResult<Columns<'py>> {
    let columns = PyDict::new(py);
    put(&columns, "stamp_ns", messages.iter().map(|(_, message)| header(message).stamp.as_ns()).collect())?;
    put(&columns, "log_time_ns", messages.iter().map(|(log_time_ns, _)| *log_time_ns).collect())?;
    Ok(columns)
}

impl Recording {
    /// The messages of a topic.
    fn messages<M: Send>(
        &self,
        py: Python<'_>,
        of: impl Fn(Payload) -> Option<M> + Send + Sync,
    ) -> PyResult<Logged<M>> {
        interruptible(py, |stopped| {
            let messages = self.recording.messages().take_while(|_| !stopped.load(Ordering::Relaxed));
            let known = messages.filter_map(|entry| match entry.message {
                Recorded::Known(payload) => Some((entry.log_time_ns, of(payload)?)),
                Recorded::Unreadable(_) | Recorded::Other => None,
            });
            known.collect()
        })
    }
}

/// The columns of predictions, those of modes with a row for each prediction, filled up with identity -1 and NaN.
pub fn predictions<'py>(columns: &Columns<'py>, predictions: &[&Prediction]) -> PyResult<()> {
    let of = |value: fn(&Prediction) -> f64| predictions.iter().map(|prediction| value(prediction)).collect();
    put(columns, "input_seq", predictions.iter().map(|prediction| prediction.input_seq).collect())?;
    put(columns, "level", predictions.iter().map(|prediction| prediction.level).collect())?;
    put(columns, "reused", predictions.iter().map(|prediction| prediction.reused).collect())?;
    put(columns, "unstable_modes", predictions.iter().map(|prediction| prediction.unstable_modes).collect())?;
    put(columns, "max_growth_rate_per_s", of(|prediction| prediction.max_growth_rate_per_s))?;
    put(columns, "worst_frequency_hz", of(|prediction| prediction.worst_frequency_hz))?;
    put(columns, "critical_friction", of(|prediction| prediction.critical_friction))?;
    put(columns, "friction_margin", of(|prediction| prediction.friction_margin))?;
    put(columns, "friction_margin_error", of(|prediction| prediction.friction_margin_error))?;
    put_texts(columns, "reason", predictions.iter().map(|prediction| prediction.reason.clone()).collect())?;
    let width = predictions.iter().map(|prediction| prediction.modes.len()).max().unwrap_or(0);
    let shape = [predictions.len(), width];
    let py = columns.py();
    fn rows<T: Copy>(predictions: &[&Prediction], width: usize, none: T, of: impl Fn(&Mode) -> T) -> Vec<T> {
        let row = |prediction: &&Prediction| {
            let row: Vec<T> = (0..width).map(|k| prediction.modes.get(k).map_or(none, &of)).collect();
            row
        };
        predictions.iter().flat_map(row).collect()
    }
    let ids = rows(predictions, width, -1, |mode| i32::try_from(mode.id).unwrap_or(i32::MAX));
    columns.set_item("mode_id", array(py, ids, &shape)?)?;
    type Value = fn(&Mode) -> f64;
    let numbers: [(&str, Value); 7] = [
        ("frequency_hz", |mode| mode.frequency_hz),
        ("growth_rate_per_s", |mode| mode.growth_rate_per_s),
        ("damping_ratio", |mode| mode.damping_ratio),
        ("pad_participation", |mode| mode.pad_participation),
        ("residual", |mode| mode.residual),
        ("frequency_error_hz", |mode| mode.frequency_error_hz),
        ("growth_rate_error_per_s", |mode| mode.growth_rate_error_per_s),
    ];
    for (name, of) in numbers {
        columns.set_item(name, array(py, rows(predictions, width, f64::NAN, of), &shape)?)?;
    }
    Ok(())
}

#[pymethods]
impl Recording {
    #[new]
    #[pyo3(signature = (path, *, topics = vec![]))]
    fn new(py: Python<'_>, path: PathBuf, topics: Vec<String>) -> PyResult<Self> {
        let opened = interruptible(py, |_| reader::Recording::open_with(&path, ReadOptions { topics }))?;
        let recording = opened.map_err(|error| RecordingError::new_err(error.to_string()))?;
        Ok(Self { path, recording: Arc::new(recording) })
    }

    /// Its files, in order.
    #[getter]
    fn files(&self) -> Vec<PathBuf> {
        self.recording.files().to_vec()
    }

    /// Damage found on opening: an unfinished or truncated file.
    #[getter]
    fn damage(&self) -> Vec<String> {
        self.recording.damage().iter().map(ToString::to_string).collect()
    }

    /// Topics that are not read, and why.
    #[getter]
    fn unread(&self) -> Vec<String> {
        self.recording.topics().unread().iter().map(ToString::to_string).collect()
    }

    /// The rig that the session was predicted with, as it is in the recording.
    ///
    /// Raises `RecordingError` if there is none.
    fn rig(&self, py: Python<'_>) -> PyResult<Rig> {
        let rig = interruptible(py, |_| recorded_rig(&self.recording))?;
        Ok(Rig::new(rig.map_err(|error| RecordingError::new_err(error.to_string()))?))
    }

    /// The operating points: `seq`, `load_n`, `speed_rad_s`, `mu`.
    fn inputs<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        let messages =
            self.messages(
                py,
                |payload| if let Payload::OperatingPoint(message) = payload { Some(message) } else { None },
            )?;
        let columns = timed(py, &messages, |message| &message.header)?;
        put(&columns, "seq", messages.iter().map(|(_, message)| message.seq).collect())?;
        put(&columns, "load_n", messages.iter().map(|(_, message)| message.normal_load_n).collect())?;
        put(&columns, "speed_rad_s", messages.iter().map(|(_, message)| message.disc_speed_rad_s).collect())?;
        put(&columns, "mu", messages.iter().map(|(_, message)| message.friction_coefficient).collect())?;
        Ok(columns)
    }

    /// The predictions: the arrays of `Predictions` by the same names, and `input_seq`, `reused`, `reason`. Arrays of modes
    /// have shape `(predictions, modes)`, filled up with identity -1 and NaN.
    fn predictions<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        let messages =
            self.messages(py, |payload| if let Payload::Prediction(message) = payload { Some(message) } else { None })?;
        let columns = timed(py, &messages, |message| &message.header)?;
        predictions(&columns, &messages.iter().map(|(_, message)| message).collect::<Vec<_>>())?;
        Ok(columns)
    }

    /// Measured vibration: `frequency_hz` and `level_db` of the highest peak of its spectrum.
    fn vibration<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        let messages =
            self.messages(py, |payload| if let Payload::Vibration(message) = payload { Some(message) } else { None })?;
        let columns = timed(py, &messages, |message| &message.header)?;
        put(&columns, "frequency_hz", messages.iter().map(|(_, message)| message.frequency_hz).collect())?;
        put(&columns, "level_db", messages.iter().map(|(_, message)| message.level_db).collect())?;
        Ok(columns)
    }

    /// Temperatures of the contact: `temperature_c`.
    fn temperatures<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        let messages = self
            .messages(py, |payload| if let Payload::Temperature(message) = payload { Some(message) } else { None })?;
        let columns = timed(py, &messages, |message| &message.header)?;
        put(&columns, "temperature_c", messages.iter().map(|(_, message)| message.temperature).collect())?;
        Ok(columns)
    }

    /// Squeals found in sound, each twice (`ended` tells which): `channel`, `number`, `ended`, `end_stamp_ns`,
    /// `frequency_hz`, `level_db`, `growth_rate_per_s`, `verdict`, `mode_id`, `predicted_frequency_hz`.
    fn heard<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        let messages =
            self.messages(py, |payload| if let Payload::Heard(message) = payload { Some(message) } else { None })?;
        let columns = timed(py, &messages, |message| &message.header)?;
        let heard = || messages.iter().map(|(_, message)| message);
        put_texts(&columns, "channel", heard().map(|squeal| squeal.channel.clone()).collect())?;
        put(&columns, "number", heard().map(|squeal| squeal.number).collect())?;
        put(&columns, "ended", heard().map(|squeal| squeal.state != 0).collect())?;
        put(&columns, "end_stamp_ns", heard().map(|squeal| squeal.end_stamp.as_ns()).collect())?;
        put(&columns, "frequency_hz", heard().map(|squeal| squeal.frequency_hz).collect())?;
        put(&columns, "level_db", heard().map(|squeal| squeal.level_db).collect())?;
        put(&columns, "growth_rate_per_s", heard().map(|squeal| squeal.growth_rate_per_s).collect())?;
        put_texts(&columns, "verdict", heard().map(|squeal| heard_verdict::name(squeal.verdict).to_owned()).collect())?;
        put(&columns, "mode_id", heard().map(|squeal| squeal.mode_id).collect())?;
        put(&columns, "predicted_frequency_hz", heard().map(|squeal| squeal.predicted_frequency_hz).collect())?;
        Ok(columns)
    }

    /// Session events, which change predictions without being inputs: `kind`, `name`, `value`, `load_n`, `speed_rad_s`,
    /// `hash`.
    fn session_events<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        let messages = self
            .messages(py, |payload| if let Payload::SessionEvent(message) = payload { Some(message) } else { None })?;
        let columns = timed(py, &messages, |message| &message.header)?;
        let events = || messages.iter().map(|(_, message)| message);
        let kind = |kind: SessionEventKind| format!("{kind:?}");
        let kinds = events().map(|event| SessionEventKind::of(event).map_or_else(|| event.kind.to_string(), kind));
        put_texts(&columns, "kind", kinds.collect())?;
        put_texts(&columns, "name", events().map(|event| event.name.clone()).collect())?;
        put(&columns, "value", events().map(|event| event.value).collect())?;
        put(&columns, "load_n", events().map(|event| event.normal_load_n).collect())?;
        put(&columns, "speed_rad_s", events().map(|event| event.disc_speed_rad_s).collect())?;
        put_texts(&columns, "hash", events().map(|event| event.hash.clone()).collect())?;
        Ok(columns)
    }

    /// Squeals, faults and silences, one row each: the columns of the file `events.csv` of `squealcast report`, as numbers
    /// where they are numbers (NaN where there is none) and else as text.
    ///
    /// Raises `RecordingError` without a rig in the recording.
    fn events<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let text = interruptible(py, |_| {
            let rig = recorded_rig(&self.recording)?;
            Ok(Display::read(&self.recording, Arc::new(rig), Criteria::default()).events.to_csv())
        })?;
        let text =
            text.map_err(|error: squealcast::recording::RecordedRigError| RecordingError::new_err(error.to_string()))?;
        py.import("squealcast._frames")?.call_method1("columns_of_csv", (text,))
    }

    /// Samples of microphones and accelerometers by channel: a dictionary of `unit`, `sample_rate_hz`, `samples` (float32,
    /// all blocks one after the other), and for each block `stamp_ns`, the time of its first sample, and `first`, the
    /// index of that sample.
    fn waveforms<'py>(&self, py: Python<'py>) -> PyResult<Columns<'py>> {
        let blocks =
            self.messages(py, |payload| if let Payload::Waveform(message) = payload { Some(message) } else { None })?;
        let mut names: Vec<&str> = blocks.iter().map(|(_, block)| block.channel.as_str()).collect();
        names.sort_unstable();
        names.dedup();
        let channels = PyDict::new(py);
        for name in names {
            let own = || blocks.iter().map(|(_, block)| block).filter(|block| block.channel == name);
            let Some(first) = own().next() else { continue };
            let channel = PyDict::new(py);
            channel.set_item("unit", &first.unit)?;
            channel.set_item("sample_rate_hz", first.sample_rate_hz)?;
            put(&channel, "samples", own().flat_map(|block| block.samples.iter().copied()).collect())?;
            put(&channel, "stamp_ns", own().map(|block| block.header.stamp.as_ns()).collect())?;
            let begins = own().scan(0_u64, |at, block| Some(std::mem::replace(at, *at + block.samples.len() as u64)));
            put(&channel, "first", begins.collect())?;
            channels.set_item(name, channel)?;
        }
        Ok(channels)
    }

    /// A `pandas.DataFrame` of what one of the methods returns, indexed by the stamp where there is one; arrays of modes
    /// become columns such as `frequency_hz_0`.
    ///
    /// Raises `ImportError` where pandas is not installed.
    fn to_pandas<'py>(slf: &Bound<'py, Self>, name: &str) -> PyResult<Bound<'py, PyAny>> {
        slf.py().import("squealcast._frames")?.call_method1("of_columns", (slf.call_method0(name)?,))
    }

    fn __repr__(&self) -> String {
        format!("Recording('{}')", self.path.display())
    }
}
