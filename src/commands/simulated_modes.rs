//! The unstable modes of a simulated rig while it runs.

use std::sync::{Arc, Mutex, PoisonError};

use crossbeam_channel::{Sender, bounded};

use crate::msgs::{OperatingPoint, Prediction};
use crate::physics::Solver;
use crate::rig::Rig;
use crate::session::computed::{Request, compute};
use crate::session::settings::Settings;
use crate::session::{Event, Session, conditions};

/// Finds the modes on a thread of its own, because a stability map takes longer than the time between two measurements.
pub struct SimulatedModes {
    measured: Sender<OperatingPoint>,
    latest: Arc<Mutex<Option<Prediction>>>,
}

impl SimulatedModes {
    pub fn start(rig: Arc<Rig>) -> Self {
        let (measured, received) = bounded(1);
        let latest: Arc<Mutex<Option<Prediction>>> = Arc::default();
        let shared = latest.clone();
        // It ends when the sender is dropped.
        std::thread::spawn(move || {
            let mut session = Session::new(rig.clone(), Settings::for_rig(&rig));
            let mut solver = Solver::new(rig.model.dimension());
            for input in received {
                prepare(&rig, &mut session, &mut solver, &input);
                // Settings are those of the rig, so the session refuses nothing.
                let found = session.step(Event::Input(input)).ok().and_then(|effects| effects.publish.cloned());
                *shared.lock().unwrap_or_else(PoisonError::into_inner) = found;
            }
        });
        Self { measured, latest }
    }

    /// The rig is at these conditions. They are passed over while those before are worked on.
    pub fn measured(&self, conditions: &OperatingPoint) {
        let _ = self.measured.try_send(conditions.clone());
    }

    /// The modes at the latest conditions that were not passed over.
    pub fn latest(&self) -> Option<Prediction> {
        self.latest.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// Computes the stability map that the conditions need, if the session does not have it.
fn prepare(rig: &Rig, session: &mut Session, solver: &mut Solver, input: &OperatingPoint) {
    let point = conditions(input);
    if session.has_no_map(&point)
        && let Ok(Some(event)) = compute(rig, solver, None, &Request::Map(point))
    {
        let _ = session.step(event);
    }
}
