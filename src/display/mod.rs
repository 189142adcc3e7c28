//! Displays for people: a page that shows a node or a recording, and a report.
//!
//! The pure modules convert data for display: [`history`], [`events`] and [`curves`] use samples and stability
//! maps, [`comparison`] a measured vibration, [`shape`] and [`change`] a spectrum, [`state`] a snapshot. [`live`] and
//! [`recorded`] provide the data; [`server`] serves browsers. Nothing here can affect a node: a node only updates its
//! [`crate::node::Watch`], whether or not it is displayed. Text is only encoded while a page is connected.

mod applications;
mod assets;
pub mod change;
pub mod comparison;
mod connections;
pub mod contact;
pub mod curves;
pub mod events;
pub mod heard;
pub mod history;
pub mod live;
mod metrics;
pub mod recorded;
pub mod report;
mod running_score;
pub mod server;
pub mod shape;
pub mod shelf;
mod sound_detail;
pub mod sound_page;
mod sound_report;
pub mod state;
mod time_line;
