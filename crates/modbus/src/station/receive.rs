//! Received bytes: which request they belong to, and their faults.
//!
//! A reply that is exactly the expected one is recognised at once. All others take the long way.

use super::{Blocks, End, MOST_REPEATED, ROOM, Station, What, Why, used};
use crate::counters::Own;
use crate::echo::Echo;
use crate::identity::Whose;
use crate::mapping::{Block, Image, Places, Role};
use crate::native::Also;
use crate::pace::Pace;
use crate::parameter::{DRIVE_UNIT, Parameter, Width};
use crate::setup::Purpose;
use crate::wire::{ExceptionCode, Header, Registers, Response, ResponseError, frame};
use fieldbeat_core::bus::Slot;
use fieldbeat_core::time::Time;

const GARBAGE: Why = "the received bytes are not Modbus";

/// The reply to a request that reads when nothing is wrong: all of it but its values, which are copied to an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Expected {
    /// The length of the whole message; 0: none is expected.
    size: usize,
    /// Its first eight bytes, the first one highest.
    header: u64,
    /// Its count of value bytes.
    bytes: u8,
    /// The indices of the values.
    pub places: Places,
}

impl Expected {
    /// The bytes before the values: header, function, number of bytes.
    pub(super) const FRONT: usize = 9;

    /// The reply to a request that reads `block` by `function`, whatever its id. There is none for a block longer than
    /// a message, nor for one that has to be sorted.
    pub(super) fn new(block: &Block, unit: u8, function: u8) -> Expected {
        let bytes = block.registers.checked_mul(2).and_then(|bytes| u8::try_from(bytes).ok());
        let Some(bytes) = bytes.filter(|_| block.in_order) else {
            return Expected::default();
        };
        // Unit, function and number of bytes are counted, too.
        let [high, low] = (u16::from(bytes) + 3).to_be_bytes();
        let header = u64::from_be_bytes([0, 0, 0, 0, high, low, unit, function]);
        Expected { size: Self::FRONT + usize::from(bytes), header, bytes, places: block.places }
    }

    /// The reply to the request with this id.
    #[inline]
    pub(super) fn to(self, transaction: u16) -> Expected {
        Expected { header: self.header | u64::from(transaction) << 48, ..self }
    }

    /// Its values, if `bytes` are all of it and nothing else.
    #[inline]
    pub(super) fn values(self, bytes: &[u8]) -> Option<Registers<'_>> {
        if bytes.len() != self.size {
            return None;
        }
        let (front, values) = bytes.split_first_chunk::<{ Self::FRONT }>()?;
        let [header @ .., count] = *front;
        if u64::from_be_bytes(header) != self.header || count != self.bytes {
            return None;
        }
        Registers::new(values)
    }
}

impl Station {
    /// The room for what arrives.
    pub fn room(&mut self) -> &mut [u8] {
        &mut self.inbox[self.conn.filled..]
    }

    /// So many bytes have arrived in it. An error: the connection has to be given up.
    pub fn take(&mut self, at: Time, count: usize, slot: &mut Slot) -> Result<(), Why> {
        self.conn.filled = (self.conn.filled + count).min(ROOM);
        if let What::Cyclic(blocks) = self.conn.requested
            && self.identity.is_open()
            && let Some(data) = self.conn.expected.values(&self.inbox[..self.conn.filled])
        {
            self.identity.answer_open();
            match blocks.is_both() {
                true => self.functions.answered(blocks.registers),
                false => self.functions.other_answered(),
            }
            if close(&mut self.pace, at, slot) {
                self.conn.image.set_front(data);
                match blocks.is_both() && self.is_repeated() {
                    true => self.repeat(at, slot),
                    false => self.cyclic_read(at, blocks, self.conn.expected.places, slot),
                }
            }
            self.conn.filled = 0;
            return Ok(());
        }
        self.take_messages(at, slot)
    }

    /// Takes in what has arrived, message by message.
    #[inline(never)]
    fn take_messages(&mut self, at: Time, slot: &mut Slot) -> Result<(), Why> {
        // Taken out of the station while it takes the messages in.
        let mut inbox = std::mem::take(&mut self.inbox);
        let mut rest = &inbox[..self.conn.filled];
        // Each turn takes a message of eight bytes at least out of the room.
        let result = loop {
            match frame(rest) {
                Ok(Some(size)) => {
                    let (adu, behind) = rest.split_at(size);
                    rest = behind;
                    self.reply(at, adu, slot);
                }
                Ok(None) => break Ok(()),
                Err(_) => break Err(GARBAGE),
            }
        };
        let left = rest.len();
        if left > 0 {
            inbox.copy_within(self.conn.filled - left..self.conn.filled, 0);
        }
        (self.inbox, self.conn.filled) = (inbox, left);
        if result.is_err() {
            slot.counters.malformed += 1;
            Own::Garbage.count(&mut slot.counters);
            self.disconnected();
        }
        result
    }

