//! The motion command interface of one drive: counts and their echo.
//!
//! Knows no order and no motion: only which command is under way, with which count, and whether the drive has it.

use super::motion::MotionCommand;
use super::wire::MotionBlock;
use crate::axis::Failure;

/// A motion command whose echo has not come after so many answered exchanges is sent again with another count (sheet,
/// 4.1: one such case was seen on real hardware) ...
const ECHO_WITHIN: u32 = 5;
/// ... and given up after so many counts.
const MOST_COUNTS: u32 = 4;

/// The motion command interface of one drive: a command runs only if its count differs from the last one it stored.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct MotionChannel {
    /// The count stored in the drive, as far as known.
    pub(super) count: Option<u8>,
    /// The command under way.
    pub(super) command: Option<MotionCommand>,
    /// The command is to be repeated until its echo comes.
    pending: bool,
    /// Answered exchanges since it was sent with this count.
    answers: u32,
    counts_used: u32,
}

impl MotionChannel {
    /// Puts `command` into the next requests, until its echo comes.
    pub(super) fn send(&mut self, command: MotionCommand) {
        *self = MotionChannel { command: Some(command), pending: true, ..self.next_count() };
    }

    /// Puts a streamed setpoint into the next requests; its echo is not awaited, since the next row has the next
    /// count.
    pub(super) fn stream(&mut self, command: MotionCommand) {
        *self = MotionChannel { command: Some(command), pending: false, ..self.next_count() };
    }

    fn next_count(&self) -> MotionChannel {
        MotionChannel {
            count: Some(self.count.unwrap_or(0).wrapping_add(1) & 0xF),
            ..MotionChannel::default()
        }
    }

    /// Removes the command; the count stays.
    pub(super) fn clear(&mut self) {
        *self = MotionChannel { count: self.count, ..MotionChannel::default() };
    }

    /// Takes the echo of a reply, `clean` if it can be no older one. `Err` when the drive accepts none of the
    /// counts.
    pub(super) fn take(&mut self, echo: u8, clean: bool) -> Result<(), Failure> {
        if self.command.is_none() {
            // Nothing under way: continue from the count stored in the drive. It is read first after a start. A
            // reply that may be older says nothing of the present: the count after its own may be the very one that
            // the drive has stored.
            if clean {
                self.count = Some(echo);
            }
        } else if self.pending && self.count == Some(echo) {
            self.clear();
        } else if self.pending && clean {
            self.answers += 1;
            if self.answers > ECHO_WITHIN {
                if self.counts_used + 1 >= MOST_COUNTS {
                    self.clear();
                    return Err(Failure::NotTaken);
                }
                let counts_used = self.counts_used + 1;
                if let Some(command) = self.command {
                    self.send(command);
                }
                self.counts_used = counts_used;
            }
        }
        Ok(())
    }

    /// The block of the next request.
    pub(super) fn block(&self) -> Option<MotionBlock> {
        self.command.map(|command| command.block(self.count.unwrap_or(0)))
    }
}
