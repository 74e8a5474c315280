//! A drive machine under watch, as the loop runs it.
//!
//! What it desires is the same when it is proposed again, no intent changes under its serial, what leaves is what was
//! proposed last, and what has ended stays ended.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::mem::{discriminant, replace};

use fieldbeat::axis::{Command, Failure};
use fieldbeat::bus::BusPlan;
use fieldbeat::time::Time;
use fieldbeat_core::bus::desired::{Desired, Intent, Motion, Power, Setpoint};
use fieldbeat_core::bus::{Grid, Slot};
use fieldbeat_core::drive::machine::Machine;

pub struct Commanded {
    machine: Machine,
    /// What was proposed last, and for which slot.
    proposed: Desired,
    grid: Time,
    /// What was desired when a request last left.
    gone: Desired,
    /// What each serial was used for.
    used: BTreeMap<u64, String>,
    end: Option<Result<(), Failure>>,
}

impl Commanded {
    /// The machine of drive `index`.
    pub fn new(plan: &dyn BusPlan, index: usize, period_ns: u64) -> Commanded {
        let facts = plan.facts(Grid { period_ns, deadline_ns: period_ns / 2 });
        Commanded {
            machine: Machine::new(plan.axes()[index], facts.drives[index].capabilities, period_ns),
            proposed: Desired::default(),
            grid: Time(0),
            gone: Desired::default(),
            used: BTreeMap::new(),
            end: None,
        }
    }

    /// A new command; `None`: to take the drive over as it is.
    pub fn start(&mut self, now: Time, command: Option<Command>) {
        self.machine.start(now, command);
        self.end = None;
        assert_eq!(self.machine.end(), None, "it works on the newest command");
    }

    pub fn velocity(&mut self, velocity: f64) {
        self.machine.input.level = velocity;
    }

    /// Writes what is desired with the send in slot `grid`.
    pub fn propose(&mut self, grid: Time, slot: &mut Slot) {
        let end = self.machine.end().is_some();
        self.machine.propose(grid, slot);
        self.check_proposal(slot);
        // A command that fails as it begins does so once.
        if self.machine.end().is_some() == end {
            let first = slot.desired;
            self.machine.propose(grid, slot);
            self.check_proposal(slot);
            assert!(is_same(&first, &slot.desired), "proposed again: {first:?}, {:?}", slot.desired);
        }
        self.grid = grid;
        self.check_end();
    }

    fn check_proposal(&mut self, slot: &Slot) {
        let Desired { power, mode, motion, .. } = slot.desired;
        let (gone, before) = (self.gone, self.proposed);
        self.check_intent(power, [gone.power, before.power]);
        self.check_intent(mode, [gone.mode, before.mode]);
        self.check_intent(motion, [gone.motion, before.motion]);
        self.proposed = slot.desired;
        assert_eq!(power.serial == 0, power.value == Power::Untouched, "{power:?}");
        assert!(power.serial != 0 || motion.serial == 0 && motion.value == Motion::Hold, "{motion:?}");
    }

    /// A serial is that of one intent, sent or not.
    fn check_intent<T: PartialEq + Debug>(&mut self, intent: Intent<T>, before: [Intent<T>; 2]) {
        if !before.contains(&intent) {
            let what = format!("{:?}", intent.value);
            let used = self.used.entry(intent.serial).or_insert_with(|| what.clone());
            assert_eq!(*used, what, "serial {} is used again", intent.serial);
        }
    }

    /// Takes over what has left.
    pub fn commit(&mut self, slot: &mut Slot) {
        let Some(grid) = slot.gone.grid.take() else { return };
        assert_eq!(grid, self.grid, "it is what was proposed last");
        self.machine.commit(grid);
        self.gone = self.proposed;
    }

    /// The reports of a cycle, which are cleared as the loop does.
    pub fn observe(&mut self, now: Time, slot: &mut Slot) {
        self.machine.observe(now, slot.notices.restarted, slot);
        (slot.notices.fresh, slot.notices.restarted) = (false, false);
        slot.notices.take_emergency();
        self.check_end();
    }

    fn check_end(&mut self) {
        let end = self.machine.end();
        if let Some(before) = replace(&mut self.end, end) {
            // A value in it may be no number, which equals nothing.
            let kind = |end: Result<(), Failure>| end.map_err(|failure| discriminant(&failure));
            assert_eq!(Some(kind(before)), end.map(kind), "what has ended has ended: {before:?}, {end:?}");
        }
    }
}

/// All is the same but the serials, which count on while nothing leaves.
fn is_same(a: &Desired, b: &Desired) -> bool {
    let row = |desired: &Desired| Setpoint { row: u64::from(desired.setpoint.row != 0), ..desired.setpoint };
    // A position that is not known is no number.
    let setpoints = row(a) == row(b) || format!("{:?}", row(a)) == format!("{:?}", row(b));
    setpoints
        && (a.power.value, a.mode.value, a.motion.value) == (b.power.value, b.mode.value, b.motion.value)
}
