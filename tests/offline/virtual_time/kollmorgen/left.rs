//! Segments that another master left behind, taken over by the whole loop.

use fieldbeat::CyclePlan;
use fieldbeat::axis::{self, FoundRunning, Link, Outcome, StopCause};
use fieldbeat::bus::ethercat::{EthercatPlan, Family, KollmorgenDrive, Layout, Mapping, Object, Watchdog};
use fieldbeat::sim::{SimSegment, WorldOptions};
use fieldbeat::time::{MS, S, Time, US};
use fieldbeat_ethercat::wire::frame::{Command, position};
use fieldbeat_ethercat::wire::registers::{Fmmu, address};
use fieldbeat_sim::ethercat::{AlState, EthercatSegment, EthercatSim};

use super::drives::left;
use super::{LINE, Machine, UP, drive, jog, pass};

impl Machine {
    /// Its master is gone for so long, and another one comes.
    fn left_for(self, plan: &EthercatPlan, ns: u64, change: impl FnOnce(&mut Left)) -> Machine {
        let segment = self.look(|line| std::mem::replace(line, EthercatSim::of(plan)));
        let now = self.sim.world().now() + ns;
        let mut of = Left { segment, now };
        // In small steps: a clock catches up with a second of SYNC0 at most.
        for since in (0..ns).step_by(100 * MS as usize) {
            of.segment.advance(Time(now.0 - ns + since));
        }
        of.segment.advance(now);
        change(&mut of);
        let options = WorldOptions { start: now, ..WorldOptions::default() };
        Machine::on(Box::new(plan.clone()), left(of.segment), CyclePlan::default(), options)
    }

    fn cycles_to_online(&mut self) -> u64 {
        let count = self.count;
        self.until("online", UP, |machine| {
            (0..count).all(|index| machine.feedback(index).link == Link::Online)
        })
    }
}

/// Another master for a segment that the first one has just left.
pub fn take_over(first: Machine, plan: &EthercatPlan, found: FoundRunning) -> Machine {
    let mut plan = plan.clone();
    plan.drives.iter_mut().for_each(|drive| drive.axis.on_found_running = found);
    first.left_for(&plan, 0, |_| ())
}

/// A segment without a master.
struct Left {
    segment: EthercatSim,
    now: Time,
}

impl Left {
    fn write(&mut self, place: u16, register: u16, data: &[u8]) {
        pass(&mut self.segment, self.now, Command::Apwr(position(place), register), data);
    }

    /// As a master leaves it that numbers stations from 1000h on, and gives the SII to the processor.
    fn numbered_otherwise(&mut self) {
        for place in 0..3 {
            self.write(place, address::STATION, &(0x1000 + place).to_le_bytes());
            self.write(place, address::SII_OWNER, &[1]);
        }
    }

    /// The slave there has another time, SYNC0 of another period, and an FMMU more.
    fn set_otherwise(&mut self, place: u16, offset: u64, period_ns: u64) {
        self.write(place, address::DC_ACTIVATION, &[0]);
        self.write(place, address::DC_OFFSET, &offset.to_le_bytes());
        self.write(place, address::DC_CYCLE, &period_ns.to_le_bytes());
        let start = self.segment.slave(place.into()).unwrap().system_time(self.now) + 10 * period_ns;
        self.write(place, address::DC_START, &start.to_le_bytes());
        self.write(place, address::DC_ACTIVATION, &[3]);
        self.write(place, address::fmmu(5), &Fmmu::bytes(0, 64, 0x1100, false).to_bytes());
    }
}

/// Slots that a drive found in OP takes more than a fresh one: SyncManagers, the station address, the status word; with
/// power the clock, FMMUs and the objects that are compared. Each slot takes two cycles for each of three slaves.
const UNPOWERED: u64 = 60;
const POWERED: u64 = 160;
/// The clocks of others are set so much later then, and whether they have settled is looked at every 100 ms.
const SETTLE_LOOK: u64 = 100;

/// Three drives; clocks take so many comparisons to settle, and drift by this at most.
fn segment(watchdog: Watchdog, settling: u16, drift_ppm: f64) -> EthercatSegment {
    let drives = (0..3).map(|place| {
        let mut drive = unwatched(drive(place, Family::S700));
        drive.slave.watchdog = watchdog;
        drive
    });
    let mut segment = EthercatSegment::from(EthercatPlan::new(LINE, drives.collect()));
    segment.settings.settling = settling;
    segment.settings.drift_ppm = vec![drift_ppm, -drift_ppm, drift_ppm / 3.0];
    segment
}

/// What must not change of a drive that turns.
#[derive(Debug)]
struct Turning {
    place: usize,
    rpm: f64,
    /// When SYNC0 comes in the periods of the grid, ns.
    sync0_ns: u64,
    watchdog: Vec<u8>,
}

