//! The page: everything that the loop counts and the telemetry measures, by the names that Prometheus recommends (base
//! units, `_total` behind counters). What the loop counts is exact; histograms lack the records that got lost.

use std::fmt;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, MetricEncoder, NoLabelSet};
use prometheus_client::metrics::MetricType;
use prometheus_client::registry::{Registry, Unit};

use crate::summary::{Found, loads};
use fieldbeat_core::axis::{Link, MonitorChannel};
use fieldbeat_core::bus::facts::of_drives;
use fieldbeat_core::bus::{BusClock, BusFacts, OwnCounter, Unmatched};
use fieldbeat_core::cycle::record::Stage;
use fieldbeat_core::cycle::status::{DeviceEnd, DriveEnd, Numbers, Peak, ReferenceStatus, Status};
use fieldbeat_core::rt::host;
use fieldbeat_core::time::{MS, S, US};
use fieldbeat_telemetry::histograms::Quantity;
use fieldbeat_telemetry::signals::{JITTER, KEPT_OF_DRIVE, Kept, PHASE_ERROR, STAGE, WAKE};
use fieldbeat_telemetry::{Histograms, Measured, Monitor};

/// Upper ends of the buckets, us: three a decade, from what a tuned loop wakes with to what a lost one does.
const BUCKETS_US: [u64; 15] =
    [1, 2, 5, 10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000];

/// The page of a machine.
pub fn page(monitor: &Monitor) -> String {
    let mut registry = Registry::with_prefix("fieldbeat");
    registry.register_collector(Box::new(Machine(monitor.clone())));
    let mut text = String::new();
    // Writing into a string cannot fail.
    let _ = prometheus_client::encoding::text::encode(&mut text, &registry);
    text
}

/// A machine, read at every request of the page.
#[derive(Debug)]
struct Machine(Monitor);

impl Collector for Machine {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let Machine(monitor) = self;
        let (plan, numbers) = (monitor.plan(), monitor.numbers());
        let Numbers { status, drives, buses, clocks, devices, .. } = &numbers;
        let facts = plan.facts();
        let mut sheet = Sheet(encoder);
        sheet.host(monitor)?;
        sheet.values((Time, "cycle_period", "The period of the cycle."), [([], plan.cycle.period_ns)])?;
        sheet.numbers(&STATUS, [([], status)])?;
        sheet.maximum(&WAKE, [([], status.wake_max)])?;
        sheet.maximum(&JITTER, [([], status.jitter_max)])?;
        sheet.maximum(&STAGE, of_stages(status.stage_max))?;
        let led = plan.cycle.reference.as_deref().map(|bus| [("bus", bus)]);
        let reference = led.zip(status.reference.as_ref());
        sheet.numbers(&REFERENCE, reference)?;
        sheet.maximum(&PHASE_ERROR, reference.map(|(labels, of)| (labels, of.error_max)))?;
        let named = || drives.iter().map(|drive| (name_of(drive), drive));
        sheet.numbers(&DRIVE, named())?;
        for (kept, _, peak) in KEPT_OF_DRIVE {
            sheet.maximum(&kept, named().map(|(labels, drive)| (labels, peak(&drive.peaks))))?;
        }
        sheet.protocols(&facts, drives)?;
        let connected = named().enumerate().filter(|(index, _)| monitor.has_connection(*index));
        sheet.numbers(&CONNECTION, connected.map(|(_, drive)| drive))?;
        sheet.monitored(&facts, drives)?;
        sheet.numbers(&BUS, buses.iter().map(|(name, bus)| ([("bus", name.as_str())], bus)))?;
        let loads = buses.iter().zip(loads(&facts, plan.cycle.period_ns, &numbers));
        let loads = loads.filter_map(|((name, _), percent)| Some(([("bus", name.as_str())], percent?)));
        let help = ("bus_load_percent", "Load of the bus by the telegrams of its drives, since the start.");
        sheet.family(help, None, MetricType::Gauge, loads, |to, percent| to.encode_gauge(&percent))?;
        sheet.numbers(&DEVICE, devices.iter().map(|device| ([("device", device.name.as_str())], device)))?;
        sheet.device_protocols(devices)?;
        let clocks = buses.iter().zip(clocks);
        let clocks =
            clocks.filter_map(|((name, _), clock)| Some(([("bus", name.as_str())], clock.as_ref()?)));
        sheet.numbers(&CLOCK, clocks)?;
        monitor.measured(|Measured { histograms, causes, .. }| {
            sheet.histograms(histograms, drives)?;
            sheet.distributions(&PHASE_ERROR, led.map(|labels| (labels, &histograms.reference)))?;
            let found: Vec<Found> = causes.ranked().iter().map(|tally| Found::of(tally, plan)).collect();
            sheet.causes(&found)
        })
    }
}

