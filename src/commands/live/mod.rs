//! The view of `run`, `demo` and `replay`: a live table on a terminal, log lines otherwise.

pub(super) mod view;

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ratatui::crossterm::event::{self, Event, KeyCode, KeyModifiers};

use super::format::significant;
use crate::display::events::iso;
use crate::node::status::{Assessment, InputSources, Status};
use crate::node::{Snapshot, Watch};
use crate::text::notes::Hold;
use view::View;

/// Interval between updates of the table.
const EVERY: Duration = Duration::from_millis(100);
/// Interval between log lines while the status does not change.
const LOG_EVERY: Duration = Duration::from_secs(5);
/// Number of rows that Page Up and Page Down scroll.
const PAGE_ROWS: isize = 10;

/// What is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// A table on a terminal, log lines otherwise.
    Table,
    Lines,
    /// Log lines in JSON.
    Json,
}

/// Returns the items of the last line.
pub type Foot = Box<dyn Fn(&Snapshot) -> Vec<String> + Send>;

/// Contents of the view that are not in its [`Watch`].
pub struct Frame {
    /// Name of the rig or recording, whether it is simulated, and the address of the page. Items that do not fit are
    /// omitted.
    pub title: Vec<String>,
    /// A mode is unstable if its damping ratio is below the negative of this value.
    pub instability_threshold: f64,
    /// Where inputs are expected; `None` if no inputs are awaited.
    pub inputs: Option<InputSources>,
    /// The last line.
    pub foot: Foot,
    /// Called when a key requests the end.
    pub quit: Box<dyn Fn() + Send>,
}

