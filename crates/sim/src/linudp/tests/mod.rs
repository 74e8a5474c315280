//! The drive as a master meets it: telegrams in, telegrams out, in virtual time. Here the master's side, which builds
//! and reads telegrams by itself.

mod commands;
mod curve;
mod rtc;
mod sequence;
mod states;
mod store;
mod stream;
mod telegram;

use super::codec::channel::{ConfigBlock, Refusal, command as C, status as channel};
use super::codec::commands::{layout, width};
use super::codec::{DRIVE_PORT, Motion, control, errors, state, status, sub_state};
use super::demand::Vad;
use super::*;
use fieldbeat_core::time::{S, US};

const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(127, 1, 1, 1), MASTER_PORT);

/// Response definitions: status to error; and with the monitoring channels.
const CYCLIC: u32 = 0x7F;
const MONITORED: u32 = 0xFF;

/// 10 mm in wire counts.
const CM: i32 = 100_000;
/// 0.5 m/s, 10 m/s2.
const VAD: Vad = Vad { velocity: 500_000, acceleration: 1_000_000, deceleration: 1_000_000 };

const DONE: u8 = channel::DONE;

/// A motion command with these fields; those of an unknown one are none.
fn motion(id: u16, values: &[i64]) -> Motion {
    let mut bytes = Vec::new();
    for (letter, value) in layout(id).unwrap_or_default().chars().zip(values) {
        bytes.extend_from_slice(&value.to_le_bytes()[..width(letter)]);
    }
    let mut parameters = [0; 30];
    parameters[..bytes.len()].copy_from_slice(&bytes);
    Motion { header: id << 4, parameters }
}

/// A move to a position, by command 010x or by one with the same fields.
fn move_by(id: u16, position: i32, vad: Vad) -> Motion {
    let Vad { velocity, acceleration, deceleration } = vad;
    motion(id, &[position.into(), velocity.into(), acceleration.into(), deceleration.into()])
}

fn go_to(position: i32, vad: Vad) -> Motion {
    move_by(0x010, position, vad)
}

/// A block for the real-time-config channel.
fn block(count: u8, code: u8, words: [u16; 3]) -> ConfigBlock {
    ConfigBlock { count, code, words }
}

fn request(
    response: u32,
    control: Option<u16>,
    motion: Option<Motion>,
    config: Option<ConfigBlock>,
) -> Vec<u8> {
    let bits = [control.is_some(), motion.is_some(), config.is_some()].map(u32::from);
    let mut bytes = (bits[0] | bits[1] << 1 | bits[2] << 2).to_le_bytes().to_vec();
    bytes.extend(response.to_le_bytes());
    bytes.extend(control.into_iter().flat_map(u16::to_le_bytes));
    bytes.extend(
        motion
            .into_iter()
            .flat_map(|motion| motion.header.to_le_bytes().into_iter().chain(motion.parameters)),
    );
    bytes.extend(config.into_iter().flat_map(|config| config.bytes()));
    bytes
}

/// The content of a response; blocks that it does not have are 0.
fn read(reply: &[u8]) -> Report {
    let mut at = 8;
    let mut take = |present: bool, size: usize| {
        let bytes = if present { &reply[at..at + size] } else { &[] };
        at += bytes.len();
        bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte))
    };
    let has = |bit: u8| reply[4] >> bit & 1 == 1;
    Report {
        status: take(has(0), 2) as u16,
        state: take(has(1), 2) as u16,
        actual: take(has(2), 4) as i32,
        demand: take(has(3), 4) as i32,
        current: take(has(4), 2) as i16,
        warn: take(has(5), 2) as u16,
        error: take(has(6), 2) as u16,
        monitor: [0; 4].map(|_: u8| take(has(7), 4) as u32),
        config: (reply[0] & 4 != 0).then(|| ConfigBlock::parse(take(true, 8).to_le_bytes())),
    }
}

impl Report {
    fn main(&self) -> u8 {
        (self.state >> 8) as u8
    }

    fn count(&self) -> u8 {
        (self.state & 0xF) as u8
    }

    fn has(&self, bits: u16) -> bool {
        self.status & bits == bits
    }

    /// A motion of the drive's own is finished.
    fn is_finished(&self) -> bool {
        self.state as u8 == sub_state::FINISHED
    }
}

/// A drive and a master's notion of time.
struct Bench {
    sim: LinMotSim,
    now: Time,
    control: u16,
    count: u8,
    /// Of the real-time-config channel.
    config_count: u8,
}

impl Bench {
    fn new(change: impl FnOnce(&mut LinMotSettings)) -> Bench {
        let mut settings = LinMotSettings {
            start_position: 2 * CM,
            range: (-20 * CM, 20 * CM),
            stream_period_ns: 2 * MS,
            ..LinMotSettings::new(SocketAddrV4::new(Ipv4Addr::new(127, 1, 1, 10), DRIVE_PORT))
        };
        change(&mut settings);
        let sim = LinMotSim::new(settings);
        Bench { sim, now: Time(5 * S), control: control::ENABLES, count: 0, config_count: 0 }
    }

    /// Switched on and homed, at 0.
    fn homed() -> Bench {
        Bench::homed_with(|_| {})
    }

    fn homed_with(change: impl FnOnce(&mut LinMotSettings)) -> Bench {
        let mut bench = Bench::new(change);
        bench.enable();
        bench.home();
        bench
    }

