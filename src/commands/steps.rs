//! Progress of long computations on standard error: bars with the remaining time on a terminal, plain lines elsewhere,
//! nothing with `--quiet`.

use std::f64::consts::TAU;
use std::io::{IsTerminal, Write};
use std::panic::resume_unwind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Args;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::physics::OperatingPoint;
use crate::reduction::{CountedBy, FullProgress, GIB, ParametricStep, Precision, Progress};
use crate::system::clock::monotonic_ns;
use crate::system::memory::resident_bytes;
use crate::text::terminal::printable;

/// A plain line is written each time one of this many parts of a step is done.
const PLAIN_PARTS: usize = 4;

/// How much a command says about its progress.
#[derive(Clone, Copy, Debug, Args)]
pub struct ProgressOptions {
    /// Show no progress, only results and errors
    #[arg(short, long)]
    pub quiet: bool,
}

impl ProgressOptions {
    /// Progress of `tasks` simultaneous tasks; time is measured from now.
    pub fn steps(self, tasks: usize) -> Steps {
        let shown = match (self.quiet, std::io::stderr().is_terminal()) {
            (true, _) => Shown::Nothing,
            (false, true) => Shown::Bars(MultiProgress::with_draw_target(ProgressDrawTarget::stderr())),
            (false, false) => Shown::Lines(Box::new(std::io::stderr())),
        };
        Steps::new(shown, tasks)
    }
}

/// Where progress is shown.
enum Shown {
    Bars(MultiProgress),
    Lines(Box<dyn Write + Send>),
    Nothing,
}

/// The current step of a task.
struct Step {
    what: String,
    done: usize,
    of: usize,
    bar: ProgressBar,
}

/// The payload with which work that was stopped unwinds.
#[derive(Clone, Copy, Debug)]
pub struct Stopped;

/// Progress of several simultaneous tasks.
pub struct Steps {
    shown: Shown,
    /// Once set, the next progress that is reported unwinds.
    stopped: Option<Arc<AtomicBool>>,
    started_ns: u64,
    tasks: Vec<Option<Step>>,
}

impl Steps {
    fn new(shown: Shown, tasks: usize) -> Self {
        Self { shown, stopped: None, started_ns: monotonic_ns(), tasks: (0..tasks).map(|_| None).collect() }
    }

    /// Progress that is not shown; the work is unwound with [`Stopped`] once `stopped` is set.
    pub fn until(stopped: Arc<AtomicBool>, tasks: usize) -> Self {
        let mut steps = Self::new(Shown::Nothing, tasks);
        steps.stopped = Some(stopped);
        steps
    }

    fn unwind_if_stopped(&self) {
        if self.stopped.as_ref().is_some_and(|stopped| stopped.load(Ordering::Relaxed)) {
            resume_unwind(Box::new(Stopped));
        }
    }

    /// Writes a permanent line. Errors are ignored, because nothing depends on it.
    pub fn say(&mut self, text: &str) {
        self.unwind_if_stopped();
        let seconds = monotonic_ns().saturating_sub(self.started_ns) as f64 / 1e9;
        let memory = resident_bytes().map_or("      ?".to_owned(), |bytes| format!("{:7.2}", bytes as f64 / GIB));
        let line = format!("[{seconds:7.1} s {memory} GiB] {}", printable(text));
        match &mut self.shown {
            Shown::Bars(bars) => drop(bars.println(line)),
            Shown::Lines(out) => drop(writeln!(out, "{line}").and_then(|()| out.flush())),
            Shown::Nothing => {}
        }
    }

    /// Reports that `task` has done `done` of `of` parts of the step `what`.
    pub fn at(&mut self, task: usize, what: &str, done: usize, of: usize) {
        self.unwind_if_stopped();
        let part = |done: usize, of: usize| done * PLAIN_PARTS / of.max(1);
        if self.tasks[task].as_ref().is_some_and(|before| before.what != what || before.of != of) {
            self.done(task);
        }
        let before = self.tasks[task].take();
        let next_part = before.as_ref().is_none_or(|before| part(before.done, of) != part(done, of));
        let bar = match (before, &self.shown) {
            (Some(before), _) => before.bar,
            (None, Shown::Bars(bars)) => bars.add(styled(what, of)),
            (None, Shown::Lines(_) | Shown::Nothing) => ProgressBar::hidden(),
        };
        bar.set_position(done as u64);
        self.tasks[task] = Some(Step { what: what.to_owned(), done, of, bar });
        if next_part && matches!(self.shown, Shown::Lines(_)) {
            self.say(&format!("{what}: {done} of {of}"));
        }
    }

    /// Reports that `task` has finished its step.
    pub fn done(&mut self, task: usize) {
        if let Some(step) = self.tasks[task].take() {
            step.bar.finish_and_clear();
        }
    }

    /// Reports the progress of solving a full model for the purpose `what`, as the first task.
    pub fn full(&mut self, what: &str, step: FullProgress) {
        let hz = |omega: f64| omega / TAU;
        match step {
            FullProgress::Analysed { bytes } => {
                self.say(&format!("{what}: ordered and analysed, needs {:.2} GiB at least", bytes as f64 / GIB));
            }
            FullProgress::Factored { shift_rad_s, precision } => {
                let kept = match precision {
                    Precision::Double => "",
                    Precision::Single => ", kept in single precision to save memory",
                };
                self.say(&format!("{what}: factored at {:.1} Hz{kept}", hz(shift_rad_s)));
            }
            FullProgress::Iterated { shift_rad_s, converged, wanted, .. } => {
                self.at(0, &format!("{what}: roots around {:.1} Hz", hz(shift_rad_s)), converged.min(wanted), wanted);
            }
            FullProgress::Covered { disc, roots } => {
                let [from, to] = disc.stretch_rad_s();
                self.done(0);
                self.say(&format!("{what}: {roots} roots cover {:.1} to {:.1} Hz", hz(from), hz(to)));
            }
        }
    }

