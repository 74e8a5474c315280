//! One station, and a wire that brings whatever it likes.
//!
//! The rig does what the loop does: it prepares, sends, takes in, judges. The bytes choose commands and rows, what the
//! drive says, and which replies come to which request. What has to hold stands in the checks behind each step; they
//! know the telegram and what is desired, and nothing of how the station keeps its books.

use std::net::Ipv4Addr;

use fieldbeat::Cycle;
use fieldbeat::axis::{Command, DriveStatus, Limits, Link, NativeOwner, State, Units};
use fieldbeat::bus::linudp::motion::CommandInfo;
use fieldbeat::bus::linudp::{
    COUNTS_PER_MM, ControlWord, ErrorCode, LinUdpDrive, LinUdpPlan, MonitorPlan, Native, ReplyTag, StateVar,
    StatusWord, StreamCommand, WarnWord,
};
use fieldbeat::time::{MS, Time};
use fieldbeat_core::bus::desired::{Desired, Motion, Power};
use fieldbeat_core::bus::{Exchange, Slot};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_linudp::station::Station;
use fieldbeat_linudp::wire::{
    REQUEST_MAX, RESPONSE_MAX, Request, RequestDef, Response, ResponseDef, RtcBlock,
};

use super::commanded::Commanded;
use super::commands::{command, output, row};
use super::input::Input;

const PERIOD_NS: u64 = MS;
const RANGE: (f64, f64) = (-100.0, 200.0);

/// Requests that a reply may still belong to.
const REMEMBERED: usize = 20;

pub fn station(data: &[u8]) {
    let mut input = Input(data);
    let mut rig = Rig::new(&mut input);
    while !input.is_over() {
        rig.step(&mut input);
        rig.check();
    }
}

struct Rig {
    drive: LinUdpDrive,
    station: Station,
    native: Native,
    machine: Commanded,
    slot: Slot,
    before: Slot,
    now: Time,
    index: u64,
    request: [u8; REQUEST_MAX],
    length: usize,
    /// The requests that went out, newest first.
    requested: Vec<Request>,
    /// What the drive says, but for its echoes.
    says: Response,
    /// The count of the last motion command that the drive heard.
    count: u8,
    /// Its state has the count that it heard.
    counts: bool,
    /// There was a command.
    ordered: bool,
}

impl Rig {
    fn new(input: &mut Input<'_>) -> Rig {
        let features = input.byte();
        let has = |bit: u8| features >> bit & 1 == 1;
        let mut drive = LinUdpDrive::new("x", Ipv4Addr::LOCALHOST);
        drive.reply_tag = match (has(0), has(7)) {
            (true, _) => ReplyTag::Count,
            (false, false) => ReplyTag::Definition,
            (false, true) => ReplyTag::Off,
        };
        drive.monitor = if has(1) { MonitorPlan::AsSet } else { MonitorPlan::Off };
        // What counts in later cycles is looked at in whole machines.
        drive.reply_within = Some(1);
        drive.leash = has(2).then_some(20.0);
        drive.stream = input.of(&[Some(StreamCommand::Pva), Some(StreamCommand::P), None]);
        let inverted = if has(3) { -1.0 } else { 1.0 };
        drive.axis.units = Units {
            offset: if has(4) { -12.5 } else { 0.0 },
            ..Units::millimetres(inverted * COUNTS_PER_MM)
        };
        if has(5) {
            drive.axis.units.modulo = Some(360.0);
        } else if has(6) {
            drive.axis.limits = Limits {
                position: Some(RANGE),
                velocity: Some(1_000.0),
                acceleration: Some(20_000.0),
                ..Limits::default()
            };
        }
        let (station, native, _) = Station::new(&drive, &InputLog::default());
        let plan = LinUdpPlan::new(Ipv4Addr::LOCALHOST, vec![drive]);
        let machine = Commanded::new(&plan, 0, PERIOD_NS);
        let drive = plan.drives.into_iter().next().unwrap();
        let slot = Slot { due: true, ..Slot::default() };
        Rig {
            drive,
            station,
            native,
            machine,
            before: slot.clone(),
            slot,
            now: Time(1_000 * PERIOD_NS),
            index: 0,
            request: [0; REQUEST_MAX],
            length: 0,
            requested: Vec::new(),
            says: Response {
                status: Some(StatusWord(0x0032)),
                state: Some(StateVar(0x0100)),
                ..Response::default()
            },
            count: 0,
            counts: true,
            ordered: false,
        }
    }

