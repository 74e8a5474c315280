//! One drive, its station, and the segment in between.

use std::collections::VecDeque;

use super::*;
use fieldbeat_core::axis::{Jog, Link, Move, Target};
use fieldbeat_core::drive::machine::Machine;
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::time::S;
use fieldbeat_ethercat::slot::{Answer, Ask};
use fieldbeat_ethercat::start_up::start_up;
use fieldbeat_ethercat::wire::frame::Command as DatagramCommand;
use fieldbeat_ethercat::wire::mailbox::{Counter, SDO_SIZE, emit};
use fieldbeat_ethercat::wire::sdo::Request;
use fieldbeat_sim::ethercat::{self as sim, Drive, DriveSettings};

/// One drive, and the segment in between.
pub(super) struct Rig {
    pub(super) drive: Drive,
    pub(super) station: Station,
    pub(super) machine: Machine,
    pub(super) native: Native,
    pub(super) plan: KollmorgenDrive,
    pub(super) slot: Slot,
    pub(super) now: Time,
    pub(super) al: AlState,
    pub(super) inputs: Vec<u8>,
    pub(super) outputs: Vec<u8>,
    /// The messages in the drive's mailbox.
    mail: VecDeque<Vec<u8>>,
    /// Demands of positions, as they went out.
    pub(super) steepest: i32,
}

/// A drive with these PDOs.
pub(super) fn planned_for(family: Family, outputs: u16, inputs: u16) -> KollmorgenDrive {
    let mut plan = KollmorgenDrive::new("x", 0, family);
    let fixed = |number| pdo::fixed(family).into_iter().find(|layout| layout.pdo == number).unwrap();
    (plan.outputs, plan.inputs) = (fixed(outputs), fixed(inputs));
    plan.fit();
    plan.slave.watchdog = Watchdog::After(100 * MS);
    plan
}

/// The same of the S700.
pub(super) fn planned(outputs: u16, inputs: u16) -> KollmorgenDrive {
    planned_for(Family::S700, outputs, inputs)
}

pub(super) fn position() -> KollmorgenDrive {
    planned(0x1701, 0x1B03)
}

pub(super) fn velocity() -> KollmorgenDrive {
    planned(0x1702, 0x1B03)
}

impl Rig {
    /// In OP, and known.
    pub(super) fn new(plan: KollmorgenDrive) -> Rig {
        Rig::with(plan, |_| {})
    }

    pub(super) fn with(plan: KollmorgenDrive, change: impl FnOnce(&mut DriveSettings)) -> Rig {
        let mut settings = DriveSettings::new(plan.family);
        settings.position = 123_456;
        change(&mut settings);
        let (station, native, _) =
            Station::new(&plan, PERIOD * u64::from(plan.axis.divisor), 0, &InputLog::default());
        let mut rig = Rig {
            machine: Machine::new(&plan.axis, capabilities(&plan, PERIOD), PERIOD),
            drive: Drive::new(settings),
            station,
            native,
            slot: Slot { due: true, link: Link::Online, ..Slot::default() },
            now: Time(5 * S),
            al: AlState::Init,
            inputs: vec![0; plan.inputs.size()],
            outputs: vec![0; plan.outputs.size()],
            mail: VecDeque::new(),
            steepest: 0,
            plan,
        };
        rig.bring_up();
        rig.turns(20);
        rig
    }

    /// Plays the segment until the drive is in OP.
    fn bring_up(&mut self) {
        self.station.operational(None, &mut self.slot);
        self.station.service.open(false);
        self.mail.clear();
        let now = self.now;
        self.drive.may_enter(now, sim::AlState::PreOp).unwrap();
        let mut counter = Counter::default();
        for start in start_up(&self.plan, PERIOD) {
            counter = counter.next();
            let value = (start.raw as u32).to_le_bytes();
            let request = Request::Download { object: start.object, value, length: start.kind.bytes() as u8 };
            let (mut message, mut reply) = ([0; SDO_SIZE], Vec::new());
            emit(&request, counter, &mut message);
            assert!(self.drive.mailbox(&message, &mut reply));
            assert_eq!(reply[8], 0x60, "{start:?}");
        }
        self.station.service.open(true);
        self.drive.may_enter(now, sim::AlState::SafeOp).unwrap();
        let neutral = vec![0; self.outputs.len()];
        for _ in 0..200 {
            self.now = self.now + PERIOD;
            self.drive.process(self.now, &neutral, &mut self.inputs);
        }
        self.drive.may_enter(self.now, sim::AlState::Op).unwrap();
        self.al = AlState::Op;
        self.station.operational(Some(AlState::Op), &mut self.slot);
    }

    /// Builds the outputs, twice as often as not.
    pub(super) fn prepare(&mut self) {
        let before = self.setpoint();
        self.machine.propose(self.now, &mut self.slot);
        self.station.encode(self.now, &self.slot, &mut self.outputs);
        let built = self.outputs.clone();
        self.station.encode(self.now, &self.slot, &mut self.outputs);
        assert_eq!(built, self.outputs, "built again it is the same");
        self.steepest = self.steepest.max(self.setpoint().wrapping_sub(before).saturating_abs());
    }

    pub(super) fn setpoint(&self) -> i32 {
        let entry = self.plan.outputs.places().find(|(_, entry)| entry.object != CONTROL_WORD).unwrap();
        let bytes = entry.1.kind.bytes();
        let mut raw = [0; 8];
        raw[..bytes].copy_from_slice(&self.outputs[entry.0..entry.0 + bytes]);
        entry.1.kind.number(u64::from_le_bytes(raw)) as i32
    }

