//! The link layer of a slave: which requests it takes, what it answers, and when.
//!
//! Knows no service of DP. Facts: sheet, 5. The memory of a frame count bit belongs to the pair of stations: a request
//! with the same bit again is answered from it, whatever it brings.

use super::Misuse;
use super::telegram::{self, BROADCAST, Frame, Telegram};
use fieldbeat_core::net::SerialLine;
use fieldbeat_core::time::Time;

/// Bits of the function code of a request.
const FCB: u8 = 0x20;
const FCV: u8 = 0x10;

/// Function codes of requests.
pub(super) mod request {
    pub const SDA: [u8; 2] = [3, 5];
    pub const SDN: [u8; 2] = [4, 6];
    pub const MULTICAST: u8 = 7;
    pub const FDL_STATUS: u8 = 9;
    pub const SRD: [u8; 2] = [0xC, 0xD];
    pub const IDENT: u8 = 0xE;
    pub const LSAP_STATUS: u8 = 0xF;
}

/// Function codes of responses. Their station type, in bits 5 and 4, is 0: a slave.
pub(super) mod response {
    pub const OK: u8 = 0;
    pub const USER_ERROR: u8 = 1;
    pub const NO_RESOURCE: u8 = 2;
    pub const NO_SERVICE: u8 = 3;
    pub const DATA: u8 = 8;
    pub const DATA_HIGH: u8 = 0xA;
}

/// The answer to a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Answer {
    /// SC.
    Ack,
    /// A function code without data.
    Status(u8),
    /// A function code with the data that was written.
    Data(u8),
}

