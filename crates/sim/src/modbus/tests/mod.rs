//! The simulated drive against the manuals, message by message, in its own time.

mod connections;
mod messages;
mod motor;
mod parameters;
mod sequencer;
mod trips;

use std::net::{Ipv4Addr, SocketAddrV4};

use super::*;
use fieldbeat_core::time::{MS, S};
use fieldbeat_modbus::parameter::{Addressing, DRIVE_UNIT, Parameter, Width};
use fieldbeat_modbus::wire::{ADU_MAX, ExceptionCode, Header, RegistersBuffer, Request, Response, function};
use fieldbeat_modbus::words::{ControlWord as C, StatusWord as W};

const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 40_000);
const RAMP: Parameter = Parameter::new(2, 11);
const POST_RAMP: Parameter = Parameter::new(2, 1);
const CURRENT: Parameter = Parameter::new(4, 1);
const USER_TRIP: Parameter = Parameter::new(10, 38);
const RESET: Parameter = Parameter::new(10, 33);
const TIMEOUT: Parameter = Parameter::new(15, 9).in_slot(4);

/// The first parameter of application menu 3 with 32 bits; 19 follow it.
const APPLICATION: Parameter = Parameter::new(20, 21);

fn parameter(text: &str) -> Parameter {
    text.parse().unwrap()
}

fn settings() -> UnidriveSettings {
    UnidriveSettings::new(SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), 502))
}

/// A drive and a master's notion of time.
struct Bench {
    sim: UnidriveSim,
    now: Time,
    transaction: u16,
    addressing: Addressing,
}

impl Bench {
    /// Connected.
    fn new(change: impl FnOnce(&mut UnidriveSettings)) -> Bench {
        let mut settings = settings();
        change(&mut settings);
        let addressing = settings.interface.addressing;
        let mut sim = UnidriveSim::new(settings);
        let now = Time(5 * S);
        assert!(sim.connect(now, MASTER));
        Bench { sim, now, transaction: 41, addressing }
    }

    /// In control by the control word, disabled.
    fn idle() -> Bench {
        Bench::idle_with(|_| {})
    }

    fn idle_with(change: impl FnOnce(&mut UnidriveSettings)) -> Bench {
        let mut bench = Bench::new(change);
        bench.write(Parameter::CONTROL_WORD_ENABLE, 1);
        bench.control(C::IDLE);
        bench
    }

    /// Enabled and at this reference, rpm, not running yet.
    fn enabled(rpm: i32) -> Bench {
        let mut bench = Bench::idle();
        bench.write(Parameter::REFERENCE, rpm * 10);
        bench.control(C::ENABLED);
        bench
    }

    /// What comes back for these bytes.
    fn raw(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut reply = Vec::new();
        let to = self.sim.receive(self.now, MASTER, bytes, &mut reply);
        assert_eq!(to.is_some(), !reply.is_empty());
        assert!(to.is_none_or(|to| to == MASTER));
        reply
    }

    /// The bytes of the next request to this unit.
    fn request(&mut self, unit: u8, request: &Request<'_>) -> Vec<u8> {
        self.transaction = self.transaction.wrapping_add(1);
        let mut bytes = vec![0; ADU_MAX];
        let size = request.emit(Header { transaction: self.transaction, unit }, &mut bytes);
        assert_ne!(size, 0);
        bytes.truncate(size);
        bytes
    }

    /// Asks, and hands the answer to `look`; the identity is checked.
    fn ask<T>(&mut self, unit: u8, request: &Request<'_>, look: impl FnOnce(Response<'_>) -> T) -> T {
        let bytes = self.request(unit, request);
        let reply = self.raw(&bytes);
        let (header, response) = Response::parse(&reply).unwrap();
        assert_eq!(header, Header { transaction: self.transaction, unit });
        assert_eq!(response.function() & !function::EXCEPTION, request.function());
        look(response)
    }

    /// The exception that a request meets.
    fn exception(&mut self, request: &Request<'_>) -> Option<ExceptionCode> {
        self.ask(DRIVE_UNIT, request, |response| match response {
            Response::Exception { code, .. } => Some(code),
            _ => None,
        })
    }

    fn address(&self, parameter: Parameter, width: Width) -> u16 {
        parameter.address(self.addressing, width).unwrap()
    }

    /// The value of a parameter.
    fn read(&mut self, parameter: Parameter) -> i32 {
        self.read_block::<1>(parameter)[0]
    }

    /// Those of several in a row.
    fn read_block<const N: usize>(&mut self, first: Parameter) -> [i32; N] {
        let read = Request::Read { address: self.address(first, Width::Long), count: 2 * N as u16 };
        self.ask(first.unit(DRIVE_UNIT), &read, |response| match response {
            Response::Read { data } => std::array::from_fn(|index| data.long(index).unwrap()),
            other => panic!("{first}: {other:?}"),
        })
    }

    /// Writes a parameter; whether the drive has taken it.
    fn try_write(&mut self, parameter: Parameter, value: i32) -> bool {
        self.write_block(parameter, &[value]) == 2
    }

    fn write(&mut self, parameter: Parameter, value: i32) {
        assert!(self.try_write(parameter, value), "{parameter} = {value}");
    }

    /// Writes several in a row; how many registers the drive has taken.
    fn write_block(&mut self, first: Parameter, values: &[i32]) -> u16 {
        let buffer = longs(values);
        let write = Request::Write { address: self.address(first, Width::Long), data: buffer.registers() };
        self.ask(first.unit(DRIVE_UNIT), &write, |response| match response {
            Response::Written { count, .. } => count,
            other => panic!("{first}: {other:?}"),
        })
    }

    /// Writes the control word, and lets the drive work for a step.
    fn control(&mut self, word: C) -> W {
        self.write(Parameter::CONTROL_WORD, word.0.into());
        self.wait(MS);
        self.status()
    }

    fn status(&mut self) -> W {
        W(self.read(Parameter::STATUS_WORD) as u16)
    }

    /// rpm.
    fn speed(&mut self) -> f64 {
        f64::from(self.read(Parameter::SPEED)) / 10.0
    }

    /// The newest trip in the log, and whether one stands.
    fn trip(&mut self) -> (i32, bool) {
        (self.read(Parameter::TRIP), !self.status().healthy())
    }

    fn wait(&mut self, ns: u64) {
        self.now = self.now + ns;
    }

    /// Power off and on; until it is back, and connected.
    fn restart(&mut self) {
        self.sim.restart(self.now);
        self.wait(S);
        assert!(self.sim.connect(self.now, MASTER));
    }

    /// Waits until the drive is there, asking each millisecond; how many.
    fn until(&mut self, what: impl Fn(W) -> bool) -> u64 {
        for waited in 0..60_000 {
            if what(self.status()) {
                return waited;
            }
            self.wait(MS);
        }
        panic!("never got there: {:?}", self.status());
    }

    /// Writes the control word and waits until the motor stands or has reached its speed; how many ms.
    fn settled(&mut self, word: C) -> u64 {
        self.control(word);
        let running = word.has_any(C::ANY_RUN);
        1 + self.until(|status| if running { status.at_speed() } else { status.zero_speed() })
    }
}

fn longs(values: &[i32]) -> RegistersBuffer {
    let mut buffer = RegistersBuffer::new();
    assert!(values.iter().all(|value| buffer.push_long(*value)));
    buffer
}
