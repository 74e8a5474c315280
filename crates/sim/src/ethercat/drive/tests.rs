//! The simulated drive against the sheet, cycle by cycle, in its own time.

mod messages;
mod motion;

use super::*;
use crate::ethercat::Dialect;
use crate::ethercat::codec::cia402::status;
use crate::ethercat::codec::mailbox::abort;
use crate::ethercat::codec::objects::dictionary;
use fieldbeat_core::time::US;

/// Counts a turn.
const TURN: i32 = 1 << 20;

/// A drive, a master's notion of time, and what it sends in every cycle.
struct Bench {
    drive: Drive,
    now: Time,
    cycle_ns: u64,
    outputs: Vec<u8>,
    inputs: Vec<u8>,
}

impl Bench {
    /// In INIT.
    fn new(change: impl FnOnce(&mut DriveSettings)) -> Bench {
        Bench::of(Family::S700, change)
    }

    fn of(family: Family, change: impl FnOnce(&mut DriveSettings)) -> Bench {
        let mut settings = DriveSettings::new(family);
        change(&mut settings);
        let drive = Drive::new(settings);
        let (outputs, inputs) = drive.sizes();
        Bench { drive, now: Time(5 * S), cycle_ns: MS, outputs: vec![0; outputs], inputs: vec![0; inputs] }
    }

    fn enter(&mut self, state: AlState) -> Result<(), u16> {
        self.drive.may_enter(self.now, state)
    }

    /// In PREOP.
    fn pre_op(change: impl FnOnce(&mut DriveSettings)) -> Bench {
        let mut bench = Bench::new(change);
        bench.enter(AlState::PreOp).unwrap();
        bench
    }

    /// From PREOP to OP, with cycles, the usual way.
    fn go_to_op(&mut self) {
        let (outputs, inputs) = self.drive.sizes();
        (self.outputs, self.inputs) = (vec![0; outputs], vec![0; inputs]);
        self.enter(AlState::SafeOp).unwrap();
        self.cycles(100);
        assert!(self.drive.is_synchronous());
        self.enter(AlState::Op).unwrap();
    }

    /// In OP, in this mode with these PDOs.
    fn op(mode: i8, outputs: u16, inputs: u16) -> Bench {
        let mut bench = Bench::pre_op(|_| {});
        bench.select(0x1C12, outputs);
        bench.select(0x1C13, inputs);
        bench.write(0x6060, 0, &[mode as u8]).unwrap();
        bench.go_to_op();
        bench
    }

    /// In OP with operation enabled, in this mode with these PDOs.
    fn enabled(mode: i8, outputs: u16, inputs: u16) -> Bench {
        let mut bench = Bench::op(mode, outputs, inputs);
        bench.put(INTERPOLATION, bench.drive.position());
        bench.put(TARGET_POSITION, bench.drive.position());
        bench.enable();
        bench
    }

    /// Operation enabled with this velocity setpoint, after so many cycles.
    fn turning(setpoint: i64, cycles: u32) -> Bench {
        let mut bench = Bench::enabled(mode::DIGITAL_VELOCITY, 0x1702, 0x1B03);
        bench.put(VELOCITY_SETPOINT, setpoint);
        bench.cycles(cycles);
        bench
    }

    fn enable(&mut self) {
        [0x06, 0x07, 0x0F].into_iter().for_each(|word| self.control(word));
        assert_eq!(self.drive.axis_state(), State::OperationEnabled);
    }

    fn select(&mut self, assignment: u16, pdo: u16) {
        self.write(assignment, 0, &[0]).unwrap();
        self.write(assignment, 1, &pdo.to_le_bytes()).unwrap();
        self.write(assignment, 0, &[1]).unwrap();
    }

    /// One cycle.
    fn cycle(&mut self) {
        self.now = self.now + self.cycle_ns;
        self.drive.process(self.now, &self.outputs, &mut self.inputs);
    }

    fn cycles(&mut self, count: u32) {
        (0..count).for_each(|_| self.cycle());
    }

    /// A control word for a cycle.
    fn control(&mut self, word: u16) {
        self.put(CONTROL_WORD, word.into());
        self.cycle();
    }

