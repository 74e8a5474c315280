//! The file of a black box as a recording.

use std::io;

use super::machine::{AxisAbout, Faults, Machine, of_axis, of_cycle};
use super::writer::Writer;
use crate::blackbox::file::Header;
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::time::{Time, nanos};

/// The bytes of a recording with the same records. Its instants are those of the file's own time stamp, which is of the
/// second in which it was written.
pub fn convert(header: &Header, records: &[Record]) -> io::Result<Vec<u8>> {
    let last = records.iter().rev().find_map(|record| match record {
        Record::Cycle(cycle) => Some(cycle.grid),
        _ => None,
    });
    let written = humantime::parse_rfc3339(&header.written).ok();
    let written = written.and_then(|at| at.duration_since(std::time::UNIX_EPOCH).ok()).map_or(0, nanos);
    let utc_ns = (written as i64).wrapping_sub(last.unwrap_or(Time(0)).0 as i64);
    let mut writer = Writer::new(Vec::new(), machine(header), utc_ns)?;
    records.iter().try_for_each(|record| writer.enter(record))?;
    writer.finish(0)
}

fn machine(header: &Header) -> Machine {
    let Header { program, machine, why, cycle, period_ns, deadline_ns, late_ns, .. } = header;
    let mut about = of_cycle(program, *period_ns, *deadline_ns, *late_ns);
    let more = [
        ("machine", machine.clone()),
        ("reference", header.reference.clone()),
        ("kernel", header.kernel.clone()),
        ("preemption", header.preemption.clone()),
        ("cpu", header.cpu.clone()),
        ("why", Some(why.clone())),
        ("cycle", Some(cycle.to_string())),
    ];
    about.extend(more.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?))));
    let axes = header.axes.iter().map(|axis| AxisAbout {
        name: axis.name.clone(),
        about: of_axis(&axis.unit, None),
        modulo: axis.modulo,
        native: None,
        monitor: axis.monitor.clone().map(|channel| channel.map(|of| (of.name, of.unit))),
        faults: Faults::Listed(axis.faults.clone()),
    });
    Machine { about, axes: axes.collect(), period_ns: *period_ns }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blackbox::file::Axis;
    use crate::recording::reading::Reading;
    use fieldbeat_core::axis::Link;
    use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord};
    use fieldbeat_core::time::MS;

    #[test]
    fn the_error_of_a_rotary_axis_is_by_the_shorter_way() {
        let axis = |modulo| Axis { name: "x".into(), modulo, ..Axis::default() };
        let drive =
            DriveRecord { link: Link::Online, position: 359.0, demand: 1.0, ..DriveRecord::default() };
        let records = [Record::Drive(drive), Record::Cycle(CycleRecord::default())];
        for (modulo, error) in [(Some(360.0), "2"), (None, "-358")] {
            let header = Header { period_ns: MS, axes: vec![axis(modulo)], ..Header::default() };
            let mut entries = Reading::of(convert(&header, &records).unwrap()).map(Result::unwrap);
            let of_axis = entries.find(|entry| entry.topic.name == "/axes/x").unwrap();
            assert_eq!(of_axis.texts().collect::<Vec<String>>()[2..5], ["359", "1", error]);
        }
    }
}
