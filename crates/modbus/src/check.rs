//! What is wrong with the plan of a drive, and what `check` says of it.

use std::net::Ipv4Addr;

use super::mapping::Mapping;
use super::parameter::Width;
use super::plan::{
    Functions, KEYPAD_WATCHDOG_NS, REFERENCES_IN_A_ROW, UnidriveDrive, Via, WATCHDOG_MAX_NS, Watchdog,
};
use fieldbeat_core::axis::{Faults, MonitorChannel, PlanFault};
use fieldbeat_core::bus::unwatched;
use fieldbeat_core::time::{MS, Ns, S};

/// A host repeats a lost segment that nothing follows after so long at the earliest, ns (Linux: TCP_RTO_MIN, and the
/// drive's host may take as long or longer) ...
const REPEATED_NS: u64 = 200 * MS;
/// ... and its reply is there by then, on a local network.
const REPEATED_BY_NS: u64 = REPEATED_NS + 10 * MS;

impl UnidriveDrive {
    /// The contradictions, and settings that would not work with an exchange every `period_ns`; those of every axis
    /// left out.
    pub fn faults(&self, period_ns: u64) -> Vec<PlanFault> {
        let mut faults: Vec<PlanFault> = Mapping::new(self).err().into_iter().collect();
        faults.extend(self.axis.position_faults());
        faults.extend(self.speed_faults());
        faults.extend(self.watchdog_faults(period_ns));
        let wrong = self.reply_within_ns == 0 || self.reply_within_ns > 10 * S;
        faults.wrong_if(wrong, "reply_within", "must be above 0 and at most 10 s");
        let why = "must be the slot of the Ethernet interface: 4 onboard, 1 ... 3 an SI-Ethernet option";
        faults.wrong_if(!(1..=4).contains(&self.slot), "slot", why);
        faults.extend(self.axis.torque_fault("the drive takes speed setpoints, no torques"));
        let trips = "a Unidrive that trips, by its watchdog too, coasts";
        faults.extend(self.axis.dropped_fault(trips));
        faults
    }

    /// A reference is a whole number of `10^-decimals` rpm, with its sign in the control word.
    fn speed_faults(&self) -> Vec<PlanFault> {
        let (axis, mut faults) = (&self.axis, Vec::new());
        if axis.units.counts_per_unit == 0.0 || !axis.units.counts_per_unit.is_finite() {
            return faults; // Reported for every axis.
        }
        let reference = &self.map.reference;
        let ends = (1, reference.width.range(true).1 as i32);
        let (least, most) = (reference.value(ends.0), reference.value(ends.1));
        for (key, value) in axis.velocities() {
            let rpm = self.rpm(value).abs();
            let why = format!(
                "{rpm} rpm of the motor are outside the range of the drive, {least} ... {most} rpm; change it or \
                 check scale"
            );
            faults.wrong_if(!(least..=most).contains(&rpm), key, why);
        }
        let missing = reference.width == Width::Word && axis.limits.velocity.is_none();
        let why = format!("missing; a reference of 16 bits needs one, up to {most} rpm of the motor");
        faults.wrong_if(missing, "limits.velocity", why);
        faults
    }

    fn watchdog_faults(&self, period_ns: u64) -> Vec<PlanFault> {
        let mut faults = Vec::new();
        // Any request is traffic. The next one follows in its turn, when the reply no longer counts at the latest.
        let silent_ns = period_ns.saturating_add(period_ns.max(self.reply_within_ns));
        match self.watchdog.timeout_ns {
            Some(ns) if ns == 0 || ns > WATCHDOG_MAX_NS || !ns.is_multiple_of(MS) => {
                faults.wrong("watchdog.timeout", "must be in whole milliseconds; use 1ms ... 65535ms");
            }
            Some(ns) if ns < silent_ns => {
                let (after, silent) = (Ns(ns), Ns(silent_ns));
                let why = format!(
                    "trips the drive after {after} without traffic, but {silent} may pass until the next request; \
                     allow more, exchange more often, or lower reply_within"
                );
                faults.wrong("watchdog.timeout", why);
            }
            _ => {}
        }
        let written_ns = self.control_written_every(period_ns);
        let (after, written) = (Ns(KEYPAD_WATCHDOG_NS), Ns(written_ns));
        let why = format!(
            "trips the drive when its control word is not written for {after}, but {written} may pass between two \
             writes; exchange more often, or use the timeout"
        );
        let trips = self.watchdog.keypad && KEYPAD_WATCHDOG_NS < written_ns.saturating_mul(2);
        faults.wrong_if(trips, "watchdog.keypad", why);
        faults
    }

    /// The control word is written at least this often, ns, while nothing is lost.
    fn control_written_every(&self, period_ns: u64) -> u64 {
        // Where control word and reference are apart, the reference goes first for a while. Acyclic calls take turns
        // with all of it, and so does reading in a drive without FC23.
        let blocks = Mapping::new(self).map_or(1, |mapping| mapping.writes().len() as u64);
        let turns = if blocks > 1 { u64::from(REFERENCES_IN_A_ROW) + 1 } else { 1 };
        period_ns.saturating_mul(4 * turns)
    }

