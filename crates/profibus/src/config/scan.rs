//! Lists the stations of a wire, on a normal thread: who answers FDL status, and the diagnosis and the configuration
//! (Get_Cfg) of each. It changes nothing in them: no parametrisation, no process data.
//!
//! The wire is listened to first. While another master uses it nothing is sent, and the scan ends with its address.

use std::os::fd::RawFd;

use thiserror::Error;

use crate::line::{Answer, Expected, Incoming, Instead, Job, Line, Other, Ready};
use crate::plan::ProfibusPlan;
use crate::wire::dp::Diagnosis;
use crate::wire::sap::Service;
use crate::wire::telegram::STATION_MAX;
use fieldbeat_core::net::{Broken, Serial};
use fieldbeat_core::time::{MS, S, Time};

/// The wire is listened to for so long at least, ns: a master with a long cycle is silent in between.
const LISTEN_NS: u64 = S;
/// A wire that is not silent for long enough within this time is given up, ns.
const NOISE_NS: u64 = 5 * S;
/// How often a station that has not answered is asked again: a telegram can be lost.
const ROUNDS: u8 = 2;
/// The longest wait at a time, ns.
const LOOK_NS: u64 = 10 * MS;
/// The most reads at a time: whoever floods the port shall not keep the scan from its end.
const MOST_READS: usize = 64;
/// The first request to a slave (FCB 1, FCV 0), as of a master that begins.
const FIRST: (bool, bool) = (true, false);

/// A station that has answered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    /// Its address.
    pub address: u8,
    /// The data of its diagnosis, if it has answered with one.
    pub(super) data: Vec<u8>,
    /// The identifier bytes of the configuration that it wants (Get_Cfg); empty: it has not said.
    pub configuration: Vec<u8>,
}

impl Found {
    /// What it says of itself; `None`: it has not answered, or not with a diagnosis.
    pub fn diagnosis(&self) -> Option<Diagnosis<'_>> {
        Diagnosis::parse(&self.data)
    }
}

/// Why a scan did not complete.
#[derive(Clone, PartialEq, Eq, Error)]
pub enum ScanError {
    /// Its end was requested.
    #[error("interrupted")]
    Interrupted,
    /// The port cannot be used.
    #[error("{0}")]
    Port(String),
    /// It has gone.
    #[error("the port has failed: look at its adapter")]
    Broken,
    /// Somebody else uses the wire.
    #[error(
        "another master, address {0}, uses this wire, and a scan would disturb it: end that one first, or \
         ask it (fieldbeat status)"
    )]
    OtherMaster(u8),
    /// Something is received all the time, and it is no telegram.
    #[error(
        "the wire is not silent, and what is received on it is no telegram: name its rate (--rate), and look \
         at its termination and shield"
    )]
    Noise,
    /// Nobody is there.
    #[error(
        "no station answers; check power, cable, termination, which of its wires is which, and the rate \
         (--rate)"
    )]
    Silent,
}
fieldbeat_core::debug_as_display!(ScanError);

/// Waits until the descriptor is readable, or for so many ns, and returns the time; `None`: the end was requested.
pub(super) type Wait<'a> = &'a mut dyn FnMut(Option<RawFd>, u64) -> Option<Time>;

/// The stations that answer on the wire of `plan`, whose drives do not matter, by address.
pub fn scan(port: &mut dyn Serial, plan: &ProfibusPlan, wait: Wait<'_>) -> Result<Vec<Found>, ScanError> {
    let asked = Service::FdlStatus;
    let mut scan = Scan { line: Line::new(plan), now: Time(0), asked, found: Vec::new() };
    scan.listen(port, wait)?;
    for _ in 0..ROUNDS {
        for address in (0..=plan.highest_address.min(STATION_MAX)).filter(|own| *own != plan.address) {
            let known = scan.found.iter().any(|found| found.address == address);
            if !known && scan.ask(port, wait, Question::Status(address))? {
                scan.found.push(Found { address, data: Vec::new(), configuration: Vec::new() });
                if scan.ask(port, wait, Question::Data(address, Service::SlaveDiag))? {
                    scan.ask(port, wait, Question::Data(address, Service::GetCfg))?;
                }
            }
        }
    }
    scan.found.sort_by_key(|found| found.address);
    if scan.found.is_empty() { Err(ScanError::Silent) } else { Ok(scan.found) }
}

#[derive(Clone, Copy)]
enum Question {
    Status(u8),
    /// What this service of it reads.
    Data(u8, Service),
}

