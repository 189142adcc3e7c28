//! The states of a managed node and the transitions between them, as ROS 2 defines them (`lifecycle_msgs`). Every
//! transition of this node succeeds, so those that follow a failure or an error are not listed.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::msgs::listed;

listed! {
    /// A primary state of a managed node.
    #[derive(PartialOrd, Ord, Serialize, Deserialize)]
    pub enum State {
        /// Computes nothing and receives nothing.
        Unconfigured,
        /// Has its stability map and chart, and receives nothing.
        Inactive,
        /// Receives, predicts and publishes.
        Active,
        /// As unconfigured, for good.
        Finalized,
    }
}

listed! {
    /// A transition that a peer can request.
    pub enum Transition {
        Configure,
        Cleanup,
        Activate,
        Deactivate,
        Shutdown,
    }
}

/// A node is active unless it is managed.
impl Default for State {
    fn default() -> Self {
        Self::Active
    }
}

impl State {
    /// Its number in `lifecycle_msgs/State`.
    pub fn id(self) -> u8 {
        match self {
            Self::Unconfigured => 1,
            Self::Inactive => 2,
            Self::Active => 3,
            Self::Finalized => 4,
        }
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Unconfigured => "unconfigured",
            Self::Inactive => "inactive",
            Self::Active => "active",
            Self::Finalized => "finalized",
        }
    }

    /// The state with this number.
    pub fn of_id(id: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.id() == id)
    }

    /// Whether the node has begun to compute what predictions need.
    pub fn is_prepared(self) -> bool {
        match self {
            Self::Inactive | Self::Active => true,
            Self::Unconfigured | Self::Finalized => false,
        }
    }

    /// What the node waits for, as a sentence for people.
    pub fn sentence(self) -> &'static str {
        match self {
            Self::Unconfigured => "unconfigured: it waits to be configured and activated over ROS 2",
            Self::Inactive => "inactive: it waits to be activated over ROS 2",
            Self::Active => "active",
            Self::Finalized => "finalized: it was shut down over ROS 2",
        }
    }
}

impl fmt::Display for State {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.name())
    }
}

impl Transition {
    /// Its number in `lifecycle_msgs/Transition`, when it begins in the state `from`; `None` if it cannot begin there.
    pub fn id(self, from: State) -> Option<u8> {
        match (self, from) {
            (Self::Configure, State::Unconfigured) => Some(1),
            (Self::Cleanup, State::Inactive) => Some(2),
            (Self::Activate, State::Inactive) => Some(3),
            (Self::Deactivate, State::Active) => Some(4),
            (Self::Shutdown, State::Unconfigured) => Some(5),
            (Self::Shutdown, State::Inactive) => Some(6),
            (Self::Shutdown, State::Active) => Some(7),
            (
                Self::Configure | Self::Cleanup | Self::Activate | Self::Deactivate | Self::Shutdown,
                State::Unconfigured | State::Inactive | State::Active | State::Finalized,
            ) => None,
        }
    }

    pub fn label(self) -> &'static str {
        match self {
            Self::Configure => "configure",
            Self::Cleanup => "cleanup",
            Self::Activate => "activate",
            Self::Deactivate => "deactivate",
            Self::Shutdown => "shutdown",
        }
    }

    /// The state it leads to.
    pub fn goal(self) -> State {
        match self {
            Self::Configure | Self::Deactivate => State::Inactive,
            Self::Cleanup => State::Unconfigured,
            Self::Activate => State::Active,
            Self::Shutdown => State::Finalized,
        }
    }

    /// Number and name of the state during the transition.
    pub fn passing(self) -> (u8, &'static str) {
        match self {
            Self::Configure => (10, "configuring"),
            Self::Cleanup => (11, "cleaningup"),
            Self::Shutdown => (12, "shuttingdown"),
            Self::Activate => (13, "activating"),
            Self::Deactivate => (14, "deactivating"),
        }
    }

    /// The number of the transition that ends it.
    pub fn success_id(self) -> u8 {
        match self {
            Self::Configure => 10,
            Self::Cleanup => 20,
            Self::Activate => 30,
            Self::Deactivate => 40,
            Self::Shutdown => 50,
        }
    }

    /// The transitions that can begin in the state `from`, with their numbers.
    pub fn available(from: State) -> impl Iterator<Item = (Self, u8)> {
        Self::ALL.into_iter().filter_map(move |transition| Some((transition, transition.id(from)?)))
    }

    /// The transition that a peer requests in the state `from`, by its label if there is one, else by its number.
    pub fn requested(from: State, id: u8, label: &str) -> Option<Self> {
        let by_label = |transition: Self| transition.label() == label;
        let mut available = Self::available(from);
        let found =
            available.find(|&(known, known_id)| if label.is_empty() { known_id == id } else { by_label(known) });
        found.map(|(transition, _)| transition)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_is_configured_activated_and_brought_back() {
        let mut state = State::Unconfigured;
        for (label, expected) in [
            ("configure", State::Inactive),
            ("activate", State::Active),
            ("deactivate", State::Inactive),
            ("cleanup", State::Unconfigured),
            ("shutdown", State::Finalized),
        ] {
            // Clients that give a label leave the number at 0.
            state = Transition::requested(state, 0, label).expect(label).goal();
            assert_eq!(state, expected, "{label}");
        }
        assert_eq!(Transition::available(State::Finalized).count(), 0);
    }

    #[test]
    fn a_transition_begins_only_where_ros_2_allows_it() {
        assert_eq!(Transition::requested(State::Unconfigured, 3, ""), None);
        assert_eq!(Transition::requested(State::Active, 1, "configure"), None);
        assert_eq!(Transition::requested(State::Active, 7, ""), Some(Transition::Shutdown));
        assert_eq!(Transition::requested(State::Active, 5, ""), None, "the shutdown of an unconfigured node");
        for state in State::ALL {
            assert_eq!(State::of_id(state.id()), Some(state));
        }
    }
}