    pub(super) fn control(&self) -> u16 {
        let at = self.plan.outputs.place(CONTROL_WORD).unwrap();
        u16::from_le_bytes([self.outputs[at], self.outputs[at + 1]])
    }

    /// One cycle. The inputs that come with a frame are those of before its outputs.
    pub(super) fn turn(&mut self) {
        self.prepare();
        self.send();
        self.receive();
    }

    pub(super) fn send(&mut self) {
        let deadline = self.now + PERIOD / 2;
        self.station.sent(self.now, deadline, &mut self.slot);
        if let Some(grid) = self.slot.gone.grid.take() {
            self.machine.commit(grid);
        }
        self.mails();
    }

    pub(super) fn receive(&mut self) {
        let inputs = self.inputs.clone();
        let at = self.now + 50_000;
        self.station.take(at, &inputs, self.al, &mut self.slot);
        assert!(matches!(self.slot.exchange, Exchange::Answered { suspect: false, .. }));
        self.machine.observe(self.now, self.slot.notices.restarted, &self.slot);
        let notices = &mut self.slot.notices;
        (notices.fresh, notices.restarted) = (false, false);
        notices.take_emergency();
        self.now = self.now + PERIOD;
        let (none, outputs) = (Vec::new(), self.outputs.clone());
        let driven = self.al == AlState::Op;
        self.drive.process(self.now, if driven { &outputs } else { &none }, &mut self.inputs);
        if self.drive.dropped().is_some() {
            self.al = AlState::SafeOp;
        }
    }

    pub(super) fn turns(&mut self, count: u64) {
        (0..count).for_each(|_| self.turn());
    }

    /// The acyclic slot of a frame.
    fn mails(&mut self) {
        let mut ask = Ask::default();
        self.station.service.advance(self.now, self.slot.link, self.slot.guarded);
        self.station.service.request(self.now, &mut ask);
        let mut message = Vec::new();
        if self.mail.is_empty() && self.drive.message(&mut message) {
            self.mail.push_back(message);
        }
        let came: Vec<_> = ask.datagrams().map(|(command, data)| self.carry(command, data)).collect();
        let answer = |place: usize| {
            let (working_counter, data) = came.get(place)?;
            Some(Answer { working_counter: *working_counter, data })
        };
        self.station.service.receive(self.now, &[answer(0), answer(1)], &mut self.slot.counters);
        self.station.mailbox_received(&mut self.slot);
    }

    /// A message has the size of the mailbox.
    fn carry(&mut self, command: DatagramCommand, data: &[u8]) -> (u16, Vec<u8>) {
        let [out, input] = self.plan.slave.mailbox.unwrap();
        match command {
            DatagramCommand::Fpwr(_, at) if at == out.start => {
                let mut reply = Vec::new();
                if self.drive.mailbox(data, &mut reply) {
                    self.mail.push_back(reply);
                }
                (1, data.to_vec())
            }
            DatagramCommand::Fprd(_, at) if at == input.start => {
                self.mail.pop_front().map_or((0, data.to_vec()), |message| (1, message))
            }
            DatagramCommand::Fprd(_, 0x080D) => {
                (1, [&[u8::from(!self.mail.is_empty()) << 3], &data[1..]].concat())
            }
            _ => (1, data.to_vec()),
        }
    }

    pub(super) fn order(&mut self, command: impl Into<Option<Command>>) {
        let command = command.into();
        self.machine.start(self.now, command);
    }

    pub(super) fn end(&self) -> Option<Result<(), Failure>> {
        self.machine.end()
    }

    pub(super) fn until(&mut self, what: &str, most: u64, done: impl Fn(&Rig) -> bool) -> u64 {
        for turn in 0..most {
            if done(self) {
                return turn;
            }
            self.turn();
        }
        panic!("not within {most} cycles: {what}; {:?}, {:?}", self.slot, self.machine);
    }

    pub(super) fn run(&mut self, command: Command) -> Result<(), Failure> {
        self.order(command);
        self.until(&format!("the end of {command:?}"), 20_000, |rig| rig.end().is_some());
        self.end().unwrap()
    }

    pub(super) fn done(&mut self, command: Command) {
        assert_eq!(self.run(command), Ok(()), "{command:?}");
    }

    pub(super) fn enabled(plan: KollmorgenDrive) -> Rig {
        let mut rig = Rig::new(plan);
        rig.done(Command::Enable);
        rig
    }

    pub(super) fn state(&self) -> State {
        self.slot.status.state
    }

    pub(super) fn by(way: f64) -> Command {
        Command::Move(Move { target: Target::Relative(way), profile: PROFILE })
    }

    pub(super) fn to(place: f64) -> Command {
        Command::Move(Move { target: Target::Absolute(place), profile: PROFILE })
    }

    pub(super) fn jog(velocity: f64) -> Command {
        Command::Jog(Jog { velocity, acceleration: 10.0 })
    }

    /// It stands, and goes on standing, with power.
    pub(super) fn assert_standing(&mut self) {
        self.turns(100);
        for _ in 0..100 {
            self.turn();
            let report = self.slot.status;
            assert!(!report.moving && report.velocity.abs() < 0.01, "{report:?}");
            assert_eq!(self.drive.axis_state(), State::OperationEnabled);
            assert!(self.drive.rpm().abs() < 1.0);
        }
    }
}
