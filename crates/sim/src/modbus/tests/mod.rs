//! The simulated drive against the manuals, message by message, in its own time. Here the master's side, which builds
//! and reads messages by itself.

mod connections;
mod messages;
mod motor;
mod parameters;
mod sequencer;
mod trips;

use std::net::{Ipv4Addr, SocketAddrV4};

use super::codec::{DRIVE_UNIT, Exception, control as C, function, status as W};
use super::*;
use fieldbeat_core::time::{MS, S};

const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 40_000);

/// Menu and number of a parameter.
type Parameter = [u16; 2];
const REFERENCE_SELECTOR: Parameter = [1, 14];
const REFERENCE: Parameter = [1, 21];
const POST_RAMP: Parameter = [2, 1];
const RAMP: Parameter = [2, 11];
const SPEED: Parameter = [3, 2];
const CURRENT: Parameter = [4, 1];
const LOAD: Parameter = [4, 20];
const CONTROL_WORD: Parameter = [6, 42];
const CONTROL_WORD_ENABLE: Parameter = [6, 43];
const TRIP: Parameter = [10, 20];
const RESET: Parameter = [10, 33];
const USER_TRIP: Parameter = [10, 38];
const STATUS_WORD: Parameter = [10, 40];
const FIRMWARE: Parameter = [11, 29];
/// The first parameter of application menu 3 with 32 bits; 19 follow it.
const APPLICATION: Parameter = [20, 21];

/// Of the interface.
const TIMEOUT: Parameter = [15, 9];
const ADDRESSING: Parameter = [15, 13];

const RESETTING: u16 = C::IDLE | C::RESET;

/// A drive and a master's notion of time.
struct Bench {
    sim: UnidriveSim,
    now: Time,
    transaction: u16,
    /// Parameters of a menu.
    each: u16,
}

