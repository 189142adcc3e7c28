//! The services of a managed node (`lifecycle_msgs`): their messages, and their answers. The buses carry them.

use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};

use super::lifecycle::{State, Transition};
use crate::system::clock;

/// The topic of what has happened.
pub(super) const TRANSITION_EVENT: &str = "~/transition_event";
/// The package of these types.
pub(super) const PACKAGE: &str = "lifecycle_msgs";
/// The services, after the name of the node.
pub(super) const CHANGE_STATE: &str = "change_state";
pub(super) const GET_STATE: &str = "get_state";
pub(super) const GET_AVAILABLE_STATES: &str = "get_available_states";
pub(super) const GET_AVAILABLE_TRANSITIONS: &str = "get_available_transitions";
pub(super) const GET_TRANSITION_GRAPH: &str = "get_transition_graph";

/// Called with every new state.
pub(super) type Changed = Box<dyn FnMut(State) + Send>;

/// `lifecycle_msgs/State` or `lifecycle_msgs/Transition`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Named {
    id: u8,
    label: String,
}

impl Named {
    fn new(id: u8, label: &str) -> Self {
        Self { id, label: label.to_owned() }
    }
}

impl From<State> for Named {
    fn from(state: State) -> Self {
        Self::new(state.id(), state.name())
    }
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct TransitionDescription {
    transition: Named,
    start_state: Named,
    goal_state: Named,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct TransitionEvent {
    /// ns since the epoch.
    timestamp: u64,
    transition: Named,
    start_state: Named,
    goal_state: Named,
}

/// A request without fields, which has one byte on the wire.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Nothing {
    structure_needs_at_least_one_member: u8,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct ChangeState {
    transition: Named,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Changing {
    success: bool,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Current {
    current_state: Named,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct States {
    available_states: Vec<Named>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Transitions {
    available_transitions: Vec<TransitionDescription>,
}

/// The state of a node that peers manage.
pub(super) struct Managed(Mutex<(State, Changed)>);

impl Managed {
    /// A node in `state`; `changed` gets every later one.
    pub(super) fn new(state: State, changed: Changed) -> Self {
        Self(Mutex::new((state, changed)))
    }

    fn lock(&self) -> MutexGuard<'_, (State, Changed)> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Brings the node into another state, and tells of both steps of the transition.
    pub(super) fn change(&self, asked: &ChangeState, mut tell: impl FnMut(TransitionEvent)) -> Changing {
        let mut present = self.lock();
        let (state, changed) = &mut *present;
        let Named { id, label } = &asked.transition;
        let Some(transition) = Transition::requested(*state, *id, label) else { return Changing { success: false } };
        let timestamp = u64::try_from(clock::now_ns()).unwrap_or_default();
        let steps = steps(*state, transition);
        *state = transition.goal();
        changed(*state);
        for TransitionDescription { transition, start_state, goal_state } in steps {
            tell(TransitionEvent { timestamp, transition, start_state, goal_state });
        }
        Changing { success: true }
    }

    pub(super) fn state(&self) -> Current {
        Current { current_state: self.lock().0.into() }
    }

    /// All states, those during transitions included.
    pub(super) fn states() -> States {
        let primary = State::ALL.into_iter().map(Named::from);
        let passing = Transition::ALL.into_iter().map(Transition::passing).map(|(id, label)| Named::new(id, label));
        States { available_states: primary.chain(passing).collect() }
    }

    /// The transitions that can begin now.
    pub(super) fn transitions(&self) -> Transitions {
        Transitions { available_transitions: begins(self.lock().0).collect() }
    }

    /// All steps of all transitions.
    pub(super) fn graph() -> Transitions {
        let ends = Transition::ALL.into_iter().map(|transition| {
            let [_, end] = steps(State::Active, transition);
            end
        });
        Transitions { available_transitions: State::ALL.into_iter().flat_map(begins).chain(ends).collect() }
    }
}

/// The two steps of a transition: into the state during it, and on to its goal.
fn steps(from: State, transition: Transition) -> [TransitionDescription; 2] {
    let (id, label) = transition.passing();
    let passing = Named::new(id, label);
    [
        TransitionDescription {
            transition: Named::new(transition.id(from).unwrap_or_default(), transition.label()),
            start_state: from.into(),
            goal_state: passing.clone(),
        },
        TransitionDescription {
            transition: Named::new(transition.success_id(), "transition_success"),
            start_state: passing,
            goal_state: transition.goal().into(),
        },
    ]
}

/// The transitions that can begin in a state.
fn begins(from: State) -> impl Iterator<Item = TransitionDescription> {
    Transition::available(from).map(move |(transition, _)| {
        let [begin, _] = steps(from, transition);
        begin
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn a_change_is_made_told_and_passed_on_or_refused() {
        let passed = Arc::new(Mutex::new(vec![]));
        let to = passed.clone();
        let node = Managed::new(State::Unconfigured, Box::new(move |state| to.lock().expect("a lock").push(state)));
        let mut told = vec![];
        let mut change = |label: &str| {
            let asked = ChangeState { transition: Named::new(0, label) };
            node.change(&asked, |event| told.push((event.start_state.label, event.goal_state.label))).success
        };
        assert!(!change("activate"), "it is not configured");
        assert!(change("configure") && change("activate"));
        let expected = [
            ("unconfigured", "configuring"),
            ("configuring", "inactive"),
            ("inactive", "activating"),
            ("activating", "active"),
        ];
        assert_eq!(told, expected.map(|(from, to)| (from.to_owned(), to.to_owned())));
        assert_eq!(*passed.lock().expect("a lock"), [State::Inactive, State::Active]);
        assert_eq!(node.state(), Current { current_state: State::Active.into() });
        assert_eq!((Managed::states().available_states.len(), Managed::graph().available_transitions.len()), (9, 12));
    }
}
