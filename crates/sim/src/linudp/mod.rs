//! The simulated LinMot drive: the server side of LinUDP, and strict.
//!
//! Knows the wire and the manuals, not the master's station.
//!
//! | file | what |
//! |---|---|
//! | `mod` | telegrams: port, master filter, padding, silence |
//! | `codec` | telegrams, commands, codes and stored objects in bytes |
//! | `settings` | the properties of a drive, and its state at the start |
//! | `rtc` | the real-time-config channel: counts, answers, what each command does |
//! | `upids`, `parameters` | the parameters there are, and their values in ROM, in RAM and in use |
//! | `log` | the error log |
//! | `store` | curves and command table entries, and their transfer in blocks |
//! | `memory` | all of these together, and how they get into flash |
//! | `machine` | the state machine and the motor; the commands, the running command table, the drive's reports |
//! | `motion`, `stream`, `time_curve` | how motion commands determine the demand |
//!
//! The drive has no clock: on each datagram it advances by the time since the last one.
//!
//! Where the manuals are silent it takes the strict side; each file names its choices. What a master meets first:
//!
//! | case | what the drive does |
//! |---|---|
//! | motion before homing | error 0080h |
//! | a motion command in any powered state but 8 | error 0086h; below state 5 nothing |
//! | a motion command in a run mode (UPID 1450h) but 1 and 3 | error 0086h |
//! | a motion command for hardware or a software key that it does not have, one for the command table only | error 0081h, or nothing (`unknown_commands`) |
//! | a trigger, an input, a captured position | never comes, low, 0: armed commands stay armed until they are cleared |
//! | sine and Bestehorn moves while another motion runs | not run, and counted |
//! | the shape of sine, Bestehorn and jerk-limited moves | a trapezoid within their limits: what a master sees of a shape is when it ends |
//! | leaving a stream | what is still buffered is dropped |
//! | 002x to a parameter that cannot be written | nothing is written; the command has no answer |
//! | 35h, whatever the motor is doing | power off at once; both state words 0, not homed, an error stays |
//! | the control word across 35h and 36h | stays: with bit 0 set the drive is locked until it was 0 |
//! | a restart by power, by 00Fx | answers with both state words 0 until it is up |
//! | a restart by 30h | the command is answered, then silence until it is up with the stored count 0: sending it on restarts it again |

pub mod codec;
pub(super) mod config;
mod demand;
mod log;
mod machine;
mod memory;
mod motion;
mod parameters;
mod rtc;
mod settings;
mod store;
mod stream;
mod time_curve;
mod upids;

use std::net::{Ipv4Addr, SocketAddrV4};

pub use self::settings::{FlashMode, LinMotSettings, MasterFilter, UnknownCommands};

use self::codec::{MASTER_PORT, RESPONSE_MAX, Report, Request};
use self::machine::{Machine, Taken};
use self::rtc::{After, Channel};
use crate::{FaultPlan, SimBus, SimDrive, Simulated, Truth};
use fieldbeat_core::time::{MS, Time};

/// From power-on until the motion software runs; until then status word and state variable are 0.
const BOOT_NS: u64 = 100 * MS;

/// Room for the longest answer and the largest padding.
const IMAGE: usize = 64;
const _: () = assert!(RESPONSE_MAX <= IMAGE);

/// Requests that the drive did not answer. This protocol has no negative answer: the master receives nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Ignored {
    /// Not from the master's port.
    pub wrong_port: u64,
    /// Shorter than their definitions.
    pub malformed: u64,
    /// From a master that the filter does not let through.
    pub filtered: u64,
    /// Requests while it wrote into its flash, or restarted.
    pub deaf: u64,
}

/// The simulated drives of a LinUDP bus.
#[derive(Clone, Debug, PartialEq)]
pub struct LinMots(pub Vec<LinMotSettings>);

impl SimBus for LinMots {
    fn build(&self, to: &mut Simulated) {
        to.drives
            .extend(self.0.iter().map(|drive| Box::new(LinMotSim::new(drive.clone())) as Box<dyn SimDrive>));
    }
}

