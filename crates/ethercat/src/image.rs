//! The process data of a segment, and the frames that carry them: built once; only their contents change from cycle
//! to cycle.
//!
//! | first frame | the others |
//! |---|---|
//! | clock: the reference's time to all, followed by ours to the reference if the reference follows the grid | |
//! | process data of the first slaves: outputs, then AL status and inputs of each | those of the next slaves |
//! | states of all slaves, or-ed | |
//! | the acyclic slot, of two datagrams at most | |
//!
//! The input area leaves the master as zeros. A slave that takes part puts its AL status there, which is never
//! zero: one working counter for all slaves does not show which one is missing, the AL status does.

use std::ops::Range;

use super::plan::{Owner, SlavePlan};
use super::slot::{Answer, Answers, Ask};
use super::wire::frame::{
    BROADCAST, Builder, CIRCULATED, Command, DATA_MAX, DATAGRAM_HEADER, FRAME_MAX, HEADER, Mac, Place, Stem,
    WORKING_COUNTER, datagrams, first_datagram, set_command, set_index,
};
use super::wire::registers::address;
use fieldbeat_core::rt::Regions;

/// The logical address space of one master: each frame has a piece of its own in it.
const FRAME_SPACE: u32 = 0x1000;
/// The sender of a frame, and its number: in a datagram that no slave touches, before all others.
const MARK_SIZE: usize = 8;
const MARK_AT: usize = HEADER + DATAGRAM_HEADER;
/// Bytes of an AL status in the image.
pub const AL_SIZE: usize = 2;
/// Bytes of the time of a segment: the lower half, which every clock has.
const TIME_SIZE: usize = 4;
/// Bytes of clock, states and slot in the first frame, besides the process data.
const FIRST_OVERHEAD: usize = 2 * (12 + TIME_SIZE) + 14 + 2 * 12 + super::slot::ROOM;
/// Bytes of the mark in each frame.
const MARK_OVERHEAD: usize = 12 + MARK_SIZE;
/// The most datagrams of a frame: mark, clock, time, process data in two, states, and the slot.
const PLACES: usize = 6 + super::slot::DATAGRAMS;
/// The header of a second datagram of process data.
const SPLIT_OVERHEAD: usize = 12;

/// The offsets of the process data of one slave: bytes of its frame, and logical addresses.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Offsets {
    /// The index of the frame.
    pub frame: usize,
    /// The outputs.
    pub outputs: Range<u16>,
    /// The AL status.
    pub al: usize,
    /// The inputs.
    pub inputs: Range<usize>,
    /// The same in the logical address space.
    pub logical: Logical,
}

/// Logical addresses of a slave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Logical {
    /// Of its outputs.
    pub outputs: u32,
    /// Of its AL status.
    pub al: u32,
    /// Of its inputs.
    pub inputs: u32,
}

/// All frames of a segment.
#[derive(Debug)]
pub struct Image {
    frames: Box<[Frame]>,
}

/// One frame.
#[derive(Debug)]
pub struct Frame {
    bytes: Box<[u8; FRAME_MAX]>,
    /// The outputs of the next send, at the same offsets.
    next: Box<[u8; FRAME_MAX]>,
    /// The outputs of the last send.
    sent: Box<[u8]>,
    outputs: Range<usize>,
    length: usize,
    stem: Stem,
    /// The reference's time for all, and ours for the reference.
    clock: Option<[Place; 2]>,
    /// LRW; or LWR and LRD.
    data: Place,
    read: Option<Place>,
    states: Option<Place>,
    slot: [Option<Place>; super::slot::DATAGRAMS],
    /// Where the datagrams begin, in their order: so many, the first ones permanent. No slave changes the addresses of
    /// the first `staying` ones; states and slot come last, and may be addressed by positions.
    headers: [u16; PLACES],
    count: usize,
    fixed: usize,
    staying: usize,
    /// The end of the last one.
    end: usize,
    logical: u32,
}

/// The sender of a frame, and the number of the frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mark {
    /// Identifies the master.
    pub master: u32,
    /// Counts its frames.
    pub number: u32,
}

impl Mark {
    /// As in its datagram.
    #[inline]
    pub fn bytes(self) -> [u8; MARK_SIZE] {
        (u64::from(self.number) << 32 | u64::from(self.master)).to_le_bytes()
    }

    /// The mark of a received frame; `None`: it has none.
    pub fn of(received: &[u8]) -> Option<Mark> {
        let (number, bytes) = first_datagram::<MARK_SIZE>(received)?;
        let [a, b, c, d, e, f, g, h] = *Some(bytes).filter(|_| number == Command::Nop.number())?;
        Some(Mark { master: u32::from_le_bytes([a, b, c, d]), number: u32::from_le_bytes([e, f, g, h]) })
    }
}