    /// One message.
    fn reply(&mut self, at: Time, adu: &[u8], slot: &mut Slot) {
        let (header, response) = match Response::parse(adu) {
            Ok(parsed) => parsed,
            Err(error) => {
                let counter = match error {
                    ResponseError::Function { .. } => Own::WrongFunction,
                    _ => Own::WrongLength,
                };
                counter.count(&mut slot.counters);
                slot.counters.malformed += 1;
                return;
            }
        };
        match self.identity.whose(header.transaction) {
            Whose::Open => {}
            Whose::Late => {
                self.identity.answer(header.transaction);
                slot.counters.late += 1;
                if matches!(response, Response::ReadWritten { .. }) {
                    self.functions.answered_late();
                }
                return;
            }
            Whose::Duplicate => {
                slot.counters.duplicate += 1;
                return;
            }
            Whose::Foreign => {
                slot.counters.foreign += 1;
                return;
            }
        }
        if let Some(fault) = self.misfits(header, &response) {
            fault.count(&mut slot.counters);
            slot.counters.malformed += 1;
            return;
        }
        self.answered(at, &response, slot);
    }

    /// The open request has this response.
    fn answered(&mut self, at: Time, response: &Response<'_>, slot: &mut Slot) {
        self.identity.answer_open();
        if matches!(response, Response::Exception { .. }) {
            Own::Exceptions.count(&mut slot.counters);
        }
        match self.conn.requested {
            What::Cyclic(blocks) if blocks.is_both() => {
                if matches!(response, Response::ReadWritten { .. }) {
                    self.functions.answered(blocks.registers);
                }
            }
            What::Call => {
                self.functions.other_answered();
                self.calls.answer(response);
            }
            _ => self.functions.other_answered(),
        }
        if !close(&mut self.pace, at, slot) {
            return;
        }
        match self.conn.requested {
            What::Call => {}
            What::Set { index, .. } => self.set_answered(at, usize::from(index), response),
            What::Cyclic(blocks) => self.cyclic(at, blocks, response, slot),
        }
    }

    /// The response to a setting.
    fn set_answered(&mut self, at: Time, index: usize, response: &Response<'_>) {
        if let Response::Exception { code, .. } = response
            && code.is_busy()
        {
            // It follows again.
            self.note_busy(at);
            return;
        }
        self.conn.busy = None;
        if let End::Disarming(_) = self.end {
            // Refused or not: a repetition would have the same result.
            self.end = End::Done;
            return;
        }
        let Some(setting) = self.settings.get(index) else { return };
        let taken =
            matches!(*response, Response::Written { count, .. } if count == setting.width.registers());
        if !taken {
            self.conn.settable = false;
        } else if setting.parameter == Parameter::CONTROL_WORD_ENABLE {
            // From here on the control word counts, once it is written again.
            (self.conn.control, self.conn.inputs.control) = (Echo::default(), None);
        }
        if taken {
            self.conn.set = index + 1;
            let rest = &self.settings[self.conn.set..];
            let is_met = |purpose| !rest.iter().any(|setting| setting.purpose == purpose);
            self.conn.finding.obeys = is_met(Purpose::Obey);
            self.conn.finding.watched = is_met(Purpose::Watch) && self.time_out().is_some();
        }
        self.tell_set_up();
    }

    /// What does not fit the open request in a response that names it.
    fn misfits(&self, header: Header, response: &Response<'_>) -> Option<Own> {
        let unit = self.conn.requested_unit;
        // A drive may answer 255 to 0 (field reports).
        if header.unit != unit && !(unit == 0 && header.unit == DRIVE_UNIT) {
            return Some(Own::WrongUnit);
        }
        let blocks = match self.conn.requested {
            What::Call => return (!self.calls.fits(response)).then_some(Own::WrongFunction),
            What::Set { .. } => {
                let fits = matches!(response, Response::Exception { .. } | Response::Written { .. });
                return (!fits).then_some(Own::WrongFunction);
            }
            What::Cyclic(blocks) => blocks,
        };
        let data = match (response, blocks.write, blocks.read) {
            (Response::Exception { .. }, ..) => return None,
            (Response::ReadWritten { data }, Some(_), Some(_)) | (Response::Read { data }, None, Some(_)) => {
                data
            }
            (Response::Written { .. }, Some(_), None) => return None,
            _ => return Some(Own::WrongFunction),
        };
        let block = blocks.read.and_then(|index| self.mapping().reads().get(usize::from(index)));
        (data.len() != block.map_or(0, |block| usize::from(block.registers))).then_some(Own::WrongLength)
    }

