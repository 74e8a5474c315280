//! The page: everything that the loop counts and the telemetry measures, by the names that Prometheus recommends (base
//! units, `_total` behind counters). What the loop counts is exact; histograms lack the records that got lost.

use std::fmt;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, MetricEncoder, NoLabelSet};
use prometheus_client::metrics::MetricType;
use prometheus_client::registry::{Registry, Unit};

use crate::axis::{Link, MonitorChannel};
use crate::bus::OwnCounter;
use crate::cycle::Plan;
use crate::cycle::record::Stage;
use crate::cycle::status::{DriveEnd, Numbers, ReferenceStatus};
use crate::rt::host;
use crate::telemetry::histograms::Quantity;
use crate::telemetry::summary::Found;
use crate::telemetry::{Histograms, Measured, Monitor};
use crate::time::{MS, S, US};

/// Upper ends of the buckets, ns: three a decade, from what a tuned loop wakes with to what a lost one does.
const BUCKETS: [u64; 15] = [
    US,
    2 * US,
    5 * US,
    10 * US,
    20 * US,
    50 * US,
    100 * US,
    200 * US,
    500 * US,
    MS,
    2 * MS,
    5 * MS,
    10 * MS,
    20 * MS,
    50 * MS,
];

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
        let mut sheet = Sheet(encoder);
        let numbers = monitor.numbers();
        sheet.host(monitor)?;
        sheet.cycle(monitor.plan().cycle.period_ns, &numbers)?;
        sheet.reference(monitor.plan(), &numbers)?;
        sheet.drives(&numbers.drives)?;
        sheet.protocols(monitor.plan(), &numbers.drives)?;
        sheet.connections(monitor, &numbers.drives)?;
        sheet.monitored(monitor.plan(), &numbers.drives)?;
        sheet.buses(&numbers)?;
        sheet.lines(&numbers)?;
        monitor.measured(|Measured { histograms, causes, .. }| {
            sheet.histograms(histograms, &numbers.drives)?;
            sheet.phase(monitor.plan(), histograms)?;
            let found: Vec<Found> =
                causes.ranked().iter().map(|tally| Found::of(tally, monitor.plan())).collect();
            sheet.causes(&found)
        })
    }
}

/// Labels of a sample.
type Labels<'a, const N: usize> = [(&'static str, &'a str); N];