struct Scan {
    line: Line,
    now: Time,
    /// The service of the request that is under way.
    asked: Service,
    found: Vec<Found>,
}

impl Scan {
    /// Opens the port, listens, and claims the wire.
    fn listen(&mut self, port: &mut dyn Serial, wait: Wait<'_>) -> Result<(), ScanError> {
        let notes = port.notes();
        loop {
            self.now = wait(None, MS).ok_or(ScanError::Interrupted)?;
            if port.opened().is_some() {
                break;
            }
            if let Some(why) = notes.get(0) {
                return Err(ScanError::Port(why));
            }
        }
        port.discard().map_err(|_| ScanError::Broken)?;
        self.line.opened(self.now, port.is_timed());
        let begun = self.now;
        loop {
            self.take_in(port, wait)?;
            let listened = self.now.since(begun);
            if listened > NOISE_NS && !self.line.is_up() {
                return Err(ScanError::Noise);
            }
            match if listened < LISTEN_NS { Ready::Wait } else { self.line.ready(self.now) } {
                Ready::Free => return Ok(()),
                Ready::Claim => self.hand_over(port)?,
                _ => {}
            }
        }
    }

    /// Asks, and waits for what comes of it: whether the station has answered.
    fn ask(&mut self, port: &mut dyn Serial, wait: Wait<'_>, question: Question) -> Result<bool, ScanError> {
        let mut asked = false;
        loop {
            match self.line.ready(self.now) {
                Ready::Free if asked => return Ok(false),
                Ready::Free => {
                    self.put(question);
                    self.hand_over(port)?;
                    asked = true;
                }
                Ready::Resend | Ready::Claim => self.hand_over(port)?,
                Ready::Overdue { instead: Instead::Silence, failed, .. } => match port.unsent() {
                    Ok(bytes @ 1..) => self.line.still_sends(self.now, bytes, failed),
                    _ if failed => return Ok(false),
                    _ => {}
                },
                Ready::Overdue { failed: true, .. } => return Ok(false),
                Ready::Overdue { .. } | Ready::Wait => {}
            }
            if self.take_in(port, wait)? {
                return Ok(true);
            }
        }
    }

    fn put(&mut self, question: Question) {
        match question {
            Question::Status(address) => self.line.gap(address),
            Question::Data(address, service) => {
                let (fcb, fcv) = FIRST;
                self.asked = service;
                let head = service.head(address, self.line.address(), fcb, fcv);
                let saps = service.saps();
                let expected = Expected::service(address, saps, false);
                self.line.request(address, |out| Some((head.emit(&[], out)?, expected)));
            }
        }
    }

    fn hand_over(&mut self, port: &mut dyn Serial) -> Result<(), ScanError> {
        let (at, count) = port.send(0, self.line.to_send()).map_err(|_| ScanError::Broken)?;
        self.line.sent(at, count);
        Ok(())
    }

    /// Waits until the line wants to be looked at, or something arrives, and takes that in: whether the request that is
    /// under way was answered.
    fn take_in(&mut self, port: &mut dyn Serial, wait: Wait<'_>) -> Result<bool, ScanError> {
        let until = self.line.look_at(true).map_or(LOOK_NS, |at| at.since(self.now));
        self.now = wait(port.fd(), until.min(LOOK_NS)).ok_or(ScanError::Interrupted)?;
        let mut answered = false;
        for _ in 0..MOST_READS {
            let received = port.receive(0, self.line.room());
            let Some((at, count)) = received.map_err(|_: Broken| ScanError::Broken)? else { break };
            self.line.received(at, count);
            while let Some(incoming) = self.line.incoming(at) {
                match incoming {
                    Incoming::Other(Other::Master { address, .. }) => {
                        return Err(ScanError::OtherMaster(address));
                    }
                    Incoming::Answer(Job::Drive(address), answer) => {
                        answered = true;
                        let found = self.found.iter_mut().find(|found| found.address == address);
                        match (found, answer, self.asked) {
                            (Some(found), Answer::Data { data, .. }, Service::GetCfg) => {
                                found.configuration = data.to_vec();
                            }
                            (Some(found), Answer::Data { data, .. }, _) => found.data = data.to_vec(),
                            _ => {}
                        }
                    }
                    Incoming::Answer(..) => answered = true,
                    Incoming::Other(_) => {}
                }
            }
        }
        Ok(answered)
    }
}