impl Bench {
    /// Connected.
    fn new(change: impl FnOnce(&mut UnidriveSettings)) -> Bench {
        let mut settings = UnidriveSettings::new(SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 2), 502));
        change(&mut settings);
        let each = if settings.interface.modified { 256 } else { 100 };
        let mut sim = UnidriveSim::new(settings);
        let now = Time(5 * S);
        assert!(sim.connect(now, MASTER));
        Bench { sim, now, transaction: 41, each }
    }

    /// In control by the control word, disabled.
    fn idle() -> Bench {
        Bench::idle_with(|_| {})
    }

    fn idle_with(change: impl FnOnce(&mut UnidriveSettings)) -> Bench {
        let mut bench = Bench::new(change);
        bench.write(CONTROL_WORD_ENABLE, 1);
        bench.control(C::IDLE);
        bench
    }

    /// Enabled and at this reference, rpm, not running yet.
    fn enabled(rpm: i32) -> Bench {
        let mut bench = Bench::idle();
        bench.write(REFERENCE, rpm * 10);
        bench.control(C::ENABLED);
        bench
    }

    /// The answer to these bytes.
    fn raw(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut reply = Vec::new();
        let to = self.sim.receive(self.now, MASTER, bytes, &mut reply);
        assert_eq!(to, (!reply.is_empty()).then_some(MASTER));
        reply
    }

    /// The next request, of words and the data behind them; the answer behind its function, or its exception. No answer
    /// at all is no data.
    fn ask(&mut self, unit: u8, function: u8, words: &[u16], data: &[u8]) -> Result<Vec<u8>, u8> {
        self.transaction = self.transaction.wrapping_add(1);
        let mut bytes = Vec::new();
        let length = (2 + 2 * words.len() + data.len()) as u16;
        [self.transaction, 0, length].iter().for_each(|word| bytes.extend(word.to_be_bytes()));
        bytes.extend([unit, function]);
        words.iter().for_each(|word| bytes.extend(word.to_be_bytes()));
        bytes.extend(data);
        let reply = self.raw(&bytes);
        let Some(([a, b, c, d, high, low, to, answered], rest)) = reply.split_first_chunk() else {
            return Ok(Vec::new());
        };
        assert_eq!(([*a, *b, *c, *d], *to), ([bytes[0], bytes[1], 0, 0], unit));
        assert_eq!(usize::from(u16::from_be_bytes([*high, *low])), 2 + rest.len());
        match *answered {
            _ if *answered == function => Ok(rest.to_vec()),
            _ if *answered == function | 0x80 => Err(rest[0]),
            other => panic!("function {other}"),
        }
    }

    /// Of a parameter with 32-bit access.
    fn address(&self, [menu, number]: Parameter) -> u16 {
        0x4000 + menu * self.each + number - 1
    }

    /// The value of a parameter.
    fn read(&mut self, parameter: Parameter) -> i32 {
        self.read_block::<1>(parameter)[0]
    }

    /// The values of several in a row.
    fn read_block<const N: usize>(&mut self, first: Parameter) -> [i32; N] {
        let data = self.ask(unit(first), function::READ, &[self.address(first), 2 * N as u16], &[]).unwrap();
        assert_eq!(usize::from(data[0]), 4 * N);
        let (values, _) = data[1..].as_chunks();
        std::array::from_fn(|index| i32::from_be_bytes(values[index]))
    }

    /// Writes a parameter; whether the drive has taken it.
    fn try_write(&mut self, parameter: Parameter, value: i32) -> bool {
        self.write_block(parameter, &[value]) == Ok(2)
    }

    fn write(&mut self, parameter: Parameter, value: i32) {
        assert!(self.try_write(parameter, value), "{parameter:?} = {value}");
    }

    /// Writes several in a row; how many registers the drive has taken, or its exception.
    fn write_block(&mut self, first: Parameter, values: &[i32]) -> Result<u16, u8> {
        let address = self.address(first);
        let reply =
            self.ask(unit(first), function::WRITE, &[address, 2 * values.len() as u16], &longs(values))?;
        assert_eq!(reply[..2], address.to_be_bytes());
        Ok(u16::from_be_bytes([reply[2], reply[3]]))
    }

    /// Writes the control word, and lets the drive work for a step.
    fn control(&mut self, word: u16) -> u16 {
        self.write(CONTROL_WORD, word.into());
        self.wait(MS);
        self.status()
    }

    fn status(&mut self) -> u16 {
        self.read(STATUS_WORD) as u16
    }

    fn is(&mut self, bits: u16) -> bool {
        self.status() & bits == bits
    }

    /// rpm.
    fn speed(&mut self) -> f64 {
        f64::from(self.read(SPEED)) / 10.0
    }

    /// The newest trip in the log, and whether one stands.
    fn trip(&mut self) -> (i32, bool) {
        (self.read(TRIP), !self.is(W::HEALTHY))
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

    /// Waits until these bits are set, asking each millisecond; how many.
    fn until(&mut self, bits: u16) -> u64 {
        for waited in 0..60_000 {
            if self.is(bits) {
                return waited;
            }
            self.wait(MS);
        }
        panic!("never got there: {:04X}h", self.status());
    }

    /// Writes the control word and waits until the motor stands or has reached its speed.
    fn settled(&mut self, word: u16) {
        self.control(word);
        let runs = word & (C::RUN_FORWARD | C::RUN_REVERSE) != 0;
        self.until(if runs { W::AT_SPEED } else { W::ZERO_SPEED });
    }
}

/// The unit of a parameter: the interface, or the drive.
fn unit([menu, _]: Parameter) -> u8 {
    if menu == 15 { 4 } else { DRIVE_UNIT }
}

/// The data of a write, with its size in front.
fn longs(values: &[i32]) -> Vec<u8> {
    let data = values.iter().flat_map(|value| value.to_be_bytes());
    [4 * values.len() as u8].into_iter().chain(data).collect()
}
