//! What long work is doing: a bar for everything under way on a terminal, plain lines elsewhere, with time and memory.

use std::io::{IsTerminal, Write};

use crate::io::clock::monotonic_ns;
use crate::io::memory::resident_bytes;
use crate::reduction::{FullProgress, GIB};

/// Characters of a bar.
const WIDTH: usize = 24;
/// Plain lines are written at every such part of a step.
const PLAIN_PARTS: usize = 4;

/// How far a step has come.
#[derive(Clone, Debug, PartialEq)]
struct Bar {
    what: String,
    done: usize,
    of: usize,
}

/// The steps of some tasks that go on side by side, told on standard error.
pub struct Steps {
    terminal: bool,
    started_ns: u64,
    bars: Vec<Option<Bar>>,
}

impl Steps {
    /// For so many tasks; the time counts from now.
    pub fn new(tasks: usize) -> Self {
        Self { terminal: std::io::stderr().is_terminal(), started_ns: monotonic_ns(), bars: vec![None; tasks] }
    }

    /// A line that stays.
    pub fn say(&mut self, text: &str) {
        let line = format!("{} {text}\n", self.stamp());
        self.write(&if self.terminal { format!("\r\x1b[K{line}{}", self.drawn()) } else { line });
    }

    /// `task` has come to `done` of `of` in the step `what`.
    pub fn at(&mut self, task: usize, what: &str, done: usize, of: usize) {
        let bar = Bar { what: what.to_owned(), done, of };
        let part = |bar: &Bar| bar.done * PLAIN_PARTS / bar.of.max(1);
        let before = self.bars[task].replace(bar.clone());
        if self.terminal {
            self.write(&format!("\r\x1b[K{}", self.drawn()));
        } else if before.is_none_or(|before| before.what != bar.what || part(&before) != part(&bar)) {
            self.write(&format!("{} {what}: {done} of {of}\n", self.stamp()));
        }
    }

    /// `task` has no step that could be counted.
    pub fn done(&mut self, task: usize) {
        self.bars[task] = None;
    }

    /// What a solve of a full model is doing, `what` it is for, as the first task.
    pub fn full(&mut self, what: &str, step: FullProgress) {
        let hz = |omega: f64| omega / std::f64::consts::TAU;
        match step {
            FullProgress::Analysed { bytes } => {
                self.say(&format!("{what}: ordered and analysed, needs {:.2} GiB at least", bytes as f64 / GIB));
            }
            FullProgress::Factored { shift_rad_s } => {
                self.say(&format!("{what}: factored at {:.1} Hz", hz(shift_rad_s)));
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

    /// Seconds since the beginning.
    fn seconds(&self) -> f64 {
        monotonic_ns().saturating_sub(self.started_ns) as f64 / 1e9
    }

    fn stamp(&self) -> String {
        let memory = resident_bytes().map_or("      ?".to_owned(), |bytes| format!("{:7.2}", bytes as f64 / GIB));
        format!("[{:7.1} s {memory} GiB]", self.seconds())
    }

    fn drawn(&self) -> String {
        let bars: Vec<String> = self.bars.iter().flatten().map(Bar::drawn).collect();
        if bars.is_empty() { String::new() } else { format!("{} {}", self.stamp(), bars.join("   ")) }
    }

    /// Nothing depends on whether it can be seen.
    fn write(&self, text: &str) {
        let mut out = std::io::stderr().lock();
        let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
    }
}

impl Drop for Steps {
    fn drop(&mut self) {
        if self.terminal {
            self.write("\r\x1b[K");
        }
    }
}

impl Bar {
    fn drawn(&self) -> String {
        let full = (WIDTH * self.done / self.of.max(1)).min(WIDTH);
        format!("{} {}{} {}/{}", self.what, "#".repeat(full), ".".repeat(WIDTH - full), self.done, self.of)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bar_never_leaves_its_width() {
        for (done, full) in [(0, 0), (3, 9), (8, 24), (12, 24)] {
            let drawn = Bar { what: "pad: modes".to_owned(), done, of: 8 }.drawn();
            assert_eq!((drawn.matches('#').count(), drawn.matches('.').count()), (full, WIDTH - full), "{drawn}");
        }
        assert!(Bar { what: "x".to_owned(), done: 0, of: 0 }.drawn().ends_with("0/0"));
    }
}
