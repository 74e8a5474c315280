//! Slaves that are no drives, and slaves that are refused: what is reported of them, and what they do not do by
//! themselves.

use std::collections::BTreeMap;
use std::time::Duration;

use fieldbeat::axis::{CallError, Emergency, FoundRunning, Link};

use fieldbeat::bus::ethercat::{
    Area, Device, EthercatPlan, Expected, Family, KollmorgenDrive, Object, SlavePlan, Start, Terminals, Type,
};
use fieldbeat::sim::WorldOptions;
use fieldbeat::{CyclePlan, MasterError, Plan};
use fieldbeat_core::axis::acyclic::Notation;
use fieldbeat_ethercat::faults::Fault;
use fieldbeat_ethercat::object::long::Target as _;
use fieldbeat_ethercat::object::{Objects, Target};
use fieldbeat_ethercat::wire::frame::{Command as Datagram, position};
use fieldbeat_ethercat::wire::registers::address;
use fieldbeat_sim::ethercat::{EthercatSegment, EthercatSim, SlaveSettings};

use super::drives::{answer, left};
use super::{LINE, Machine, drive};

/// Four bytes of outputs that are its inputs, too.
fn io(place: u16) -> Device {
    let area = |start| vec![Area { start, length: 4 }];
    let slave = SlavePlan { outputs: area(0x1000), inputs: area(0x1100), ..SlavePlan::new(place) };
    Device { name: "io".into(), slave }
}

fn line(drives: Vec<KollmorgenDrive>, devices: Vec<Device>) -> EthercatPlan {
    EthercatPlan { devices, ..EthercatPlan::new(LINE, drives) }
}

/// What is reported of the slaves in the end.
fn reported(machine: Machine) -> (Vec<Option<String>>, Vec<Option<String>>) {
    let end = machine.sim.finish();
    let drives = end.drives.into_iter().map(|drive| drive.not_connected);
    assert!(end.devices.iter().all(|device| device.name == "io"));
    (drives.collect(), end.devices.into_iter().map(|device| device.not_operational).collect())
}

#[test]
fn a_device_that_is_refused_is_reported_by_its_name_and_one_in_operation_is_not() {
    let mut other = line(vec![drive(0, Family::S700)], vec![io(1)]);
    let world = EthercatSim::of(&other);
    other.devices[0].slave.identity = Expected { product: Some(77), ..Expected::default() };
    let (cycle, options) = (CyclePlan::default(), WorldOptions::default());
    let mut machine = Machine::on(Box::new(other), left(world), cycle, options);
    machine.online();
    machine.run(2_000);
    let (drives, devices) = reported(machine);
    assert_eq!(drives, [None]);
    let why = devices[0].clone().expect("it is refused");
    assert!(why.starts_with("place 1: its product is 0x") && why.contains("correct product"), "{why}");

    let mut machine = Machine::new(line(vec![drive(0, Family::S700)], vec![io(1)]));
    machine.run(3);
    let (_, devices) = reported(machine);
    assert_eq!(devices, [Some("place 1: it is being brought up".to_owned())]);

    let mut machine = Machine::new(line(vec![drive(0, Family::S700)], vec![io(1)]));
    machine.online();
    let io = machine.sim.device::<Terminals>("io").unwrap();
    machine.until("operational", 3_000, |_| io.inputs().operational);
    assert_eq!(reported(machine), (vec![None], vec![None]));
}

#[test]
fn the_outputs_of_a_device_that_was_lost_are_zeros_until_they_are_written_anew() {
    let mut machine = Machine::new(line(vec![drive(0, Family::S700)], vec![io(1)]));
    let mut io = machine.sim.device::<Terminals>("io").unwrap();
    machine.online();
    machine.until("operational", 3_000, |_| io.inputs().operational);
    io.write(&[1, 2, 3, 4]).unwrap();
    machine.run(4);
    assert_eq!(io.inputs().bytes(), [1, 2, 3, 4]);
    machine.sim.world().restart_slave(LINE, 1);
    machine.until("lost", 1_000, |_| !io.inputs().operational);
    machine.until("back", 5_000, |_| io.inputs().operational);
    machine.run(100);
    assert_eq!(io.inputs().bytes(), [0; 4], "nothing comes back by itself");
    io.write(&[1, 2, 3, 5]).unwrap();
    machine.run(4);
    assert_eq!(io.inputs().bytes(), [1, 2, 3, 5]);
    assert_eq!(machine.feedback(0).link, Link::Online);
}