    /// Reports the progress of the modes of the part `name`, as the task `part`.
    pub fn modes(&mut self, part: usize, name: &str, what: Progress) {
        match what {
            Progress::Analysing => self.say(&format!("{name}: ordering and analysing")),
            Progress::Analysed { factor_entries, bytes } => self.say(&format!(
                "{name}: {:.1} million numbers in the factor, {:.2} GiB needed for this part in addition to the matrices",
                factor_entries as f64 / 1e6,
                bytes as f64 / GIB
            )),
            Progress::Factored { .. } => self.say(&format!("{name}: factored")),
            Progress::Iterated { converged, wanted, .. } => {
                self.at(part, &format!("{name}: modes"), converged.min(wanted), wanted);
            }
            Progress::Counted { modes, below, by } => {
                self.done(part);
                let below_hz = below.max(0.0).sqrt() / TAU;
                let by = match by {
                    CountedBy::Us => "",
                    CountedBy::Engine => " of the engine, unchecked: no memory for a factor of our own",
                };
                self.say(&format!(
                    "{name}: {modes} modes below {below_hz:.1} Hz, counted by the inertia of K - shift M{by}"
                ));
            }
            Progress::Loaded { solved, loads } => self.at(part, &format!("{name}: residual"), solved, loads),
        }
    }

    /// Reports the progress of a parametric basis, as the first task.
    pub fn basis(&mut self, step: ParametricStep) {
        let at = |point: OperatingPoint| {
            format!(
                "{:.4} N, {:.4} rad/s, friction coefficient {:.4}",
                point.normal_load_n, point.disc_speed_rad_s, point.friction_coefficient
            )
        };
        match step {
            ParametricStep::Planned { bytes } => {
                self.say(&format!(
                    "{:.2} GiB needed in addition to the matrices, for two operating points",
                    bytes as f64 / GIB
                ));
            }
            ParametricStep::Sampling { point, sample } => {
                self.say(&format!("sample {sample}: solving the full model at {}", at(point)));
            }
            ParametricStep::Solving(step) => self.full("full model", step),
            ParametricStep::Sampled { roots, vectors, .. } => {
                self.say(&format!("{roots} roots there, {vectors} vectors in all"));
            }
            ParametricStep::Estimating { done, of } => self.at(0, "estimating errors at operating points", done, of),
            ParametricStep::Estimated { worst, vectors } => {
                self.done(0);
                self.say(&format!("worst estimate of |dlambda|/|lambda| with {vectors} vectors: {worst:.1e}"));
            }
            ParametricStep::Cut { vectors, worst } => self.say(&format!("cut to {vectors} vectors: {worst:.1e}")),
            ParametricStep::HeldOut { point, worst, done, of } => {
                self.say(&format!("held out, {done} of {of}, {}: {worst:.1e}", at(point)));
            }
        }
    }
}

/// The progress bar of a step: name, progress, elapsed and remaining time.
fn styled(what: &str, of: usize) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} [{bar:24}] {pos}/{len}, {elapsed}, {eta} left");
    let style = style.map_or_else(|_| ProgressStyle::default_bar(), |style| style.progress_chars("#>."));
    ProgressBar::new(of as u64).with_style(style).with_message(what.to_owned())
}

impl Drop for Steps {
    fn drop(&mut self) {
        if let Shown::Bars(bars) = &self.shown {
            drop(bars.clear());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Sender, channel};

    use super::*;

    /// A writer whose output is read elsewhere.
    struct Sink(Sender<String>);

    impl Write for Sink {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            drop(self.0.send(String::from_utf8_lossy(bytes).into_owned()));
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn plain_lines_are_written_at_quarters_of_a_step() {
        let (sender, written) = channel();
        let mut steps = Steps::new(Shown::Lines(Box::new(Sink(sender))), 2);
        for done in 0..=8 {
            steps.at(0, "pad: modes", done, 8);
        }
        steps.at(1, "disc: modes", 0, 0);
        drop(steps);
        let text: String = written.iter().collect();
        let counts: Vec<&str> =
            text.lines().filter_map(|line| line.split_once("GiB] ")).map(|(_, what)| what).collect();
        let expected = ["0 of 8", "2 of 8", "4 of 8", "6 of 8", "8 of 8"].map(|part| format!("pad: modes: {part}"));
        assert_eq!(counts[..5], expected);
        assert_eq!(counts[5..], ["disc: modes: 0 of 0"]);
    }

    #[test]
    fn a_step_keeps_its_bar_until_the_next_step_begins() {
        let mut steps = Steps::new(Shown::Bars(MultiProgress::with_draw_target(ProgressDrawTarget::hidden())), 1);
        steps.at(0, "pad: modes", 1, 8);
        let first = steps.tasks[0].as_ref().map(|step| step.bar.clone()).expect("a step");
        steps.at(0, "pad: modes", 3, 8);
        assert_eq!((first.position(), first.length()), (3, Some(8)), "one bar, which the time left is estimated from");
        steps.at(0, "pad: residual", 0, 5);
        let second = &steps.tasks[0].as_ref().expect("a step").bar;
        assert_eq!((second.position(), second.length()), (0, Some(5)));
        assert!(first.is_finished() && !second.is_finished());
    }
}
