//! The segment against a simulated one, frame by frame, in virtual time.

mod clocks;
mod emulated;
mod found;
mod left;
mod managers;
mod refused;
mod sii;

use crate::{foreign, only};
use fieldbeat_core::axis::FoundRunning;
use fieldbeat_core::bus::Cycle;
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::time::{MS, S, Time, US};
use fieldbeat_ethercat::counters::Own;
use fieldbeat_ethercat::image::{Image, Mark, Read};
use fieldbeat_ethercat::object::Family;
use fieldbeat_ethercat::plan::{
    Area, Device, EthercatPlan, Expected, FIRST_STATION, KollmorgenDrive, Owner, SlavePlan, Start,
};
use fieldbeat_ethercat::segment::note::Note;
use fieldbeat_ethercat::segment::slave::Slave;
use fieldbeat_ethercat::segment::*;
use fieldbeat_ethercat::service::Service;
use fieldbeat_ethercat::slot::Answers;
use fieldbeat_ethercat::wire::frame::{Command, datagrams, position};
use fieldbeat_ethercat::wire::registers::{AlState, address};
use fieldbeat_sim::SimSegment;
use fieldbeat_sim::ethercat::{self, Coupler, Esc, EthercatSegment, EthercatSim, Settings};

/// The step of a slave, and how far it is, for people.
fn at(slave: &Slave) -> String {
    let all = format!("{slave:?}");
    let (_, from) = all.split_once("step: ").unwrap();
    format!("{} {:?}", from.split_once(", since: ").unwrap().0, slave.way)
}

/// The segment's reports to its handler.
#[derive(Default)]
struct Reports {
    states: Vec<(Owner, Option<AlState>)>,
    taken: Vec<Owner>,
    passed_by: Vec<Owner>,
    restarted: Vec<Owner>,
    wrong_counts: u64,
}

impl Handler for Reports {
    fn service(&mut self, _owner: Owner) -> Option<&mut Service> {
        None
    }

    fn advance(&mut self, _owner: Owner, _now: Time) -> Option<&mut Service> {
        None
    }

    fn state(&mut self, owner: Owner, state: SlaveState) {
        self.states.push((owner, state.al));
    }

    fn restarted(&mut self, owner: Owner) {
        self.restarted.push(owner);
    }

    fn mailbox_received(&mut self, _owner: Owner, _now: Time, _answers: &Answers<'_>) {}

    fn wants_outputs(&self, _owner: Owner) -> bool {
        false
    }

    fn powered(&self, owner: Owner) -> Option<(bool, Time)> {
        matches!(owner, Owner::Drive(_)).then_some((false, Time(0)))
    }

    fn own_values(&mut self, _owner: Owner, _values: &[Start]) {}

    fn expect_silence(&mut self, _owner: Owner) {}

    fn take(&mut self, owner: Owner, taken: Taken<'_>) {
        assert!(taken.in_window && !(taken.inputs.is_empty() && matches!(owner, Owner::Drive(_))));
        self.taken.push(owner);
    }

    fn passed_by(&mut self, owner: Owner) {
        self.passed_by.push(owner);
    }

    fn count(&mut self, owner: Owner, counter: Own) {
        if let Owner::Drive(_) = owner {
            self.wrong_counts += u64::from(counter == Own::WrongCount);
        }
    }
}

/// A segment, a simulated one, and the loop between them.
struct Rig {
    line: Segment,
    image: Image,
    sim: EthercatSim,
    drives: usize,
    reported: Reports,
    cycle: Cycle,
    number: u32,
    /// Frames are lost.
    lossy: bool,
    /// The next frame comes back when it is requested.
    late: bool,
    /// Requests to the slave at this position come back as if it had not been there.
    mute: Option<u16>,
    held: Option<(Sent, Vec<u8>, u16)>,
}

impl Rig {
    fn new(plan: &EthercatPlan) -> Rig {
        Rig::on(plan, plan)
    }

    /// A segment of more slaves than the master knows of.
    fn on(plan: &EthercatPlan, whole: impl Into<EthercatSegment>) -> Rig {
        Rig::based(plan, whole, 0x1000_0000)
    }

