//! Independent pieces of work on several threads, with the same result for any number of them.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, mpsc};

use faer::MatMut;

/// Number of threads: that of the cores.
pub(super) fn count() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Number of threads for `items` independent pieces of work: at most one for each, at least 1.
pub fn threads_for(items: usize) -> usize {
    count().min(items).max(1)
}

/// Works on every item, the first ones first; on all cores if `parallel`.
pub(super) fn shared<T: Send>(items: Vec<T>, parallel: bool, work: impl Fn(T) + Sync) {
    let threads = if parallel { threads_for(items.len()) } else { 1 };
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

/// Divides a matrix into blocks of `most` rows, each with its first row.
pub(super) fn row_blocks<T>(mut matrix: MatMut<'_, T>, most: usize) -> Vec<(usize, MatMut<'_, T>)> {
    let (mut blocks, mut first) = (vec![], 0);
    while matrix.nrows() > 0 {
        let at = most.min(matrix.nrows());
        let (block, rest) = matrix.split_at_row_mut(at);
        blocks.push((first, block));
        first += at;
        matrix = rest;
    }
    blocks
}

/// Runs `work` on every item, on as many threads as there are `workers`, each of which takes the next item with its own
/// worker. Returns the results in the order of the items. Progress is reported on the calling thread.
///
/// # Errors
/// The first one in the order of the items. Items that were not begun when work failed are left out.
pub fn on_threads<W: Send, T: Sync, P: Send, R: Send, E: Send, F>(
    workers: &mut [W],
    items: &[T],
    progress: &mut dyn FnMut(P),
    work: &F,
) -> Result<Vec<R>, E>
where
    F: Fn(&mut W, &T, &mut dyn FnMut(P)) -> Result<R, E> + Sync,
{
    if let ([worker], _) | ([worker, ..], [] | [_]) = (&mut *workers, items) {
        return items.iter().map(|item| work(worker, item, progress)).collect();
    }
    let (next, failed) = (AtomicUsize::new(0), AtomicBool::new(false));
    let take = || if failed.load(Ordering::Relaxed) { items.len() } else { next.fetch_add(1, Ordering::Relaxed) };
    let mut results = std::thread::scope(|scope| {
        let (sender, receiver) = mpsc::channel();
        let started: Vec<_> = workers
            .iter_mut()
            .map(|worker| {
                let (sender, take, failed) = (sender.clone(), &take, &failed);
                scope.spawn(move || {
                    let mut done = vec![];
                    while let (index, Some(item)) = {
                        let index = take();
                        (index, items.get(index))
                    } {
                        // A closed channel means that progress is no longer received; ignore it.
                        let result = work(worker, item, &mut |step| drop(sender.send(step)));
                        failed.fetch_or(result.is_err(), Ordering::Relaxed);
                        done.push((index, result));
                    }
                    done
                })
            })
            .collect();
        drop(sender);
        receiver.iter().for_each(progress);
        let join = |thread: std::thread::ScopedJoinHandle<'_, Vec<_>>| {
            thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        };
        started.into_iter().flat_map(join).collect::<Vec<_>>()
    });
    results.sort_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_are_in_the_order_of_the_items_for_any_number_of_threads() {
        let items: Vec<u64> = (0..50).collect();
        for threads in 1..4 {
            let mut steps = 0;
            let squares = on_threads(&mut vec![0; threads], &items, &mut |_: u64| steps += 1, &|done, item, step| {
                *done += 1;
                step(*item);
                Ok::<_, ()>(item * item)
            });
            assert_eq!(squares.unwrap(), items.iter().map(|item| item * item).collect::<Vec<_>>());
            assert_eq!(steps, 50);
        }
        assert_eq!(on_threads(&mut [(), ()], &[0; 0], &mut |()| (), &|(), _, _| Ok::<_, ()>(1)), Ok(vec![]));
    }

    #[test]
    fn the_first_failure_ends_the_work() {
        for threads in 1..4 {
            let begun = AtomicUsize::new(0);
            let items: Vec<usize> = (0..1000).collect();
            let found = on_threads(&mut vec![(); threads], &items, &mut |()| (), &|(), item, _| {
                begun.fetch_add(1, Ordering::Relaxed);
                if *item < 3 { Ok(()) } else { Err(*item) }
            });
            assert_eq!(found, Err(3));
            assert!(begun.load(Ordering::Relaxed) < 1000);
        }
    }
}
