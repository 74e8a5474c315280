//! Our master at our slaves: its start-up telegrams, and what profirust makes of all that is on the wire.

use std::collections::BTreeMap;
use std::process::Command;

use fieldbeat::axis::{Axis, ParameterError};
use fieldbeat::time::MS;
use fieldbeat::{CyclePlan, Master, Memory};
use fieldbeat_profibus::wire::telegram::{Next, Telegram};
use fieldbeat_sim::profibus::DpState;

use super::cable::{By, Cable};
use super::telegrams::{TOKEN, global_control, searched, start_up, started};
use super::{DRIVECOM, OWN, PKW, PLAIN, Slaves, plan};
use crate::peer::{Peer, package};
use crate::support::{LONG, Machine, skipping, until};

/// rev/s.
const SPEED: f64 = 2.0;

fn work(plan: fieldbeat::bus::profibus::ProfibusPlan) {
    let cycle =
        CyclePlan { period_ns: 2 * MS, receive_deadline: 0.8, memory: Memory::Own, ..CyclePlan::default() };
    let master = Master::from_plan(skipping(plan, cycle)).start().unwrap();
    master.wait_online(LONG).unwrap_or_else(|error| panic!("{error}: {:?}", master.numbers()));
    let mut axes = [DRIVECOM, PKW, PLAIN].map(|address| master.axis(&format!("l{address}")).unwrap());
    for axis in &axes {
        let parameter = axis.parameter();
        // 43 °C; 1.0, written and read; there is no such code.
        assert_eq!(parameter.read::<i32>("C0061"), Ok(430_000));
        assert_eq!(parameter.write("C0039/2", 10_000), Ok(()));
        assert_eq!(parameter.read::<i32>("C0039/2"), Ok(10_000));
        let refused = parameter.read::<i32>("C1999");
        assert!(matches!(refused, Err(ParameterError::Refused { .. })), "{refused:?}");
    }
    let turns = |axis: &Axis| (axis.feedback().status.velocity - SPEED).abs() < 0.01;
    for axis in &mut axes {
        axis.enable().unwrap();
        axis.jog(SPEED).unwrap();
    }
    let turn = until(LONG, || {
        master.alive();
        axes.iter().all(turns)
    });
    assert!(turn, "{:?}", axes.each_ref().map(Axis::feedback));
    for axis in &mut axes {
        axis.stop().unwrap();
        axis.disable().unwrap();
    }
    master.finish();
}

/// A telegram in the words of the decoder, by our own one.
fn describe(bytes: &[u8]) -> String {
    let Next::Telegram { telegram, size } = Next::parse(bytes) else { panic!("{bytes:02X?}") };
    assert_eq!(size, bytes.len());
    match telegram {
        Telegram::Acknowledge => "acknowledge".into(),
        Telegram::Token { da, sa } => format!("token:{da}:{sa}"),
        Telegram::Data(frame) => {
            let head = frame.head;
            let sap = |sap: Option<u8>| sap.map_or("-".into(), |sap| sap.to_string());
            let data: String = frame.data.iter().map(|byte| format!("{byte:02x}")).collect();
            let saps = [head.dsap, head.ssap].map(sap).join(":");
            format!("{}:{}:{saps}:{:02x}:{data}", head.da, head.sa, head.fc.0)
        }
    }
}

/// What profirust decodes of the bytes of one side; how many of each kind.
fn decode(cable: &Cable, by: By, decoder: &mut Peer) -> BTreeMap<String, usize> {
    let telegrams = cable.telegrams().into_iter().filter_map(|(of, bytes)| (of == by).then_some(bytes));
    let telegrams: Vec<Vec<u8>> = telegrams.collect();
    let mut kinds = BTreeMap::new();
    // All that is sent one after the other: it finds each begin itself.
    for some in telegrams.chunks(100) {
        let digits: String = some.concat().iter().map(|byte| format!("{byte:02x}")).collect();
        let answer = decoder.ask(&digits);
        let decoded: Vec<&str> = answer.split(' ').skip(1).collect();
        assert_eq!(decoded.len(), some.len(), "{answer}");
        for (theirs, bytes) in decoded.into_iter().zip(some) {
            let (kind, rest) = match theirs.split_once(':') {
                Some((kind, rest)) if kind != "token" => (kind, rest),
                _ => (theirs.split(':').next().unwrap(), theirs),
            };
            assert_eq!(rest, describe(bytes), "{bytes:02X?}");
            *kinds.entry(kind.to_owned()).or_default() += 1;
        }
    }
    kinds
}

#[test]
#[ignore = "needs root and a package registry: builds the crate profirust"]
fn profirust_decodes_what_our_master_and_our_slaves_send() {
    let (machine, cable) = (Machine::new(83), Cable::new());
    let plan = plan(&cable.master);
    let slaves = Slaves::new(&plan, &cable);
    work(plan);
    slaves.have_no_complaint(&cable);
    for seen in slaves.seen() {
        // In the end each is let go.
        assert_eq!(seen.state, Some((DpState::WaitPrm, None)));
        assert_eq!((seen.events.refused, seen.events.watchdogs), (0, 0));
    }
    let requests = cable.requests();
    assert_eq!(requests[..2], [TOKEN; 2]);
    assert!(requests.contains(&global_control(0)));
    for address in [DRIVECOM, PKW, PLAIN] {
        assert_eq!(started(&requests, address), start_up(address), "{address}");
    }
    // It looks for other masters where none of its slaves is.
    let mut searched = searched(&requests);
    searched.sort_unstable();
    searched.dedup();
    assert!(searched.iter().all(|station| *station < DRIVECOM && *station != OWN), "{searched:?}");
    assert!(!searched.is_empty());
    let mut decoder = Command::new(package("profirust"));
    let mut decoder = Peer::start(
        {
            decoder.arg("decode");
            decoder
        },
        machine.path("decoder.err"),
    );
    let sent = decode(&cable, By::Master, &mut decoder);
    // At least two of the start-up, four of the way to a turning motor and back; twice Global_Control.
    let at_least = |kinds: &BTreeMap<String, usize>, kind: &str, least: usize| {
        assert!(kinds.get(kind).is_some_and(|count| *count >= least), "{kind}: {kinds:?}");
    };
    // Four accesses by DP-V1: a request of each is written, and its response is read.
    for (kind, least) in
        [("SrdHigh", 3 * 10), ("SrdLow", 4 * 2), ("SdnHigh", 2), ("FdlStatus", 1), ("token", 3)]
    {
        at_least(&sent, kind, least);
    }
    let answered = decode(&cable, By::Drive, &mut decoder);
    for (kind, least) in [("DataLow", 3 * 8), ("acknowledge", 3 * 3)] {
        at_least(&answered, kind, least);
    }
}
