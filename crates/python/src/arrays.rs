//! Conditions from numpy arrays, and results into numpy arrays.

use numpy::{Element, PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use squealcast::physics::OperatingPoint;

use crate::errors::ConditionError;

/// Operating points of one shape.
pub struct Conditions {
    pub points: Vec<OperatingPoint>,
    pub shape: Vec<usize>,
}

impl Conditions {
    /// Load, speed and friction coefficient broadcast against one another; those not given are those of `reference`.
    ///
    /// # Errors
    /// `ConditionError` for values that are no numbers, or shapes that do not go together.
    pub fn broadcast(
        py: Python<'_>,
        given: [Option<&Bound<'_, PyAny>>; 3],
        reference: &OperatingPoint,
    ) -> PyResult<Self> {
        let OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient } = *reference;
        let names = ["load_n", "speed_rad_s", "mu"];
        let mut arrays = vec![];
        for ((name, given), default) in
            names.into_iter().zip(given).zip([normal_load_n, disc_speed_rad_s, friction_coefficient])
        {
            arrays.push(match given {
                Some(values) => floats(name, values)?,
                None => floats(name, default.into_pyobject(py)?.as_any())?,
            });
        }
        let together = py.import("numpy")?.call_method1("broadcast_arrays", PyTuple::new(py, arrays)?);
        let together = together.map_err(|error| ConditionError::new_err(error.value(py).to_string()))?;
        let shape = together.get_item(0)?.getattr("shape")?.extract()?;
        let [loads, speeds, frictions] = [0, 1, 2].map(|k| together.get_item(k).and_then(|array| values(&array)));
        let points = loads?.into_iter().zip(speeds?).zip(frictions?);
        let point = |((normal_load_n, disc_speed_rad_s), friction_coefficient)| OperatingPoint {
            normal_load_n,
            disc_speed_rad_s,
            friction_coefficient,
        };
        Ok(Self { points: points.map(point).collect(), shape })
    }

    /// The only operating point, for calls that take one.
    ///
    /// # Errors
    /// `ConditionError` for arrays.
    pub fn only(self) -> PyResult<OperatingPoint> {
        match (self.shape.is_empty(), self.points.as_slice()) {
            (true, [point]) => Ok(*point),
            _ => {
                Err(ConditionError::new_err(format!("conditions of shape {:?}, expected one number each", self.shape)))
            }
        }
    }

    /// Where condition `index` is in the arrays, as Python writes it; empty for a single one.
    pub fn place(&self, mut index: usize) -> String {
        let mut at: Vec<String> = vec![];
        for &length in self.shape.iter().rev() {
            at.insert(0, (index % length).to_string());
            index /= length;
        }
        if at.is_empty() { String::new() } else { format!(", condition [{}]", at.join(", ")) }
    }
}

/// `values` as an array of 64-bit numbers.
fn floats<'py>(name: &str, values: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let py = values.py();
    let options = PyDict::new(py);
    options.set_item("dtype", "float64")?;
    let array = py.import("numpy")?.call_method("asarray", (values,), Some(&options));
    array.map_err(|error| ConditionError::new_err(format!("{name}: {}, expected numbers", error.value(py))))
}

/// The values of an array in C order.
fn values(array: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    let flat = array.call_method0("ravel")?;
    Ok(flat.cast_into::<PyArray1<f64>>()?.readonly().as_array().to_vec())
}

/// The values of a one-dimensional argument.
///
/// # Errors
/// `ConditionError` for other shapes and for values that are no numbers.
pub fn vector(name: &str, given: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    let array = floats(name, given)?;
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    match shape.as_slice() {
        [_] => values(&array),
        _ => Err(ConditionError::new_err(format!("{name} has shape {shape:?}, expected one dimension"))),
    }
}

/// Whether an argument is an array or sequence, not a single number.
pub fn is_array(given: &Bound<'_, PyAny>) -> bool {
    given.len().is_ok() || given.getattr("shape").and_then(|shape| shape.len()).is_ok_and(|count| count > 0)
}

/// `values` as an array of `shape`, without a copy; of a single condition, a number.
pub fn array<T: Element>(py: Python<'_>, values: Vec<T>, shape: &[usize]) -> PyResult<Py<PyAny>> {
    let flat = PyArray1::from_vec(py, values).into_any();
    let shaped = flat.call_method1("reshape", (PyTuple::new(py, shape)?,))?;
    if shape.is_empty() {
        return Ok(shaped.call_method0("item")?.unbind());
    }
    Ok(shaped.unbind())
}
