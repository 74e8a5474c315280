//! The master's view of one drive: whose turn in what it is, the next telegram, and what its answers report.
//!
//! It takes instants and slices, and knows no port. What is desired of the drive becomes outputs in `profile`.
//!
//! Telegrams of the start-up are no exchanges: a slot that is due is unsent until the drive is in Data_Exchange. From
//! then on a turn is Data_Exchange, or in its place a diagnosis that the drive has announced, or an MSAC1 request. A
//! drive that does not answer is sent what is desired of it all the same, since it may be the stop; once its link is
//! lost, a diagnosis takes turns with that, and shows what became of it.

use super::acyclic::{self, Acyclic, Turn};
use super::counters::Own;
use super::line::{Answer, Expected};
use super::native::{Native, NativePort, native};
use super::notes::Note;
use super::plan::{CHANNEL, LenzeDrive};
use super::profile::{Inputs, Profile};
use super::start_up::{StartUp, Step};
use super::target::commanding;
use super::wire::dp::{Diagnosis, DiagnosisStatus, station_status};
use super::wire::sap::Service;
use super::wire::telegram::MAX;
use crate::axis::Link;
use crate::axis::acyclic::{AcyclicEnds, queue};
use crate::axis::feedback::MONITOR_CHANNELS;
use crate::bus::{Cycle, Exchange, Slot};
use crate::rt::Regions;
use crate::time::Time;

/// The function code of Data_Exchange without its count: SRD high.
const SRD_HIGH: u8 = 0x4D;
/// The count bits of a function code: the first request; its FCB is 1, and does not count.
const FIRST: u8 = 0x20;
const FCB: u8 = 0x20;
const SECOND: u8 = 0x10;
/// In the telegram of Data_Exchange: its function code, and its data.
const AT_FC: usize = 6;
const AT_DATA: usize = 7;
/// The code of a fault that the diagnosis does not name: any error (DRIVECOM).
const ANY_ERROR: u16 = 0x1000;
/// So many diagnoses may come without the code of a fault.
const UNNAMED: u8 = 5;
/// A motor turns from this part of its full speed on (assumed): below it is noise of the measurement.
const MOVES_FROM: u16 = 256;
/// Bit 7 of either status word: a warning; bit 10: the set point is reached.
const WARNING: u16 = 1 << 7;
const REACHED: u16 = 1 << 10;

/// What the telegram under way is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sending {
    StartUp,
    DataExchange,
    Diagnosis,
    Msac1,
    Unlock,
}

/// A word of the inputs that is shown.
#[derive(Clone, Copy, Debug)]
struct Shown {
    channel: u8,
    /// Its first byte.
    at: u8,
    signed: bool,
    per_count: f64,
}

/// One drive.
#[derive(Debug)]
#[repr(C, align(64))] // What each exchange touches comes first.
pub struct Station {
    /// The slot of the grid that the outputs are built for.
    grid: Time,
    sending: Sending,
    /// The count bits of the next new telegram.
    count: u8,
    address: u8,
    own: u8,
    /// The outputs have changed since the check byte was made.
    is_changed: bool,
    guarded: bool,
    /// A diagnosis is due.
    diagnosis_due: bool,
    /// The last turn was no Data_Exchange.
    passed_over: bool,
    /// It was in Data_Exchange once, and is not any more.
    was_lost: bool,
    /// Diagnoses since a fault began.
    unnamed: u8,
    process_at: u8,
    set_point_at: u8,
    actual_at: u8,
    inputs_len: u8,
    /// The sum of the telegram without its function code.
    sum: u8,
    /// It moves from so many counts of its actual value on.
    moves_from: u16,
    /// Its last telegram was answered.
    was_answered: bool,
    fault_at: Option<u8>,
    start_up: StartUp,
    velocity_per_count: f64,
    inputs: Inputs,
    /// Data_Exchange as it is sent next.
    telegram: Box<[u8]>,
    pub(super) profile: Profile,
    native: NativePort,
    acyclic: Acyclic,
    shown: Box<[Shown]>,
    unlock: [u8; 7],
}