    fn based(plan: &EthercatPlan, whole: impl Into<EthercatSegment>, base: u32) -> Rig {
        let slaves = plan.slaves();
        let (image, offsets) = Image::new(&slaves, base, [0x10; 6], true, plan.lrw).unwrap();
        let grid = Time(50 * S);
        Rig {
            line: Segment::new(plan, offsets, MS),
            image,
            sim: EthercatSim::new(&whole.into()),
            reported: Reports::default(),
            drives: plan.drives.len(),
            cycle: Cycle { index: 0, grid, period_ns: MS, deadline: grid + MS / 2 },
            number: 0,
            lossy: false,
            late: false,
            mute: None,
            held: None,
        }
    }

    fn step(&mut self) {
        self.cycle.index += 1;
        self.cycle.grid = self.cycle.grid + MS;
        let late = u64::from(self.number % 250) * 131;
        let at = self.cycle.grid + late;
        let first = &mut self.image.frames_mut()[0];
        self.line.prepare(&self.cycle, first, &mut self.reported);
        for (number, frame) in self.image.frames_mut().iter_mut().enumerate() {
            frame.load_outputs();
            frame.number(Mark { master: 7, number: self.number });
            self.number += 1;
            if number == 0 {
                frame.set_time(self.line.clock.sent_time(&self.cycle, at));
                self.line.clock.lead_on();
            }
            let mut received = frame.bytes().to_vec();
            let came = self.sim.pass(at, &mut received);
            if !came || self.lossy && self.number.is_multiple_of(7) {
                self.line.lost(at, number == 0, &mut self.reported);
                continue;
            }
            if let Some(place) = self.mute {
                uncount(place, frame.bytes(), &mut received);
            }
            let Read::Good(counter) = frame.read(&received) else { panic!("a frame of our own") };
            let sent = Sent { cycle: self.cycle, at };
            if self.late {
                self.held = Some((sent, received, counter));
                continue;
            }
            let back =
                Back { sent: &sent, frame, at: at + 30 * US, received: &received, counter, in_window: true };
            self.line.receive(&back, number, &mut self.reported);
        }
    }

    fn deliver(&mut self) {
        let (sent, received, counter) = self.held.take().unwrap();
        let frame = &self.image.frames()[0];
        let back = Back { sent: &sent, frame, at: sent.at, received: &received, counter, in_window: false };
        self.line.receive(&back, 0, &mut self.reported);
    }

    fn run(&mut self, cycles: usize) {
        for _ in 0..cycles {
            self.step();
        }
    }

    fn until(&mut self, what: &str, most: usize, done: impl Fn(&mut Rig) -> bool) -> usize {
        for cycle in 0..most {
            if done(self) {
                return cycle;
            }
            self.step();
        }
        let slaves: Vec<_> = self.line.slaves.iter().map(at).collect();
        panic!("not within {most} cycles: {what}; {slaves:?}");
    }

    fn al(&mut self, place: usize) -> AlState {
        AlState::new(self.slave(place).state() as u8).unwrap()
    }

    fn slave(&mut self, place: usize) -> &mut Esc {
        self.sim.slave(place).unwrap()
    }

    /// A datagram of another master, and its data as they come back.
    fn pass(&mut self, command: Command, data: &[u8]) -> Vec<u8> {
        let sim = &mut self.sim;
        let pass = |now, frame: &mut [u8]| _ = sim.pass(now, frame);
        only(&foreign(self.cycle.grid, command, data, pass)).0
    }

    fn poke(&mut self, place: u16, register: u16, data: &[u8]) {
        self.pass(Command::Apwr(position(place), register), data);
    }

    fn peek(&mut self, place: u16, register: u16, length: usize) -> Vec<u8> {
        self.pass(Command::Aprd(position(place), register), &vec![0; length])
    }

    fn assert_own_addresses(&mut self) {
        for place in 0..self.line.slaves.len() as u16 {
            assert_eq!(self.peek(place, address::STATION, 2), (FIRST_STATION + place).to_le_bytes());
        }
    }

