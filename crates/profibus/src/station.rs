//! The master's view of one drive: whose turn in what it is, the next telegram, and what its answers report.
//!
//! It takes instants and slices, and knows no port. What is desired of the drive becomes outputs in `profile`, which
//! `telegram` sends. `answer` is what an answer changes, `report` what it says of the drive.
//!
//! The outputs are built in the turn: what is desired stays the same since the preparation. Native writes and acyclic
//! calls, which may come at any time, are taken with the preparation.
//!
//! Telegrams of the start-up are no exchanges: a slot that is due is unsent until the drive is in Data_Exchange. From
//! then on a turn is Data_Exchange, or in its place a diagnosis that the drive has announced, or an MSAC1 request. A
//! drive that does not answer is sent what is desired of it all the same, since it may be the stop; once its link is
//! lost, a diagnosis takes turns with that, and shows what became of it.

mod answer;
mod report;
mod telegram;

use self::report::Shown;
use self::telegram::Telegram;
use super::acyclic::{Acyclic, Turn};
use super::counters::Own;
use super::line::Expected;
use super::native::{NATIVE_WORDS, Native, NativePort, seen};
use super::notes::Note;
use super::plan::LenzeDrive;
use super::profile::{Change, Inputs, Profile};
use super::start_up::{StartUp, WANTED};
use super::target::commanding;
use super::wire::dp::station_status;
use super::wire::sap::Service;
use super::wire::telegram::MAX;
use fieldbeat_core::axis::Link;
use fieldbeat_core::axis::acyclic::{AcyclicEnds, queue};
use fieldbeat_core::bus::native::native;
use fieldbeat_core::bus::{Cycle, Exchange, Slot};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// The count bits of a function code: the first request; its FCB is 1, and does not count.
const FIRST: u8 = 0x20;
const FCB: u8 = 0x20;
const SECOND: u8 = 0x10;
/// Of so many answers in a row that came behind their window, one more, the first ones are waited for there.
const SLOW: u8 = 63;
const AWAITED: u8 = 4;
/// A motor turns from this part of its full speed on (assumed): below it is noise of the measurement.
const MOVES_FROM: u16 = 256;

/// The kind of the telegram under way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sending {
    StartUp,
    DataExchange,
    Diagnosis,
    Msac1,
    Unlock,
}

/// One drive.
#[derive(Debug)]
#[repr(C, align(64))] // What each exchange touches is on a cache line at the begin, and on one of each part.
pub struct Station {
    /// The slot of the grid that the outputs are built for, and the end of its window.
    grid: Time,
    window_end: Time,
    inputs: Inputs,
    shown: Box<[Shown]>,
    sending: Sending,
    /// The count bits of the next new telegram.
    count: u8,
    address: u8,
    /// The end of the inputs that the application sees.
    seen_to: u8,
    /// A diagnosis is due.
    diagnosis_due: bool,
    /// The last turn was no Data_Exchange.
    passed_over: bool,
    /// Native mode runs: a telegram with it has left.
    is_native: bool,
    /// Exchanges and diagnoses that it refused (UE, RR) since the last one that it answered.
    refused: u8,
    /// The number of answers in a row that came behind the window of their request.
    slow: u8,
    process_at: u8,
    set_point_at: u8,
    actual_at: u8,
    /// It moves from so many counts of its actual value on.
    moves_from: u16,
    /// Diagnoses since a fault began.
    unnamed: u8,
    own: u8,
    start_up: StartUp,
    profile: Profile,
    native: NativePort,
    acyclic: Acyclic,
    /// Data_Exchange as it is sent next; its outputs behind the parameter channel where the application writes none.
    telegram: Telegram,
    own_outputs: Box<[u8]>,
    fault_at: Option<u8>,
    unlock: [u8; 7],
}

