//! The services of a managed node (`lifecycle_msgs`): its state, and the transitions that a peer requests.

use std::sync::{Arc, Mutex, PoisonError};

use ros2_client::{Message, MessageTypeName, ServiceTypeName};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::link::{Durability, Hearing, Link, MAX_UNANSWERED};
use super::{Ros2Error, publish};
use crate::bus::lifecycle::{State, Transition};
use crate::system::clock;

/// The topic of what has happened.
const TRANSITION_EVENT: &str = "~/transition_event";

/// Called with every new state, on the node's thread.
pub(super) type Changed = Box<dyn FnMut(State) + Send>;

/// `lifecycle_msgs/State` or `lifecycle_msgs/Transition`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Named {
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

#[derive(Clone, Debug, Serialize, Deserialize)]
struct TransitionDescription {
    transition: Named,
    start_state: Named,
    goal_state: Named,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct TransitionEvent {
    /// ns since the epoch.
    timestamp: u64,
    transition: Named,
    start_state: Named,
    goal_state: Named,
}

/// A request without fields, which has one byte on the wire.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Nothing {
    structure_needs_at_least_one_member: u8,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct ChangeState {
    transition: Named,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Changing {
    success: bool,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Current {
    current_state: Named,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct States {
    available_states: Vec<Named>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Transitions {
    available_transitions: Vec<TransitionDescription>,
}

impl Message for Nothing {}
impl Message for ChangeState {}
impl Message for Changing {}
impl Message for Current {}
impl Message for States {}
impl Message for Transitions {}

/// Adds the lifecycle services to the node of `link`, which starts in `state`; they answer while the future runs.
pub(super) fn add<M: DeserializeOwned + Send + Sync + 'static>(
    link: &mut Link<M>,
    state: State,
    mut changed: Changed,
) -> Result<Hearing, Ros2Error> {
    fn kind(name: &str) -> ServiceTypeName {
        ServiceTypeName::new("lifecycle_msgs", name)
    }
    let events = link.publisher::<TransitionEvent>(
        TRANSITION_EVENT,
        MessageTypeName::new("lifecycle_msgs", "TransitionEvent"),
        Durability::Volatile,
        MAX_UNANSWERED,
    )?;
    let shared = Arc::new(Mutex::new(state));
    let present = {
        let shared = shared.clone();
        move || *shared.lock().unwrap_or_else(PoisonError::into_inner)
    };
    let change = link.service("change_state", &kind("ChangeState"), move |asked: ChangeState| {
        let mut state = shared.lock().unwrap_or_else(PoisonError::into_inner);
        let Named { id, label } = asked.transition;
        let Some(transition) = Transition::requested(*state, id, &label) else { return Changing { success: false } };
        let timestamp = u64::try_from(clock::now_ns()).unwrap_or_default();
        let steps = steps(*state, transition);
        *state = transition.goal();
        changed(*state);
        for TransitionDescription { transition, start_state, goal_state } in steps {
            // Without it a peer still learns of the change from the answer.
            let event = TransitionEvent { timestamp, transition, start_state, goal_state };
            drop(publish(&events, TRANSITION_EVENT, &event));
        }
        Changing { success: true }
    })?;
    let get = link.service("get_state", &kind("GetState"), {
        let present = present.clone();
        move |_: Nothing| Current { current_state: present().into() }
    })?;
    let states = link.service("get_available_states", &kind("GetAvailableStates"), |_: Nothing| {
        let primary = State::ALL.into_iter().map(Named::from);
        let passing = Transition::ALL.into_iter().map(Transition::passing).map(|(id, label)| Named::new(id, label));
        States { available_states: primary.chain(passing).collect() }
    })?;
    let transitions =
        link.service("get_available_transitions", &kind("GetAvailableTransitions"), move |_: Nothing| Transitions {
            available_transitions: begins(present()).collect(),
        })?;
    let graph = link.service("get_transition_graph", &kind("GetAvailableTransitions"), |_: Nothing| Transitions {
        available_transitions: graph(),
    })?;
    Ok(Box::pin(async move {
        tokio::join!(change, get, states, transitions, graph);
    }))
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

/// All steps of all transitions.
fn graph() -> Vec<TransitionDescription> {
    let ends = Transition::ALL.into_iter().map(|transition| {
        let [_, end] = steps(State::Active, transition);
        end
    });
    State::ALL.into_iter().flat_map(begins).chain(ends).collect()
}
