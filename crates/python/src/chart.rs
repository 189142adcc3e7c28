//! Charts: predictions in microseconds.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use pyo3::exceptions::PyKeyboardInterrupt;
use pyo3::prelude::*;
use squealcast::files::chart_file::ChartFile;
use squealcast::node::kept_chart;
use squealcast::physics::chart::build::{ChartOptions, build};
use squealcast::physics::{self, OperatingPoint};
use squealcast::rig::Rig;
use squealcast::session::chart_options;

use crate::errors::{ChartError, ConditionError};
use crate::run::{interruptible, threads};

/// The roots of a rig over a box of conditions, as piecewise Chebyshev expansions with error bounds: what `Rig.chart`
/// returns and `Rig.predict(chart=...)` evaluates.
///
/// Attributes: `leaves` (number of boxes on which every expansion converged), `solves` (dense solves that the build has
/// taken), `size_bytes`, `dense_share` (share of the box that is not charted and left to dense solves), `path` (its file;
/// `None` if it is not stored).
///
/// >>> rig = squealcast.Rig.load("nine-dof-case-2")
/// >>> chart = rig.chart(mu=(0.0, 1.0))
/// >>> rig.predict(mu=0.5, chart=chart).route == squealcast.Route.CHARTED
/// True
#[pyclass(frozen, module = "squealcast")]
pub struct Chart {
    pub chart: Arc<physics::Chart>,
    pub rig: Arc<Rig>,
    path: Option<PathBuf>,
}

/// The box of a chart: ranges of friction coefficient, load and speed; `None` for those of the rig file.
pub struct Ranges {
    pub mu: Option<(f64, f64)>,
    pub load_n: Option<(f64, f64)>,
    pub speed_rad_s: Option<(f64, f64)>,
}

impl Chart {
    /// Builds a chart of `rig`, or takes it from the cache of the program, where it is also stored if `keep` and the box
    /// is that of the rig file.
    ///
    /// # Errors
    /// `ChartError`; the exception of a signal handler.
    pub fn of(py: Python<'_>, rig: &Arc<Rig>, ranges: &Ranges, keep: bool, asked: Option<usize>) -> PyResult<Self> {
        let Ranges { mu, load_n, speed_rad_s } = *ranges;
        let of_the_file = mu.is_none() && load_n.is_none() && speed_rad_s.is_none();
        // A rig at another temperature has the content of its files, not their chart.
        let at_reference = rig.temperature_c().is_none_or(|celsius| {
            Rig::from_files(&rig.files).is_ok_and(|reference| reference.temperature_c() == Some(celsius))
        });
        let file = (keep && of_the_file && at_reference)
            .then(|| ChartFile::locate(&rig.name, rig.path.as_deref(), &rig.content_hash))
            .flatten();
        let own = chart_options(rig);
        let corner = |own: OperatingPoint, of: fn((f64, f64)) -> f64| OperatingPoint {
            friction_coefficient: mu.map_or(own.friction_coefficient, of),
            normal_load_n: load_n.map_or(own.normal_load_n, of),
            disc_speed_rad_s: speed_rad_s.map_or(own.disc_speed_rad_s, of),
        };
        let threads = threads(asked);
        let options = ChartOptions {
            low: corner(own.low, |range| range.0),
            high: corner(own.high, |range| range.1),
            threads,
            ..own
        };
        let built = interruptible(py, |stopped| {
            let go_on = || !stopped.load(Ordering::Relaxed);
            let built = match &file {
                Some(file) => kept_chart(rig, file, threads, &go_on),
                None => build(&rig.model, &options, &|_| go_on()).map_err(|error| error.to_string()),
            };
            built.map(Arc::new).map_err(|text| if go_on() { Some(text) } else { None })
        })?;
        let chart = built.map_err(|text| match text {
            Some(text) => ChartError::new_err(format!("{}: {text}", rig.name)),
            None => PyKeyboardInterrupt::new_err("stopped"),
        })?;
        Ok(Self { chart, rig: rig.clone(), path: file.map(|file| file.path().to_owned()) })
    }

    /// Checks that this is a chart of `rig`.
    ///
    /// # Errors
    /// `ConditionError`.
    pub fn serves(&self, rig: &Rig) -> PyResult<()> {
        let key = |rig: &Rig| (rig.content_hash.clone(), rig.temperature_c().map(f64::to_bits));
        if key(&self.rig) == key(rig) {
            return Ok(());
        }
        let at =
            |rig: &Rig| rig.temperature_c().map_or_else(|| rig.name.clone(), |t| format!("{} at {t} °C", rig.name));
        Err(ConditionError::new_err(format!("the chart is of {}, expected one of {}", at(&self.rig), at(rig))))
    }
}

#[pymethods]
impl Chart {
    /// Number of boxes on which every expansion converged.
    #[getter]
    fn leaves(&self) -> usize {
        self.chart.leaf_count()
    }

    /// Number of dense solves that the build has taken.
    #[getter]
    fn solves(&self) -> usize {
        self.chart.solve_count()
    }

    /// Size of the coefficients, bytes.
    #[getter]
    fn size_bytes(&self) -> usize {
        self.chart.size_bytes()
    }

    /// Share of the box that is left to dense solves, 0 to 1.
    #[getter]
    fn dense_share(&self) -> f64 {
        self.chart.dense_share()
    }

    /// The file of the chart; `None` if it is not stored.
    #[getter]
    fn path(&self) -> Option<PathBuf> {
        self.path.clone()
    }

    fn __repr__(&self) -> String {
        let (share, leaves) = (100.0 * (1.0 - self.chart.dense_share()), self.chart.leaf_count());
        let plural = if leaves == 1 { "leaf" } else { "leaves" };
        format!("<Chart of {}: {share:.1} % of the box in {leaves} {plural}>", self.rig.name)
    }
}
