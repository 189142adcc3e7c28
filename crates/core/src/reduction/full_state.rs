//! Full models whose contact pairs open and close: the state of steady sliding, and the contact about it.

use std::sync::Arc;

use super::ReductionError;
use super::full_model::{FullContact, FullModel, FullSteady, SparseRow};
use crate::contact::Statics;
use crate::physics::{self, ModelError, OperatingPoint, Situation};

/// Contact pairs at an operating point.
pub(super) struct PairsHere {
    /// N/m: the tangent stiffness in a state.
    pub stiffness_n_per_m: Vec<f64>,
    /// N·s/m.
    pub damping_n_s_per_m: Vec<f64>,
    /// Normal force of each pair, relative to the load.
    pub load_share: Vec<f64>,
}

impl FullModel {
    /// Lets the contact pairs follow the states of `statics` under `load`, the generalised force of a load of 1 N over the
    /// rows of all parts; see [`Self::static_response`]. Does nothing for a model without contact pairs.
    ///
    /// # Errors
    /// [`ModelError::PairCount`], [`ModelError::StateLoadExponent`], [`ModelError::StateDamping`].
    pub fn follow_states(&mut self, load: SparseRow, statics: Arc<Statics>) -> Result<(), ModelError> {
        let Some(contact) = &mut self.contact else { return Ok(()) };
        let (found, expected) = (statics.pairs(), contact.normal.len());
        if found != expected {
            return Err(ModelError::PairCount { what: "statics", found, expected });
        }
        let relaxation_s =
            physics::relaxation_s(&self.contact_law, &contact.stiffness_n_per_m, &contact.damping_n_s_per_m)?;
        contact.steady = Some(FullSteady { load, statics, relaxation_s });
        Ok(())
    }

    /// The statics of steady sliding; `None` if the contact pairs are always closed.
    pub fn statics(&self) -> Option<&Arc<Statics>> {
        self.contact.as_ref()?.steady.as_ref().map(|steady| &steady.statics)
    }

    /// The largest friction coefficient up to `mu_max` that is known to have a contact state at the load and speed of `p`, to
    /// a thousandth of `mu_max`.
    pub(super) fn last_friction(&self, p: &OperatingPoint, mu_max: f64) -> f64 {
        let has_state = |mu: f64| self.at(&p.with_friction(mu)).is_ok();
        if has_state(mu_max) {
            return mu_max;
        }
        let (mut sound, mut without) = (0.0, mu_max);
        while without - sound > 1e-3 * mu_max {
            let middle = 0.5 * (sound + without);
            if has_state(middle) {
                sound = middle;
            } else {
                without = middle;
            }
        }
        sound
    }

    /// The contact state at `p`, from which the matrices there follow.
    ///
    /// # Errors
    /// [`ReductionError::State`] if there is no state of steady sliding.
    pub fn at(&self, p: &OperatingPoint) -> Result<Situation, ReductionError> {
        Situation::of_contact(p, self.statics().map(Arc::as_ref))
            .map_err(|error| ReductionError::State(Box::new(error)))
    }
}

impl FullContact {
    /// The pairs in the state of `here`, or always closed without one.
    pub(super) fn pairs_in(&self, here: &Situation) -> PairsHere {
        let Some((state, steady)) = here.state().zip(self.steady.as_ref()) else {
            let count = self.normal.len();
            return PairsHere {
                stiffness_n_per_m: self.stiffness_n_per_m.clone(),
                damping_n_s_per_m: self.damping_n_s_per_m.clone(),
                load_share: vec![1.0 / count.max(1) as f64; count],
            };
        };
        let tangent = &state.tangent_n_per_m;
        PairsHere {
            stiffness_n_per_m: tangent.clone(),
            damping_n_s_per_m: tangent.iter().zip(&steady.relaxation_s).map(|(k, s)| k * s).collect(),
            load_share: state.force_n.iter().map(|force| force / here.point().normal_load_n).collect(),
        }
    }
}