/// The services of a station.
pub(super) trait Services {
    /// A request: appends the data of its answer to `out`.
    fn request(&mut self, now: Time, frame: &Frame<'_>, misuse: &mut Misuse, out: &mut Vec<u8>) -> Answer;

    /// A request that is answered from memory.
    fn repeated(&mut self, now: Time, frame: &Frame<'_>);

    /// A telegram to this station, or to all, that nobody answers.
    fn unanswered(&mut self, now: Time, frame: &Frame<'_>, misuse: &mut Misuse);

    /// The time before an answer, bits.
    fn answer_bits(&self) -> u16;
}

/// What was last received from a master, and answered.
#[derive(Debug, Default)]
struct Memory {
    master: u8,
    fcb: bool,
    request: Vec<u8>,
    answer: Vec<u8>,
}

/// The link layer of one station.
#[derive(Debug)]
pub(super) struct Link {
    address: u8,
    line: SerialLine,
    sd3: bool,
    memories: Vec<Memory>,
    /// The answer, and when it begins.
    answer: Vec<u8>,
    due: Option<Time>,
    /// From the end of the last request to the end of its answer.
    busy: (Time, Time),
    /// Behind a real port: nobody knows when a byte was sent.
    untimed: bool,
    data: Vec<u8>,
    pub misuse: Misuse,
    /// Requests that were answered from memory.
    pub repeated: u64,
}

impl Link {
    pub(super) fn new(address: u8, line: SerialLine, sd3: bool) -> Link {
        Link {
            address,
            line,
            sd3,
            memories: Vec::new(),
            answer: Vec::new(),
            due: None,
            busy: (Time(0), Time(0)),
            untimed: false,
            data: Vec::new(),
            misuse: Misuse::default(),
            repeated: 0,
        }
    }

    /// Behind a real port from now on.
    pub(super) fn untimed(&mut self) {
        self.untimed = true;
    }

    /// Power was lost.
    pub(super) fn restart(&mut self) {
        self.memories.clear();
        self.due = None;
        self.busy = (Time(0), Time(0));
    }

    #[cfg(test)]
    pub(super) fn address(&self) -> u8 {
        self.address
    }

    pub(super) fn next_due(&self) -> Option<Time> {
        self.due
    }

    /// The answer begins now: its end.
    pub(super) fn send(&mut self, now: Time, out: &mut Vec<u8>) -> Option<Time> {
        self.due.take_if(|due| *due <= now)?;
        out.extend_from_slice(&self.answer);
        self.busy.1 = now + self.line.span_ns(self.answer.len());
        Some(self.busy.1)
    }

    /// So many bytes in a row end now: while an answer is to come, nobody may speak.
    pub(super) fn overlap(&mut self, now: Time, count: usize) {
        let begin = now - self.line.span_ns(count);
        if !self.untimed && now > self.busy.0 && begin < self.busy.1 {
            self.misuse.interrupted += 1;
        }
    }

    /// A whole telegram that ends at `now`.
    /// There was silence for a request before it, or not.
    pub(super) fn telegram(&mut self, now: Time, silence: bool, bytes: &[u8], services: &mut impl Services) {
        let frame = match telegram::parse(bytes) {
            Ok(Telegram::Token { .. }) => {
                self.misuse.too_early += u64::from(!silence);
                return;
            }
            Ok(Telegram::Frame(frame)) if frame.is_request() => frame,
            _ => return,
        };
        if frame.to != self.address && frame.to != BROADCAST {
            return;
        }
        if !silence {
            return self.misuse.too_early += 1;
        }
        if frame.from >= BROADCAST || frame.from == self.address {
            return self.misuse.source += 1;
        }
        let code = frame.function & 0x0F;
        let counted = frame.function & (FCB | FCV);
        if request::SDN.contains(&code) {
            match counted {
                0 => services.unanswered(now, &frame, &mut self.misuse),
                _ => self.misuse.frame_count += 1,
            }
        } else if frame.to == BROADCAST {
            self.misuse.broadcast += 1;
        } else if code == request::FDL_STATUS {
            if counted != 0 || frame.saps != (None, None) || !frame.data.is_empty() {
                return self.misuse.frame_count += 1;
            }
            self.reply(&frame, Answer::Status(response::OK));
            self.answer_at(now, services);
        } else if request::SRD.contains(&code) || request::SDA.contains(&code) {
            self.counted(now, &frame, bytes, services);
        } else if matches!(code, request::IDENT | request::LSAP_STATUS) {
            self.reply(&frame, Answer::Status(response::NO_SERVICE));
            self.answer_at(now, services);
        } else if code != request::MULTICAST {
            self.misuse.function += 1;
        }
    }

    /// A request with a frame count bit.
    fn counted(&mut self, now: Time, frame: &Frame<'_>, bytes: &[u8], services: &mut impl Services) {
        let (fcb, fcv) = (frame.function & FCB != 0, frame.function & FCV != 0);
        if !fcb && !fcv {
            return self.misuse.frame_count += 1;
        }
        let known = self.memories.iter().position(|memory| memory.master == frame.from);
        let place = known.unwrap_or(self.memories.len());
        if known.is_none() {
            self.memories.push(Memory { master: frame.from, ..Memory::default() });
        }
        if known.is_some() && fcv && self.memories[place].fcb == fcb {
            let memory = &self.memories[place];
            self.repeated += 1;
            self.misuse.changed_retry += u64::from(memory.request != bytes);
            self.answer.clear();
            self.answer.extend_from_slice(&memory.answer);
            services.repeated(now, frame);
            return self.answer_at(now, services);
        }
        self.data.clear();
        let answer = match request::SRD.contains(&(frame.function & 0x0F)) {
            true => services.request(now, frame, &mut self.misuse, &mut self.data),
            false => Answer::Status(response::NO_SERVICE),
        };
        self.reply(frame, answer);
        let memory = &mut self.memories[place];
        memory.fcb = fcb;
        memory.request.clear();
        memory.request.extend_from_slice(bytes);
        memory.answer.clear();
        memory.answer.extend_from_slice(&self.answer);
        self.answer_at(now, services);
    }

    /// Writes the answer to a request.
    fn reply(&mut self, frame: &Frame<'_>, answer: Answer) {
        self.answer.clear();
        let (function, data, saps) = match answer {
            Answer::Ack => return telegram::append_ack(&mut self.answer),
            Answer::Status(function) => (function, &[][..], (None, None)),
            Answer::Data(function) => (function, &self.data[..], (frame.saps.1, frame.saps.0)),
        };
        let reply = Frame { to: frame.from, from: self.address, saps, function, data };
        telegram::append(&reply, self.sd3, &mut self.answer);
    }

    fn answer_at(&mut self, now: Time, services: &impl Services) {
        self.due = Some(now + self.line.bits_ns(services.answer_bits().into()));
        self.busy = (now, Time(u64::MAX));
    }
}
