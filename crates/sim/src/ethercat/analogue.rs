//! An analogue input terminal: two channels of 16 bits with a status each, a mailbox and its objects.
//!
//! Each channel follows time, so that a reader sees that it lives: the first one rises by 1 a millisecond, the second
//! one falls. The status has nothing but the toggle bit, which changes with each value.

use super::Application;
use super::codec::mailbox::abort;
use super::codec::objects::Object;
use super::codec::registers::{AlState, code};
use super::mailbox::{Answer, Mailbox};
use super::settings::Dialect;
use super::sii::Contents;
use fieldbeat_core::time::{MS, Time};

/// The bytes of a channel: status, value.
const CHANNEL: usize = 4;
const CHANNELS: usize = 2;
/// Limits of a channel, which can be written, as an example of a setting.
const LIMIT: Object = Object::new(0x8000, 0x13);
/// A text of the user's, of up to so many bytes: longer than a message of its mailbox has room for. Assumed, as an
/// example of a string.
const TEXT: Object = Object::new(0x8005, 0);
const TEXT_MOST: usize = 128;

/// The terminal behind its controller.
#[derive(Debug)]
pub(super) struct Analogue {
    contents: Contents,
    mailbox: Mailbox,
    now: Time,
    limit: u16,
    text: Vec<u8>,
}

impl Analogue {
    pub(super) fn new(contents: Contents) -> Analogue {
        let room = contents.mailboxes.map(|mailboxes| usize::from(mailboxes.input.1));
        let mailbox = Mailbox::new(Dialect::Standard, room);
        Analogue { mailbox, contents, now: Time::default(), limit: 0, text: Vec::new() }
    }

    fn value(&self, channel: u16) -> i16 {
        let ms = (self.now.0 / MS) as i16;
        if channel == 0 { ms } else { ms.wrapping_neg() }
    }

    /// Whether the toggle bit is set.
    fn toggle(&self) -> bool {
        !(self.now.0 / MS).is_multiple_of(2)
    }

    /// The value of an object, as it is on the wire.
    fn read(&self, object: Object) -> Answer {
        let Contents { identity, serial, .. } = self.contents;
        let long = |value: u32| Ok(value.to_le_bytes().to_vec());
        match (object.index, object.sub) {
            (0x1000, 0) => long(0x0001_1389),
            (0x1008, 0) => Ok(self.contents.name.as_bytes().to_vec()),
            (0x1018, 0) => Ok(vec![4]),
            (0x1018, sub @ 1..=4) => {
                long([identity.vendor, identity.product, identity.revision, serial][usize::from(sub) - 1])
            }
            (0x1C00, 0) => Ok(vec![4]),
            (0x1C00, sub @ 1..=4) => Ok(vec![sub]),
            (0x1C12, 0) => Ok(vec![0]),
            (0x1C13, 0) => Ok(vec![self.contents.inputs.len() as u8]),
            (0x1C13, sub) => {
                let (assigned, _) = self.contents.inputs.get(usize::from(sub) - 1).ok_or(abort::NO_SUB)?;
                Ok(assigned.index.to_le_bytes().to_vec())
            }
            (0x1A00 | 0x1A02, sub) => {
                let pdo = self.contents.inputs.iter().find(|(pdo, _)| pdo.index == object.index);
                pdo.and_then(|(pdo, _)| pdo.value(sub)).ok_or(abort::NO_SUB)
            }
            (0x1800 | 0x1802, 0) => Ok(vec![9]),
            (0x1800 | 0x1802, 7) => Ok(vec![0]),
            (0x1800 | 0x1802, 9) => Ok(vec![self.toggle().into()]),
            (0x6000 | 0x6010, 0) => Ok(vec![0x11]),
            (0x6000 | 0x6010, 1 | 2 | 3 | 5 | 7) => Ok(vec![0]),
            (index @ (0x6000 | 0x6010), 0x11) => {
                Ok(self.value((index - 0x6000) / 0x10).to_le_bytes().to_vec())
            }
            _ if object == LIMIT => Ok(self.limit.to_le_bytes().to_vec()),
            _ if object == TEXT => Ok(self.text.clone()),
            (0x1000 | 0x1008 | 0x1018 | 0x1800 | 0x1802 | 0x1C00 | 0x1C12 | 0x6000 | 0x6010, _) => {
                Err(abort::NO_SUB)
            }
            _ => Err(abort::NO_OBJECT),
        }
    }

    fn write(&mut self, object: Object, data: &[u8]) -> Answer {
        match object {
            LIMIT => self.limit = u16::from_le_bytes(data.try_into().map_err(|_| abort::LENGTH)?),
            TEXT if data.len() > TEXT_MOST => return Err(abort::LENGTH),
            TEXT => self.text = data.to_vec(),
            _ => return self.read(object).and(Err(abort::READ_ONLY)),
        }
        Ok(Vec::new())
    }
}

impl Application for Analogue {
    fn mailbox(&mut self, request: &[u8], reply: &mut Vec<u8>) -> bool {
        if let Some(request) = self.mailbox.take(request) {
            let answer = match &request.data {
                _ if request.complete => Err(abort::NOT_COMPLETE),
                Some(data) => self.write(request.object, data),
                None => self.read(request.object),
            };
            self.mailbox.answer(&request, answer);
        }
        self.message(reply)
    }

    fn message(&mut self, message: &mut Vec<u8>) -> bool {
        self.mailbox.next().map(|next| *message = next).is_some()
    }

    fn may_enter(&mut self, _now: Time, state: AlState) -> Result<(), u16> {
        match state {
            AlState::Boot => return Err(code::NO_BOOT),
            AlState::Init => self.mailbox.reset(),
            _ => {}
        }
        Ok(())
    }

    fn process(&mut self, now: Time, _outputs: &[u8], inputs: &mut [u8]) {
        self.now = now;
        for (n, channel) in (0..).zip(inputs.chunks_exact_mut(CHANNEL)) {
            let [low, high] = self.value(n).to_le_bytes();
            channel.copy_from_slice(&[0, u8::from(self.toggle()) << 7, low, high]);
        }
    }

    fn check_sizes(&self, outputs: usize, inputs: usize) -> Result<(), u16> {
        match (outputs, inputs) {
            (1.., _) => Err(code::OUTPUTS),
            (_, inputs) if inputs != CHANNELS * CHANNEL => Err(code::INPUTS),
            _ => Ok(()),
        }
    }

    fn advance(&mut self, now: Time) {
        self.now = now;
    }
}
