//! The request of the next send: its choice, its bytes, and what changes once they are sent.

use super::turns::{Cyclic, Read, Write};
use super::{End, RequestKind, Station};
use crate::counters::Own;
use crate::mapping::{Places, Role};
use crate::plan::REFERENCES_IN_A_ROW;
use crate::wire::{HEADER, Header, RegistersBuffer};
use fieldbeat_core::bus::{Cycle, Exchange, Slot};
use fieldbeat_core::time::Time;

impl Station {
    /// Builds the request of the next send. Built again for the same send, it is the same: state that changes with
    /// every request changes in [`sent`](Self::sent).
    pub fn prepare(&mut self, cycle: &Cycle, slot: &mut Slot) {
        if matches!(slot.exchange, Exchange::Missed) {
            self.look_for_silence();
        }
        let native = &mut self.native;
        let is_desired = self.profile.encode(&slot.desired, &self.conn.inputs, native);
        let profile = &self.profile;
        let (calls, commanded) =
            self.calls.advance(cycle.grid, slot.link, || profile.is_on(), self.since_call, slot.guarded);
        if std::mem::replace(&mut slot.commanded, commanded) && !commanded {
            self.doubt_settings();
        }
        // Whether the last one is answered by then is known at the send.
        self.conn.length = 0;
        if !self.connected || !self.rest().is_empty() {
            return;
        }
        self.grid = cycle.grid;
        // A drive that does not follow the control word, and cannot be configured to, is only read. So is one that was
        // found restarted, until the loop has seen that: what is desired is what it was commanded before.
        let is_written = is_desired && (self.conn.obeys || self.conn.settable) && !slot.notices.restarted;
        let sets = self.end != End::NotYet || self.conn.unset > 0;
        if !self.conn.is_only || !is_written || calls || sets || self.conn.other.is_check_due() {
            let stands = slot.desired.setpoint.velocity == 0.0;
            return self.prepare_next(is_written, calls, sets, stands);
        }
        // There is nothing to choose: only the id and the values are new.
        let (outputs, out) = (self.profile.outputs(), &mut self.room);
        self.conn.length = Cyclic::refill(self.identity.next(), outputs, out).into();
        self.profile.carries(true, true);
    }

    /// Chooses and builds the next request: a setting, a call, or one of the cycle.
    #[inline]
    fn prepare_next(&mut self, is_written: bool, calls: bool, sets: bool, stands: bool) {
        let header = Header { transaction: self.identity.next(), unit: self.conn.unit };
        let setting = if sets { self.next_setting() } else { None };
        let changes = is_written && !self.conn.inputs.have_control(self.profile.outputs());
        let goes_first = || changes || is_written && self.profile.is_new();
        self.conn.prepared = match setting {
            Some(setting) => setting,
            None if calls && !goes_first() => RequestKind::Call,
            None => RequestKind::Cyclic(self.choose(is_written, changes, stands)),
        };
        self.conn.is_only = false;
        if let RequestKind::Cyclic(cyclic) = &self.conn.prepared {
            self.conn.is_only = self.turns.is_only(cyclic);
            self.conn.length = cyclic.emit(header, self.profile.outputs(), &mut self.room).into();
            if cyclic.write.is_some() {
                let (control, reference) = cyclic.writes();
                return self.profile.carries(control, reference);
            }
        } else {
            self.conn.length = self.emit_other(header) as u16;
        }
        self.profile.carries_nothing();
    }

    /// A missed request by FC23 may be one that the drive ignores. The next one goes out behind it.
    #[cold]
    fn look_for_silence(&mut self) {
        if self.reads_and_writes() && self.rest().is_empty() && self.functions.ignored() {
            self.conn.is_only = false;
            self.identity.give_up();
            self.pace.unanswered();
        }
    }

    /// The application may have changed what the drive follows: it is set up again before it is enabled or stopped.
    fn doubt_settings(&mut self) {
        if self.conn.settable {
            self.conn.unset = self.settings.len() as u8;
            (self.conn.obeys, self.conn.watched) = (false, false);
            self.tell_set_up();
        }
    }