#[test]
fn the_objects_of_a_device_with_a_mailbox_are_read_and_written() {
    // A drive in the place of the device: the plan knows no more of it than its memory.
    let akd = drive(1, Family::Akd);
    let mut plan = line(vec![drive(0, Family::S700)], Vec::new());
    let mut whole = EthercatSegment::from(line(vec![drive(0, Family::S700), akd.clone()], Vec::new()));
    whole.drives[1].interrupts_to_sync = 1;
    let world = EthercatSim::new(&whole);
    // 1 ms.
    let start = |sub, kind, raw| Start::new(Object::new(0x60C2, sub), kind, raw);
    let start_up = vec![start(1, Type::U8, 1), start(2, Type::I8, 0xFD)];
    let slave = SlavePlan { start_up, ..akd.slave.clone() };
    plan.devices = vec![Device { name: "io".into(), slave }];
    let (cycle, options) = (CyclePlan::default(), WorldOptions::default());
    let mut machine = Machine::on(Box::new(plan), left(world), cycle, options);
    let acyclic = machine.sim.acyclics()[1].clone();
    assert_eq!(acyclic.axis(), "io");
    let notation: &dyn Notation = &Objects;
    let limit = Duration::from_secs(1);
    let vendor = notation.read("0x1018:1").unwrap();
    let ticket = acyclic.post(vendor, limit).unwrap();
    assert_eq!(answer(&mut machine, ticket), Err(CallError::NotOnline), "it is not up yet");
    machine.online();
    let mut io = machine.sim.device::<Terminals>("io").unwrap();
    machine.until("operational", 5_000, |_| io.inputs().operational);
    let mut ask = |call| {
        let ticket = acyclic.post(call, limit).unwrap();
        answer(&mut machine, ticket)
    };
    assert_eq!(ask(vendor), Ok(0x6A));
    assert_eq!(ask(notation.write("0x6081:0", 4_321).unwrap()), Ok(4_321));
    assert_eq!(ask(notation.read("0x6081:0").unwrap()), Ok(4_321));
    assert_eq!(io.emergency(), None);
    machine.drive(1, |drive| drive.provoke(Fault::OVERVOLTAGE.code));
    machine.run(100);
    assert_eq!(io.emergency(), Some(Emergency { code: 0x3110, register: 4 }));
    assert_eq!(io.emergency(), None);
    let mut ask = |call| {
        let ticket = acyclic.post(call, limit).unwrap();
        answer(&mut machine, ticket)
    };
    assert!(matches!(ask(Target::parse("0x2FFF:7.u16").unwrap().read()), Err(CallError::Refused(_))));
    // Of forty that nobody takes the application gets as many as there is room for; the others count. Each fault comes,
    // and goes by the control word.
    for _ in 0..20 {
        machine.drive(1, |drive| drive.provoke(Fault::OVERVOLTAGE.code));
        for control in [0, 0x80] {
            machine.run(60);
            io.write(&[0, 0, 0, 0, control, 0]).unwrap();
        }
        machine.run(60);
        io.write(&[0; 6]).unwrap();
    }
    let mut received = std::iter::from_fn(|| io.emergency()).count();
    assert_eq!(received, 16, "as many as there is room for");
    // Some wait behind them in the master.
    machine.run(600);
    received += std::iter::from_fn(|| io.emergency()).count();
    let counted = counted(machine);
    let lost = counted["emergencies_lost"];
    // Of the first fault only its end: it was there already.
    assert_eq!(received as u64 + lost, 39, "{received} {lost}");
    assert!(lost >= 10, "{received} {lost}");
    // The one that was taken before, too; and an object that does not exist.
    assert_eq!((counted["emergencies"], counted["aborts"], counted["brought_up"]), (40, 1, 1));
}

/// What was counted of the one device.
fn counted(machine: Machine) -> BTreeMap<&'static str, u64> {
    let end = machine.sim.finish();
    end.devices[0].protocol_counters.0.iter().map(|(counter, count)| (counter.key, *count)).collect()
}