/// The result of comparing a returned frame, or a datagram of it, with the sent one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Read {
    /// It is the sent one; the working counter of it, or of its process data.
    Good(u16),
    /// It is the sent one, but circulated without passing the master.
    Circulated,
    /// It is another one.
    Other,
}

impl Image {
    /// The image of these slaves, in their order on the segment, and the offsets of each: logical addresses from
    /// `base` on. `None`: one of them does not fit into a frame.
    pub fn new(
        slaves: &[(Owner, &SlavePlan)],
        base: u32,
        source: Mac,
        clock: bool,
        lrw: bool,
    ) -> Option<(Image, Vec<Offsets>)> {
        let (mut frames, mut offsets) = (Vec::new(), Vec::new());
        let mut rest = slaves;
        while !rest.is_empty() || frames.is_empty() {
            let overhead = if frames.is_empty() { FIRST_OVERHEAD } else { 0 };
            let room = DATA_MAX - MARK_OVERHEAD - overhead - if lrw { 0 } else { SPLIT_OVERHEAD };
            let count = fitting(rest, room);
            if count == 0 && !rest.is_empty() {
                return None;
            }
            let (these, others) = rest.split_at(count);
            let logical = base.wrapping_add(frames.len() as u32 * FRAME_SPACE);
            let first = frames.is_empty();
            let frame = Frame::new(first, these, logical, source, clock && first, lrw)?;
            offsets.extend(frame.offsets(frames.len(), these));
            frames.push(frame);
            rest = others;
        }
        Some((Image { frames: frames.into() }, offsets))
    }

    /// Adds what it touches besides itself, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.frames);
        for frame in &self.frames {
            regions.add(&*frame.bytes);
            regions.add(&*frame.next);
            regions.add(&*frame.sent);
        }
    }

    /// The frames, the first one with clock, states and slot.
    pub fn frames(&self) -> &[Frame] {
        &self.frames
    }

    /// The same, to be changed.
    pub fn frames_mut(&mut self) -> &mut [Frame] {
        &mut self.frames
    }
}

/// How many of these slaves fit into so many bytes.
fn fitting(slaves: &[(Owner, &SlavePlan)], room: usize) -> usize {
    let sums = slaves.iter().scan(0, |sum, (_, slave)| {
        *sum += slave.output_bytes() + AL_SIZE + slave.input_bytes();
        Some(*sum)
    });
    sums.take_while(|sum| *sum <= room).count()
}

impl Frame {
    fn new(
        first: bool,
        slaves: &[(Owner, &SlavePlan)],
        logical: u32,
        source: Mac,
        clock: bool,
        lrw: bool,
    ) -> Option<Frame> {
        let mut bytes = Box::new([0; FRAME_MAX]);
        let outputs: usize = slaves.iter().map(|(_, slave)| slave.output_bytes()).sum();
        let inputs: usize = slaves.iter().map(|(_, slave)| AL_SIZE + slave.input_bytes()).sum();
        let mut builder = Builder::new(&mut *bytes, BROADCAST, source)?;
        let nop = |builder: &mut Builder<'_>, length| builder.push(Command::Nop, 0, length);
        let mark = nop(&mut builder, MARK_SIZE)?;
        let clock = match clock {
            true => Some([nop(&mut builder, TIME_SIZE)?, nop(&mut builder, TIME_SIZE)?]),
            false => None,
        };
        let (data, read) = if lrw {
            (builder.push(Command::Lrw(logical), 0, outputs + inputs)?, None)
        } else {
            let behind = logical + outputs as u32;
            let data = builder.push(Command::Lwr(logical), 0, outputs)?;
            (data, Some(builder.push(Command::Lrd(behind), 0, inputs)?))
        };
        let states = if first { Some(builder.push(Command::Brd(address::AL_STATUS), 0, 2)?) } else { None };
        let stem = builder.stem();
        let length = builder.finish();
        let begin = data.data().start;
        let mut headers = [0; PLACES];
        let stay = [mark].into_iter().chain(clock.into_iter().flatten()).chain([data]).chain(read);
        let staying = headers.iter_mut().zip(stay).map(|(header, place)| *header = place.at as u16).count();
        let fixed = staying + usize::from(first);
        if let Some(states) = states {
            headers[staying] = states.at as u16;
        }
        Some(Frame {
            headers,
            count: fixed,
            fixed,
            staying,
            end: states.or(read).unwrap_or(data).end(),
            next: bytes.clone(),
            sent: vec![0; outputs].into(),
            outputs: begin..begin + outputs,
            bytes,
            length,
            stem,
            clock,
            data,
            read,
            states,
            slot: [None; super::slot::DATAGRAMS],
            logical,
        })
    }

