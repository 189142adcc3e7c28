//! The services of a managed node over DDS.

use std::sync::Arc;

use ros2_client::{Message, MessageTypeName, ServiceTypeName};
use serde::de::DeserializeOwned;

use super::link::{Durability, Hearing, Link, MAX_UNANSWERED};
use super::{Ros2Error, publish};
use crate::bus::lifecycle::State;
use crate::bus::managed::{
    CHANGE_STATE, ChangeState, Changed, Changing, Current, GET_AVAILABLE_STATES, GET_AVAILABLE_TRANSITIONS, GET_STATE,
    GET_TRANSITION_GRAPH, Managed, Nothing, PACKAGE, States, TRANSITION_EVENT, TransitionEvent, Transitions,
};

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
    changed: Changed,
) -> Result<Hearing, Ros2Error> {
    fn kind(name: &str) -> ServiceTypeName {
        ServiceTypeName::new(PACKAGE, name)
    }
    let events = link.publisher::<TransitionEvent>(
        TRANSITION_EVENT,
        MessageTypeName::new(PACKAGE, "TransitionEvent"),
        Durability::Volatile,
        MAX_UNANSWERED,
    )?;
    let node = Arc::new(Managed::new(state, changed));
    let [changing, current, available] = std::array::from_fn(|_| node.clone());
    let change = link.service(CHANGE_STATE, &kind("ChangeState"), move |asked| {
        // Without it a peer still learns of the change from the answer.
        changing.change(&asked, |event| drop(publish(&events, TRANSITION_EVENT, &event)))
    })?;
    let get = link.service(GET_STATE, &kind("GetState"), move |_: Nothing| current.state())?;
    let states = link.service(GET_AVAILABLE_STATES, &kind("GetAvailableStates"), |_: Nothing| Managed::states())?;
    let transitions =
        link.service(GET_AVAILABLE_TRANSITIONS, &kind("GetAvailableTransitions"), move |_: Nothing| {
            available.transitions()
        })?;
    let graph = link.service(GET_TRANSITION_GRAPH, &kind("GetAvailableTransitions"), |_: Nothing| Managed::graph())?;
    Ok(Box::pin(async move {
        tokio::join!(change, get, states, transitions, graph);
    }))
}
