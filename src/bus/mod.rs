//! The contract between the loop and a protocol, and one folder for each protocol.
//!
//! | file | what |
//! |---|---|
//! | `contract` | [`Bus`]: an open bus on the real-time thread, and what passes between it and the loop |
//! | `desired` | what the loop wants of a drive, and what shows that the drive has it |
//! | `counters` | exact counts of a drive's exchanges, and of what belongs to no drive |
//! | `plan`, `error` | [`BusPlan`]: a bus as configured, before any socket is open; why it cannot be opened |
//! | `native` | the native process data of a drive for a recording |
//! | `drives` | what the buses of all protocols do with their drives |
//! | `reader`, `cia402` | what their wires have in common: values from bytes, the states in a status word |
//! | `variant` | a bus in a machine that is otherwise like its own |
//! | `tools` | the commands that a protocol adds to the program |
//! | `outline` | what a first configuration of a protocol has, and what is asked for it |
//!
//! No protocol knows another. Each has these modules:
//!
//! | file | what | must not know |
//! |---|---|---|
//! | `wire` | bytes <-> values | state, clock, socket, allocation |
//! | `profile` | what is desired as process data, and what the replies prove | commands, sockets |
//! | `station` | the master's view of one drive: identity of replies, its reports, the next request | sockets |
//! | `bus` | stations + sockets = one [`Bus`] | the loop |
//! | `config`, `outline` | its keys in a configuration, and those of a first one | other protocols |
//! | `tools` | its own commands of the program | other protocols |
//!
//! `tests/conformance` tests the contract clause by clause, for every protocol.

mod cia402;
pub(crate) mod contract;
pub(crate) mod counters;
pub(crate) mod desired;
pub(crate) mod drives;
mod error;
pub mod ethercat;
pub mod ethernet_ip;
pub mod linudp;
pub mod modbus;
pub(crate) mod native;
#[cfg(feature = "cli")]
pub(crate) mod outline;
mod plan;
pub mod profibus;
mod reader;
#[cfg(feature = "cli")]
pub(crate) mod tools;
pub(crate) mod variant;

pub(crate) use self::contract::{Bus, Cycle, Exchange, LastResort, Notes, Slot};
pub(crate) use self::counters::{BusClock, Counters, OwnCounter, ProtocolCounters, Unmatched};
pub(crate) use self::drives::Ends;
pub use self::error::OpenError;
pub use self::plan::{BusPlan, Grid};
#[cfg(feature = "config")]
use crate::keys::{machine::Machine, table::Table};

/// A protocol, as the rest of the program finds it: what it is called, and what it adds.
#[doc(hidden)]
#[derive(Debug)]
pub struct Protocol {
    /// Its name in configurations.
    pub name: &'static str,
    /// The drives that have it, for people.
    pub drives: &'static str,
    /// Reads the keys of a `[[bus]]`. What is wrong is noted on the table.
    #[cfg(feature = "config")]
    pub(crate) read: fn(&mut Table<'_>, &mut Machine) -> Box<dyn BusPlan>,
    /// The reference of its keys in docs/.
    #[cfg(feature = "config")]
    pub(crate) reference: &'static str,
    /// The keys of a `[[bus]]` behind its protocol, with each table whose keys are read only if it is there: the schema
    /// is recorded from it.
    #[cfg(feature = "config")]
    pub(crate) specimen: &'static str,
    /// What a first configuration of it has.
    #[cfg(feature = "cli")]
    pub outline: outline::Outline,
    /// The commands that it adds to the program.
    #[cfg(feature = "cli")]
    pub tools: &'static [tools::Tool],
}

/// All protocols; the next one is a folder, and one line more.
#[doc(hidden)]
pub const PROTOCOLS: [Protocol; 5] = [
    linudp::REGISTERED,
    modbus::REGISTERED,
    ethercat::REGISTERED,
    ethernet_ip::REGISTERED,
    profibus::REGISTERED,
];
