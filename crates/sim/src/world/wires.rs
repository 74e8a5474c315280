//! Serial wires in a world: their bytes, and the master's ports.

use std::any::Any;
use std::io;
use std::os::fd::RawFd;

use super::{Inner, World, record, taken};
use crate::fault::Injected;
use crate::serial::Medium;
use crate::{FaultPlan, SerialWire, SimSerial};
use fieldbeat_core::net::link::{Action, Connection};
use fieldbeat_core::net::{Broken, LinkNotes, Serial, SerialLine, Streams};
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// A wire, and the master's port at it.
struct Rail {
    medium: Medium,
    /// The master's adapter is there.
    plugged: bool,
    carrier: Option<Carrier>,
}

/// The master's port, open or not.
struct Carrier {
    machine: Connection,
    hold: Hold,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Hold {
    Closed,
    /// It is open, and ready for the loop.
    Offered,
    Loop,
    /// The loop has it, and its adapter is gone.
    Broken,
}

impl Rail {
    fn next_due(&self) -> Option<Time> {
        let life = self.carrier.as_ref().and_then(|carrier| carrier.machine.next_due());
        [self.medium.next_due(), life].into_iter().flatten().min()
    }

    fn is_readable(&self, now: Time) -> bool {
        self.carrier.as_ref().is_some_and(|carrier| match carrier.hold {
            Hold::Loop => self.medium.is_readable(now),
            Hold::Broken => true,
            Hold::Closed | Hold::Offered => false,
        })
    }

    /// The port is opened if that is due, and its adapter is there.
    fn open(&mut self, now: Time) {
        let Some(carrier) = &mut self.carrier else { return };
        if carrier.machine.poll(now) != Action::Connect {
            return;
        }
        if self.plugged {
            self.medium.discard(now);
            carrier.hold = Hold::Offered;
            carrier.machine.connected(now);
        } else {
            let port = &self.medium.wire.port;
            carrier.machine.refused(now, format!("there is no serial port {port}: plug in its adapter"));
        }
    }
}

/// All wires.
#[derive(Default)]
pub(super) struct Wires(Vec<Rail>);

impl Wires {
    pub(super) fn new(wires: Vec<SerialWire>) -> io::Result<Wires> {
        let mut all = Wires::default();
        for wire in wires {
            if all.0.iter().any(|rail| rail.medium.wire.port == wire.port) {
                return Err(taken(&wire.port));
            }
            all.0.push(Rail { medium: Medium::new(wire), plugged: true, carrier: None });
        }
        Ok(all)
    }

    /// Something waits for a master.
    pub(super) fn readable(&self, now: Time) -> bool {
        self.0.iter().any(|rail| rail.is_readable(now))
    }

    /// When the next thing happens.
    pub(super) fn next_due(&self) -> Option<Time> {
        self.0.iter().filter_map(Rail::next_due).min()
    }
}

impl Inner {
    /// The next thing on a wire, or at a port, that is due happens; false: there is nothing.
    pub(super) fn pass_wires(&mut self, due: Time) -> bool {
        let Inner { wires, digest, delivered, now, .. } = self;
        let is_due = |rail: &&mut Rail| rail.next_due().is_some_and(|at| at <= due);
        let Some(rail) = wires.0.iter_mut().find(is_due) else { return false };
        let mut passed = |at, _, parcel: &_| {
            record(digest, at, parcel);
            *delivered += 1;
        };
        if !rail.medium.step(*now, &mut passed) {
            rail.open(*now);
        }
        true
    }
}

/// Faults of the wire at a port. Each returns false, or nothing, if there is no such wire.
impl World {
    /// Unplugs the master's adapter; what it sends and what is sent to it is lost.
    pub fn unplug_port(&self, port: &str) -> bool {
        self.with_rail(port, |rail, now| {
            rail.plugged = false;
            rail.medium.discard(now);
            if let Some(carrier) = rail.carrier.as_mut().filter(|carrier| carrier.hold != Hold::Closed) {
                carrier.hold = Hold::Broken;
            }
        })
        .is_some()
    }

    /// Plugs it in again.
    pub fn plug_port(&self, port: &str) -> bool {
        self.with_rail(port, |rail, _| rail.plugged = true).is_some()
    }

    /// Switches the drive at `place`, counted from 0, off and on again.
    pub fn restart_on(&self, port: &str, place: usize) -> bool {
        self.with_rail(port, |rail, now| rail.medium.restart(now, place)).is_some()
    }

    /// Opens the hardware enable (STO) of the drive at `place` for `ns`.
    pub fn open_sto_on(&self, port: &str, place: usize, ns: u64) -> bool {
        self.with_rail(port, |rail, now| rail.medium.open_sto(place, now + ns)).is_some()
    }

    /// The wire has the faults of `plan` from now on; its counters restart.
    pub fn set_wire_faults(&self, port: &str, plan: FaultPlan) -> bool {
        self.with_rail(port, |rail, _| rail.medium.change(plan)).is_some()
    }

