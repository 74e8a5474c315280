//! A simulated segment: slave controllers (ESC) from the other end of the wire, and strict.
//!
//! Knows the wire and the standard (ETG.1000.4, .6), not the master's side of the segment.
//!
//! | file | what |
//! |---|---|
//! | `segment` | slaves in order; carries a frame through all of them |
//! | `topology` | the cables between them: ports, branches, propagation delays, a cut |
//! | `hardware` | the settings of one slave |
//! | `esc` | one slave: its controller and its firmware; the commands of a datagram |
//! | `chip` | registers and memory: access rights, and the effects of an access |
//! | `manager` | SyncManagers: mailboxes and process data |
//! | `clock` | the distributed clock: drift, compensation, SYNC0 |
//! | `codec` | frames, registers, the SII, the mailbox, objects and CiA 402, as a slave reads them |
//! | `sii` | the EEPROM, and images for it |
//! | `firmware` | the EtherCAT state machine, the mailbox, the cycle of the application |
//! | `simulation` | the segment of a plan |
//! | `settings` | the settings of a drive and a segment |
//! | `slave` | what sets one slave apart: its SII, how another master left it |
//! | `models` | couplers and terminals as they can be bought |
//! | `drive` | the firmware of a drive behind its slave controller: states, process data, CiA 402, modes, faults |
//! | `objects`, `mapping` | its objects and which of them can be written; PDOs that the master maps |
//! | `mailbox` | SDOs of four bytes and of more, emergencies |
//! | `sync` | whether the cycle of the bus is regular enough |
//! | `coupler` | an application: plain digital and analogue I/O |
//! | `analogue` | an application: an analogue input terminal with a mailbox |
//!
//! A slave has no thread: when a frame passes it advances by the time since the last one. Where the standard leaves
//! a choice it takes the strict side:
//!
//! | case | what the slave does |
//! |---|---|
//! | AL control is written again before the firmware has read it | does not take it: working counter 0 |
//! | a slave without a mailbox, unless it is a drive | has no processor: AL status is what AL control says |
//! | an error is present | every request is ignored but one that acknowledges it |
//! | process data below SAFEOP, the mailbox in INIT | locked: working counter 0 |
//! | the three buffers of process data reach into another SyncManager's | refuses SAFEOP: 0x0017 |
//! | start, length or control of a SyncManager are written while it is on | nothing changes |
//! | start or cycle of SYNC0 are written while it runs, or it is switched on again | counted, and nothing changes |
//! | a start of SYNC0 that has passed, or an offset that skips it | there is none: until the clock has wrapped around, if it has 32 bits |
//! | SAFEOP to OP before it is synchronous | AL code 001Ah, fault F28 |
//! | two cycles in a row outside of the window | SAFEOP, AL code 001Ah, fault F28: stops, power off |
//! | OP is left by request | quick stop, then power off; the control word is ignored until OP |
//! | 000Fh while ready to switch on | nothing: 0007h has to come first |
//! | bit 7 is set already when OP is reached | no reset: the edge counts |
//! | a mapped object is written by SDO in SAFEOP or OP | abort 06010006h |
//! | mode 7 without bit 4 of the control word | holds its position |

mod analogue;
mod chip;
mod clock;
pub mod codec;
pub(super) mod config;
pub mod coupler;
pub mod drive;
pub mod esc;
mod firmware;
pub mod hardware;
mod mailbox;
mod manager;
mod mapping;
mod models;
mod objects;
pub mod segment;
mod settings;
pub mod sii;
mod simulation;
mod slave;
mod sync;
#[cfg(test)]
mod tests;
mod topology;

use std::fmt::Debug;

pub use self::chip::Misuse;
pub use self::codec::registers::AlState;
pub use self::codec::sii::Identity;
pub use self::coupler::Coupler;
pub use self::esc::Esc;
pub use self::hardware::Settings;
pub use self::segment::Segment;
pub use drive::Drive;
pub use models::Model;
pub use settings::{Dialect, DriveSettings, MotorSettings, SegmentSettings};
pub use simulation::{EthercatSegment, EthercatSim};
pub use slave::{ClockKind, Left, MailboxSettings, SiiContent, SiiSettings, SlaveSettings};
pub use topology::Behind;

use fieldbeat_core::time::Time;

/// The part of a slave's firmware behind its controller.
pub trait Application: Debug + Send {
    /// Takes the master's message from the mailbox, the whole buffer: after the message there are older bytes.
    /// Writes the answer, or a message that precedes it, into `reply` (empty when called); false: there is none.
    /// The application has to recognise a repetition itself.
    fn mailbox(&mut self, request: &[u8], reply: &mut Vec<u8>) -> bool;

    /// Whether it can enter `state`. Called when the controller has no objection; with a yes the state is entered.
    /// The refusal 0 means not yet: it is called again. For a state below its own the answer does
    /// not count, nor for SAFEOP when the watchdog forces it out of OP.
    fn may_enter(&mut self, now: Time, state: AlState) -> Result<(), u16>;

    /// Runs a cycle, in SAFEOP and OP: with SYNC0, or with each output if there is no SYNC0, or with each frame if
    /// there are no outputs. `outputs` is empty as long as none count: below OP, and until they have come. `inputs`
    /// holds its last inputs.
    fn process(&mut self, now: Time, outputs: &[u8], inputs: &mut [u8]);

    /// Checks SyncManagers for so many bytes of outputs and inputs. Called on the way to SAFEOP and to OP.
    fn check_sizes(&self, _outputs: usize, _inputs: usize) -> Result<(), u16> {
        Ok(())
    }

    /// Writes the next message that waits for the master into `message` (empty when called); false: there is none.
    /// Called when the mailbox is empty.
    fn message(&mut self, _message: &mut Vec<u8>) -> bool {
        false
    }

    /// Why it left OP by itself, returned once: it is in SAFEOP now.
    fn dropped(&mut self) -> Option<u16> {
        None
    }

    /// Time has advanced to `now`, with or without a cycle.
    fn advance(&mut self, _now: Time) {}

    /// Writes its inputs as they are, on the way to SAFEOP, before its first cycle there.
    fn actual(&mut self, _inputs: &mut [u8]) {}

    /// Clears the bits of its outputs that no channel has.
    fn trim(&self, _outputs: &mut [u8]) {}

    /// Outputs of another slave that are wired to its inputs.
    fn sense(&self, _levels: &[u8], _inputs: &mut [u8]) {}

    /// Another master has left it in `state`.
    fn left_in(&mut self, _state: AlState) {}

    /// Power cycle: everything volatile is lost.
    fn restart(&mut self, _now: Time) {}

    /// The drive, if there is one.
    fn drive(&mut self) -> Option<&mut Drive> {
        None
    }
}
