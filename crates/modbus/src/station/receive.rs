//! Received bytes: which request they belong to, and their faults.
//!
//! A reply that is exactly the expected one is recognised at once. All others take the long way.

use super::turns::{Cyclic, Read, Write};
use super::{End, MOST_REPEATED, ROOM, RequestKind, Station, Why};
use crate::counters::Own;
use crate::echo::Echo;
use crate::identity::Whose;
use crate::pace::Pace;
use crate::parameter::{DRIVE_UNIT, Parameter};
use crate::setup::Purpose;
use crate::wire::{ExceptionCode, Header, Registers, Response, ResponseError, frame, function};
use fieldbeat_core::bus::Slot;
use fieldbeat_core::time::Time;

const GARBAGE: Why = "the received bytes are not Modbus";

impl Station {
    /// The room for what arrives.
    pub fn room(&mut self) -> &mut [u8] {
        self.inbox.get_mut(usize::from(self.conn.filled)..).unwrap_or_default()
    }

    /// Takes in `count` bytes that have arrived. An error: the connection has to be given up.
    pub fn take(&mut self, at: Time, count: usize, slot: &mut Slot) -> Result<(), Why> {
        let filled = (usize::from(self.conn.filled) + count).min(ROOM);
        let unit = self.conn.requested_unit;
        let open = self.identity.open().map(|transaction| Header { transaction, unit });
        let bytes = self.inbox.get(..filled).unwrap_or_default();
        let Some((cyclic, read, data)) = expected(&self.conn.requested, open, bytes) else {
            self.conn.filled = filled as u16;
            return self.take_messages(at, slot);
        };
        self.conn.filled = 0;
        self.identity.answer_open();
        match cyclic.is_both() {
            true => self.functions.answered(cyclic.registers()),
            false => self.functions.other_answered(),
        }
        if close(&mut self.pace, at, slot) {
            self.turns.take(read, data, &mut self.conn.image, &self.also);
            match self.is_repeated(&cyclic, read, slot) {
                true => self.repeat(at, slot),
                false => self.cyclic_read(at, cyclic, read, slot),
            }
        }
        Ok(())
    }

