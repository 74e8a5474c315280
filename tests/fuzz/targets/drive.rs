//! The simulated drive, and a master that knows no rules: any control word, any motion command, anything on the
//! parameter channel, at any moment. The drive answers what the wire's rules say, keeps what it has accepted, and stays
//! as small as it is.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat::bus::linudp::motion::CATALOGUE;
use fieldbeat::bus::linudp::{
    ControlWord, DRIVE_PORT, ErrorCode, MASTER_PORT, MainState, MotionBlock, StatusWord,
};
use fieldbeat::sim::SimDrive;
use fieldbeat::sim::linudp::{FlashMode, LinMotSettings, LinMotSim, UnknownCommands};
use fieldbeat::time::{MS, S, Time};
use fieldbeat_linudp::wire::{
    REQUEST_MAX, Request, RequestDef, Response, ResponseDef, RtcBlock, RtcCommand, RtcStatus,
};

use super::input::Input;

/// Parameters that can be written, of every width, and others: of 16 bits, of 8, with narrow limits, a variable, none.
const UPIDS: [u16; 12] =
    [0x1E72, 0x1E73, 0x14BE, 0x13A2, 0x20A8, 0x145A, 0x1450, 0x14E6, 0x30D4, 0x1E0F, 0x000C, 0x7777];

/// Padding and the longest answer.
const LONGEST_REPLY: usize = 64;

/// All that the drive can hold, as its debug text: 128 KiB of curves in RAM, in flash and on their way, and 255
/// entries.
const MOST_TEXT: usize = 8 << 20;

pub fn drive(data: &[u8]) {
    let mut input = Input(data);
    let mut bench = Bench::new(&mut input);
    while !input.is_over() {
        bench.operate(&mut input);
    }
    assert!(format!("{:?}", bench.drive).len() < MOST_TEXT, "it grows");
}

struct Bench {
    drive: LinMotSim,
    now: Time,
    /// The count that the drive has stored.
    count: u8,
    /// What was written to RAM, and accepted, since the last start.
    written: BTreeMap<u16, u32>,
    last: Option<Request>,
}

impl Bench {
    fn new(input: &mut Input<'_>) -> Bench {
        let features = input.byte();
        let has = |bit: u8| features >> bit & 1 == 1;
        let settings = LinMotSettings {
            padding: [0, 14, 64][usize::from(features & 3) % 3],
            force_enable_bits: has(2),
            start_running: has(3),
            config_time_ns: if has(4) { 3 * MS } else { 0 },
            flash_time_ns: 20 * MS,
            flash: if has(5) { FlashMode::Busy } else { FlashMode::Silent },
            unknown_commands: if has(6) { UnknownCommands::Ignore } else { UnknownCommands::Refuse },
            extend_sign: has(7),
            ..LinMotSettings::new(SocketAddrV4::new(Ipv4Addr::LOCALHOST, DRIVE_PORT))
        };
        Bench {
            drive: LinMotSim::new(settings),
            now: Time(S),
            count: 0,
            written: BTreeMap::new(),
            last: None,
        }
    }

    fn operate(&mut self, input: &mut Input<'_>) {
        match input.byte() % 16 {
            0..=3 => self.call(input),
            4..=8 => {
                let request = Self::request(input);
                self.ask(request);
            }
            // Most of what is wanted of a drive needs it to be switched on and homed.
            9 => {
                for control in [ControlWord::BASE, ControlWord::ON, ControlWord::HOME] {
                    self.ask(Request { control: Some(control), ..status() });
                    self.now = self.now + 500 * MS;
                }
            }
            10 => self.now = self.now + u64::from(input.byte()) * MS / 4,
            11 => self.now = self.now + u64::from(input.word()) * 100 * MS,
            12 => self.raw(input),
            13 => {
                if let Some(again) = self.last {
                    self.written.clear();
                    self.ask(again);
                }
            }
            14 => match input.flag() {
                true => self.drive.provoke(ErrorCode(input.word() & 0xFF)),
                false => self.drive.inhibit(self.now + u64::from(input.byte()) * MS),
            },
            _ => {
                self.drive.restart(self.now);
                self.count = 0;
                self.written.clear();
            }
        }
    }

