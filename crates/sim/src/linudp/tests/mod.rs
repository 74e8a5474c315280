//! The drive as a master meets it: only telegrams in, only telegrams out, in virtual time. Here the master's side.

mod commands;
mod curve;
mod memory;
mod rtc;
mod sequence;
mod states;
mod stream;
mod telegram;

use super::demand::Vad;
use super::*;
use RtcCommand as C;
use fieldbeat_core::time::{S, US};
use fieldbeat_linudp::motion::{Acceleration, Bits, MotionCommand, Position, Raw, Upid, Velocity};
use fieldbeat_linudp::wire::{
    ControlWord, MainState, MotionBlock, Refusal, ResponseDef, RtcBlock, RtcCommand, RtcStatus,
};
use fieldbeat_linudp::{DRIVE_PORT, StreamCommand};

const MASTER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(127, 1, 1, 1), MASTER_PORT);

/// 10 mm in wire counts.
const CM: i32 = 100_000;
/// 0.5 m/s, 10 m/s2.
const VAD: Vad = Vad { velocity: 500_000, acceleration: 1_000_000, deceleration: 1_000_000 };

const DONE: RtcStatus = RtcStatus::Done;

fn refused(refusal: Refusal) -> RtcStatus {
    RtcStatus::Refused(refusal)
}

/// VAI go to position, from which the tests make its relatives.
fn go_to(position: i32, vad: Vad) -> MotionCommand {
    let [acceleration, deceleration] = [vad.acceleration, vad.deceleration].map(Acceleration);
    MotionCommand::vai_go_to(Position(position), Velocity(vad.velocity), acceleration, deceleration)
}

fn settings() -> LinMotSettings {
    LinMotSettings {
        start_position: 2 * CM,
        range: (-20 * CM, 20 * CM),
        stream_period_ns: 2 * MS,
        ..LinMotSettings::new(SocketAddrV4::new(Ipv4Addr::new(127, 1, 1, 10), DRIVE_PORT))
    }
}

/// A drive and a master's notion of time.
struct Bench {
    sim: LinMotSim,
    now: Time,
    control: ControlWord,
    count: u8,
    /// Of the real-time-config channel.
    config_count: u8,
}

impl Bench {
    fn new(change: impl FnOnce(&mut LinMotSettings)) -> Bench {
        let mut settings = settings();
        change(&mut settings);
        Bench {
            sim: LinMotSim::new(settings),
            now: Time(5 * S),
            control: ControlWord::BASE,
            count: 0,
            config_count: 0,
        }
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
        assert_eq!(to.is_some(), !reply.is_empty());
        assert!(to.is_none_or(|to| to == from));
        to.map(|_| reply)
    }

    fn ask(&mut self, request: &Request) -> Response {
        self.try_ask(request).expect("no answer")
    }

    /// The same with a drive that may be silent.
    fn try_ask(&mut self, request: &Request) -> Option<Response> {
        let mut bytes = [0; 64];
        let size = request.emit(&mut bytes);
        self.raw(MASTER, &bytes[..size]).map(|reply| Response::parse(&reply).unwrap())
    }

    /// All blocks, at this instant.
    fn look(&mut self) -> Response {
        self.ask(&Request { response_def: ResponseDef(0xFF), ..Request::default() })
    }

    /// 1 ms later: one exchange with the control word, and `motion` if there is one.
    fn exchange(&mut self, motion: Option<MotionBlock>) -> Response {
        self.now = self.now + MS;
        let request = Request {
            response_def: ResponseDef::CYCLIC,
            control: Some(self.control),
            motion,
            ..Request::default()
        };
        self.ask(&request)
    }

    fn state(&mut self, control: ControlWord) -> StateVar {
        self.control = control;
        self.exchange(None).state.unwrap()
    }

    /// One exchange on the real-time-config channel, at this instant.
    fn configure(&mut self, block: RtcBlock) -> RtcBlock {
        self.try_configure(block).expect("no answer")
    }

    fn try_configure(&mut self, block: RtcBlock) -> Option<RtcBlock> {
        let response_def = ResponseDef::CYCLIC.with(ResponseDef::CONFIG);
        self.try_ask(&Request { response_def, config: Some(block), ..Request::default() })?.config
    }

