//! The request of the next send: its choice, its bytes, and what changes once they are sent.

use super::{Blocks, End, Station, What, used};
use crate::bus::modbus::counters::Own;
use crate::bus::modbus::mapping::{Block, Role};
use crate::bus::modbus::parameter::Width;
use crate::bus::modbus::profile::Outputs;
use crate::bus::modbus::template::{Expected, Template};
use crate::bus::modbus::wire::{Header, Request};
use crate::bus::{Cycle, Exchange, Slot};
use crate::time::Time;

/// After so many references in a row it is the control word's turn, for the drive's watchdogs.
pub(in crate::bus::modbus) const REFERENCES_IN_A_ROW: u32 = 8;

impl Station {
    /// Builds the request of the next send. Built again for the same send, it is the same: state that changes with
    /// every request changes in [`sent`](Self::sent).
    pub fn prepare(&mut self, cycle: &Cycle, slot: &mut Slot) {
        if slot.exchange == Exchange::Missed {
            self.look_for_silence();
        }
        let native = &mut self.native;
        let outputs = self.profile.encode(&slot.desired, &self.inputs, native);
        let calls = self.calls.advance(cycle.grid, slot.link, self.profile.is_on(), slot.guarded);
        let commanded = self.calls.commands();
        if std::mem::replace(&mut slot.commanded, commanded) && !commanded {
            self.doubt_settings();
        }
        // Whether the last one is answered by then is known at the send.
        self.length = 0;
        if !self.connected || !self.rest().is_empty() {
            return;
        }
        self.grid = cycle.grid;
        // A drive that does not follow the control word, and cannot be configured to, is only read.
        let outputs = if self.finding.obeys || self.settable { outputs } else { None };
        self.outputs = outputs.unwrap_or_default();
        let sets = self.end != End::NotYet || self.set < self.settings.len();
        if let Some(template) = &self.template
            && template.only
            && outputs.is_some()
            && !(calls || sets || self.other.is_check_due())
        {
            // There is nothing to choose, and `prepared` is this request already.
            template.refill(&mut self.out, self.identity.next(), self.outputs);
            self.length = template.length;
            return;
        }
        self.length = self.prepare_next(outputs, calls);
    }

    /// A missed request by FC23 may be one that the drive ignores. The next one goes out behind it.
    #[cold]
    fn look_for_silence(&mut self) {
        if self.asks_both() && self.rest().is_empty() && self.functions.ignored() {
            self.template = None;
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
        if self.settable {
            (self.set, self.finding.obeys, self.finding.watched) = (0, false, false);
            self.profile.found(self.unwatched, false, true);
        }
    }

    /// The setting to write now, if there is one.
    fn next_setting(&self) -> Option<What> {
        if let End::Disarming(_) = self.end {
            return self.time_out().map(|index| What::Set { index: index as u8, value: 0 });
        }
        let setting = self.settings.get(self.set).filter(|_| self.profile.wants_set_up(&self.inputs))?;
        Some(What::Set { index: self.set as u8, value: setting.value })
    }

    /// The blocks of the next cyclic request.
    fn choose(&self, outputs: Option<Outputs>) -> Blocks {
        let urgent = self.control_changes(outputs) || self.profile.is_new();
        // It delays no step of an order, a stop above all, and does not come between the two halves of a report.
        let may_check = self.seen == (false, false) && !self.profile.waits() || self.other.is_in_doubt();
        if may_check
            && self.other.is_check_due()
            && !urgent
            && let Some(read) = self.mapping().block_with(self.other.check())
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
            Some(_) if self.written_in_a_row < most => Blocks { read: None, confirms: false, ..both },
            Some(_) => Blocks { write: None, ..both },
        }
    }