    /// A value in the outputs, if it is mapped.
    fn put(&mut self, object: Object, value: i64) {
        let layout = self.drive.selected(OUTPUT_PDO).unwrap();
        if let Some(place) = layout.place(object) {
            let bytes = value.to_le_bytes();
            self.outputs[place].iter_mut().zip(bytes).for_each(|(output, byte)| *output = byte);
        }
    }

    /// A value in the inputs.
    fn got(&self, object: Object) -> i64 {
        let place = self.drive.selected(INPUT_PDO).unwrap().place(object).unwrap();
        self.number(object, &self.inputs[place])
    }

    fn status(&self) -> u16 {
        self.got(STATUS_WORD) as u16
    }

    fn shows(&self, bits: u16) -> bool {
        self.status() & bits == bits
    }

    fn is(&self, state: State) -> bool {
        self.status() & 0x6F == cia402::status_of(state)
    }

    /// The number in the bytes of an object.
    fn number(&self, object: Object, bytes: &[u8]) -> i64 {
        let all = dictionary(self.drive.settings.family);
        all.iter().find(|(own, ..)| *own == object).unwrap().1.read(bytes)
    }

    fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), u32> {
        self.drive.write(Object::new(index, sub), data)
    }

    fn read(&mut self, index: u16, sub: u8) -> Result<i64, u32> {
        let data = self.bytes(index, sub)?;
        Ok(self.number(Object::new(index, sub), &data))
    }

    /// The bytes of an object.
    fn bytes(&mut self, index: u16, sub: u8) -> Result<Vec<u8>, u32> {
        self.drive.refresh();
        self.drive.read(Object::new(index, sub))
    }

    /// The emergencies that wait.
    fn emergencies(&mut self) -> Vec<u16> {
        let mut reply = Vec::new();
        let mut codes = Vec::new();
        while self.drive.message(&mut reply) {
            if reply[7] >> 4 == 1 {
                codes.push(u16::from_le_bytes([reply[8], reply[9]]));
            }
        }
        codes
    }
}

#[test]
fn going_through_pre_op_deletes_what_is_not_fatal() {
    let mut bench = Bench::pre_op(|_| {});
    bench.drive.provoke(0x3100);
    assert_eq!(bench.read(0x1003, 1), Ok(0x3100));
    bench.go_to_op();
    assert_eq!(bench.drive.fault(), None);
    bench.enter(AlState::PreOp).unwrap();
    bench.drive.provoke(0x2380);
    bench.go_to_op();
    assert_eq!(bench.drive.fault(), Some(0x2380));
}

#[test]
fn a_cycle_of_another_length_than_60c2_never_makes_it_synchronous() {
    let mut bench = Bench::pre_op(|_| {});
    // 2 ms, in the form 20 x 10^-4.
    bench.write(0x60C2, 1, &[20]).unwrap();
    bench.write(0x60C2, 2, &[-4_i8 as u8]).unwrap();
    assert_eq!(bench.read(0x35D5, 1), Ok(8));
    assert_eq!(bench.read(0x1C32, 2), Ok(2_000_000));
    bench.enter(AlState::SafeOp).unwrap();
    bench.cycles(300);
    assert!(!bench.drive.is_synchronous());
    bench.cycle_ns = 2 * MS;
    bench.cycles(110);
    assert!(bench.drive.is_synchronous());
    // 1.1 ms is no multiple of 250 us.
    bench.enter(AlState::PreOp).unwrap();
    bench.write(0x60C2, 1, &[11]).unwrap();
    bench.cycle_ns = 1_100 * US;
    bench.enter(AlState::SafeOp).unwrap();
    bench.cycles(300);
    assert!(!bench.drive.is_synchronous());
}

