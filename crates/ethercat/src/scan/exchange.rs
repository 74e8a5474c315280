//! A frame out and back.
//!
//! Each frame begins with a NOP with a mark: a reply counts by it alone, and an EtherCAT frame without it is that
//! of another master. Broken, circulated and late frames are skipped.

use super::ScanError;
use crate::image::Mark;
use crate::wire::frame::{BROADCAST, Builder, Command, Datagram, FRAME_MAX, datagrams, source};
use fieldbeat_core::net::Frames;
use fieldbeat_core::time::{MS, Time};

/// No master is expected to be slower than this.
const LISTEN_NS: u64 = 100 * MS;
/// A segment needs microseconds; the rest is for the two computers, one of which may be busy, or simulated.
const BACK_WITHIN_NS: u64 = 200 * MS;
/// A frame may be lost, and so may its repetition.
const ATTEMPTS: usize = 3;
/// How often it checks whether to go on.
const LOOK_MS: u8 = 10;

/// A datagram to be sent.
#[derive(Debug)]
pub struct Ask {
    command: Command,
    data: Vec<u8>,
}

impl Ask {
    pub(super) fn write(command: Command, data: &[u8]) -> Ask {
        Ask { command, data: data.to_vec() }
    }

    pub(super) fn read(command: Command, length: usize) -> Ask {
        Ask { command, data: vec![0; length] }
    }

    /// Whether this is the reply to it: slaves count positions, and leave the register.
    fn is(&self, back: &Datagram) -> bool {
        (back.number, back.address >> 16, back.data.len())
            == (self.command.number(), self.command.address() >> 16, self.data.len())
    }
}

/// A datagram that came back.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Answer {
    pub(super) data: Vec<u8>,
    /// How many slaves have carried it out.
    pub(super) count: u16,
}

/// Sends frames one by one.
pub(super) struct Exchange<'a> {
    frames: &'a mut dyn Frames,
    go_on: &'a dyn Fn() -> bool,
    mark: Mark,
}