    /// Lets the segment go, within so many cycles.
    fn down(&mut self, most: usize) {
        self.until("all down", most, |rig| {
            let now = rig.cycle.grid;
            rig.line.shut_down(now)
        });
    }

    /// How far its time is from ours.
    fn time_off(&mut self, place: usize) -> i64 {
        let now = self.cycle.grid + MS / 2;
        self.slave(place).system_time(now).wrapping_sub(now.0) as i64
    }

    fn all_up(&mut self, most: usize) -> usize {
        let count = self.line.slaves.len();
        self.until("all in OP", most, |rig| (0..count).all(|index| rig.line.is_operational(index)))
    }
}

/// The working counters of what was sent to the slave at this position are 0.
fn uncount(place: u16, sent: &[u8], received: &mut [u8]) {
    for datagram in datagrams(sent).unwrap().map_while(Result::ok) {
        if let Some(Command::Aprd(to, _) | Command::Apwr(to, _)) = datagram.command()
            && to == position(place)
        {
            let counter = datagram.place.data().end;
            received[counter..counter + 2].fill(0);
        }
    }
}

fn drives(count: u16) -> EthercatPlan {
    let drive = |place| KollmorgenDrive::new(format!("d{place}"), place, Family::S700);
    EthercatPlan::new("local:test", (0..count).map(drive).collect())
}

/// A byte either way.
fn coupler(place: u16) -> Device {
    let area = |start| vec![Area { start, length: 1 }];
    let slave = SlavePlan {
        outputs: area(0x1000),
        inputs: area(0x1100),
        identity: Expected::default(),
        ..SlavePlan::new(place)
    };
    Device { name: "io".into(), slave }
}

/// Of terminals with a byte either way, and nothing else.
fn terminals() -> EthercatPlan {
    EthercatPlan { devices: vec![coupler(0)], ..drives(0) }
}

const IO: ethercat::Identity = ethercat::Identity { vendor: 2, product: 0, revision: 0 };

impl Rig {
    /// The terminals of this plan, with these settings of their controllers.
    fn io(plan: &EthercatPlan, settings: Settings) -> Rig {
        let settings = Settings { features: 0x0180, ..settings };
        let slave = |device| Coupler::of(device).slave("I/O", IO, settings.clone());
        Rig::of(plan, plan.devices.iter().map(slave).collect())
    }

    fn of(plan: &EthercatPlan, slaves: Vec<Esc>) -> Rig {
        let mut rig = Rig::new(plan);
        *rig.sim.segment() = ethercat::Segment::new(slaves);
        rig
    }

    /// Drives of which the one at this place is another product than the configured one.
    fn with_other(count: u16, place: usize) -> Rig {
        let mut plan = drives(count);
        plan.drives[place].slave.identity.product = Some(7);
        let mut whole = EthercatSegment::from(&plan);
        whole.drives[place].identity.product = 8;
        Rig::on(&plan, whole)
    }

    /// Runs so many cycles, and how often each drive answered in them.
    fn receive(&mut self, cycles: usize) -> Vec<usize> {
        self.reported.taken.clear();
        self.run(cycles);
        let count = |index| self.reported.taken.iter().filter(|owner| **owner == Owner::Drive(index)).count();
        (0..self.drives).map(count).collect()
    }

    fn note(&self, index: usize) -> Note {
        self.line.notes.get(index)
    }

