//! Tests of the whole program, in one binary: each of these modules would otherwise be linked with everything the program
//! depends on. `cargo test --test suite rig_files::` runs one module.
//!
//! `program`, `bus`, `domain`, `records` and `forger` are helpers.

mod basis_rigs;
mod brake;
mod bus;
mod buses;
mod ceilings;
mod commands;
mod contact_calculix;
mod contact_rigs;
mod contact_states;
mod display;
mod domain;
mod examples;
mod file_systems;
mod forger;
mod foxglove;
mod full_model;
mod full_scipy;
mod identify;
mod identities;
mod layers;
mod live_sound;
mod modal_rigs;
mod neighbours;
mod non_matching;
mod peers;
mod program;
mod readers;
mod readme;
mod recorder_faults;
mod recording;
mod records;
mod reduce;
mod reproduce;
mod rig_files;
mod rig_models;
mod ros2_side;
mod scipy;
mod service;
mod sessions;
mod slepc;
mod sound;
mod sound_beside_logs;
mod sound_reports;
mod steady_states;
mod stress;
mod study;
mod temperature;
mod tribometer;
mod upstream;
mod usage;