/// A family of one number: how it is written, its name, its help, and where the number is.
type Field<T> = (Kind, &'static str, &'static str, fn(&T) -> u64);

#[derive(Clone, Copy, Debug)]
enum Kind {
    Count,
    Gauge,
    /// Of ns.
    Time,
}

use Kind::{Count, Gauge, Time};

const STATUS: [Field<Status>; 9] = [
    (Count, "cycles_planned", "Slots of the grid.", |of| of.planned),
    (Count, "cycles_executed", "Cycles executed.", |of| of.executed),
    (Count, "cycles_skipped", "Slots skipped.", |of| of.skipped),
    (Count, "overruns", "Times that a cycle ended too late for the next slot.", |of| of.overruns),
    (Count, "late_cycles", "Cycles later than the late limit of the plan.", |of| of.late),
    (Count, "telemetry_records_lost", RECORDS_LOST, |of| of.lost_records),
    (Count, "events_lost", EVENTS_LOST, |of| of.lost_events),
    (Gauge, "axes_online", "Axes online.", |of| of.online.into()),
    (Gauge, "axes_operational", "Axes in operation.", |of| of.operational.into()),
];
const RECORDS_LOST: &str = "Records lost before the histograms: the telemetry ring was full.";
const EVENTS_LOST: &str = "Events and samples lost because a queue of the application was full.";

const REFERENCE: [Field<ReferenceStatus>; 5] = [
    (Gauge, "reference_locked", "1 while the grid is locked to its reference clock.", |of| of.locked.into()),
    (Count, "reference_lock_losses", "Times that the grid lost its lock.", |of| of.losses),
    (Count, "reference_samples", "Executed cycles with a sample of the reference clock.", |of| of.samples),
    (Count, "reference_silent_cycles", WITHOUT_SAMPLE, |of| of.silent),
    (Time, "reference_step_max", "Largest step of the grid.", |of| of.step_max.ns),
];
const WITHOUT_SAMPLE: &str = "Executed cycles without a sample of the reference clock.";

const DRIVE: [Field<DriveEnd>; 14] = [
    (Count, "drive_requests_sent", "Requests sent.", |of| of.counters.sent),
    (Count, "drive_requests_unsent", UNSENT, |of| of.counters.unsent),
    (Count, "drive_replies_in_time", "Requests answered in time.", |of| of.counters.answered),
    (Count, "drive_replies_missed", "Requests not answered in time.", |of| of.counters.missed),
    (Count, "drive_replies_late", "Replies after their time.", |of| of.counters.late),
    (Count, "drive_replies_duplicate", "Duplicate replies.", |of| of.counters.duplicate),
    (Count, "drive_replies_suspect", SUSPECT, |of| of.counters.suspect),
    (Count, "drive_reports_implausible", IMPLAUSIBLE, |of| of.counters.implausible),
    (Count, "drive_datagrams_rejected", REJECTED, |of| of.counters.malformed + of.counters.foreign),
    (Count, "drive_link_losses", "Times that the link was lost.", |of| of.losses),
    (Gauge, "drive_online", "1 while the link is up.", |of| (of.feedback.link == Link::Online).into()),
    (Gauge, "drive_stopped", "1 while a stop is latched.", |of| of.feedback.stopped.is_some().into()),
    (Gauge, "drive_sto_open", STO_OPEN, |of| of.feedback.status.sto_open.into()),
    (Gauge, "drive_fault", "Fault code, 0 = none.", |of| of.feedback.status.fault.into()),
];
const UNSENT: &str = "Requests not sent: no connection, or refused by the operating system.";
const IMPLAUSIBLE: &str = "Reports that were not taken: the axis cannot be so.";
const SUSPECT: &str = "Replies that may belong to an earlier request.";
const REJECTED: &str = "Malformed and unmatched datagrams from its address.";
const STO_OPEN: &str = "1 while the hardware enable (STO) is missing.";

