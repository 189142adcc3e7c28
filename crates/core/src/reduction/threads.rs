//! Independent pieces of work on all cores.

use std::sync::Mutex;

/// Number of threads: that of the cores.
pub(super) fn count() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Works on every item, the first ones first; on all cores if `parallel`.
pub(super) fn shared<T: Send>(items: Vec<T>, parallel: bool, work: impl Fn(T) + Sync) {
    let threads = if parallel { count().min(items.len()) } else { 1 };
    if threads < 2 {
        return items.into_iter().for_each(work);
    }
    let queue = Mutex::new(items.into_iter());
    let next = || queue.lock().ok().and_then(|mut items| items.next());
    let run = || {
        while let Some(item) = next() {
            work(item);
        }
    };
    std::thread::scope(|scope| {
        let others: Vec<_> = (1..threads).map(|_| scope.spawn(run)).collect();
        run();
        others.into_iter().for_each(|other| other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
    });
}