#[test]
fn two_cycles_that_fail_in_a_row_stop_it_and_drop_it_to_safe_op() {
    let mut bench = Bench::turning(1_000, 200);
    let rpm = bench.drive.rpm();
    assert!(rpm > 200.0, "{rpm}");
    bench.now = bench.now + MS;
    bench.cycle();
    assert_eq!((bench.drive.al_state(), bench.drive.dropped()), (AlState::Op, None), "one is forgiven");
    bench.cycles(10);
    bench.now = bench.now + 2 * MS;
    bench.cycle();
    assert_eq!(bench.drive.dropped(), Some(code::SYNCHRONISATION));
    assert_eq!((bench.drive.al_state(), bench.drive.dropped()), (AlState::SafeOp, None));
    assert_eq!(bench.drive.fault(), Some(fault::SYNCHRONISATION));
    bench.cycles(200);
    assert_eq!(bench.drive.axis_state(), State::Fault);
    assert!(bench.drive.rpm().abs() < 1.0);
    // A master that dies is noticed without another cycle.
    let mut bench = Bench::turning(1_000, 200);
    bench.drive.advance(bench.now + 10 * S);
    assert_eq!(bench.drive.dropped(), Some(code::SYNCHRONISATION));
    assert_eq!(bench.drive.axis_state(), State::Fault);
    assert!(bench.drive.rpm().abs() < 1.0);
}

#[test]
fn the_status_words_of_the_sheet_are_those_on_the_way_up() {
    let mut bench = Bench::op(mode::DIGITAL_VELOCITY, 0x1702, 0x1B03);
    // No step is left out.
    for (control, status) in [(0, 0x0240), (0x0F, 0x0240), (6, 0x0221), (7, 0x0633), (0x0F, 0x0637)] {
        bench.control(control);
        assert_eq!(bench.status(), status);
    }
    bench.control(0x02);
    bench.cycle();
    assert!(bench.is(State::SwitchOnDisabled), "it stood: the quick stop was short");
}

#[test]
fn leaving_op_stops_quickly_and_switches_off() {
    let mut bench = Bench::turning(2_000, 200);
    bench.enter(AlState::SafeOp).unwrap();
    bench.cycle();
    assert!(bench.is(State::QuickStopActive));
    bench.cycles(100);
    assert!(bench.is(State::SwitchOnDisabled));
    assert!(bench.drive.rpm().abs() < 1.0);
    bench.enter(AlState::Op).unwrap();
    bench.cycle();
    assert!(bench.is(State::SwitchOnDisabled), "the old word is obeyed, but is no shutdown");
}

#[test]
fn a_fault_stops_the_motor_and_is_reset_by_a_rising_edge() {
    let mut bench = Bench::turning(4_000, 300);
    bench.put(CONTROL_WORD, 0x8F);
    bench.drive.provoke(0x4110);
    bench.cycle();
    assert!(bench.is(State::FaultReactionActive));
    bench.cycles(100);
    assert!(bench.is(State::Fault), "bit 7 stood before the fault was over");
    assert_eq!(bench.emergencies(), [0x4110]);
    assert_eq!(bench.read(0x1001, 0), Ok(9));
    bench.control(0x00);
    bench.control(0x80);
    assert!(bench.is(State::SwitchOnDisabled));
    assert_eq!(bench.emergencies(), [0]);
    assert_eq!(bench.read(0x1001, 0), Ok(0));
    bench.enable();
}

#[test]
fn without_its_hardware_enable_it_has_no_power() {
    let mut bench = Bench::turning(1_000, 100);
    bench.drive.open_sto(bench.now + 50 * MS);
    bench.cycle();
    assert!(bench.is(State::SwitchOnDisabled));
    [0x06, 0x07, 0x0F].into_iter().for_each(|word| bench.control(word));
    assert!(bench.is(State::ReadyToSwitchOn));
    assert!(bench.drive.rpm() > 50.0, "it coasts");
    bench.cycles(50);
    [0x06, 0x07, 0x0F].into_iter().for_each(|word| bench.control(word));
    assert!(bench.is(State::OperationEnabled));
    // A restart loses what was written, and the motor goes on turning.
    bench.cycles(200);
    bench.drive.restart(bench.now);
    assert_eq!((bench.drive.al_state(), bench.drive.axis_state()), (AlState::Init, State::SwitchOnDisabled));
    assert!(bench.drive.rpm() > 100.0);
    bench.drive.advance(bench.now + 100 * S);
    assert!(bench.drive.rpm().abs() < 1.0, "friction ends it");
}