/// Of drives that are reached by a connection.
const CONNECTION: [Field<DriveEnd>; 1] =
    [(Gauge, "drive_not_connected", NOT_CONNECTED, |of| of.not_connected.is_some().into())];
const NOT_CONNECTED: &str = "1 while the drive is not online, and it is known why.";

const BUS: [Field<Unmatched>; 3] = [
    (Count, "bus_unmatched", "Datagrams from unknown senders.", |of| of.datagrams),
    (Count, "bus_dropped", DROPPED, |of| of.dropped),
    (Count, "bus_receive_errors", "Errors of the receiving socket.", |of| of.errors),
];
const DROPPED: &str = "Datagrams dropped by the kernel because the receive buffer was full.";

/// Of what takes part without being a drive.
const DEVICE: [Field<DeviceEnd>; 1] =
    [(Gauge, "device_not_operational", NOT_OPERATIONAL, |of| of.not_operational.is_some().into())];
const NOT_OPERATIONAL: &str = "1 while a device that is not a drive is not in operation.";

const CLOCK: [Field<BusClock>; 2] = [
    (Gauge, "bus_clock_locked", CLOCK_LOCKED, |of| of.locked.into()),
    (Time, "bus_clock_error_max", CLOCK_ERROR, |of| of.error_max_ns),
];
const CLOCK_LOCKED: &str = "1 while the clock of the bus and the grid are synchronised.";
const CLOCK_ERROR: &str = "Largest phase error of that clock and the grid since they were synchronised.";

/// Labels of a sample.
type Labels<'a, const N: usize> = [(&'static str, &'a str); N];

/// The page that is written, one family of samples after the other.
struct Sheet<'a>(DescriptorEncoder<'a>);