    /// The next command on the channel, and its answer: the status and words 2, 3 and 4.
    fn rtc(&mut self, command: RtcCommand, words: [u16; 3]) -> (RtcStatus, [u16; 3]) {
        self.config_count = (self.config_count + 1) % 16;
        let answer = self.configure(RtcBlock { words, ..RtcBlock::command(self.config_count, command) });
        assert_eq!(answer.count(), self.config_count);
        (answer.status(), answer.words)
    }

    /// The value that a command gives for an index.
    fn value(&mut self, command: RtcCommand, index: u16) -> u32 {
        let (status, [echo, low, high]) = self.rtc(command, [index, 0, 0]);
        assert_eq!((status, echo), (RtcStatus::Done, index), "{command} {index:04X}h");
        u32::from(high) << 16 | u32::from(low)
    }

    /// Writes a value, and waits until the flash has it.
    fn write(&mut self, command: RtcCommand, index: u16, value: u32) -> RtcStatus {
        let (status, _) = self.rtc(command, [index, value as u16, (value >> 16) as u16]);
        self.settle(status)
    }

    /// Waits for the end of what is under way.
    fn settle(&mut self, mut status: RtcStatus) -> RtcStatus {
        while matches!(status, RtcStatus::Running | RtcStatus::Busy) {
            self.now = self.now + MS;
            let again = RtcBlock::command(self.config_count, RtcCommand::NO_OPERATION);
            status = self.try_configure(again).map_or(RtcStatus::Busy, |answer| answer.status());
        }
        status
    }

    fn command(&mut self, command: MotionCommand) -> Response {
        self.count = (self.count + 1) % 16;
        self.exchange(Some(command.block(self.count)))
    }

    /// The error that a command leads to.
    fn fails(&mut self, command: MotionCommand) -> ErrorCode {
        self.command(command);
        self.until_error()
    }

    /// Exchanges until the drive is there; how many it took.
    fn until(&mut self, what: impl Fn(&Response) -> bool) -> u32 {
        for exchanges in 1..20_000 {
            if what(&self.exchange(None)) {
                return exchanges;
            }
        }
        panic!("never got there: {:?}", self.exchange(None));
    }

    fn until_main(&mut self, main: MainState) -> u32 {
        self.until(|response| response.state.unwrap().main() == main)
    }

    fn enable(&mut self) {
        self.control = ControlWord::BASE;
        self.until_main(MainState::READY_TO_SWITCH_ON);
        self.control = ControlWord::ON;
        self.until_main(MainState::OPERATION_ENABLED);
        self.count = self.exchange(None).state.unwrap().count().unwrap();
    }

    fn home(&mut self) {
        self.control = ControlWord::HOME;
        self.until(|response| response.state.unwrap().finished());
        self.control = ControlWord::ON;
        self.until_main(MainState::OPERATION_ENABLED);
    }

    fn until_stopped(&mut self) -> u32 {
        self.until(|response| !response.status.unwrap().motion_active())
    }

    fn until_standing(&mut self) -> Response {
        self.until_stopped();
        self.until(|response| response.status.unwrap().in_target());
        // The last micrometres.
        self.now = self.now + 300 * MS;
        self.exchange(None)
    }

    /// Out of an error, up to state 0.
    fn acknowledge(&mut self) {
        self.state(ControlWord::BASE);
        self.state(ControlWord::ACKNOWLEDGE);
    }

    /// Power off and on; until it is back.
    fn restart(&mut self) {
        self.sim.restart(self.now);
        self.now = self.now + BOOT_NS;
        (self.count, self.config_count) = (0, 0);
    }

    /// Quick stop, if any, is over: the error that stands.
    fn until_error(&mut self) -> ErrorCode {
        self.until_main(MainState::ERROR);
        let response = self.exchange(None);
        assert_eq!(u16::from(response.state.unwrap().sub()), response.error.unwrap().0 & 0xFF);
        assert!(response.status.unwrap().error());
        response.error.unwrap()
    }
}
