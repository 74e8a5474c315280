//! A master for tests: it sends datagrams one by one; and a scripted application.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::codec::frame::Command::{self, Apwr, Fprd, Fpwr, Nop};
use super::codec::registers::{AlState, Fmmu, SyncManager, address, al, code};
use super::sii::{Contents, Mailboxes};
use super::{Application, Esc, Segment, Settings};
use fieldbeat_core::time::{MS, S, Time};

/// The behaviour of an application, and its calls.
#[derive(Debug, Default)]
pub(super) struct Script {
    pub(super) sizes: Option<(usize, usize)>,
    pub(super) inputs: Vec<u8>,
    pub(super) refuses: Option<(AlState, u16)>,
    pub(super) drops: Option<u16>,
    pub(super) messages: Vec<Vec<u8>>,
    pub(super) requested: Vec<AlState>,
    pub(super) requests: Vec<Vec<u8>>,
    /// When it ran, and with which outputs.
    pub(super) cycles: Vec<(Time, Vec<u8>)>,
}

/// A script that is shared by the test and the application.
#[derive(Clone, Debug, Default)]
pub(super) struct Scripted(Arc<Mutex<Script>>);

impl Scripted {
    pub(super) fn script(&self) -> MutexGuard<'_, Script> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Application for Scripted {
    /// Answers with the first 16 bytes of the message, in reverse.
    fn mailbox(&mut self, request: &[u8], reply: &mut Vec<u8>) -> bool {
        let mut script = self.script();
        script.requests.push(request.to_vec());
        reply.extend(request.iter().take(16).rev());
        true
    }

    fn may_enter(&mut self, _now: Time, state: AlState) -> Result<(), u16> {
        let mut script = self.script();
        script.requested.push(state);
        script.refuses.filter(|(refused, _)| *refused == state).map_or(Ok(()), |(_, code)| Err(code))
    }

    fn process(&mut self, now: Time, outputs: &[u8], inputs: &mut [u8]) {
        let mut script = self.script();
        script.cycles.push((now, outputs.to_vec()));
        for (input, own) in inputs.iter_mut().zip(&script.inputs) {
            *input = *own;
        }
    }

    fn check_sizes(&self, outputs: usize, inputs: usize) -> Result<(), u16> {
        match self.script().sizes {
            Some(sizes) if sizes.0 != outputs => Err(0x001D),
            Some(sizes) if sizes.1 != inputs => Err(0x001E),
            _ => Ok(()),
        }
    }

    fn message(&mut self, message: &mut Vec<u8>) -> bool {
        let next = self.script().messages.pop();
        next.map(|next| message.extend(next)).is_some()
    }

    fn dropped(&mut self) -> Option<u16> {
        self.script().drops.take()
    }
}

/// A slave with a mailbox.
pub(super) fn with_mailbox() -> Settings {
    let mailboxes = Mailboxes { out: (0x1800, 0x400), input: (0x1C00, 0x400), protocols: 4 };
    let contents = Contents { alias: 0x77, mailboxes: Some(mailboxes), ..Contents::default() };
    Settings { sii: contents.image(), ..Settings::default() }
}

/// The address of a logical command.
pub(super) fn logical(command: Command, address: u32) -> (Command, u16, u16) {
    (command, address as u16, (address >> 16) as u16)
}

/// A segment, and a master's time.
pub(super) struct Bench {
    pub(super) segment: Segment,
    pub(super) now: Time,
    pub(super) scripts: Vec<Scripted>,
}

impl Bench {
    /// An existing segment, with station addresses from 0x1001 on.
    pub(super) fn of(segment: Segment) -> Bench {
        let count = segment.slaves() as u16;
        let mut bench = Bench::left(segment);
        for n in 0..count {
            let station = (0x1001 + n).to_le_bytes();
            assert_eq!(bench.send((Apwr, n.wrapping_neg(), address::STATION), &station).1, 1);
        }
        bench
    }

    /// An existing segment with the station addresses that it has.
    pub(super) fn left(segment: Segment) -> Bench {
        Bench { segment, now: Time(S), scripts: Vec::new() }
    }

    /// A segment of scripted slaves.
    pub(super) fn new(settings: Vec<Settings>) -> Bench {
        let scripts: Vec<Scripted> = settings.iter().map(|_| Scripted::default()).collect();
        let slaves = settings.into_iter().zip(&scripts);
        let slaves = slaves.map(|(settings, script)| Esc::new(settings, Box::new(script.clone()))).collect();
        Bench { scripts, ..Bench::of(Segment::new(slaves)) }
    }

    /// Two drives with mailboxes and a mapped image as in the sheet, in PREOP.
    pub(super) fn drives(change: impl Fn(&mut Settings)) -> Bench {
        let mut settings = with_mailbox();
        change(&mut settings);
        let mut bench = Bench::new(vec![settings.clone(), settings]);
        for n in 0..2 {
            bench.set_up(n, 6, 8);
            bench.scripts[usize::from(n)].script().sizes = Some((6, 8));
            assert_eq!(bench.go(n, AlState::PreOp), (AlState::PreOp, None));
        }
        bench
    }