    fn step(&mut self, input: &mut Input<'_>) {
        match input.byte() % 16 {
            0..=2 => self.exchange(|rig| rig.answer(0)),
            3 => self.exchange(|_| {}),
            4 | 5 => {
                let replies = input.below(4);
                self.exchange(|rig| (0..replies).for_each(|_| rig.reply(input, true)));
            }
            6 => {
                self.prepare();
                self.station.unsent(&mut self.slot);
                self.judge(self.now);
            }
            // What lay in the socket before the send, or what comes in a cycle in which nothing was asked.
            7 => {
                let in_window = input.flag();
                self.reply(input, in_window);
                self.machine.observe(self.now, &mut self.slot);
            }
            8 => {
                self.says.state = Some(StateVar(input.word()));
                self.counts = input.flag();
            }
            // As a drive in operation says it: standing or moving, homed or not.
            9 => {
                let sub = input.byte() & 0xF0;
                self.says.state = Some(StateVar(0x0800 | u16::from(sub)));
                self.says.status = Some(StatusWord(0x0037 | (u16::from(sub & 0x80) << 4)));
                self.counts = true;
            }
            10 => self.says.status = Some(StatusWord(input.word())),
            11 => {
                (self.says.actual, self.says.demand) = (Some(input.long() as i32), Some(input.long() as i32))
            }
            12 => {
                self.says.current = Some(input.word() as i16);
                self.says.warn = Some(WarnWord(input.word()));
                self.says.error = Some(ErrorCode(input.word()));
            }
            13 => self.order(Some(command(input))),
            14 => self.machine.row(row(input)),
            _ => match input.byte() % 8 {
                link @ 0..4 => {
                    self.slot.link =
                        [Link::Unseen, Link::Qualifying, Link::Online, Link::Lost][usize::from(link)];
                }
                4 => self.order(None),
                5 => {
                    let _ = self.native.write(output(input));
                }
                6 => self.now = self.now + u64::from(input.word()) * PERIOD_NS,
                _ => (self.says.status, self.says.state) = (Some(StatusWord(0)), Some(StateVar(0))),
            },
        }
    }

    /// One cycle in which a request is due.
    fn exchange(&mut self, replies: impl FnOnce(&mut Rig)) {
        self.prepare();
        let sent_at = self.now;
        self.station.sent(sent_at, &self.cycle(), &mut self.slot);
        self.machine.commit(&mut self.slot);
        self.before.counters.sent += 1;
        let request = Request::parse(&self.request[..self.length]).unwrap();
        if let Some(motion) = &request.motion {
            self.count = (motion.header & 0xF) as u8;
        }
        if self.drive.reply_tag == ReplyTag::Definition {
            let turns = if self.drive.monitor == MonitorPlan::Off { 7 } else { 3 };
            let like = |requested: &&Request| requested.response_def == request.response_def;
            assert_eq!(self.requested.iter().take(turns).find(like), None, "no two in a row look alike");
        }
        self.requested.insert(0, request);
        self.requested.truncate(REMEMBERED);
        self.now = self.now + PERIOD_NS / 4;
        replies(self);
        self.judge(sent_at);
        self.now = self.now + PERIOD_NS / 4 * 3;
        self.index += 1;
    }

    /// Each request has a count on the real-time-config channel.
    fn counted(&self) -> bool {
        self.drive.reply_tag == ReplyTag::Count
    }

    fn cycle(&self) -> Cycle {
        let deadline = self.now + PERIOD_NS / 2;
        Cycle { index: self.index, grid: self.now, period_ns: PERIOD_NS, deadline }
    }

