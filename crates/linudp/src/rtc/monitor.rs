//! The sources of the drive's monitoring channels: read, and written where they differ.

use super::super::upid::{self, Upid};
use super::super::wire::RtcCommand;
use fieldbeat_core::axis::acyclic::{Answer, Call, CallError};

/// A channel that the drive has left unanswered so often is given up.
const MOST_TRIES: u8 = 3;

/// Sets the sources of the plan in the drive: reads first, and writes (RAM only) what differs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Monitor {
    sources: [Option<Upid>; 4],
    shown: [bool; 4],
    channel: usize,
    writing: bool,
    /// Failed attempts on the present channel.
    tries: u8,
    /// A source that the drive refused, with its status, or with 0 if it never answered.
    pub(super) refused: Option<(u8, u32)>,
}

impl Monitor {
    pub(super) fn new(sources: [Option<Upid>; 4]) -> Monitor {
        Monitor { sources, shown: [false; 4], channel: 0, writing: false, tries: 0, refused: None }
    }

    /// The drive may have lost its settings.
    pub(super) fn forget(&mut self) {
        (self.shown, self.channel, self.writing, self.tries) = ([false; 4], 0, false, 0);
    }

    /// All channels are set, or given up.
    pub(super) fn is_done(&self) -> bool {
        self.channel >= self.sources.len()
    }

    pub(super) fn next(&mut self) -> Option<Call> {
        while let Some(source) = self.sources.get(self.channel) {
            let Some(source) = source else {
                self.channel += 1;
                continue;
            };
            let place = Upid::MONITOR_SOURCE.0 + self.channel as u16;
            return Some(match self.writing {
                true => upid::call(RtcCommand::WRITE_RAM, place, source.0.into()),
                false => upid::call(RtcCommand::READ_RAM, place, 0),
            });
        }
        None
    }

    pub(super) fn take(&mut self, result: Result<Answer, CallError>) {
        let Some(Some(source)) = self.sources.get(self.channel) else { return };
        match result {
            Ok(answer) if self.writing || answer.value == u64::from(source.0) => {
                self.shown[self.channel] = true;
            }
            Ok(_) => return self.writing = true,
            Err(CallError::Refused(status)) => self.refused = Some((self.channel as u8, status)),
            Err(_) if self.tries + 1 < MOST_TRIES => {
                (self.writing, self.tries) = (false, self.tries + 1);
                return;
            }
            Err(_) => self.refused = Some((self.channel as u8, 0)),
        }
        (self.channel, self.writing, self.tries) = (self.channel + 1, false, 0);
    }

    pub(super) fn shows(&self, channel: usize) -> bool {
        self.shown.get(channel).copied().unwrap_or(false)
    }
}
