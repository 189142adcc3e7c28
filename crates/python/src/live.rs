//! A client of a running node over shared memory.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use pyo3::prelude::*;
use pyo3::types::PyDict;
use squealcast::bus::shm::{ShmOptions, ShmSink, ShmSource};
use squealcast::msgs::{Header, OperatingPoint, Prediction, Time};

use crate::errors::LiveError;
use crate::recording::predictions;
use crate::run::LOOK_EVERY;

/// Predictions that are kept until they are asked for; the oldest are dropped and counted.
const KEPT: usize = 65_536;

/// Sends operating points to a running node and receives its predictions, over shared memory.
///
/// `squealcast run RIG --no-ros` starts a node; on both sides, the same prefix goes before the names of the services. Use it
/// in a `with` statement, or call `close`.
///
/// Parameters
/// ----------
/// prefix : str
///     Prefix of the service names: that of `squealcast run --shm-prefix`.
///
/// Raises `LiveError` if shared memory cannot be used.
///
/// >>> with squealcast.Live(prefix="doctest/") as live:
/// ...     live.nodes, live.receive(timeout_s=0.0)
/// (0, None)
#[pyclass(frozen, module = "squealcast")]
pub struct Live {
    ports: Mutex<Option<Ports>>,
    inbox: Arc<Inbox>,
    sent: AtomicU64,
}

struct Ports {
    source: ShmSource,
    sink: ShmSink,
}

/// Predictions received and not asked for yet.
#[derive(Default)]
struct Inbox {
    waiting: Mutex<Waiting>,
    arrived: Condvar,
}

#[derive(Default)]
struct Waiting {
    predictions: VecDeque<Prediction>,
    dropped: u64,
}

/// The content of a lock; a thread that panicked left it whole.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn failed(error: impl std::fmt::Display) -> PyErr {
    LiveError::new_err(format!("shared memory: {error}"))
}

impl Inbox {
    fn put(&self, prediction: Prediction) {
        let mut waiting = locked(&self.waiting);
        if waiting.predictions.len() == KEPT {
            waiting.predictions.pop_front();
            waiting.dropped += 1;
        }
        waiting.predictions.push_back(prediction);
        self.arrived.notify_one();
    }

    /// The oldest prediction; waits for one until `deadline`, looking for signals.
    fn take(&self, py: Python<'_>, deadline: Instant) -> PyResult<Option<Prediction>> {
        loop {
            let taken = py.detach(|| {
                let left = deadline.saturating_duration_since(Instant::now()).min(LOOK_EVERY);
                let empty = |waiting: &mut Waiting| waiting.predictions.is_empty();
                let waited = self.arrived.wait_timeout_while(locked(&self.waiting), left, empty);
                waited.unwrap_or_else(PoisonError::into_inner).0.predictions.pop_front()
            });
            py.check_signals()?;
            if taken.is_some() || Instant::now() >= deadline {
                return Ok(taken);
            }
        }
    }
}

impl Live {
    /// What `of` gives of the ports.
    ///
    /// # Errors
    /// `LiveError` if they are closed.
    fn with<T>(&self, of: impl FnOnce(&Ports) -> PyResult<T>) -> PyResult<T> {
        match locked(&self.ports).as_ref() {
            Some(ports) => of(ports),
            None => Err(LiveError::new_err("the client is closed")),
        }
    }
}

/// The moment `timeout_s` from now.
///
/// # Errors
/// `LiveError` for a time that is no time.
fn deadline(timeout_s: f64) -> PyResult<Instant> {
    let wait = Duration::try_from_secs_f64(timeout_s).ok().filter(|wait| wait.as_secs() < 1 << 31);
    let wait = wait.ok_or_else(|| LiveError::new_err(format!("timeout_s is {timeout_s}, expected 0 to 2e9")))?;
    Ok(Instant::now() + wait)
}

/// A prediction as a dictionary: the columns of `Recording.predictions` without its first axis.
fn shown<'py>(py: Python<'py>, prediction: &Prediction) -> PyResult<Bound<'py, PyDict>> {
    let columns = PyDict::new(py);
    predictions(&columns, &[prediction])?;
    let one = PyDict::new(py);
    one.set_item("stamp_ns", prediction.header.stamp.as_ns())?;
    for (name, column) in columns {
        one.set_item(name, column.get_item(0)?)?;
    }
    Ok(one)
}