    /// Gives the terminals at this place a value.
    fn put_out(&mut self, place: usize, value: u8) {
        let offsets = self.line.slaves[place].offsets.clone();
        self.image.frames_mut()[0].outputs(&offsets.outputs).unwrap().copy_from_slice(&[value]);
    }
}

#[test]
fn a_segment_comes_up_to_op_and_every_frame_counts() {
    let mut mixed = drives(2);
    mixed.drives[1].slave.place = 2;
    mixed.devices = vec![coupler(1)];
    for (what, plan, lossy) in [
        ("by one datagram", drives(3), false),
        ("without LRW by two", EthercatPlan { lrw: false, ..drives(3) }, false),
        ("with terminals in between", mixed, false),
        ("though frames are lost", drives(2), true),
    ] {
        let (count, slaves) = (plan.drives.len(), plan.drives.len() + plan.devices.len());
        let mut rig = Rig::new(&plan);
        rig.lossy = lossy;
        rig.all_up(if lossy { 4_000 } else { 3_000 });
        assert!((0..slaves).all(|place| rig.al(place) == AlState::Op), "{what}");
        assert!((0..slaves).all(|index| rig.note(index) == Note::None), "{what}");
        if !lossy {
            assert_eq!(rig.receive(500), vec![500; count], "{what}");
            assert_eq!(rig.reported.taken.len(), 500 * slaves, "{what}");
            assert!(rig.reported.passed_by.is_empty() && rig.reported.restarted.is_empty(), "{what}");
        }
        for place in count..slaves {
            rig.put_out(place - 1, 0xA5);
            rig.run(2);
        }
        assert_eq!(rig.reported.wrong_counts, 0, "{what}");
    }
}

#[test]
fn a_drive_that_receives_nothing_costs_no_other_one_a_frame_and_comes_back() {
    let mut rig = Rig::new(&drives(5));
    rig.all_up(4_000);
    rig.sim.deafen(2, true);
    assert_eq!(rig.receive(1_000), [1_000, 1_000, 0, 1_000, 1_000]);
    // It is not counted: at its place there is the one behind it, and is left alone.
    assert_eq!((rig.reported.wrong_counts, rig.note(2)), (0, Note::WrongPlace(3)));
    assert_eq!(rig.reported.states.last(), Some(&(Owner::Drive(2), None)));
    rig.sim.deafen(2, false);
    let frames = rig.reported.taken.len();
    let cycles = rig.all_up(4_000);
    assert_eq!(rig.reported.taken.len() - frames, 4 * cycles, "the others went on");
    assert_eq!((rig.reported.wrong_counts, rig.receive(100)), (0, vec![100; 5]));
    // One that is switched off and on is reported, and comes back, too.
    let now = rig.cycle.grid;
    rig.sim.restart(now, 1);
    let answers = rig.receive(10);
    assert_eq!([0, 2, 3, 4].map(|place| answers[place]), [10; 4]);
    rig.all_up(4_000);
    assert_eq!(rig.reported.restarted, [Owner::Drive(1)]);
    assert_eq!((rig.reported.wrong_counts, rig.receive(100)), (0, vec![100; 5]));
}

#[test]
fn a_cut_cable_takes_what_is_behind_it_and_nothing_else() {
    for (count, from, cycles) in [(5, 2, 1_000), (2, 0, 50)] {
        let mut rig = Rig::new(&drives(count));
        rig.all_up(4_000);
        assert!(rig.line.timed);
        rig.sim.cut(Some(from));
        let answers = (0..usize::from(count)).map(|place| if place < from { cycles } else { 0 });
        assert_eq!(rig.receive(cycles), answers.collect::<Vec<_>>());
        rig.sim.cut(None);
        rig.reported.taken.clear();
        let cycles = rig.all_up(6_000);
        let is_before = |owner: &&Owner| matches!(owner, Owner::Drive(index) if *index < from);
        let upstream = rig.reported.taken.iter().filter(is_before).count();
        assert_eq!(upstream, from * cycles, "they went on while the others came back");
        rig.until("one time for all", 500, |rig| rig.line.timed);
        assert_eq!((rig.reported.wrong_counts, rig.receive(100)), (0, vec![100; count.into()]));
        assert!(rig.reported.restarted.is_empty(), "nothing was switched off");
    }
}

#[test]
fn an_image_that_outgrows_a_frame_goes_by_more_and_each_is_judged_alone() {
    let mut rig = Rig::new(&drives(90));
    assert!(rig.image.frames().len() > 1);
    rig.all_up(20_000);
    assert_eq!((rig.reported.wrong_counts, rig.receive(20)), (0, vec![20; 90]));
    rig.sim.deafen(80, true);
    let answered = rig.receive(100);
    assert!((0..90).all(|index| answered[index] == if index == 80 { 0 } else { 100 }), "{answered:?}");
}

#[test]
fn a_drive_of_another_make_is_refused_by_name_each_time_and_the_others_run() {
    for (place, others, answers) in [(0, [1, 2], vec![0, 50, 50]), (1, [0, 2], vec![50, 0, 50])] {
        let mut rig = Rig::with_other(3, place);
        // Another master has given it the address of the second place: it gives that back.
        rig.poke(place as u16, address::STATION, &0x1002_u16.to_le_bytes());
        rig.until("the others in OP", 4_000, |rig| {
            others.iter().all(|other| rig.line.is_operational(*other))
        });
        for _ in 0..3_000 {
            assert_eq!((rig.note(place), rig.note(2)), (Note::Product(8), Note::None), "{place}");
            rig.run(1);
        }
        assert_eq!((rig.al(place), rig.receive(50)), (AlState::Init, answers));
    }
}

#[test]
fn drives_in_op_with_the_addresses_of_other_places_are_taken_by_their_places() {
    let mut rig = Rig::new(&drives(3));
    rig.all_up(4_000);
    let moved = Rig::new(&drives(3));
    (rig.line, rig.image) = (moved.line, moved.image);
    for (place, station) in [(0, 0x1002_u16), (1, 0x1003), (2, 0x1001)] {
        rig.poke(place, address::STATION, &station.to_le_bytes());
    }
    rig.reported.taken.clear();
    rig.all_up(2_000);
    rig.assert_own_addresses();
    assert_eq!(rig.receive(100), [100; 3]);
    assert_eq!((0..3).map(|place| rig.al(place)).min(), Some(AlState::Op));
}

#[test]
fn an_earlier_state_is_no_answer_to_the_last_request() {
    // At each step of the way the end comes while a frame is under way, and is taken in only behind it.
    for cycles in 5..250 {
        let mut rig = Rig::new(&drives(1));
        rig.run(cycles);
        rig.late = true;
        rig.step();
        rig.late = false;
        let now = rig.cycle.grid;
        rig.line.shut_down(now);
        rig.deliver();
        rig.down(300);
        assert_eq!(rig.al(0), AlState::Init, "after {cycles} cycles");
    }
}

#[test]
fn a_slave_whose_state_no_frame_shows_is_not_operational_below_op() {
    // Two FMMUs, and none to spare.
    let mut rig = Rig::io(&terminals(), Settings { fmmus: 2, ..Settings::default() });
    rig.put_out(0, 0xA5);
    rig.all_up(4_000);
    assert!(!rig.line.slaves[0].has_al);
    rig.run(200);
    rig.reported.states.clear();
    // Its state is read by itself, and reported before anything is done about it.
    rig.poke(0, address::AL_CONTROL, &[4, 0]);
    rig.until("it was read", 200, |rig| !rig.line.slaves[0].is_settled());
    assert_eq!(rig.reported.states, [(Owner::Device(0), Some(AlState::SafeOp))]);
    rig.run(400);
    assert_eq!(rig.reported.states.last(), Some(&(Owner::Device(0), Some(AlState::Op))));
}

#[test]
fn a_station_address_of_ours_is_taken_from_any_other_slave() {
    let mut rig = Rig::on(&drives(1), drives(2));
    rig.poke(1, address::STATION, &FIRST_STATION.to_le_bytes());
    rig.all_up(4_000);
    assert_eq!(rig.peek(1, address::STATION, 2), [0; 2]);
    assert_eq!(rig.receive(100), [100]);
}

#[test]
fn a_place_beyond_all_addresses_is_no_panic() {
    let mut plan = drives(1);
    plan.drives[0].slave.place = u16::MAX;
    let _ = fieldbeat_ethercat::station::Station::new(&plan.drives[0], MS, 0, &InputLog::default());
    let slaves = plan.slaves();
    let (_, offsets) = Image::new(&slaves, 0x1000_0000, [0x10; 6], true, true).unwrap();
    let line = Segment::new(&plan, offsets, MS);
    assert_eq!(line.slaves[0].station(), 0x1000);
}
