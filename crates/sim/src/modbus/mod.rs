//! The simulated Unidrive: the server side of Modbus TCP, and strict.
//!
//! Knows the wire and the manuals, not the master's station.
//!
//! | file | what |
//! |---|---|
//! | `codec` | messages, addresses, bits and trips |
//! | `settings` | the properties of a drive, and its state at the start |
//! | `table`, `database` | the parameters, and their values; what menu 0 shows |
//! | `sequencer` | control word, hardware enable, trips, watchdogs |
//! | `motor` | the ramp, and the motor that follows it |
//! | `drive` | these together: reading and writing parameters, the status word |
//! | `server` | connections, messages, functions, exceptions |
//!
//! The drive has no clock: on each message it advances by the time since the last one, in whole steps of a
//! millisecond.
//!
//! Where the manuals are silent it takes the strict side; `sequencer`, `database` and `server` name their choices.
//! What a master meets first:
//!
//! | case | what the drive does |
//! |---|---|
//! | 06.043 = 0, as delivered | the control word does nothing at all |
//! | a negative reference, as delivered (01.010 = 0) | stands still; run in reverse, or set 01.010 |
//! | a trip is reset while a run bit stands | runs again, at once |
//! | Modbus timeout S.15.009, 0 as delivered | supervises from the first request after the write; its trip is "slot error" |
//! | a new addressing mode (S.15.013) | counts from the next start on |
//! | a write that was not saved | is lost at a restart |

pub mod codec;
pub(super) mod config;
mod database;
mod drive;
mod motor;
mod sequencer;
mod server;
mod settings;
mod table;

use std::net::SocketAddrV4;

pub use self::settings::{Interface, MotorSettings, ReadWrite, Start, UnidriveSettings};

use self::drive::Drive;
use self::server::Server;
use crate::{Carrier, FaultPlan, SimBus, SimDrive, Simulated, Truth};
use fieldbeat_core::time::Time;

/// The simulated drives of a Modbus TCP bus.
#[derive(Clone, Debug, PartialEq)]
pub struct Unidrives(pub Vec<UnidriveSettings>);

impl SimBus for Unidrives {
    fn build(&self, to: &mut Simulated) {
        to.drives.extend(
            self.0.iter().map(|drive| Box::new(UnidriveSim::new(drive.clone())) as Box<dyn SimDrive>),
        );
    }
}

/// One simulated Unidrive.
#[derive(Debug)]
pub struct UnidriveSim {
    settings: UnidriveSettings,
    drive: Drive,
    server: Server,
    /// Does not receive until then.
    booted_at: Time,
}

impl UnidriveSim {
    /// The drive as set up, listening. Its time begins with the first message.
    pub fn new(settings: UnidriveSettings) -> UnidriveSim {
        UnidriveSim {
            drive: Drive::new(&settings),
            server: Server::new(&settings.interface),
            settings,
            booted_at: Time(0),
        }
    }

    /// Trips the drive, as if its hardware had.
    pub fn provoke(&mut self, trip: u16) {
        self.drive.trip(trip);
    }

    /// The connections that it holds.
    pub fn connections(&self) -> usize {
        self.server.connections()
    }

    /// The real state at `now`; counts are revolutions. This is no request of a master to the drive's time-out.
    pub fn truth(&mut self, now: Time) -> Truth {
        self.drive.advance(now);
        self.drive.truth()
    }
}

impl SimDrive for UnidriveSim {
    fn address(&self) -> SocketAddrV4 {
        self.settings.address
    }

    fn faults(&self) -> FaultPlan {
        self.settings.faults.clone()
    }

    fn carrier(&self) -> Carrier {
        Carrier::Stream
    }

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.drive.advance(now);
        self.server.take(from, bytes, &mut self.drive, reply);
        (!reply.is_empty()).then_some(from)
    }

    fn connect(&mut self, now: Time, from: SocketAddrV4) -> bool {
        self.drive.advance(now);
        now >= self.booted_at && self.server.connect(from)
    }

    fn hangs_up(&mut self, from: SocketAddrV4) -> bool {
        self.server.hangs_up(from)
    }

    fn disconnected(&mut self, now: Time, from: SocketAddrV4) {
        self.drive.advance(now);
        self.server.disconnect(from);
    }

    fn mislabel(&self, reply: &mut [u8]) {
        // Half the range away from every identity in use.
        if let Some(high) = reply.first_mut() {
            *high ^= 0x80;
        }
    }

    fn restart(&mut self, now: Time) {
        self.drive.advance(now);
        self.drive.restart();
        self.server.disconnect_all();
        self.booted_at = now + self.settings.boot_ns;
    }

    fn open_sto(&mut self, until: Time) {
        self.drive.open_sto(until);
    }
}

#[cfg(test)]
mod tests;
