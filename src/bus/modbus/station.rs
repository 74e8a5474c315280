//! The master's view of one Unidrive: one request after the other on its connection, and what came of each.

use std::sync::Arc;

use super::calls::Calls;
use super::counters::Own;
use super::echo::Echo;
use super::greeting::{Finding, Found};
use super::identity::{Identity, Whose};
use super::mapping::{Block, Image, Mapping, Role};
use super::native::{Native, NativePort, native};
use super::orders::{Inputs, Orders, Outputs};
use super::parameter::{DRIVE_UNIT, Parameter, Width};
use super::plan::UnidriveDrive;
use super::setup::{Purpose, Setting, settings};
use super::template::{Expected, Template};
use super::wire::{
    ADU_MAX, ExceptionCode, Header, Registers, RegistersBuffer, Request, Response, ResponseError, frame,
};
use super::words::{ControlWord, StatusWord};
use crate::axis::acyclic::{self, AcyclicEnds};
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::bus::{Cycle, Exchange, Slot};
use crate::rt::Regions;
use crate::time::{S, Time};

/// The end waits for the drive's time-out to be disarmed for so many times that a reply may take.
const DISARM_WITHIN: u64 = 3;
/// A cyclic exchange that is refused so often in a row is not what the greeting found: the drive is greeted again ...
const MOST_REFUSALS: u32 = 3;
/// ... and so it is after it was busy for so many times that a reply may take.
const BUSY_WITHIN: u64 = 4;

/// One drive as the master sees it.
#[derive(Debug)]
pub struct Station {
    /// Counts in one unit of each channel that it shows.
    shown: [Option<f64>; MONITOR_CHANNELS],
    /// User units/s of one count of the speed feedback.
    velocity_per_count: f64,
    /// It tells the numbers of its trips.
    tells_trips: bool,
    /// The blocks where they are, and those of menu 0.
    direct: Mapping,
    menu_0: Option<Mapping>,
    found: Arc<Found>,
    finding: Finding,
    /// No time-out has to be set in the drive before it is enabled.
    unwatched: bool,
    /// What makes the drive follow the control word, and what watches it: written with the first order that needs it, this far.
    settings: Box<[Setting]>,
    set: usize,
    settable: bool,
    end: End,
    reply_within_ns: u64,
    /// A window of this length is followed by so much time for a reply, in whole periods.
    window_ns: Option<u64>,
    beyond_ns: u64,
    orders: Orders,
    calls: Calls,
    native: NativePort,
    connected: bool,
    opened_before: bool,
    /// An exchange was owed as this cycle's send began: none is due.
    pub(super) passed: bool,
    identity: Identity,
    /// What the open request is, and when it went out.
    asked: What,
    asked_at: Time,
    written: Outputs,
    prepared: What,
    /// The values that the prepared request writes.
    outputs: Outputs,
    grid: Time,
    /// What it writes, as registers.
    data: RegistersBuffer,
    out: [u8; ADU_MAX],
    /// What stands there, if it is cyclic.
    template: Option<Template>,
    /// The reply to the open request, if there is only one that is right.
    expected: Expected,
    /// Of the prepared request; 0: there is none.
    length: usize,
    /// Of the open one, and how much of it the wire has taken. The next one is built over it as soon as that is all.
    open: usize,
    gone: usize,
    /// The unit id of the open request.
    asked_unit: u8,
    inbox: Vec<u8>,
    filled: usize,
    /// Exchanges that read, and that wrote; those that wrote only, in a row.
    reads: u32,
    writes: u32,
    written_in_a_row: u8,
    /// Writes, and reads, that were refused in a row; and since when the drive is busy.
    refused: (u32, u32),
    busy_since: Option<Time>,
    image: Image,
    inputs: Inputs,
    control: Echo,
    reference: Echo,
    /// The control word that the drive last took, and the one that last went out, on whatever connection.
    control_taken: Option<ControlWord>,
    control_sent: Option<ControlWord>,
    /// A status, a speed was read since the last report.
    seen: (bool, bool),
    /// The last read was for what is waited for to be taken.
    confirmed: bool,
    was_active: bool,
    /// The power stage was last off then although the drive was told to run.
    dark_at: Option<Time>,
}

/// How far the orderly end is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    NotYet,
    /// The drive is to be seen off, until this instant at the latest ...
    Waiting(Time),
    /// ... then its time-out is disarmed.
    Disarming(Time),
    Done,
}

