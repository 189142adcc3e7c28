//! Dense spectra of recorded conditions, solved side by side before the session comes to them.
//!
//! A spectrum is a function of the model and of the conditions alone, so that a session that is handed what it would solve
//! predicts the same to the last bit. What it turns out not to need is thrown away; what it lacks it solves itself.

use std::collections::VecDeque;
use std::thread;

use crate::physics::{Model, OperatingPoint, Solver, Spectrum, Vectors};
use crate::session::Session;

/// Conditions looked at ahead of the session, for each thread: bounds what spectra take in memory.
const AHEAD_PER_THREAD: usize = 4;

/// Solves ahead of a session.
pub struct Ahead<I> {
    points: I,
    window: VecDeque<OperatingPoint>,
    solvers: Vec<Solver>,
}

impl<I: Iterator<Item = OperatingPoint>> Ahead<I> {
    /// Ahead of a session that is going to be asked for `points`, in that order, with `threads` threads.
    pub fn new(points: I, model: &Model, threads: usize) -> Self {
        let solvers = (0..threads).map(|_| Solver::new(model.dimension())).collect();
        Self { points, window: VecDeque::new(), solvers }
    }

    /// The session is about to be asked for the next point: it is handed the spectra of this and of those that follow, unless
    /// it has them.
    pub fn step(&mut self, session: &mut Session, model: &Model) {
        let room = (AHEAD_PER_THREAD * self.solvers.len()).saturating_sub(self.window.len());
        self.window.extend(self.points.by_ref().take(room));
        // One thread has nothing beside it.
        if self.solvers.len() > 1 && self.window.front().is_some_and(|next| session.would_solve(next)) {
            let wanted = session.would_solve_among(self.window.iter());
            session.hand_in(self.solve(model, &wanted));
        }
        self.window.pop_front();
    }

    /// Spectra of `points`, but of those that cannot be solved: why will be found out by the session.
    fn solve(&mut self, model: &Model, points: &[OperatingPoint]) -> Vec<Spectrum> {
        let share = points.len().div_ceil(self.solvers.len()).max(1);
        let one = |solver: &mut Solver, points: &[OperatingPoint]| -> Vec<Spectrum> {
            points.iter().filter_map(|p| solver.solve(model, p, Vectors::Both).ok()).collect()
        };
        let solved: Result<Vec<_>, _> = thread::scope(|scope| {
            let chunks = self.solvers.iter_mut().zip(points.chunks(share));
            let workers: Vec<_> = chunks.map(|(solver, points)| scope.spawn(move || one(solver, points))).collect();
            workers.into_iter().map(thread::ScopedJoinHandle::join).collect()
        });
        // A solver that panicked is of no more use; neither is looking ahead.
        solved.map_or_else(
            |_| {
                self.solvers.clear();
                vec![]
            },
            |solved| solved.into_iter().flatten().collect(),
        )
    }
}