    /// The offsets of each of its slaves.
    fn offsets(&self, frame: usize, slaves: &[(Owner, &SlavePlan)]) -> Vec<Offsets> {
        let outputs: usize = slaves.iter().map(|(_, slave)| slave.output_bytes()).sum();
        // Inputs follow the outputs, in the same datagram or in the next one.
        let behind = self.read.map_or(self.data.data().start + outputs, |read| read.data().start);
        let (mut out, mut input) = (0, 0);
        let offsets = |(_, slave): &(Owner, &SlavePlan)| {
            let (wide, deep) = (slave.output_bytes(), slave.input_bytes());
            let begin = self.data.data().start + out;
            let al = behind + input;
            let at = |offset: usize| self.logical + offset as u32;
            let logical =
                Logical { outputs: at(out), al: at(outputs + input), inputs: at(outputs + input + AL_SIZE) };
            out += wide;
            input += AL_SIZE + deep;
            Offsets {
                frame,
                outputs: begin as u16..(begin + wide) as u16,
                al,
                inputs: al + AL_SIZE..al + AL_SIZE + deep,
                logical,
            }
        };
        slaves.iter().map(offsets).collect()
    }

    /// The bytes to send.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }

    /// The next outputs in this range, which is that of a slave: they stay until others are written there.
    #[inline]
    pub fn outputs(&mut self, range: &Range<u16>) -> Option<&mut [u8]> {
        self.next.get_mut(range.start.into()..range.end.into())
    }

    /// The outputs in this range that left last, as long as no newer ones are loaded.
    #[inline]
    pub fn sent_outputs(&self, range: &Range<u16>) -> &[u8] {
        self.bytes.get(range.start.into()..range.end.into()).unwrap_or_default()
    }

    /// The next outputs there are the previous ones.
    pub fn keep_outputs(&mut self, range: &Range<u16>) {
        let range = usize::from(range.start)..usize::from(range.end);
        if let (Some(next), Some(sent)) = (self.next.get_mut(range.clone()), self.bytes.get(range)) {
            next.copy_from_slice(sent);
        }
    }

    /// Puts the next outputs of all into the frame.
    #[inline]
    pub fn load_outputs(&mut self) {
        let range = self.outputs.clone();
        self.sent.copy_from_slice(&self.bytes[range.clone()]);
        self.bytes[range.clone()].copy_from_slice(&self.next[range]);
    }

    /// The frame was not sent: the outputs in it are the previous ones again.
    pub fn unload_outputs(&mut self) {
        self.bytes[self.outputs.clone()].copy_from_slice(&self.sent);
    }

    /// The slave with this station address is the reference from now on. `to_all`: its time goes to all others,
    /// otherwise it is only read; `follows`: it receives our time.
    pub fn refer_to(&mut self, station: Option<u16>, to_all: bool, follows: bool) {
        let Some([clock, time]) = self.clock else { return };
        let mut set = |place, command| set_command(&mut *self.bytes, place, command);
        match station {
            Some(station) if to_all => set(clock, Command::Frmw(station, address::DC_TIME)),
            Some(station) => set(clock, Command::Fprd(station, address::DC_TIME)),
            None => set(clock, Command::Nop),
        }
        match station.filter(|_| follows) {
            Some(station) => set(time, Command::Fpwr(station, address::DC_TIME)),
            None => set(time, Command::Nop),
        }
    }

    /// The reference receives our time.
    #[inline]
    pub fn is_followed(&self) -> bool {
        self.clock.is_some_and(|[_, time]| self.bytes[time.at] != Command::Nop.number())
    }

    /// Our time for the reference; and for all, if the reference is absent and cannot replace it with its own.
    pub fn set_time(&mut self, ns: u64) {
        let Some(places) = self.clock else { return };
        for Place { at, .. } in places {
            let place = self.bytes.get_mut(at + DATAGRAM_HEADER..).and_then(<[u8]>::first_chunk_mut);
            if let Some(place) = place {
                *place = (ns as u32).to_le_bytes();
            }
        }
    }

    /// Puts the request into the slot, replacing the previous one.
    #[inline]
    pub fn request(&mut self, ask: &Ask) {
        if !ask.is_empty() || self.slot[0].is_some() {
            self.replace_request(ask);
        }
    }

    fn replace_request(&mut self, ask: &Ask) {
        (self.slot, self.count) = ([None; super::slot::DATAGRAMS], self.fixed);
        self.end = self.states.map_or(self.end, Place::end);
        let Some(mut builder) = Builder::resume(&mut *self.bytes, self.stem) else { return };
        for (slot, (command, data)) in self.slot.iter_mut().zip(ask.datagrams()) {
            *slot = builder.push_with(command, 0, data);
            if let (Some(header), Some(place)) = (self.headers.get_mut(self.count), *slot) {
                (*header, self.end) = (place.at as u16, place.end());
                self.count += 1;
            }
        }
        self.length = builder.finish();
    }

