//! EtherCAT on a cable between two network namespaces, our simulated segment at its end: Wireshark's dissector in
//! between, and our master or one that others wrote.

mod dissector;
mod left;
mod master;
mod own;
mod scan;
mod soem;
mod terminals;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Mutex;

use fieldbeat::bus::ethercat::{
    Area, Device, EthercatPlan, Expected, Family, KollmorgenDrive, SlavePlan, Watchdog,
};
use fieldbeat::sim::SimPlan;
use fieldbeat::sim::server::{ServerOptions, SimServer};
use fieldbeat::time::MS;
use fieldbeat_core::net::{Carriers, Frames, Os};
use fieldbeat_sim::ethercat::{DriveSettings, EthercatSegment, Model, SegmentSettings, SlaveSettings};

use crate::capture::Capture;
use crate::support::{Cable, Ended, Machine, command};

/// The interface at both ends of a [`Cable`].
const WIRE: &str = "wire";
const ETHERTYPE: u16 = 0x88A4;
/// For local experiments (IEEE 802): marks of a capture.
const MARKER: u16 = 0x88B5;

/// The watchdog of whatever has outputs: as long as no busy host is silent.
const PATIENT: Watchdog = Watchdog::After(1_000 * MS);

/// A drive whose link no busy host loses, and that goes on until it is stopped.
fn patient(place: u16, family: Family) -> KollmorgenDrive {
    let mut drive = KollmorgenDrive::new(format!("d{place}"), place, family);
    drive.axis.health.bucket = 1_000;
    drive.axis.jog_deadman = None;
    drive.slave.watchdog = PATIENT;
    drive
}

/// A coupler with a byte of outputs and one of inputs, and so many drives behind it.
fn segment(family: Family, drives: u16, short_clocks: bool) -> EthercatSegment {
    let simulated =
        |place: u16| DriveSettings { serial: 100 + u32::from(place), ..DriveSettings::new(family) };
    let mut plan = EthercatPlan::new(WIRE, (1..=drives).map(|place| patient(place, family)).collect());
    let slave = SlavePlan {
        identity: Expected { vendor: Some(2), product: Some(0x044C_2C52), ..Expected::default() },
        outputs: vec![Area { start: 0x1000, length: 1 }],
        inputs: vec![Area { start: 0x1100, length: 1 }],
        watchdog: PATIENT,
        ..SlavePlan::new(0)
    };
    plan.devices.push(Device { name: "io".into(), slave });
    let settings = SegmentSettings {
        interface: Some(WIRE.into()),
        drift_ppm: vec![0.0, 20.0, -35.0],
        short_clocks,
        ..SegmentSettings::default()
    };
    EthercatSegment { settings, drives: (1..=drives).map(simulated).collect(), ..plan.into() }
}

/// A coupler, digital outputs that are wired to digital inputs, outputs behind two SyncManagers, analogue inputs, and
/// two drives.
fn with_terminals() -> EthercatSegment {
    let drives = [5, 6].map(|place| patient(place, Family::S700));
    let mut plan = EthercatPlan::new(WIRE, drives.into());
    let area = |start, length| Area { start, length };
    let models = [
        ("coupler", Model::Ek1100, vec![], vec![]),
        ("out", Model::El2008, vec![area(0x0F00, 1)], vec![]),
        ("in", Model::El1008, vec![], vec![area(0x1000, 1)]),
        ("wide", Model::El2809, vec![area(0x0F00, 1), area(0x0F01, 1)], vec![]),
        ("analogue", Model::El3102, vec![], vec![area(0x1180, 8)]),
    ];
    let mut slaves = BTreeMap::new();
    for (place, (name, model, outputs, inputs)) in (0..).zip(models) {
        let mailbox = (model == Model::El3102).then_some([area(0x1000, 128), area(0x1080, 128)]);
        let watchdog = if outputs.is_empty() { Watchdog::AsDelivered } else { PATIENT };
        let slave = SlavePlan { outputs, inputs, mailbox, watchdog, ..SlavePlan::new(place) };
        plan.devices.push(Device { name: name.into(), slave });
        let wired_to = (model == Model::El2008).then_some(2);
        slaves.insert(place, SlaveSettings { model: Some(model), wired_to, ..SlaveSettings::default() });
    }
    let settings = SegmentSettings { interface: Some(WIRE.into()), slaves, ..SegmentSettings::default() };
    EthercatSegment { settings, ..plan.into() }
}

/// A cable whose end at the master has an address like that of a network card: without the bit that the first slave
/// sets.
fn cable(test: u8) -> Cable {
    let cable = Cable::new(test, &[]);
    command(&["ip", "-n", &cable.master, "link", "set", WIRE, "address", "10:10:10:10:10:10"]);
    cable
}

/// The segment, served at the drives' end of a cable. It ends with this.
fn serve(cable: &Cable, segment: EthercatSegment) -> SimServer {
    let simulated = SimPlan::from(segment).build();
    // A segment is hardware: it does not wait for whatever else this computer does.
    let options = ServerOptions { priority: Some(70), ..ServerOptions::default() };
    cable.among_drives(|| SimServer::start(simulated, options).unwrap())
}

/// Captures the frames that go either way on `cable` while `run` does something there; the file with all of them.
///
/// What leaves by PACKET_QDISC_BYPASS is never seen where it leaves: each end sees what comes in there.
fn capture(cable: &Cable, machine: &Machine, run: impl FnOnce()) -> PathBuf {
    let open = || Os::default().frames(WIRE, MARKER).unwrap();
    let sent = come_in(&cable.drives, machine.path("sent.pcapng"), cable.at_master(open));
    let back = come_in(&cable.master, machine.path("back.pcapng"), cable.among_drives(open));
    run();
    let (sent, back, both) = (sent.end(), back.end(), machine.path("both.pcapng"));
    let files = [&both, &sent, &back].map(|file| file.to_str().unwrap());
    command(&["mergecap", "-w", files[0], files[1], files[2]]);
    both
}

/// A capture of what comes in at one end; `marks` sends at the other one.
fn come_in(namespace: &str, file: PathBuf, marks: Box<dyn Frames>) -> Capture<impl Fn(&str) + use<>> {
    let filter = format!("inbound and (ether proto {ETHERTYPE:#x} or ether proto {MARKER:#x})");
    let marks = Mutex::new(marks);
    Capture::start(Some(namespace), WIRE, &filter, file, move |text| {
        let header = [&[0xFF; 6][..], &[0x10; 6], &MARKER.to_be_bytes()].concat();
        let _ = marks.lock().unwrap().send(&[&header, text.as_bytes(), &[0; 46]].concat());
    })
}

/// What another master has reported, by the first word of each line.
fn said(ended: &Ended) -> BTreeMap<&str, Vec<&str>> {
    let mut said = BTreeMap::<_, Vec<_>>::new();
    for line in ended.out.lines() {
        let (what, rest) = line.split_once(' ').unwrap();
        said.entry(what).or_default().push(rest);
    }
    said
}
