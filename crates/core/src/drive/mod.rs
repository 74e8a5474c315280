//! The drive machine: what the loop keeps and does for one drive, whatever its protocol.
//!
//! | file | what |
//! |---|---|
//! | `controller` | the loop's side of one drive: its queues, the running command, its latch |
//! | `controller/judge`, `controller/watch` | the end of its exchange; what it must not do, and its stops |
//! | `controller/commands` | the application's commands in their order |
//! | `controller/setpoints` | rows, velocities and torques for the next send, and their age |
//! | `stop` | the stop sequence |
//! | `last` | that of drives whose loop is stuck or has died |
//! | `at_end` | how a drive was left at the end of a run |
//! | `groups` | group synchronisation |
//! | `watch` | what an axis must not do by its reports, and which of them it can have reached |
//! | `machine` | what a command does to a drive, step by step; `power`: the states of CiA 402 |
//! | `planner` | the setpoint at an instant |
//! | `health` | the link to one drive: leaky bucket, schedule, probes |
//! | `record`, `numbers` | what the loop reports and counts of one drive |
//! | `journal` | its commands and events, until they are reported |
//!
//! It reads the instants of the grid and the stamps of exchanges, and never a clock: the same code runs in virtual
//! time.

pub mod at_end;
pub mod controller;
pub mod groups;
mod health;
pub mod journal;
pub mod last;
pub mod machine;
pub mod numbers;
pub mod planner;
mod power;
pub mod record;
mod stop;
mod watch;
