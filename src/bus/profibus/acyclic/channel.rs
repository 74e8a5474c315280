//! The parameter channel in the process data: one job at a time, in the PKW form (path A) or that of DRIVECOM (path B).
//!
//! A job stays in the outputs until the inputs of an exchange that carried it have its answer, however many exchanges
//! are lost meanwhile: what stands there is no new job, so that nothing is written twice. A drive that has left
//! Data_Exchange may take it for a new one: the channel is cleared before the next exchange.
//!
//! PKW has no handshake bit: between two jobs there is none, until the drive shows that. In DRIVECOM the handshake bit
//! changes with each job, against what the drive showed last.

use super::super::plan::{CHANNEL, Numbers, ParameterPath};
use super::super::target::{BROKEN, NO_TEXT, Parameter, UNREACHABLE, drivecom as drivecom_status, number};
use super::super::wire::drivecom::{self, Size};
use super::super::wire::errors::ErrorNumber;
use super::super::wire::pkw::{self, Response, Value};

/// DRIVECOM: the handshake bit that a drive shows without a job is taken over at one of so many answers.
const PATIENCE: u8 = 16;

/// What is to be done with a code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Job {
    code: u16,
    sub: u8,
    size: Size,
    /// The value to write.
    write: Option<u32>,
}

/// The form of jobs and answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    None,
    Pkw,
    Drivecom,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// There is no job; the drive has not shown yet that it knows.
    Clear,
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
    form: Form,
    state: State,
    /// DRIVECOM: the handshake bit in `out`.
    handshake: bool,
    /// DRIVECOM: so many answers without a job had another one.
    differs: u8,
}

impl Job {
    /// That of a code by this path; an error is its status.
    pub(super) fn of(parameter: Parameter, write: Option<u64>, path: ParameterPath) -> Result<Job, u32> {
        let Parameter { code, sub, .. } = parameter;
        let size = parameter.kind().size().ok_or(NO_TEXT)?;
        let reaches = match path {
            ParameterPath::Pkw => code <= pkw::CODE_MAX,
            _ => Numbers::FromTop.index(code).is_some(),
        };
        if !reaches {
            return Err(UNREACHABLE);
        }
        Ok(Job { code, sub, size, write: write.map(|value| value as u32) })
    }

    fn pkw(&self) -> pkw::Request {
        let value = |value: u32| match self.size {
            Size::One | Size::Two => Value::Word(value as u16),
            Size::Three | Size::Four => Value::Double(value),
        };
        let job = match (self.write, self.sub) {
            (None, 0) => pkw::Job::Read,
            (None, _) => pkw::Job::ReadElement,
            (Some(raw), 0) => pkw::Job::Write(value(raw)),
            (Some(raw), _) => pkw::Job::WriteElement(value(raw)),
        };
        pkw::Request { job, code: self.code, subcode: self.sub }
    }

    fn drivecom(&self, handshake: bool) -> drivecom::Request {
        let job = match self.write {
            None => drivecom::Job::Read(self.size),
            Some(raw) => drivecom::Job::Write(self.size, raw),
        };
        let index = Numbers::FromTop.index(self.code).unwrap_or_default();
        drivecom::Request { job, handshake, index, subindex: self.sub }
    }
}

impl Channel {
    /// That of a drive with this path.
    pub(super) fn new(path: ParameterPath) -> Channel {
        let form = match path {
            ParameterPath::Pkw => Form::Pkw,
            ParameterPath::Drivecom => Form::Drivecom,
            ParameterPath::None | ParameterPath::Msac1 { .. } => Form::None,
        };
        let (out, state) = ([0; CHANNEL], if form == Form::None { State::Free } else { State::Clear });
        Channel { out, is_out: false, form, state, handshake: false, differs: 0 }
    }

    /// As it is to be in the outputs.
    #[inline]
    pub(super) fn out(&self) -> &[u8; CHANNEL] {
        &self.out
    }

    /// A job can begin.
    pub(super) fn is_free(&self) -> bool {
        self.state == State::Free
    }