    /// The block to read, and whether it is out of turn: to check what the drive has accepted.
    fn choose_read(&self, outputs: Option<Outputs>) -> (usize, bool) {
        let mapping = self.mapping();
        let turn = (mapping.read_in(self.reads), false);
        if self.inputs.seen && !self.inputs.status.healthy() && !self.trip_read {
            // A trip is named as soon as it is seen.
            return mapping.block_with(Role::Trip).map_or(turn, |block| (block, true));
        }
        if self.confirmed || mapping.reads().len() < 2 {
            return turn;
        }
        let Some(outputs) = outputs else {
            // Whether somebody commands a drive that is found running, once its state is known.
            let known = self.image.of(Role::Status).is_some() && self.image.of(Role::Speed).is_some();
            let found = known && self.inputs.status.active();
            let block = mapping.block_with(Role::Reference).filter(|_| found);
            return block.map_or(turn, |block| (block, true));
        };
        let missing = if self.control_changes(Some(outputs)) {
            Some(Role::Control)
        } else if self.inputs.reference != Some(outputs.reference) && self.profile.waits() {
            Some(Role::Reference)
        } else {
            None
        };
        missing.and_then(|role| mapping.block_with(role)).map_or(turn, |block| (block, true))
    }

    fn control_changes(&self, outputs: Option<Outputs>) -> bool {
        outputs.is_some_and(|outputs| self.inputs.control != Some(outputs.control))
    }

    /// The value that differs from the drive's, the control word first; else each in its turn, for the drive's
    /// watchdogs.
    fn choose_write(&self, outputs: Outputs) -> usize {
        let writes = self.mapping().writes();
        if writes.len() == 1 {
            return 0;
        }
        let with = |role| writes.iter().position(|block| block.has(role));
        let control_turn = self.writes.is_multiple_of(REFERENCES_IN_A_ROW);
        let block = if self.control_changes(Some(outputs)) {
            with(Role::Control)
        } else if self.inputs.reference != Some(outputs.reference) && (self.profile.is_new() || !control_turn)
        {
            with(Role::Reference)
        } else if control_turn {
            with(Role::Control)
        } else {
            None
        };
        block.unwrap_or_else(|| self.writes as usize % writes.len().max(1))
    }

    /// Writes the next request into its room: over the last one, if that had the same blocks.
    fn emit(&mut self, next: What) -> usize {
        let transaction = self.identity.next();
        if let What::Cyclic(blocks) = next
            && let Some(template) = &self.template
            && template.blocks == (blocks.write, blocks.read)
        {
            template.refill(&mut self.out, transaction, self.outputs);
            let (control, reference) = (template.control.is_some(), template.reference.is_some());
            self.prepared =
                What::Cyclic(Blocks { control, reference, registers: template.registers, ..blocks });
            return template.length;
        }
        self.prepared = next;
        self.build(transaction)
    }

    /// Builds the prepared request in its room.
    fn build(&mut self, transaction: u16) -> usize {
        self.template = None;
        let data = &mut self.data;
        data.clear();
        let blocks = match &mut self.prepared {
            What::Call => {
                let Some((unit, request)) = self.calls.request(self.finding.unit, data) else { return 0 };
                return request.emit(Header { transaction, unit }, &mut self.out);
            }
            What::Set { index, value } => {
                let Some(setting) = self.settings.get(usize::from(*index)) else { return 0 };
                let unit = setting.parameter.unit(self.finding.unit);
                return setting.write(*value, data).emit(Header { transaction, unit }, &mut self.out);
            }
            What::Cyclic(blocks) => blocks,
        };
        let mapping = used(&self.direct, &self.menu_0, self.finding.menu_0);
        let block =
            |blocks, index: Option<u8>| index.and_then(|index| <[Block]>::get(blocks, usize::from(index)));
        let (write, read) = (block(mapping.writes(), blocks.write), block(mapping.reads(), blocks.read));
        let (mut control, mut reference) = (None, None);
        if let Some(block) = write {
            for role in &block.roles {
                let (place, count) = match role {
                    Role::Control => (&mut control, i32::from(self.outputs.control.0)),
                    _ => (&mut reference, self.outputs.reference),
                };
                *place = Some((data.registers().bytes().len(), block.width));
                match block.width {
                    Width::Word => data.push_word(count as u16),
                    Width::Long => data.push_long(count),
                };
            }
        }
        (blocks.control, blocks.reference) = (control.is_some(), reference.is_some());
        let data = data.registers();
        blocks.registers = data.len() as u16 + read.map_or(0, |read| read.registers);
        let registers = blocks.registers;
        let unit = self.finding.unit;
        let request = match (write, read) {
            (Some(write), Some(read)) => {
                Request::ReadWrite { read: read.address, count: read.registers, write: write.address, data }
            }
            (Some(write), None) => Request::Write { address: write.address, data },
            (None, Some(read)) => Request::Read { address: read.address, count: read.registers },
            (None, None) => return 0,
        };
        let length = request.emit(Header { transaction, unit }, &mut self.out);
        let expected = match (write, read) {
            (Some(_), Some(read)) => Expected::new(read, unit),
            _ => Expected::default(),
        };
        // The values are the end of the message.
        let begin = length.saturating_sub(data.bytes().len());
        let in_message = |place: Option<(usize, Width)>| {
            place.and_then(|(at, width)| Some((u8::try_from(begin + at).ok()?, width)))
        };
        let places = (in_message(control), in_message(reference));
        // A value whose offset is not known would stay unchanged.
        let found = (places.0.is_some(), places.1.is_some()) == (control.is_some(), reference.is_some());
        let (control, reference) = places;
        let blocks = (blocks.write, blocks.read);
        let only = mapping.writes().len() == 1 && mapping.reads().len() == 1 && blocks == (Some(0), Some(0));
        let template = Template { blocks, only, registers, length, control, reference, expected };
        self.template = (length > 0 && found).then_some(template);
        length
    }

