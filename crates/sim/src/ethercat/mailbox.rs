//! The drive's mailbox: expedited SDOs of 16 bytes, longer ones if the drive supports them, and emergencies.
//!
//! Knows no object. One request at a time; answers wait in a queue, since an emergency may come before an answer. A
//! request with the counter of the previous one is a repetition and is ignored; the manual's dialect has no counter
//! (EtherCAT manual, "Mail Input"; ETG.1000.6).

use std::collections::VecDeque;

use super::settings::Dialect;
use super::transfer::{Step, Transfers, head};
use fieldbeat_ethercat::wire::mailbox::{Emergency, SDO_SIZE};
use fieldbeat_ethercat::wire::sdo::{AbortCode, EXPEDITED_MAX, Object};

/// A message in the mailbox: at least the 16 bytes of an expedited one.
pub(super) type Message = Vec<u8>;

/// Messages that wait to be read; emergencies above that are lost.
const QUEUE: usize = 16;

/// The offset of a mailbox message's content.
const HEADER: usize = 6;
const EOE: u8 = 2;
const COE: u8 = 3;
const EMERGENCY: u8 = 1;
const REQUEST: u8 = 2;
const RESPONSE: u8 = 3;
/// The command byte of an abort.
const ABORT: u8 = 0x80;
/// SDO information: a drive has no dictionary to offer, and reports that (opcode 7).
const INFORMATION: u8 = 8;
const INFORMATION_ERROR: u8 = 7;
const NO_DICTIONARY: AbortCode = AbortCode(0x0800_0023);

/// Why a mailbox message cannot be used at all (ETG.1000.4, 5.6).
mod error {
    pub const PROTOCOL: u16 = 2;
    pub const SERVICE: u16 = 4;
    pub const SHORT: u16 = 6;
    pub const SIZE: u16 = 8;
}

/// The content of a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Request {
    counter: u8,
    pub object: Object,
    /// For all subindices.
    pub complete: bool,
    /// The value to write; `None`: read.
    pub data: Option<Vec<u8>>,
    /// The answer to a write that is not expedited.
    answer: Option<Vec<u8>>,
}

/// The content of an answer.
pub(super) type Answer = Result<Vec<u8>, AbortCode>;

/// The mailbox of one drive.
#[derive(Debug)]
pub(super) struct Mailbox {
    dialect: Dialect,
    /// Of a drive that supports more than expedited transfers.
    transfers: Option<Transfers>,
    /// Counter of the last request; 0: none.
    last: u8,
    /// Data of the last answer: the bytes after a shorter one.
    stale: [u8; EXPEDITED_MAX],
    queue: VecDeque<Message>,
}

impl Mailbox {
    /// `room`: bytes of the mailbox that the master reads, of a drive that supports more than expedited transfers.
    pub(super) fn new(dialect: Dialect, room: Option<usize>) -> Mailbox {
        let transfers = room.map(Transfers::new);
        Mailbox { dialect, transfers, last: 0, stale: [0; EXPEDITED_MAX], queue: VecDeque::new() }
    }

    /// Switched off and on.
    pub(super) fn reset(&mut self) {
        (self.last, self.stale) = (0, [0; EXPEDITED_MAX]);
        self.queue.clear();
        self.transfers.iter_mut().for_each(Transfers::end);
    }

    /// Takes a written message. One that is not a request is answered here.
    pub(super) fn take(&mut self, written: &[u8]) -> Option<Request> {
        let Some(message) = written.first_chunk::<SDO_SIZE>() else {
            self.refuse(0, error::SHORT);
            return None;
        };
        let counter = message[5] >> 4 & 7;
        let counts = self.dialect == Dialect::Standard && counter != 0;
        if counts && counter == self.last {
            return None;
        }
        self.last = counter;
        let body = match read(message, written, &mut self.transfers) {
            Ok(Step::Read { object, complete }) => {
                return Some(Request { counter, object, complete, data: None, answer: None });
            }
            Ok(Step::Write { object, complete, data, answer }) => {
                return Some(Request { counter, object, complete, data: Some(data), answer });
            }
            Ok(Step::Nothing) => return None,
            Err(Trouble::Refused(code)) => {
                self.refuse(counter, code);
                return None;
            }
            Err(Trouble::NoDictionary) => {
                let [a, b, c, d] = NO_DICTIONARY.0.to_le_bytes();
                let content = [0, INFORMATION << 4, INFORMATION_ERROR, 0, 0, 0, a, b, c, d];
                self.push(0, COE | counter << 4, &content);
                return None;
            }
            Ok(Step::Answer(body)) => body,
            Err(Trouble::Abort(object, code)) => abort(object, code),
        };
        self.reply(counter, body);
        None
    }

