//! Lines on standard error. While a live table covers the terminal, lines are kept back, so that none is written across
//! it.

use std::collections::VecDeque;
use std::fmt;
use std::io::IsTerminal;
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use crate::text::terminal::{self, printable};

/// Number of lines kept back; beyond it the oldest are dropped, and their number is written.
const MOST_LINES: usize = 200;

/// What makes a line of a note, if it is not the note itself.
static FORM: OnceLock<fn(&str) -> String> = OnceLock::new();

/// Writes every note from now on as `form` makes it; only the first call has an effect.
pub fn write_as(form: fn(&str) -> String) {
    let _ = FORM.set(form);
}

static WAITING: Mutex<Option<Waiting>> = Mutex::new(None);
/// The lines since they were last taken; `None` until [`collect`] is called.
static COLLECTED: Mutex<Option<Waiting>> = Mutex::new(None);

#[derive(Default)]
struct Waiting {
    lines: VecDeque<String>,
    dropped: u64,
}

impl Waiting {
    fn push(&mut self, line: String) {
        if self.lines.len() == MOST_LINES {
            self.lines.pop_front();
            self.dropped += 1;
        }
        self.lines.push_back(line);
    }

    fn into_lines(self) -> impl Iterator<Item = String> {
        let dropped = (self.dropped > 0).then(|| format!("{} earlier lines were dropped", self.dropped));
        dropped.into_iter().chain(self.lines)
    }
}

fn waiting() -> MutexGuard<'static, Option<Waiting>> {
    WAITING.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Begins to collect lines for [`take`].
pub fn collect() {
    COLLECTED.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert_default();
}

/// The lines since the last call, oldest first; none before [`collect`].
pub fn take() -> impl Iterator<Item = String> {
    let mut collected = COLLECTED.lock().unwrap_or_else(PoisonError::into_inner);
    collected.as_mut().map(std::mem::take).unwrap_or_default().into_lines()
}

/// Writes a line, or keeps it back while a [`Hold`] exists.
pub fn line(text: fmt::Arguments<'_>) {
    if let Some(collected) = COLLECTED.lock().unwrap_or_else(PoisonError::into_inner).as_mut() {
        collected.push(printable(&text.to_string()).into_owned());
    }
    match FORM.get() {
        Some(form) => write(format_args!("{}", form(&text.to_string()))),
        None => write(text),
    }
}

fn write(text: fmt::Arguments<'_>) {
    match waiting().as_mut() {
        Some(waiting) => waiting.push(printable(&text.to_string()).into_owned()),
        None => terminal::note(text),
    }
}

/// Keeps lines back while it exists, and writes them when it is dropped.
pub struct Hold(());

impl Hold {
    /// Begins to keep lines back; `None` if standard error is not a terminal, where nothing can be covered.
    pub fn begin() -> Option<Self> {
        std::io::stderr().is_terminal().then(Self::always)
    }

    fn always() -> Self {
        waiting().get_or_insert_default();
        Self(())
    }

    /// The latest line that is kept back.
    pub fn latest() -> Option<String> {
        waiting().as_ref()?.lines.back().cloned()
    }
}

impl Drop for Hold {
    fn drop(&mut self) {
        let kept = waiting().take().unwrap_or_default();
        kept.into_lines().for_each(|line| terminal::note(format_args!("{line}")));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_wait_in_bounded_memory_and_the_dropped_are_counted() {
        let mut waiting = Waiting::default();
        (0..MOST_LINES + 2).for_each(|k| waiting.push(k.to_string()));
        let lines: Vec<String> = waiting.into_lines().collect();
        assert_eq!(lines.len(), MOST_LINES + 1);
        assert_eq!((&*lines[0], &*lines[1]), ("2 earlier lines were dropped", "2"));
    }
}
