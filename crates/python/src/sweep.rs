//! Sweeps over one condition.

use pyo3::prelude::*;
use squealcast::analysis::condition::{Condition, Place};
use squealcast::analysis::sweep::{self as library, Swept};
use squealcast::figures::plot;
use squealcast::rig::Rig;
use std::sync::Arc;

use crate::arrays::array;
use crate::errors;

/// The modes of a rig at every value of one condition, followed through crossings and merging points: what `Rig.sweep`
/// returns. In Jupyter, the figure of `squealcast sweep --svg`.
///
/// The arrays have one entry for each mode at each value, those of one value together and in ascending frequency, as in
/// the file of `squealcast sweep --csv`: `load_n`, `speed_rad_s`, `mu`, `temperature_c` (NaN without), `mode_id`,
/// `frequency_hz`, `growth_rate_per_s`, `damping_ratio`. Besides: `condition` ("mu", "load_n", "speed_rad_s" or
/// "temperature_c"), `windows` (pairs of values between which a mode is unstable; the second is `None` where that is
/// beyond the sweep) and `missing` (values without a prediction, and why).
///
/// >>> sweep = squealcast.Rig.load("nine-dof-case-2").sweep(mu=numpy.arange(11) * 0.1)
/// >>> sweep.frequency_hz.shape
/// (99,)
#[pyclass(frozen, module = "squealcast")]
pub struct Sweep {
    rig: Arc<Rig>,
    place: Place,
    over: Condition,
    sweep: library::Sweep,
}

/// The name of a condition as an argument.
pub fn name(condition: Condition) -> &'static str {
    match condition {
        Condition::Friction => "mu",
        Condition::Load => "load_n",
        Condition::Speed => "speed_rad_s",
        Condition::Temperature => "temperature_c",
    }
}

impl Sweep {
    pub fn new(rig: Arc<Rig>, place: Place, over: Condition, sweep: library::Sweep) -> Self {
        Self { rig, place, over, sweep }
    }

    fn column<T: numpy::Element>(&self, py: Python<'_>, of: impl Fn(&Swept) -> T) -> PyResult<Py<PyAny>> {
        let values: Vec<T> = self.sweep.modes.iter().map(of).collect();
        let shape = [values.len()];
        array(py, values, &shape)
    }
}

#[pymethods]
impl Sweep {
    /// Name of the condition that is swept.
    #[getter]
    fn condition(&self) -> &'static str {
        name(self.over)
    }

    /// Normal loads, N.
    #[getter]
    fn load_n(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.column(py, |swept| Condition::Load.of(&swept.place))
    }

    /// Disc speeds, rad/s.
    #[getter]
    fn speed_rad_s(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.column(py, |swept| Condition::Speed.of(&swept.place))
    }

    /// Friction coefficients.
    #[getter]
    fn mu(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.column(py, |swept| Condition::Friction.of(&swept.place))
    }

    /// Temperatures, °C; NaN for a rig without `[temperature]`.
    #[getter]
    fn temperature_c(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.column(py, |swept| Condition::Temperature.of(&swept.place))
    }

    /// Identities of the modes.
    #[getter]
    fn mode_id(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.column(py, |swept| swept.mode.id)
    }

    /// Frequencies, Hz.
    #[getter]
    fn frequency_hz(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.column(py, |swept| swept.mode.root.frequency_hz())
    }

    /// Growth rates, 1/s.
    #[getter]
    fn growth_rate_per_s(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.column(py, |swept| swept.mode.root.growth_rate_per_s())
    }

    /// Damping ratios.
    #[getter]
    fn damping_ratio(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        self.column(py, |swept| swept.mode.root.damping_ratio())
    }

    /// Pairs of values of the condition between which a mode is unstable.
    #[getter]
    fn windows(&self) -> Vec<(f64, Option<f64>)> {
        self.sweep.windows.clone()
    }

    /// Values of the condition without a prediction, and why.
    #[getter]
    fn missing(&self) -> Vec<(f64, String)> {
        self.sweep.missing.iter().map(|(value, error)| (*value, error.to_string())).collect()
    }

    /// The text that `squealcast sweep --csv` writes.
    fn to_csv(&self) -> PyResult<String> {
        self.sweep.to_csv(&self.rig).map_err(errors::figure)
    }

    /// One row for each mode at each value, as a `pandas.DataFrame`.
    ///
    /// Raises `ImportError` where pandas is not installed.
    fn to_pandas(slf: Bound<'_, Self>) -> PyResult<Bound<'_, PyAny>> {
        slf.py().import("squealcast._frames")?.call_method1("of_sweep", (slf,))
    }

    /// Frequencies and growth rates over the condition, as SVG text.
    fn svg(&self) -> PyResult<String> {
        let title = format!("{}, {}", self.rig.name, self.place.fixed(&[self.over]));
        let points = plot::swept(&self.sweep, self.over);
        plot::sweep(&title, self.over.label(), &points, &self.sweep.windows).map_err(errors::figure)
    }

    fn _repr_svg_(&self) -> PyResult<String> {
        self.svg()
    }

    fn __repr__(&self) -> String {
        format!("<Sweep of {} over {}: {} modes in all>", self.rig.name, name(self.over), self.sweep.modes.len())
    }
}