    /// The faults of the wire so far.
    pub fn wire_injected(&self, port: &str) -> Option<Injected> {
        self.with_rail(port, |rail, _| rail.medium.injected())
    }

    /// Looks at the drive at `place` itself; nothing also if it is no `D`.
    pub fn look_on<D: SimSerial, R>(
        &self,
        port: &str,
        place: usize,
        look: impl FnOnce(&mut D, Time) -> R,
    ) -> Option<R> {
        self.with_rail(port, |rail, now| {
            let drive: &mut dyn Any = &mut **rail.medium.wire.drives.get_mut(place)?;
            drive.downcast_mut().map(|drive| look(drive, now))
        })?
    }

    fn with_rail<R>(&self, port: &str, f: impl FnOnce(&mut Rail, Time) -> R) -> Option<R> {
        let mut inner = self.lock();
        let now = inner.now;
        inner.wires.0.iter_mut().find(|rail| rail.medium.wire.port == port).map(|rail| f(rail, now))
    }

    pub(super) fn open_serial(&self, port: &str, line: &SerialLine) -> io::Result<SerialCarrier> {
        let mut inner = self.lock();
        let now = inner.now;
        let names = || inner.wires.0.iter().map(|rail| rail.medium.wire.port.as_str());
        let Some(index) = names().position(|name| name == port) else {
            let names: Vec<_> = names().collect();
            let message = format!("no serial wire at {port} in this world; there are: {}", names.join(", "));
            return Err(io::Error::new(io::ErrorKind::NotFound, message));
        };
        let rail = &mut inner.wires.0[index];
        if rail.carrier.is_some() {
            return Err(taken(port));
        }
        let notes = LinkNotes::new(1);
        rail.medium.set_master(line);
        rail.carrier =
            Some(Carrier { machine: Connection::of_port(now, port, notes.clone()), hold: Hold::Closed });
        drop(inner);
        Ok(SerialCarrier { world: self.clone(), index, notes, looked: false })
    }
}

/// A carrier of bytes in a world.
#[derive(Debug)]
pub(super) struct SerialCarrier {
    world: World,
    index: usize,
    notes: LinkNotes,
    looked: bool,
}

impl SerialCarrier {
    /// Works on the open port at the present instant; the time of this takes one reading of the clock.
    fn with<R>(&self, f: impl FnOnce(&mut Medium, Time) -> R) -> Result<R, Broken> {
        let mut inner = self.world.lock();
        let at = inner.read();
        let rail = &mut inner.wires.0[self.index];
        match rail.carrier.as_ref().map(|carrier| carrier.hold) {
            Some(Hold::Loop) => Ok(f(&mut rail.medium, at)),
            Some(Hold::Broken) => Err(Broken::Failed(libc::EIO)),
            _ => Err(Broken::Absent),
        }
    }
}

impl Streams for SerialCarrier {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn opened(&mut self) -> Option<usize> {
        let mut inner = self.world.lock();
        let carrier = inner.wires.0[self.index].carrier.as_mut()?;
        if carrier.hold != Hold::Offered {
            return None;
        }
        carrier.hold = Hold::Loop;
        Some(0)
    }

    fn look(&mut self) {
        self.looked = true;
    }

    fn ready(&mut self) -> Option<usize> {
        std::mem::take(&mut self.looked).then_some(0)
    }

    fn receive(&mut self, _index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        self.with(|medium, at| match medium.read(at, room) {
            0 => None,
            count => Some((at, count)),
        })
    }

    fn send(&mut self, _index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        self.with(|medium, at| (at, medium.write(at, bytes)))
    }

    fn abandon(&mut self, _index: usize, why: &'static str) {
        let mut inner = self.world.lock();
        let now = inner.now;
        let rail = &mut inner.wires.0[self.index];
        if let Some(carrier) =
            rail.carrier.as_mut().filter(|carrier| matches!(carrier.hold, Hold::Loop | Hold::Broken))
        {
            carrier.hold = Hold::Closed;
            carrier.machine.given_back(now, why);
            rail.medium.discard(now);
        }
    }

    fn notes(&self) -> LinkNotes {
        self.notes.clone()
    }

    /// Virtual time is never real time: nothing to lock.
    fn memory(&self, _regions: &mut Regions) {}
}

impl Serial for SerialCarrier {
    fn unsent(&mut self) -> Result<usize, Broken> {
        self.with(|medium, at| medium.unsent(at))
    }

    fn discard(&mut self) -> Result<(), Broken> {
        self.with(|medium, at| medium.discard(at))
    }
}

/// The port is free again. What was sent last still leaves.
impl Drop for SerialCarrier {
    fn drop(&mut self) {
        self.world.lock().wires.0[self.index].carrier = None;
    }
}

#[cfg(test)]
mod tests;