    /// Answers a request.
    pub(super) fn answer(&mut self, request: &Request, answer: Answer) {
        let Request { counter, object, complete, .. } = *request;
        let body = match (answer, &request.data, &mut self.transfers) {
            (Err(code), ..) => abort(object, code),
            (Ok(_), Some(_), _) => {
                request.answer.clone().unwrap_or_else(|| head(0x60, object, [0; EXPEDITED_MAX]))
            }
            (Ok(value), None, Some(transfers)) if value.len() > EXPEDITED_MAX => {
                transfers.begin_upload(object, complete, value)
            }
            (Ok(value), None, _) => {
                // Unused bytes of the four are old memory.
                self.stale.iter_mut().zip(&value).for_each(|(stale, byte)| *stale = *byte);
                let unused = EXPEDITED_MAX.saturating_sub(value.len()) as u8 & 3;
                head(if complete { 0x53 } else { 0x43 } | unused << 2, object, self.stale)
            }
        };
        self.reply(counter, body);
    }

    /// An answer in the drive's dialect. An abort has the service of a request (ETG.1000.6, 5.6.2.7).
    fn reply(&mut self, counter: u8, body: Vec<u8>) {
        let (longer, counter, service) = match self.dialect {
            Dialect::Standard if body.first() == Some(&ABORT) => (0, counter, REQUEST),
            Dialect::Standard => (0, counter, RESPONSE),
            Dialect::Manual => (4, 0, REQUEST),
        };
        let mut content = vec![0, service << 4];
        content.extend(body);
        self.push(longer, COE | counter << 4, &content);
    }

    /// Reports an event of the drive.
    pub(super) fn report(&mut self, emergency: Emergency) {
        let [low, high] = emergency.code.to_le_bytes();
        let [a, b, c, d, e] = emergency.vendor;
        self.push(0, COE, &[0, EMERGENCY << 4, low, high, emergency.register, a, b, c, d, e]);
    }

    /// Ethernet over EtherCAT, unknown to the master: the begin of a broadcast.
    pub(super) fn disturb(&mut self) {
        self.push(0, EOE, &[0, 1, 0, 0, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF]);
    }

    /// A message that cannot be used.
    fn refuse(&mut self, counter: u8, code: u16) {
        let [low, high] = code.to_le_bytes();
        let mut message = vec![0; SDO_SIZE];
        message[..10].copy_from_slice(&[4, 0, 0, 0, 0, counter << 4, 1, 0, low, high]);
        self.enqueue(message);
    }

    /// A message with this content; its length field is larger by `longer`.
    fn push(&mut self, longer: u16, kind: u8, content: &[u8]) {
        let length = content.len().max(SDO_SIZE - HEADER) as u16;
        let mut message = vec![0; HEADER];
        message[..2].copy_from_slice(&(length + longer).to_le_bytes());
        message[5] = kind;
        message.extend(content);
        message.resize(HEADER + usize::from(length), 0);
        self.enqueue(message);
    }

    fn enqueue(&mut self, message: Message) {
        if self.queue.len() < QUEUE {
            self.queue.push_back(message);
        }
    }

    /// Nothing waits to be read.
    pub(super) fn is_empty(&self) -> bool {
        self.queue.is_empty()
    }

    /// The next message to be read.
    pub(super) fn next(&mut self) -> Option<Message> {
        self.queue.pop_front()
    }
}

enum Trouble {
    NoDictionary,
    Refused(u16),
    Abort(Object, AbortCode),
}

fn abort(object: Object, code: AbortCode) -> Vec<u8> {
    head(ABORT, object, code.0.to_le_bytes())
}