/// One simulated LinMot drive.
#[derive(Debug)]
pub struct LinMotSim {
    settings: LinMotSettings,
    /// The one master of the filter that latches.
    master: Option<Ipv4Addr>,
    machine: Machine,
    booted_at: Time,
    /// Receives nothing until then.
    deaf_until: Time,
    channel: Channel,
    /// The last answer. The padding of the next one is its remainder, as seen on real drives.
    image: [u8; IMAGE],
    ignored: Ignored,
}

impl LinMotSim {
    /// The drive as set up: switched off and in state 0, or running if the settings say so. Its time begins with the
    /// first datagram.
    pub fn new(settings: LinMotSettings) -> LinMotSim {
        LinMotSim {
            master: None,
            machine: Machine::new(&settings),
            booted_at: Time(0),
            deaf_until: Time(0),
            channel: Channel::new(settings.config_time_ns),
            image: [0; IMAGE],
            ignored: Ignored::default(),
            settings,
        }
    }

    /// Raises an error of the drive, as if its hardware had: a moving motor is quick-stopped, then state 4. A fatal one
    /// needs a restart.
    pub fn provoke(&mut self, code: u16) {
        self.machine.fail(code);
    }

    /// The requests that it left unanswered so far.
    pub fn ignored(&self) -> Ignored {
        self.ignored
    }

    /// Sine and Bestehorn moves that it did not run because another motion was still running.
    pub fn refused_moves(&self) -> u64 {
        self.machine.setpoints.refused
    }

    /// The real state at `now`.
    pub fn truth(&mut self, now: Time) -> Truth {
        self.machine.advance(now);
        self.machine.truth()
    }

    fn lets_through(&mut self, master: Ipv4Addr) -> bool {
        match self.settings.filter {
            MasterFilter::None => true,
            MasterFilter::Single => *self.master.get_or_insert(master) == master,
            MasterFilter::Fixed(only) => only == master,
        }
    }

    /// Takes in the content of a request; returns what follows once it has been answered.
    fn take(&mut self, request: &Request, now: Time) -> After {
        let after = match &request.config {
            Some(config) => self.channel.take(config, &mut self.machine, now),
            None => After::Nothing,
        };
        if now < self.booted_at {
            return after;
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
        after
    }

    /// The answer, padded, in the image.
    fn answer(&mut self, request: &Request, now: Time) -> &[u8] {
        let machine = &self.machine;
        let saving = machine.memory.saving_until().is_some();
        let config = request.config.map(|_| self.channel.answer(now, saving));
        let mut report = Report { config, ..machine.report() };
        if now < self.booted_at {
            (report.status, report.state) = (0, 0);
        }
        let size = report.write(request.definitions, &mut self.image).max(self.settings.padding.min(IMAGE));
        &self.image[..size]
    }
}

impl SimDrive for LinMotSim {
    fn address(&self) -> SocketAddrV4 {
        self.settings.address
    }

    fn faults(&self) -> FaultPlan {
        self.settings.faults.clone()
    }

    fn receive(
        &mut self,
        now: Time,
        from: SocketAddrV4,
        bytes: &[u8],
        reply: &mut Vec<u8>,
    ) -> Option<SocketAddrV4> {
        self.machine.advance(now);
        if from.port() != MASTER_PORT {
            self.ignored.wrong_port += 1;
            return None;
        }
        let Some(request) = Request::parse(bytes) else {
            self.ignored.malformed += 1;
            return None;
        };
        if !self.lets_through(*from.ip()) {
            self.ignored.filtered += 1;
            return None;
        }
        if now < self.deaf_until {
            self.ignored.deaf += 1;
            return None;
        }
        let after = self.take(&request, now);
        reply.extend_from_slice(self.answer(&request, now));
        if after == After::Restart {
            self.restart(now);
            self.deaf_until = self.booted_at;
        } else if let Some(until) = self.machine.memory.silent_until() {
            self.deaf_until = until;
        }
        (after != After::Silence).then_some(from)
    }

    fn open_sto(&mut self, until: Time) {
        self.machine.open_sto(until);
    }

    fn restart(&mut self, now: Time) {
        self.machine.advance(now);
        self.machine.power_up();
        self.booted_at = now + BOOT_NS;
        self.deaf_until = Time(0);
        self.master = None;
        self.channel = Channel::new(self.settings.config_time_ns);
        self.image = [0; IMAGE];
    }
}

#[cfg(test)]
mod tests;