    /// Sets the SyncManagers and FMMUs of a drive as the sheet has them.
    pub(super) fn set_up(&mut self, n: u16, outputs: u16, inputs: u16) {
        for (manager, bytes) in [
            (0, [0x00, 0x18, 0x00, 0x04, 0x26, 0, 1, 0]),
            (1, [0x00, 0x1C, 0x00, 0x04, 0x22, 0, 1, 0]),
            (2, [0x00, 0x11, outputs as u8, 0, SyncManager::OUTPUTS, 0, 1, 0]),
            (3, [0x40, 0x11, inputs as u8, 0, SyncManager::INPUTS, 0, 1, 0]),
        ] {
            self.manage(n, manager, &bytes);
        }
        let (own, at) = (u32::from(n), 0x1_0000);
        let outputs = Fmmu::bytes(at + 6 * own, outputs, 0x1100, Fmmu::WRITE);
        let inputs = Fmmu::bytes(at + 12 + 8 * own, inputs, 0x1140, Fmmu::READ);
        assert_eq!(self.write(n, address::fmmu(0), &outputs.to_bytes()), 1);
        assert_eq!(self.write(n, address::fmmu(1), &inputs.to_bytes()), 1);
    }

    /// Sets a SyncManager, which has to be off for that.
    pub(super) fn manage(&mut self, n: u16, manager: u16, bytes: &[u8; 8]) {
        assert_eq!(self.write(n, address::sync_manager(manager) + 6, &[0]), 1);
        assert_eq!(self.write(n, address::sync_manager(manager), bytes), 1);
    }

    /// A frame with one datagram, by its command and both halves of its address: its data and its working counter as
    /// they come back.
    pub(super) fn send(&mut self, to: (Command, u16, u16), data: &[u8]) -> (Vec<u8>, u16) {
        let (data, count, _) = self.send_whole(to, data);
        (data, count)
    }

    /// Sends a datagram; returns data, working counter and the first half of the address as they come back.
    pub(super) fn send_whole(&mut self, to: (Command, u16, u16), data: &[u8]) -> (Vec<u8>, u16, u16) {
        let (length, end) = (data.len() as u16, 26 + data.len());
        let [header, a, b, l] = [0x1000 | (12 + length), to.1, to.2, length].map(u16::to_le_bytes);
        let mut frame = [&[0xFF; 6][..], &[0x10; 6], &[0x88, 0xA4], &header, &[to.0 as u8, 7]].concat();
        frame.extend([&a[..], &b, &l, &[0; 2], data, &[0; 2]].concat());
        self.segment.pass(self.now, &mut frame);
        let word = |at: usize| u16::from_le_bytes([frame[at], frame[at + 1]]);
        (frame[26..end].to_vec(), word(end), word(18))
    }

    pub(super) fn write(&mut self, n: u16, at: u16, data: &[u8]) -> u16 {
        self.send((Fpwr, 0x1001 + n, at), data).1
    }

    /// `None`: not read.
    pub(super) fn read<const N: usize>(&mut self, n: u16, at: u16) -> Option<[u8; N]> {
        let (data, count) = self.send((Fprd, 0x1001 + n, at), &[0; N]);
        (count == 1).then(|| data.try_into().unwrap())
    }

    /// Requests a state, and returns the resulting one.
    pub(super) fn go(&mut self, n: u16, state: AlState) -> (AlState, Option<u16>) {
        self.control(n, state as u16);
        self.state(n)
    }

    /// Writes AL control.
    pub(super) fn control(&mut self, n: u16, request: u16) {
        assert_eq!(self.write(n, address::AL_CONTROL, &request.to_le_bytes()), 1);
    }

    /// The state as the registers show it.
    pub(super) fn state(&mut self, n: u16) -> (AlState, Option<u16>) {
        let [status, _, _, _, low, high] = self.read(n, address::AL_STATUS).unwrap();
        let (status, code) = (u16::from(status), u16::from_le_bytes([low, high]));
        assert_eq!(status & al::ERROR != 0, code != code::NONE);
        (AlState::of(status).unwrap(), (code != code::NONE).then_some(code))
    }

    /// Both drives go to these states, the last one.
    pub(super) fn all_to(&mut self, states: &[AlState]) {
        for n in 0..2 {
            for state in states {
                assert_eq!(self.go(n, *state), (*state, None));
            }
        }
    }

    pub(super) fn wait(&mut self, ns: u64) {
        self.now = self.now + ns;
    }

    /// Empty frames, one per millisecond.
    pub(super) fn idle(&mut self, ms: u64) {
        for _ in 0..ms {
            self.wait(MS);
            self.send((Nop, 0, 0), &[]);
        }
    }
}