/// Reads a message: its first bytes, and all written bytes.
fn read(
    message: &[u8; SDO_SIZE],
    written: &[u8],
    transfers: &mut Option<Transfers>,
) -> Result<Step, Trouble> {
    let [l0, l1, _, _, _, kind, _, service, command, low, high, sub, data @ ..] = *message;
    if kind & 0x0F != COE {
        return Err(Trouble::Refused(error::PROTOCOL));
    }
    if service >> 4 == INFORMATION {
        return Err(Trouble::NoDictionary);
    }
    let length = usize::from(u16::from_le_bytes([l0, l1]));
    let least = SDO_SIZE - HEADER;
    let content = match transfers {
        Some(_) if length >= least => written.get(HEADER..HEADER + length),
        _ => written.get(HEADER..SDO_SIZE).filter(|_| length == least),
    };
    let Some(content) = content else { return Err(Trouble::Refused(error::SIZE)) };
    if service >> 4 != REQUEST {
        return Err(Trouble::Refused(error::SERVICE));
    }
    let object = Object::new(u16::from_le_bytes([low, high]), sub);
    let complete = command & 0x10 != 0;
    let refused = |code| Trouble::Abort(object, code);
    let Some(transfers) = transfers else { return read_expedited(command, object, data).map_err(refused) };
    let step = match command {
        0x21 | 0x31 => {
            transfers.begin_download(object, complete, u32::from_le_bytes(data), &content[least..])
        }
        0x00..=0x1F => transfers.download_segment(command, &content[3..]),
        0x60 | 0x70 => transfers.upload_segment(command).map(Step::Answer),
        0x80 => {
            transfers.end();
            return Ok(Step::Nothing);
        }
        0x50 => return Ok(Step::Read { object, complete }),
        0x33 | 0x37 | 0x3B | 0x3F => return Ok(write(command, object, data)),
        _ => {
            transfers.end();
            return read_expedited(command, object, data).map_err(refused);
        }
    };
    step.map_err(refused)
}

/// Requests that every drive supports.
fn read_expedited(command: u8, object: Object, data: [u8; EXPEDITED_MAX]) -> Result<Step, AbortCode> {
    match command {
        0x40 => Ok(Step::Read { object, complete: false }),
        0x23 | 0x27 | 0x2B | 0x2F => Ok(write(command, object, data)),
        // Complete access.
        0x30..=0x3F | 0x50..=0x5F => Err(AbortCode::NOT_COMPLETE),
        0x80 => Ok(Step::Nothing),
        // Segments, and sizes that do not fit into the message.
        _ => Err(AbortCode::COMMAND),
    }
}

