//! The parameter channel in the process data: one job at a time, in the PKW form (path A) or that of DRIVECOM (path B).
//!
//! A job stays in the outputs until the inputs of an exchange that carried it have its answer, however many exchanges
//! are lost meanwhile: what stands there is no new job, so that nothing is written twice. A drive that has left
//! Data_Exchange may take it for a new one: the channel is cleared before the next exchange.
//!
//! PKW has no handshake bit: between two jobs there is none, until the drive shows that; by a setting, between two of
//! the same code only. In DRIVECOM the handshake bit changes with each job, against what the drive showed last.

use super::super::plan::{CHANNEL, ParameterPath};
use super::super::target::{BROKEN, drivecom as drivecom_status, number};
use super::super::wire::job::{Job, Raw};
use super::super::wire::{drivecom, pkw};

/// DRIVECOM: the handshake bit that a drive shows without a job is taken over at one of so many answers.
const PATIENCE: u8 = 16;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// There is no job, and the drive has not shown yet that it knows; after an answer to this one.
    Clear(Option<Job>),
    /// A job can begin.
    Free,
    /// This one runs.
    Job(Job),
}

/// The channel of one drive.
#[derive(Debug)]
pub(super) struct Channel {
    out: [u8; CHANNEL],
    /// The last exchange carried `out`.
    is_out: bool,
    path: ParameterPath,
    state: State,
    /// DRIVECOM: the handshake bit in `out`.
    handshake: bool,
    /// DRIVECOM: so many answers without a job had another one.
    differs: u8,
}

impl Channel {
    /// That of a drive with this path.
    pub(super) fn new(path: ParameterPath) -> Channel {
        let state = if path.is_channel() { State::Clear(None) } else { State::Free };
        Channel { out: [0; CHANNEL], is_out: false, path, state, handshake: false, differs: 0 }
    }

    /// As it is to be in the outputs.
    #[inline]
    pub(super) fn out(&self) -> &[u8; CHANNEL] {
        &self.out
    }

    /// There is no job, and the drive knows.
    pub(super) fn is_free(&self) -> bool {
        self.state == State::Free
    }

    /// Begins a job, if there is none and the drive can tell it from the one before.
    pub(super) fn begin(&mut self, job: Job) {
        let differs = |done: Job| (done.code, done.sub) != (job.code, job.sub);
        let may_begin = match self.state {
            State::Free => true,
            State::Clear(Some(done)) => self.path == ParameterPath::Pkw { pause: false } && differs(done),
            State::Clear(None) | State::Job(_) => false,
        };
        if !may_begin {
            return;
        }
        self.state = State::Job(job);
        self.handshake = !self.handshake;
        self.put(match self.path {
            ParameterPath::Pkw { .. } => pkw::encode(&job),
            _ => drivecom::encode(&job, self.handshake),
        });
    }

    fn put(&mut self, out: [u8; CHANNEL]) {
        self.is_out &= self.out == out;
        self.out = out;
    }

    /// There is no job any more; the one before was answered, or not.
    pub(super) fn clear(&mut self, done: Option<Job>) {
        if self.path.is_channel() {
            (self.state, self.differs) = (State::Clear(done), 0);
            self.put_none();
        }
    }

    fn put_none(&mut self) {
        self.put(match self.path {
            ParameterPath::Drivecom => drivecom::none(self.handshake),
            _ => pkw::NONE,
        });
    }

    /// The drive begins anew.
    pub(super) fn reset(&mut self) {
        (self.handshake, self.is_out) = (false, false);
        self.clear(None);
    }

    /// An exchange left, with the channel in it. True: it carries a job.
    pub(super) fn sent(&mut self) -> bool {
        self.is_out = true;
        matches!(self.state, State::Job(_))
    }

    /// The channel in the inputs of the last exchange: how the job has ended, if it has. An error is a status.
    pub(super) fn answered(&mut self, bytes: &[u8; CHANNEL]) -> Option<Result<Raw, u32>> {
        // Else it answers what was there before.
        if !self.is_out {
            return None;
        }
        let is_pkw = matches!(self.path, ParameterPath::Pkw { .. });
        match self.state {
            State::Job(job) => {
                let ended = if is_pkw {
                    pkw::reply(&job, bytes)?.map_err(|error| error.map_or(BROKEN, number))
                } else {
                    drivecom::reply(&job, self.handshake, bytes)?.map_err(drivecom_status)
                };
                self.state = State::Free;
                // A write that stands there could be taken for a new one by a drive that has forgotten it.
                if is_pkw || job.write.is_some() {
                    self.clear(Some(job));
                }
                return Some(ended);
            }
            State::Clear(_) if is_pkw => {
                if pkw::is_none(bytes) {
                    self.state = State::Free;
                }
            }
            State::Clear(_) if drivecom::shows(bytes) == self.handshake => self.state = State::Free,
            State::Clear(_) => {
                // Not at each answer: a drive whose answers come late would change with it for ever.
                if self.differs.is_multiple_of(PATIENCE) {
                    self.handshake = !self.handshake;
                    self.put_none();
                }
                self.differs = self.differs.wrapping_add(1);
            }
            State::Free => {}
        }
        None
    }
}