    /// Takes in what has arrived, message by message.
    #[inline(never)]
    fn take_messages(&mut self, at: Time, slot: &mut Slot) -> Result<(), Why> {
        // Copied out of the station, which takes the messages in.
        let inbox = self.inbox;
        let filled = usize::from(self.conn.filled);
        let mut rest = &inbox[..filled];
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
            self.inbox.copy_within(filled - left..filled, 0);
        }
        self.conn.filled = left as u16;
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
            RequestKind::Cyclic(cyclic) if cyclic.is_both() => {
                if matches!(response, Response::ReadWritten { .. }) {
                    self.functions.answered(cyclic.registers());
                }
            }
            RequestKind::Call => {
                self.functions.other_answered();
                self.calls.answer(response);
            }
            _ => self.functions.other_answered(),
        }
        if !close(&mut self.pace, at, slot) {
            return;
        }
        match self.conn.requested {
            RequestKind::Call => {}
            RequestKind::Set { index, .. } => self.set_answered(at, usize::from(index), response),
            RequestKind::Cyclic(cyclic) => self.cyclic(at, cyclic, response, slot),
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
        self.conn.busy = 0;
        if self.end == End::Disarming {
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
            self.conn.inputs.control = Echo::default();
        }
        if taken {
            self.conn.unset = (self.settings.len() - index - 1) as u8;
            let rest = &self.settings[index + 1..];
            let is_met = |purpose| !rest.iter().any(|setting| setting.purpose == purpose);
            self.conn.obeys = is_met(Purpose::Obey);
            self.conn.watched = is_met(Purpose::Watch) && self.time_out().is_some();
        }
        self.tell_set_up();
    }

    /// The part of a response that does not fit the open request that it names.
    fn misfits(&self, header: Header, response: &Response<'_>) -> Option<Own> {
        let unit = self.conn.requested_unit;
        // A drive may answer 255 to 0 (field reports).
        if header.unit != unit && !(unit == 0 && header.unit == DRIVE_UNIT) {
            return Some(Own::WrongUnit);
        }
        let cyclic = match self.conn.requested {
            RequestKind::Call => return (!self.calls.fits(response)).then_some(Own::WrongFunction),
            RequestKind::Set { .. } => {
                let fits = matches!(response, Response::Exception { .. } | Response::Written { .. });
                return (!fits).then_some(Own::WrongFunction);
            }
            RequestKind::Cyclic(cyclic) => cyclic,
        };
        let (data, read) = match (response, cyclic.write, cyclic.read) {
            (Response::Exception { .. }, ..) => return None,
            (Response::ReadWritten { data }, Some(_), Some(read))
            | (Response::Read { data }, None, Some(read)) => (data, read),
            (Response::Written { .. }, Some(_), None) => return None,
            _ => return Some(Own::WrongFunction),
        };
        (data.len() != usize::from(read.registers())).then_some(Own::WrongLength)
    }

    /// The response to a cyclic request.
    fn cyclic(&mut self, at: Time, cyclic: Cyclic, response: &Response<'_>, slot: &mut Slot) {
        match (*response, cyclic.write, cyclic.read) {
            (Response::Exception { code, .. }, ..) => self.refuse(at, cyclic, code),
            (Response::Written { count, .. }, Some(write), _) => self.written(at, write, count, slot),
            (Response::Read { data } | Response::ReadWritten { data }, _, Some(read)) => {
                self.turns.take(read, data, &mut self.conn.image, &self.also);
                self.cyclic_read(at, cyclic, read, slot);
            }
            _ => {}
        }
    }

    /// The drive has refused a cyclic request.
    fn refuse(&mut self, at: Time, cyclic: Cyclic, code: ExceptionCode) {
        match code {
            _ if code.is_busy() => {
                if self.note_busy(at) <= MOST_REPEATED {
                    self.take_turn_back(cyclic);
                }
            }
            _ if cyclic.is_both() && self.functions.refused(code, cyclic.registers()) => {
                self.conn.is_only = false;
                let (control, reference) = cyclic.writes();
                self.profile.refused(control, reference);
            }
            _ => {
                self.conn.proved = None;
                let (writes, reads) = &mut self.conn.refused;
                *writes = writes.saturating_add(cyclic.write.is_some().into());
                *reads = reads.saturating_add(cyclic.read.is_some().into());
            }
        }
    }

    /// The drive was too busy for a request: for so many in a row.
    fn note_busy(&mut self, at: Time) -> u8 {
        self.conn.proved = None;
        if self.conn.busy == 0 {
            self.conn.busy_since = at;
        }
        self.conn.busy = self.conn.busy.saturating_add(1);
        self.conn.busy
    }

    /// The turn of a request that the drive was too busy for comes again: one that is busy in the rhythm of the turns
    /// would never report the same parameters.
    fn take_turn_back(&mut self, cyclic: Cyclic) {
        let conn = &mut self.conn;
        if cyclic.read.is_some() {
            if !cyclic.confirms {
                conn.turn = conn.turn.checked_sub(1).unwrap_or(self.turns.reads.len() as u16 - 1);
            }
            // What is out of turn and what is in turn alternate.
            conn.confirmed = !cyclic.confirms;
        }
        match (cyclic.write, cyclic.read) {
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
    fn written(&mut self, at: Time, write: Write, count: u16, slot: &mut Slot) {
        (self.conn.refused.0, self.conn.busy) = (0, 0);
        if count < write.registers() {
            Own::WrittenShort.count(&mut slot.counters);
            return self.profile.not_taken();
        }
        let inputs = &mut self.conn.inputs;
        let before = inputs.control();
        if write.has_control() {
            inputs.control.confirm(i32::from(self.conn.written.control.0));
        }
        if write.has_reference() {
            inputs.reference.confirm(self.conn.written.reference);
        }
        self.note_taken(at, before);
    }
}

/// The open request, and the values of the reply to it, if `bytes` are all of that and nothing else. Only a request
/// that reads has such a reply.
#[inline]
fn expected<'a>(
    requested: &RequestKind,
    open: Option<Header>,
    bytes: &'a [u8],
) -> Option<(Cyclic, Read, Registers<'a>)> {
    let RequestKind::Cyclic(cyclic) = *requested else { return None };
    let (header, read) = (open?, cyclic.read?);
    let function = if cyclic.write.is_some() { function::READ_WRITE } else { function::READ };
    Some((cyclic, read, read.values(header, function, bytes)?))
}

/// Ends the exchange as answered, if its time has not passed.
#[inline]
fn close(pace: &mut Pace, at: Time, slot: &mut Slot) -> bool {
    pace.answered(at);
    let is_open = slot.answer(at, false).is_some();
    slot.counters.late += u64::from(!is_open);
    is_open
}
