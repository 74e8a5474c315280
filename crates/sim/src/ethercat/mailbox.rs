//! The mailbox of a slave with objects: expedited SDOs, longer ones if the slave supports them, and emergencies.
//!
//! Knows no object. One request at a time; answers wait in a queue, since an emergency may come before an answer. A
//! request with the counter of the previous one is a repetition and is ignored; the manual's dialect has no counter
//! (EtherCAT manual, "Mail Input"; ETG.1000.6, 5.6.2). One transfer at a time: a new one, or an abort, ends it.

use std::collections::VecDeque;

use super::codec::mailbox::{EXPEDITED_MAX, Kind, SDO_SIZE, abort, counter, request};
use super::codec::mailbox::{
    aborted, emergency, long_value, no_information, refused, response, response_of_manual, segment,
    segment_taken, value, written,
};
use super::codec::objects::Object;
use super::settings::Dialect;

/// Messages that wait to be read; emergencies above that are lost.
const QUEUE: usize = 16;
/// The most bytes that a master may announce.
const LONGEST: usize = 4_096;
/// Bytes of a message before the data of a segment.
const SEGMENT_HEADER: usize = 9;

/// An SDO that is to be carried out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Request {
    counter: u8,
    pub object: Object,
    /// For all subindices.
    pub complete: bool,
    /// The value to write; `None`: read.
    pub data: Option<Vec<u8>>,
    /// The answer to a write.
    answer: Vec<u8>,
}

/// The value that was read, or why a request is not carried out.
pub(super) type Answer = Result<Vec<u8>, u32>;

/// The consequence of a message.
enum Step {
    /// An SDO to be carried out.
    Request(Request),
    /// An answer.
    Answer(Vec<u8>),
}

#[derive(Debug)]
struct Upload {
    rest: Vec<u8>,
    toggle: bool,
}

#[derive(Debug)]
struct Download {
    request: Request,
    size: usize,
    data: Vec<u8>,
    toggle: bool,
}

/// The mailbox of one slave.
#[derive(Debug, Default)]
pub(super) struct Mailbox {
    dialect: Dialect,
    /// Bytes of the mailbox that the master reads, of a slave that supports more than expedited transfers.
    room: Option<usize>,
    upload: Option<Upload>,
    download: Option<Download>,
    /// Counter of the last request; 0: none.
    last: u8,
    /// Data of the last answer: the bytes after a shorter one.
    stale: [u8; EXPEDITED_MAX],
    queue: VecDeque<Vec<u8>>,
}

impl Mailbox {
    /// `room`: bytes of the mailbox that the master reads, of a slave that supports more than expedited transfers.
    pub(super) fn new(dialect: Dialect, room: Option<usize>) -> Mailbox {
        Mailbox { dialect, room: room.map(|room| room.max(SDO_SIZE)), ..Mailbox::default() }
    }

    /// Switched off and on.
    pub(super) fn reset(&mut self) {
        *self = Mailbox::new(self.dialect, self.room);
    }

    /// Takes a written message. One that needs no object is answered here.
    pub(super) fn take(&mut self, buffer: &[u8]) -> Option<Request> {
        let counter = if buffer.len() < SDO_SIZE { 0 } else { counter(buffer) };
        if self.dialect == Dialect::Standard && counter != 0 && counter == self.last {
            return None;
        }
        self.last = counter;
        let request = match request(buffer, self.room.is_some()) {
            Ok(request) => request,
            Err(code) => {
                self.enqueue(refused(counter, code));
                return None;
            }
        };
        let (object, complete) = (request.object, request.complete);
        let taken = Request { counter, object, complete, data: None, answer: written(object) };
        if !matches!(request.kind, Kind::Segment { .. } | Kind::Next(_)) {
            (self.upload, self.download) = (None, None);
        }
        let answer = match request.kind {
            Kind::Information => {
                self.enqueue(no_information(counter));
                return None;
            }
            Kind::Abort => return None,
            _ if complete && self.room.is_none() => Err(abort::NOT_COMPLETE),
            Kind::Upload => return Some(taken),
            Kind::Download(data) => return Some(Request { data: Some(data.to_vec()), ..taken }),
            Kind::Begin(size, data) if self.room.is_some() => self.begin(taken, size, data),
            Kind::Segment { toggle, last, data } => self.download(counter, toggle, last, data),
            Kind::Next(toggle) => self.upload(toggle).map(Step::Answer),
            Kind::Unknown if complete => Err(abort::NOT_COMPLETE),
            Kind::Begin(..) | Kind::Unknown => Err(abort::COMMAND),
        };
        match answer {
            Ok(Step::Request(whole)) => return Some(whole),
            Ok(Step::Answer(body)) => self.reply(counter, &body),
            Err(code) => self.reply(counter, &aborted(object, code)),
        }
        None
    }

