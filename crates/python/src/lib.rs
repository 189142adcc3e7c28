//! The Python package `squealcast`: a thin layer on the library of the same name. Arrays of conditions go in, arrays of
//! predictions come out; what is computed is computed by the library.

mod arrays;
mod chart;
mod errors;
mod live;
mod predictions;
mod recording;
mod reduce;
mod rig;
mod run;
mod sweep;
mod windows;

use pyo3::prelude::*;

/// The compiled part of the package `squealcast`, which its `__init__.py` passes on.
#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<rig::Rig>()?;
    module.add_class::<chart::Chart>()?;
    module.add_class::<predictions::Predictions>()?;
    module.add_class::<live::Live>()?;
    module.add_class::<recording::Recording>()?;
    module.add_class::<sweep::Sweep>()?;
    module.add_class::<windows::Window>()?;
    module.add_class::<windows::Windows>()?;
    module.add_function(wrap_pyfunction!(reduce::reduce, module)?)?;
    module.add_function(wrap_pyfunction!(rig::embedded_rigs, module)?)
}
