//! The request of the next send: its choice, its bytes, and what changes once they are sent.
//!
//! In most cycles the request to a drive is the same but for its id and its values: it is built once, and these are
//! written over it. The one that only reads has a room of its own, since it comes now and then between the others.

use super::receive::Expected;
use super::{Blocks, End, Station, What, used};
use crate::counters::Own;
use crate::mapping::{Block, Role};
use crate::parameter::Width;
use crate::plan::REFERENCES_IN_A_ROW;
use crate::profile::Outputs;
use crate::wire::{ADU_MAX, HEADER, Header, Registers, RegistersBuffer, Request, function};
use fieldbeat_core::bus::{Cycle, Exchange, Slot};
use fieldbeat_core::time::Time;

/// The offset of a value in a message, and its width: its first byte is at most 255, so that four always fit.
pub(super) type Place = (u8, Width);

/// A cyclic request in its room.
#[derive(Clone, Copy, Debug)]
pub(super) struct Template {
    /// What it writes and reads.
    pub blocks: Blocks,
    /// The drive has no other blocks.
    pub only: bool,
    /// The length of the whole message.
    pub length: usize,
    /// The offsets of control word and reference, if it writes them.
    pub control: Option<Place>,
    pub reference: Option<Place>,
    /// The reply to it.
    pub expected: Expected,
}

impl Template {
    /// Writes another id and other values over those of the request in `out`.
    #[inline]
    pub(super) fn refill(&self, out: &mut [u8; ADU_MAX], transaction: u16, outputs: Outputs) {
        out[..2].copy_from_slice(&transaction.to_be_bytes());
        put(out, self.control, i32::from(outputs.control.0));
        put(out, self.reference, outputs.reference);
    }
}

#[inline]
pub(super) fn put(out: &mut [u8; ADU_MAX], place: Option<Place>, count: i32) {
    let Some((at, width)) = place else { return };
    let at = usize::from(at);
    match width {
        Width::Long => out[at..at + 4].copy_from_slice(&count.to_be_bytes()),
        Width::Word => out[at..at + 2].copy_from_slice(&(count as u16).to_be_bytes()),
    }
}

impl Station {
    /// Builds the request of the next send. Built again for the same send, it is the same: state that changes with
    /// every request changes in [`sent`](Self::sent).
    pub fn prepare(&mut self, cycle: &Cycle, slot: &mut Slot) {
        if matches!(slot.exchange, Exchange::Missed) {
            self.look_for_silence();
        }
        let native = &mut self.native;
        let outputs = self.profile.encode(&slot.desired, &self.conn.inputs, native);
        let calls = self.calls.advance(cycle.grid, slot.link, self.profile.is_on(), slot.guarded);
        let commanded = self.calls.commands();
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
        let is_written = (self.conn.finding.obeys || self.conn.settable) && !slot.notices.restarted;
        let outputs = outputs.filter(|_| is_written);
        self.conn.outputs = outputs.unwrap_or_default();
        let sets = self.end != End::NotYet || self.conn.set < self.settings.len();
        if let Some(template) = &self.conn.templates[0]
            && template.only
            && outputs.is_some()
            && !(calls || sets || self.conn.other.is_check_due())
        {
            // There is nothing to choose.
            template.refill(&mut self.rooms[0], self.identity.next(), self.conn.outputs);
            (self.conn.room, self.conn.length) = (0, template.length);
            self.conn.prepared = What::Cyclic(template.blocks);
        } else {
            self.conn.length = self.prepare_next(outputs, calls);
        }
        match self.conn.prepared {
            What::Cyclic(Blocks { write: Some(_), control, reference, .. }) => {
                self.profile.carries(control, reference);
            }
            _ => self.profile.carries_nothing(),
        }
    }

    /// A missed request by FC23 may be one that the drive ignores. The next one goes out behind it.
    #[cold]
    fn look_for_silence(&mut self) {
        if self.reads_and_writes() && self.rest().is_empty() && self.functions.ignored() {
            self.conn.templates = [None; 2];
            self.identity.give_up();
            self.pace.unanswered();
        }
    }