#[test]
fn protocol_errors_of_a_slave_are_counted_by_name() {
    let mut segment = EthercatSegment::from(line(vec![drive(0, Family::S700)], vec![io(1)]));
    // With a processor, which refuses a state.
    let own = SlaveSettings { emulated: Some(false), ..SlaveSettings::default() };
    segment.settings.slaves.insert(1, own);
    let mut machine = Machine::new(segment);
    let io = machine.sim.device::<Terminals>("io").unwrap();
    machine.online();
    machine.until("operational", 3_000, |_| io.inputs().operational);
    let write = |machine: &Machine, register: u16, data: &[u8]| {
        machine.pass(Datagram::Apwr(position(1), register), data);
    };
    machine.sim.world().deafen(LINE, 1, true);
    machine.run(2);
    machine.sim.world().deafen(LINE, 1, false);
    machine.run(50);
    // Its outputs do not count, which the frames do not show.
    write(&machine, address::fmmu(0) + 12, &[0]);
    machine.run(50);
    write(&machine, address::fmmu(0) + 12, &[1]);
    machine.run(100);
    // No state at all.
    write(&machine, address::AL_CONTROL, &[0x0F, 0]);
    machine.run(2_000);
    assert!(io.inputs().operational);
    let counted = counted(machine);
    // Two while it was deaf, and two with a count that fits nobody, until each slave is evaluated alone.
    assert_eq!(counted["passed_by"], 4, "{counted:?}");
    assert!(counted["wrong_count"] >= 9 && counted["al_errors"] >= 1, "{counted:?}");
    assert!(counted["not_operational"] > 0 && counted["brought_up"] == 2, "{counted:?}");
}

#[test]
fn a_drive_with_another_resolution_is_refused_unless_that_is_not_compared() {
    let refused = |prbase: u8, turns: u32, check: bool| {
        let mut odd = drive(0, Family::S700);
        odd.check_prbase = check;
        odd.axis.on_found_running = FoundRunning::Refuse;
        let mut segment = EthercatSegment::from(line(vec![odd], Vec::new()));
        (segment.drives[0].prbase, segment.drives[0].resolution_turns) = (prbase, turns);
        let mut machine = Machine::new(segment);
        machine.run(4_000);
        let link = machine.feedback(0).link;
        let (drives, _) = reported(machine);
        assert_eq!(link == Link::Online, drives[0].is_none(), "{drives:?}");
        drives.into_iter().next().flatten()
    };
    assert_eq!(refused(20, 1, true), None);
    assert_eq!(refused(20, 4, true), None, "as a ratio it is the same");
    let why = refused(19, 1, true).expect("it counts otherwise");
    assert!(
        why.contains("its increments per turn (0x608f:1) are 524288") && why.contains("check_prbase = false")
    );
    assert_eq!(refused(19, 1, false), None);
}

#[test]
fn a_device_is_taken_once_by_its_name_and_type() {
    let named = |name: &str, place| Device { name: name.into(), ..io(place) };
    let plan = |a: &str, b: &str| line(vec![drive(0, Family::S700)], vec![named(a, 1), named(b, 2)]);
    let mut sim = Machine::new(plan("di", "do")).sim;
    assert_eq!(sim.device::<u32>("do").err(), Some(MasterError::DeviceType("do".into())));
    assert!(sim.device::<Terminals>("do").is_ok(), "another type has not taken it");
    assert_eq!(sim.device::<Terminals>("do").err(), Some(MasterError::DeviceTaken("do".into())));
    let absent = sim.device::<Terminals>("dx").err().unwrap().to_string();
    assert_eq!(absent, "there is no device dx; there are: di, do");
    let taken = "its name is taken; names are unique in the machine";
    for (other, refused) in [
        ("di", format!("device di: {taken}")),
        ("d0", format!("device d0: {taken}")),
        ("d o", "device \"d o\": its name must be 1 to 32 letters, digits, - _ or .".to_owned()),
    ] {
        let plan = Plan { buses: vec![Box::new(plan("di", other))], ..Plan::default() };
        let reported = plan.check().unwrap_err().to_string();
        assert!(reported.lines().any(|line| line == refused), "{reported}");
    }
}