impl Sheet<'_> {
    fn family<'a, const N: usize, V>(
        &mut self,
        (name, help): (&str, &str),
        unit: Option<Unit>,
        kind: MetricType,
        samples: impl IntoIterator<Item = (Labels<'a, N>, V)>,
        encode: impl Fn(&mut MetricEncoder<'_>, V) -> fmt::Result,
    ) -> fmt::Result {
        let mut family = self.0.encode_descriptor(name, help, unit.as_ref(), kind)?;
        for (labels, value) in samples {
            // Empty braces would be right, too, but are not nice to read.
            match N {
                0 => encode(&mut family, value)?,
                _ => encode(&mut family.encode_family(&labels)?, value)?,
            }
        }
        Ok(())
    }

    fn values<'a, const N: usize>(
        &mut self,
        (kind, name, help): (Kind, &str, &str),
        samples: impl IntoIterator<Item = (Labels<'a, N>, u64)>,
    ) -> fmt::Result {
        let (unit, metric) = match kind {
            Count => (None, MetricType::Counter),
            Gauge => (None, MetricType::Gauge),
            Time => (Some(Unit::Seconds), MetricType::Gauge),
        };
        self.family((name, help), unit, metric, samples, |to, value| match kind {
            Count => to.encode_counter::<NoLabelSet, _, f64>(&value, None),
            Gauge => to.encode_gauge(&value),
            Time => to.encode_gauge(&seconds(value)),
        })
    }

    /// A family for each of the fields, with a sample of each thing that has them.
    fn numbers<'a, T: 'a, const N: usize>(
        &mut self,
        fields: &[Field<T>],
        of: impl IntoIterator<Item = (Labels<'a, N>, &'a T)> + Clone,
    ) -> fmt::Result {
        fields.iter().try_for_each(|(kind, name, help, value)| {
            let samples = of.clone().into_iter().map(|(labels, of)| (labels, value(of)));
            self.values((*kind, name, help), samples)
        })
    }

    fn maximum<'a, const N: usize>(
        &mut self,
        Kept { metric, largest, .. }: &Kept,
        samples: impl IntoIterator<Item = (Labels<'a, N>, Peak)>,
    ) -> fmt::Result {
        let samples = samples.into_iter().map(|(labels, peak)| (labels, peak.ns));
        self.values((Time, &format!("{metric}_max"), largest), samples)
    }

    fn distributions<'a, const N: usize>(
        &mut self,
        Kept { metric, about, .. }: &Kept,
        samples: impl IntoIterator<Item = (Labels<'a, N>, &'a Quantity)>,
    ) -> fmt::Result {
        self.family((metric, about), Some(Unit::Seconds), MetricType::Histogram, samples, |to, histogram| {
            let sum = histogram.bins().mean() * histogram.len() as f64 / S as f64;
            to.encode_histogram::<NoLabelSet>(sum, histogram.len(), &buckets(histogram), None)
        })
    }

    fn host(&mut self, monitor: &Monitor) -> fmt::Result {
        let granted = monitor.granted();
        let known = |text: Option<String>| text.unwrap_or_default();
        let (kernel, preemption, cpu) =
            (known(host::kernel()), known(host::preemption()), known(host::cpu()));
        let labels = [("kernel", kernel.as_str()), ("preemption", &preemption), ("cpu", &cpu)];
        let help = ("host", "The host.");
        self.family(help, None, MetricType::Info, [([], labels)], |to, labels| to.encode_info(&labels))?;
        let priority = granted.priority.to_string();
        let core = granted.core.map_or(String::new(), |core| core.to_string());
        let labels = [
            ("version", env!("CARGO_PKG_VERSION")),
            ("policy", granted.policy),
            ("priority", &priority),
            ("core", &core),
        ];
        let help = ("loop", "The program, and how its loop is scheduled.");
        self.family(help, None, MetricType::Info, [([], labels)], |to, labels| to.encode_info(&labels))?;
        let all = u64::from(granted.missing.is_empty());
        let help = "1 if the loop got the scheduling and the locked memory of its plan.";
        self.values((Gauge, "realtime", help), [([], all)])?;
        let help = ("steal", "Time that the hypervisor took from all cores since the start.");
        let steal = monitor.steal_ms().map(|ms| ([], ms * MS));
        self.family(help, Some(Unit::Seconds), MetricType::Counter, steal, |to, ns| {
            to.encode_counter::<NoLabelSet, _, f64>(&seconds(ns), None)
        })
    }

    fn protocols(&mut self, facts: &[BusFacts], drives: &[DriveEnd]) -> fmt::Result {
        let samples = drives.iter().zip(of_drives(facts)).flat_map(|(drive, (bus, _))| {
            let labels = |key| [("drive", drive.name.as_str()), ("what", key)];
            bus.own_counters
                .iter()
                .zip(drive.counters.own)
                .map(move |(OwnCounter { key, .. }, count)| (labels(*key), count))
        });
        self.values((Count, "drive_protocol_events", "Counters of the protocol of the drive."), samples)
    }

    fn device_protocols(&mut self, devices: &[DeviceEnd]) -> fmt::Result {
        let samples = devices.iter().flat_map(|DeviceEnd { name, protocol_counters, .. }| {
            let labels = |key| [("device", name.as_str()), ("what", key)];
            protocol_counters.0.iter().map(move |(OwnCounter { key, .. }, count)| (labels(*key), *count))
        });
        self.values((Count, "device_protocol_events", "Counters of the protocol of the device."), samples)
    }

    fn monitored(&mut self, facts: &[BusFacts], drives: &[DriveEnd]) -> fmt::Result {
        type Field = (&'static str, &'static str, fn(&DriveEnd, usize) -> Option<f64>);
        const VALUES: [Field; 3] = [
            (
                "drive_monitor",
                "A monitored variable of the drive, while the drive reports it.",
                |drive, channel| {
                    let DriveEnd { feedback, monitor, .. } = drive;
                    let shows = feedback.link == Link::Online && feedback.status.monitor[channel].is_some();
                    monitor[channel].filter(|_| shows).map(|extent| extent.value)
                },
            ),
            ("drive_monitor_min", "The smallest value of that variable.", |drive, channel| {
                drive.monitor[channel].map(|extent| extent.min)
            }),
            ("drive_monitor_max", "The largest value of that variable.", |drive, channel| {
                drive.monitor[channel].map(|extent| extent.max)
            }),
        ];
        let mut variables = Vec::new();
        for (drive, (_, of)) in drives.iter().zip(of_drives(facts)) {
            for (channel, named) in of.monitored.iter().enumerate() {
                variables.extend(named.as_ref().map(|named| (drive, channel, named)));
            }
        }
        for (name, help, value) in VALUES {
            let samples = variables.iter().filter_map(|(drive, channel, MonitorChannel { name, unit })| {
                let labels = [("drive", drive.name.as_str()), ("variable", name), ("unit", unit)];
                Some((labels, value(drive, *channel)?))
            });
            self.family((name, help), None, MetricType::Gauge, samples, |to, value| to.encode_gauge(&value))?;
        }
        Ok(())
    }

    fn histograms(&mut self, histograms: &Histograms, drives: &[DriveEnd]) -> fmt::Result {
        self.distributions(&WAKE, [([], &histograms.wake)])?;
        self.distributions(&JITTER, [([], &histograms.jitter)])?;
        self.distributions(&STAGE, of_stages(&histograms.stages))?;
        KEPT_OF_DRIVE.into_iter().try_for_each(|(kept, quantity, _)| {
            let drives = drives.iter().zip(&histograms.drives);
            self.distributions(&kept, drives.map(|(drive, measured)| (name_of(drive), quantity(measured))))
        })
    }

    fn causes(&mut self, found: &[Found]) -> fmt::Result {
        let samples = found.iter().map(|found| {
            let drive = found.drive.as_deref().unwrap_or_default();
            (
                [("cause", found.cause), ("stage", found.stage.unwrap_or_default()), ("drive", drive)],
                found.count,
            )
        });
        let help = "Late cycles by their cause; the newest are not explained yet.";
        self.values((Count, "late_cycles_explained", help), samples)
    }
}

