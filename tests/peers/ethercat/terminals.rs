//! Our own master on a coupler with terminals and drives behind them, each frame of it captured.

use std::time::{Duration, Instant};

use fieldbeat::bus::ethercat::{EthercatPlan, Terminals};
use fieldbeat::time::MS;
use fieldbeat::{CyclePlan, Master, Memory};

use super::dissector::{APWR, Address, BRD, Datagram, FPWR, Frame, LRW, dissect, exchanges};
use super::{cable, capture, serve, with_terminals};
use crate::support::{LONG, Machine, skipping};

const PERIOD_NS: u64 = 2 * MS;
const SLAVES: u64 = 7;
/// Each slave has its AL status in the image; outputs, of which four have some, count twice.
const COUNTER: u64 = SLAVES + 2 * 4;
const FIRST_STATION: u64 = 0x1001;
const AL_CONTROL: u64 = 0x0120;
/// A state in it.
const PREOP: u64 = 2;
const SII_OWNER: u64 = 0x0500;
const MANAGERS: u64 = 0x0800;
/// The SyncManagers of each slave that are set: the analogue terminal has one for outputs, and no outputs.
const SET: [&[u64]; SLAVES as usize] = [&[], &[0], &[0], &[0, 1], &[0, 1, 3], &[0, 1, 2, 3], &[0, 1, 2, 3]];

#[test]
#[ignore = "needs root, iproute2 and tshark"]
fn tshark_finds_nothing_wrong_with_our_master_on_a_coupler_with_terminals() {
    let (machine, cable) = (Machine::new(54), cable(54));
    let segment = with_terminals();
    let plan = segment.plan.clone();
    let _segment = serve(&cable, segment);
    let mut executed = 0;
    let file = capture(&cable, &machine, || executed = cable.at_master(|| work(plan)));
    let exchanges = exchanges(&dissect(&file));
    assert_eq!(exchanges.len() as u64, executed, "a frame a cycle");
    let frames: Vec<&Frame> = exchanges.iter().filter_map(|(_, back)| back.as_ref()).collect();
    let of = |command| {
        frames.iter().flat_map(move |frame| frame.datagrams.iter().find(|one| one.command == command))
    };
    assert!(of(BRD).all(|states| states.working_counter == SLAVES), "the broadcast counts all of them");
    assert!(of(LRW).filter(|image| image.working_counter == COUNTER).count() > 200);
    for place in 0..SLAVES {
        judge_slave(&exchanges, place);
    }
}

/// Whether each frame came back too late for the next one, or not at all: what it requested is requested once more. One
/// that was back half a period before was there.
fn late(exchanges: &[(Frame, Option<Frame>)]) -> Vec<bool> {
    let next = exchanges.iter().skip(1).map(|(sent, _)| sent.at_ns).chain([u64::MAX]);
    let is_late = |((_, back), next): (&(Frame, Option<Frame>), u64)| {
        back.as_ref().is_none_or(|back| back.at_ns + PERIOD_NS / 2 > next)
    };
    exchanges.iter().zip(next).map(is_late).collect()
}

/// What was written to the slave at this place, and carried out.
fn judge_slave(exchanges: &[(Frame, Option<Frame>)], place: u64) {
    let is_its = |datagram: &Datagram| match datagram.address {
        // Each slave has counted it up.
        Address::Slave(to, _) if datagram.command == APWR => (SLAVES.wrapping_sub(to)) & 0xFFFF == place,
        Address::Slave(to, _) => datagram.command == FPWR && to == FIRST_STATION + place,
        Address::Logical(_) => false,
    };
    let register = |datagram: &Datagram| match datagram.address {
        Address::Slave(_, register) if is_its(datagram) && datagram.working_counter > 0 => Some(register),
        _ => None,
    };
    let written =
        |frame: &Frame, at: u64| frame.datagrams.iter().any(|datagram| register(datagram) == Some(at));
    // Step by step to OP, and down in the end: no state is requested twice, which an acknowledgement would be, unless a
    // frame since the first request was late.
    let late = late(exchanges);
    let frames: Vec<&Frame> = exchanges.iter().filter_map(|(_, back)| back.as_ref()).collect();
    let requests = exchanges.iter().enumerate().filter_map(|(at, (_, back))| Some((at, back.as_ref()?)));
    let (mut states, mut last): (Vec<u64>, Option<(usize, u64)>) = (Vec::new(), None);
    let mut preop = 0;
    for (at, frame) in requests.filter(|(_, frame)| written(frame, AL_CONTROL)) {
        let Some(state) = frame.state else { continue };
        match last.replace((at, state)) {
            Some((before, same)) if same == state => {
                let excused = late[before..at].contains(&true);
                assert!(excused, "place {place}: {state} was requested in frame {}, too", frame.number);
            }
            _ => states.push(state),
        }
        if state == PREOP && preop == 0 {
            preop = frame.number;
        }
    }
    assert_eq!(states, [1, PREOP, 4, 8, 1], "place {place}");
    // Its SII is taken and given back before PREOP.
    let owners: Vec<_> =
        frames.iter().filter(|frame| written(frame, SII_OWNER)).map(|frame| frame.number).collect();
    assert!(owners.len() >= 3 && owners.iter().all(|owner| *owner < preop), "place {place}");
    // Its SyncManagers, all of them: cleared first, and then set one by one.
    let one = |datagram: &Datagram| {
        let at = register(datagram)?.checked_sub(MANAGERS).filter(|at| *at < 0x80 && datagram.length == 8)?;
        Some(at / 8)
    };
    let mut set: Vec<u64> = frames.iter().flat_map(|frame| frame.datagrams.iter().filter_map(one)).collect();
    set.dedup();
    assert_eq!(set, SET[place as usize], "place {place}");
}

/// What the application does; how many cycles that were.
fn work(plan: EthercatPlan) -> u64 {
    let cycle = CyclePlan {
        period_ns: PERIOD_NS,
        receive_deadline: 0.8,
        reference: Some(plan.name.clone()),
        memory: Memory::Own,
        ..CyclePlan::default()
    };
    let master = Master::from_plan(skipping(plan, cycle)).start().unwrap();
    master.wait_online(LONG).unwrap_or_else(|error| panic!("{error}: {:?}", master.numbers()));
    let mut devices: Vec<Terminals> =
        ["out", "in", "wide", "analogue"].map(|name| master.device(name).unwrap()).into();
    let until = |what: &str, done: &mut dyn FnMut() -> bool| {
        let end = Instant::now() + LONG;
        while !done() {
            assert!(Instant::now() < end, "{what}: {:?}", master.numbers());
            std::thread::sleep(Duration::from_millis(2));
        }
    };
    until("in operation", &mut || devices.iter().all(|device| device.inputs().operational));
    for byte in [0x5A, 0xA5] {
        devices[0].write(&[byte]).unwrap();
        devices[2].write(&[byte, !byte]).unwrap();
        until("seen at the inputs", &mut || devices[1].inputs().bytes() == [byte]);
    }
    let value = |devices: &[Terminals]| devices[3].inputs().bytes().to_vec();
    let before = value(&devices);
    until("the analogue inputs live", &mut || value(&devices) != before);
    std::thread::sleep(Duration::from_millis(500));
    master.finish().end.status.executed
}
