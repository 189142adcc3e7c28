//! What a node tells the service manager that started it (systemd, `Type=notify`): that it is ready, its status in a
//! sentence, and that its thread works. Without a service manager nothing is told.

use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{RecvTimeoutError, Sender, bounded};
use sd_notify::NotifyState;

use crate::node::{Snapshot, Watch};

/// Interval at which the status is told if it changed, and at which the watchdog is told at most.
const EVERY: Duration = Duration::from_secs(1);

/// Tells the service manager about a node until it is dropped, and then that the node stops.
pub struct Service {
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Service {
    /// Tells that the node is ready, and from then on what `watch` shows.
    pub fn start(watch: Watch) -> Self {
        if std::env::var_os("NOTIFY_SOCKET").is_none() {
            return Self { stop: None, thread: None };
        }
        let (stop, stopped) = bounded(0);
        // Several times in each period of the watchdog, so that a late thread is no reason to restart the node.
        let watchdog = sd_notify::watchdog_enabled();
        let every = watchdog.map_or(EVERY, |period| EVERY.min(period / 4));
        let thread = std::thread::spawn(move || {
            let mut told = Told::default();
            tell(&[NotifyState::Ready]);
            loop {
                let (status, alive) = told.by(&watch.snapshot());
                if let Some(status) = status {
                    tell(&[NotifyState::Status(&status)]);
                }
                if alive && watchdog.is_some() {
                    tell(&[NotifyState::Watchdog]);
                }
                if stopped.recv_timeout(every) != Err(RecvTimeoutError::Timeout) {
                    return tell(&[NotifyState::Stopping]);
                }
            }
        });
        Self { stop: Some(stop), thread: Some(thread) }
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// What was told last.
#[derive(Default)]
struct Told {
    status: String,
    reports: u64,
}

impl Told {
    /// The status of `snapshot` if it is another one, and whether the node's thread has worked since the last call.
    fn by(&mut self, snapshot: &Snapshot) -> (Option<String>, bool) {
        let alive = snapshot.reports > self.reports;
        self.reports = snapshot.reports;
        let said = snapshot.assessment();
        let mut status = format!("{}: {}", said.status.name(), said.message);
        if let Some(problem) = &snapshot.recording_problem {
            status += &format!("; {problem}");
        }
        let changed = status != self.status;
        self.status.clone_from(&status);
        (changed.then_some(status), alive)
    }
}

/// Runs `reload`, and tells the service manager when it begins and ends.
pub fn reloading(reload: impl FnOnce()) {
    // A service manager that waits for the end of a reload needs the moment of its beginning.
    let began = NotifyState::monotonic_usec_now();
    tell(&[Some(NotifyState::Reloading), began.ok()].into_iter().flatten().collect::<Vec<_>>());
    reload();
    tell(&[NotifyState::Ready]);
}

fn tell(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        note!("warning: the service manager cannot be told: {error}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_told_once_and_the_watchdog_only_of_new_reports() {
        let mut told = Told::default();
        let mut snapshot = Snapshot::default();
        assert_eq!(told.by(&snapshot), (Some("WAITING: no input was received yet".to_owned()), false));
        assert_eq!(told.by(&snapshot), (None, false), "the node's thread has made no report");
        snapshot.reports = 1;
        assert_eq!(told.by(&snapshot), (None, true));
        assert_eq!(told.by(&snapshot), (None, false), "no further report");
        snapshot.recording_problem = Some("not recording: disk full".to_owned());
        let status = "WAITING: no input was received yet; not recording: disk full".to_owned();
        assert_eq!(told.by(&snapshot), (Some(status), false));
    }
}