impl Machine {
    /// All drives in OP; these turn, the others have no power.
    fn turning(segment: &EthercatSegment, places: &[usize]) -> Machine {
        let mut machine = Machine::new(segment.clone());
        machine.online();
        machine.run(200);
        for place in places {
            machine.done(*place, axis::Command::Enable);
            machine.post(*place, jog(1.0));
        }
        machine.run(300);
        machine
    }

    fn seen(&self, place: usize) -> Turning {
        let now = self.sim.world().now();
        let to_sync0 = self.look(|line| line.slave(place).unwrap().sync0_in_ns(now)).expect("it has SYNC0");
        Turning {
            place,
            rpm: self.drive(place, |drive| drive.rpm()),
            sync0_ns: (now.0 + to_sync0) % MS,
            watchdog: self.pass(Command::Aprd(position(place as u16), address::WATCHDOG_DIVIDER), &[0; 0x22]),
        }
    }

    fn is_powered(&self, place: usize) -> bool {
        self.drive(place, |drive| drive.axis_state().is_powered())
    }

    /// Cycles until all are online, and that the ones that turn are stopped by the master's ramp alone.
    fn cycles_undisturbed(&mut self, turning: &[usize]) -> u64 {
        let begun: Vec<_> = turning.iter().map(|place| self.seen(*place)).collect();
        let mut before: Vec<_> = begun.iter().map(|turning| turning.rpm).collect();
        let mut online = None;
        for cycle in 0..UP {
            if (0..self.count).all(|index| self.feedback(index).link == Link::Online) {
                online = online.or(Some(cycle));
            }
            if let Some(cycles) = online.filter(|_| !turning.iter().any(|place| self.is_powered(*place))) {
                return cycles;
            }
            self.run(1);
            for (begun, before) in begun.iter().zip(&mut before) {
                let place = begun.place;
                if !self.is_powered(place) {
                    continue;
                }
                let (al, fault, is_synchronous) =
                    self.drive(place, |drive| (drive.al_state(), drive.fault(), drive.is_synchronous()));
                assert_eq!((al, fault, is_synchronous), (AlState::Op, None, true), "{place} in {cycle}");
                let seen = self.seen(place);
                assert!((seen.rpm - *before).abs() < 1.0, "{before} rpm before {seen:?} in {cycle}");
                let off = (seen.sync0_ns + MS + MS / 2 - begun.sync0_ns) % MS;
                assert!(off.abs_diff(MS / 2) < 10 * US, "{begun:?} and {seen:?} in {cycle}");
                assert_eq!(seen.watchdog, begun.watchdog);
                *before = seen.rpm;
            }
        }
        panic!("{:?} {:?}", self.feedback(0), self.feedback(1));
    }
}

#[test]
fn drives_left_in_op_are_online_in_the_time_of_a_fresh_segment_wherever_their_sync0_comes() {
    for (settling, phases) in [(32, &[0, 250, 500, 750, 999][..]), (1_024, &[500])] {
        let segment = segment(Watchdog::After(S), settling, 30.0);
        let fresh = Machine::new(segment.clone()).cycles_to_online();
        for phase in phases {
            for turning in [&[][..], &[0], &[1], &[0, 1, 2]] {
                let first = Machine::turning(&segment, turning);
                let mut machine =
                    first.left_for(&segment.plan, 3 * MS + phase * US, Left::numbered_otherwise);
                let cycles = machine.cycles_undisturbed(turning);
                let more = if turning.is_empty() { UNPOWERED } else { POWERED + SETTLE_LOOK };
                assert!(
                    cycles <= fresh + more,
                    "{turning:?}, {phase} us: {cycles} cycles, and {fresh} of a fresh segment"
                );
            }
        }
    }
}

#[test]
fn clocks_left_at_any_time_and_period_delay_no_start() {
    let segment = segment(Watchdog::Off, 1_024, 30.0);
    let fresh = Machine::new(segment.clone()).cycles_to_online();
    for (offset, period_ns) in [(7, 250 * US), (1 << 62, 2 * MS), (u64::MAX / 3, 777_777)] {
        let first = Machine::turning(&segment, &[]);
        let mut machine = first.left_for(&segment.plan, S, |left| {
            left.numbered_otherwise();
            (0..3)
                .for_each(|place| left.set_otherwise(place, offset * (1 + u64::from(place) % 2), period_ns));
        });
        let cycles = machine.cycles_undisturbed(&[]);
        assert!(cycles <= fresh + UNPOWERED, "{offset}: {cycles} cycles, and {fresh} of a fresh segment");
    }
}

