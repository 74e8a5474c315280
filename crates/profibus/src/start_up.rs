//! A drive on its way to Data_Exchange: diagnosis, Set_Prm, Chk_Cfg, diagnosis, a telegram a turn, each of them a step
//! (sheet, 6).
//!
//! It begins anew whenever the drive does not answer, or reports that it has lost its parametrisation. What the drive
//! refuses is noted by name, and tried again as seldom as a drive that does not answer.

use super::notes::Note;
use super::plan::LenzeDrive;
use super::wire::Writer;
use super::wire::dp::{Diagnosis, DiagnosisStatus as Status, SetPrm, station_status};
use super::wire::sap::{CHK_CFG, Service};
use super::wire::telegram::DU_MAX;

/// So many diagnoses of a drive that is parametrised and configured may report that it is not ready.
const NOT_READY: u32 = 100;

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
    /// It exchanges data.
    Exchange,
}

/// The start-up of one drive.
#[derive(Debug)]
pub(super) struct StartUp {
    step: Step,
    /// The next step follows with the drive's next slot; else it is tried again like a drive that does not answer.
    is_due: bool,
    checks: u32,
    note: Note,
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
            checks: 0,
            note: Note::None,
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

    /// The drive exchanges data, and has its turns.
    #[inline]
    pub(super) fn settled(&mut self) {
        self.is_due = false;
    }

    /// The next step follows with the drive's next slot.
    #[inline]
    pub(super) fn is_due(&self) -> bool {
        self.is_due
    }

    /// Why the drive does not exchange data; `None`: its diagnosis is to say so first.
    pub(super) fn note(&self) -> Option<Note> {
        let asks = self.step == Step::Check && matches!(self.note, Note::Refused { .. });
        (!asks).then_some(self.note)
    }

    /// The service of the next step, and its data.
    pub(super) fn request(&self) -> (Service, &[u8]) {
        match self.step {
            Step::Parametrise => (Service::SetPrm, &self.parameters),
            Step::Configure => (Service::ChkCfg, &self.configuration),
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

    fn go_to(&mut self, step: Step) {
        (self.step, self.is_due) = (step, true);
    }

    /// The telegram of the step was not answered.
    pub(super) fn failed(&mut self) {
        self.refuse(Note::Absent);
    }

    /// It was refused by the link layer with this function.
    pub(super) fn refused(&mut self, function: u8) {
        let sap = self.request().0.saps().map_or(0, |(dsap, _)| dsap);
        self.refuse(Note::Refused { sap, function });
        if sap == CHK_CFG {
            // Its diagnosis may say why: a wrong Set_Prm is acknowledged, too.
            self.go_to(Step::Check);
        }
    }

    /// It was acknowledged.
    pub(super) fn acknowledged(&mut self) {
        match self.step {
            Step::Parametrise => self.go_to(Step::Configure),
            Step::Configure => self.go_to(Step::Check),
            Step::Diagnose | Step::Check | Step::Exchange => self.again(false),
        }
    }

    /// The drive's diagnosis.
    pub(super) fn diagnosed(&mut self, diagnosis: &Diagnosis<'_>) {
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
            Step::Check if status.has(Status::PRM_FAULT) => self.refuse(Note::Parameters),
            Step::Check if status.has(Status::CFG_FAULT) => self.refuse(Note::Configuration),
            Step::Check if status.has(Status::PRM_REQ) => {
                self.again(!matches!(self.note, Note::Refused { .. }));
            }
            Step::Check if status.has_any(Status::NOT_READY | Status::STAT_DIAG) => {
                self.checks += 1;
                if self.checks > NOT_READY {
                    self.refuse(Note::NotReady);
                }
            }
            Step::Check => {
                let watched = status.has(Status::WD_ON) || !self.has_watchdog;
                self.note = if watched { Note::None } else { Note::Unwatched };
                self.go_to(Step::Exchange);
            }
            Step::Diagnose | Step::Parametrise | Step::Configure | Step::Exchange => {
                self.go_to(Step::Parametrise);
            }
        }
    }
}