    fn request(input: &mut Input<'_>) -> Request {
        let header = match input.flag() {
            true => CATALOGUE[input.below(CATALOGUE.len())].id << 4 | u16::from(input.byte() & 0xF),
            false => input.word(),
        };
        let mut motion = MotionBlock { header, parameters: [0; 30] };
        let fields = input.below(motion.parameters.len() + 1);
        let given = input.bytes(fields);
        motion.parameters[..given.len()].copy_from_slice(given);
        let usual =
            input.of(&[ControlWord::ON, ControlWord::BASE, ControlWord::HOME, ControlWord::ACKNOWLEDGE]);
        Request {
            response_def: ResponseDef(u32::from(input.byte())),
            control: match input.below(4) {
                0 => None,
                1 => Some(ControlWord(input.word())),
                _ => Some(usual),
            },
            motion: input.flag().then_some(motion),
            ..Request::default()
        }
    }

    /// A call on the parameter channel, alone in its telegram, and until it is done.
    fn call(&mut self, input: &mut Input<'_>) {
        let command = match input.below(4) {
            0 => RtcCommand(input.byte()),
            1 => input.of(&[RtcCommand::WRITE_RAM, RtcCommand::READ_RAM]),
            _ => input.of(RtcCommand::ALL),
        };
        let index = match input.below(4) {
            0 => input.word(),
            1 => u16::from(input.byte()),
            _ => input.of(&UPIDS),
        };
        let value = match input.below(4) {
            0 => input.long(),
            // Sizes of a small curve, and of an entry of the command table.
            1 => 0x0008_0046,
            2 => 64,
            _ => u32::from(input.byte()),
        };
        let count = self.count % 15 + 1;
        let config = Some(RtcBlock::call(count, command, index, value));
        let request =
            Request { config, response_def: ResponseDef::CYCLIC.with(ResponseDef::CONFIG), ..status() };
        if command == RtcCommand::RESTART {
            // Said again to the drive that has restarted, it would restart once more.
            self.ask(request);
            return self.written.clear();
        }
        // Busy, or silent for a save.
        for _ in 0..64 {
            let Some(answer) = self.ask(request).and_then(|response| response.config) else {
                self.now = self.now + 25 * MS;
                continue;
            };
            match answer.status() {
                RtcStatus::Running | RtcStatus::Busy => self.now = self.now + MS,
                // Busy with the one before until now.
                _ if answer.count() != count => {}
                _ => return self.answered(command, index, value, answer),
            }
        }
        panic!("no end of {request:?}");
    }

    fn answered(&mut self, command: RtcCommand, index: u16, value: u32, answer: RtcBlock) {
        let status = answer.status();
        let done = status == RtcStatus::Done;
        match command {
            RtcCommand::WRITE_RAM | RtcCommand::WRITE_BOTH if done => {
                assert_eq!((answer.index(), answer.value()), (index, value));
                self.written.insert(index, value);
            }
            RtcCommand::READ_RAM if done => {
                if let Some(written) = self.written.get(&index) {
                    assert_eq!(answer.value(), *written, "{index:04X}h");
                }
            }
            // Who runs the motion software anew loads what it starts with.
            RtcCommand::START_SOFTWARE | RtcCommand::STOP_SOFTWARE => self.written.clear(),
            _ => {}
        }
        if !RtcCommand::ALL.contains(&command) {
            assert!(matches!(status, RtcStatus::Refused(_)), "{command} is unknown: {status:?}");
        }
    }

    /// Learns the stored count from an answer.
    fn received(&mut self, requested: RtcBlock, answer: RtcBlock) {
        let taken = answer.count() == requested.count() && self.count != requested.count();
        let restarts = taken && requested.code == RtcCommand::RESTART.0;
        self.count = if restarts { 0 } else { answer.count() };
    }