/// A second without a time from anybody, and clocks so bad that theirs are half a period apart.
#[test]
fn drives_running_on_two_dc_times_are_not_disturbed_and_all_are_set_up() {
    let segment = segment(Watchdog::Off, 32, 250.0);
    let first = Machine::turning(&segment, &[0, 1]);
    let mut machine = first.left_for(&segment.plan, S, Left::numbered_otherwise);
    machine.cycles_undisturbed(&[0, 1]);
    // Without power they are set up.
    machine.run(3_000);
    for index in 0..3 {
        let stopped = (index < 2).then_some(StopCause::FoundRunning);
        assert_eq!(machine.feedback(index).stopped, stopped, "{index}");
        machine.recover(index);
        machine.post(index, jog(1.0));
        machine.run(600);
        machine.assert_turns(index, 1.0);
    }
}

/// A drive that goes on by itself when its master is gone.
fn unwatched(mut drive: KollmorgenDrive) -> KollmorgenDrive {
    drive.slave.watchdog = Watchdog::Off;
    drive.accept_no_watchdog = true;
    (drive.axis.stop.deceleration, drive.axis.profile.velocity) = (2.0, 2.0);
    drive
}

fn line(drive: KollmorgenDrive) -> EthercatPlan {
    EthercatPlan::new(LINE, vec![drive])
}

/// Left as it turns by the master of one plan, and found by that of another.
fn left_turning(left: &EthercatPlan, found: &EthercatPlan, how: FoundRunning) -> Machine {
    let mut first = Machine::enabled(left.clone());
    first.post(0, jog(1.0));
    first.run(500);
    take_over(first, found, how)
}

fn rpm(machine: &Machine) -> f64 {
    machine.drive(0, |drive| drive.rpm())
}

fn free(outputs: &[u16], inputs: &[u16]) -> KollmorgenDrive {
    let objects = |indices: &[u16]| indices.iter().map(|index| Object::new(*index, 0)).collect::<Vec<_>>();
    let mut free = unwatched(drive(0, Family::S700));
    free.outputs = Layout::of_known(0x1600, &objects(outputs)).unwrap();
    free.inputs = Layout::of_known(0x1A00, &objects(inputs)).unwrap();
    free.mapping = Mapping::Free;
    free.fit();
    free
}

#[test]
fn a_drive_that_runs_with_other_objects_is_not_joined() {
    let plain = unwatched(drive(0, Family::S700));
    // As many bytes, in another order.
    let one = free(&[0x606B, 0x6040], &[0x6041, 0x6064, 0x606C]);
    let two = free(&[0x606B, 0x6040], &[0x6041, 0x606C, 0x6064]);
    let three = free(&[0x6040, 0x606B], &[0x6041, 0x6064, 0x606C]);
    for (left, found, joined) in
        [(&plain, &plain, true), (&one, &one, true), (&one, &two, false), (&one, &three, false)]
    {
        let mut machine = left_turning(&line(left.clone()), &line(found.clone()), FoundRunning::Refuse);
        machine.run(3_000);
        let feedback = machine.feedback(0);
        assert!((rpm(&machine) - 60.0).abs() < 3.0, "it is left alone: {} {feedback:?}", rpm(&machine));
        assert_eq!(feedback.link == Link::Online, joined, "{feedback:?}");
        let al = machine.look(|line| line.slave(0).unwrap().state());
        assert_eq!(al, AlState::Op);
        if joined {
            assert_eq!(feedback.stopped, Some(StopCause::FoundRunning));
            continue;
        }
        // By its own reaction to the end of OP, if it is to be stopped.
        let mut machine = left_turning(&line(left.clone()), &line(found.clone()), FoundRunning::Stop);
        machine.online();
        assert!(rpm(&machine).abs() < 3.0, "{}", rpm(&machine));
        machine.recover(0);
    }
}

#[test]
fn a_drive_found_without_power_is_set_up_before_its_axis_gets_a_report() {
    let plan = line(unwatched(drive(0, Family::S700)));
    let mut first = Machine::new(plan.clone());
    first.online();
    let mut machine = take_over(first, &plan, FoundRunning::Stop);
    machine.online();
    let id = machine.sim.axis(0).post(axis::Command::Enable).unwrap();
    let mut lowest = AlState::Op;
    for _ in 0..3_000 {
        machine.run(1);
        lowest = lowest.min(machine.look(|line| line.slave(0).unwrap().state()));
        assert_eq!((machine.feedback(0).link, machine.feedback(0).stopped), (Link::Online, None));
    }
    assert_eq!(lowest, AlState::Op, "all of that was over");
    assert_eq!(machine.sim.run_command(0, id, 1), Some(Outcome::Done));
}