    /// A write of `size` bytes begins: the whole request, or the answer until it is whole.
    fn begin(&mut self, request: Request, size: u32, data: &[u8]) -> Result<Step, u32> {
        let size = usize::try_from(size).ok().filter(|size| *size <= LONGEST && data.len() <= *size);
        let (size, data) = (size.ok_or(abort::LENGTH)?, data.to_vec());
        if data.len() == size {
            return Ok(Step::Request(Request { data: Some(data), ..request }));
        }
        let answer = request.answer.clone();
        self.download = Some(Download { request, size, data, toggle: false });
        Ok(Step::Answer(answer))
    }

    /// A piece of it comes.
    fn download(&mut self, counter: u8, toggle: bool, last: bool, data: &[u8]) -> Result<Step, u32> {
        let mut download = self.download.take().ok_or(abort::COMMAND)?;
        if toggle != download.toggle {
            return Err(abort::TOGGLE);
        }
        download.data.extend(data);
        download.toggle = !toggle;
        let (there, size) = (download.data.len(), download.size);
        if there > size || last && there < size {
            return Err(abort::LENGTH);
        }
        let answer = segment_taken(toggle);
        if last {
            return Ok(Step::Request(Request {
                counter,
                data: Some(download.data),
                answer,
                ..download.request
            }));
        }
        self.download = Some(download);
        Ok(Step::Answer(answer))
    }

    /// The next piece of what is read.
    fn upload(&mut self, toggle: bool) -> Result<Vec<u8>, u32> {
        let (mut upload, room) = self.upload.take().zip(self.room).ok_or(abort::COMMAND)?;
        if toggle != upload.toggle {
            return Err(abort::TOGGLE);
        }
        let piece: Vec<u8> = upload.rest.drain(..upload.rest.len().min(room - SEGMENT_HEADER)).collect();
        upload.toggle = !toggle;
        let last = upload.rest.is_empty();
        self.upload = Some(upload).filter(|_| !last);
        Ok(segment(toggle, last, &piece))
    }

    /// Answers a request.
    pub(super) fn answer(&mut self, request: &Request, answer: Answer) {
        let Request { counter, object, complete, .. } = *request;
        let body = match (answer, self.room) {
            (Err(code), _) => aborted(object, code),
            (Ok(_), _) if request.data.is_some() => request.answer.clone(),
            (Ok(mut long), Some(room)) if long.len() > EXPEDITED_MAX => {
                let size = long.len();
                let rest = long.split_off(size.min(room - SDO_SIZE));
                self.upload = (!rest.is_empty()).then_some(Upload { rest, toggle: false });
                long_value(object, complete, size as u32, &long)
            }
            (Ok(short), _) => {
                // Unused bytes of the four are old memory.
                self.stale.iter_mut().zip(&short).for_each(|(stale, byte)| *stale = *byte);
                value(object, complete, short.len(), self.stale)
            }
        };
        self.reply(counter, &body);
    }

    /// An answer in the drive's dialect.
    fn reply(&mut self, counter: u8, body: &[u8]) {
        self.enqueue(match self.dialect {
            Dialect::Standard => response(counter, body),
            Dialect::Manual => response_of_manual(body),
        });
    }

    /// Reports a fault by its code, register and category; all 0: its end.
    pub(super) fn report(&mut self, code: u16, register: u8, category: u8) {
        self.enqueue(emergency(code, register, [category, 0, 0, 0, 0]));
    }

    fn enqueue(&mut self, message: Vec<u8>) {
        if self.queue.len() < QUEUE {
            self.queue.push_back(message);
        }
    }

    /// The next message to be read.
    pub(super) fn next(&mut self) -> Option<Vec<u8>> {
        self.queue.pop_front()
    }
}

#[cfg(test)]
mod tests;
