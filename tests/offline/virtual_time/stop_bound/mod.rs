//! The bound of every stop: seeded faults of every kind, in machines of every shape, in every kind of motion.
//!
//! From the cycle of its cause to the cycle whose send carries the last stop request that it has to cause; and what
//! goes out to each drive from its latch until it is enabled again. All of it is looked at on the wire, at the master's
//! end.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the kinds of faults, their bounds, and the count of what came of them |
//! | `machine` | a machine of any shape, brought into motion, given a fault, and brought back |
//! | `moons` | drives with their own clock, and edges |
//! | `lenze` | drives in turn on one wire |
//! | `watch` | the requests to one drive |

mod lenze;
mod machine;
mod moons;
mod watch;

use std::collections::BTreeMap;
use std::ops::AddAssign;

use fieldbeat::axis::{AxisPlan, StopCause};

use self::machine::Machine;
use super::campaign::{self, Judged};

/// What happens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Fault {
    // To the link of one drive.
    Unplugged,
    Muted,
    Dropping,
    WrongPort,
    Late,
    // To one drive, which says so.
    FoundRunning,
    DriveError,
    PowerCut,
    Restarted,
    // To one stream.
    Starved,
    BadRow,
    // To the whole machine.
    SlowTask,
    PanickingTask,
    HeldUp,
    Shutdown,
}

use Fault::*;

const LINK: [Fault; 5] = [Unplugged, Muted, Dropping, WrongPort, Late];
const DRIVE: [Fault; 3] = [DriveError, PowerCut, Restarted];
const STREAM: [Fault; 2] = [Starved, BadRow];
const MACHINE: [Fault; 2] = [SlowTask, HeldUp];
const KINDS: usize = Shutdown as usize + 1;

impl Fault {
    fn cause(self) -> StopCause {
        match self {
            Unplugged | Muted | Dropping | WrongPort | Late => StopCause::LinkLost,
            FoundRunning => StopCause::FoundRunning,
            DriveError => StopCause::DriveFault,
            PowerCut | Restarted => StopCause::DriveDropped,
            Starved => StopCause::Underrun,
            BadRow => StopCause::Limit,
            SlowTask | PanickingTask => StopCause::Task,
            HeldUp => StopCause::Overrun,
            Shutdown => StopCause::Shutdown,
        }
    }

    /// The most cycles from the cause to the stop request: of the axis that it befell, or of another one of its group.
    fn bound(self, own: bool, axis: &AxisPlan, faulty: &AxisPlan, stated: u64) -> u64 {
        let next_own_slot = u64::from(axis.divisor);
        match self {
            // From the last good exchange, as `check` states it.
            Unplugged | Muted | Dropping | WrongPort | Late => stated,
            // From the exchange that reports it, and the next one, which proves that it was no older report.
            DriveError | PowerCut | Restarted => u64::from(faulty.divisor) + next_own_slot,
            // From the exchange that reports it, from the task's run, from the last slot passed over.
            FoundRunning | SlowTask | PanickingTask | HeldUp | Shutdown => next_own_slot,
            // From the cycle that looks for the row of the next slot. That slot has the stop in the row's place, and
            // the group goes with the same send.
            Starved | BadRow if own => 1,
            Starved | BadRow => next_own_slot,
        }
    }
}

/// What came of the faults of one kind.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    faults: u64,
    /// Drives that had to get a stop.
    stops: u64,
    /// The longest way from the cause to the wire, cycles.
    longest: u64,
    /// Stops that would have broken their bound one cycle later.
    just_in_time: u64,
}

impl Tally {
    fn note(&mut self, cycles: u64, bound: u64) {
        self.stops += 1;
        self.longest = self.longest.max(cycles);
        self.just_in_time += u64::from(cycles == bound);
    }

    fn add(&mut self, other: Tally) {
        self.faults += other.faults;
        self.stops += other.stops;
        self.longest = self.longest.max(other.longest);
        self.just_in_time += other.just_in_time;
    }
}

#[derive(Debug, Default)]
struct Table(BTreeMap<Fault, Tally>);

impl AddAssign for Table {
    fn add_assign(&mut self, other: Table) {
        for (fault, tally) in other.0 {
            self.0.entry(fault).or_default().add(tally);
        }
    }
}

/// A hundred faults in the machine of a seed, which panics at the first that breaks its bound.
fn of_seed(seed: u64) -> Judged<Table> {
    let mut machine = Machine::new(seed);
    machine.run(100);
    (machine.into_table(), Ok(()))
}

/// No bound was broken, or there would be no table; and each was met, so that it would have been by a stop one cycle
/// late.
fn assert_proved(Table(table): &Table, least: u64) {
    println!("{:14} {:>8} {:>8} {:>8} {:>13}", "fault", "faults", "stops", "longest", "just in time");
    for (fault, Tally { faults, stops, longest, just_in_time }) in table {
        println!("{:14} {faults:8} {stops:8} {longest:8} {just_in_time:13}", format!("{fault:?}"));
    }
    let faults: u64 = table.values().map(|tally| tally.faults).sum();
    assert!(faults >= least, "{faults} faults");
    assert_eq!(table.len(), KINDS, "{:?}", table.keys());
    for (fault, tally) in table {
        assert!(tally.just_in_time > 0, "{fault:?}: no stop came as late as its bound, so that is no bound");
    }
}

#[test]
fn ten_thousand_faults_and_no_stop_is_late() {
    let table = campaign::fixed("faults", 100, of_seed);
    if campaign::only().is_none() {
        assert_proved(&table, 10_000);
    }
}

#[test]
#[ignore = "new seeds: minutes, in a release build"]
fn faults_of_new_seeds_and_no_stop_is_late() {
    let table = campaign::long("faults", of_seed);
    if campaign::only().is_none() {
        assert_proved(&table, 1);
    }
}
