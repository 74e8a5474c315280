//! What passed the wires of a run, as a capture, and that in words: each telegram of the log is there once.

use std::collections::BTreeMap;
use std::path::Path;

use fieldbeat::axis::{Command, Jog, Link};
use fieldbeat::sim::WorldOptions;
use fieldbeat::telemetry::recording::Recorder;
use fieldbeat::{Master, Simulation};
use fieldbeat_capture::Direction;
use fieldbeat_capture::decode::{Decoder, Telegram};
use fieldbeat_capture::export::{Export, link_of, utc_ns};
use fieldbeat_capture::reader::Capture;
use fieldbeat_core::inputs::entry::Kind;
use fieldbeat_core::logged::{LinkEvent, LinkPassed};
use fieldbeat_record::recording::reading::Reading;
use fieldbeat_replay::{LogEnd, Recorded};

/// The machine of the demo: all five wires.
const DEMO: &str = include_str!("../../../rt-config/demo.toml");

/// Records it while an axis of each wire comes up and turns, and a drive by Modbus restarts.
fn record(directory: &Path) -> std::path::PathBuf {
    let (config, path) = (directory.join("demo.toml"), directory.join("run.mcap"));
    std::fs::write(&config, DEMO).unwrap();
    let recorder = Recorder::create(&path).unwrap().with_wire().unwrap();
    let setup = Master::from_file(&config).unwrap().with_recorder(recorder);
    let mut machine = setup.simulate(WorldOptions::default()).unwrap();
    let axes = machine.plan().axes().len();
    let online = |machine: &Simulation| (0..axes).all(|axis| machine.feedback(axis).link == Link::Online);
    assert!(machine.run_until(20_000, online));
    for axis in 0..axes {
        machine.axis(axis).post(Command::Enable).unwrap();
    }
    machine.run(2_000);
    machine.axis(8).post(Command::Jog(Jog { velocity: 2.0, acceleration: 40.0 })).unwrap();
    machine.run(500);
    assert!(machine.world().restart("127.77.1.11:1502".parse().unwrap()));
    machine.run(8_000);
    let [recorded] = &machine.finish_recording()[..] else { panic!("one file") };
    assert!(recorded.failure().is_none(), "{recorded}");
    path
}

/// Telegrams by interface and direction.
type Counts = BTreeMap<(String, bool), u64>;

#[test]
fn a_capture_has_each_telegram_of_the_recording_in_words() {
    let directory = tempfile::tempdir().unwrap();
    let path = record(directory.path());
    let (plan, entries, end) = Recorded::open(&path).unwrap().entries().unwrap();
    let names: Vec<String> = plan.buses.iter().map(|bus| bus.name().to_owned()).collect();
    let utc_ns = utc_ns(Reading::open(&path).unwrap());
    assert!(utc_ns > 0);
    let mut logged = Counts::new();
    let (mut times, mut bytes) = ((u64::MAX, 0), Vec::new());
    let link: Vec<LinkPassed> = link_of(Reading::open(&path).unwrap()).collect();
    for passed in link.iter().filter(|passed| !passed.bytes.is_empty()) {
        times = (times.0.min(passed.at.0), times.1.max(passed.at.0));
        if passed.event == LinkEvent::Sent {
            // A request each.
            *logged.entry((names[usize::from(passed.bus)].clone(), true)).or_default() += 1;
        }
    }
    let of_link = logged.clone();
    let entries = entries.inspect(|entry| {
        let (_, entry) = entry.as_ref().unwrap();
        let is_out = match entry.kind {
            Kind::DatagramOut | Kind::FrameOut | Kind::BytesOut => true,
            Kind::DatagramIn | Kind::FrameIn => false,
            _ => return,
        };
        times = (times.0.min(entry.at.0), times.1.max(entry.at.0));
        let (bus, _) = fieldbeat_core::inputs::entry::place_of(entry.word(0));
        *logged.entry((names[bus].clone(), is_out)).or_default() += 1;
    });
    let export = Export::new(&mut bytes, "test", &plan, utc_ns, link.clone().into_iter()).unwrap();
    let (packets, is_broken) = export.all(entries).unwrap();
    assert!(!is_broken && end() == LogEnd::Whole);

    let (mut capture, mut decoder) = (Capture::open(&bytes[..]).unwrap(), Decoder::new(Vec::new()));
    let (mut found, mut read) = (Counts::new(), 0);
    let (mut streams, mut seen) = (BTreeMap::<String, u64>::new(), (u64::MAX, 0));
    while let Some(packet) = capture.next_packet().unwrap() {
        read += 1;
        let interface = &capture.interfaces()[packet.interface];
        let take = |telegram: &Telegram<'_>| {
            let at = telegram.utc_ns.unwrap();
            seen = (seen.0.min(at), seen.1.max(at));
            let is_out = telegram.direction == Some(Direction::Outbound);
            *found.entry((telegram.interface.to_owned(), is_out)).or_default() += 1;
            if telegram.protocol == "modbus-tcp" && is_out {
                *streams.entry(telegram.ends[0].clone()).or_default() += 1;
            }
            Ok::<(), ()>(())
        };
        decoder.enter(interface, &packet, take).unwrap();
    }
    // No byte is left over, and no segment is missing.
    decoder.finish();
    assert!(decoder.others().is_empty(), "{:?}", decoder.others());
    assert_eq!(read, packets);
    let later = |at: u64| at.wrapping_add_signed(utc_ns);
    assert_eq!(seen, (later(times.0), later(times.1)));
    // What was received on connections and serial wires comes in pieces.
    for (of, count) in &logged {
        let (found, sessions) = (found[of], &("ethernet-ip".to_owned(), false));
        let answers = if of == sessions { of_link[&("ethernet-ip".to_owned(), true)] } else { 0 };
        // Each request of a session has an answer, but the last one of each.
        let most = count + answers;
        let least = if answers == 0 { most } else { most.saturating_sub(2) };
        assert!((least..=most).contains(&found), "{of:?}: {found} of {count} and {answers}");
    }
    let of_link: u64 = of_link.values().sum();
    assert!(of_link > 20, "{of_link}");
    let [requested, answered] = [true, false].map(|is_out| found[&("modbus-tcp".to_owned(), is_out)]);
    assert!(answered > 500 && requested - answered < 8, "{requested} {answered}");
    let [requested, answered] = [true, false].map(|is_out| found[&("profibus-dp".to_owned(), is_out)]);
    assert!(answered > 500 && requested > answered, "{requested} {answered}");
    // Two drives, of which one was connected again.
    assert!(streams.len() == 3 && streams.values().all(|count| *count > 10), "{streams:?}");
}
