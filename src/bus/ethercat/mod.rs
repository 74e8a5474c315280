//! EtherCAT with CoE to Kollmorgen S300, S400, S600 and S700: one frame serves all drives of a line.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `cia402`, `faults` | control word, status word, states, transitions; numbers of faults |
//! | `object` | objects of a drive: what is known of them, how people write them, what its PDOs are made of |
//! | `plan` | the line as configured |
//! | `counters` | what only EtherCAT counts |
//! | `bus` | stations, devices and frames as one bus |
//! | `image` | the process data of the line, and its frames |
//! | `line` | the slaves on their way to OP, and the clock of the line |
//! | `slot` | the acyclic slot of a frame |
//! | `service` | SDOs and emergencies of a slave |
//! | `station`, `orders`, `trajectory` | the master's view of one drive; what an order does; where its axis shall be |
//! | `start_up` | what is written to a drive before its process data run |
//! | `native` | native process data of drives, and of devices that are no drives |
//! | `scan` | what is on a line, for people |
//! | `sim` | a simulated line: slave controllers, and what drives and I/O do behind them |

pub mod cia402;
pub mod counters;
pub mod faults;
pub mod object;
pub mod scan;
pub mod sim;
pub mod wire;

mod bus;
mod image;
mod line;
mod native;
mod orders;
mod plan;
mod service;
mod slot;
mod start_up;
mod station;
mod trajectory;

pub use bus::EthercatBus;
pub use native::{
    Native, NativeInputs, NativeOutput, PDO_MAX, TERMINAL_MAX, TerminalError, TerminalInputs, Terminals,
};
pub use plan::{
    Area, Device, EthercatPlan, Expected, KOLLMORGEN, KollmorgenDrive, Mapping, Owner, Scaling, Setpoint,
    SlavePlan, Start,
};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "ethercat";