    /// The setting to write now, if there is one.
    #[inline(never)]
    fn next_setting(&self) -> Option<RequestKind> {
        if self.end == End::Disarming {
            return self.time_out().map(|index| RequestKind::Set { index: index as u8, value: 0 });
        }
        let index = self.settings.len().checked_sub(self.conn.unset.into())?;
        let setting = self.settings.get(index);
        let setting = setting.filter(|_| self.profile.wants_set_up(&self.conn.inputs))?;
        Some(RequestKind::Set { index: index as u8, value: setting.value })
    }

    /// The blocks of the next cyclic request; `changes`: the control word is another one than the drive has.
    #[inline]
    fn choose(&self, is_written: bool, changes: bool, stands: bool) -> Cyclic {
        let is_urgent = || changes || self.profile.is_new();
        if self.conn.other.is_check_due()
            && !is_urgent()
            && let Some(read) = self.check(stands)
        {
            // Whether our values stand: what FC23 reads it has written itself.
            return Cyclic { write: None, read: Some(read), confirms: true };
        }
        let confirming = self.choose_confirming(is_written, changes, stands);
        let confirms = confirming.is_some();
        let read = confirming.or_else(|| self.turns.read(self.conn.turn));
        let write = if is_written { self.choose_write(changes) } else { None };
        // Without FC23 writing and reading take turns; an urgent one may go twice in a row.
        let most = || if is_urgent() { 2 } else { 1 };
        match write {
            Some(_) if self.functions.is_used() => Cyclic { write, read, confirms },
            Some(_) if self.conn.written_in_a_row < most() => Cyclic { write, read: None, confirms: false },
            _ => Cyclic { write: None, read, confirms },
        }
    }

    /// The block that shows whether somebody else writes. It delays no step of a command, a stop above all, and does
    /// not come between the two halves of a report.
    #[inline(never)]
    fn check(&self, stands: bool) -> Option<Read> {
        let may_check = self.conn.seen == Places::default() && !self.profile.waits(stands)
            || self.conn.other.is_in_doubt();
        if may_check { self.turns.read_with(self.conn.other.check()) } else { None }
    }

    /// The block to read out of turn, to check what the drive has accepted; `None`: that of the turn.
    #[inline]
    fn choose_confirming(&self, is_written: bool, changes: bool, stands: bool) -> Option<Read> {
        let inputs = &self.conn.inputs;
        if inputs.seen && !inputs.status.healthy() && !self.conn.trip_read {
            // A trip is named as soon as it is seen.
            return self.turns.read_with(Role::Trip);
        }
        if self.conn.confirmed || self.turns.reads.len() < 2 {
            return None;
        }
        let role = match is_written {
            // Whether somebody commands a drive that is found running, once its state is known.
            false => {
                let image = &self.conn.image;
                let known = image.of(Role::Status).is_some() && image.of(Role::Speed).is_some();
                (known && inputs.status.active()).then_some(Role::Reference)
            }
            true if changes => Some(Role::Control),
            true => (self.reference_changes() && self.profile.waits(stands)).then_some(Role::Reference),
        };
        role.and_then(|role| self.turns.read_with(role))
    }

    /// The reference is another one than the drive has.
    #[inline]
    fn reference_changes(&self) -> bool {
        !self.conn.inputs.reference.has_taken(self.profile.outputs().reference)
    }

    /// The value that differs from the drive's, the control word first; else each in its turn, for the drive's
    /// watchdogs.
    #[inline]
    fn choose_write(&self, changes: bool) -> Option<Write> {
        let [first, last] = self.turns.writes;
        if first == last {
            return first;
        }
        let is_first_control = first.is_some_and(Write::has_control);
        let writes = self.conn.writes;
        let control_turn = writes.is_multiple_of(REFERENCES_IN_A_ROW);
        let is_control = if changes {
            true
        } else if self.reference_changes() {
            control_turn && !self.profile.is_new()
        } else {
            control_turn || is_first_control == writes.is_multiple_of(2)
        };
        if is_first_control == is_control { first } else { last }
    }

    /// Writes a call or a setting into the room.
    #[inline(never)]
    fn emit_other(&mut self, header: Header) -> usize {
        let mut data = RegistersBuffer::new();
        let request = match self.conn.prepared {
            RequestKind::Set { index, value } => self
                .settings
                .get(usize::from(index))
                .map(|setting| (setting.parameter.unit(header.unit), setting.write(value, &mut data))),
            RequestKind::Call | RequestKind::Cyclic(_) => self.calls.request(header.unit, &mut data),
        };
        let Some((unit, request)) = request else { return 0 };
        request.emit(Header { unit, ..header }, &mut self.room)
    }

