//! What `run`, `demo` and `replay` show: a live table on a terminal, log lines when piped.

mod view;

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
use crate::notes::Hold;
use view::View;

/// Time between two looks.
const EVERY: Duration = Duration::from_millis(100);
/// Time between log lines while the status stays.
const LOG_EVERY: Duration = Duration::from_secs(5);
/// Rows that Page Up and Page Down scroll by.
const PAGE_ROWS: isize = 10;

/// What of the view is not in its [`Watch`].
pub struct Frame {
    /// Name of what is shown, and whether it is simulated; then where the page is. What does not fit is left out.
    pub title: Vec<String>,
    /// A mode whose damping ratio is below the negative of this grows.
    pub instability_threshold: f64,
    /// What is listened to; `None` where nothing is waited for.
    pub inputs: Option<InputSources>,
    /// The last line.
    pub foot: Box<dyn Fn(&Snapshot) -> Vec<String> + Send>,
    /// A key asks for the end.
    pub quit: Box<dyn Fn() + Send>,
}

/// A view that runs beside the node.
pub struct Shown {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl Shown {
    /// Ends the view and gives the terminal back.
    pub fn stop(self) {
        self.stop.store(true, Ordering::Relaxed);
        // Writing to a terminal or a pipe that nobody reads does not end: it is not waited for longer than this.
        let deadline = Instant::now() + 3 * EVERY;
        while !self.thread.is_finished() && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// Shows what `watch` sees until stopped; the keys q, Esc and Ctrl-C quit, arrows and page keys scroll. Where the terminal
/// refuses, log lines.
pub fn show(around: Frame, watch: Watch, plain: bool) -> Shown {
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = stop.clone();
    let terminal = if plain || !std::io::stdout().is_terminal() { None } else { ratatui::try_init().ok() };
    let thread = std::thread::spawn(move || {
        let Some(mut terminal) = terminal else { return log(&around, &watch, &stopped) };
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
                // The terminal is gone or no terminal: the node is not.
                Ok(Asked::Nothing | Asked::Scroll(_)) | Err(_) => break true,
            }
        };
        ratatui::restore();
        drop(hold);
        if goes_on {
            log(&around, &watch, &stopped);
        }
    });
    Shown { stop, thread }
}

/// What a key asks for.
enum Asked {
    Nothing,
    Quit,
    /// Down by so many rows.
    Scroll(isize),
}

/// Waits for a key for one look's time.
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

/// A line whenever the status changes, and now and then.
fn log(around: &Frame, watch: &Watch, stopped: &AtomicBool) {
    let mut last: Option<(Status, Instant)> = None;
    let mut stopping = false;
    let mut problem = None;
    // A last look after the end: a short session says something too.
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
            // It is said once, unless something else came between.
            Status::Waiting | Status::NoData => Duration::MAX,
            Status::Ok | Status::Warn | Status::Squeal | Status::Fault => LOG_EVERY,
        };
        let due = last.is_none_or(|(status, at)| status != said.status || at.elapsed() >= again);
        if due {
            last = Some((said.status, Instant::now()));
            // Nobody reading is no reason to end a node.
            let _ = super::print(&format!("{}\n", line(&said, &snapshot, around.inputs.as_ref())));
        }
    }
}

/// The status in one line: when, under which conditions, what is predicted.
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
    fn a_log_line_has_time_conditions_and_what_is_predicted() {
        let shown = |status| {
            let snapshot = snapshot(status);
            line(&snapshot.assessment(), &snapshot, Some(&InputSources::default()))
        };
        assert_eq!(
            shown(Status::Squeal),
            "2023-11-14T22:13:20.250000Z  SQUEAL   seq 7  mu 0.4312  load 500.00 N  speed 13.000 rad/s  margin -0.05570  \
             mode 15 at 3114.6 Hz grows by 636 1/s, the fastest of 2"
        );
        assert_eq!(shown(Status::Waiting), "WAITING  no input was heard yet  it listens to no bus");
        assert!(
            shown(Status::Fault).ends_with("normal_load_n is -5, expected 0 to 1000000"),
            "{}",
            shown(Status::Fault)
        );
        let stopped = shown(Status::NoData);
        assert!(stopped.contains("NO DATA") && stopped.ends_with("inputs have stopped"), "{stopped}");
    }
}