    /// Chooses and builds the next request.
    #[inline(never)]
    fn prepare_next(&mut self, outputs: Option<Outputs>, calls: bool) -> usize {
        let goes_first = || self.control_changes(outputs) || outputs.is_some() && self.profile.is_new();
        let next = match self.next_setting() {
            Some(setting) => setting,
            None if calls && !goes_first() => What::Call,
            None => What::Cyclic(self.choose(outputs)),
        };
        self.emit(next)
    }

    /// The application may have changed what the drive follows: it is set up again before it is enabled or stopped.
    fn doubt_settings(&mut self) {
        if self.conn.settable {
            (self.conn.set, self.conn.finding.obeys, self.conn.finding.watched) = (0, false, false);
            self.tell_set_up();
        }
    }

    /// The setting to write now, if there is one.
    fn next_setting(&self) -> Option<What> {
        if let End::Disarming(_) = self.end {
            return self.time_out().map(|index| What::Set { index: index as u8, value: 0 });
        }
        let setting =
            self.settings.get(self.conn.set).filter(|_| self.profile.wants_set_up(&self.conn.inputs))?;
        Some(What::Set { index: self.conn.set as u8, value: setting.value })
    }

    /// The blocks of the next cyclic request.
    fn choose(&self, outputs: Option<Outputs>) -> Blocks {
        let urgent = self.control_changes(outputs) || self.profile.is_new();
        // It delays no step of a command, a stop above all, and does not come between the two halves of a report.
        let may_check =
            self.conn.seen == (false, false) && !self.profile.waits() || self.conn.other.is_in_doubt();
        if may_check
            && self.conn.other.is_check_due()
            && !urgent
            && let Some(read) = self.mapping().block_with(self.conn.other.check())
        {
            // Whether our values stand: what FC23 reads it has written itself.
            return Blocks { read: Some(read as u8), confirms: true, ..Blocks::default() };
        }
        let (read, confirms) = self.choose_read(outputs);
        let write = outputs.map(|outputs| self.choose_write(outputs) as u8);
        let both = Blocks { write, read: Some(read as u8), confirms, ..Blocks::default() };
        // Without FC23 writing and reading take turns; an urgent one may go twice in a row.
        let most = if urgent { 2 } else { 1 };
        match write {
            None => both,
            Some(_) if self.functions.is_used() => both,
            Some(_) if self.conn.written_in_a_row < most => Blocks { read: None, confirms: false, ..both },
            Some(_) => Blocks { write: None, ..both },
        }
    }

    /// The block to read, and whether it is out of turn: to check what the drive has accepted.
    fn choose_read(&self, outputs: Option<Outputs>) -> (usize, bool) {
        let mapping = self.mapping();
        let turn = (mapping.read_in(self.conn.reads), false);
        if self.conn.inputs.seen && !self.conn.inputs.status.healthy() && !self.conn.trip_read {
            // A trip is named as soon as it is seen.
            return mapping.block_with(Role::Trip).map_or(turn, |block| (block, true));
        }
        if self.conn.confirmed || mapping.reads().len() < 2 {
            return turn;
        }
        let Some(outputs) = outputs else {
            // Whether somebody commands a drive that is found running, once its state is known.
            let known =
                self.conn.image.of(Role::Status).is_some() && self.conn.image.of(Role::Speed).is_some();
            let found = known && self.conn.inputs.status.active();
            let block = mapping.block_with(Role::Reference).filter(|_| found);
            return block.map_or(turn, |block| (block, true));
        };
        let missing = if self.control_changes(Some(outputs)) {
            Some(Role::Control)
        } else if self.conn.inputs.reference != Some(outputs.reference) && self.profile.waits() {
            Some(Role::Reference)
        } else {
            None
        };
        missing.and_then(|role| mapping.block_with(role)).map_or(turn, |block| (block, true))
    }

    fn control_changes(&self, outputs: Option<Outputs>) -> bool {
        outputs.is_some_and(|outputs| self.conn.inputs.control != Some(outputs.control))
    }

