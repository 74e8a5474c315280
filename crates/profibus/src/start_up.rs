//! A drive on its way to Data_Exchange: diagnosis, Set_Prm, Chk_Cfg, diagnosis, a telegram a turn, each of them a step
//! (sheet, 6).
//!
//! It begins anew whenever the drive does not answer, or reports that it has lost its parametrisation. What the drive
//! refuses is noted by name. It is tried once more as soon as a drive that does not answer; then the pauses grow, in
//! which the drive is only diagnosed. Of a drive that refuses its configuration the one that it wants is read first
//! (Get_Cfg).

use super::notes::Note;
use super::plan::LenzeDrive;
use super::wire::Writer;
use super::wire::dp::{Diagnosis, DiagnosisStatus as Status, SetPrm, station_status};
use super::wire::sap::{CHK_CFG, Service};
use super::wire::telegram::DU_MAX;
use fieldbeat_core::time::{S, Time};

/// The number of diagnoses of a drive that is parametrised and configured which may report that it is not ready.
const NOT_READY: u32 = 100;

/// The pause behind the second refusal in a row, ns; each is twice the one before, so many times.
const PAUSE_NS: u64 = S;
const DOUBLED: u32 = 4;
/// The number of identifier bytes kept of the configuration that a drive wants.
pub(super) const WANTED: usize = 32;

/// The next telegram of a drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Step {
    /// Who is there, and whose is it?
    #[default]
    Diagnose,
    Parametrise,
    Configure,
    /// Is it ready?
    Check,
    /// Which configuration does it want?
    Ask,
    /// It exchanges data.
    Exchange,
}

/// The start-up of one drive.
#[derive(Debug)]
#[repr(C)] // What each exchange looks at comes first.
pub(super) struct StartUp {
    step: Step,
    /// The next step follows with the drive's next slot; else it is tried again like a drive that does not answer.
    is_due: bool,
    /// It was in Data_Exchange, and has not come back yet.
    was_lost: bool,
    checks: u32,
    note: Note,
    /// Why it has left Data_Exchange, until it exchanges data again.
    left: Note,
    /// Refusals in a row, and no Set_Prm before.
    refusals: u32,
    not_before: Time,
    /// The identifier bytes that it wants, as far as there is room for them.
    wanted: Box<[u8; WANTED]>,
    /// The address of the master.
    own: u8,
    ident: u16,
    has_watchdog: bool,
    parameters: Box<[u8]>,
    configuration: Box<[u8]>,
}

/// The data of Set_Prm, with this status byte; `None`: they are too long.
fn parameters(drive: &LenzeDrive, status: u8) -> Option<Box<[u8]>> {
    let mut room = [0; DU_MAX];
    let mut writer = Writer::new(&mut room);
    let set = SetPrm {
        status,
        watchdog: drive.watchdog(),
        min_tsdr: drive.min_tsdr,
        ident: drive.ident,
        groups: drive.group,
        user: &drive.user_prm,
    };
    set.put(&mut writer);
    let length = writer.finish()?;
    Some(room[..length].into())
}

impl StartUp {
    /// That of `drive`, whose master is at address `own`; `None`: its parametrisation is too long.
    pub(super) fn new(drive: &LenzeDrive, own: u8) -> Option<StartUp> {
        Some(StartUp {
            step: Step::Diagnose,
            is_due: false,
            was_lost: false,
            checks: 0,
            note: Note::None,
            left: Note::None,
            refusals: 0,
            not_before: Time(0),
            wanted: Box::new([0; WANTED]),
            own,
            ident: drive.ident,
            has_watchdog: drive.watchdog.timeout_ns.is_some(),
            parameters: parameters(drive, station_status::LOCK)?,
            configuration: drive.configuration.clone().into(),
        })
    }

    /// The next step.
    #[inline]
    pub(super) fn step(&self) -> Step {
        self.step
    }

    /// The drive exchanges data.
    #[inline]
    pub(super) fn is_over(&self) -> bool {
        self.step == Step::Exchange
    }

    /// The drive exchanges data, and has its turns. True: again, after it had left Data_Exchange.
    #[inline]
    pub(super) fn settled(&mut self) -> bool {
        (self.is_due, self.left) = (false, Note::None);
        (self.refusals, self.not_before) = (0, Time(0));
        std::mem::take(&mut self.was_lost)
    }

    /// The drive exchanges no data any more, for this reason.
    pub(super) fn left(&mut self, now: Time, why: Note) {
        self.left = why;
        self.was_lost |= self.is_over();
        if self.is_over() && self.is_due {
            // Nor has it ever.
            self.refuse_setup(now, self.note);
        }
        self.again(true);
    }

    /// The next step follows with the drive's next slot.
    #[inline]
    pub(super) fn is_due(&self) -> bool {
        self.is_due
    }

    /// Why the drive does not exchange data; `None`: the drive is to say so first.
    pub(super) fn note(&self) -> Option<Note> {
        let reads = self.step == Step::Check && matches!(self.note, Note::Refused { .. });
        let note = match self.note {
            Note::None | Note::Unwatched if self.left != Note::None => self.left,
            note => note,
        };
        (!reads && self.step != Step::Ask).then_some(note)
    }

