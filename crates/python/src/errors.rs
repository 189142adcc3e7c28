//! The library's errors as the exceptions of `python/squealcast/_errors.py`, with the same text as the program's.

use pyo3::PyErr;
use pyo3::exceptions::PyKeyboardInterrupt;
use squealcast::analysis::AnalysisError;

pyo3::import_exception!(squealcast._errors, RigError);
pyo3::import_exception!(squealcast._errors, ConditionError);
pyo3::import_exception!(squealcast._errors, PredictionError);
pyo3::import_exception!(squealcast._errors, ChartError);
pyo3::import_exception!(squealcast._errors, FigureError);
pyo3::import_exception!(squealcast._errors, RecordingError);
pyo3::import_exception!(squealcast._errors, LiveError);
pyo3::import_exception!(squealcast._errors, ReductionError);

/// The exception of a rig file that cannot be used.
pub fn rig(error: squealcast::rig::RigError) -> PyErr {
    RigError::new_err(error.to_string())
}

/// The exception of an analysis that failed.
pub fn analysis(error: AnalysisError) -> PyErr {
    let text = error.to_string();
    match error {
        AnalysisError::Conditions { .. } => ConditionError::new_err(text),
        AnalysisError::Rig(_) => RigError::new_err(text),
        AnalysisError::Map(_) | AnalysisError::Solve(_) => PredictionError::new_err(text),
        AnalysisError::Stopped => PyKeyboardInterrupt::new_err(text),
    }
}

/// The exception of a figure that cannot be drawn.
pub fn figure(error: impl std::fmt::Display) -> PyErr {
    FigureError::new_err(error.to_string())
}
