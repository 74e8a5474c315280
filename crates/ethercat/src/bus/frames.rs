//! The frames under way: each is numbered as it is sent, found again by its number as it comes back, and passed to the
//! segment; what comes late, twice or from others is counted.

use super::EthercatBus;
use super::endpoints::{DriveEnd, Endpoints};
use super::notes::WireNote;
use crate::counters::Own;
use crate::image::{Mark, Read};
use crate::segment::{Back, Sent};
use crate::wire::frame::{self, FrameError, datagrams};
use fieldbeat_core::bus::{Counters, Cycle, Slot};
use fieldbeat_core::net::frames::Unsent;
use fieldbeat_core::time::Time;

/// Frames that are remembered: one that comes back later is unknown.
pub(super) const KNOWN: usize = 256;
/// The most frames taken in at once beyond those that are due.
const MORE_AT_ONCE: usize = 4;
/// The number of cycles in a row without a returned frame that are reported as a fault of the wire.
const SILENT: u8 = 100;

/// A frame that was sent.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SentFrame {
    pub(super) number: Option<u32>,
    pub(super) frame: u8,
    pub(super) answered: bool,
}

/// A frame of the image: sent and not yet back, back, or not sent at all.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Flight {
    pub(super) number: u32,
    pub(super) sent: Option<Sent>,
    pub(super) back: bool,
}

impl EthercatBus {
    /// Takes in what has come, up to a bounded amount. Once all sent frames are back, nothing more is waited for,
    /// and the socket is not read again: that would be a system call in each cycle. Further frames are taken in
    /// with the next ones.
    pub(super) fn take_in(&mut self, in_window: bool, slots: &mut [Slot]) {
        for _ in 0..self.flights.len() + MORE_AT_ONCE {
            let Some((at, length)) = self.net.receive(&mut self.room) else { return };
            self.take(at, length, in_window, slots);
            if self.is_back() {
                return;
            }
        }
    }

    /// All frames that were sent last were sent, and are back.
    pub(super) fn is_back(&self) -> bool {
        self.missing == 0
    }

    /// The frames that are not back by now do not count any more.
    pub(super) fn lose(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        for number in 0..self.flights.len() {
            if !self.flights[number].back {
                let (drives, devices) = (&mut self.drives[..], &mut self.devices[..]);
                self.segment.lost(cycle.grid, number == 0, &mut Endpoints { drives, devices, slots });
                self.prepared &= number != 0;
            }
        }
        if !self.flights.iter().any(|flight| flight.back) {
            self.silent = self.silent.saturating_add(1);
            if self.silent >= SILENT {
                let is_other = self.other.is_there(cycle.grid);
                self.wire.set(0, if is_other { WireNote::OtherMaster } else { WireNote::NothingBack });
            }
        }
    }

    /// One frame.
    fn take(&mut self, at: Time, length: usize, in_window: bool, slots: &mut [Slot]) {
        // Taken out of the bus while it is read.
        let room = std::mem::take(&mut self.room);
        match room.get(..length) {
            Some(received) => self.sort(at, received, in_window, slots),
            // Longer than any frame.
            None => self.unmatched.datagrams += 1,
        }
        self.room = room;
    }

    /// The sender of a frame, and its number.
    fn sort(&mut self, at: Time, received: &[u8], in_window: bool, slots: &mut [Slot]) {
        let number = match own_number(received, &self.source, self.mark.master) {
            Ok(number) => number,
            Err(sender) => return self.take_unknown(sender, at, received, slots),
        };
        let place = number as usize % KNOWN;
        let known = self.known[place];
        if known.number != Some(number) {
            return self.count(None, slots, |counters| counters.foreign += 1);
        }
        let frame = usize::from(known.frame);
        if known.answered {
            return self.count(Some(frame), slots, |counters| counters.duplicate += 1);
        }
        let flight = &self.flights[frame];
        let Some(sent) = flight.sent.filter(|_| flight.number == number) else {
            self.known[place].answered = true;
            return self.count(Some(frame), slots, |counters| counters.late += 1);
        };
        match self.image.frames()[frame].read(received) {
            Read::Good(counter) => {
                self.known[place].answered = true;
                (self.flights[frame].sent, self.flights[frame].back) = (None, true);
                self.missing -= 1;
                self.silent = 0;
                let is_other = self.other.is_there(at);
                self.wire.set(0, if is_other { WireNote::OtherMaster } else { WireNote::None });
                if !in_window {
                    // Too late for the exchanges of the drives, but not for what proceeds step by step.
                    self.count_late(frame, &sent, slots);
                }
                let image = &self.image.frames()[frame];
                let back = Back { sent: &sent, frame: image, at, received, counter, in_window };
                let (drives, devices) = (&mut self.drives[..], &mut self.devices[..]);
                self.segment.receive(&back, frame, &mut Endpoints { drives, devices, slots });
                if std::mem::take(&mut self.segment.lowered) {
                    other_master(slots);
                }
            }
            Read::Circulated => self.count(Some(frame), slots, |counters| Own::Circulated.count(counters)),
            Read::Other => self.count(Some(frame), slots, |counters| counters.malformed += 1),
        }
    }

