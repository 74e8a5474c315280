//! The runtime of Fieldbeat: the cyclic loop, the drive machine, and what both of them stand on. No protocol, no file.
//!
//! A program uses it through the package `fieldbeat`, which re-exports what an application needs. What else is public
//! here is for the wires, the simulated drives and the program, and changes with them.
//!
//! | module | what |
//! |---|---|
//! | [`cycle`] | the loop: grid, order of a cycle, overruns, records; it knows drives and buses, no motion |
//! | [`drive`] | one drive machine for all protocols: commands in, desired state out |
//! | [`bus`] | the contract between the loop and a protocol |
//! | [`axis`] | what an application holds: handles, commands, feedback, events, units |
//! | [`logged`] | carriers and clocks whose results are recorded, and replayed |
//! | [`net`] | sockets and descriptors: UDP, TCP, frames, serial ports |
//! | [`inputs`] | what the loop takes from outside, recorded by construction |
//! | [`rt`] | the operating system: FIFO, core, memory lock, clock |
//!
//! Arrows point down: `cycle` -> `drive` -> `bus` -> `axis`, `net` -> `inputs`, `rt`.

pub mod axis;
pub mod bus;
pub mod cycle;
pub mod drive;
pub mod errors;
pub mod inputs;
pub mod logged;
pub mod named;
pub mod net;
pub mod packed;
pub mod rt;
#[cfg(feature = "serde")]
mod serialised;
pub mod sync;
pub mod time;