    /// Begins a job.
    pub(super) fn begin(&mut self, job: Job) {
        let out = match self.form {
            Form::None => return,
            Form::Pkw => job.pkw().encode(),
            Form::Drivecom => {
                self.handshake = !self.handshake;
                Some(job.drivecom(self.handshake).encode())
            }
        };
        self.state = State::Job(job);
        self.put(out.unwrap_or_default());
    }

    fn put(&mut self, out: [u8; CHANNEL]) {
        self.is_out &= self.out == out;
        self.out = out;
    }

    /// There is no job any more.
    pub(super) fn clear(&mut self) {
        if self.form != Form::None {
            (self.state, self.differs) = (State::Clear, 0);
            self.put_none();
        }
    }

    fn put_none(&mut self) {
        let none = drivecom::Request { handshake: self.handshake, ..drivecom::Request::default() };
        self.put(if self.form == Form::Drivecom { none.encode() } else { [0; CHANNEL] });
    }

    /// The drive begins anew.
    pub(super) fn reset(&mut self) {
        (self.handshake, self.is_out) = (false, false);
        self.clear();
    }

    /// An exchange left, with the channel in it. True: it carries a job.
    pub(super) fn sent(&mut self) -> bool {
        self.is_out = true;
        matches!(self.state, State::Job(_))
    }

    /// The channel in the inputs of the last exchange: how the job has ended, if it has. An error is a status.
    pub(super) fn answered(&mut self, bytes: &[u8; CHANNEL]) -> Option<Result<u32, u32>> {
        // Else it answers what was there before.
        if !self.is_out {
            return None;
        }
        match self.state {
            State::Free => None,
            State::Clear => {
                self.cleared(bytes);
                None
            }
            State::Job(job) => {
                let ended = match self.form {
                    Form::Pkw => pkw_answer(&job, bytes)?,
                    _ => drivecom_answer(&job, self.handshake, bytes)?,
                };
                self.state = State::Free;
                // A write that stands there could be taken for a new one by a drive that has forgotten it.
                if self.form == Form::Pkw || job.write.is_some() {
                    self.clear();
                }
                Some(ended)
            }
        }
    }

    /// The drive may have shown that it knows of no job.
    fn cleared(&mut self, bytes: &[u8; CHANNEL]) {
        if self.form == Form::Pkw {
            if pkw::Reply::parse(bytes).response == Response::None {
                self.state = State::Free;
            }
        } else if drivecom::Reply::parse(bytes).handshake == self.handshake {
            self.state = State::Free;
        } else {
            // Not at each answer: a drive whose answers come late would change with it for ever.
            if self.differs.is_multiple_of(PATIENCE) {
                self.handshake = !self.handshake;
                self.put_none();
            }
            self.differs = self.differs.wrapping_add(1);
        }
    }
}

fn pkw_answer(job: &Job, bytes: &[u8; CHANNEL]) -> Option<Result<u32, u32>> {
    let reply = pkw::Reply::parse(bytes);
    if !reply.answers(&job.pkw()) {
        return None;
    }
    Some(match reply.response {
        Response::Value(Value::Word(word)) | Response::Element(Value::Word(word)) => Ok(word.into()),
        Response::Value(Value::Double(double)) | Response::Element(Value::Double(double)) => Ok(double),
        Response::Error(error) => Err(number(error)),
        Response::NoRight => Err(number(ErrorNumber::NO_RIGHT)),
        Response::None | Response::Unknown(_) => Err(BROKEN),
    })
}

/// Only the handshake and the error bit of its first byte are trusted; the length is that of the code.
fn drivecom_answer(job: &Job, handshake: bool, bytes: &[u8; CHANNEL]) -> Option<Result<u32, u32>> {
    let reply = drivecom::Reply::parse(bytes);
    let is_its = reply.answers(&job.drivecom(handshake));
    is_its.then(|| reply.result.map(|data| data.value(job.size)).map_err(drivecom_status))
}