    /// Makes it the frame with this number of this master.
    pub fn number(&mut self, mark: Mark) {
        self.bytes[MARK_AT..MARK_AT + MARK_SIZE].copy_from_slice(&mark.bytes());
        for at in &self.headers[..self.count] {
            set_index(&mut *self.bytes, Place { at: usize::from(*at), length: 0 }, mark.number as u8);
        }
    }

    /// Compares a received frame with this one, which was sent.
    #[inline]
    pub fn read(&self, received: &[u8]) -> Read {
        let (Some(sent), Some(whole)) = (self.bytes.get(..self.end), received.get(..self.end)) else {
            return self.read_other(received);
        };
        let (stay, counted) = self.headers();
        let changes =
            |headers: &[u16]| headers.iter().fold(0, |all, at| all | change(sent, whole, usize::from(*at)));
        if changes(stay) | changes(counted) & !POSITION != 0 {
            return self.read_other(received);
        }
        let counter = |place: Place| {
            let counter = whole.get(place.data().end..).and_then(<[u8]>::first_chunk);
            counter.map_or(0, |counter| u16::from_le_bytes(*counter))
        };
        Read::Good(counter(self.data).saturating_add(self.read.map_or(0, counter)))
    }

    /// The same of one that is another one: the first datagram that is decides.
    #[cold]
    fn read_other(&self, received: &[u8]) -> Read {
        let places = datagrams(self.bytes()).into_iter().flatten().map_while(Result::ok);
        let mut reads = places
            .enumerate()
            .map(|(index, datagram)| returned(&*self.bytes, received, datagram.place, index < self.staying));
        reads.find(|read| !matches!(read, Read::Good(_))).unwrap_or(Read::Other)
    }

    /// Where the datagrams begin whose addresses no slave changes, and all others.
    #[inline]
    fn headers(&self) -> (&[u16], &[u16]) {
        self.headers[..self.count].split_at(self.staying)
    }

    /// The time of the reference in a frame that was read, if the reference took part: otherwise the other slaves
    /// count the datagram, and it has what was sent.
    pub fn time_of(&self, received: &[u8]) -> Option<u32> {
        let [Place { at, .. }, _] = self.clock?;
        let answer =
            received.get(at + DATAGRAM_HEADER..)?.first_chunk::<{ TIME_SIZE + WORKING_COUNTER }>()?;
        let [a, b, c, d, counter @ ..] = *answer;
        let is_shown = counter != [0; WORKING_COUNTER] && self.bytes[at] != Command::Nop.number();
        is_shown.then_some(u32::from_le_bytes([a, b, c, d]))
    }

    /// How many slaves took part in a frame that was read: all of them have an AL status.
    pub fn slaves_in(&self, received: &[u8]) -> u16 {
        let states = self.states.and_then(|place| answer(received, place));
        states.map_or(0, |states| states.working_counter)
    }

    /// The answers of the slot.
    pub fn answers_of<'a>(&self, received: &'a [u8]) -> Answers<'a> {
        self.slot.map(|place| answer(received, place?))
    }
}

/// The bit of `CIRCULATED` in the first eight bytes of a datagram.
const WENT_ROUND: u64 = (CIRCULATED as u64) << 48;
/// The two lower bytes of the address there, in which a position is counted up.
const POSITION: u64 = 0xFFFF << 16;

/// The difference in the first eight bytes of a datagram: all that no slave changes has to be the same.
#[inline]
fn change(sent: &[u8], received: &[u8], at: usize) -> u64 {
    let header = |frame: &[u8]| Some(u64::from_le_bytes(*frame.get(at..at + 8)?.first_chunk()?));
    header(sent).zip(header(received)).map_or(u64::MAX, |(sent, received)| sent ^ received)
}

/// Compares the datagram at `place` of a received frame with the one sent there. `stays`: its address is not counted up
/// by the slaves.
pub fn returned(sent: &[u8], received: &[u8], place: Place, stays: bool) -> Read {
    let counter = received.get(place.data().end..).and_then(<[u8]>::first_chunk);
    let Some(counter) = counter else { return Read::Other };
    match change(sent, received, place.at) & if stays { u64::MAX } else { !POSITION } {
        0 => Read::Good(u16::from_le_bytes(*counter)),
        WENT_ROUND => Read::Circulated,
        _ => Read::Other,
    }
}

fn answer(received: &[u8], place: Place) -> Option<Answer<'_>> {
    let data = received.get(place.data())?;
    let counter = received.get(place.data().end..place.end())?;
    Some(Answer { working_counter: u16::from_le_bytes(counter.try_into().ok()?), data })
}