impl Station {
    /// The station of `drive` of the master at address `own`, and the application's ends of its native process data and
    /// of its acyclic access. `None`: its plan is not free of faults.
    pub fn new(drive: &LenzeDrive, own: u8, log: &InputLog) -> Option<(Station, Native, AcyclicEnds)> {
        let (application, native) = native();
        let (ends, port) = queue(drive.axis.parameter_queue, commanding());
        let (native, port) = (native.logged(log), port.logged(log));
        let (outputs, inputs) = drive.lengths()?;
        let process_at = drive.process_at();
        let word = |word: u8, length: usize| {
            let at = process_at + 2 * usize::from(word);
            u8::try_from(at).ok().filter(|_| at + 2 <= length)
        };
        word(0, inputs)?;
        word(0, outputs)?;
        let [high, low] = drive.ident.to_be_bytes();
        let mut station = Station {
            grid: Time(0),
            window_end: Time(0),
            inputs: Inputs::default(),
            shown: Shown::all(drive, |at| word(at, inputs)),
            sending: Sending::StartUp,
            count: FIRST,
            address: drive.address,
            seen_to: (process_at + seen(inputs - process_at)) as u8,
            diagnosis_due: false,
            passed_over: false,
            is_native: false,
            refused: 0,
            slow: 0,
            process_at: process_at as u8,
            set_point_at: word(drive.scale.set_point, outputs)?,
            actual_at: word(drive.scale.actual, inputs)?,
            moves_from: (drive.scale.full_count.unsigned_abs() / MOVES_FROM).max(1),
            unnamed: 0,
            own,
            start_up: StartUp::new(drive, own)?,
            profile: Profile::new(drive),
            native,
            acyclic: Acyclic::new(drive, port),
            telegram: Telegram::new(drive.address, own, outputs, inputs)?,
            own_outputs: Box::default(),
            fault_at: drive.fault_at,
            unlock: [station_status::UNLOCK, 0, 0, 0, high, low, 0],
        };
        let set_point = usize::from(drive.scale.set_point);
        let further = (1_u8..).filter(|word| usize::from(*word) != set_point);
        for (n, value) in further.zip(&drive.further) {
            if let Some(at) = word(n, outputs) {
                station.telegram.put(at, *value);
            }
        }
        station.own_outputs = station.telegram.outputs(station.process_at).into();
        Some((station, application, ends))
    }