    /// Counts such a frame, and looks whether another master sends them.
    #[cold]
    fn take_unknown(&mut self, sender: UnknownSender, at: Time, received: &[u8], slots: &mut [Slot]) {
        match sender {
            UnknownSender::Foreign => self.unmatched.datagrams += 1,
            UnknownSender::Unknown => self.count(None, slots, |counters| counters.foreign += 1),
            // Its frame cannot be identified.
            UnknownSender::Broken => self.count(None, slots, |counters| counters.malformed += 1),
        }
        if self.other.see(at, received) {
            other_master(slots);
        }
    }

    /// Counts something of each drive and device in a frame; of all of them, if the frame is unknown. Of a device only
    /// what this protocol counts for itself is kept.
    #[cold]
    fn count(&self, frame: Option<usize>, slots: &mut [Slot], count: impl Fn(&mut Counters)) {
        let mut of_device = Counters::default();
        count(&mut of_device);
        for device in &self.devices {
            if device.operational && frame.is_none_or(|frame| frame == device.offsets.frame) {
                device.counters.add(&of_device);
            }
        }
        for ((slot, drive), out) in slots.iter_mut().zip(&self.drives).zip(&self.outgoing) {
            if frame.is_none_or(|frame| frame == usize::from(out.frame))
                && self.segment.is_operational(drive.slave)
            {
                count(&mut slot.counters);
            }
        }
    }

    /// Counts frame `number`, which came after its window, as late for the drives of its exchanges.
    #[cold]
    fn count_late(&self, number: usize, sent: &Sent, slots: &mut [Slot]) {
        for ((slot, drive), out) in slots.iter_mut().zip(&self.drives).zip(&self.outgoing) {
            let was_sent = usize::from(out.frame) == number && drive.station.sent_grid == sent.cycle.grid;
            if was_sent && self.segment.is_operational(drive.slave) {
                slot.counters.late += 1;
            }
        }
    }

    /// Completes the first frame, once nothing of the one before is under way.
    pub(super) fn finish(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.segment.left = !self.ending && self.other.is_there(cycle.grid);
        if let Some(first) = self.image.frames_mut().first_mut() {
            let (drives, devices) = (&mut self.drives[..], &mut self.devices[..]);
            self.segment.prepare(cycle, first, &mut Endpoints { drives, devices, slots });
        }
        self.prepared = true;
    }

    /// Opens the exchanges of the drives that are due with frame `number`.
    pub(super) fn requested(
        &mut self,
        number: usize,
        sent_at: Option<Time>,
        cycle: &Cycle,
        slots: &mut [Slot],
    ) {
        let drives = self.drives.iter_mut().zip(&mut self.outgoing).zip(slots);
        let drives = drives.filter(|((_, out), slot)| slot.due && usize::from(out.frame) == number);
        if let Some(sent_at) = sent_at.filter(|_| self.segment.is_settled()) {
            for ((drive, out), slot) in drives {
                out.built = false;
                drive.station.sent(sent_at, cycle.deadline, slot);
            }
            return;
        }
        for ((DriveEnd { station, slave }, out), slot) in drives {
            out.built = sent_at.is_none();
            let is_requested = self.segment.is_operational(*slave);
            match sent_at.filter(|_| is_requested) {
                Some(sent_at) if self.segment.outputs_count(*slave) => {
                    station.sent(sent_at, cycle.deadline, slot);
                }
                Some(sent_at) => station.open(sent_at, cycle.deadline, slot),
                None => {
                    // The silence of a slave that is being shut down is expected.
                    slot.expected_silence |= self.ending;
                    station.unsent(slot);
                }
            }
        }
    }

    /// Sends frame `number`.
    pub(super) fn send_frame(&mut self, number: usize, cycle: &Cycle) -> Option<Time> {
        let frame = &mut self.image.frames_mut()[number];
        frame.load_outputs();
        let mark = self.mark;
        self.mark.number = mark.number.wrapping_add(1);
        frame.number(mark);
        if number == 0 {
            let now = self.net.now();
            let clock = &mut self.segment.clock;
            frame.set_time(clock.sent_time(cycle, now));
            clock.lead_on();
        }
        let sent = self.net.send(frame.bytes());
        if sent.is_err() {
            frame.unload_outputs();
        }
        if sent == Err(Unsent::Down) {
            self.wire.set(0, WireNote::Down);
        }
        let sent_at = sent.ok();
        let sent = sent_at.map(|at| Sent { cycle: *cycle, at });
        self.flights[number] = Flight { number: mark.number, sent, back: false };
        let known = SentFrame { number: sent_at.map(|_| mark.number), frame: number as u8, answered: false };
        self.known[mark.number as usize % KNOWN] = known;
        sent_at
    }
}

/// A frame that is not one of this master's last frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum UnknownSender {
    /// Of an unknown sender.
    Foreign,
    /// From here, but not of this master.
    Unknown,
    /// Of this master, but broken.
    Broken,
}

/// The number of a frame that this master has sent.
fn own_number(received: &[u8], source: &[u8; 6], master: u32) -> Result<u32, UnknownSender> {
    if frame::source(received) != Some(*source) {
        return Err(UnknownSender::Foreign);
    }
    match Mark::of(received) {
        Some(mark) if mark.master == master => Ok(mark.number),
        Some(_) => Err(UnknownSender::Unknown),
        None => match datagrams(received) {
            Err(FrameError::Foreign) => Err(UnknownSender::Foreign),
            _ => Err(UnknownSender::Broken),
        },
    }
}

/// Another master has frames on the segment of these drives.
#[cold]
#[inline(never)]
fn other_master(slots: &mut [Slot]) {
    slots.iter_mut().for_each(|slot| slot.notices.other_master = true);
}