/// The value of each stage, with its label.
fn of_stages<'a, T>(of: impl IntoIterator<Item = T>) -> impl Iterator<Item = (Labels<'a, 1>, T)> {
    Stage::ALL.into_iter().map(|stage| [("stage", stage.name())]).zip(of)
}

fn name_of(drive: &DriveEnd) -> Labels<'_, 1> {
    [("drive", &drive.name)]
}

fn seconds(ns: u64) -> f64 {
    ns as f64 / S as f64
}

/// The samples of each bucket, and those beyond.
fn buckets(histogram: &Quantity) -> Vec<(f64, u64)> {
    let ends = BUCKETS_US.map(|us| us * US);
    let mut buckets: Vec<(f64, u64)> = ends.iter().map(|end| (seconds(*end), 0)).collect();
    buckets.push((f64::INFINITY, 0));
    for step in histogram.bins().iter_recorded() {
        // The middle of its bin stands for a sample, as it does in the sum.
        let value = histogram.bins().median_equivalent(step.value_iterated_to());
        let place = ends.partition_point(|end| *end < value);
        buckets[place].1 += step.count_since_last_iteration();
    }
    buckets
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sample_is_in_a_bucket() {
        let mut histograms = Histograms::new(1);
        for ns in [1, 1_000, 1_001, 45_000, 50_000_000, 60_000_000] {
            histograms.wake.bins_mut().record(ns).unwrap();
        }
        let buckets = buckets(&histograms.wake);
        let filled: Vec<(f64, u64)> = buckets.iter().copied().filter(|(_, count)| *count > 0).collect();
        assert_eq!(filled, [(1e-6, 2), (2e-6, 1), (5e-5, 1), (5e-2, 1), (f64::INFINITY, 1)]);
        assert_eq!((buckets.len(), buckets[14].0), (16, 0.05));
    }
}
