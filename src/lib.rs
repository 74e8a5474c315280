//! Fieldbeat: a hard-real-time cyclic master for servo drives.
//!
//! One thread, SCHED_FIFO and pinned to a core, wakes on an absolute time grid. In every cycle it sends one
//! preallocated request to every drive that is due, takes in the replies until a deadline, evaluates them, and
//! publishes feedback. Application threads talk to it through wait-free queues and never make it wait.
//!
//! **It is not a safety function.** A machine needs its own STO / emergency stop.
//!
//! # A tour
//!
//! - [`Master`] brings a machine up from a file or from a [`Plan`] built in code, and hands out its [`Axis`] handles.
//! - [`Axis`] is the application's end of one drive: commands ([`Command`]) that each end in Done, Failed or Aborted,
//!   streamed rows ([`Row`]), the newest [`Feedback`], events ([`Event`]).
//! - [`Axis::parameter`] reads and writes the drive's parameters outside the cycle ([`axis::Parameters`]); the
//!   other services of a LinMot drive, such as curves and command tables, are in [`bus::linudp::service`].
//! - [`Group`] takes several axes: commands and rows of all of them take effect in the same cycle's send, all or
//!   none.
//! - An in-loop task ([`Setup::with_task`]) runs inside the cycle: it sees the feedback of cycle k, and its
//!   commands leave in cycle k + 1.
//! - [`Monitor`] reads a running machine from any thread: its numbers, histograms, and why cycles were late
//!   ([`telemetry`]); [`telemetry::metrics`] serves them to Prometheus, and [`telemetry::report`] writes the results
//!   of a run.
//! - [`Setup::simulate`] builds the same machine in virtual time, with simulated drives and seeded faults: hours pass
//!   in seconds, and the same seed gives the same bytes.
//! - [`replay`] repeats a recorded run bit by bit: a failure in the field becomes a test.
//! - [`doctor`] reports how fit a host is for real time, and how to fix what is not.
//! - [`bus`] has a folder for each protocol: the plan of its buses, its native process data, its services.
//!
//! # A complete program
//!
//! It starts the simulated drives of the sample configuration, so that it runs anywhere. Without that line it moves
//! real drives.
//!
//! ```no_run
//! use std::time::Duration;
//!
//! use fieldbeat::sim::server::{ServerOptions, SimServer};
//! use fieldbeat::{Master, Profile};
//!
//! # #[cfg(not(feature = "config"))]
//! # fn main() {}
//! # #[cfg(feature = "config")]
//! fn main() -> Result<(), Box<dyn std::error::Error>> {
//!     let setup = Master::from_file("rt-config/demo.toml")?;
//!     let _drives = SimServer::start(setup.simulation().build(), ServerOptions::default())?;
//!
//!     let master = setup.start()?;
//!     master.wait_online(Duration::from_secs(5))?;
//!
//!     let mut x = master.axis("a1")?;
//!     x.enable()?;
//!     x.home()?;
//!     x.move_to(120.0, Profile { velocity: 200.0, ..x.profile() })?;
//!     let feedback = x.feedback();
//!     println!("{:.3} mm, {} cycles old", feedback.status.position, feedback.age);
//!     x.disable()?;
//!
//!     let run = master.finish();
//!     let status = run.end.status;
//!     println!("{} cycles executed, {} skipped", status.executed, status.skipped);
//!     Ok(())
//! }
//! ```
//!
//! # Features
//!
//! The default is the whole program. With `default-features = false` there is the runtime for a program of your own, in
//! at most 25 crates: [`Master`], [`axis`], [`bus`], [`Simulation`], [`sim`] and the histograms of [`telemetry`], for a
//! [`Plan`] that is built in code.
//!
//! | feature | what it adds |
//! |---|---|
//! | `config` | [`config`]: a plan from TOML, [`Master::from_file`] |
//! | `summary` | [`telemetry::summary`]: a run as one object and as a table; serde's traits of acyclic calls |
//! | `replay` | [`replay`]: the run of a recording with the wire, repeated; brings `config` |
//! | `report` | [`telemetry::report`]: a directory with a page of plots, the summary and `.hgrm` histograms; brings `summary` |
//! | `metrics` | [`telemetry::metrics`]: a page for Prometheus; brings `summary` |
//! | `record` | [`telemetry::recording`]: every cycle in a file for Foxglove, PlotJuggler and Rerun; brings `summary` |
//! | `black-box` | [`telemetry::blackbox`]: the last cycles in a file when something fails; brings `summary` |
//! | `control` | the program's socket by which other processes reach a running master; brings `summary` |
//! | `doctor` | [`doctor`]: what this host is worth; brings `summary` |
//! | `jog` | the program's panel in the terminal; brings `cli` |
//! | `scope` | the program's page of a running machine in the browser, with a web server; brings `cli` |
//! | `cli` | the program, with all of them; the default |
//!
//! # Architecture
//!
//! Arrows point down only: `cli` -> `control`, [`doctor`], [`config`], [`replay`], `master` -> [`telemetry`] -> `cycle`
//! -> `drive`, `bus` (the contract) -> [`axis`], `net`, `rt`; `bus/x` -> [`axis`], `net`; a `wire` module depends on
//! nothing. Loop, drive machine, wires and sockets are not public: what is listed here is kept, and the rest changes
//! freely.

pub mod axis;
pub mod bus;
#[cfg(feature = "config")]
pub mod config;
#[cfg(feature = "control")]
mod control;
mod cycle;
#[cfg(feature = "doctor")]
pub mod doctor;
mod drive;
mod errors;
mod inputs;
#[doc(hidden)]
pub mod internals;
#[cfg(feature = "config")]
mod keys;
mod logged;
mod master;
mod named;
mod net;
mod packed;
pub mod replay;
mod rt;
#[cfg(feature = "scope")]
mod scope;
pub mod sim;
mod simulation;
#[cfg(feature = "config")]
mod soak;
#[cfg(feature = "summary")]
mod style;
mod sync;
pub mod telemetry;
pub mod time;

pub use axis::{Axis, Command, Event, EventKind, Feedback, Group, Profile, Row};
pub use bus::OpenError;
pub use bus::contract::Cycle;
pub use cycle::engine::Flow;
pub use cycle::task::Axes;
pub use cycle::{CyclePlan, GroupPlan, Guard, Overrun, Plan, PlanErrors, Wait, WatchAfter};
pub use master::{Master, MasterError, Setup, StartError, StopHandle};
pub use rt::{Granted, Memory, Realtime, RealtimeError};
pub use simulation::{SimulateError, Simulation};
pub use telemetry::{Monitor, Run};
pub use time::Time;

/// The programs of README.md and docs/ compile, or the doctests fail.
#[cfg(all(doctest, feature = "record", feature = "replay"))]
#[doc = include_str!("../README.md")]
#[doc = include_str!("../docs/src/library.md")]
#[doc = include_str!("../docs/src/replay.md")]
struct Programs;

#[cfg(all(doctest, feature = "record"))]
#[doc = include_str!("../docs/src/recording.md")]
struct Recordings;
