//! The simulated LinMot drive: the server side of LinUDP, and strict.
//!
//! Knows the wire and the manuals, not the master's station.
//!
//! | file | what |
//! |---|---|
//! | `mod` | telegrams: port, master filter, padding, real-time config |
//! | `machine` | the drive's state machine and its motor |
//! | `motion` | what motion commands make of the demand |
//!
//! The drive has no clock: on each datagram it lives through the time since the last one. It has no parameters, curves
//! or command table: the real-time-config channel echoes its count, finishes the command that does nothing, and answers
//! everything else with "UPID error"; curves and table entries are errors 0062h and 008Ah.
//!
//! Where the manuals are silent it takes the strict side: motion commands before homing are error 0080h, commands in
//! any powered state but 8 are error 0086h, leaving a stream drops what is still buffered.

mod machine;
mod motion;

use std::net::{Ipv4Addr, SocketAddrV4};

use self::machine::{Machine, Taken};
use super::plan::{LinUdpDrive, MASTER_PORT, MasterFilter};
use super::wire::{ErrorCode, RESPONSE_MAX, Request, Response, RtcBlock, StateVar, StatusWord};
use crate::sim::{DatagramDrive, FaultPlan};
use crate::time::{MS, S, Time, US};

/// From power-on until the motion software runs; until then status word and state variable are 0.
const BOOT_NS: u64 = 100 * MS;

/// One step of motor and state machine; also the drive's reaction time.
const STEP_NS: u64 = 500 * US;
/// After a silence the drive lives through so much of it in steps of [`STEP_NS`] ...
const FINE_NS: u64 = S;
/// ... and through the rest in at most so many longer ones. By then every stream has run dry and every stop has ended,
/// and profiles do not depend on the step.
const COARSE_STEPS: u64 = 1_000;

/// Room for the longest answer and the largest padding.
const IMAGE: usize = 64;
const _: () = assert!(RESPONSE_MAX <= IMAGE);

/// What the drive did not answer. There is no negative answer in this protocol: the master hears nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Ignored {
    /// Not from the master's port.
    pub wrong_port: u64,
    /// Shorter than their definitions.
    pub malformed: u64,
    /// From a master that the filter does not let through.
    pub filtered: u64,
}

/// One simulated LinMot drive.
#[derive(Debug)]
pub struct LinMotSim {
    address: SocketAddrV4,
    faults: FaultPlan,
    filter: MasterFilter,
    padding: usize,
    /// The one master of the filter that latches.
    master: Option<Ipv4Addr>,
    machine: Machine,
    /// The instant that the drive has lived up to.
    lived: Option<Time>,
    booted_at: Time,
    /// The last answer on the real-time-config channel, with its count.
    config: RtcBlock,
    /// The last answer. The padding of the next one is what is left of it, as met on real drives.
    image: [u8; IMAGE],
    ignored: Ignored,
}

impl LinMotSim {
    /// The drive as planned: switched off and in state 0, or running if the plan says so. Its time begins with the
    /// first datagram.
    pub fn new(drive: &LinUdpDrive) -> LinMotSim {
        let plan = &drive.simulate;
        LinMotSim {
            address: drive.address,
            faults: plan.faults.clone(),
            filter: plan.filter,
            padding: plan.padding.min(IMAGE),
            master: None,
            machine: Machine::new(plan),
            lived: None,
            booted_at: Time(0),
            config: RtcBlock::default(),
            image: [0; IMAGE],
            ignored: Ignored::default(),
        }
    }

    /// Raises an error of the drive, as if its hardware had: a moving motor is quick-stopped, then state 4. A fatal one
    /// needs a restart.
    pub fn provoke(&mut self, code: ErrorCode) {
        self.machine.fail(code);
    }

    /// What it did not answer so far.
    pub fn ignored(&self) -> Ignored {
        self.ignored
    }

    /// Sine and Bestehorn moves that it did not run because another motion was still running.
    pub fn refused_moves(&self) -> u64 {
        self.machine.setpoints.refused
    }

    /// Lives up to `now`.
    fn live(&mut self, now: Time) {
        let mut at = self.lived.unwrap_or(now);
        let fine_end = at + FINE_NS;
        let coarse_ns = (now.since(fine_end) / COARSE_STEPS).max(STEP_NS);
        while at < now {
            let dt_ns = now.since(at).min(if at < fine_end { STEP_NS } else { coarse_ns });
            at = at + dt_ns;
            self.machine.step(at, dt_ns);
        }
        self.lived = Some(at);
    }

    fn lets_through(&mut self, master: Ipv4Addr) -> bool {
        match self.filter {
            MasterFilter::None => true,
            MasterFilter::Single => *self.master.get_or_insert(master) == master,
            MasterFilter::Fixed(only) => only == master,
        }
    }

    fn take(&mut self, request: &Request, now: Time) {
        if let Some(config) = &request.config {
            self.configure(config);
        }
        if now < self.booted_at {
            return;
        }
        if let Some(control) = request.control {
            self.machine.set_control(control, now);
        }
        if let Some(motion) = &request.motion {
            match self.machine.command(motion, now) {
                Taken::Done => {}
                Taken::Restart => self.restart(now),
            }
        }
    }

    /// A command on the real-time-config channel is run if its count is new.
    fn configure(&mut self, request: &RtcBlock) {
        if request.count() == self.config.count() {
            return;
        }
        self.config = match request.code {
            RtcBlock::NO_OPERATION => RtcBlock::command(request.count(), RtcBlock::DONE),
            _ => RtcBlock {
                words: [request.words[0], 0, 0],
                ..RtcBlock::command(request.count(), RtcBlock::UPID_ERROR)
            },
        };
    }

    /// The answer, padded, in the image.
    fn answer(&mut self, request: &Request, now: Time) -> &[u8] {
        let machine = &self.machine;
        let booting = now < self.booted_at;
        let response = Response {
            request_def: request.definition(),
            response_def: request.response_def,
            status: Some(if booting { StatusWord(0) } else { machine.status() }),
            state: Some(if booting { StateVar(0) } else { machine.state() }),
            actual: Some(machine.actual_position()),
            demand: Some(machine.demand_position()),
            current: Some(machine.current()),
            warn: Some(machine.warn()),
            error: Some(machine.error()),
            monitor: Some(machine.monitor()),
            config: Some(self.config),
        };
        let size = response.emit(&mut self.image).max(self.padding);
        &self.image[..size]
    }
}

impl DatagramDrive for LinMotSim {
    fn address(&self) -> SocketAddrV4 {
        self.address
    }

    fn faults(&self) -> FaultPlan {
        self.faults.clone()
    }

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.live(now);
        if from.port() != MASTER_PORT {
            self.ignored.wrong_port += 1;
            return None;
        }
        let Ok(request) = Request::parse(bytes) else {
            self.ignored.malformed += 1;
            return None;
        };
        if !self.lets_through(*from.ip()) {
            self.ignored.filtered += 1;
            return None;
        }
        self.take(&request, now);
        reply.extend_from_slice(self.answer(&request, now));
        Some(from)
    }

    fn inhibit(&mut self, until: Time) {
        self.machine.inhibit(until);
    }

    fn restart(&mut self, now: Time) {
        self.live(now);
        self.machine.power_up();
        self.booted_at = now + BOOT_NS;
        self.master = None;
        self.config = RtcBlock::default();
        self.image = [0; IMAGE];
    }
}

#[cfg(test)]
mod tests;
