//! The motion command interface of one drive: counts, and their echoes.
//!
//! Source: SG5 manual 4.3.4, motion command interface (sheet, 4.1).

use super::motion::MotionCommand;
use super::wire::MotionBlock;
use fieldbeat_core::axis::Failure;

/// A motion command whose echo has not come after so many answered exchanges is sent again with another count (sheet,
/// 4.1: one such case was seen on real hardware) ...
const ECHO_WITHIN: u32 = 5;
/// ... and given up after so many counts, or if another command takes its place so often.
const MOST_TRIES: u32 = 4;

/// The motion command interface of one drive: a command runs only if its count differs from the last one it stored.
///
/// From the first agreement on the master chooses the counts by itself: the count of an older reply is no news (sheet,
/// 2.4). The echo of a command counts only in a clean reply to a request that carried it.
///
/// A clean reply with another count, after the echo, has two meanings: an old request that was delivered once more has
/// run in the drive since, or the reply is an old one that was delivered once more. One answer is right for both: the
/// command is repeated with the same count. A drive that has it ignores that, any other one runs it; and until its echo
/// comes again it is not accepted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct MotionChannel {
    /// The count of the newest command; before the first one, the count that the drive has stored, as far as known.
    pub(super) count: Option<u8>,
    /// The count in the last reply, however old that was: no command gets this one.
    reported: Option<u8>,
    /// The command under way, or accepted and not over.
    command: Option<MotionCommand>,
    /// The command is to be repeated until its echo comes.
    pending: bool,
    stage: Stage,
    /// Clean replies without it since the last one with it, or since it was sent with this count.
    answers: u32,
    /// Counts that were not taken, and echoes that did not come twice in a row.
    tries: u32,
    /// A reply to a request without the command had its count: the drive has stored that before, and would ignore it.
    clashes: bool,
}

/// How far the command is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum Stage {
    /// No request with it has gone out.
    #[default]
    Waiting,
    Sent,
    /// A clean reply had its echo: the drive has taken the command, and may have replaced it since.
    Echoed,
    /// The drive may have run another command of this master since the echo.
    Doubted,
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
        let after = |count: u8| count.wrapping_add(1) & 0xF;
        let count = after(self.count.or(self.reported).unwrap_or(0));
        let count = if self.reported == Some(count) { after(count) } else { count };
        MotionChannel { count: Some(count), reported: self.reported, ..MotionChannel::default() }
    }

    /// Removes the command; the counts stay.
    pub(super) fn clear(&mut self) {
        *self = MotionChannel { count: self.count, reported: self.reported, ..MotionChannel::default() };
    }

    /// The request with the block has gone out.
    pub(super) fn sent(&mut self) {
        if self.command.is_some() && self.stage == Stage::Waiting {
            self.stage = Stage::Sent;
        }
    }

    /// The count of the command in the last request that went out, if it had one.
    pub(super) fn sent_count(&self) -> Option<u8> {
        self.count.filter(|_| self.stage != Stage::Waiting)
    }

    /// Before the next request is built: a count that the drive has stored is replaced.
    pub(super) fn avoid_clash(&mut self) {
        if std::mem::take(&mut self.clashes) {
            (self.count, self.stage, self.answers) = (self.next_count().count, Stage::Waiting, 0);
        }
    }

    /// The last clean reply had the echo of the command.
    pub(super) fn is_accepted(&self) -> bool {
        self.stage == Stage::Echoed && self.answers == 0
    }

    fn is_echoed(&self) -> bool {
        matches!(self.stage, Stage::Echoed | Stage::Doubted)
    }

    /// Takes the echo of a reply, `clean` if it can be no older one, `foreign` if this master has not used it lately.
    /// `Err` when the drive accepts none of the counts.
    pub(super) fn take(&mut self, echo: u8, clean: bool, foreign: bool) -> Result<(), Failure> {
        self.reported = Some(echo);
        let Some(command) = self.command else {
            // The first agreement. A reply that may be older says nothing of the present: the count after its own may
            // be the very one that the drive has stored.
            if clean {
                self.count.get_or_insert(echo);
            }
            return Ok(());
        };
        if self.stage == Stage::Waiting {
            // The drive has the chosen count already, and would ignore the command.
            if self.count == Some(echo) {
                self.count = self.next_count().count;
            }
        } else if self.pending && clean && self.count == Some(echo) && !self.clashes {
            if self.is_accepted() {
                self.tries = 0;
            }
            (self.stage, self.answers) = (Stage::Echoed, 0);
        } else if self.pending && clean {
            // Another master's command is answered by no motion: whether it is one, the next replies show.
            let doubted = self.is_echoed() && (!foreign || command.is_stop());
            let lost = doubted && self.is_accepted();
            if doubted {
                self.stage = Stage::Doubted;
            }
            self.answers += 1;
            let ignored = self.answers > ECHO_WITHIN;
            if lost || ignored {
                self.tries += 1;
            }
            if self.tries >= MOST_TRIES {
                self.clear();
                return Err(Failure::NotTaken);
            }
            if ignored {
                let tries = self.tries;
                self.send(command);
                self.tries = tries;
            }
        }
        Ok(())
    }

    /// The same of a reply to a request that carried the command with this count, while newer ones are on their way or
    /// built.
    pub(super) fn take_earlier(
        &mut self,
        echo: u8,
        carried: Option<u8>,
        clean: bool,
        foreign: bool,
    ) -> Result<(), Failure> {
        if self.command.is_none() || self.stage != Stage::Waiting && carried == self.count {
            return self.take(echo, clean, foreign);
        }
        self.reported = Some(echo);
        self.clashes |= self.count == Some(echo) && !self.is_echoed();
        Ok(())
    }

    /// No command is under way, there is none or the drive has it: no request carries one, and another reply with the
    /// same count changes nothing.
    pub(super) fn is_settled(&self) -> bool {
        self.command.is_none() || self.is_accepted()
    }

    /// The block of the next request.
    pub(super) fn block(&self) -> Option<MotionBlock> {
        self.command
            .filter(|_| self.stage != Stage::Echoed)
            .map(|command| command.block(self.count.unwrap_or(0)))
    }
}

#[cfg(test)]
mod tests;
