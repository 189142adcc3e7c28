//! Dense spectra of coming inputs, solved in parallel ahead of a session.
//!
//! A spectrum depends only on the model and the operating point, so a session that receives spectra in advance makes
//! bit-identical predictions. Unused spectra are discarded; missing ones the session solves itself.

use std::collections::VecDeque;
use std::thread;

use crate::physics::{Model, OperatingPoint, Solver, Spectrum, Vectors};
use crate::session::Session;

/// Number of operating points looked ahead, per thread. Bounds the memory that spectra take.
const AHEAD_PER_THREAD: usize = 4;

/// Solves spectra ahead of a session.
pub struct Ahead<I> {
    points: I,
    window: VecDeque<OperatingPoint>,
    solvers: Vec<Solver>,
}

impl<I: Iterator<Item = OperatingPoint>> Ahead<I> {
    /// `points` are the operating points that the session will predict, in order.
    pub fn new(points: I, model: &Model, threads: usize) -> Self {
        let solvers = (0..threads).map(|_| Solver::new(model.dimension())).collect();
        Self { points, window: VecDeque::new(), solvers }
    }

    /// To be called before each prediction. Hands the session the spectra of the coming operating points, unless it can
    /// predict the next one without a solve.
    pub fn step(&mut self, session: &mut Session) {
        let room = (AHEAD_PER_THREAD * self.solvers.len()).saturating_sub(self.window.len());
        self.window.extend(self.points.by_ref().take(room));
        // A single thread would gain nothing.
        if self.solvers.len() > 1 && self.window.front().is_some_and(|next| session.would_solve(next)) {
            let (wanted, rig) = (session.would_solve_among(self.window.iter()), session.rig().clone());
            session.hand_in(self.solve(&rig.model, &wanted));
        }
        self.window.pop_front();
    }

    /// The spectra of `points`. Points that cannot be solved are left to the session, which reports why.
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
        // A solver that panicked cannot be used again: stop looking ahead.
        solved.map_or_else(
            |_| {
                self.solvers.clear();
                vec![]
            },
            |solved| solved.into_iter().flatten().collect(),
        )
    }
}