    /// The identifier bytes that it wants, as far as there is room for them.
    pub(super) fn wanted(&self) -> &[u8; WANTED] {
        &self.wanted
    }

    /// The service of the next step, and its data.
    pub(super) fn request(&self) -> (Service, &[u8]) {
        match self.step {
            Step::Parametrise => (Service::SetPrm, &self.parameters),
            Step::Configure => (Service::ChkCfg, &self.configuration),
            Step::Ask => (Service::GetCfg, &[]),
            Step::Diagnose | Step::Check | Step::Exchange => (Service::SlaveDiag, &[]),
        }
    }

    /// It begins anew; `is_due`: with the drive's next slot.
    pub(super) fn again(&mut self, is_due: bool) {
        (self.step, self.is_due, self.checks) = (Step::Diagnose, is_due, 0);
    }

    fn refuse(&mut self, note: Note) {
        self.note = note;
        self.again(false);
    }

    /// It refuses what Set_Prm or Chk_Cfg has brought: the next Set_Prm follows later each time.
    fn refuse_setup(&mut self, now: Time, note: Note) {
        self.refuse(note);
        self.refusals = self.refusals.saturating_add(1);
        let pause_ns = match self.refusals {
            0 | 1 => 0,
            more => PAUSE_NS << (more - 2).min(DOUBLED),
        };
        self.not_before = now + pause_ns;
    }

    fn go_to(&mut self, step: Step) {
        (self.step, self.is_due) = (step, true);
    }

    /// The telegram of the step was not answered.
    pub(super) fn failed(&mut self) {
        if self.step == Step::Ask {
            // It does not say what it wants.
            return self.again(false);
        }
        // Whoever comes back may be another one, or set up otherwise.
        (self.refusals, self.not_before) = (0, Time(0));
        self.refuse(Note::Absent);
    }

    /// Notes that its diagnosis was none.
    pub(super) fn unreadable(&mut self) {
        self.refuse(Note::Unreadable);
    }

    /// It was refused by the link layer with this function.
    pub(super) fn refused(&mut self, now: Time, function: u8) {
        if self.step == Step::Ask {
            return self.again(false);
        }
        let sap = self.request().0.saps().map_or(0, |(dsap, _)| dsap);
        if sap == CHK_CFG {
            // Its diagnosis may say why: a wrong Set_Prm is acknowledged, too.
            self.refuse(Note::Refused { sap, function });
            return self.go_to(Step::Check);
        }
        self.refuse_setup(now, Note::Refused { sap, function });
    }

    /// It was acknowledged.
    pub(super) fn acknowledged(&mut self) {
        match self.step {
            Step::Parametrise => self.go_to(Step::Configure),
            Step::Configure => self.go_to(Step::Check),
            Step::Diagnose | Step::Check | Step::Ask | Step::Exchange => self.again(false),
        }
    }

    /// The answer to the step has data.
    pub(super) fn answered(&mut self, now: Time, data: &[u8]) {
        match Diagnosis::parse(data) {
            _ if self.step == Step::Ask => {
                self.wanted.iter_mut().zip(data).for_each(|(place, byte)| *place = *byte);
                self.note = Note::Configuration { wants: data.len().min(u8::MAX.into()) as u8 };
                self.again(false);
            }
            Some(diagnosis) => self.diagnosed(now, &diagnosis),
            None => self.unreadable(),
        }
    }

    /// The drive's diagnosis.
    fn diagnosed(&mut self, now: Time, diagnosis: &Diagnosis<'_>) {
        let status = diagnosis.status;
        if diagnosis.ident != self.ident {
            return self.refuse(Note::Ident(diagnosis.ident));
        }
        if let Some(master) = diagnosis.master.filter(|master| *master != self.own)
            && !status.has(Status::PRM_REQ)
        {
            return self.refuse(Note::Locked(master));
        }
        match self.step {
            Step::Check if status.has(Status::PRM_FAULT) => self.refuse_setup(now, Note::Parameters),
            Step::Check if status.has(Status::CFG_FAULT) => {
                self.refuse_setup(now, Note::Configuration { wants: 0 });
                self.go_to(Step::Ask);
            }
            Step::Check if status.has(Status::PRM_REQ) => match self.note {
                Note::Refused { .. } => self.refuse_setup(now, self.note),
                // It may have been too late for its watchdog.
                _ if self.refusals == 0 => {
                    self.refusals = 1;
                    self.again(true);
                }
                _ => self.refuse_setup(now, Note::NotReady),
            },
            Step::Check if status.has_any(Status::NOT_READY | Status::STAT_DIAG) => {
                self.checks += 1;
                if !matches!(self.note, Note::Refused { .. }) {
                    self.note = Note::NotReady;
                }
                if self.checks > NOT_READY {
                    self.refuse_setup(now, Note::NotReady);
                }
            }
            Step::Check => {
                let watched = status.has(Status::WD_ON) || !self.has_watchdog;
                self.note = if watched { Note::None } else { Note::Unwatched };
                self.go_to(Step::Exchange);
            }
            Step::Diagnose if now < self.not_before => self.again(false),
            Step::Diagnose | Step::Parametrise | Step::Configure | Step::Ask | Step::Exchange => {
                self.go_to(Step::Parametrise);
            }
        }
    }
}