impl<'a> Exchange<'a> {
    pub(super) fn new(frames: &'a mut dyn Frames, go_on: &'a dyn Fn() -> bool) -> Exchange<'a> {
        let master = (frames.now().0 as u32).rotate_left(16) ^ std::process::id();
        Exchange { frames, go_on, mark: Mark { master, number: 0 } }
    }

    pub(super) fn now(&mut self) -> Time {
        self.frames.now()
    }

    /// Listens for another master before anything is sent.
    pub(super) fn listen(&mut self) -> Result<(), ScanError> {
        let until = self.now() + LISTEN_NS;
        self.receive(&[], until).map(drop)
    }

    /// Sends these in one frame, again if it does not come back. `None`: it never did.
    pub(super) fn ask(&mut self, requests: &[Ask]) -> Result<Option<Vec<Answer>>, ScanError> {
        self.ask_until(requests, |_| true)
    }

    /// The same until the answer is `good`.
    pub(super) fn ask_until(
        &mut self,
        requests: &[Ask],
        good: impl Fn(&[Answer]) -> bool,
    ) -> Result<Option<Vec<Answer>>, ScanError> {
        for _ in 0..ATTEMPTS {
            self.mark.number = self.mark.number.wrapping_add(1);
            self.send(requests)?;
            let until = self.now() + BACK_WITHIN_NS;
            if let Some(answers) = self.receive(requests, until)?.filter(|answers| good(answers)) {
                return Ok(Some(answers));
            }
        }
        Ok(None)
    }

    fn send(&mut self, requests: &[Ask]) -> Result<(), ScanError> {
        let mut room = [0; FRAME_MAX];
        let mac = self.frames.mac();
        let Some(mut frame) = Builder::new(&mut room, BROADCAST, mac) else { return Ok(()) };
        frame.push_with(Command::Nop, 0, &self.mark.bytes());
        for (index, ask) in (1..).zip(requests) {
            frame.push_with(ask.command, index, &ask.data);
        }
        let length = frame.finish();
        self.frames.send(&room[..length]).map(drop).map_err(ScanError::Unsent)
    }

    /// Waits for the frame with the present mark.
    fn receive(&mut self, requests: &[Ask], until: Time) -> Result<Option<Vec<Answer>>, ScanError> {
        let mut room = [0; FRAME_MAX];
        loop {
            if !(self.go_on)() {
                return Err(ScanError::Interrupted);
            }
            let Some((_, length)) = self.frames.receive(&mut room) else {
                if self.now() >= until {
                    return Ok(None);
                }
                self.frames.wait(LOOK_MS);
                continue;
            };
            let answers = self.judge(&room[..length.min(FRAME_MAX)], requests)?;
            if answers.is_some() || self.now() >= until {
                return Ok(answers);
            }
        }
    }

    /// The answers in a received frame; `None`: it is of no use, and not another master's.
    fn judge(&self, frame: &[u8], requests: &[Ask]) -> Result<Option<Vec<Answer>>, ScanError> {
        let Ok(Ok(read)) = datagrams(frame).map(Iterator::collect::<Result<Vec<Datagram>, _>>) else {
            return Ok(None);
        };
        let Some((_, rest)) = read.split_first() else { return Ok(None) };
        let mark = Mark::of(frame);
        if mark.is_none_or(|mark| mark.master != self.mark.master) {
            return source(frame).map_or(Ok(None), |mac| Err(ScanError::Foreign(mac)));
        }
        let is_whole = rest.len() == requests.len()
            && rest.iter().zip(requests).all(|(back, ask)| ask.is(back) && !back.circulated);
        if mark != Some(self.mark) || !is_whole || requests.is_empty() {
            return Ok(None);
        }
        let answer = |back: &Datagram| Answer { data: back.data.to_vec(), count: back.working_counter };
        Ok(Some(rest.iter().map(answer).collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::other::tests::Interface;
    use crate::wire::frame::FRAME_MIN;

    /// A frame that begins with `mark`, and the answers to `requests`.
    fn frame(mark: &[u8], requests: &[Ask]) -> Vec<u8> {
        let mut room = [0; FRAME_MAX];
        let mut frame = Builder::new(&mut room, BROADCAST, [0x12; 6]).unwrap();
        frame.push_with(Command::Nop, 0, mark);
        for ask in requests {
            frame.push_with(ask.command, 1, &ask.data);
        }
        let length = frame.finish();
        room[..length].to_vec()
    }

    #[test]
    fn a_reply_counts_by_its_mark_and_its_shape() {
        let mut nobody = Interface::new(Vec::new(), None);
        let mut exchange = Exchange::new(&mut nobody, &|| true);
        exchange.mark.number = 3;
        let requests = [Ask::read(Command::Brd(0), 2)];
        let mark = exchange.mark.bytes();
        let good = frame(&mark, &requests);
        let changed = |at: usize, byte: u8| {
            let mut frame = good.clone();
            frame[at] = byte;
            frame
        };
        let (mut late, mut other) = (mark, mark);
        (late[4], other[0]) = (2, mark[0] ^ 1);
        let foreign = || Err(ScanError::Foreign([0x10, 0x12, 0x12, 0x12, 0x12, 0x12]));
        let answer = Answer { data: vec![0, 0], count: 0 };
        for (what, received, expected) in [
            ("good", good.clone(), Ok(Some(vec![answer]))),
            ("late", frame(&late, &requests), Ok(None)),
            ("of another shape", frame(&mark, &[Ask::read(Command::Brd(0x0130), 2)]), Ok(None)),
            ("of none", frame(&mark, &[]), Ok(None)),
            ("circulated", changed(16 + 20 + 7, good[16 + 20 + 7] | 1 << 6), Ok(None)),
            ("broken", changed(14, 0xFF), Ok(None)),
            ("of a gateway", changed(15, 0x50), Ok(None)),
            ("zeros", vec![0; FRAME_MIN], Ok(None)),
            ("empty", vec![], Ok(None)),
            ("with another mark", frame(&other, &requests), foreign()),
            ("with no mark", frame(&[0; 4], &requests), foreign()),
        ] {
            assert_eq!(exchange.judge(&received, &requests), expected, "{what}");
        }
    }
}
