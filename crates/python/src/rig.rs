//! Rigs.

use std::path::PathBuf;
use std::sync::Arc;

use faer::Mat;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use squealcast::analysis::condition::{Condition, Place};
use squealcast::analysis::many::{self, Maps, Options};
use squealcast::analysis::sweep::sweep;
use squealcast::analysis::{AnalysisError, check};
use squealcast::figures::html;
use squealcast::physics::{MapOptions, OperatingPoint, Solver, StabilityMap};
use squealcast::rig::{EMBEDDED, Rig as LibraryRig};
use squealcast::session::map_options;

use crate::arrays::{self, Conditions};
use crate::chart::{Chart, Ranges};
use crate::errors::{self, ConditionError};
use crate::predictions::Predictions;
use crate::run::{interruptible, threads as number_of_threads};
use crate::sweep::{Sweep, name};
use crate::windows::Windows;

/// The embedded rigs: name and description, as `squealcast rigs` lists them. The first is the default of the program.
///
/// >>> "tribometer" in squealcast.embedded_rigs()
/// True
#[pyfunction]
pub fn embedded_rigs(py: Python<'_>) -> PyResult<Bound<'_, PyDict>> {
    let rigs = PyDict::new(py);
    for rig in &EMBEDDED {
        rigs.set_item(rig.name, rig.about)?;
    }
    Ok(rigs)
}

/// A rig: a reduced model of pad and disc with its settings, as a rig file describes it.
///
/// ```text
/// (λ² I + λ C(p) + K(p)) x = 0,   λ = σ + iω,   p = (normal load, disc speed, friction coefficient)
/// ```
///
/// A mode grows if `σ > 0`. `Rig.load` reads one; conditions that a call is not given are those of its reference.
///
/// >>> rig = squealcast.Rig.load("nine-dof-case-2")
/// >>> rig
/// Rig('nine-dof-case-2')
/// >>> rig.reference
/// OperatingPoint(load_n=500.0, speed_rad_s=13.0, mu=0.35)
#[pyclass(frozen, module = "squealcast")]
pub struct Rig {
    rig: Arc<LibraryRig>,
}

impl Rig {
    pub fn new(rig: LibraryRig) -> Self {
        Self { rig: Arc::new(rig) }
    }
}

#[pymethods]
impl Rig {
    /// Reads a rig file, or the embedded rig of that name (`squealcast.embedded_rigs()`).
    ///
    /// Parameters
    /// ----------
    /// path : str or path
    ///     A rig file, or the name of an embedded rig.
    /// temperature_c : float, optional
    ///     Temperature of the contact, °C, of a rig with `[temperature]`; by default that of its reference.
    ///
    /// Raises `RigError`, naming file, field, value and limit.
    ///
    /// >>> squealcast.Rig.load("nine-dof").dimension
    /// 9
    /// >>> squealcast.Rig.load("missing.toml")
    /// Traceback (most recent call last):
    /// squealcast.RigError: missing.toml: neither a readable rig file (No such file or directory (os error 2)) nor ...
    #[staticmethod]
    #[pyo3(signature = (path, *, temperature_c = None))]
    fn load(py: Python<'_>, path: PathBuf, temperature_c: Option<f64>) -> PyResult<Self> {
        let path = path.to_string_lossy();
        let rig = interruptible(py, |_| {
            let rig = LibraryRig::load(&path).map_err(errors::rig)?;
            match temperature_c {
                Some(celsius) => rig.at_temperature(celsius).map_err(errors::rig),
                None => Ok(rig),
            }
        })?;
        Ok(Self::new(rig?))
    }

    /// The same rig at another temperature of the contact, °C.
    ///
    /// Raises `RigError` if the rig has no `[temperature]` or not this one.
    fn at_temperature(&self, py: Python<'_>, celsius: f64) -> PyResult<Self> {
        let rig = interruptible(py, |_| self.rig.at_temperature(celsius).map_err(errors::rig))?;
        Ok(Self::new(rig?))
    }

    /// Name of the rig.
    #[getter]
    fn name(&self) -> &str {
        &self.rig.name
    }

    /// Path of the rig file; `None` for an embedded rig.
    #[getter]
    fn path(&self) -> Option<PathBuf> {
        self.rig.path.clone()
    }

    /// SHA-256 of the rig file and all files it refers to, hexadecimal.
    #[getter]
    fn content_hash(&self) -> &str {
        &self.rig.content_hash
    }

    /// Number of coordinates.
    #[getter]
    fn dimension(&self) -> usize {
        self.rig.model.dimension()
    }

    /// Highest frequency that is listed and judged, Hz; `None` for all.
    #[getter]
    fn band_max_hz(&self) -> Option<f64> {
        self.rig.band_max_hz
    }

    /// Windows of instability are sought up to this friction coefficient.
    #[getter]
    fn mu_max(&self) -> f64 {
        self.rig.mu_max
    }

    /// Temperature of the contact, °C; `None` for a rig without `[temperature]`.
    #[getter]
    fn temperature_c(&self) -> Option<f64> {
        self.rig.temperature_c()
    }

    /// The conditions that a call uses unless it is given others: `OperatingPoint(load_n, speed_rad_s, mu)`.
    #[getter]
    fn reference<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient } = self.rig.reference;
        let values = (normal_load_n, disc_speed_rad_s, friction_coefficient);
        py.import("squealcast._types")?.getattr("OperatingPoint")?.call1(values)
    }

    /// Ranges of the conditions that are predicted: low and high of `load_n`, `speed_rad_s` and `mu`.
    #[getter]
    fn limits<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let limits = &self.rig.limits;
        let ranges = PyDict::new(py);
        for (name, [low, high]) in [
            ("load_n", limits.normal_load_n),
            ("speed_rad_s", limits.disc_speed_rad_s),
            ("mu", limits.friction_coefficient),
        ] {
            ranges.set_item(name, (low, high))?;
        }
        Ok(ranges)
    }

    /// Predicts the modes for every condition, as fast as the library: without the GIL, on all processors.
    ///
    /// Parameters
    /// ----------
    /// load_n, speed_rad_s, mu : float or array
    ///     Normal load, N; disc speed, rad/s; friction coefficient. They are broadcast against one another; those not
    ///     given are those of the reference.
    /// chart : Chart, optional
    ///     Of this rig: what it covers is evaluated in microseconds, all else is solved.
    /// maps : "each" or "reference", optional
    ///     Where stability maps give identities, levels and margins: at the load and speed of every condition as far as the
    ///     rig depends on them, which takes some 40 solves each and is exact; or at the reference once, as a session
    ///     numbers modes until it has a newer map. Margins are then NaN where that map does not count. By default
    ///     "each" without a chart and "reference" with one.
    /// modes : bool
    ///     Whether to return the modes; False keeps one value per condition only.
    /// threads : int, optional
    ///     By default as many as processors. Results do not depend on it.
    /// on_fault : "raise" or "mark"
    ///     What to do with a condition that cannot be predicted: raise an exception, or mark it as a fault, with NaN and
    ///     its reason in `faults`.
    ///
    /// Returns `Predictions`. Raises `PredictionError` for a fault, `ConditionError` for shapes that do not go together.
    /// Ctrl-C ends it.
    ///
    /// >>> rig = squealcast.Rig.load("nine-dof-case-2")
    /// >>> found = rig.predict(mu=numpy.linspace(0.0, 1.0, 5))
    /// >>> found.growth_rate_per_s.max(axis=1).round(3)
    /// array([0.   , 0.   , 0.058, 0.098, 0.128])
    /// >>> rig.predict(mu=numpy.nan)
    /// Traceback (most recent call last):
    /// squealcast.PredictionError: nine-dof-case-2: friction_coefficient is NaN, expected a finite number
    #[pyo3(signature = (*, load_n = None, speed_rad_s = None, mu = None, chart = None, maps = None, modes = true, threads = None, on_fault = "raise"))]
    #[allow(clippy::too_many_arguments)] // as many as Python gives names to
    fn predict(
        &self,
        py: Python<'_>,
        load_n: Option<&Bound<'_, PyAny>>,
        speed_rad_s: Option<&Bound<'_, PyAny>>,
        mu: Option<&Bound<'_, PyAny>>,
        chart: Option<&Bound<'_, Chart>>,
        maps: Option<&str>,
        modes: bool,
        threads: Option<usize>,
        on_fault: &str,
    ) -> PyResult<Predictions> {
        let maps = match (maps, chart) {
            (Some("each"), _) | (None, None) => Maps::Each,
            (Some("reference"), _) | (None, Some(_)) => Maps::Reference,
            (Some(other), _) => {
                return Err(ConditionError::new_err(format!("maps is {other:?}, expected \"each\" or \"reference\"")));
            }
        };
        let faults_raise = match on_fault {
            "raise" => true,
            "mark" => false,
            other => {
                return Err(ConditionError::new_err(format!("on_fault is {other:?}, expected \"raise\" or \"mark\"")));
            }
        };
        let chart = chart.map(Bound::get);
        chart.map_or(Ok(()), |chart| chart.serves(&self.rig))?;
        let conditions = Conditions::broadcast(py, [load_n, speed_rad_s, mu], &self.rig.reference)?;
        let (rig, points, chart) = (&self.rig, &conditions.points, chart.map(|chart| &chart.chart));
        let options = Options { chart, maps, modes, threads: number_of_threads(threads) };
        let found = interruptible(py, |stopped| many::predict(rig, points, options, stopped))?;
        Predictions::new(py, &rig.name, conditions, found.map_err(errors::analysis)?, faults_raise)
    }

    /// The smallest friction coefficient at which the rig becomes unstable; NaN if it does not.
    ///
    /// Parameters
    /// ----------
    /// load_n, speed_rad_s : float or array
    ///     Normal load, N; disc speed, rad/s; broadcast against each other. By default those of the reference.
    /// mu_max : float, optional
    ///     Search from 0 to this friction coefficient; by default that of the rig.
    ///
    /// Returns an array of their shape, a number for numbers. Raises `ConditionError`, `PredictionError`.
    ///
    /// >>> rig = squealcast.Rig.load("nine-dof-case-2")
    /// >>> rig.critical() == rig.windows().critical_friction
    /// True
    #[pyo3(signature = (*, load_n = None, speed_rad_s = None, mu_max = None))]
    fn critical(
        &self,
        py: Python<'_>,
        load_n: Option<&Bound<'_, PyAny>>,
        speed_rad_s: Option<&Bound<'_, PyAny>>,
        mu_max: Option<f64>,
    ) -> PyResult<Py<PyAny>> {
        let conditions = Conditions::broadcast(py, [load_n, speed_rad_s, None], &self.rig.reference)?;
        let mu_max = mu_max.unwrap_or(self.rig.mu_max);
        let (rig, points) = (&self.rig, &conditions.points);
        let found = interruptible(py, |stopped| many::critical_friction(rig, points, mu_max, stopped))?;
        let found = found.map_err(errors::analysis)?;
        arrays::array(py, found.into_iter().map(|mu| mu.unwrap_or(f64::NAN)).collect(), &conditions.shape)
    }

    /// Finds every window of instability in the friction coefficient, its ends to within 1e-10.
    ///
    /// Parameters
    /// ----------
    /// load_n, speed_rad_s : float, optional
    ///     Normal load, N; disc speed, rad/s. By default those of the reference.
    /// mu_max : float, optional
    ///     Search from 0 to this friction coefficient; by default that of the rig.
    ///
    /// Returns `Windows`, a sequence of `Window`. Raises `ConditionError`, `PredictionError`.
    ///
    /// >>> for window in squealcast.Rig.load("nine-dof-case-2").windows():
    /// ...     print(window.kind, window.mode_ids)
    /// coalescence [5, 6]
    /// coalescence [1, 2]
    #[pyo3(signature = (*, load_n = None, speed_rad_s = None, mu_max = None))]
    fn windows(
        &self,
        py: Python<'_>,
        load_n: Option<&Bound<'_, PyAny>>,
        speed_rad_s: Option<&Bound<'_, PyAny>>,
        mu_max: Option<f64>,
    ) -> PyResult<Windows> {
        let point = Conditions::broadcast(py, [load_n, speed_rad_s, None], &self.rig.reference)?.only()?;
        let mu_max = mu_max.unwrap_or(self.rig.mu_max);
        let rig = &self.rig;
        let map = interruptible(py, |_| -> Result<StabilityMap, AnalysisError> {
            check(rig, &point)?;
            let options = MapOptions { mu_max, ..map_options(rig) };
            Ok(StabilityMap::build(&rig.model, &mut Solver::new(rig.model.dimension()), &point, &options)?)
        })?;
        let place = Place { point, temperature_c: rig.temperature_c() };
        let title = format!("{}, {}", rig.name, place.fixed(&[Condition::Friction]));
        Windows::new(py, map.map_err(errors::analysis)?, title, mu_max, rig.band_max_hz)
    }

    /// Sweeps one condition, following modes through crossings and merging points.
    ///
    /// Parameters
    /// ----------
    /// mu, load_n, speed_rad_s, temperature_c : float or array
    ///     Exactly one of them is an array of ascending values; the others are numbers, by default those of the reference.
    ///
    /// Returns `Sweep`. Raises `ConditionError`, `RigError`, `PredictionError`. Ctrl-C ends it.
    ///
    /// >>> rig = squealcast.Rig.load("rough-pad")
    /// >>> rig.sweep(load_n=[100.0, 200.0, 400.0])
    /// <Sweep of rough-pad over load_n: 21 modes in all>
    #[pyo3(signature = (*, mu = None, load_n = None, speed_rad_s = None, temperature_c = None))]
    fn sweep(
        &self,
        py: Python<'_>,
        mu: Option<&Bound<'_, PyAny>>,
        load_n: Option<&Bound<'_, PyAny>>,
        speed_rad_s: Option<&Bound<'_, PyAny>>,
        temperature_c: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Sweep> {
        let given = [
            (Condition::Friction, mu),
            (Condition::Load, load_n),
            (Condition::Speed, speed_rad_s),
            (Condition::Temperature, temperature_c),
        ];
        let mut place = Place { point: self.rig.reference, temperature_c: self.rig.temperature_c() };
        let mut swept = vec![];
        for (condition, values) in given.into_iter().filter_map(|(condition, values)| Some((condition, values?))) {
            if arrays::is_array(values) {
                swept.push((condition, arrays::vector(name(condition), values)?));
            } else {
                place = condition.set(place, values.extract().map_err(|_| not_a_number(condition, values))?);
            }
        }
        let [(condition, values)] = swept.as_slice() else {
            return Err(ConditionError::new_err(format!(
                "{} arrays, expected one of mu, load_n, speed_rad_s and temperature_c",
                swept.len()
            )));
        };
        let ascending = values.windows(2).all(|pair| pair[0] < pair[1]);
        let (Some(&first), Some(&last), true) = (values.first(), values.last(), ascending) else {
            return Err(ConditionError::new_err(format!(
                "{}: expected ascending values, at least one",
                name(*condition)
            )));
        };
        if !(first.is_finite() && last.is_finite()) {
            return Err(ConditionError::new_err(format!("{}: expected finite values", name(*condition))));
        }
        let rig = &self.rig;
        // Friction coefficients may be swept beyond the limits of inputs.
        let checked = match condition {
            Condition::Friction => [rig.reference.friction_coefficient; 2],
            Condition::Load | Condition::Speed | Condition::Temperature => [first, last],
        };
        for value in checked {
            condition.set(place, value).check(rig).map_err(errors::analysis)?;
        }
        let found = interruptible(py, |stopped| sweep(rig, &place, *condition, values, true, stopped))?;
        Ok(Sweep::new(rig.clone(), place, *condition, found.map_err(errors::analysis)?))
    }

    /// Builds the chart of the rig: its roots over a box of conditions, for predictions in microseconds.
    ///
    /// Parameters
    /// ----------
    /// mu, load_n, speed_rad_s : (low, high), optional
    ///     The box; by default that of the rig file, `[search]` and `[chart]`.
    /// keep : bool
    ///     Whether the chart of the rig file's box is taken from, and stored in, the cache of the program: next to the
    ///     rig file, or in `~/.cache/squealcast`. An interrupted build is continued from there.
    /// threads : int, optional
    ///     By default as many as processors. The chart does not depend on it.
    ///
    /// Returns `Chart`. Raises `ChartError`. Ctrl-C ends it.
    ///
    /// >>> squealcast.Rig.load("nine-dof-case-2").chart(mu=(0.0, 1.0)).dense_share
    /// 0.0
    #[pyo3(signature = (*, mu = None, load_n = None, speed_rad_s = None, keep = true, threads = None))]
    fn chart(
        &self,
        py: Python<'_>,
        mu: Option<(f64, f64)>,
        load_n: Option<(f64, f64)>,
        speed_rad_s: Option<(f64, f64)>,
        keep: bool,
        threads: Option<usize>,
    ) -> PyResult<Chart> {
        Chart::of(py, &self.rig, &Ranges { mu, load_n, speed_rad_s }, keep, threads)
    }

    /// The matrices of the equation of motion, `M = I`: stiffness `K(p)`, 1/s², and damping `C(p)`, 1/s, shape `(n, n)`.
    ///
    /// Raises `ConditionError`, `PredictionError`.
    ///
    /// >>> stiffness, damping = squealcast.Rig.load("nine-dof-case-2").matrices(mu=0.5)
    /// >>> stiffness.shape, bool(numpy.allclose(stiffness, stiffness.T)), bool(damping.any())
    /// ((9, 9), False, False)
    #[pyo3(signature = (*, load_n = None, speed_rad_s = None, mu = None))]
    fn matrices(
        &self,
        py: Python<'_>,
        load_n: Option<&Bound<'_, PyAny>>,
        speed_rad_s: Option<&Bound<'_, PyAny>>,
        mu: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<(Py<PyAny>, Py<PyAny>)> {
        let point = Conditions::broadcast(py, [load_n, speed_rad_s, mu], &self.rig.reference)?.only()?;
        check(&self.rig, &point).map_err(errors::analysis)?;
        let n = self.rig.model.dimension();
        let (mut stiffness, mut damping) = (Mat::zeros(n, n), Mat::zeros(n, n));
        let assembled = self.rig.model.assemble(&point, &mut stiffness, &mut damping);
        assembled.map_err(|error| errors::analysis(AnalysisError::Solve(error.into())))?;
        let rows = |matrix: &Mat<f64>| {
            let entries = (0..n).flat_map(|i| (0..n).map(move |j| matrix[(i, j)])).collect();
            arrays::array(py, entries, &[n, n])
        };
        Ok((rows(&stiffness)?, rows(&damping)?))
    }

    /// A description of the rig, in a few lines of text, as `squealcast check` prints it.
    fn describe(&self) -> String {
        self.rig.describe()
    }

    fn __repr__(&self) -> String {
        let at = self.rig.temperature_c().map_or_else(String::new, |celsius| format!(" at {celsius} °C"));
        match &self.rig.path {
            Some(path) => format!("Rig('{}'{at})", path.display()),
            None => format!("Rig('{}'{at})", self.rig.name),
        }
    }

    fn _repr_html_(&self) -> String {
        let rows = self.rig.describe();
        html::facts(
            rows.lines().map(|line| line.split_once(' ').map_or((line, ""), |(name, value)| (name, value.trim()))),
        )
    }
}

/// The exception of an argument of a sweep that is neither a number nor an array.
fn not_a_number(condition: Condition, value: &Bound<'_, PyAny>) -> PyErr {
    ConditionError::new_err(format!("{} is {value}, expected a number or an array", name(condition)))
}