#[pymethods]
impl Live {
    #[new]
    #[pyo3(signature = (*, prefix = String::new()))]
    fn new(prefix: String) -> PyResult<Self> {
        let options = ShmOptions { service_prefix: prefix, ..Default::default() };
        let inbox = Arc::<Inbox>::default();
        let receiving = inbox.clone();
        let sink = ShmSink::spawn(&options, move |received| receiving.put(received.message)).map_err(failed)?;
        let source = ShmSource::new(&options).map_err(failed)?;
        Ok(Self { ports: Mutex::new(Some(Ports { source, sink })), inbox, sent: AtomicU64::new(0) })
    }

    /// Sends an operating point; returns its sequence number, which the prediction for it carries as `input_seq`.
    ///
    /// Parameters
    /// ----------
    /// load_n, speed_rad_s, mu : float
    ///     Normal load, N; disc speed, rad/s; friction coefficient.
    /// stamp_ns : int, optional
    ///     Time of measurement, ns since the epoch; by default now.
    ///
    /// Raises `LiveError`.
    #[pyo3(signature = (*, load_n, speed_rad_s, mu, stamp_ns = None))]
    fn send(&self, load_n: f64, speed_rad_s: f64, mu: f64, stamp_ns: Option<i64>) -> PyResult<u64> {
        let now = || SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as i64);
        let stamp = Time::from_ns(stamp_ns.unwrap_or_else(now));
        self.with(|ports| {
            let seq = self.sent.fetch_add(1, Ordering::Relaxed) + 1;
            let input = OperatingPoint {
                header: Header { stamp, frame_id: String::new() },
                seq,
                normal_load_n: load_n,
                disc_speed_rad_s: speed_rad_s,
                friction_coefficient: mu,
            };
            ports.source.publish(&input).map_err(failed)?;
            Ok(seq)
        })
    }

    /// The oldest prediction that was received and not taken yet; `None` if none comes within `timeout_s`.
    ///
    /// A dictionary of the fields of `Recording.predictions`: numbers, and arrays of modes. Ctrl-C ends the wait.
    #[pyo3(signature = (*, timeout_s = 1.0))]
    fn receive<'py>(&self, py: Python<'py>, timeout_s: f64) -> PyResult<Option<Bound<'py, PyDict>>> {
        let prediction = self.inbox.take(py, deadline(timeout_s)?)?;
        prediction.map(|prediction| shown(py, &prediction)).transpose()
    }

    /// Sends an operating point and waits for the prediction for it; predictions received before are passed over.
    ///
    /// Raises `LiveError` if it does not come within `timeout_s`.
    #[pyo3(signature = (*, load_n, speed_rad_s, mu, stamp_ns = None, timeout_s = 1.0))]
    fn predict<'py>(
        &self,
        py: Python<'py>,
        load_n: f64,
        speed_rad_s: f64,
        mu: f64,
        stamp_ns: Option<i64>,
        timeout_s: f64,
    ) -> PyResult<Bound<'py, PyDict>> {
        let deadline = deadline(timeout_s)?;
        let seq = self.send(load_n, speed_rad_s, mu, stamp_ns)?;
        while let Some(prediction) = self.inbox.take(py, deadline)? {
            if prediction.input_seq == seq {
                return shown(py, &prediction);
            }
        }
        Err(LiveError::new_err(format!("no prediction for input {seq} within {timeout_s} s")))
    }

    /// Number of readers of operating points, such as nodes; killed ones count until their remains are removed.
    #[getter]
    fn nodes(&self) -> PyResult<usize> {
        self.with(|ports| Ok(ports.source.readers()))
    }

    /// Number of other sources of operating points.
    #[getter]
    fn other_sources(&self) -> PyResult<usize> {
        self.with(|ports| Ok(ports.source.other_writers()))
    }

    /// Counts so far: `sent`, `received`, `missed` (predictions lost on the way), `malformed`, `failures`, and `dropped`
    /// (predictions that were never taken and made room for newer ones).
    #[getter]
    fn counts<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let counts = self.with(|ports| Ok(ports.sink.counts()))?;
        let named = PyDict::new(py);
        for (name, value) in [
            ("sent", self.sent.load(Ordering::Relaxed)),
            ("received", counts.received),
            ("missed", counts.missed),
            ("malformed", counts.malformed),
            ("failures", counts.failures),
            ("dropped", locked(&self.inbox.waiting).dropped),
        ] {
            named.set_item(name, value)?;
        }
        Ok(named)
    }

    /// Leaves shared memory.
    fn close(&self, py: Python<'_>) {
        py.detach(|| drop(locked(&self.ports).take()));
    }

    fn __enter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __exit__(
        &self,
        py: Python<'_>,
        _kind: &Bound<'_, PyAny>,
        _value: &Bound<'_, PyAny>,
        _traceback: &Bound<'_, PyAny>,
    ) {
        self.close(py);
    }
}
