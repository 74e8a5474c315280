//! The whole machine in virtual time: loop, buses, stations and simulated drives, without a socket or a clock.
//!
//! Everything is deterministic: a test that fails, fails again. Where seeds are drawn they stand in the message.

mod acyclic;
mod arrivals;
mod background;
mod bring_up;
mod campaign;
mod captures;
mod carrier;
mod commanding;
mod commands;
mod diagnosis;
mod evidence;
mod faults;
#[path = "../../support/fuse.rs"]
mod fuse;
mod grid;
mod groups;
mod groups_random;
mod identity;
mod kollmorgen;
mod latches;
mod lenze;
mod limits;
mod loads;
mod lock;
mod moons;
mod native;
mod oracle;
mod oracle_found;
mod other_masters;
mod owners;
mod panics;
mod powered;
mod queues;
mod recordings;
mod replay;
mod replies;
mod restarts;
mod services;
mod shutdown;
mod soak;
mod stop_bound;
mod streams;
mod stuck;
mod support;
mod telemetry;
mod torques;
mod unidrive;
mod watchdogs;