impl Station {
    /// The station of `drive` of the master at address `own`, and the application's ends of its native process data and
    /// of its acyclic access. `None`: its plan is not free of faults.
    pub fn new(drive: &LenzeDrive, own: u8) -> Option<(Station, Native, AcyclicEnds)> {
        let (application, native) = native();
        let (ends, port) = queue(drive.axis.parameter_queue, commanding());
        let (outputs, inputs) = drive.lengths()?;
        let process_at = drive.process_at();
        let word = |word: u8, length: usize| {
            let at = process_at + 2 * usize::from(word);
            u8::try_from(at).ok().filter(|_| at + 2 <= length)
        };
        word(0, inputs)?;
        word(0, outputs)?;
        let shown = |(channel, shown): (usize, &Option<super::plan::ShownWord>)| {
            let shown = shown.as_ref()?;
            let at = word(shown.word, inputs)?;
            Some(Shown { channel: channel as u8, at, signed: shown.signed, per_count: shown.per_count })
        };
        let scale = drive.counts_per_velocity();
        let [high, low] = drive.ident.to_be_bytes();
        let mut station = Station {
            grid: Time(0),
            sending: Sending::StartUp,
            count: FIRST,
            address: drive.address,
            own,
            is_changed: true,
            guarded: false,
            diagnosis_due: false,
            passed_over: false,
            was_lost: false,
            unnamed: 0,
            process_at: process_at as u8,
            set_point_at: word(drive.scale.set_point, outputs)?,
            actual_at: word(drive.scale.actual, inputs)?,
            inputs_len: u8::try_from(inputs).ok()?,
            sum: 0,
            moves_from: (drive.scale.full_count.unsigned_abs() / MOVES_FROM).max(1),
            was_answered: false,
            fault_at: drive.fault_at,
            start_up: StartUp::new(drive, own)?,
            velocity_per_count: 1.0 / scale,
            inputs: Inputs::default(),
            telegram: vec![0; AT_DATA + outputs + 2].into(),
            profile: Profile::new(drive),
            native,
            acyclic: Acyclic::new(drive, port),
            shown: drive.show.iter().enumerate().take(MONITOR_CHANNELS).filter_map(shown).collect(),
            unlock: [station_status::UNLOCK, 0, 0, 0, high, low, 0],
        };
        let head = Service::DataExchange.head(drive.address, own, false, false);
        let mut room = [0; MAX];
        let length = head.emit_with(&mut room, |data| data.bytes(&station.telegram[AT_DATA..][..outputs]))?;
        station.telegram.copy_from_slice(room.get(..length)?);
        let further = station.telegram[AT_DATA + process_at..][..outputs - process_at].as_chunks_mut::<2>().0;
        let places = further
            .iter_mut()
            .enumerate()
            .filter(|(n, _)| *n != 0 && *n != usize::from(drive.scale.set_point));
        for ((_, place), word) in places.zip(&drive.further) {
            *place = word.to_be_bytes();
        }
        Some((station, application, ends))
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.telegram);
        regions.add(&*self.shown);
        self.native.memory(regions);
        self.acyclic.memory(regions);
    }

    /// The address of the drive.
    pub(super) fn address(&self) -> u8 {
        self.address
    }

    /// It is in Data_Exchange.
    #[inline]
    pub(super) fn exchanges(&self) -> bool {
        self.start_up.is_over()
    }

    /// The next step of its start-up, or its first exchange, follows with its next own slot.
    #[inline]
    pub(super) fn starts(&self) -> bool {
        self.start_up.is_due()
    }

    /// Its last telegram was answered.
    pub(super) fn was_answered(&self) -> bool {
        self.was_answered
    }

    /// Why it is not in Data_Exchange, unless its diagnosis is to say so first.
    pub(super) fn note(&self) -> Option<Note> {
        self.start_up.note()
    }

    /// Builds the outputs of the next send in place. Built again for the same send, they are the same: state that
    /// changes with every telegram changes in [`sent`](Self::sent).
    #[inline]
    pub fn prepare(&mut self, cycle: &Cycle, slot: &mut Slot) {
        self.grid = cycle.grid;
        if let Some((control, setpoint)) = self.profile.encode(&slot.desired, &mut self.native) {
            self.put(self.process_at, control.to_be_bytes());
            self.put(self.set_point_at, setpoint.to_be_bytes());
        }
        if self.profile.is_native() {
            self.prepare_native();
        }
        if !self.acyclic.is_idle() || self.guarded != slot.guarded {
            self.prepare_acyclic(slot);
        } else {
            slot.commanded = false;
        }
    }

    #[inline]
    fn put(&mut self, at: u8, word: [u8; 2]) {
        let at = AT_DATA + usize::from(at);
        if let Some(place) = self.telegram.get_mut(at..at + 2) {
            place.copy_from_slice(&word);
        }
        self.is_changed = true;
    }

    #[inline(never)]
    fn prepare_native(&mut self) {
        let end = self.telegram.len() - 2;
        if let Some((output, whole)) = self.profile.native(&mut self.native)
            && let Some(outputs) = self.telegram.get_mut(AT_DATA + usize::from(self.process_at)..end)
        {
            output.put(whole, outputs);
            self.is_changed = true;
        }
    }

    #[inline(never)]
    fn prepare_acyclic(&mut self, slot: &mut Slot) {
        self.guarded = slot.guarded;
        self.acyclic.advance(self.grid, slot.link, self.start_up.is_over(), slot.guarded);
        slot.commanded = self.acyclic.commands();
        if self.process_at > 0
            && let Some(place) = self.telegram.get_mut(AT_DATA..AT_DATA + CHANNEL)
        {
            place.copy_from_slice(self.acyclic.channel());
            self.is_changed = true;
        }
    }

    /// Writes the telegram of its turn, which may be acyclic or not, and returns its length and what answers it.
    #[inline]
    pub fn request(
        &mut self,
        slot: &Slot,
        may_be_acyclic: bool,
        out: &mut [u8; MAX],
    ) -> Option<(usize, Expected)> {
        let usual = self.start_up.is_over() && slot.link == Link::Online && !self.diagnosis_due;
        if !usual || self.acyclic.data_unit().is_some() {
            self.sending = self.choose(slot, may_be_acyclic);
            if self.sending != Sending::DataExchange {
                return self.request_other(out);
            }
        }
        self.sending = Sending::DataExchange;
        let length = self.telegram.len();
        if std::mem::take(&mut self.is_changed) {
            let (before, after) = (self.telegram.get(4..AT_FC)?, self.telegram.get(AT_DATA..length - 2)?);
            let add = |sum: u8, byte: &u8| sum.wrapping_add(*byte);
            self.sum = after.iter().fold(before.iter().fold(0, add), add);
        }
        let fc = SRD_HIGH | self.count;
        let place = out.get_mut(..length)?;
        place.copy_from_slice(&self.telegram);
        place[AT_FC] = fc;
        place[length - 2] = self.sum.wrapping_add(fc);
        let expected =
            Expected { da: self.address, saps: None, acknowledge: false, data: Some(self.inputs_len) };
        Some((length, expected))
    }

    /// What its turn is used for.
    #[inline(never)]
    fn choose(&self, slot: &Slot, may_be_acyclic: bool) -> Sending {
        match slot.link {
            _ if !self.start_up.is_over() => Sending::StartUp,
            // What is new, a stop above all, comes first.
            _ if self.passed_over || self.profile.is_new() => Sending::DataExchange,
            _ if self.diagnosis_due => Sending::Diagnosis,
            Link::Unseen | Link::Lost => Sending::Diagnosis,
            // Without a count its repetition would be a second request.
            _ if may_be_acyclic && self.count != FIRST && self.acyclic.data_unit().is_some() => {
                Sending::Msac1
            }
            _ => Sending::DataExchange,
        }
    }

    #[inline(never)]
    fn request_other(&self, out: &mut [u8; MAX]) -> Option<(usize, Expected)> {
        let (service, data) = match self.sending {
            Sending::StartUp => self.start_up.request(),
            Sending::Msac1 => (Service::Msac1, self.acyclic.data_unit()?),
            Sending::Unlock => (Service::SetPrm, &self.unlock[..]),
            Sending::Diagnosis | Sending::DataExchange => (Service::SlaveDiag, &[][..]),
        };
        let mut head = service.head(self.address, self.own, false, false);
        head.fc.0 |= self.count;
        let acknowledge = !matches!(service, Service::SlaveDiag);
        let expected = Expected { da: self.address, saps: service.saps(), acknowledge, data: None };
        Some((head.emit(data, out)?, expected))
    }

    /// The telegram of its turn is one of MSAC1.
    #[inline]
    pub(super) fn is_acyclic(&self) -> bool {
        self.sending == Sending::Msac1
    }

    /// The telegram of its turn left at `at`; the first time, if it is repeated.
    #[inline]
    pub fn sent(&mut self, at: Time, reply_by: Time, slot: &mut Slot) {
        if self.sending == Sending::StartUp {
            Own::StartUps.count(&mut slot.counters);
            return self.unsent(slot);
        }
        slot.counters.sent += 1;
        slot.exchange = Exchange::Owed { sent_at: at, reply_by, awaited: false };
        if self.sending != Sending::DataExchange {
            return self.sent_other();
        }
        self.passed_over = false;
        slot.gone.grid = Some(self.grid);
        self.profile.sent();
        if !self.acyclic.is_idle() {
            self.acyclic.sent(Turn::DataExchange);
        }
    }

    #[cold]
    fn sent_other(&mut self) {
        self.passed_over = true;
        if self.sending == Sending::Msac1 {
            self.acyclic.sent(Turn::Msac1);
        }
    }

    /// Its turn was none: nothing could be sent, or what was sent is no exchange.
    pub(super) fn unsent(&mut self, slot: &mut Slot) {
        slot.counters.unsent += 1;
        slot.exchange = Exchange::Unsent;
    }

    /// The telegram of its turn was answered at `at`.
    #[inline]
    pub fn answered(&mut self, at: Time, answer: Answer<'_>, slot: &mut Slot) {
        self.count = if self.count == FIRST { SECOND } else { self.count ^ FCB };
        self.was_answered = true;
        let Answer::Data { high, data } = answer else { return self.answered_without(at, answer, slot) };
        if self.sending != Sending::DataExchange {
            return self.answered_other(at, data, slot);
        }
        self.diagnosis_due |= high;
        self.profile.answered();
        if !self.close(at, slot) {
            return;
        }
        if !self.acyclic.is_idle()
            && self.process_at > 0
            && let Some(channel) = data.first_chunk()
        {
            self.acyclic.channel_answered(channel);
        }
        self.read(at, data, slot);
    }

    /// Its exchange is answered; false: it is over for the loop.
    #[inline]
    fn close(&mut self, at: Time, slot: &mut Slot) -> bool {
        let Exchange::Owed { sent_at, .. } = slot.exchange else {
            slot.counters.late += 1;
            return false;
        };
        slot.exchange = Exchange::Answered { sent_at, at, suspect: false };
        slot.counters.answered += 1;
        true
    }

    /// Data came in answer to something else.
    #[inline(never)]
    fn answered_other(&mut self, at: Time, data: &[u8], slot: &mut Slot) {
        match self.sending {
            Sending::Msac1 => {
                self.close(at, slot);
                self.acyclic.answered(at, acyclic::Answer::Data(data));
            }
            Sending::StartUp => match Diagnosis::parse(data) {
                Some(diagnosis) => self.start(&diagnosis),
                None => self.start_up.again(false),
            },
            Sending::Diagnosis => {
                self.close(at, slot);
                if let Some(diagnosis) = Diagnosis::parse(data) {
                    self.diagnosed(&diagnosis, slot);
                }
            }
            Sending::DataExchange | Sending::Unlock => {}
        }
    }

    /// The answer has no data.
    #[inline(never)]
    fn answered_without(&mut self, at: Time, answer: Answer<'_>, slot: &mut Slot) {
        match (self.sending, answer) {
            (Sending::StartUp, Answer::Refused(function)) => self.start_up.refused(function),
            (Sending::StartUp, _) => self.start_up.acknowledged(),
            (Sending::Msac1, Answer::Refused(function)) => {
                self.close(at, slot);
                self.acyclic.answered(at, acyclic::Answer::Refused(function));
            }
            (Sending::Msac1, _) => {
                self.close(at, slot);
                self.acyclic.answered(at, acyclic::Answer::Acknowledged);
            }
            (Sending::Unlock, _) => self.leave(slot),
            (Sending::DataExchange | Sending::Diagnosis, _) => {
                // It does not exchange data any more.
                self.absent(slot);
                self.leave(slot);
            }
        }
    }

    fn absent(&mut self, slot: &mut Slot) {
        if let Exchange::Owed { sent_at, .. } = slot.exchange {
            slot.exchange = Exchange::Absent { sent_at };
        }
    }

    /// The telegram of its turn has failed: nothing answers it, however often it was repeated. The next one counts
    /// anew.
    #[cold]
    pub(super) fn failed(&mut self, slot: &mut Slot) {
        (self.count, self.was_answered) = (FIRST, false);
        match self.sending {
            Sending::StartUp => self.start_up.failed(),
            Sending::Msac1 => self.acyclic.lost(Turn::Msac1),
            Sending::DataExchange => self.acyclic.lost(Turn::DataExchange),
            Sending::Diagnosis | Sending::Unlock => {}
        }
        self.absent(slot);
    }

    /// The drive is not in Data_Exchange any more: it starts up anew.
    #[cold]
    fn leave(&mut self, slot: &mut Slot) {
        if self.start_up.is_over() {
            self.was_lost = true;
        }
        self.start_up.again(true);
        (self.diagnosis_due, self.passed_over) = (false, false);
        self.profile.dropped();
        self.acyclic.ended();
        slot.evidence.outputs_count = false;
    }

    /// A diagnosis of the start-up.
    fn start(&mut self, diagnosis: &Diagnosis<'_>) {
        let checks = self.start_up.step() == Step::Check;
        self.start_up.diagnosed(diagnosis);
        if checks && self.start_up.is_over() {
            self.profile.dropped();
            self.profile.watchdog_is(diagnosis.status.has(DiagnosisStatus::WD_ON));
            self.acyclic.ended();
            // Data_Exchange comes first.
            (self.diagnosis_due, self.passed_over, self.unnamed) = (false, true, 0);
            self.inputs = Inputs::default();
        }
    }

    /// The diagnosis of a drive in Data_Exchange.
    fn diagnosed(&mut self, diagnosis: &Diagnosis<'_>, slot: &mut Slot) {
        self.diagnosis_due = false;
        let status = diagnosis.status;
        let elsewhere = diagnosis.master.is_some_and(|master| master != self.own);
        if status.has_any(DiagnosisStatus::PRM_REQ | DiagnosisStatus::NOT_READY) || elsewhere {
            slot.notices.other_master |= elsewhere;
            return self.leave(slot);
        }
        self.profile.watchdog_is(status.has(DiagnosisStatus::WD_ON));
        if !self.inputs.faulted() {
            return;
        }
        let word = self.fault_at.and_then(|at| {
            let rest = diagnosis.extended.get(usize::from(at)..)?;
            rest.first_chunk().map(|word| u16::from_be_bytes(*word)).filter(|word| *word != 0)
        });
        self.unnamed = self.unnamed.saturating_add(1);
        match word {
            Some(code) => (self.inputs.fault, self.inputs.named) = (code, true),
            None if self.unnamed >= UNNAMED || self.fault_at.is_none() => {
                (self.inputs.fault, self.inputs.named) = (ANY_ERROR, true);
            }
            None => self.diagnosis_due = true,
        }
    }

    /// The drive's report, in user units.
    #[inline]
    fn read(&mut self, at: Time, data: &[u8], slot: &mut Slot) {
        let word = |at: u8| {
            let word = data.get(usize::from(at)..).and_then(<[u8]>::first_chunk);
            word.map_or(0, |word: &[u8; 2]| u16::from_be_bytes(*word))
        };
        let (status, actual) = (word(self.process_at), word(self.actual_at) as i16);
        if status != self.inputs.status || !self.profile.is_steady() || slot.status.at == Time(0) {
            self.read_anew(status, slot);
        }
        let report = &mut slot.status;
        (report.at, report.velocity) = (at, f64::from(actual) * self.velocity_per_count);
        let turns = actual.unsigned_abs() >= self.moves_from || self.profile.is_turning();
        report.moving = report.state.is_powered() && turns;
        slot.notices.fresh = true;
        if !self.shown.is_empty() {
            slot.notices.monitor_fresh = true;
            for &Shown { channel, at, signed, per_count } in &self.shown {
                let raw = word(at);
                let count = if signed { f64::from(raw as i16) } else { f64::from(raw) };
                if let Some(place) = report.monitor.get_mut(usize::from(channel)) {
                    *place = Some(count * per_count);
                }
            }
        }
        let process = data.get(usize::from(self.process_at)..).unwrap_or_default();
        self.native.publish(at, self.profile.is_native(), process);
    }

    /// Its status, or what is proved, may be another one than before.
    #[inline(never)]
    fn read_anew(&mut self, status: u16, slot: &mut Slot) {
        self.start_up.settled();
        slot.notices.restarted |= std::mem::take(&mut self.was_lost);
        let was_faulted = self.inputs.faulted();
        self.inputs.status = status;
        self.inputs.state = self.profile.state(status);
        self.inputs.inhibited = self.profile.is_inhibited(status);
        match (was_faulted, self.inputs.faulted()) {
            (false, true) => {
                // Its diagnosis names the fault.
                (self.diagnosis_due, self.unnamed, self.inputs.named) = (true, 0, false);
            }
            (_, false) => (self.inputs.fault, self.inputs.named) = (0, false),
            (true, true) => {}
        }
        self.profile.prove(&self.inputs, &mut slot.evidence);
        let report = &mut slot.status;
        (report.state, report.inhibited) = (self.inputs.state, self.inputs.inhibited);
        (report.position, report.demand, report.current) = (f64::NAN, f64::NAN, f64::NAN);
        report.in_target = status & REACHED != 0;
        report.warning = u32::from(status & WARNING);
        report.fault = if self.inputs.faulted() { u32::from(self.inputs.fault) } else { 0 };
        report.suspect = false;
    }

    /// Its turn is to let the drive go: unlocked, it is any master's. False: it is not in Data_Exchange.
    pub(super) fn unlocks(&mut self) -> bool {
        self.sending = Sending::Unlock;
        self.start_up.is_over()
    }

    /// The telegram that unlocks it.
    pub(super) fn unlock(&self, out: &mut [u8; MAX]) -> Option<(usize, Expected)> {
        self.request_other(out)
    }

    /// The port is gone, or the wire: it begins with a diagnosis, without a count.
    pub(super) fn cut_off(&mut self, slot: &mut Slot) {
        self.count = FIRST;
        self.absent(slot);
        if slot.exchange == Exchange::Queued {
            self.unsent(slot);
        }
        if self.start_up.is_over() {
            self.leave(slot);
        }
        self.start_up.again(false);
    }
}
