//! What people look at: a page that shows a node or a recording, and a report.
//!
//! The pure part turns what is known into what is shown: [`history`], [`events`] and [`curves`] from samples and
//! stability maps, [`comparison`] from a measured vibration, [`shape`] and [`change`] from a spectrum, [`state`] from a snapshot. [`live`] and [`recorded`] feed it; [`server`]
//! hands it to browsers. Nothing here can change a node: a node only updates its [`crate::node::Watch`], whether
//! somebody looks or not, and text is encoded only while a page listens.

mod assets;
pub mod change;
pub mod comparison;
mod connections;
pub mod curves;
pub mod events;
pub mod history;
pub mod live;
pub mod recorded;
pub mod report;
pub mod server;
pub mod shape;
pub mod state;
mod time_line;
