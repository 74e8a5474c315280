//! The contract between the loop and a protocol.
//!
//! | file | what |
//! |---|---|
//! | `contract` | [`Bus`]: an open bus on the real-time thread, and what passes between it and the loop |
//! | `desired` | what the loop wants of a drive, and what shows that the drive has it |
//! | `calls` | [`Calls`]: the acyclic calls to a drive, as the executor of its wire holds them |
//! | `counters` | exact counts of a drive's exchanges, and of what belongs to no drive |
//! | `diagnosis` | why a drive is not online, from these counts |
//! | `prepared` | [`Prepared`]: what is built and has not left |
//! | `plan`, `error` | [`BusPlan`]: a bus as configured, before any socket is open; why it cannot be opened |
//! | `facts` | what a plan knows before the start, computed once |
//! | `last` | what stops its drives without the loop |
//! | `load` | what its exchanges put on its wire |
//! | `native` | the native process data of a drive, for the application and for a recording |
//! | `notes` | what is wrong by a wire's own names, from the loop to normal threads |
//! | `drives` | what the buses of all protocols do with their drives |
//! | `reader`, `cia402` | what their wires have in common: values from bytes, the states in a status word |
//! | `variant` | a bus in a machine that is otherwise like its own |

pub mod calls;
pub mod cia402;
pub mod contract;
pub mod counters;
pub mod desired;
pub mod diagnosis;
pub mod drives;
mod error;
pub mod facts;
pub mod last;
pub mod load;
pub mod native;
pub mod notes;
mod plan;
pub mod prepared;
pub mod reader;
pub mod variant;

pub use self::calls::Calls;
pub use self::contract::{Bus, Cycle, Earlier, Exchange, MOST_EARLIER, Notes, Opened, Slot, Waits};
pub use self::counters::{BusClock, BusNumbers, Counters, OwnCounter, ProtocolCounters, Unmatched};
pub use self::drives::{DeviceEnds, DriveEnds, Ends};
pub use self::error::OpenError;
pub use self::facts::{BusFacts, DriveFacts, ReplyWithin};
pub use self::last::LastResort;
pub use self::plan::{BusPlan, Grid, unwatched};
pub use self::prepared::Prepared;
