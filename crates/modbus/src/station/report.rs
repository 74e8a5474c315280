//! The values of a reply: what they confirm of what was written, who else writes, and the drive's report.

use super::turns::{Cyclic, Read};
use super::{Connection, Station};
use crate::counters::Own;
use crate::echo::Shown;
use crate::mapping::{Places, Role};
use crate::native::publish;
use crate::words::{ControlWord, StatusWord};
use fieldbeat_core::bus::Slot;
use fieldbeat_core::time::{S, Time};

/// A missing hardware enable is reported for so long, ns, after the drive was last commanded to run: only the next
/// such command shows whether it is back.
const DARK_NS: u64 = S;

impl Station {
    /// All of the drive's values were read: they are those that the open request wrote, and the drive reports the
    /// status of before.
    #[inline]
    pub(super) fn is_repeated(&self, cyclic: &Cyclic, read: Read, slot: &Slot) -> bool {
        let Connection { image, inputs, written, .. } = &self.conn;
        let [control, reference, status] = image.front();
        !slot.anew
            && cyclic.is_both()
            && read.places().have(Places::FRONT)
            && self.profile.is_revision(self.conn.proved)
            && inputs.have_control(*written)
            && (control as u16, reference) == (written.control.0, written.reference)
            && status as u16 == inputs.status.0
    }

    /// Such a reply: only the reference and what turns are new.
    #[inline]
    pub(super) fn repeat(&mut self, at: Time, slot: &mut Slot) {
        self.conn.inputs.reference.reads_back(self.conn.written.reference);
        publish(&mut self.native, at, &self.conn.image);
        self.turns(at, slot);
    }

    /// The values of this block are in the image.
    #[inline(never)]
    pub(super) fn cyclic_read(&mut self, at: Time, cyclic: Cyclic, read: Read, slot: &mut Slot) {
        let conn = &mut self.conn;
        (conn.refused.1, conn.busy) = (0, 0);
        if cyclic.write.is_some() {
            conn.refused.0 = 0;
        }
        let control_before = conn.inputs.control();
        let (wrote_control, wrote_reference) = cyclic.writes();
        if wrote_control {
            conn.inputs.control.replied(i32::from(conn.written.control.0));
        }
        if wrote_reference {
            conn.inputs.reference.replied(conn.written.reference);
        }
        let places = read.places();
        let (control, reference) = (places.has(Role::Control), places.has(Role::Reference));
        let (status, with_trip) = (places.has(Role::Status), places.has(Role::Trip));
        publish(&mut self.native, at, &self.conn.image);
        if control || reference {
            // What this exchange has not written itself shows who did.
            let unwritten = control && !wrote_control || reference && !wrote_reference;
            self.compare(at, control, reference, unwritten, slot);
        }
        self.note_taken(at, control_before);
        let conn = &mut self.conn;
        conn.seen = conn.seen.with(places, Places::REPORT);
        conn.trip_read |= with_trip;
        let is_same = conn.image.of(Role::Status).map(|raw| raw as u16) == Some(conn.inputs.status.0);
        let steady =
            (is_same || !status) && !slot.anew && self.profile.proves_again(conn.proved, &conn.inputs);
        if status && steady {
            // It is healthy still: a number that was read is that of an earlier trip.
            conn.trip_read = false;
        } else if status {
            conn.proved = None;
            self.take_status(at, with_trip);
        }
        if self.conn.seen == Places::REPORT && !self.conn.other.is_in_doubt() {
            self.conn.seen = Places::default();
            if steady {
                return self.turns(at, slot);
            }
            self.report(at, slot);
            let word = self.conn.inputs.status;
            let waits = !word.active() && (self.profile.runs() || self.conn.dark_at.is_some());
            // Time changes nothing of it.
            let is_steady = word.healthy() && !waits && self.conn.refused == (0, 0);
            self.conn.proved = self.profile.proved().filter(|_| is_steady);
        }
    }

    /// Compares read-back values with the written ones.
    #[inline(always)]
    fn compare(&mut self, at: Time, control: bool, reference: bool, unwritten: bool, slot: &mut Slot) {
        let word = self.conn.image.of(Role::Control).filter(|_| control).map(|count| i32::from(count as u16));
        let speed = self.conn.image.of(Role::Reference).filter(|_| reference);
        let control = word.map(|word| self.conn.inputs.control.read(word));
        let reference = speed.map(|speed| self.conn.inputs.reference.read(speed));
        let shown = [control, reference];
        if shown.contains(&Some(Shown::Refused)) {
            Own::NotTaken.count(&mut slot.counters);
            self.profile.not_taken();
        }
        if unwritten || shown.contains(&Some(Shown::Changed)) {
            self.look_for_others(at, shown, [word, speed], slot);
        }
    }