    /// The native process data.
    #[inline]
    pub(super) fn native(&self) -> &NativePort {
        &self.native
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        regions.add(&*self.own_outputs);
        regions.add(self.start_up.wanted());
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

    /// The last telegram was answered.
    pub(super) fn was_answered(&self) -> bool {
        self.count != FIRST
    }

    /// Why it is not in Data_Exchange, unless its diagnosis is to say so first.
    pub(super) fn note(&self) -> Option<Note> {
        self.start_up.note()
    }

    /// The identifier bytes that it wants, as far as there is room for them.
    pub(super) fn wanted(&self) -> &[u8; WANTED] {
        self.start_up.wanted()
    }

    /// Takes what the application has written since the last turn into the next one. Called again for the same send,
    /// it is the same: state that changes with every telegram changes in [`sent`](Self::sent).
    #[inline]
    pub fn prepare(&mut self, cycle: &Cycle, slot: &mut Slot) {
        (self.grid, self.window_end) = (cycle.grid, cycle.deadline);
        if self.is_native {
            self.build(slot);
        }
        if self.acyclic.is_idle_as(slot.guarded) {
            slot.commanded = false;
        } else {
            self.prepare_acyclic(slot);
        }
    }

    /// Builds the outputs of the next telegram in place.
    #[inline]
    fn build(&mut self, slot: &Slot) {
        match self.profile.encode(&slot.desired, &mut self.native, self.is_native) {
            Change::Nothing => {}
            Change::Setpoint => self.telegram.put(self.set_point_at, self.profile.values().1),
            Change::Outputs => self.put_outputs(),
        }
    }

    /// Rebuilds all outputs: what the application wrote in native modes before this one, the control word and the set
    /// point, and what it writes in this one.
    #[inline(never)]
    fn put_outputs(&mut self) {
        let (kept, own) = (self.profile.kept(), &self.own_outputs);
        self.telegram.change(self.process_at, |outputs| {
            outputs.copy_from_slice(own);
            kept.put(false, outputs);
        });
        let (control, setpoint) = self.profile.values();
        self.telegram.put(self.process_at, control);
        self.telegram.put(self.set_point_at, setpoint);
        if let Some((output, whole)) = self.profile.native() {
            self.telegram.change(self.process_at, |outputs| output.put(whole, outputs));
        }
    }

    #[inline(never)]
    fn prepare_acyclic(&mut self, slot: &mut Slot) {
        self.acyclic.advance(self.grid, slot.link, self.start_up.is_over(), slot.guarded);
        slot.commanded = self.acyclic.commands();
        if self.process_at > 0 {
            let channel = self.acyclic.channel();
            self.telegram.change(0, |outputs| {
                outputs.iter_mut().zip(channel).for_each(|(place, byte)| *place = *byte);
            });
        }
    }

    /// The outputs behind the parameter channel that were sent last, as long as no newer ones are built; nothing if its
    /// turn was no Data_Exchange.
    pub(super) fn sent_outputs(&self) -> &[u8] {
        let outputs = match self.sending {
            Sending::DataExchange => self.telegram.outputs(self.process_at),
            Sending::StartUp | Sending::Diagnosis | Sending::Msac1 | Sending::Unlock => &[],
        };
        outputs.get(..2 * NATIVE_WORDS).unwrap_or(outputs)
    }

    /// Builds and writes the telegram of its turn, which may be acyclic or not, and returns its length and what answers
    /// it.
    #[inline]
    pub fn request(
        &mut self,
        slot: &Slot,
        may_be_acyclic: bool,
        out: &mut [u8; MAX],
    ) -> Option<(usize, Expected)> {
        // What the application writes natively was taken with the preparation, once native mode has left.
        if !self.is_native || self.profile.is_void() {
            self.build(slot);
        }
        let usual = self.start_up.is_over() && slot.link == Link::Online && !self.diagnosis_due;
        if !usual || self.acyclic.data_unit().is_some() {
            self.sending = self.choose(slot, may_be_acyclic);
            if self.sending != Sending::DataExchange {
                return self.request_other(out);
            }
        }
        self.sending = Sending::DataExchange;
        self.telegram.emit(self.count, out)
    }

    /// The use of its turn.
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
        let expected = Expected::service(self.address, service.saps(), acknowledge);
        Some((head.emit(data, out)?, expected))
    }

    /// The telegram of its turn is one of MSAC1.
    #[inline]
    pub(super) fn is_acyclic(&self) -> bool {
        self.sending == Sending::Msac1
    }

    /// The telegram of its turn left at `at`; the first time, if it is repeated. The window is kept open for its answer
    /// if that usually comes inside it; of many that do not, now and then.
    #[inline]
    pub fn sent(&mut self, at: Time, reply_by: Time, slot: &mut Slot) {
        if self.sending == Sending::StartUp {
            Own::StartUps.count(&mut slot.counters);
            return slot.unsent();
        }
        slot.owe(at, reply_by, self.slow & SLOW < AWAITED);
        if self.sending != Sending::DataExchange {
            return self.sent_other();
        }
        self.passed_over = false;
        slot.gone.grid = Some(self.grid);
        if let Some(is_native) = self.profile.sent(&mut self.native) {
            self.is_native = is_native;
        }
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

    /// The turn is to let the drive go: unlocked, it is any master's. False: it is not in Data_Exchange.
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
        slot.absent();
        if slot.exchange == Exchange::Queued {
            slot.unsent();
        }
        if self.start_up.is_over() {
            self.leave(Note::None, slot);
        }
        self.start_up.again(false);
    }
}