    /// The bytes for the wire for a slot that is due; empty: nothing can be sent.
    pub fn to_send(&self) -> &[u8] {
        match self.connected && !self.identity.is_open() {
            true => self.out.get(..self.length).unwrap_or_default(),
            false => &[],
        }
    }

    /// The bytes of the open request that the wire has not taken yet.
    pub(in crate::bus::modbus) fn rest(&self) -> &[u8] {
        match self.connected && self.identity.is_open() {
            true => self.out.get(self.gone..self.open).unwrap_or_default(),
            false => &[],
        }
    }

    /// More of the open request went out.
    pub(in crate::bus::modbus) fn rest_sent(&mut self, count: usize) {
        self.gone += count;
    }

    /// The prepared request was handed to the wire, or the front of it: `count` bytes.
    #[inline]
    pub fn sent(&mut self, at: Time, count: usize, cycle: &Cycle, slot: &mut Slot) {
        if count < self.length {
            Own::Pieces.count(&mut slot.counters);
        }
        (self.open, self.gone, self.asked_unit) = (self.length, count, self.out[6]);
        let expected = self.template.as_ref().map(|template| template.expected.to(self.identity.next()));
        self.expected = expected.unwrap_or_default();
        self.identity.sent();
        (self.asked, self.asked_at, self.written) = (self.prepared, at, self.outputs);
        self.calls.sent(self.asked == What::Call);
        if let What::Cyclic(blocks) = self.asked {
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
        slot.counters.sent += 1;
        slot.counters.own[Own::NoReadWrite as usize] = self.functions.given_up();
        slot.exchange = Exchange::Owed { sent_at: at, reply_by, awaited: self.pace.awaited() };
    }

    /// These blocks went out.
    #[inline]
    fn blocks_sent(&mut self, blocks: Blocks, slot: &mut Slot) {
        // Where there is nothing to choose, turns have no effect.
        if self.template.as_ref().is_none_or(|template| !template.only) {
            self.confirmed = blocks.confirms;
            self.reads = self.reads.wrapping_add(u32::from(blocks.read.is_some() && !blocks.confirms));
            self.writes = self.writes.wrapping_add(u32::from(blocks.write.is_some()));
            self.written_in_a_row = if blocks.read.is_some() { 0 } else { self.written_in_a_row + 1 };
        }
        self.other.sent(blocks.control || blocks.reference);
        if blocks.control {
            self.control.sent(self.written.control.0.into());
            self.control_sent = Some(self.written.control);
            self.profile.control_sent();
        }
        if blocks.reference {
            self.reference.sent(self.written.reference);
            self.profile.reference_sent();
        }
        if blocks.write.is_some() {
            slot.gone.grid = Some(self.grid);
            self.profile.sent();
        }
    }

    /// Nothing could be sent.
    pub(in crate::bus::modbus) fn unsent(&mut self, slot: &mut Slot) {
        slot.counters.unsent += 1;
        slot.exchange = Exchange::Unsent;
    }
}