    fn prepare(&mut self) {
        let cycle = self.cycle();
        self.machine.propose(self.now, &mut self.slot);
        let length = self.station.prepare(&cycle, &mut self.slot, &mut self.request);
        let first = self.request;
        self.length = self.station.prepare(&cycle, &mut self.slot, &mut self.request);
        assert_eq!(first[..length], self.request[..self.length], "built again, it is the same");
        self.check_request();
    }

    /// What the loop makes of the cycle of this slot.
    fn judge(&mut self, grid: Time) {
        match self.slot.exchange {
            Exchange::Owed { .. } => {
                self.slot.counters.missed += 1;
                self.slot.exchange = Exchange::Missed;
            }
            Exchange::Answered { .. } | Exchange::Unsent => self.slot.exchange = Exchange::Idle,
            Exchange::Idle | Exchange::Missed | Exchange::Absent { .. } => {}
            Exchange::Queued | Exchange::OwnClock { .. } => panic!("not of this wire: {:?}", self.slot),
        }
        self.machine.observe(grid, &mut self.slot);
    }

    /// A reply that is somehow wrong, or comes to something else, or is right.
    fn reply(&mut self, input: &mut Input<'_>, in_window: bool) {
        let age = input.below(REMEMBERED);
        let mut bytes = self.telegram(age.min(self.requested.len().saturating_sub(1)));
        match input.byte() % 8 {
            0..=2 => {}
            3 => bytes[input.below(8)] ^= 1 << input.below(8),
            4 => bytes.truncate(input.below(bytes.len())),
            5 => bytes.extend_from_slice(input.bytes(14)),
            6 => bytes = input.bytes(64).to_vec(),
            // Another count on the real-time-config channel, where there is one.
            _ => {
                if let Some(tag) = bytes.len().checked_sub(8) {
                    bytes[tag] ^= 1 + input.byte() % 15;
                }
            }
        }
        self.take(&bytes, in_window);
    }

    fn answer(&mut self, age: usize) {
        let bytes = self.telegram(age);
        self.take(&bytes, true);
    }

    /// What the drive says now, as the reply to the request of so many requests ago.
    fn telegram(&self, age: usize) -> Vec<u8> {
        let requested = self.requested.get(age).copied().unwrap_or_default();
        let state = self.says.state.unwrap_or_default();
        let counted = StateVar(state.0 & !0xF | u16::from(self.count));
        let response = Response {
            request_def: requested.definition(),
            response_def: requested.response_def,
            state: Some(if self.counts && state.count().is_some() { counted } else { state }),
            config: requested.config,
            ..self.says
        };
        let mut bytes = vec![0; RESPONSE_MAX];
        let size = response.emit(&mut bytes);
        bytes.truncate(size);
        bytes
    }

    fn order(&mut self, command: Option<Command>) {
        self.machine.start(self.now, command);
        self.ordered = true;
    }

