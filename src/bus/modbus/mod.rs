//! Modbus TCP to Nidec Unidrive M700, M701 and M702: speed-controlled axes, a connection each.
//!
//! | file | what |
//! |---|---|
//! | `wire` | bytes <-> values |
//! | `parameter`, `notation` | parameters of a drive: addresses, what is known of them, how people write them |
//! | `words`, `trips` | control word and status word, trip numbers |
//! | `plan`, `mapping` | the bus as configured; its cyclic parameters as blocks |
//! | `greeting` | what is said on a new connection before the loop has it |
//! | `station` | the master's view of one drive |
//! | `identity`, `orders`, `calls`, `native`, `counters` | its parts: whose reply, what an order does, acyclic calls, native process data, counts |
//! | `setup`, `echo`, `template` | and what is set before the first order, what the drive has taken, what stays the same from exchange to exchange |
//! | `bus` | stations and connections as one bus |
//! | `sim` | the simulated drive |

pub mod counters;
pub mod mapping;
pub mod native;
pub mod notation;
pub mod parameter;
pub mod sim;
pub mod trips;
pub mod wire;
pub mod words;

mod bus;
mod calls;
mod echo;
mod greeting;
mod identity;
mod orders;
mod plan;
mod setup;
mod station;
mod template;

pub use bus::ModbusBus;
pub use greeting::{Finding, Found};
pub use native::{Native, NativeInputs, NativeOutput};
pub use plan::{Map, Mapped, ModbusPlan, PORT, UnidriveDrive, Via, WATCHDOG_MAX_NS, Watchdog};
pub use station::{Station, Why};

/// The protocol's name in configurations.
pub const PROTOCOL: &str = "modbus-tcp";