    /// The value that differs from the drive's, the control word first; else each in its turn, for the drive's
    /// watchdogs.
    fn choose_write(&self, outputs: Outputs) -> usize {
        let writes = self.mapping().writes();
        if writes.len() == 1 {
            return 0;
        }
        let with = |role| writes.iter().position(|block| block.has(role));
        let control_turn = self.conn.writes.is_multiple_of(REFERENCES_IN_A_ROW);
        let block = if self.control_changes(Some(outputs)) {
            with(Role::Control)
        } else if self.conn.inputs.reference != Some(outputs.reference)
            && (self.profile.is_new() || !control_turn)
        {
            with(Role::Reference)
        } else if control_turn {
            with(Role::Control)
        } else {
            None
        };
        block.unwrap_or_else(|| self.conn.writes as usize % writes.len().max(1))
    }

    /// Writes the next request into its room: over the last one there, if that had the same blocks.
    fn emit(&mut self, next: What) -> usize {
        self.conn.prepared = next;
        let What::Cyclic(blocks) = next else { return self.emit_other(next) };
        let room = usize::from(blocks.write.is_none());
        let is_built = |template: &Template| {
            (template.blocks.write, template.blocks.read) == (blocks.write, blocks.read)
        };
        if !self.conn.templates[room].as_ref().is_some_and(is_built) {
            self.conn.templates[room] = self.build(blocks, room);
        }
        let Some(template) = &self.conn.templates[room] else { return 0 };
        template.refill(&mut self.rooms[room], self.identity.next(), self.conn.outputs);
        self.conn.room = room;
        self.conn.prepared = What::Cyclic(Blocks { confirms: blocks.confirms, ..template.blocks });
        template.length
    }

    /// Writes a call or a setting into the room.
    fn emit_other(&mut self, next: What) -> usize {
        (self.conn.room, self.conn.templates[0]) = (0, None);
        let (mut data, drive) = (RegistersBuffer::new(), self.conn.finding.unit);
        let request = match next {
            What::Set { index, value } => self
                .settings
                .get(usize::from(index))
                .map(|setting| (setting.parameter.unit(drive), setting.write(value, &mut data))),
            What::Call | What::Cyclic(_) => self.calls.request(drive, &mut data),
        };
        let Some((unit, request)) = request else { return 0 };
        request.emit(Header { transaction: self.identity.next(), unit }, &mut self.rooms[0])
    }

    /// Builds a cyclic request in this room, all but its id and its values.
    fn build(&mut self, blocks: Blocks, room: usize) -> Option<Template> {
        let mapping = used(&self.direct, &self.menu_0, self.conn.finding.menu_0);
        let block =
            |blocks, index: Option<u8>| index.and_then(|index| <[Block]>::get(blocks, usize::from(index)));
        let (write, read) = (block(mapping.writes(), blocks.write), block(mapping.reads(), blocks.read));
        let count = |block: Option<&Block>| block.map_or(0, |block| block.registers);
        let data = Registers::zeros(count(write));
        let request = match (write, read) {
            (Some(write), Some(read)) => {
                Request::ReadWrite { read: read.address, count: read.registers, write: write.address, data }
            }
            (Some(write), None) => Request::Write { address: write.address, data },
            (None, Some(read)) => Request::Read { address: read.address, count: read.registers },
            (None, None) => return None,
        };
        let unit = self.conn.finding.unit;
        let length = request.emit(Header { transaction: 0, unit }, &mut self.rooms[room]);
        // The values are the end of the message. At most two are written: they are in its first 30 bytes.
        let begin = length.checked_sub(data.bytes().len())?;
        let place = |role: Role| {
            let block = write?;
            let index = block.roles.iter().position(|other| *other == role)?;
            let at = begin + index * block.width.bytes();
            Some((at as u8, block.width))
        };
        let expected = match (write, read) {
            (Some(_), Some(read)) => Expected::new(read, unit, function::READ_WRITE),
            (None, Some(read)) => Expected::new(read, unit, function::READ),
            (_, None) => Expected::default(),
        };
        let only = mapping.writes().len() == 1
            && mapping.reads().len() == 1
            && (blocks.write, blocks.read) == (Some(0), Some(0));
        let (control, reference) = (place(Role::Control), place(Role::Reference));
        let blocks = Blocks {
            control: control.is_some(),
            reference: reference.is_some(),
            registers: count(write) + count(read),
            ..blocks
        };
        (length > 0).then_some(Template { blocks, only, length, control, reference, expected })
    }