    /// Motion commands write parameters too, and a running command table: what was read back before says nothing then.
    fn ask(&mut self, request: Request) -> Option<Response> {
        self.last = Some(request);
        if request.motion.is_some() {
            self.written.clear();
        }
        let mut bytes = [0; REQUEST_MAX];
        let size = request.emit(&mut bytes);
        let first = self.send(MASTER_PORT, &bytes[..size]);
        let response = first.as_deref().map(|reply| Response::parse(reply).expect("a telegram"))?;
        assert_eq!(
            (response.request_def, response.response_def),
            (request.definition(), request.response_def)
        );
        assert_eq!(response.config.is_some(), request.config.is_some(), "{request:?}");
        check_states(&response);
        if let (Some(requested), Some(answer)) = (request.config, response.config) {
            self.received(requested, answer);
        }
        // At the same instant the same again changes nothing, and gets the same stored answer.
        if let (Some(requested), Some(answer)) = (request.config, response.config)
            && request.motion.is_none()
            && requested.count() == answer.count()
            && !matches!(answer.status(), RtcStatus::Running | RtcStatus::Busy)
            && requested.code != RtcCommand::RESTART.0
        {
            let again = self.send(MASTER_PORT, &bytes[..size]).and_then(|reply| Response::parse(&reply).ok());
            assert_eq!(again.and_then(|response| response.config), Some(answer), "{requested:?}");
        }
        Some(response)
    }

    /// Anything, from anywhere.
    fn raw(&mut self, input: &mut Input<'_>) {
        let port = if input.below(4) == 0 { input.word() } else { MASTER_PORT };
        let length = input.below(100);
        let bytes = input.bytes(length);
        self.written.clear();
        self.last = None;
        let before = self.drive.ignored();
        let reply = self.send(port, bytes);
        let after = self.drive.ignored();
        let counted = |ignored: fieldbeat::sim::linudp::Ignored| {
            ignored.wrong_port + ignored.malformed + ignored.filtered + ignored.deaf
        };
        assert_eq!(reply.is_none(), counted(after) == counted(before) + 1, "{before:?}, {after:?}");
        let request = Request::parse(bytes);
        if port != MASTER_PORT || request.is_err() {
            assert_eq!(reply, None, "{request:?} from port {port}");
        }
        let answer = reply.as_deref().and_then(|reply| Response::parse(reply).ok()?.config);
        if let (Some(requested), Some(answer)) = (request.ok().and_then(|request| request.config), answer) {
            self.received(requested, answer);
        }
    }

    fn send(&mut self, port: u16, bytes: &[u8]) -> Option<Vec<u8>> {
        let from = SocketAddrV4::new(Ipv4Addr::LOCALHOST, port);
        let mut reply = Vec::new();
        let to = self.drive.receive(self.now, from, bytes, &mut reply);
        assert_eq!(to.is_some(), !reply.is_empty());
        assert!(to.is_none_or(|to| to == from) && reply.len() <= LONGEST_REPLY, "{to:?}: {reply:?}");
        to.map(|_| reply)
    }
}

/// A question that changes nothing.
fn status() -> Request {
    Request { reserved: RequestDef::NONE, response_def: ResponseDef::CYCLIC, ..Request::default() }
}

/// Status word, state variable, error code and warn word say the same. All are 0 while its software does not run.
fn check_states(response: &Response) {
    let Response { status: Some(status), state: Some(state), error, warn, .. } = *response else { return };
    if status.0 == 0 {
        return assert_eq!(state.0, 0);
    }
    let operates = state.main() == MainState::OPERATION_ENABLED;
    assert_eq!(status.operation_enabled(), state.main() >= MainState::OPERATION_ENABLED, "{response:?}");
    let shown = [status.motion_active(), status.in_target(), status.homed()];
    let sampled = [state.motion_active(), state.in_target(), state.homed()];
    assert_eq!(sampled, shown.map(|shown| operates.then_some(shown)), "{response:?}");
    assert_eq!(
        state.main() == MainState::ERROR,
        status.error() && !status.operation_enabled(),
        "{response:?}"
    );
    assert!(!(status.in_target() && status.motion_active() || operates && status.error()), "{response:?}");
    assert!(error.is_none_or(|error| status.error() == (error != ErrorCode::NONE)), "{response:?}");
    assert!(warn.is_none_or(|warn| status.has(StatusWord::WARNING) == (warn.0 != 0)), "{response:?}");
}