    /// Hands a datagram over, and looks at what became of it.
    fn take(&mut self, bytes: &[u8], in_window: bool) {
        let before = self.slot.clone();
        let owed = matches!(before.exchange, Exchange::Owed { .. });
        let in_window = in_window || owed;
        self.station.take(self.now, bytes, in_window, &mut self.slot);

        let (c, b) = (self.slot.counters, before.counters);
        let seen = |c: &fieldbeat::telemetry::Counters| {
            [c.answered, c.late, c.duplicate, c.malformed, c.foreign].iter().sum::<u64>()
        };
        assert_eq!(seen(&c), seen(&b) + 1, "a datagram is counted once: {b:?}, {c:?}");
        assert_eq!((c.sent, c.unsent, c.missed), (b.sent, b.unsent, b.missed));

        let Ok(response) = Response::parse(bytes) else {
            assert_eq!(c.malformed, b.malformed + 1);
            let taken = |slot: &Slot| (slot.exchange, slot.status, slot.notices);
            assert_eq!(taken(&self.slot), taken(&before));
            return;
        };
        let tag = |config: Option<RtcBlock>| config.filter(|_| self.counted()).map(|block| block.count());
        let echoes = self.requested.first().is_some_and(|requested| {
            (requested.definition(), requested.response_def, tag(requested.config))
                == (response.request_def, response.response_def, tag(response.config))
        });
        // Before the first request nothing is echoed but by chance: of two empty definitions.
        let echoes = echoes || self.requested.is_empty() && response.request_def == RequestDef::NONE;
        assert_eq!(
            c.answered - b.answered,
            u64::from(owed && echoes),
            "{response:?} to {:?}",
            self.requested.first()
        );
        if (self.slot.status, self.slot.notices) == (before.status, before.notices) {
            assert!(c.answered == b.answered || !self.slot.notices.fresh);
        } else {
            assert!(echoes && in_window, "only what was asked for is read: {response:?}");
            self.check_report(&response, &before.status);
        }
        if c.answered == b.answered && self.slot.exchange != before.exchange {
            // The second of two replies in one window.
            assert!(matches!(before.exchange, Exchange::Answered { .. }));
        }
    }

    /// The report is what this telegram says.
    fn check_report(&self, response: &Response, before: &DriveStatus) {
        let report = &self.slot.status;
        assert_eq!((self.slot.notices.fresh, report.at), (true, self.now));
        let units = &self.drive.axis.units;
        for (value, raw) in [(report.position, response.actual), (report.demand, response.demand)] {
            let raw = raw.unwrap_or_default();
            match units.modulo {
                None => assert_eq!(value, f64::from(raw) / units.counts_per_unit + units.offset),
                Some(turn) => assert!((0.0..=turn).contains(&value), "{value}"),
            }
        }
        assert!(report.velocity.is_finite());
        // What was not asked for is as it was.
        assert_eq!(report.current, response.current.map_or(before.current, |raw| f64::from(raw) * 1e-3));
        assert_eq!(report.warning, response.warn.map_or(before.warning, |raw| u32::from(raw.0)));
        let (status, state) = (response.status.unwrap_or_default(), response.state.unwrap_or_default());
        // An error whose code this reply does not have is the one that was reported last.
        let code = response.error.map_or(before.fault, |error| u32::from(error.0));
        assert_eq!((report.fault, report.homed), (if status.error() { code } else { 0 }, status.homed()));
        let main = state.main().0;
        // Of a state that it cannot name it says nothing good.
        let booting = report.state == State::NotReadyToSwitchOn;
        let powered = main == 3 || main >= 5;
        assert_eq!(report.state.is_powered(), powered && !booting, "{state:?} is {}", report.state);
        assert_eq!(self.native.inputs().response, *response, "the application sees the same telegram");
    }

