//! The plan of a bus as a [`BusPlan`].

use std::net::SocketAddrV4;
use std::sync::Arc;

use super::bus::ProfibusBus;
use super::counters::OWN;
use super::notation::Codes;
use super::plan::{LenzeDrive, ProfibusPlan};
use super::profile;
use crate::axis::acyclic::Notation;
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::axis::{AxisPlan, FoundRunning, MonitorChannel, PlanFault};
use crate::bus::desired::Capabilities;
use crate::bus::{Bus, BusPlan, OpenError, OwnCounter, drives};
use crate::net::Carriers;

/// The bytes of a telegram around its data, and those of a token.
const AROUND: usize = 9;
const TOKEN: usize = 3;

impl ProfibusPlan {
    /// The longest turn of drive `index`, ns: its request with all repetitions, none of which is answered in time.
    pub fn longest_turn_ns(&self, index: usize) -> u64 {
        let Some((outputs, inputs)) = self.drives.get(index).and_then(LenzeDrive::lengths) else { return 0 };
        let line = self.line();
        let once = line.span_ns(outputs + AROUND)
            + self.slot_ns()
            + line.span_ns(inputs + AROUND)
            + line.bits_ns(self.bits.idle.max(self.bits.sync).into());
        once.saturating_mul(1 + u64::from(self.retries))
    }

    /// The turn of drive `index` if it is answered at once, ns.
    pub fn usual_turn_ns(&self, index: usize) -> u64 {
        let Some((outputs, inputs)) = self.drives.get(index).and_then(LenzeDrive::lengths) else { return 0 };
        let line = self.line();
        let bits = self.bits.max_tsdr.saturating_add(self.bits.idle.max(self.bits.sync));
        line.span_ns(outputs + inputs + 2 * AROUND) + line.bits_ns(bits.into())
    }

    /// All turns of a round, each of them the longest, and what the master sends besides.
    fn longest_round_ns(&self) -> u64 {
        let turns: u64 = (0..self.drives.len()).map(|index| self.longest_turn_ns(index)).sum();
        let own = self.line().span_ns(TOKEN + AROUND + 4 + 6) + 2 * self.slot_ns();
        turns.saturating_add(own)
    }
}

impl BusPlan for ProfibusPlan {
    fn name(&self) -> &str {
        &self.name
    }

    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn axes(&self) -> Vec<&AxisPlan> {
        self.drives.iter().map(|drive| &drive.axis).collect()
    }

    fn faults(&self, period_ns: u64) -> Vec<(usize, PlanFault)> {
        let same: fn(&LenzeDrive, &LenzeDrive) -> bool = |one, other| one.address == other.address;
        let taken = "is taken by another drive; one drive per address";
        drives::faults(&self.drives, period_ns, |drive| &drive.axis, |_, _| Vec::new(), same, taken)
    }

    fn turn_within_ns(&self, _index: usize) -> Option<u64> {
        Some(self.longest_round_ns())
    }

    fn before_stop(&self, _index: usize) -> u32 {
        // A telegram that is repeated stays what it is, and what is new in it would be ignored.
        1
    }

    fn describe(&self, _period_ns: u64) -> Vec<String> {
        let one = |drive: &LenzeDrive| format!("{} address {}", self.device, drive.address);
        self.drives.iter().map(one).collect()
    }

    fn drive_watchdog_ns(&self, index: usize) -> Option<u64> {
        self.drives.get(index)?.watchdog_ns()
    }

    fn open(&self, _period_ns: u64, carriers: &dyn Carriers) -> Result<Box<dyn Bus>, OpenError> {
        Ok(Box::new(ProfibusBus::open(self, carriers)?))
    }

    fn monitored(&self, index: usize) -> [Option<MonitorChannel>; MONITOR_CHANNELS] {
        self.drives.get(index).map_or([const { None }; MONITOR_CHANNELS], LenzeDrive::shown)
    }

    fn own_counters(&self) -> &'static [OwnCounter] {
        &OWN
    }

    fn capabilities(&self, index: usize, _period_ns: u64) -> Capabilities {
        profile::capabilities(&self.drives[index])
    }

    fn notation(&self) -> Arc<dyn Notation> {
        Arc::new(Codes)
    }

    /// The other drives are not parametrised: each needs its master.
    fn reaching(&self, index: usize) -> Option<Box<dyn BusPlan>> {
        let mut drive = self.drives.get(index)?.clone();
        drive.axis.on_found_running = FoundRunning::Refuse;
        drive.show = [const { None }; MONITOR_CHANNELS];
        Some(Box::new(ProfibusPlan { drives: vec![drive], ..self.clone() }))
    }

    fn addresses(&self) -> Vec<SocketAddrV4> {
        Vec::new()
    }
}
