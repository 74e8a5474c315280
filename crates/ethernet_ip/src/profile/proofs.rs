//! What a packet of the drive proves: effects of the command that is held, the end of what runs, and what has to be
//! repeated.

use super::{BUSY, BUSY_NOW, Holder, Profile, Rules, Seen, State, Step, UNSETTLED};
use crate::plan::HomingMethod;
use crate::wire::assembly::{command, status};
use fieldbeat_core::bus::desired::{
    Evidence, FaultIs, Homing as HomingIs, Motion, Power, Reference, Resettable,
};

impl Profile {
    /// Takes the evidence of a packet of the drive.
    #[doc(hidden)]
    pub fn take(&mut self, seen: &Seen, evidence: &mut Evidence) {
        let Profile { state, rules, settled, .. } = self;
        let is_settled = *settled == state.revision() && !state.left().is_unsettled_by(seen);
        if !is_settled {
            state.change(|state| state.take(seen, rules));
        }
        state.left().prove(seen, evidence);
        *settled = if state.left().is_settled() { state.revision() } else { UNSETTLED };
    }
}

impl State {
    fn take(&mut self, seen: &Seen, rules: &Rules) {
        self.edges.answered();
        self.see(seen, rules);
        self.repeat(seen);
    }

    /// Although nothing was under way, this packet changes something.
    fn is_unsettled_by(&self, seen: &Seen) -> bool {
        let stopped = !seen.moves() && (self.jog.is_some() || self.ramp.is_some());
        stopped || self.is_to_repeat(seen) != (false, false)
    }

    fn prove(&self, seen: &Seen, evidence: &mut Evidence) {
        let since = |settled: bool, serial: u64| if settled { serial } else { serial.saturating_sub(1) };
        let power_has = match self.power_step {
            Step::Held => self.edges.is_delivered(),
            Step::Due => false,
            _ => true,
        };
        // One that waits for a busy drive is known to the drive machine by that.
        let waits =
            self.power_step == Step::Due && self.power.value == Power::EnableOperation && seen.has(BUSY);
        let accepted = &mut evidence.accepted;
        accepted.power = accepted.power.max(since(power_has || waits, self.power.serial));
        accepted.motion = accepted.motion.max(since(self.is_taken, self.motion.serial));
        evidence.refused = self.refused;
        evidence.homing = self.homing;
        evidence.reference = Some(if self.homed { Reference::Set } else { Reference::Silent });
        evidence.outputs_count = true;
        evidence.stays_on = seen.is_enabled();
        evidence.ready = !seen.has(BUSY);
        evidence.obstacle = seen.has(BUSY).then_some(BUSY_NOW);
        let active = seen.has(status::FAULT);
        evidence.fault = FaultIs { active, named: true, resettable: Resettable::Now };
    }

    /// Nothing is under way, and nothing is to be sent but idle.
    fn is_settled(&self) -> bool {
        self.edges.is_settled()
            && self.power_step == Step::Settled
            && matches!(self.motion_step, Step::Settled)
            && !matches!(self.motion.value, Motion::Native(_))
            && self.is_taken
    }

    /// Effects of the held command, and of one that runs.
    fn see(&mut self, seen: &Seen, rules: &Rules) {
        let delivered = self.edges.is_delivered();
        let effect = match (self.holder, self.power.value, self.motion.value) {
            (Holder::Power, Power::EnableOperation, _) => seen.is_enabled(),
            (Holder::Power, Power::FaultReset, _) => delivered && !seen.has(status::FAULT | status::ALARM),
            (Holder::Power, Power::QuickStop, _) => self.stands(seen, delivered),
            (Holder::Power, ..) => {
                let off = delivered && !seen.is_enabled();
                self.may_come_on &= !off;
                off
            }
            (Holder::Clearing, ..) => self.stands(seen, delivered),
            (Holder::Motion, _, _) if matches!(self.motion_step, Step::Zeroing { .. }) => {
                delivered && seen.demand as i32 == 0
            }
            (Holder::Motion, _, Motion::Ramp { .. } | Motion::Halt) => self.stands(seen, delivered),
            (Holder::Motion, _, Motion::Move { position, .. }) => {
                let target = i64::from(rules.position(position, seen.demand));
                seen.has(status::MOVING) || delivered && i64::from(seen.demand as i32) == target
            }
            (Holder::Motion, _, Motion::Velocity { .. }) if self.outputs.command == command::JOG => {
                seen.jogs()
            }
            // One that has ended meanwhile takes no other speed.
            (Holder::Motion, _, Motion::Velocity { .. }) => delivered && seen.jogs(),
            (Holder::Motion, _, Motion::Home) => seen.has(status::HOMING),
            (Holder::Native, ..) => delivered,
            _ => false,
        };
        if effect {
            self.edges.see();
            if self.holder == Holder::Motion && self.motion_step == Step::Held {
                self.is_taken = true;
            }
        }
        let waits = matches!(self.holder, Holder::Nobody | Holder::Clearing);
        if waits && self.motion_step == Step::Clearing && !seen.moves() {
            self.is_taken = self.motion.value == Motion::Hold;
            self.motion_step = if self.is_taken { Step::Settled } else { Step::Due };
        }
        if self.motion_step == Step::Due && self.repeats > 0 && !self.may_repeat(seen, rules) {
            self.motion_step = self.not_taken();
        }
        if !seen.moves() && self.holder != Holder::Motion {
            (self.jog, self.ramp) = (None, None);
        }
        if self.motion_step == Step::Runs && !seen.moves() {
            self.home_ended(seen, rules);
        }
        if matches!(self.motion_step, Step::Zeroing { held: true }) && seen.demand as i32 == 0 {
            self.rehomed |= !std::mem::replace(&mut self.zeroed, true);
        }
    }

    /// It stands, after the stop was delivered, or has begun to brake.
    fn stands(&self, seen: &Seen, delivered: bool) -> bool {
        seen.has(status::STOPPING) || delivered && !seen.moves()
    }

    /// The drive's homing is over.
    fn home_ended(&mut self, seen: &Seen, rules: &Rules) {
        let failed = !seen.is_enabled() || seen.alarm & !self.alarms_before != 0;
        let seeks = rules.homing.as_ref().is_some_and(|homing| homing.method == HomingMethod::Seek);
        self.motion_step = match () {
            () if failed => {
                self.homing = HomingIs::Failed;
                Step::Settled
            }
            () if seeks => Step::Zeroing { held: false },
            () => {
                (self.homing, self.homed) = (HomingIs::Attained, true);
                Step::Settled
            }
        };
    }

    /// A stop, and power off, are repeated until they are seen: whatever set the drive in motion after that. Of the
    /// motion, and of the power.
    fn is_to_repeat(&self, seen: &Seen) -> (bool, bool) {
        let runs = seen.moves() && !seen.has(status::STOPPING);
        let stops = matches!(self.motion.value, Motion::Ramp { .. } | Motion::Halt);
        let off = match self.power.value {
            Power::Off | Power::Shutdown => seen.is_enabled(),
            Power::QuickStop => runs,
            _ => false,
        };
        let is_settled = self.power_step == Step::Settled && self.power.serial > 0;
        (stops && self.motion_step == Step::Settled && runs, is_settled && off)
    }

    fn repeat(&mut self, seen: &Seen) {
        let (motion, power) = self.is_to_repeat(seen);
        if motion {
            self.motion_step = Step::Due;
        }
        if power {
            self.power_step = Step::Due;
        }
    }
}