    /// The request that was sent last, without its header, as long as no newer one is built.
    pub(crate) fn sent_request(&self) -> &[u8] {
        self.room.get(HEADER..self.conn.open.into()).unwrap_or_default()
    }

    /// Says whether news since the last request was built have changed what it was built from.
    #[inline]
    pub fn is_void(&self) -> bool {
        self.profile.is_void()
    }

    /// The bytes for the wire for a slot that is due; empty: nothing can be sent.
    #[inline]
    pub fn to_send(&self) -> &[u8] {
        match self.connected && !self.identity.is_open() {
            true => self.room.get(..self.conn.length.into()).unwrap_or_default(),
            false => &[],
        }
    }

    /// The bytes of the open request that the wire has not taken yet.
    #[inline]
    pub fn rest(&self) -> &[u8] {
        match self.connected && self.identity.is_open() {
            true => self.room.get(self.conn.gone.into()..self.conn.open.into()).unwrap_or_default(),
            false => &[],
        }
    }

    /// More of the open request went out.
    pub(crate) fn rest_sent(&mut self, count: usize) {
        self.conn.gone += count as u16;
    }

    /// The prepared request was handed to the wire, or the front of it: `count` bytes.
    #[inline]
    pub fn sent(&mut self, at: Time, count: usize, cycle: &Cycle, slot: &mut Slot) {
        let conn = &mut self.conn;
        if count < usize::from(conn.length) {
            Own::Pieces.count(&mut slot.counters);
        }
        (conn.open, conn.gone) = (conn.length, count as u16);
        self.identity.sent();
        (conn.requested, conn.requested_at, conn.written) = (conn.prepared, at, self.profile.outputs());
        self.since_call = self.since_call.saturating_add(1);
        match conn.prepared {
            RequestKind::Cyclic(cyclic) => {
                conn.requested_unit = conn.unit;
                self.blocks_sent(cyclic, slot);
            }
            RequestKind::Call | RequestKind::Set { .. } => self.other_sent(),
        }
        let window_ns = cycle.deadline.since(cycle.grid);
        if self.window_ns != window_ns {
            // It is always the same one: a division is needed once.
            let more = self.reply_within_ns.saturating_sub(window_ns);
            self.beyond_ns = more.div_ceil(cycle.period_ns) * cycle.period_ns;
            self.window_ns = window_ns;
        }
        self.pace.sent(cycle);
        self.passed = true;
        let reply_by = cycle.deadline + self.beyond_ns;
        let given_up = self.functions.given_up();
        if given_up > 0 {
            slot.counters.own[Own::NoReadWrite as usize] = given_up.into();
        }
        slot.owe(at, reply_by, self.pace.awaited());
    }

    /// A call or a setting went out.
    #[cold]
    fn other_sent(&mut self) {
        self.conn.requested_unit = self.room[HEADER - 1];
        if matches!(self.conn.requested, RequestKind::Call) {
            self.since_call = 0;
            self.calls.sent();
        }
    }

    /// These blocks went out.
    #[inline]
    fn blocks_sent(&mut self, cyclic: Cyclic, slot: &mut Slot) {
        let conn = &mut self.conn;
        conn.confirmed = cyclic.confirms;
        if cyclic.read.is_some() && !cyclic.confirms {
            let next = conn.turn + 1;
            conn.turn = if usize::from(next) < self.turns.reads.len() { next } else { 0 };
        }
        conn.writes = conn.writes.wrapping_add(cyclic.write.is_some().into());
        conn.written_in_a_row = if cyclic.read.is_some() { 0 } else { conn.written_in_a_row + 1 };
        let (control, reference) = cyclic.writes();
        conn.other.sent(control || reference);
        if control {
            conn.inputs.control.sent(conn.written.control.0.into());
            self.control_sent = Some(conn.written.control);
        }
        if reference {
            conn.inputs.reference.sent(conn.written.reference);
        }
        if cyclic.write.is_some() {
            slot.gone.grid = Some(self.grid);
            self.profile.sent(&mut self.native);
        }
    }
}