fn write(command: u8, object: Object, data: [u8; EXPEDITED_MAX]) -> Step {
    let used = EXPEDITED_MAX - usize::from(command >> 2 & 3);
    Step::Write { object, complete: command & 0x10 != 0, data: data[..used].to_vec(), answer: None }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::hex;
    use fieldbeat_ethercat::wire::mailbox::{MailboxError, Message as Parsed, parse};
    use fieldbeat_ethercat::wire::sdo::Response;

    const READ: [u8; SDO_SIZE] = [0x0A, 0, 0, 0, 0, 0x13, 0, 0x20, 0x40, 0, 0x1C, 0, 0, 0, 0, 0];
    const SELECT: [u8; SDO_SIZE] = [0x0A, 0, 0, 0, 0, 0x03, 0, 0x20, 0x2B, 0x12, 0x1C, 1, 4, 0x17, 0, 0];

    #[test]
    fn answers_are_those_of_a_real_drive_and_of_the_manual_to_the_byte() {
        let standard = "0A00 0000 00 13 0030 4F 001C 00 04000000";
        let manual = "0E00 0000 00 03 0020 60 121C 01 00000000";
        for (dialect, sent, object, data, value, answer) in [
            (Dialect::Standard, READ, Object::new(0x1C00, 0), None, vec![4], standard),
            (Dialect::Manual, SELECT, Object::new(0x1C12, 1), Some(vec![4, 0x17]), vec![], manual),
        ] {
            let mut mailbox = Mailbox::new(dialect, None);
            let request = mailbox.take(&sent).unwrap();
            assert_eq!((request.object, &request.data), (object, &data));
            mailbox.answer(&request, Ok(value));
            assert_eq!([mailbox.next(), mailbox.next()], [Some(hex(answer)), None]);
        }
        let mut mailbox = Mailbox::new(Dialect::Standard, None);
        mailbox.report(Emergency { code: 0x4310, register: 8, vendor: [1, 0, 0, 0, 0] });
        assert_eq!(mailbox.next(), Some(hex("0A00 0000 00 03 0010 1043 08 01 00000000")));
        (0..100).for_each(|_| mailbox.report(Emergency::default()));
        assert_eq!(mailbox.queue.len(), QUEUE);
    }

    #[test]
    fn what_the_drive_cannot_do_is_refused_by_its_code() {
        let aborted = |code| Some(Response::Abort { object: Object::new(0x1C12, 1), code });
        for (place, byte, abort, refused) in [
            (8, 0x21, aborted(AbortCode::COMMAND), None),
            (8, 0x60, aborted(AbortCode::COMMAND), None),
            (8, 0x50, aborted(AbortCode::NOT_COMPLETE), None),
            (5, 0x02, None, Some(error::PROTOCOL)),
            (7, 0x90, None, Some(error::SERVICE)),
            (0, 200, None, Some(error::SIZE)),
        ] {
            let mut mailbox = Mailbox::new(Dialect::Standard, None);
            let mut message = SELECT;
            message[place] = byte;
            assert_eq!(mailbox.take(&message), None);
            let answer = mailbox.next().unwrap();
            let parsed = parse(&answer);
            match (abort, refused) {
                (Some(response), _) => {
                    assert_eq!(answer[7..9], [REQUEST << 4, ABORT], "an abort is a request itself");
                    assert!(matches!(parsed, Some(Parsed::Sdo { response: own, .. }) if own == response));
                }
                (_, code) => assert_eq!(parsed, code.map(|code| Parsed::Refused(MailboxError(code)))),
            }
        }
        let mut mailbox = Mailbox::new(Dialect::Standard, None);
        let mut abort = SELECT;
        abort[8] = 0x80;
        assert_eq!((mailbox.take(&abort), mailbox.next()), (None, None), "an abort has no answer");
        assert!(mailbox.take(&SELECT[..15]).is_none() && mailbox.next().is_some());
    }

    #[test]
    fn a_drive_that_can_do_more_serves_long_objects_and_all_subindices() {
        let mut mailbox = Mailbox::new(Dialect::Standard, Some(32));
        let with = |mut message: [u8; SDO_SIZE], counter: u8, command: u8| {
            (message[5], message[8]) = (counter << 4 | 3, command);
            message
        };
        let request = mailbox.take(&with(READ, 1, 0x50)).unwrap();
        assert!(request.complete && request.data.is_none());
        mailbox.answer(&request, Ok((0..20).collect()));
        let first = mailbox.next().unwrap();
        assert_eq!(first[..16], [26, 0, 0, 0, 0, 0x13, 0, 0x30, 0x51, 0, 0x1C, 0, 20, 0, 0, 0]);
        assert_eq!((first.len(), first[31]), (32, 15));
        assert_eq!(mailbox.take(&with(READ, 2, 0x60)), None);
        let last = mailbox.next().unwrap();
        assert_eq!(
            last,
            [10, 0, 0, 0, 0, 0x23, 0, 0x30, 0x07, 16, 17, 18, 19, 0, 0, 0],
            "four of seven, the last"
        );
        // Written in one message that is longer than 16 bytes.
        let mut write = with(SELECT, 3, 0x31).to_vec();
        write[0] = 16;
        write[12..16].copy_from_slice(&[6, 0, 0, 0]);
        write.extend([1, 0, 4, 0x17, 9, 9]);
        let request = mailbox.take(&write).unwrap();
        assert_eq!((request.complete, request.data.clone()), (true, Some(vec![1, 0, 4, 0x17, 9, 9])));
        mailbox.answer(&request, Ok(Vec::new()));
        assert_eq!(mailbox.next().unwrap()[8], 0x60);
        write[0] = 40;
        write[5] = 0x43;
        assert!(mailbox.take(&write).is_none(), "longer than what was written");
        assert_eq!(mailbox.next().unwrap()[..10], [4, 0, 0, 0, 0, 0x40, 1, 0, 8, 0]);
        let request = mailbox.take(&with(READ, 5, 0x40)).unwrap();
        mailbox.answer(&request, Ok(vec![7]));
        assert_eq!(mailbox.next().unwrap()[8], 0x4F, "a short one is expedited all the same");
    }
}
