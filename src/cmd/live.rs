//! What `run`, `demo` and `replay` show: a live table on a terminal, log lines when piped.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ratatui::crossterm::event::{self, Event, KeyCode, KeyModifiers};
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Modifier, Style, Stylize};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph, Row, Table};

use super::format::significant;
use crate::node::{Snapshot, Watch};
use crate::wire::{Prediction, level};

/// Time between two looks.
const EVERY: Duration = Duration::from_millis(100);
/// Time between log lines while the level stays.
const LOG_EVERY: Duration = Duration::from_secs(5);

/// What of the view is not in its [`Watch`].
pub struct Frame {
    pub title: String,
    /// A mode whose damping ratio is below the negative of this grows.
    pub instability_threshold: f64,
    /// The last line.
    pub foot: Box<dyn Fn(&Snapshot) -> String + Send>,
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

/// Shows what `watch` sees until stopped; the keys q, Esc and Ctrl-C quit. Where the terminal refuses, log lines.
pub fn show(around: Frame, watch: Watch, plain: bool) -> Shown {
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = stop.clone();
    let terminal = if plain || !std::io::stdout().is_terminal() { None } else { ratatui::try_init().ok() };
    let thread = std::thread::spawn(move || {
        let Some(mut terminal) = terminal else { return log(&watch, &stopped) };
        while !stopped.load(Ordering::Relaxed) {
            let snapshot = watch.snapshot();
            let drawn = terminal.draw(|frame| draw(frame, &around, &snapshot)).is_ok();
            match asked_to_stop() {
                Ok(false) if drawn => {}
                Ok(true) => {
                    (around.quit)();
                    break;
                }
                // The terminal is gone or no terminal: the node is not.
                _ => {
                    ratatui::restore();
                    return log(&watch, &stopped);
                }
            }
        }
        ratatui::restore();
    });
    Shown { stop, thread }
}

/// Waits for a key for one look's time.
fn asked_to_stop() -> std::io::Result<bool> {
    if !event::poll(EVERY)? {
        return Ok(false);
    }
    let Event::Key(key) = event::read()? else { return Ok(false) };
    let control_c = key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL);
    Ok(control_c || matches!(key.code, KeyCode::Char('q') | KeyCode::Esc))
}

/// A line whenever the level changes, and now and then.
fn log(watch: &Watch, stopped: &AtomicBool) {
    let mut last: Option<(u8, Instant)> = None;
    let mut stopping = false;
    let mut problem = None;
    // A last look after the end: a short session says something too.
    while !std::mem::replace(&mut stopping, stopped.load(Ordering::Relaxed)) {
        if !stopping {
            std::thread::sleep(EVERY);
        }
        let snapshot = watch.snapshot();
        if snapshot.recording_problem != problem {
            problem = snapshot.recording_problem;
            note!("{}", problem.as_deref().unwrap_or("recording again"));
        }
        let Some(prediction) = snapshot.prediction else { continue };
        let due = last.is_none_or(|(level, at)| level != prediction.level || at.elapsed() >= LOG_EVERY);
        if due {
            last = Some((prediction.level, Instant::now()));
            // Nobody reading is no reason to end a node.
            let _ = super::print(&format!("{}\n", line(&prediction)));
        }
    }
}

/// A prediction in one line.
fn line(prediction: &Prediction) -> String {
    let mut text = format!("seq {:>8}  {:<6}", prediction.input_seq, level::name(prediction.level));
    if prediction.level != level::FAULT {
        text += &format!(
            "  {} unstable  margin {:>9}  growth {:>10} 1/s",
            prediction.unstable_modes,
            significant(prediction.friction_margin, 4),
            significant(prediction.max_growth_rate_per_s, 4),
        );
    }
    if !prediction.reason.is_empty() {
        text += &format!("  {}", prediction.reason);
    }
    text
}

fn colour(level: u8) -> Color {
    match level {
        level::OK => Color::Green,
        level::WARN => Color::Yellow,
        level::SQUEAL => Color::Red,
        _ => Color::Magenta,
    }
}

fn draw(frame: &mut ratatui::Frame<'_>, around: &Frame, snapshot: &Snapshot) {
    let [head, body, foot] =
        Layout::vertical([Constraint::Length(6), Constraint::Min(4), Constraint::Length(1)]).areas(frame.area());
    let title = format!(" squealcast: {} ", around.title);
    frame.render_widget(Paragraph::new(head_lines(snapshot)).block(Block::bordered().title(title)), head);
    frame.render_widget(table(around.instability_threshold, snapshot.prediction.as_ref()), body);
    let foot_line = format!(" q quits   {}", (around.foot)(snapshot));
    frame.render_widget(Paragraph::new(foot_line).dim(), foot);
}

fn head_lines(snapshot: &Snapshot) -> Vec<Line<'static>> {
    let Some(prediction) = &snapshot.prediction else { return vec![Line::from("waiting for the first conditions")] };
    let level_style = Style::new().fg(colour(prediction.level)).add_modifier(Modifier::BOLD | Modifier::REVERSED);
    let first = Line::from(vec![
        Span::styled(format!(" {:^6} ", level::name(prediction.level)), level_style),
        Span::raw(format!("  {}", prediction.reason)),
    ]);
    let conditions = snapshot.input.as_ref().map_or_else(String::new, |input| {
        format!(
            "load {:>9.2} N   speed {:>8.3} rad/s   friction coefficient {:>7.4}",
            input.normal_load_n, input.disc_speed_rad_s, input.friction_coefficient
        )
    });
    let margin = format!(
        "critical {:>8}   margin {:>8}   unstable modes {}",
        significant(prediction.critical_friction, 5),
        significant(prediction.friction_margin, 4),
        prediction.unstable_modes
    );
    vec![first, Line::from(conditions), Line::from(margin)]
}

fn table(instability_threshold: f64, prediction: Option<&Prediction>) -> Table<'static> {
    let modes = prediction.map_or(&[][..], |prediction| &prediction.modes);
    let rows = modes.iter().map(|mode| {
        let grows = mode.damping_ratio < -instability_threshold;
        let row = Row::new([
            format!("{:>4}", mode.id),
            format!("{:>12}", significant(mode.frequency_hz, 7)),
            format!("{:>14}", significant(mode.growth_rate_per_s, 5)),
            format!("{:>14}", significant(mode.damping_ratio, 4)),
            format!("{:>9}", significant(mode.pad_participation, 3)),
        ]);
        if grows { row.style(Style::new().fg(Color::Red).add_modifier(Modifier::BOLD)) } else { row }
    });
    let widths = [5, 13, 15, 15, 10].map(Constraint::Length);
    let header = Row::new(["mode", "frequency Hz", "growth 1/s", "damping ratio", "pad share"]).bold();
    Table::new(rows, widths).header(header).block(Block::bordered().title(" modes "))
}
