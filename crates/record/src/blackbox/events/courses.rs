//! The drives that it happened to, from cycle to cycle.

use std::num::NonZeroU32;
use std::ops::RangeInclusive;

use serde::Serialize;

use super::Event;
use crate::blackbox::file::{Channel, Header};
use crate::summary::reported;
use fieldbeat_core::cycle::record::Record;

/// A drive from cycle to cycle.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Course {
    /// The name.
    pub name: String,
    /// The user unit.
    pub unit: String,
    /// The monitored variables.
    pub monitor: Vec<Channel>,
    /// The cycles.
    pub rows: Vec<Row>,
}

/// A drive in a cycle.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Which.
    pub cycle: u64,
    /// The fate of its exchange.
    pub reply: String,
    /// The round trip.
    pub rtt_ns: Option<NonZeroU32>,
    /// The link as judged.
    pub link: String,
    /// State of the drive.
    pub state: String,
    /// Actual position, user units; `None` = the drive reports none, like the three below.
    pub position: Option<f64>,
    /// Demand position, user units.
    pub demand: Option<f64>,
    /// Actual velocity, user units/s.
    pub velocity: Option<f32>,
    /// Motor current, A.
    pub current: Option<f32>,
    /// The monitored variables, in the order of [`Course::monitor`]; `None` = nothing in this cycle.
    pub monitor: Vec<Option<f64>>,
}

/// The drives that it happened to, from `cycles` cycles before the failure on.
pub fn courses(header: &Header, records: &[Record], events: &[Event], cycles: u64) -> Vec<Course> {
    let shown = around(header, cycles);
    let mut courses: Vec<Option<Course>> = vec![None; header.axes.len()];
    for axis in concerned(header, events, cycles) {
        let of = &header.axes[axis];
        let (name, unit) = (of.name.clone(), of.unit.clone());
        let monitor = of.monitor.iter().flatten().cloned().collect();
        courses[axis] = Some(Course { name, unit, monitor, rows: Vec::new() });
    }
    for record in records.iter().filter(|record| shown.contains(&record.index())) {
        match record {
            Record::Drive(drive) => {
                let Some(Some(course)) = courses.get_mut(usize::from(drive.axis)) else { continue };
                course.rows.push(Row {
                    cycle: drive.index,
                    reply: format!("{:?}", drive.reply).to_lowercase(),
                    rtt_ns: drive.rtt_ns,
                    link: drive.link.to_string(),
                    state: drive.state.to_string(),
                    position: reported(drive.position),
                    demand: reported(drive.demand),
                    velocity: Some(drive.velocity).filter(|velocity| velocity.is_finite()),
                    current: Some(drive.current).filter(|current| current.is_finite()),
                    monitor: vec![None; course.monitor.len()],
                });
            }
            Record::Monitor(of) => {
                let axis = usize::from(of.axis);
                let Some(Some(course)) = courses.get_mut(axis) else { continue };
                let Some(row) = course.rows.last_mut().filter(|row| row.cycle == of.index) else { continue };
                let values = of.shown.values().map(|value| value.and_then(reported));
                let channels = header.axes[axis].monitor.iter().zip(values);
                row.monitor =
                    channels.filter_map(|(channel, value)| channel.as_ref().map(|_| value)).collect();
            }
            _ => {}
        }
    }
    courses.into_iter().flatten().collect()
}

/// The cycles that are shown one by one: so many before the failure, and a quarter of that after it.
pub(super) fn around(header: &Header, cycles: u64) -> RangeInclusive<u64> {
    header.cycle.saturating_sub(cycles)..=header.cycle.saturating_add(cycles / 4)
}

/// The drives to which something happened around the failure; all of them if it was to none.
fn concerned(header: &Header, events: &[Event], cycles: u64) -> Vec<usize> {
    let until = |one: &Event| one.until.saturating_add(1).saturating_add(cycles);
    let near = |one: &Event| until(one) > header.cycle && one.cycle <= header.cycle;
    let met = |axis: &usize| {
        events.iter().any(|one| near(one) && one.drive.as_ref() == Some(&header.axes[*axis].name))
    };
    let some: Vec<usize> = (0..header.axes.len()).filter(met).collect();
    if some.is_empty() { (0..header.axes.len()).collect() } else { some }
}