/// A view that runs on its own thread.
pub struct Shown {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl Shown {
    /// Ends the view and restores the terminal.
    pub fn stop(self) {
        self.stop.store(true, Ordering::Relaxed);
        // Writing to a terminal or pipe without a reader may never return, so the waiting time is limited.
        let deadline = Instant::now() + 3 * EVERY;
        while !self.thread.is_finished() && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// Shows what `watch` contains until stopped. The keys q, Esc and Ctrl-C quit; arrow and page keys scroll. Log lines
/// are written if the terminal cannot be used.
pub fn show(around: Frame, watch: Watch, form: Form) -> Shown {
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = stop.clone();
    let is_table = form == Form::Table && std::io::stdout().is_terminal();
    let terminal = if is_table { ratatui::try_init().ok() } else { None };
    let thread = std::thread::spawn(move || {
        let Some(mut terminal) = terminal else { return log(&around, &watch, form, &stopped) };
        let hold = Hold::begin();
        let mut first_row = 0;
        let goes_on = loop {
            if stopped.load(Ordering::Relaxed) {
                break false;
            }
            let snapshot = watch.snapshot();
            let note = snapshot.recording_problem.clone().or_else(Hold::latest);
            let drawn = terminal.draw(|frame| {
                let view = View { around: &around, snapshot: &snapshot, note: note.as_deref(), first_row };
                first_row = view.draw(frame);
            });
            match asked() {
                Ok(Asked::Nothing) if drawn.is_ok() => {}
                Ok(Asked::Scroll(rows)) if drawn.is_ok() => first_row = first_row.saturating_add_signed(rows),
                Ok(Asked::Quit) => {
                    (around.quit)();
                    break false;
                }
                // The terminal is gone or was not one; the node continues.
                Ok(Asked::Nothing | Asked::Scroll(_)) | Err(_) => break true,
            }
        };
        ratatui::restore();
        drop(hold);
        if goes_on {
            log(&around, &watch, form, &stopped);
        }
    });
    Shown { stop, thread }
}

/// The request of a key.
enum Asked {
    Nothing,
    Quit,
    /// Scroll down by this number of rows.
    Scroll(isize),
}

/// Waits for a key for the time between two updates.
fn asked() -> std::io::Result<Asked> {
    if !event::poll(EVERY)? {
        return Ok(Asked::Nothing);
    }
    let Event::Key(key) = event::read()? else { return Ok(Asked::Nothing) };
    let control = key.modifiers.contains(KeyModifiers::CONTROL);
    Ok(match key.code {
        KeyCode::Char('c') if control => Asked::Quit,
        KeyCode::Char('q') | KeyCode::Esc => Asked::Quit,
        KeyCode::Down | KeyCode::Char('j') => Asked::Scroll(1),
        KeyCode::Up | KeyCode::Char('k') => Asked::Scroll(-1),
        KeyCode::PageDown | KeyCode::Char(' ') => Asked::Scroll(PAGE_ROWS),
        KeyCode::PageUp => Asked::Scroll(-PAGE_ROWS),
        KeyCode::Home => Asked::Scroll(isize::MIN),
        KeyCode::End => Asked::Scroll(isize::MAX),
        _ => Asked::Nothing,
    })
}

/// Writes a log line whenever the status changes, and at regular intervals.
fn log(around: &Frame, watch: &Watch, form: Form, stopped: &AtomicBool) {
    let mut last: Option<(Status, Instant)> = None;
    let mut stopping = false;
    let mut problem = None;
    // One more line after the end, so that a short session is logged too.
    while !std::mem::replace(&mut stopping, stopped.load(Ordering::Relaxed)) {
        if !stopping {
            std::thread::sleep(EVERY);
        }
        let snapshot = watch.snapshot();
        if snapshot.recording_problem != problem {
            problem.clone_from(&snapshot.recording_problem);
            note!("{}", problem.as_deref().unwrap_or("recording again"));
        }
        let said = snapshot.assessment();
        let again = match said.status {
            // Logged once, unless the status changes in between.
            Status::Waiting | Status::NoData | Status::Inactive => Duration::MAX,
            Status::Ok | Status::Warn | Status::Squeal | Status::Fault => LOG_EVERY,
        };
        let due = last.is_none_or(|(status, at)| status != said.status || at.elapsed() >= again);
        if due {
            last = Some((said.status, Instant::now()));
            // A closed reader does not end the node.
            let line = match form {
                Form::Json => super::log::status(&said, &snapshot),
                Form::Table | Form::Lines => line(&said, &snapshot, around.inputs.as_ref()),
            };
            let _ = super::print(&format!("{line}\n"));
        }
    }
}

/// The status in one line: time, conditions and prediction.
fn line(said: &Assessment, snapshot: &Snapshot, inputs: Option<&InputSources>) -> String {
    let waits = said.status == Status::Waiting;
    let prediction = snapshot.prediction.as_ref().filter(|_| !waits);
    let mut parts: Vec<String> = vec![];
    parts.extend(prediction.map(|prediction| iso(prediction.header.stamp.as_ns() as f64 * 1e-9)));
    parts.push(format!("{:<7}", said.status.name()));
    parts.extend(prediction.map(|prediction| format!("seq {}", prediction.input_seq)));
    if let Some(input) = snapshot.input.as_ref().filter(|_| !waits) {
        parts.push(format!("mu {:.4}", input.friction_coefficient));
        parts.push(format!("load {} N", significant(input.normal_load_n, 5)));
        parts.push(format!("speed {} rad/s", significant(input.disc_speed_rad_s, 5)));
    }
    if let Some(prediction) = prediction.filter(|_| said.status.is_known()) {
        parts.push(format!("margin {}", significant(prediction.friction_margin, 4)));
    }
    parts.push(said.message.clone());
    if let Some(inputs) = inputs.filter(|_| waits) {
        parts.push(inputs.sentence());
    }
    let next = said.next.as_ref().filter(|_| said.status == Status::Ok);
    parts.extend(next.map(|next| format!("next: {} {}", next.modes(), next.place())));
    parts.join("  ")
}

#[cfg(test)]
mod tests {
    use super::view::tests::snapshot;
    use super::*;

    #[test]
    fn a_log_line_has_time_conditions_and_prediction() {
        let shown = |status| {
            let snapshot = snapshot(status);
            line(&snapshot.assessment(), &snapshot, Some(&InputSources::default()))
        };
        assert_eq!(
            shown(Status::Squeal),
            "2023-11-14T22:13:20.250000Z  SQUEAL   seq 7  mu 0.4312  load 500.00 N  speed 13.000 rad/s  margin -0.05570  \
             mode 15 at 3114.6 Hz grows by 636 1/s, the fastest of 2"
        );
        assert_eq!(shown(Status::Waiting), "WAITING  no input was received yet  it listens to no bus");
        assert!(
            shown(Status::Fault).ends_with("normal_load_n is -5, expected 0 to 1000000"),
            "{}",
            shown(Status::Fault)
        );
        let stopped = shown(Status::NoData);
        assert!(stopped.contains("NO DATA") && stopped.ends_with("inputs have stopped"), "{stopped}");
    }
}
