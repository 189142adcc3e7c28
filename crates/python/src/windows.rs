//! Windows of instability.

use pyo3::prelude::*;
use pyo3::types::PyList;
use squealcast::display::curves::Curves;
use squealcast::figures::plot;
use squealcast::physics::StabilityMap;

use crate::errors;

/// An interval of the friction coefficient in which a mode or a pair of modes is unstable.
///
/// Attributes: `mode_ids` (identities of its modes), `mu_from`, `mu_to` (`None` if it is still open at the end of the
/// search), `frequency_hz` (at its beginning; 0 for a static divergence), `kind` ("coalescence", "zero_growth" or
/// "divergence"), `at_jump` (whether it begins or ends where a contact pair opens or closes and the roots jump).
///
/// >>> squealcast.Rig.load("nine-dof-case-2").windows()[0].kind
/// 'coalescence'
#[pyclass(frozen, get_all, module = "squealcast")]
pub struct Window {
    /// Identities of its modes.
    mode_ids: Vec<u32>,
    /// Friction coefficient at which it begins.
    mu_from: f64,
    /// Friction coefficient at which it ends; `None` if it is open at the end of the search.
    mu_to: Option<f64>,
    /// Frequency at its beginning, Hz; 0 for a static divergence.
    frequency_hz: f64,
    /// "coalescence", "zero_growth" or "divergence".
    kind: &'static str,
    /// Whether it begins or ends where a contact pair opens or closes and the roots jump.
    at_jump: bool,
}

#[pymethods]
impl Window {
    fn __repr__(&self) -> String {
        let to = self.mu_to.map_or_else(|| "the end of the search".to_owned(), |to| to.to_string());
        format!(
            "<Window from {} to {to}: {}, modes {:?}, {} Hz>",
            self.mu_from, self.kind, self.mode_ids, self.frequency_hz
        )
    }
}

/// The windows of instability at one load and speed, ascending in `mu_from`: what `Rig.windows` returns. A sequence of
/// `Window`; in Jupyter, the figure of `squealcast critical --svg`.
///
/// >>> windows = squealcast.Rig.load("nine-dof-case-2").windows()
/// >>> len(windows), windows.critical_friction == windows[0].mu_from
/// (2, True)
#[pyclass(frozen, sequence, module = "squealcast")]
pub struct Windows {
    map: StabilityMap,
    title: String,
    mu_max: f64,
    band_max_hz: Option<f64>,
    windows: Py<PyList>,
}

impl Windows {
    /// The windows of `map`.
    pub fn new(
        py: Python<'_>,
        map: StabilityMap,
        title: String,
        mu_max: f64,
        band_max_hz: Option<f64>,
    ) -> PyResult<Self> {
        let windows = PyList::empty(py);
        for (window, (from, to)) in map.windows.iter().zip(&map.ends.windows) {
            windows.append(Window {
                mode_ids: window.mode_ids.clone(),
                mu_from: window.mu_from,
                mu_to: window.mu_to,
                frequency_hz: window.frequency_hz,
                kind: window.kind.name(),
                at_jump: from.is_jump() || to.is_some_and(|to| to.is_jump()),
            })?;
        }
        Ok(Self { map, title, mu_max, band_max_hz, windows: windows.unbind() })
    }
}

#[pymethods]
impl Windows {
    /// The smallest friction coefficient at which a window begins; `None` if there is none.
    #[getter]
    fn critical_friction(&self) -> Option<f64> {
        self.map.critical_friction()
    }

    /// Windows narrower than this in friction coefficient may have been missed.
    #[getter]
    fn narrowest_window(&self) -> f64 {
        self.map.resolution
    }

    /// Whether the search was refined everywhere as far as necessary.
    #[getter]
    fn complete(&self) -> bool {
        self.map.complete
    }

    /// Where steady sliding ends inside the range, and why; else `None`.
    #[getter]
    fn sliding_end(&self) -> Option<(f64, String)> {
        self.map.sliding_ends.as_ref().map(|end| (end.mu, end.reason.to_string()))
    }

    fn __len__(&self, py: Python<'_>) -> usize {
        self.windows.bind(py).len()
    }

    fn __getitem__<'py>(&self, py: Python<'py>, index: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        self.windows.bind(py).as_any().get_item(index)
    }

    fn __iter__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, pyo3::types::PyIterator>> {
        self.windows.bind(py).try_iter()
    }

    fn __repr__(&self, py: Python<'_>) -> PyResult<String> {
        Ok(format!("<Windows of {}: {}>", self.title, self.windows.bind(py).repr()?))
    }

    /// Frequencies and growth rates over the friction coefficient, with shaded windows, as SVG text.
    fn svg(&self) -> PyResult<String> {
        let curves = Curves::new(&self.map, self.band_max_hz);
        plot::map(&self.title, &curves, self.mu_max, self.map.critical_friction()).map_err(errors::figure)
    }

    fn _repr_svg_(&self) -> PyResult<String> {
        self.svg()
    }
}
