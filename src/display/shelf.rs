//! Several recordings that one server shows: each is read when its page is first opened.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use super::server::Source;

/// Number of recordings kept in memory: those opened last.
const KEPT: usize = 3;

/// Reads a recording, by its index; why it cannot be shown, as text.
type Open = Box<dyn Fn(usize) -> Result<Arc<dyn Source>, String> + Send + Sync>;

/// Recordings in order of name.
pub struct Shelf {
    names: Vec<String>,
    open: Open,
    /// Those in memory. Each has its own lock, so that reading one delays no other.
    opened: Vec<Mutex<Option<Arc<dyn Source>>>>,
    /// Indices of those in memory, the latest opened last.
    recent: Mutex<VecDeque<usize>>,
}

impl Shelf {
    /// Recordings with these names, of which `open` reads one.
    pub fn new(names: Vec<String>, open: Open) -> Self {
        let opened = names.iter().map(|_| Mutex::default()).collect();
        Self { names, open, opened, recent: Mutex::default() }
    }

    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The recording of a number, from 1; read if it is not in memory.
    ///
    /// # Errors
    /// There is no such recording, or why it cannot be shown.
    pub fn source(&self, number: Option<usize>) -> Result<Arc<dyn Source>, String> {
        let index = number.and_then(|number| number.checked_sub(1)).filter(|index| *index < self.names.len());
        let index = index.ok_or("there is no such recording")?;
        let mut opened = self.opened[index].lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(source) = &*opened {
            return Ok(source.clone());
        }
        let source = (self.open)(index)?;
        *opened = Some(source.clone());
        drop(opened);
        self.forget_all_but_recent(index);
        Ok(source)
    }

    fn forget_all_but_recent(&self, index: usize) {
        let mut recent = self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        recent.push_back(index);
        while recent.len() > KEPT {
            let Some(oldest) = recent.pop_front() else { return };
            self.opened[oldest].lock().unwrap_or_else(PoisonError::into_inner).take();
        }
    }
}
