//! What an accepted packet reports, in user units.

use super::{Open, Sends, Station};
use crate::plan::MoonsDrive;
use crate::profile::Seen;
use crate::wire::assembly::{Inputs, Version, status};
use crate::wire::io::Packet;
use fieldbeat_core::axis::State;
use fieldbeat_core::axis::units::Unwrap;
use fieldbeat_core::bus::Slot;
use fieldbeat_core::bus::desired::{Motion, Power};
use fieldbeat_core::time::Time;

/// The turns of a rotary axis since the connection was opened.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Turns {
    demand: Unwrap,
    encoder: Unwrap,
}

/// The additional values of a drive, in its own integers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Shown([u32; 4]);

impl Shown {
    #[inline]
    fn of(inputs: &Inputs) -> Shown {
        let error = inputs.position_error.unwrap_or_default();
        Shown([inputs.voltage, inputs.temperature as u32, inputs.main_inputs, error as u32])
    }
}

/// The number of packets after which additional values are reported although they have not changed.
const SHOWN_EVERY: u32 = 16;

impl Station {
    /// The values of an accepted packet. Its inputs are only read here, so that none is decoded that is not needed.
    #[inline(always)]
    pub(super) fn report(&mut self, at: Time, packet: &Packet<'_>, inputs: &Inputs, slot: &mut Slot) {
        let Some(Open { version, rate, most_steps, .. }) = self.open else { return };
        let sto_open = self.has_sto_open(inputs.main_inputs);
        // Only a rotary axis wraps around; on any other one a wrong value must not shift all later ones.
        let wraps = self.units.modulo.is_some();
        let unwrap = |track: &mut Unwrap, count: i32| if wraps { track.next(count) } else { count.into() };
        let demand = unwrap(&mut self.turns.demand, inputs.absolute);
        let encoder = self.has_encoder().then(|| {
            let count = unwrap(&mut self.turns.encoder, inputs.encoder);
            count as f64 * self.steps_per_encoder_count
        });
        let before = std::mem::replace(
            &mut self.seen,
            Seen { any: true, status: inputs.status, alarm: inputs.alarm, demand, sto_open },
        );
        let same = (before.status, before.alarm, before.sto_open) == (inputs.status, inputs.alarm, sto_open);
        if !same || slot.anew || !self.profile.is_settled() {
            self.prove(slot);
            if self.profile.take_rehomed() {
                // The position was set: that was no motion, and the encoder is where the steps are.
                self.shift = demand as f64 - encoder.unwrap_or_default();
                self.has_last = false;
            }
        }
        let demand_steps = demand as f64;
        let actual = encoder.map_or(demand_steps, |steps| steps + self.shift);
        let Slot { status: report, notices, evidence, .. } = slot;
        // By the drive's clock: its packets count its intervals, however they travel. What no motor makes is another
        // origin: the position was set.
        if self.has_last
            && let intervals = packet.sequence.wrapping_sub(self.last)
            && let moved = (demand - before.demand) as f64
            && moved.abs() <= most_steps * (f64::from(intervals) + 1.0)
        {
            let rate = match intervals {
                0 | 1 => rate,
                _ => rate / f64::from(intervals),
            };
            evidence.demand_velocity = self.units.distance(moved * rate);
            report.velocity = match encoder {
                None => evidence.demand_velocity,
                Some(_) if inputs.velocity != 0 => f64::from(inputs.velocity) * self.velocity_per_count,
                Some(_) => self.units.distance((actual - self.actual) * rate),
            };
        } else {
            (evidence.demand_velocity, report.velocity) =
                (0.0, f64::from(inputs.velocity) * self.velocity_per_count);
        }
        (self.last, self.has_last, self.actual) = (packet.sequence, true, actual);
        let place = |steps: f64| self.units.distance(steps) + self.units.offset;
        evidence.demand = place(demand_steps);
        evidence.position = if encoder.is_some() { place(actual) } else { evidence.demand };
        report.at = at;
        report.position = self.units.folded(evidence.position);
        report.demand = self.units.folded(evidence.demand);
        let current = f64::from(inputs.current);
        report.current = if version == Version::V1 { current * 1e-2 } else { current * 1e-3 };
        let shown = Shown::of(inputs);
        if shown != self.shown || packet.sequence.is_multiple_of(SHOWN_EVERY) {
            self.shown = shown;
            report.monitor = MoonsDrive::monitor(inputs);
            notices.monitor_fresh = true;
        }
        notices.fresh = true;
    }

    /// Takes the reported states of a packet, and their evidence.
    #[inline(never)]
    fn prove(&mut self, slot: &mut Slot) {
        let Slot { status: report, notices, evidence, .. } = slot;
        let Seen { status: word, alarm, .. } = self.seen;
        let starts = word & status::INITIALIZING != 0;
        if starts && report.state != State::NotReadyToSwitchOn && report.state != State::Unknown {
            notices.restarted = true;
            self.profile.drive_restarted();
        }
        let owned = self.open.is_some_and(|open| open.outputs == Sends::Owned);
        self.profile.take(&self.seen, evidence);
        evidence.outputs_count = owned;
        let (power, motion) = self.profile.commanded();
        report.state = drive_state(&self.seen, power, motion);
        report.homed = self.profile.is_homed();
        report.moving = self.seen.moves();
        // A drive without an encoder is where it stands.
        report.in_target = !self.seen.moves() && (!self.has_encoder() || word & status::IN_POSITION != 0);
        report.sto_open = self.seen.sto_open;
        report.suspect = false;
        let fault = word & status::FAULT != 0;
        // A fault has a code: that of a drive without an alarm in its word is the status bit.
        report.fault = if fault { alarm.max(u32::from(alarm == 0)) } else { 0 };
        report.warning = if fault { 0 } else { alarm };
    }

    fn has_encoder(&self) -> bool {
        self.steps_per_encoder_count != 0.0
    }

    /// The hardware enable is missing, where one is wired. A closed input is 0.
    fn has_sto_open(&self, main_inputs: u32) -> bool {
        self.enable_input.is_some_and(|input| {
            let bit = input.number.saturating_sub(1).min(31);
            let open = main_inputs >> bit & 1 != 0;
            open == input.closed
        })
    }
}

/// Maps the drive's status onto the states of CiA 402.
fn drive_state(seen: &Seen, power: Power, motion: Motion) -> State {
    let has = |bits: u16| seen.status & bits != 0;
    match () {
        () if has(status::INITIALIZING) => State::NotReadyToSwitchOn,
        () if has(status::FAULT) && seen.is_enabled() => State::FaultReactionActive,
        () if has(status::FAULT) => State::Fault,
        () if seen.is_enabled() && power == Power::QuickStop && motion != Motion::Halt => {
            State::QuickStopActive
        }
        () if seen.is_enabled() => State::OperationEnabled,
        () if seen.sto_open => State::SwitchOnDisabled,
        () => State::ReadyToSwitchOn,
    }
}