/// A missing hardware enable is shown for so long, ns, after the drive was last told to run: only telling it again will show
/// whether it is back.
const DARK_NS: u64 = S;

/// Room for what arrives: a whole message, and what came behind it.
const ROOM: usize = 2 * ADU_MAX;

/// What a request is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum What {
    /// An acyclic call.
    Call,
    /// A setting, and its value: what is to be set, or 0 to disarm a time-out.
    Set { index: u8, value: i32 },
    /// Blocks to write and to read.
    Cyclic(Blocks),
}

impl Default for What {
    fn default() -> What {
        What::Cyclic(Blocks::default())
    }
}

/// The blocks of a cyclic request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Blocks {
    write: Option<u8>,
    read: Option<u8>,
    /// The block to write has the control word, the reference.
    control: bool,
    reference: bool,
    /// The block to read is out of turn.
    confirms: bool,
}

/// Why a connection has to be given up.
pub type Why = &'static str;

impl Station {
    /// The station of `drive` for an exchange every `interval_ns`, and the application's ends of its native process data and of its
    /// acyclic access.
    pub fn new(
        drive: &UnidriveDrive,
        mappings: (Mapping, Option<Mapping>),
        found: Arc<Found>,
        interval_ns: u64,
    ) -> (Station, Native, AcyclicEnds) {
        let (application, native) = native(drive.map.also.len());
        let (ends, port) = acyclic::queue(drive.axis.parameter_queue);
        let station = Station {
            velocity_per_count: drive.velocity(drive.map.speed.value(1)),
            tells_trips: drive.map.trip.is_some(),
            shown: drive.map.show.map(|mapped| Some(mapped?.raw(1.0))),
            direct: mappings.0,
            menu_0: mappings.1,
            found,
            finding: Finding::default(),
            unwatched: drive.watchdog.timeout_ns.is_none()
                && (drive.watchdog.keypad || drive.watchdog.accept_none),
            settings: if drive.set_up { settings(drive, None).into() } else { Box::default() },
            set: 0,
            settable: false,
            end: End::NotYet,
            reply_within_ns: drive.reply_within_ns,
            window_ns: None,
            beyond_ns: 0,
            orders: Orders::new(drive, interval_ns),
            calls: Calls::new(port, drive.addressing),
            native,
            connected: false,
            opened_before: false,
            passed: false,
            identity: Identity::default(),
            asked: What::default(),
            asked_at: Time(0),
            written: Outputs::default(),
            prepared: What::default(),
            outputs: Outputs::default(),
            grid: Time(0),
            data: RegistersBuffer::new(),
            out: [0; ADU_MAX],
            template: None,
            expected: Expected::default(),
            length: 0,
            open: 0,
            gone: 0,
            asked_unit: 0,
            inbox: vec![0; ROOM],
            filled: 0,
            reads: 0,
            writes: 0,
            written_in_a_row: 0,
            refused: (0, 0),
            busy_since: None,
            image: Image::default(),
            inputs: Inputs::default(),
            control: Echo::default(),
            reference: Echo::default(),
            control_taken: None,
            control_sent: None,
            seen: (false, false),
            confirmed: false,
            was_active: false,
            dark_at: None,
        };
        (station, application, ends)
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.inbox);
        self.native.memory(regions);
        self.calls.memory(regions);
        for mapping in std::iter::once(&self.direct).chain(&self.menu_0) {
            mapping.memory(regions);
        }
    }

    /// A new connection is there, greeted.
    pub fn connected(&mut self, slot: &mut Slot) {
        self.connected = true;
        self.finding = self.found.get();
        let finding = &self.finding;
        // What is so already is not set again.
        let is_met = |setting: &&Setting| match setting.purpose {
            Purpose::Obey => finding.obeys,
            Purpose::Watch => finding.watched,
            Purpose::Menu0 => true,
        };
        self.set = self.settings.iter().take_while(is_met).count();
        self.settable = !self.settings.is_empty();
        self.orders.found(finding.watched || self.unwatched, finding.obeys, self.settable);
        self.identity.reconnected();
        (self.template, self.expected) = (None, Expected::default());
        (self.filled, self.length, self.open, self.gone) = (0, 0, 0, 0);
        (self.refused, self.busy_since, self.written_in_a_row) = ((0, 0), None, 0);
        // What the drive has is not known until it reads back, nor what it does until it says so again.
        (self.control, self.reference) = (Echo::default(), Echo::default());
        let velocity = f64::from(finding.speed) * self.velocity_per_count;
        self.inputs = Inputs { seen: true, status: finding.status, velocity, ..Inputs::default() };
        (self.was_active, self.dark_at) = (false, None);
        (self.image, self.reads, self.writes, self.seen) = (Image::default(), 0, 0, (false, false));
        // It stands, and has neither what it last took nor what was last on its way.
        let known = [self.control_taken, self.control_sent];
        if self.control_sent.is_some() && !finding.status.active() && !known.contains(&Some(finding.control))
        {
            slot.report.restarted = true;
            (self.control_taken, self.control_sent) = (None, None);
            self.orders.drive_restarted();
        }
        slot.reachable = true;
        if std::mem::replace(&mut self.opened_before, true) {
            Own::Reopened.count(&mut slot.counters);
        }
    }

    /// The connection is gone.
    pub(super) fn disconnected(&mut self) {
        self.connected = false;
        self.calls.lost();
    }

    /// The connection has ended at the other end.
    pub(super) fn ended(&mut self, slot: &mut Slot) {
        let counter = if self.filled > 0 { Own::CutOff } else { Own::Closed };
        counter.count(&mut slot.counters);
        self.disconnected();
    }

    /// Why the connection has to be given up, if it has.
    pub(super) fn gives_up(&mut self, now: Time, slot: &mut Slot) -> Option<Why> {
        let silent = self.identity.is_open() && now.since(self.asked_at) > 2 * self.reply_within_ns;
        let busy = self.busy_since.is_some_and(|since| now.since(since) > BUSY_WITHIN * self.reply_within_ns);
        let why = match () {
            () if !self.connected => return None,
            () if silent => "a request was not answered in twice its time",
            () if busy => "the drive is busy all the time",
            () if self.refused.0.max(self.refused.1) >= MOST_REFUSALS => {
                "the drive refuses its cyclic parameters"
            }
            () => return None,
        };
        Own::GivenUp.count(&mut slot.counters);
        self.disconnected();
        Some(why)
    }

    /// Starts or continues the orderly end: true once nothing is owed to this drive any more.
    pub(super) fn shut_down(&mut self, cycle: &Cycle) -> bool {
        let armed =
            self.connected && self.finding.watched && self.time_out().is_some() && self.orders.writes();
        let off = self.inputs.control == Some(ControlWord::IDLE) && !self.inputs.status.active();
        self.end = match self.end {
            // A drive that is still on keeps what stops it.
            End::NotYet if !armed || self.orders.is_on() => End::Done,
            End::NotYet => End::Waiting(cycle.deadline + DISARM_WITHIN * self.reply_within_ns),
            End::Waiting(until) if off => End::Disarming(until),
            End::Waiting(until) | End::Disarming(until) if !self.connected || cycle.grid > until => End::Done,
            same => same,
        };
        self.end == End::Done
    }

    /// The place of the time-out among the settings.
    fn time_out(&self) -> Option<usize> {
        self.settings.iter().position(|setting| setting.purpose == Purpose::Watch)
    }

    /// The orderly end is over: nothing is asked any more.
    pub(super) fn has_ended(&self) -> bool {
        self.end == End::Done
    }

    fn mapping(&self) -> &Mapping {
        used(&self.direct, &self.menu_0, self.finding.menu_0)
    }

    /// Builds the request of the next send. Built again for the same send, it is the same: what moves on with every request does so
    /// in [`sent`](Self::sent).
    pub fn prepare(&mut self, cycle: &Cycle, slot: &mut Slot) {
        let native = &mut self.native;
        let outputs = self.orders.advance(cycle.grid, &self.inputs, slot, native);
        self.inputs.fresh = false;
        let calls = self.calls.advance(cycle.grid, slot.link, self.orders.is_on());
        // Whether the last one is answered by then, the send will see.
        self.length = 0;
        if !self.connected || !self.rest().is_empty() {
            return;
        }
        self.grid = cycle.grid;
        // A drive that does not follow the control word, and cannot be set so, is only read.
        let outputs = outputs.filter(|_| self.finding.obeys || self.settable);
        self.outputs = outputs.unwrap_or_default();
        let goes_first = || self.control_changes(outputs) || outputs.is_some() && self.orders.is_new();
        let next = match self.next_setting() {
            Some(setting) => setting,
            None if calls && !goes_first() => What::Call,
            None => What::Cyclic(self.choose(outputs)),
        };
        self.length = self.emit(next);
    }

    /// The setting to write now, if there is one.
    fn next_setting(&self) -> Option<What> {
        if let End::Disarming(_) = self.end {
            return self.time_out().map(|index| What::Set { index: index as u8, value: 0 });
        }
        let setting = self.settings.get(self.set).filter(|_| self.orders.wants_set_up(&self.inputs))?;
        Some(What::Set { index: self.set as u8, value: setting.value })
    }

    /// The blocks of the next cyclic request.
    fn choose(&self, outputs: Option<Outputs>) -> Blocks {
        let mapping = self.mapping();
        if mapping.reads().len() == 1 && mapping.writes().len() == 1 && self.finding.read_write {
            return Blocks { write: outputs.map(|_| 0), read: Some(0), ..Blocks::default() };
        }
        let (read, confirms) = self.choose_read(outputs);
        let write = outputs.map(|outputs| self.choose_write(outputs) as u8);
        let both = Blocks { write, read: Some(read as u8), confirms, ..Blocks::default() };
        // Without FC23 writing and reading take turns; what is urgent may go twice in a row.
        let urgent = self.control_changes(outputs) || self.orders.is_new();
        let most = if urgent { 2 } else { 1 };
        match write {
            None => both,
            Some(_) if self.finding.read_write => both,
            Some(_) if self.written_in_a_row < most => Blocks { read: None, confirms: false, ..both },
            Some(_) => Blocks { write: None, ..both },
        }
    }

    /// The block to read, and whether it is out of turn: to see what the drive has taken.
    fn choose_read(&self, outputs: Option<Outputs>) -> (usize, bool) {
        let mapping = self.mapping();
        let turn = (mapping.read_in(self.reads), false);
        if self.inputs.seen && !self.inputs.status.healthy() && self.image.of(Role::Trip).is_none() {
            // A trip is named as soon as it is seen.
            return mapping.block_with(Role::Trip).map_or(turn, |block| (block, true));
        }
        let Some(outputs) = outputs.filter(|_| !self.confirmed && mapping.reads().len() > 1) else {
            return turn;
        };
        let missing = if self.control_changes(Some(outputs)) {
            Some(Role::Control)
        } else if self.inputs.reference != Some(outputs.reference) && self.orders.waits() {
            Some(Role::Reference)
        } else {
            None
        };
        missing.and_then(|role| mapping.block_with(role)).map_or(turn, |block| (block, true))
    }

    fn control_changes(&self, outputs: Option<Outputs>) -> bool {
        outputs.is_some_and(|outputs| self.inputs.control != Some(outputs.control))
    }

    /// What differs from what the drive has, the control word first; else each in its turn, for the drive's watchdogs.
    fn choose_write(&self, outputs: Outputs) -> usize {
        let writes = self.mapping().writes();
        if writes.len() == 1 {
            return 0;
        }
        let with = |role| writes.iter().position(|block| block.has(role));
        let control_turn = self.writes.is_multiple_of(REFERENCES_IN_A_ROW);
        let block = if self.control_changes(Some(outputs)) {
            with(Role::Control)
        } else if self.inputs.reference != Some(outputs.reference) && (self.orders.is_new() || !control_turn)
        {
            with(Role::Reference)
        } else if control_turn {
            with(Role::Control)
        } else {
            None
        };
        block.unwrap_or_else(|| self.writes as usize % writes.len().max(1))
    }

    /// Writes the next request into its room: over the last one, if that asked for the same blocks.
    fn emit(&mut self, next: What) -> usize {
        let transaction = self.identity.next();
        if let What::Cyclic(blocks) = next
            && let Some(template) = &self.template
            && template.blocks == (blocks.write, blocks.read)
        {
            template.refill(&mut self.out, transaction, self.outputs);
            let (control, reference) = (template.control.is_some(), template.reference.is_some());
            self.prepared = What::Cyclic(Blocks { control, reference, ..blocks });
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
            (Some(_), Some(read)) => Expected::new(read.registers, unit),
            _ => Expected::default(),
        };
        // The values are the end of the message.
        let begin = length.saturating_sub(data.bytes().len());
        let in_message = |place: Option<(usize, Width)>| place.map(|(at, width)| (begin + at, width));
        let (control, reference) = (in_message(control), in_message(reference));
        let blocks = (blocks.write, blocks.read);
        self.template = (length > 0).then_some(Template { blocks, length, control, reference, expected });
        length
    }

    /// What is to be handed to the wire for a slot that is due; empty: nothing can be.
    pub fn to_send(&self) -> &[u8] {
        match self.connected && !self.identity.is_open() {
            true => self.out.get(..self.length).unwrap_or_default(),
            false => &[],
        }
    }

    /// What the wire has not taken yet of the request that is open.
    pub(super) fn rest(&self) -> &[u8] {
        match self.connected && self.identity.is_open() {
            true => self.out.get(self.gone..self.open).unwrap_or_default(),
            false => &[],
        }
    }

    /// More of the open request went out.
    pub(super) fn rest_sent(&mut self, count: usize) {
        self.gone += count;
    }

    /// The prepared request was handed to the wire, or the front of it: `count` bytes.
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
            self.blocks_sent(blocks);
        }
        let window_ns = cycle.deadline.since(cycle.grid);
        if self.window_ns != Some(window_ns) {
            // It is always the same one: a division is needed once.
            let more = self.reply_within_ns.saturating_sub(window_ns);
            self.beyond_ns = more.div_ceil(cycle.period_ns) * cycle.period_ns;
            self.window_ns = Some(window_ns);
        }
        let reply_by = cycle.deadline + self.beyond_ns;
        slot.counters.sent += 1;
        slot.exchange = Exchange::Owed { sent_at: at, reply_by, awaited: true };
    }

    /// These blocks went out.
    fn blocks_sent(&mut self, blocks: Blocks) {
        self.confirmed = blocks.confirms;
        self.reads = self.reads.wrapping_add(u32::from(blocks.read.is_some() && !blocks.confirms));
        self.writes = self.writes.wrapping_add(u32::from(blocks.write.is_some()));
        self.written_in_a_row = if blocks.read.is_some() { 0 } else { self.written_in_a_row + 1 };
        if blocks.control {
            self.control_sent = Some(self.written.control);
            self.orders.control_sent();
        }
        if blocks.reference {
            self.orders.reference_sent(self.grid);
        }
        if blocks.write.is_some() {
            self.orders.sent();
        }
    }

    /// Nothing could be sent.
    pub(super) fn unsent(&mut self, slot: &mut Slot) {
        slot.counters.unsent += 1;
        slot.exchange = Exchange::Unsent;
    }

    /// The room for what arrives.
    pub fn room(&mut self) -> &mut [u8] {
        &mut self.inbox[self.filled..]
    }

    /// So many bytes have arrived in it. An error: the connection has to be given up.
    pub fn take(&mut self, at: Time, count: usize, slot: &mut Slot) -> Result<(), Why> {
        self.filled = (self.filled + count).min(ROOM);
        // Out of the station's hands while it takes the messages in.
        let mut inbox = std::mem::take(&mut self.inbox);
        let mut rest = &inbox[..self.filled];
        if let Some(data) = self.expected.values(rest).filter(|_| self.identity.is_open()) {
            self.answered(at, &Response::ReadWritten { data }, slot);
            (self.inbox, self.filled) = (inbox, 0);
            return Ok(());
        }
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
            inbox.copy_within(self.filled - left..self.filled, 0);
        }
        (self.inbox, self.filled) = (inbox, left);
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
        if self.asked == What::Call {
            self.calls.answer(response);
        }
        let Exchange::Owed { sent_at, .. } = slot.exchange else {
            // Its time had passed.
            slot.counters.late += 1;
            return;
        };
        slot.exchange = Exchange::Answered { sent_at, at, suspect: false };
        slot.counters.answered += 1;
        match self.asked {
            What::Call => {}
            What::Set { index, .. } => self.set_answered(usize::from(index), response),
            What::Cyclic(blocks) => self.cyclic(at, blocks, response, slot),
        }
    }

    /// The response to a setting.
    fn set_answered(&mut self, index: usize, response: &Response<'_>) {
        if let End::Disarming(_) = self.end {
            // Refused or not: asked once more it would say the same.
            self.end = End::Done;
            return;
        }
        let Some(setting) = self.settings.get(index) else { return };
        let taken =
            matches!(*response, Response::Written { count, .. } if count == setting.width.registers());
        if !taken {
            self.settable = false;
        } else if setting.parameter == Parameter::CONTROL_WORD_ENABLE {
            // From here on the control word counts, once it is written again.
            (self.control, self.inputs.control) = (Echo::default(), None);
        }
        if taken {
            self.set = index + 1;
            let rest = &self.settings[self.set..];
            let is_met = |purpose| !rest.iter().any(|setting| setting.purpose == purpose);
            self.finding.obeys = is_met(Purpose::Obey);
            self.finding.watched = is_met(Purpose::Watch) && self.time_out().is_some();
        }
        self.orders.found(self.finding.watched || self.unwatched, self.finding.obeys, self.settable);
    }

    /// What does not fit the open request in a response that names it.
    fn misfits(&self, header: Header, response: &Response<'_>) -> Option<Own> {
        let unit = self.asked_unit;
        // A drive may answer 255 to 0 (field reports).
        if header.unit != unit && !(unit == 0 && header.unit == DRIVE_UNIT) {
            return Some(Own::WrongUnit);
        }
        let blocks = match self.asked {
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
        (self.refused.1, self.busy_since) = (0, None);
        if blocks.write.is_some() {
            self.refused.0 = 0;
        }
        if blocks.control {
            self.control.replied(i32::from(self.written.control.0));
        }
        if blocks.reference {
            self.reference.replied(self.written.reference);
        }
        let Some(index) = blocks.read else { return };
        let mapping = used(&self.direct, &self.menu_0, self.finding.menu_0);
        let Some(block) = mapping.reads().get(usize::from(index)) else { return };
        read(block, data, &mut self.image, &mut self.native);
        let (control, reference) = (block.has(Role::Control), block.has(Role::Reference));
        let (status, speed) = (block.has(Role::Status), block.has(Role::Speed));
        let with_trip = block.has(Role::Trip);
        self.native.publish(at, self.orders.is_native(), &self.image);
        if control || reference {
            self.compare(at, control, reference, slot);
        } else if blocks.control || blocks.reference {
            self.note_taken(at);
        }
        self.seen = (self.seen.0 || status, self.seen.1 || speed);
        if status {
            self.take_status(at, with_trip);
        }
        if self.seen == (true, true) {
            self.seen = (false, false);
            self.report(at, slot);
        }
    }

    /// The drive has refused a cyclic request.
    fn refuse(&mut self, at: Time, blocks: Blocks, code: ExceptionCode) {
        match code {
            ExceptionCode::ACKNOWLEDGE | ExceptionCode::BUSY => {
                self.busy_since.get_or_insert(at);
            }
            ExceptionCode::FUNCTION if blocks.write.is_some() && blocks.read.is_some() => {
                self.finding.read_write = false;
            }
            _ => {
                self.refused.0 += u32::from(blocks.write.is_some());
                self.refused.1 += u32::from(blocks.read.is_some());
            }
        }
    }

    /// The drive has written so many registers.
    fn written(&mut self, at: Time, blocks: Blocks, count: u16, slot: &mut Slot) {
        (self.refused.0, self.busy_since) = (0, None);
        let block = blocks.write.and_then(|index| self.mapping().writes().get(usize::from(index)));
        if block.is_some_and(|block| count < block.registers) {
            Own::WrittenShort.count(&mut slot.counters);
            return self.orders.not_taken(at);
        }
        if blocks.control {
            self.control.confirm(i32::from(self.written.control.0));
        }
        if blocks.reference {
            self.reference.confirm(self.written.reference);
        }
        self.note_taken(at);
    }

    /// What was read back against what was written.
    fn compare(&mut self, at: Time, control: bool, reference: bool, slot: &mut Slot) {
        let word = self.image.of(Role::Control).filter(|_| control).map(|count| i32::from(count as u16));
        let speed = self.image.of(Role::Reference).filter(|_| reference);
        let wrong_control = word.is_some_and(|word| self.control.read(word));
        let wrong_reference = speed.is_some_and(|speed| self.reference.read(speed));
        self.note_taken(at);
        if wrong_control || wrong_reference {
            Own::NotTaken.count(&mut slot.counters);
            self.orders.not_taken(at);
        }
    }

    /// What the drive has taken by now.
    fn note_taken(&mut self, at: Time) {
        let control = self.control.taken().map(|count| ControlWord(count as u16));
        if control.is_some() && control != self.inputs.control {
            self.control_taken = control;
            self.inputs.control_since = at;
        }
        self.inputs.control = control;
        self.inputs.reference = self.reference.taken();
    }

    /// A new status; `named`: the number of a trip came with it.
    fn take_status(&mut self, at: Time, named: bool) {
        let Some(status) = self.image.of(Role::Status).map(|raw| StatusWord(raw as u16)) else { return };
        if status.healthy() {
            // That of the last time.
            self.forget_trip();
        } else {
            if self.inputs.tripped_at.is_none() && !named {
                // What was read before this trip is that of another one.
                self.forget_trip();
            }
            self.inputs.tripped_at.get_or_insert(at);
        }
        let number = self.image.of(Role::Trip);
        let inputs = &mut self.inputs;
        (inputs.seen, inputs.fresh, inputs.status) = (true, true, status);
        inputs.trip = number.unwrap_or(0) as u16;
        inputs.named = number.is_some() || !self.tells_trips;
        // It has taken that it is to run; before, what it did is no answer to that.
        let running =
            self.orders.runs() && self.inputs.control.is_some_and(|word| word.has_any(ControlWord::ANY_RUN));
        self.was_active = running && (self.was_active || status.active());
        self.inputs.dark = running
            && status.healthy()
            && !status.active()
            && (self.was_active || self.orders.should_be_active(at, &self.inputs));
        if self.inputs.dark {
            self.dark_at = Some(at);
        }
    }

    /// What the drive said, in user units: a status and a speed that were both read since the last report.
    fn report(&mut self, at: Time, slot: &mut Slot) {
        let velocity = f64::from(self.image.of(Role::Speed).unwrap_or(0)) * self.velocity_per_count;
        self.inputs.velocity = velocity;
        let status = self.inputs.status;
        let was_dark = self.dark_at.is_some_and(|dark_at| at.since(dark_at) < DARK_NS);
        let report = &mut slot.report;
        report.fresh = true;
        report.at = at;
        report.suspect = false;
        report.inhibited = was_dark && !status.active();
        report.state = self.orders.state(status, report.inhibited);
        report.moving = status.active() && !status.zero_speed();
        report.in_target = status.at_speed();
        report.velocity = velocity;
        (report.position, report.demand, report.current) = (f64::NAN, f64::NAN, f64::NAN);
        report.warning = u32::from(status.0 & StatusWord::WARNINGS);
        report.fault = if status.healthy() { 0 } else { u32::from(self.inputs.trip) };
        for (channel, shown) in self.shown.iter().enumerate() {
            let Some(counts) = shown else { continue };
            let count = self.image.get(Role::FIRST_SHOWN + channel);
            report.monitor[channel] = count.map(|count| f64::from(count) / counts);
            report.monitor_fresh = true;
        }
    }

    fn forget_trip(&mut self) {
        if let Some(place) = Role::Trip.index() {
            self.image.take(place);
        }
        (self.inputs.trip, self.inputs.tripped_at) = (0, None);
    }
}

/// After so many references in a row the control word has its turn again, for the drive's watchdogs.
pub(super) const REFERENCES_IN_A_ROW: u32 = 8;

const GARBAGE: Why = "what came is no Modbus";

/// The blocks that the drive is asked by: those of menu 0 where it shows them there.
#[inline]
fn used<'a>(direct: &'a Mapping, menu_0: &'a Option<Mapping>, in_menu_0: bool) -> &'a Mapping {
    menu_0.as_ref().filter(|_| in_menu_0).unwrap_or(direct)
}

/// Takes the values of a block into the image.
fn read(block: &Block, data: Registers<'_>, image: &mut Image, native: &mut NativePort) {
    if block.in_order {
        return image.set_front(data);
    }
    let mut take = |role: &Role, count: i32| match (role.index(), role) {
        (Some(place), _) => image.set(place, count),
        (None, Role::Also(index)) => native.publish_also(*index, count),
        (None, _) => {}
    };
    match block.width {
        Width::Word => {
            block.roles.iter().zip(data.words()).for_each(|(role, word)| take(role, (word as i16).into()))
        }
        Width::Long => block.roles.iter().zip(data.longs()).for_each(|(role, long)| take(role, long)),
    }
}
