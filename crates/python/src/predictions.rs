//! The result of `Rig.predict`.

use std::f64::consts::TAU;

use numpy::{Complex64, PyArrayDyn, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use squealcast::analysis::many::{self, Route};
use squealcast::physics::{Root, RootError};

use crate::arrays::{Conditions, array};
use crate::errors::PredictionError;

/// Predictions for conditions of shape `S`: what `Rig.predict` returns.
///
/// Arrays with one value per condition have shape `S`; arrays of modes have shape `S + (modes,)`, where a row holds
/// the modes of the band in ascending frequency, filled up with identity -1 and NaN. For a single condition, values
/// are numbers and `S` is empty.
///
/// | attribute | unit | meaning |
/// |---|---|---|
/// | `load_n`, `speed_rad_s`, `mu` | N, rad/s, 1 | the conditions, shape `S` |
/// | `eigenvalue_per_s` | 1/s | `λ = σ + iω` |
/// | `growth_rate_per_s` | 1/s | `σ`; a mode grows if it is positive |
/// | `frequency_hz` | Hz | `ω / 2π` |
/// | `damping_ratio` | 1 | `-σ / \|λ\|` |
/// | `mode_id` | | the number a mode keeps as conditions change; -1 where there is no mode |
/// | `pad_participation` | 1 | the pad's share in the mode, 0 to 1; NaN if unknown |
/// | `residual` | 1 | `\|(λ² I + λ C + K) x\|`, scaled; of a charted mode, a bound of it |
/// | `frequency_error_hz`, `growth_rate_error_per_s` | Hz, 1/s | bounds of the errors |
/// | `unstable_modes` | | number of unstable modes, shape `S` |
/// | `max_growth_rate_per_s` | 1/s | of the fastest growing root, shape `S` |
/// | `worst_frequency_hz` | Hz | of the fastest growing root, if it is unstable, shape `S` |
/// | `critical_friction` | 1 | the end of a window of instability nearest to `mu`, shape `S` |
/// | `friction_margin`, `friction_margin_error` | 1 | distance to it, negative inside a window, and a bound of its error |
/// | `level` | | `squealcast.Level` of each condition, as a session without hysteresis gives it |
/// | `route` | | `squealcast.Route`: solved, charted, or a fault |
/// | `faults` | | why a condition has no prediction, by its flat index |
///
/// Examples
/// --------
/// >>> rig = squealcast.Rig.load("nine-dof-case-2")
/// >>> found = rig.predict(mu=[0.2, 0.6])
/// >>> found.frequency_hz.shape
/// (2, 9)
/// >>> found.unstable_modes
/// array([0, 1], dtype=uint32)
#[pyclass(frozen, module = "squealcast")]
pub struct Predictions {
    /// Normal loads, N, shape `S`.
    #[pyo3(get)]
    load_n: Py<PyAny>,
    /// Disc speeds, rad/s, shape `S`.
    #[pyo3(get)]
    speed_rad_s: Py<PyAny>,
    /// Friction coefficients, shape `S`.
    #[pyo3(get)]
    mu: Py<PyAny>,
    /// Eigenvalues `λ = σ + iω`, 1/s, shape `S + (modes,)`.
    #[pyo3(get)]
    eigenvalue_per_s: Py<PyAny>,
    /// Identities, -1 where there is no mode, shape `S + (modes,)`.
    #[pyo3(get)]
    mode_id: Py<PyAny>,
    /// The pad's shares, 0 to 1, NaN if unknown, shape `S + (modes,)`.
    #[pyo3(get)]
    pad_participation: Py<PyAny>,
    /// Scaled residuals; of charted modes, bounds of them; shape `S + (modes,)`.
    #[pyo3(get)]
    residual: Py<PyAny>,
    /// Bounds of the errors of `frequency_hz`, Hz, shape `S + (modes,)`.
    #[pyo3(get)]
    frequency_error_hz: Py<PyAny>,
    /// Bounds of the errors of `growth_rate_per_s`, 1/s, shape `S + (modes,)`.
    #[pyo3(get)]
    growth_rate_error_per_s: Py<PyAny>,
    /// Numbers of unstable modes, shape `S`.
    #[pyo3(get)]
    unstable_modes: Py<PyAny>,
    /// Growth rates of the fastest growing roots, 1/s, shape `S`.
    #[pyo3(get)]
    max_growth_rate_per_s: Py<PyAny>,
    /// Frequencies of the fastest growing roots that are unstable, Hz, else NaN, shape `S`.
    #[pyo3(get)]
    worst_frequency_hz: Py<PyAny>,
    /// Ends of windows of instability nearest to `mu`, NaN if unknown or none, shape `S`.
    #[pyo3(get)]
    critical_friction: Py<PyAny>,
    /// Distances to `critical_friction`, negative inside a window, shape `S`.
    #[pyo3(get)]
    friction_margin: Py<PyAny>,
    /// Bounds of the errors of `friction_margin`, shape `S`.
    #[pyo3(get)]
    friction_margin_error: Py<PyAny>,
    /// Levels: values of `squealcast.Level`, shape `S`.
    #[pyo3(get)]
    level: Py<PyAny>,
    /// Routes: values of `squealcast.Route`, shape `S`.
    #[pyo3(get)]
    route: Py<PyAny>,
    /// Why conditions have no prediction, by flat index.
    #[pyo3(get)]
    faults: Py<PyAny>,
    rig: String,
    shape: Vec<usize>,
}

impl Predictions {
    /// The predictions for `conditions` as arrays.
    ///
    /// # Errors
    /// `PredictionError` for the first fault, unless faults are to be marked.
    pub fn new(
        py: Python<'_>,
        rig: &str,
        conditions: Conditions,
        found: many::Predictions,
        faults_raise: bool,
    ) -> PyResult<Self> {
        if let Some((index, reason)) = found.faults.first().filter(|_| faults_raise) {
            return Err(PredictionError::new_err(format!("{rig}{}: {reason}", conditions.place(*index))));
        }
        let Conditions { points, shape } = conditions;
        let column =
            |of: fn(&squealcast::physics::OperatingPoint) -> f64| array(py, points.iter().map(of).collect(), &shape);
        let one = |values: Vec<f64>| array(py, values, &shape);
        let many::Predictions { routes, levels, modes, .. } = found;
        let mut wide = shape.clone();
        wide.push(modes.width);
        let errors_hz = modes.error_rad_s.into_iter().map(|error| error / TAU).collect();
        let routes = routes.into_iter().map(|route| match route {
            Route::Solved => 0_u8,
            Route::Charted => 1,
            Route::Fault => 2,
        });
        let faults = PyDict::new(py);
        for (index, reason) in &found.faults {
            faults.set_item(index, reason)?;
        }
        Ok(Self {
            load_n: column(|point| point.normal_load_n)?,
            speed_rad_s: column(|point| point.disc_speed_rad_s)?,
            mu: column(|point| point.friction_coefficient)?,
            eigenvalue_per_s: array::<Complex64>(py, modes.eigenvalue_per_s, &wide)?,
            mode_id: array(py, modes.id, &wide)?,
            pad_participation: array(py, modes.pad_participation, &wide)?,
            residual: array(py, modes.residual, &wide)?,
            frequency_error_hz: array(py, errors_hz, &wide)?,
            growth_rate_error_per_s: array(py, modes.error_per_s, &wide)?,
            unstable_modes: array(py, found.unstable_modes, &shape)?,
            max_growth_rate_per_s: one(found.max_growth_rate_per_s)?,
            worst_frequency_hz: one(found.worst_frequency_hz)?,
            critical_friction: one(found.critical_friction)?,
            friction_margin: one(found.friction_margin)?,
            friction_margin_error: one(found.friction_margin_error)?,
            level: array(py, levels, &shape)?,
            route: array(py, routes.collect(), &shape)?,
            faults: faults.into_any().unbind(),
            rig: rig.to_owned(),
            shape,
        })
    }
}

#[pymethods]
impl Predictions {
    /// Growth rates `σ`, 1/s, shape `S + (modes,)`: a view of `eigenvalue_per_s`.
    #[getter]
    fn growth_rate_per_s<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.eigenvalue_per_s.bind(py).getattr("real")
    }

    /// Frequencies `ω / 2π`, Hz, shape `S + (modes,)`.
    #[getter]
    fn frequency_hz<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.eigenvalue_per_s.bind(py).getattr("imag")?.div(TAU)
    }

    /// Damping ratios `-σ / |λ|`, shape `S + (modes,)`.
    #[getter]
    fn damping_ratio(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let eigenvalues = self.eigenvalue_per_s.bind(py).cast::<PyArrayDyn<Complex64>>()?.readonly();
        let eigenvalues = eigenvalues.as_array();
        let ratio = |&lambda: &Complex64| {
            let (square, residual, pad_participation) = (lambda * lambda, f64::NAN, f64::NAN);
            Root { lambda, square, residual, pad_participation, error: RootError::UNKNOWN }.damping_ratio()
        };
        array(py, eigenvalues.iter().map(ratio).collect(), eigenvalues.shape())
    }

    /// Shape `S` of the conditions.
    #[getter]
    fn shape<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, pyo3::types::PyTuple>> {
        pyo3::types::PyTuple::new(py, &self.shape)
    }

    /// One row for each mode of each condition, as a `pandas.DataFrame`.
    ///
    /// Raises `ImportError` where pandas is not installed.
    ///
    fn to_pandas(slf: Bound<'_, Self>) -> PyResult<Bound<'_, PyAny>> {
        slf.py().import("squealcast._frames")?.call_method1("of_predictions", (slf,))
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        let count: usize = self.shape.iter().product();
        let unstable: usize = py.import("numpy")?.call_method1("count_nonzero", (&self.unstable_modes,))?.extract()?;
        Ok(format!("<Predictions of {}: {count} conditions, {unstable} of them unstable>", self.rig))
    }

    fn __len__(&self) -> PyResult<usize> {
        self.shape
            .first()
            .copied()
            .ok_or_else(|| pyo3::exceptions::PyTypeError::new_err("a single prediction has no length"))
    }
}