    /// Whether somebody else has written the values that an exchange has shown.
    #[inline(never)]
    fn look_for_others(
        &mut self,
        at: Time,
        shown: [Option<Shown>; 2],
        values: [Option<i32>; 2],
        slot: &mut Slot,
    ) {
        let [control, reference] = shown.map(|shown| shown == Some(Shown::Changed));
        let [same_control, same_reference] = shown.map(|shown| shown == Some(Shown::Same));
        let proved = if self.profile.writes() {
            self.conn.other.same(same_control, same_reference);
            (control || reference) && self.conn.other.changed(at, control, reference)
        } else {
            self.conn.other.read(at, values)
        };
        slot.notices.other_master |= proved;
    }

    /// The control word that the drive has accepted was this one before.
    #[inline]
    pub(super) fn note_taken(&mut self, at: Time, before: Option<ControlWord>) {
        let control = self.conn.inputs.control();
        if control.is_some() && control != before {
            self.control_taken = control;
            self.conn.control_since = at;
        }
    }

    /// A new status; `named`: the number of a trip came with it.
    #[inline(always)]
    fn take_status(&mut self, at: Time, named: bool) {
        let Some(status) = self.conn.image.of(Role::Status).map(|raw| StatusWord(raw as u16)) else { return };
        // It has accepted the command to run; its earlier state is no answer to that.
        let running = self.profile.runs() && self.conn.inputs.runs();
        let was_active = running && (self.conn.was_active || status.active());
        let off = status.healthy() && !status.active();
        let dark = running
            && off
            && (was_active || self.profile.should_be_active(at, &self.conn.inputs, self.conn.control_since));
        if self.conn.other.doubts(off && self.profile.runs(), dark) {
            return;
        }
        self.profile.status_read();
        let Connection { inputs, tripped_at, trip_read, image, .. } = &mut self.conn;
        (inputs.seen, inputs.status) = (true, status);
        if status.healthy() {
            // The present name is that of the last trip.
            (inputs.trip, *tripped_at, *trip_read) = (0, None, false);
        } else {
            // A number that was read before this trip is that of another one.
            *trip_read &= named || tripped_at.is_some();
            tripped_at.get_or_insert(at);
            inputs.trip = image.of(Role::Trip).filter(|_| *trip_read).unwrap_or(0) as u16;
        }
        inputs.named = *trip_read || !self.reports_trips;
        inputs.dark = dark;
        self.conn.was_active = was_active;
        if dark {
            self.conn.dark_at = Some(at);
        }
    }

    /// The drive's report, in user units: a status and a speed that were both read since the last report.
    #[inline(never)]
    fn report(&mut self, at: Time, slot: &mut Slot) {
        self.turns(at, slot);
        let status = self.conn.inputs.status;
        let was_dark = self.conn.dark_at.is_some_and(|dark_at| at.since(dark_at) < DARK_NS);
        self.profile.prove(&self.conn.inputs, self.conn.tripped_at, &mut slot.evidence);
        let report = &mut slot.status;
        report.suspect = false;
        report.sto_open = was_dark && !status.active();
        report.state = self.profile.state(status, report.sto_open);
        report.moving = status.active() && !status.zero_speed();
        report.in_target = status.at_speed();
        (report.position, report.demand, report.current) = (f64::NAN, f64::NAN, f64::NAN);
        report.warning = u32::from(status.0 & StatusWord::WARNINGS);
        report.fault = if status.healthy() { 0 } else { u32::from(self.conn.inputs.trip) };
    }

    /// Takes the values that are new in each report: the speed, and the shown values.
    #[inline]
    fn turns(&mut self, at: Time, slot: &mut Slot) {
        let velocity = f64::from(self.conn.image.of(Role::Speed).unwrap_or(0)) * self.velocity_per_count;
        let Slot { status: report, notices, .. } = slot;
        notices.fresh = true;
        (report.at, report.velocity) = (at, velocity);
        notices.monitor_fresh |= !self.shown.is_empty();
        for &(channel, counts) in &self.shown {
            let count = self.conn.image.get(Role::FIRST_SHOWN + channel);
            report.monitor[channel] = count.map(|count| f64::from(count) / counts);
        }
    }
}