    /// The request that was sent last, without its header, as long as no newer one is built.
    pub(crate) fn sent_request(&self) -> &[u8] {
        self.rooms[self.conn.room].get(HEADER..self.conn.open).unwrap_or_default()
    }

    /// What came since the last request was built has changed what it was built from.
    #[inline]
    pub fn is_void(&self) -> bool {
        self.profile.is_void()
    }

    /// The bytes for the wire for a slot that is due; empty: nothing can be sent.
    pub fn to_send(&self) -> &[u8] {
        match self.connected && !self.identity.is_open() {
            true => self.rooms[self.conn.room].get(..self.conn.length).unwrap_or_default(),
            false => &[],
        }
    }

    /// The bytes of the open request that the wire has not taken yet.
    pub fn rest(&self) -> &[u8] {
        match self.connected && self.identity.is_open() {
            true => self.rooms[self.conn.room].get(self.conn.gone..self.conn.open).unwrap_or_default(),
            false => &[],
        }
    }

    /// More of the open request went out.
    pub(crate) fn rest_sent(&mut self, count: usize) {
        self.conn.gone += count;
    }

    /// The prepared request was handed to the wire, or the front of it: `count` bytes.
    #[inline]
    pub fn sent(&mut self, at: Time, count: usize, cycle: &Cycle, slot: &mut Slot) {
        if count < self.conn.length {
            Own::Pieces.count(&mut slot.counters);
        }
        let (out, template) = (&self.rooms[self.conn.room], &self.conn.templates[self.conn.room]);
        (self.conn.open, self.conn.gone, self.conn.requested_unit) = (self.conn.length, count, out[6]);
        let expected = template.as_ref().map(|template| template.expected.to(self.identity.next()));
        self.conn.expected = expected.unwrap_or_default();
        self.identity.sent();
        (self.conn.requested, self.conn.requested_at, self.conn.written) =
            (self.conn.prepared, at, self.conn.outputs);
        self.calls.sent(self.conn.requested == What::Call);
        if let What::Cyclic(blocks) = self.conn.requested {
            self.blocks_sent(blocks, slot);
        }
        let window_ns = cycle.deadline.since(cycle.grid);
        if self.window_ns != window_ns {
            // It is always the same one: a division is needed once.
            let more = self.reply_within_ns.saturating_sub(window_ns);
            self.beyond_ns = more.div_ceil(cycle.period_ns) * cycle.period_ns;
            self.window_ns = window_ns;
        }
        self.pace.sent(cycle);
        let reply_by = cycle.deadline + self.beyond_ns;
        slot.counters.own[Own::NoReadWrite as usize] = self.functions.given_up();
        slot.owe(at, reply_by, self.pace.awaited());
    }

    /// These blocks went out.
    #[inline]
    fn blocks_sent(&mut self, blocks: Blocks, slot: &mut Slot) {
        // Where there is nothing to choose, turns have no effect.
        if self.conn.templates[self.conn.room].as_ref().is_none_or(|template| !template.only) {
            self.conn.confirmed = blocks.confirms;
            self.conn.reads =
                self.conn.reads.wrapping_add(u32::from(blocks.read.is_some() && !blocks.confirms));
            self.conn.writes = self.conn.writes.wrapping_add(u32::from(blocks.write.is_some()));
            self.conn.written_in_a_row =
                if blocks.read.is_some() { 0 } else { self.conn.written_in_a_row + 1 };
        }
        self.conn.other.sent(blocks.control || blocks.reference);
        if blocks.control {
            self.conn.control.sent(self.conn.written.control.0.into());
            self.control_sent = Some(self.conn.written.control);
        }
        if blocks.reference {
            self.conn.reference.sent(self.conn.written.reference);
        }
        if blocks.write.is_some() {
            slot.gone.grid = Some(self.grid);
            self.profile.sent(&mut self.native);
        }
    }
}