    /// The response to a cyclic request.
    fn cyclic(&mut self, at: Time, blocks: Blocks, response: &Response<'_>, slot: &mut Slot) {
        let data = match *response {
            Response::Exception { code, .. } => return self.refuse(at, blocks, code),
            Response::Written { count, .. } => return self.written(at, blocks, count, slot),
            Response::Read { data } | Response::ReadWritten { data } => data,
            Response::WriteOne { .. } => return,
        };
        let mapping = used(&self.direct, &self.menu_0, self.conn.finding.menu_0);
        if let Some(block) = blocks.read.and_then(|index| mapping.reads().get(usize::from(index))) {
            read(block, data, &mut self.conn.image, &self.also);
            let places = block.places;
            self.cyclic_read(at, blocks, places, slot);
        }
    }

    /// The drive has refused a cyclic request.
    fn refuse(&mut self, at: Time, blocks: Blocks, code: ExceptionCode) {
        match code {
            _ if code.is_busy() => {
                if self.note_busy(at) <= MOST_REPEATED {
                    self.take_turn_back(blocks);
                }
            }
            _ if blocks.is_both() && self.functions.refused(code, blocks.registers) => {
                self.conn.templates = [None; 2];
                self.profile.refused(blocks.control, blocks.reference);
            }
            _ => {
                self.conn.refused.0 += u32::from(blocks.write.is_some());
                self.conn.refused.1 += u32::from(blocks.read.is_some());
            }
        }
    }

    /// The drive was too busy for a request: for so many in a row.
    fn note_busy(&mut self, at: Time) -> u8 {
        let (_, requests) = self.conn.busy.get_or_insert((at, 0));
        *requests = requests.saturating_add(1);
        *requests
    }

    /// The turn of a request that the drive was too busy for comes again: one that is busy in the rhythm of the turns
    /// would never report the same parameters.
    fn take_turn_back(&mut self, blocks: Blocks) {
        let conn = &mut self.conn;
        if blocks.read.is_some() {
            conn.reads = conn.reads.wrapping_sub(u32::from(!blocks.confirms));
            // What is out of turn and what is in turn alternate.
            conn.confirmed = !blocks.confirms;
        }
        match (blocks.write, blocks.read) {
            (None, _) => conn.written_in_a_row = 1,
            (Some(_), read) => {
                conn.writes = conn.writes.wrapping_sub(1);
                if read.is_none() {
                    conn.written_in_a_row = conn.written_in_a_row.saturating_sub(1);
                }
            }
        }
    }

    /// The drive has written so many registers.
    fn written(&mut self, at: Time, blocks: Blocks, count: u16, slot: &mut Slot) {
        (self.conn.refused.0, self.conn.busy) = (0, None);
        let block = blocks.write.and_then(|index| self.mapping().writes().get(usize::from(index)));
        if block.is_some_and(|block| count < block.registers) {
            Own::WrittenShort.count(&mut slot.counters);
            return self.profile.not_taken();
        }
        if blocks.control {
            self.conn.control.confirm(i32::from(self.conn.written.control.0));
        }
        if blocks.reference {
            self.conn.reference.confirm(self.conn.written.reference);
        }
        self.note_taken(at);
    }
}

/// Ends the exchange as answered, if its time has not passed.
#[inline]
fn close(pace: &mut Pace, at: Time, slot: &mut Slot) -> bool {
    pace.answered(at);
    let is_open = slot.answer(at, false).is_some();
    slot.counters.late += u64::from(!is_open);
    is_open
}

/// Takes the values of a block into the image.
fn read(block: &Block, data: Registers<'_>, image: &mut Image, also: &Also) {
    if block.in_order {
        return image.set_front(data);
    }
    let mut take = |role: &Role, count: i32| match (role.index(), role) {
        (Some(place), _) => image.set(place, count),
        (None, Role::Also(index)) => also.publish(*index, count),
        (None, _) => {}
    };
    match block.width {
        Width::Word => {
            block.roles.iter().zip(data.words()).for_each(|(role, word)| take(role, (word as i16).into()))
        }
        Width::Long => block.roles.iter().zip(data.longs()).for_each(|(role, long)| take(role, long)),
    }
}