    fn raw(&mut self, from: SocketAddrV4, bytes: &[u8]) -> Option<Vec<u8>> {
        let mut reply = Vec::new();
        let to = self.sim.receive(self.now, from, bytes, &mut reply);
        assert!(to.is_none_or(|to| to == from && !reply.is_empty()));
        to.map(|_| reply)
    }

    /// All blocks, at this instant.
    fn look(&mut self) -> Report {
        read(&self.raw(MASTER, &request(MONITORED, None, None, None)).expect("no answer"))
    }

    fn wait(&mut self, ns: u64) {
        self.now = self.now + ns;
    }

    /// 1 ms later: one exchange with the control word, and `motion` if there is one.
    fn exchange(&mut self, motion: Option<Motion>) -> Report {
        self.wait(MS);
        read(&self.raw(MASTER, &request(CYCLIC, Some(self.control), motion, None)).expect("no answer"))
    }

    /// An exchange with this control word from now on.
    fn state(&mut self, control: u16) -> Report {
        self.control = control;
        self.exchange(None)
    }

    /// One exchange on the real-time-config channel, at this instant.
    fn configure(&mut self, count: u8, code: u8, words: [u16; 3]) -> Option<ConfigBlock> {
        let config = Some(block(count, code, words));
        read(&self.raw(MASTER, &request(CYCLIC, None, None, config))?).config
    }

    /// The next command on the channel, and its answer: the status and words 2, 3 and 4.
    fn rtc(&mut self, code: u8, words: [u16; 3]) -> (u8, [u16; 3]) {
        self.config_count = (self.config_count + 1) % 16;
        let answer = self.configure(self.config_count, code, words).expect("no answer");
        assert_eq!(answer.count, self.config_count);
        (answer.code, answer.words)
    }

    /// The value that a command gives for an index.
    fn value(&mut self, code: u8, index: u16) -> u32 {
        let (status, words) = self.rtc(code, [index, 0, 0]);
        assert_eq!((status, words[0]), (DONE, index), "{code:02X}h {index:04X}h");
        block(0, status, words).value()
    }

    /// Writes a value, and waits until the flash has it.
    fn write(&mut self, code: u8, index: u16, value: u32) -> u8 {
        let (mut status, _) = self.rtc(code, [index, value as u16, (value >> 16) as u16]);
        while matches!(status, channel::RUNNING | channel::BUSY) {
            self.wait(MS);
            let again = self.configure(self.config_count, C::NO_OPERATION, [0; 3]);
            status = again.map_or(channel::BUSY, |answer| answer.code);
        }
        status
    }

    fn command(&mut self, mut motion: Motion) -> Report {
        self.count = (self.count + 1) % 16;
        motion.header |= u16::from(self.count);
        self.exchange(Some(motion))
    }

    /// A command, and some time.
    fn command_for(&mut self, motion: Motion, ns: u64) {
        self.command(motion);
        self.wait(ns);
    }

    /// The error that a command leads to.
    fn fails(&mut self, motion: Motion) -> u16 {
        self.command(motion);
        self.until_error()
    }

    /// Exchanges until the drive is there; how many it took.
    fn until(&mut self, what: impl Fn(&Report) -> bool) -> u32 {
        for exchanges in 1..20_000 {
            if what(&self.exchange(None)) {
                return exchanges;
            }
        }
        panic!("never got there: {:?}", self.exchange(None));
    }

    fn until_main(&mut self, main: u8) -> u32 {
        self.until(|report| report.main() == main)
    }

    fn enable(&mut self) {
        self.control = control::ENABLES;
        self.until_main(state::READY_TO_SWITCH_ON);
        self.control = control::ON;
        self.until_main(state::OPERATION_ENABLED);
        self.count = self.exchange(None).count();
    }

    /// Homes the drive; how many exchanges it took.
    fn home(&mut self) -> u32 {
        self.control = control::ON | control::HOME;
        let took = self.until(Report::is_finished);
        self.control = control::ON;
        self.until_main(state::OPERATION_ENABLED);
        took
    }

    fn until_stopped(&mut self) -> u32 {
        self.until(|report| !report.has(status::MOTION_ACTIVE))
    }

    fn until_standing(&mut self) -> Report {
        self.until_stopped();
        self.until(|report| report.has(status::IN_TARGET));
        // The last micrometres.
        self.wait(300 * MS);
        self.exchange(None)
    }

    /// A motion, and where it ends.
    fn ends_at(&mut self, motion: Motion) -> i32 {
        self.command(motion);
        self.until_standing().actual
    }

    /// Out of an error, up to state 0.
    fn acknowledge(&mut self) {
        self.state(control::ENABLES);
        self.state(control::ENABLES | control::ERROR_ACKNOWLEDGE);
    }

    /// Power off and on; until it is back.
    fn restart(&mut self) {
        self.sim.restart(self.now);
        self.wait(BOOT_NS);
        (self.count, self.config_count) = (0, 0);
    }

    /// The error that stands, when a quick stop before it is over.
    fn until_error(&mut self) -> u16 {
        self.until_main(state::ERROR);
        let report = self.exchange(None);
        assert_eq!(report.state & 0xFF, report.error & 0xFF);
        assert!(report.has(status::ERROR));
        report.error
    }
}