    /// The lines of `check` beyond its axis; the first line is its address.
    pub fn describe(&self, bind: Option<Ipv4Addr>, period_ns: u64) -> String {
        let every = Ns(period_ns.saturating_mul(self.axis.divisor.into()));
        let mut lines = vec![match bind {
            Some(bind) => format!("{bind} -> {}", self.address),
            None => self.address.to_string(),
        }];
        lines.push(self.describe_serial());
        lines.extend(self.describe_exchange(every));
        lines.push(
            match self.functions {
                Functions::Auto => {
                    "by FC23; a drive that refuses or ignores it is written by FC16 and read by FC03 in \
                     turns (no_fc23 counts that)"
                }
                Functions::ReadWrite => "by FC23 and no other function",
                Functions::Apart => "writing (FC16) and reading (FC03) take turns",
            }
            .to_owned(),
        );
        lines.push(format!(
            "a reply counts for {}; after {} of silence its connection is opened again, with pauses: a stop \
             request leaves with the first exchange on the new one, and until then only the drive's own \
             watchdog stops it",
            Ns(self.reply_within_ns),
            Ns(2 * self.reply_within_ns)
        ));
        lines.push(self.describe_loss(every.0));
        lines.push("takes velocities; no moves, no streams, no homing".to_owned());
        lines.extend(MonitorChannel::names(self.shown()).map(|names| format!("shows {names}")));
        if !self.set_up {
            lines.push(
                "set_up = false: the master writes no settings, and enables the drive only if they are as \
                 needed"
                    .to_owned(),
            );
        }
        lines.push(format!("if the master dies: {}", self.describe_death()));
        lines.join("\n")
    }

    /// By what it is known.
    fn describe_serial(&self) -> String {
        let [low, high] = self.serial_from;
        match self.serial {
            Some(serial) => format!(
                "known by its serial number {serial} (Pr {low} and {high}, read before anything is written)"
            ),
            None => "known by its address only: an equal drive there is taken for it (serial; fieldbeat pin)"
                .to_owned(),
        }
    }

    /// Which blocks go with a request.
    fn describe_exchange(&self, every: Ns) -> Option<String> {
        let mapping = Mapping::new(self).ok()?;
        let all = "writes and reads all parameters";
        Some(match (self.via, mapping.turns()) {
            (Via::Menu0 { first }, _) => format!(
                "one request every {every} {all}, in a row in menu 0 from Pr 00.{first:03} (the master sets \
                 Pr 22.{first:03} and those after it)"
            ),
            (Via::Direct, 1) => format!("one request every {every} {all}"),
            (Via::Direct, turns) => format!(
                "one request every {every} writes what changed and reads a part: {}, all parameters within \
                 {}",
                match mapping.hot() {
                    1 => "status and speed in two of three".to_owned(),
                    hot => format!("status and speed within {}", count(hot + 1, "request")),
                },
                count(turns, "request"),
            ),
        })
    }

    /// The cost of one lost frame. A host repeats it after [`REPEATED_NS`], after the doubled time if it is lost again.
    pub(super) fn describe_loss(&self, every_ns: u64) -> String {
        let repeated = Ns(REPEATED_NS);
        let within_ns = self.reply_within_ns;
        if within_ns >= REPEATED_BY_NS {
            return format!(
                "one lost frame delays an exchange by {repeated}, since TCP repeats it no sooner, and the \
                 link stays up: a stop request that waits for it leaves {} later at most; a frame lost twice \
                 costs the link",
                Ns(REPEATED_BY_NS + every_ns)
            );
        }
        // The connection is given up after twice the time; else the requests of the meantime are misses.
        let misses = 1 + (REPEATED_BY_NS - within_ns) / every_ns.max(1);
        let is_lost = 2 * within_ns < REPEATED_BY_NS || misses >= u64::from(self.axis.health.bucket);
        let costs = if is_lost { "the link".to_owned() } else { count(misses as usize, "exchange") };
        let remedy = match self.watchdog.timeout_ns {
            Some(timeout_ns) if timeout_ns < REPEATED_BY_NS + 2 * every_ns => format!(
                "; reply_within from {} on would wait for it, with a watchdog.timeout from {} on",
                Ns(REPEATED_BY_NS),
                Ns(REPEATED_BY_NS + 2 * every_ns)
            ),
            _ => format!("; reply_within from {} on would wait for it", Ns(REPEATED_BY_NS)),
        };
        format!("one lost frame costs {costs}: TCP repeats it after {repeated} at the earliest{remedy}")
    }

    fn describe_death(&self) -> String {
        let done =
            if self.set_up { "set by the master before it is enabled" } else { "which must be set to it" };
        let timeout = format!("Pr {}.15.009, {done}", self.slot);
        let how = match self.watchdog {
            Watchdog { timeout_ns: Some(_), keypad: true, .. } => {
                format!("{timeout}, and the keypad watchdog")
            }
            Watchdog { timeout_ns: Some(_), .. } => timeout,
            _ => "the keypad watchdog".to_owned(),
        };
        match self.watchdog.within_ns() {
            Some(within) => format!("the drive trips within {} and its motor coasts ({how})", Ns(within)),
            None => unwatched(self.watchdog.accept_none).to_owned(),
        }
    }
}

fn count(number: usize, what: &str) -> String {
    format!("{number} {what}{}", if number == 1 { "" } else { "s" })
}