/// What is written to, one family of samples after the other.
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

    fn counters<'a, const N: usize>(
        &mut self,
        name: &str,
        help: &str,
        samples: impl IntoIterator<Item = (Labels<'a, N>, u64)>,
    ) -> fmt::Result {
        self.family((name, help), None, MetricType::Counter, samples, |to, count| {
            to.encode_counter::<NoLabelSet, _, f64>(&count, None)
        })
    }

    fn gauges<'a, const N: usize>(
        &mut self,
        name: &str,
        help: &str,
        samples: impl IntoIterator<Item = (Labels<'a, N>, u64)>,
    ) -> fmt::Result {
        self.family((name, help), None, MetricType::Gauge, samples, |to, value| to.encode_gauge(&value))
    }

    fn times<'a, const N: usize>(
        &mut self,
        name: &str,
        help: &str,
        samples: impl IntoIterator<Item = (Labels<'a, N>, u64)>,
    ) -> fmt::Result {
        self.family((name, help), Some(Unit::Seconds), MetricType::Gauge, samples, |to, ns| {
            to.encode_gauge(&seconds(ns))
        })
    }

    fn distributions<'a, const N: usize>(
        &mut self,
        name: &str,
        help: &str,
        samples: impl IntoIterator<Item = (Labels<'a, N>, &'a Quantity)>,
    ) -> fmt::Result {
        self.family((name, help), Some(Unit::Seconds), MetricType::Histogram, samples, |to, histogram| {
            let sum = histogram.mean() * histogram.len() as f64 / S as f64;
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
        self.gauges(
            "realtime",
            "1 if the loop got the scheduling and the locked memory of its plan.",
            [([], all)],
        )?;
        let help = ("steal", "Time that the hypervisor took from all cores since the start.");
        let steal = monitor.steal_ms().map(|ms| ([], ms * MS));
        self.family(help, Some(Unit::Seconds), MetricType::Counter, steal, |to, ns| {
            to.encode_counter::<NoLabelSet, _, f64>(&seconds(ns), None)
        })
    }

    fn cycle(&mut self, period_ns: u64, Numbers { status, .. }: &Numbers) -> fmt::Result {
        self.times("cycle_period", "The period of the cycle.", [([], period_ns)])?;
        for (name, help, count) in [
            ("cycles_planned", "Slots of the grid.", status.planned),
            ("cycles_executed", "Cycles executed.", status.executed),
            ("cycles_skipped", "Slots skipped.", status.skipped),
            ("overruns", "Times that a cycle ended too late for the next slot.", status.overruns),
            ("late_cycles", "Cycles later than the late limit of the plan.", status.late),
            (
                "telemetry_records_lost",
                "Records lost before the histograms: the telemetry ring was full.",
                status.lost_records,
            ),
            (
                "events_lost",
                "Events and samples lost because a queue of the application was full.",
                status.lost_events,
            ),
        ] {
            self.counters(name, help, [([], count)])?;
        }
        self.gauges("axes_online", "Axes online.", [([], u64::from(status.online))])?;
        self.gauges("axes_operational", "Axes in operation.", [([], u64::from(status.operational))])?;
        self.times(
            "wake_up_max",
            "Largest wake-up latency: start of a cycle after its grid point.",
            [([], status.wake_max.ns)],
        )?;
        self.times("cycle_jitter_max", "Largest jitter of the cycle.", [([], status.jitter_max.ns)])?;
        let stages = Stage::ALL.map(|stage| ([("stage", stage.name())], status.stage_max[stage as usize].ns));
        self.times("stage_max", "The longest time of each stage.", stages)
    }

    fn reference(&mut self, plan: &Plan, Numbers { status, .. }: &Numbers) -> fmt::Result {
        let led = status.reference.zip(plan.cycle.reference.as_deref());
        let (led, bus) = (led.map(|(status, _)| status), led.map_or("", |(_, bus)| bus));
        let of = |value: fn(&ReferenceStatus) -> u64| led.map(|status| ([("bus", bus)], value(&status)));
        let locked = of(|status| status.locked.into());
        self.gauges("reference_locked", "1 while the grid is locked to its reference clock.", locked)?;
        let losses = of(|status| status.losses);
        self.counters("reference_lock_losses", "Times that the grid lost its lock.", losses)?;
        let samples = of(|status| status.samples);
        self.counters("reference_samples", "Executed cycles with a sample of the reference clock.", samples)?;
        let silent = of(|status| status.silent);
        self.counters(
            "reference_silent_cycles",
            "Executed cycles without a sample of the reference clock.",
            silent,
        )?;
        let error = of(|status| status.error_max.ns);
        self.times("reference_error_max", "Largest phase error of the grid since its first lock.", error)?;
        let step = of(|status| status.step_max.ns);
        self.times("reference_step_max", "Largest step of the grid.", step)
    }

    fn drives(&mut self, drives: &[DriveEnd]) -> fmt::Result {
        type Field = (&'static str, &'static str, fn(&DriveEnd) -> u64);
        const COUNTS: [Field; 9] = [
            ("drive_requests_sent", "Requests sent.", |drive| drive.counters.sent),
            ("drive_requests_unsent", "Requests not sent: refused by the operating system.", |drive| {
                drive.counters.unsent
            }),
            ("drive_replies_in_time", "Requests answered in time.", |drive| drive.counters.answered),
            ("drive_replies_missed", "Requests not answered in time.", |drive| drive.counters.missed),
            ("drive_replies_late", "Replies after the receive deadline.", |drive| drive.counters.late),
            ("drive_replies_duplicate", "Duplicate replies.", |drive| drive.counters.duplicate),
            ("drive_replies_suspect", "Replies that may belong to an earlier request.", |drive| {
                drive.counters.suspect
            }),
            ("drive_datagrams_rejected", "Malformed and unmatched datagrams from its address.", |drive| {
                drive.counters.malformed + drive.counters.foreign
            }),
            ("drive_link_losses", "Times that the link was lost.", |drive| drive.losses),
        ];
        const STATES: [Field; 4] = [
            ("drive_online", "1 while the link is up.", |drive| {
                u64::from(drive.feedback.link == Link::Online)
            }),
            ("drive_stopped", "1 while a stop is latched.", |drive| {
                u64::from(drive.feedback.stopped.is_some())
            }),
            ("drive_inhibited", "1 while the hardware enable (STO) is missing.", |drive| {
                u64::from(drive.feedback.status.inhibited)
            }),
            ("drive_fault", "Fault code, 0 = none.", |drive| u64::from(drive.feedback.status.fault)),
        ];
        const MAXIMA_NS: [Field; 3] = [
            ("drive_round_trip_max", "The longest round trip.", |drive| drive.peaks.rtt.ns),
            ("drive_send_jitter_max", "The largest jitter of the requests.", |drive| {
                drive.peaks.send_jitter.ns
            }),
            ("drive_value_age_max", "Largest age of the feedback at the receive deadline.", |drive| {
                drive.peaks.age.ns
            }),
        ];
        for (name, help, value) in COUNTS {
            self.counters(name, help, drives.iter().map(|drive| (name_of(drive), value(drive))))?;
        }
        for (name, help, value) in STATES {
            self.gauges(name, help, drives.iter().map(|drive| (name_of(drive), value(drive))))?;
        }
        for (name, help, value) in MAXIMA_NS {
            self.times(name, help, drives.iter().map(|drive| (name_of(drive), value(drive))))?;
        }
        Ok(())
    }

    fn protocols(&mut self, plan: &Plan, drives: &[DriveEnd]) -> fmt::Result {
        let samples = drives.iter().zip(plan.own_counters()).flat_map(|(drive, own)| {
            let labels = |key| [("drive", drive.name.as_str()), ("what", key)];
            own.iter()
                .zip(drive.counters.own)
                .map(move |(OwnCounter { key, .. }, count)| (labels(*key), count))
        });
        self.counters("drive_protocol_events", "Counters of the protocol of the drive.", samples)
    }

    fn connections(&mut self, monitor: &Monitor, drives: &[DriveEnd]) -> fmt::Result {
        let samples = (drives.iter().enumerate())
            .filter(|(index, _)| monitor.has_connection(*index))
            .map(|(_, drive)| (name_of(drive), u64::from(drive.not_connected.is_some())));
        self.gauges("drive_not_connected", "1 while the connection to the drive cannot be opened.", samples)
    }

    fn monitored(&mut self, plan: &Plan, drives: &[DriveEnd]) -> fmt::Result {
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
        let monitored = plan.monitored();
        let mut variables = Vec::new();
        for (drive, channels) in drives.iter().zip(&monitored) {
            for (channel, named) in channels.iter().enumerate() {
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

    /// What takes part without being a drive, and the clocks of the buses.
    fn lines(&mut self, Numbers { buses, clocks, devices, .. }: &Numbers) -> fmt::Result {
        let samples = devices
            .iter()
            .map(|device| ([("device", device.name.as_str())], u64::from(device.not_operational.is_some())));
        self.gauges(
            "device_not_operational",
            "1 while a device that is not a drive is not in operation.",
            samples,
        )?;
        let clocks: Vec<_> = buses
            .iter()
            .zip(clocks)
            .filter_map(|((name, _), clock)| Some(([("bus", name.as_str())], (*clock)?)))
            .collect();
        let locked = clocks.iter().map(|(bus, clock)| (*bus, u64::from(clock.locked)));
        self.gauges(
            "bus_clock_locked",
            "1 while the clock of the bus and the grid are synchronised.",
            locked,
        )?;
        let error = clocks.iter().map(|(bus, clock)| (*bus, clock.error_max_ns));
        self.times(
            "bus_clock_error_max",
            "Largest phase error of that clock and the grid since they were synchronised.",
            error,
        )
    }

    fn buses(&mut self, Numbers { buses, .. }: &Numbers) -> fmt::Result {
        let unmatched = buses.iter().map(|(name, bus)| ([("bus", name.as_str())], bus.datagrams));
        self.counters("bus_unmatched", "Datagrams from unknown senders.", unmatched)?;
        let dropped = buses.iter().map(|(name, bus)| ([("bus", name.as_str())], bus.dropped));
        self.counters(
            "bus_dropped",
            "Datagrams dropped by the kernel because the receive buffer was full.",
            dropped,
        )?;
        let errors = buses.iter().map(|(name, bus)| ([("bus", name.as_str())], bus.errors));
        self.counters("bus_receive_errors", "Errors of the receiving socket.", errors)
    }

    fn histograms(&mut self, histograms: &Histograms, drives: &[DriveEnd]) -> fmt::Result {
        let Histograms { wake, jitter, .. } = histograms;
        self.distributions(
            "wake_up",
            "Wake-up latency: start of the cycles after their grid points; skipped slots count as late.",
            [([], wake)],
        )?;
        self.distributions(
            "cycle_jitter",
            "Differences between the distance of two starts and that of their grid points.",
            [([], jitter)],
        )?;
        let stages = Stage::ALL.map(|stage| ([("stage", stage.name())], histograms.stage(stage)));
        self.distributions("stage", "Time of each stage of a cycle.", stages)?;
        let drives =
            || drives.iter().zip(&histograms.drives).map(|(drive, measured)| (name_of(drive), measured));
        let rtt = drives().map(|(labels, drive)| (labels, &drive.rtt));
        self.distributions("drive_round_trip", "Round trips.", rtt)?;
        let jitter = drives().map(|(labels, drive)| (labels, &drive.send_jitter));
        self.distributions(
            "drive_send_jitter",
            "Differences between the distance of two requests and that of their grid points.",
            jitter,
        )?;
        let age = drives().map(|(labels, drive)| (labels, &drive.age));
        self.distributions("drive_value_age", "Age of the feedback at the receive deadline.", age)
    }

    fn phase(&mut self, plan: &Plan, histograms: &Histograms) -> fmt::Result {
        let led = plan.cycle.reference.as_deref().map(|bus| ([("bus", bus)], &histograms.reference));
        self.distributions(
            "reference_error",
            "Phase errors of the grid, late or early, since its first lock.",
            led,
        )
    }

    fn causes(&mut self, found: &[Found]) -> fmt::Result {
        let samples = found.iter().map(|found| {
            let drive = found.drive.as_deref().unwrap_or_default();
            (
                [("cause", found.cause), ("stage", found.stage.unwrap_or_default()), ("drive", drive)],
                found.count,
            )
        });
        self.counters(
            "late_cycles_explained",
            "Late cycles by their cause; the newest are not explained yet.",
            samples,
        )
    }
}

fn name_of(drive: &DriveEnd) -> Labels<'_, 1> {
    [("drive", &drive.name)]
}

fn seconds(ns: u64) -> f64 {
    ns as f64 / S as f64
}

/// The samples of each bucket, and those beyond.
fn buckets(histogram: &Quantity) -> Vec<(f64, u64)> {
    let ends = BUCKETS.iter().map(|end| seconds(*end)).chain([f64::INFINITY]);
    let mut buckets: Vec<(f64, u64)> = ends.map(|end| (end, 0)).collect();
    for step in histogram.iter_recorded() {
        // The middle of its bin stands for a sample, as it does in the sum.
        let value = histogram.median_equivalent(step.value_iterated_to());
        let place = BUCKETS.partition_point(|end| *end < value);
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
            histograms.wake.record(ns).unwrap();
        }
        let buckets = buckets(&histograms.wake);
        let filled: Vec<(f64, u64)> = buckets.iter().copied().filter(|(_, count)| *count > 0).collect();
        assert_eq!(filled, [(1e-6, 2), (2e-6, 1), (5e-5, 1), (5e-2, 1), (f64::INFINITY, 1)]);
        assert_eq!((buckets.len(), buckets[14].0), (16, 0.05));
    }
}
