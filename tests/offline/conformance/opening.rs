//! The plan, and the bus before its first cycle.

use fieldbeat::bus::BusPlan;
use fieldbeat::sim::Simulated;
use fieldbeat::time::S;
use fieldbeat_core::rt::Regions;

use crate::conformance::line::{GRID, Line, PERIOD, drives};
use crate::conformance::subject::{Subject, not_applicable};

pub fn a_plan_lists_its_drives_in_slot_order(subject: &'static dyn Subject) {
    let drives = drives(subject, 3, |index, drive| drive.axis.name = format!("n{}", 7 - index));
    let plan = subject.plan(&drives);
    let names: Vec<&str> = plan.axes().iter().map(|axis| axis.name.as_str()).collect();
    assert_eq!(names, ["n7", "n6", "n5"]);
    let (facts, reported) = (plan.facts(GRID), plan.describe(GRID));
    // What a line, or a wire, has besides has a line each behind them.
    let can = subject.can();
    let more = (can.shared || can.half_duplex) && reported.len() > 3;
    assert!(reported.len() == 3 || more, "a paragraph a drive: {reported:#?}");
    assert!(reported.iter().all(|paragraph| paragraph.lines().next().is_some_and(|line| !line.is_empty())));
    let Simulated { drives, segments, wires, .. } = subject.simulated(&drives);
    // On a line the first drive stands last.
    let slaves = if subject.can().shared { subject.place(0, 3) + 1 } else { 3 };
    let on_wires: usize = wires.iter().map(|wire| wire.drives.len()).sum();
    let on_lines: usize = segments.iter().map(|segment| segment.slaves()).sum();
    assert_eq!(drives.len() + on_lines + on_wires, slaves);
    let addresses: Vec<_> = drives.iter().map(|drive| drive.address()).collect();
    assert_eq!(facts.addresses(), addresses);
    assert_eq!(facts.drives.len(), 3);
    assert!(!facts.protocol.is_empty() && !plan.name().is_empty());
}

pub fn open_sends_nothing(subject: &'static dyn Subject) {
    let line = Line::new(subject, 3);
    line.world.advance(S);
    assert_eq!(line.wire.log().sends, 0);
    // Connections are opened, with their handshake, outside the loop.
    assert!(line.can.stream || line.can.sessions || line.world.delivered() == 0);
    assert!(
        !line
            .wire
            .log()
            .drives
            .iter()
            .any(|tape| tape.received.iter().any(|received| received.said.is_some()))
    );
}

pub fn a_bus_that_cannot_be_opened_is_an_error_with_its_name_and_a_remedy(subject: &'static dyn Subject) {
    let line = Line::new(subject, 1);
    if line.can.stream {
        return not_applicable(subject, "a place that is taken", "it listens nowhere");
    }
    let error = line.wire.open(PERIOD, &line.world).expect_err("its place on the wire is taken").to_string();
    assert!(error.contains(line.wire.name()), "{error}");
    let remedy = error.rsplit(';').next().unwrap_or_default();
    assert!(error.contains(';') && remedy.trim().len() > 10, "no remedy: {error}");
}

pub fn the_native_end_of_each_drive_is_given_once(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 2);
    assert_eq!(line.ends.drives.len(), 2);
    // Nobody needs to hold it.
    line.ends.drives.clear();
    line.ready();
}

pub fn the_memory_that_it_names_stays_where_it_is(subject: &'static dyn Subject) {
    let mut line = Line::new(subject, 3);
    let named = |line: &Line| {
        let mut regions = Regions::new();
        line.bus.memory(&mut regions);
        format!("{regions:?}")
    };
    let before = named(&line);
    assert_ne!(before, format!("{:?}", Regions::new()), "at least the bus itself");
    line.ready();
    line.move_about(0);
    assert_eq!(named(&line), before, "locked memory was left for other memory");
}
