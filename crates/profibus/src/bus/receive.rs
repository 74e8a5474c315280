//! What arrives: answers go to their stations, the rest is counted for whom it concerns.

use super::ProfibusBus;
use crate::counters::Own;
use crate::line::{Answer, Incoming, Job, Other, Unrelated};
use crate::other::Sign;
use crate::station::Station;
use fieldbeat_core::bus::Slot;
use fieldbeat_core::time::{S, Time};

/// Readings of the port in one call, and telegrams in one reading: what does not fit waits for the next one.
const MOST_READS: usize = 4;
const MOST_TELEGRAMS: usize = 32;
/// A wire that is not silent for long enough within this time is noisy, ns.
const NOISY_NS: u64 = 2 * S;
/// After something that answers nothing, or a silent slot time, the wire is looked at before anything is sent, for so
/// many cycles. Otherwise what arrives is seen with the next answer, which it cannot be taken for.
pub(super) const WATCHFUL: u16 = 1_000;

impl ProfibusBus {
    /// Takes in what has arrived before something is sent, unless nothing is likely to have.
    #[inline]
    pub(super) fn look(&mut self, slots: &mut [Slot]) {
        if self.always_looks || self.watchful > 0 || !self.line.is_free() {
            self.take_in(slots);
        }
    }

    /// Takes in what has arrived.
    pub(super) fn take_in(&mut self, slots: &mut [Slot]) {
        for _ in 0..MOST_READS {
            let room = self.line.room();
            let size = room.len();
            match self.net.receive(0, room) {
                Ok(None) => return,
                Ok(Some((at, count))) => {
                    self.line.received(at, count);
                    self.hear(at, slots);
                    // A whole telegram, and no more of it.
                    if count < size {
                        return;
                    }
                }
                Err(broken) => return self.broken(broken, slots),
            }
        }
    }

    /// Takes in what has arrived by `at`, telegram by telegram.
    #[inline]
    fn hear(&mut self, at: Time, slots: &mut [Slot]) {
        for _ in 0..MOST_TELEGRAMS {
            match self.line.incoming(at) {
                None => return,
                Some(Incoming::Answer(Job::Drive(index), answer)) => {
                    let place = usize::from(index);
                    if let (Some(station), Some(slot)) = (self.stations.get_mut(place), slots.get_mut(place))
                    {
                        let bytes = if let Answer::Data { data, .. } = answer { data.len() } else { 0 };
                        let has_changed = station.answered(at, answer, slot);
                        let took_ns = self.line.took_ns(self.began_at, bytes);
                        slot.counters.own[Own::WireUs as usize] += took_ns / 1_000;
                        if has_changed {
                            self.changed(index);
                        }
                    }
                }
                Some(Incoming::Answer(Job::Own | Job::Gap(_), _)) => {}
                Some(Incoming::Other(other)) => self.unusual(other, slots),
            }
            if self.line.is_read() {
                return;
            }
        }
    }

    /// A drive has come a step further in its start-up, or begins it.
    #[cold]
    pub(super) fn changed(&mut self, index: u8) {
        let Some(station) = self.stations.get(usize::from(index)) else { return };
        let bit = 1_u128 << (index & 0x7F);
        self.starting = if station.starts() { self.starting | bit } else { self.starting & !bit };
        if let Some(note) = station.note() {
            self.notes.set(index.into(), note, station.wanted());
        }
        if station.exchanges() && station.starts() {
            // Its outputs count from the next Global_Control on, which waits for the others that are due.
            self.upkeep.operate(Some(self.grid));
        }
    }

    /// Something arrived that answers nothing. It counts for its sender, or for the drive whose turn was last.
    #[cold]
    fn unusual(&mut self, other: Other, slots: &mut [Slot]) {
        self.watchful = WATCHFUL;
        let station_at = |address: u8| self.stations.iter().position(|station| station.address() == address);
        let sender = match other {
            Other::Unrelated(_, Some(address)) => station_at(address),
            _ => None,
        };
        let place = sender.unwrap_or(self.last.into());
        let again = self.stations.get(place).is_some_and(Station::was_answered);
        // An own station that still owes an answer, in the turn of another one.
        let other = match other {
            Other::Unrelated(Unrelated::Turn, from) if sender.is_some() && !again => {
                Other::Unrelated(Unrelated::Late, from)
            }
            other => other,
        };
        let Some(counters) = slots.get_mut(place).map(|slot| &mut slot.counters) else { return };
        match other {
            Other::Own if self.line.returns() => self.notes.set_returns(),
            Other::Own => {}
            Other::Malformed { why, expected: true } => {
                counters.malformed += 1;
                Own::of(&why).count(counters);
            }
            Other::Malformed { expected: false, .. } => {
                Own::Noise.count(counters);
                self.unmatched.datagrams += 1;
                if !self.line.is_up() && self.grid.since(self.opened_at) > NOISY_NS {
                    self.notes.set_noisy();
                }
            }
            Other::Unrelated(Unrelated::Station | Unrelated::Turn, _) => {
                Own::WrongStation.count(counters);
                counters.foreign += 1;
            }
            Other::Unrelated(Unrelated::Kind, _) => {
                Own::WrongAnswer.count(counters);
                counters.foreign += 1;
            }
            Other::Unrelated(Unrelated::Late, _) => {
                Own::OtherJob.count(counters);
                // It has answered already.
                *(if again { &mut counters.duplicate } else { &mut counters.late }) += 1;
            }
            Other::Master { address, sign } => {
                Own::SecondMaster.count(counters);
                self.unmatched.datagrams += 1;
                self.other_master(address, sign, slots);
            }
        }
    }

    /// A telegram of another master. Before the first own one the wire is its; afterwards it is this master's, and the
    /// axes stop.
    fn other_master(&mut self, address: u8, sign: Sign, slots: &mut [Slot]) {
        if !self.others.received(self.grid, address, sign) {
            return;
        }
        self.notes.set_other(Some(address));
        if self.line.is_up() {
            slots.iter_mut().for_each(|slot| slot.notices.other_master = true);
        }
    }
}
