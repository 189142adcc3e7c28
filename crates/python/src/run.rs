//! Long calls: without the GIL, and ended by Ctrl-C.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use pyo3::exceptions::PySystemError;
use pyo3::prelude::*;

/// Interval between looks for a signal.
pub const LOOK_EVERY: Duration = Duration::from_millis(50);

/// The result of `task`, which runs on a thread of its own while other Python threads go on. A signal whose handler
/// raises, as that of Ctrl-C does, sets its flag; the call then ends with that exception once `task` has returned.
///
/// # Errors
/// The exception of a signal handler; `SystemError` if `task` panics, which the panic hook reports.
pub fn interruptible<T: Send>(py: Python<'_>, task: impl FnOnce(&Arc<AtomicBool>) -> T + Send) -> PyResult<T> {
    let stopped = Arc::<AtomicBool>::default();
    std::thread::scope(|scope| {
        let (caller, flag) = (std::thread::current(), &stopped);
        let worker = scope.spawn(move || {
            let result = task(flag);
            caller.unpark();
            result
        });
        let mut interrupted = Ok(());
        while !worker.is_finished() && interrupted.is_ok() {
            py.detach(|| std::thread::park_timeout(LOOK_EVERY));
            interrupted = py.check_signals();
        }
        stopped.store(interrupted.is_err(), Ordering::Relaxed);
        let result = py.detach(|| worker.join());
        interrupted?;
        result.map_err(|_| PySystemError::new_err("internal error in squealcast"))
    })
}

/// The number of threads asked for, by default that of the processors.
pub fn threads(asked: Option<usize>) -> usize {
    let processors = || std::thread::available_parallelism().map_or(1, usize::from);
    asked.unwrap_or_else(processors).max(1)
}