    /// What the request says, whatever the drive said.
    fn check_request(&mut self) {
        let request = Request::parse(&self.request[..self.length]).unwrap();
        assert_eq!((request.size(), request.reserved), (self.length, RequestDef::NONE));
        let needed = match self.drive.reply_tag {
            ReplyTag::Definition => ResponseDef(0x0F),
            ReplyTag::Count | ReplyTag::Off => ResponseDef::CYCLIC,
        };
        assert!(request.response_def.contains(needed));
        assert_eq!(request.config.is_some(), request.response_def.contains(ResponseDef::CONFIG));
        assert!(request.config.is_some() || !self.counted());
        // The id of its motion command, but for "no operation", and the fields; native ones may be unknown.
        let command = request.motion.map(|block| (block.header >> 4, block.parameters));
        let command = command.filter(|(id, _)| *id != 0).map(|(id, parameters)| {
            (id, CommandInfo::of(id).map_or([0; 5], |info| info.values(&parameters)))
        });
        let Desired { power, motion, setpoint, .. } = self.slot.desired;
        assert!(self.ordered || power.serial == 0, "nothing is desired before the first command");
        if power.serial == 0 {
            assert_eq!(request.control, None, "nothing is written before something is desired");
            assert_eq!(command, None);
            return;
        }
        if motion.value == Motion::Native(NativeOwner::Application) {
            return;
        }
        use ControlWord as C;
        let abort = |word: C| C(word.0 & !C::NO_ABORT);
        // Powered, and kept out of operation.
        let held = C(C::ON.0 & !C::ENABLE_OPERATION);
        let usual: &[C] = match power.value {
            Power::Untouched | Power::Off | Power::Shutdown => &[C::BASE],
            Power::FaultReset => &[C::ACKNOWLEDGE],
            Power::SwitchOn => &[held],
            Power::QuickStop => &[abort(C::ON)],
            Power::EnableOperation => match motion.value {
                Motion::Home => &[C::HOME],
                Motion::Halt => &[abort(C::ON)],
                _ => &[C::ON],
            },
        };
        assert!(
            request.control.is_none_or(|word| usual.contains(&word)),
            "{request:?} for {power:?}, {motion:?}"
        );
        let units = &self.drive.axis.units;
        let near = |value: i64, wanted: f64| {
            let position = value as f64 / units.counts_per_unit + units.offset;
            // Rounded to a count. On a rotary axis the count is another one in each turn of the wire.
            units.modulo.is_some() || (position - wanted).abs() <= 1e-4
        };
        match (motion.value, command) {
            (_, None) | (Motion::Native(_), _) => {}
            (Motion::Ramp { .. }, Some((0x017, _))) | (Motion::EndStream, Some((0x03F, _))) => {}
            (Motion::Follow, Some((id, _))) if StreamCommand::from_id(id).is_some() => {
                assert_eq!(StreamCommand::from_id(id), self.drive.stream);
                assert_ne!(setpoint.row, 0);
            }
            (Motion::Move { position, .. }, Some((0x010, [target, vad @ .., _]))) => {
                assert!(near(target, position), "{target} for {position}");
                self.check_move(target);
                assert!(vad.iter().all(|value| *value > 0), "{vad:?} never arrives");
            }
            (_, other) => panic!("a master does not send {other:?} for {motion:?}"),
        }
    }

    /// A target that the newest command may have.
    fn check_move(&self, target: i64) {
        let (limits, command) = (self.drive.axis.limits.position, self.machine.command());
        let backwards = self.machine.wanted_velocity() < 0.0;
        let (low, high) = match (limits, command) {
            (Some((low, high)), Some(Command::Move(_))) => (low, high),
            // From outside the range a jog leads back in.
            (Some((low, _)), Some(Command::Jog(_) | Command::Velocity { .. })) if backwards => {
                (low, f64::INFINITY)
            }
            (Some((_, high)), Some(Command::Jog(_) | Command::Velocity { .. })) => (f64::NEG_INFINITY, high),
            (None, Some(Command::Move(_) | Command::Jog(_) | Command::Velocity { .. })) => {
                (f64::NEG_INFINITY, f64::INFINITY)
            }
            (_, other) => panic!("a move to {target} in {other:?}"),
        };
        let position = self.drive.axis.units.position(target);
        // Rounded to a count.
        assert!((low - 1e-4..=high + 1e-4).contains(&position), "a move to {position} in {command:?}");
    }

    fn check(&mut self) {
        let c = self.slot.counters;
        let owed = u64::from(matches!(self.slot.exchange, Exchange::Owed { .. }));
        assert_eq!(c.sent, c.answered + c.missed + owed, "{c:?}");
        assert_eq!(c.sent, self.before.counters.sent, "{c:?}");
        assert!(c.suspect <= c.answered && c.late <= c.missed + c.suspect, "{c:?}");
        let b = self.before.counters;
        let fields = |c: &fieldbeat::telemetry::Counters| {
            [c.unsent, c.answered, c.missed, c.late, c.duplicate, c.suspect, c.malformed, c.foreign]
        };
        assert!(fields(&c).iter().zip(fields(&b)).all(|(now, before)| *now >= before), "{b:?}, {c:?}");
        self.before = self.slot.clone();
    }
}
