//! The drive's side of the real-time-config channel: counts, answers, and the effect of each command.
//!
//! Knows the block, not the telegram around it. A command runs if its count differs from the stored one; the same
//! count again gets the stored answer again. While a command takes its time (`config_time`) the answer is 02h and
//! 05h in turn, and 02h while it writes into a flash without falling silent, with the words of the previous answer,
//! as seen on real drives; a command with yet another count is not accepted then, and its count is not echoed.
//!
//! What the manuals leave open, and the choices here:
//!
//! | case | answer |
//! |---|---|
//! | a command that the manual does not list | C0h, "UPID error" |
//! | refused | word 2 as it came, words 3 and 4 are 0 |
//! | default of a variable | C3h: it has none |
//! | next item behind the end of a list | C6h, again and again; a list of the other kind: C5h |
//! | 31h-34h, 40h, 80h while the software runs | D7h |
//! | 35h, 36h in the state that they lead to | 00h, nothing happens |
//! | an error log entry, an error or a part of a text that there is not | C2h |
//! | 30h | 00h at once, then the drive starts anew and is silent until it has |
//! | a save, or a write into ROM | its own telegram is answered (02h); a drive that saves silently receives nothing after it |

use super::machine::Machine;
use super::memory::Save;
use super::parameters::{Bound, Part, allowed, check};
use super::upids::{PARAMETERS, from};
use super::{log, parameters};
use fieldbeat_core::time::Time;
use fieldbeat_linudp::upid::Usage;
use fieldbeat_linudp::wire::{ErrorCode, Refusal, RtcBlock, RtcCommand, RtcStatus};

/// What follows a command after its telegram has been answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum After {
    Nothing,
    Restart,
    /// This telegram is not answered either.
    Silence,
}

/// The answer to a command that was not refused.
pub(super) struct Reply {
    code: u8,
    words: [u16; 3],
}

impl Reply {
    const DONE: Reply = Reply { code: RtcStatus::DONE, words: [0; 3] };

    /// Done, with these words.
    pub(super) const fn words(words: [u16; 3]) -> Reply {
        Reply { code: RtcStatus::DONE, words }
    }

    /// Done, with an index and a value.
    pub(super) const fn value(index: u16, value: u32) -> Reply {
        Reply::words([index, value as u16, (value >> 16) as u16])
    }

    /// A block of something longer, and whether it is the last one.
    pub(super) const fn block(index: u16, bytes: [u8; 4], last: bool) -> Reply {
        let code = if last { RtcStatus::DONE } else { RtcStatus::BLOCK_NOT_FINISHED };
        Reply { code, ..Reply::value(index, u32::from_le_bytes(bytes)) }
    }
}

/// The list that is being read, and its next item.
#[derive(Clone, Copy, Debug)]
enum List {
    /// Of all UPIDs: the index in [`PARAMETERS`].
    All(usize),
    /// Of those whose ROM differs from the default: the UPID to look from; `None` at the end.
    Modified(Option<u16>),
}

/// The channel's state.
#[derive(Debug)]
pub(super) struct Channel {
    /// The last answer, with its count.
    answer: RtcBlock,
    /// The words of the one before it.
    before: [u16; 3],
    /// The answer is not given before then.
    busy_until: Time,
    /// The code for "busy" that was given last.
    polled: bool,
    list: Option<List>,
    /// How long a command takes.
    duration_ns: u64,
}

impl Channel {
    /// As after a restart: the stored count is 0.
    pub(super) fn new(duration_ns: u64) -> Channel {
        Channel {
            answer: RtcBlock::default(),
            before: [0; 3],
            busy_until: Time(0),
            polled: false,
            list: None,
            duration_ns,
        }
    }

    /// Takes in a block, and runs its command if its count is new.
    pub(super) fn take(&mut self, block: &RtcBlock, machine: &mut Machine, now: Time) -> After {
        if now < self.busy_until || block.count() == self.answer.count() {
            return After::Nothing;
        }
        let (words, code) = match self.run(block, machine, now) {
            Ok(reply) => (reply.words, reply.code),
            Err(refusal) => ([block.index(), 0, 0], refusal.code()),
        };
        if machine.memory.is_mute() {
            return After::Silence;
        }
        self.before = self.answer.words;
        self.answer = RtcBlock { words, ..RtcBlock::answer(block.count(), code) };
        self.polled = false;
        if RtcCommand(block.code) == RtcCommand::RESTART {
            self.busy_until = now;
            return After::Restart;
        }
        self.busy_until = machine.memory.saving_until().unwrap_or(now).max(now + self.duration_ns);
        After::Nothing
    }

    /// The drive's present answer; `saving`: it writes into its flash.
    pub(super) fn answer(&mut self, now: Time, saving: bool) -> RtcBlock {
        if now >= self.busy_until {
            return self.answer;
        }
        self.polled = !self.polled;
        let code = if saving || self.polled { RtcStatus::RUNNING } else { RtcStatus::BUSY };
        RtcBlock { words: self.before, code, ..self.answer }
    }

    fn run(&mut self, block: &RtcBlock, machine: &mut Machine, now: Time) -> Result<Reply, Refusal> {
        use RtcCommand as C;
        let (index, value) = (block.index(), block.value());
        let bytes = value.to_le_bytes();
        let stopped = machine.is_stopped();
        let serial = machine.serial(index);
        let memory = &mut machine.memory;
        match RtcCommand(block.code) {
            C::NO_OPERATION | C::RESTART => {}
            C::READ_ROM => return Ok(Reply::value(index, memory.parameters.rom(index)?)),
            C::READ_RAM if serial.is_some() => {
                return Ok(Reply::value(index, serial.unwrap_or_default()));
            }
            C::READ_RAM => {
                return Ok(Reply::value(index, machine.read(allowed(index, Usage::RAM_READ)?)));
            }
            C::WRITE_ROM => {
                check(index, value, Usage::ROM_WRITE)?;
                memory.save(Save::Parameter(index, value), now);
                return Ok(Reply::value(index, value));
            }
            C::WRITE_RAM => {
                machine.write(index, value)?;
                return Ok(Reply::value(index, value));
            }
            C::WRITE_BOTH => {
                check(index, value, Usage::ROM_WRITE | Usage::RAM_WRITE)?;
                memory.save(Save::Parameter(index, value), now);
                machine.write(index, value)?;
                return Ok(Reply::value(index, value));
            }
            C::READ_MINIMUM => return bound(&memory.parameters, index, Bound::Minimum),
            C::READ_MAXIMUM => return bound(&memory.parameters, index, Bound::Maximum),
            C::READ_DEFAULT => return bound(&memory.parameters, index, Bound::Default),

            C::START_LIST => self.list = Some(List::All(from(index))),
            C::NEXT_ITEM => {
                let Some(List::All(next)) = &mut self.list else { return Err(Refusal::ListNotStarted) };
                let parameter = PARAMETERS.get(*next).ok_or(Refusal::EndOfList)?;
                *next += 1;
                return Ok(Reply::words([parameter.upid, parameter.usage.0, 0]));
            }
            C::START_MODIFIED_LIST => self.list = Some(List::Modified(Some(index))),
            C::NEXT_MODIFIED_ITEM => {
                let Some(List::Modified(next)) = &mut self.list else { return Err(Refusal::ListNotStarted) };
                let found = next.and_then(|next| memory.parameters.modified_from(next));
                *next = found.and_then(|(upid, _)| upid.checked_add(1));
                let (upid, value) = found.ok_or(Refusal::EndOfList)?;
                return Ok(Reply::value(upid, value));
            }

            C::DEFAULT_OS
            | C::DEFAULT_MC
            | C::DEFAULT_INTERFACE
            | C::DEFAULT_APPLICATION
            | C::SAVE_CURVES
            | C::SAVE_TABLE
                if !stopped =>
            {
                return Err(Refusal::SoftwareRuns);
            }
            C::DEFAULT_OS => memory.save(Save::Defaults(Part::OS), now),
            C::DEFAULT_MC => memory.save(Save::Defaults(Part::MC), now),
            C::DEFAULT_INTERFACE => memory.save(Save::Defaults(Part::INTERFACE), now),
            C::DEFAULT_APPLICATION => memory.save(Save::Defaults(Part::APPLICATION), now),
            C::STOP_SOFTWARE => machine.stop_software(),
            C::START_SOFTWARE => machine.start_software(),

            C::SAVE_CURVES => memory.save(Save::Curves, now),
            C::DELETE_CURVES => memory.curves.delete_all(),
            C::ADD_CURVE | C::MODIFY_CURVE => {
                let [_, info, data] = block.words;
                let modify = block.code == C::MODIFY_CURVE.0;
                memory.curves.begin(index, info, data, modify)?;
                return Ok(Reply::words(block.words));
            }
            C::ADD_CURVE_INFO | C::MODIFY_CURVE_INFO => {
                let modify = block.code == C::MODIFY_CURVE_INFO.0;
                let last = memory.curves.put_info(index, bytes, modify)?;
                return Ok(Reply::block(index, bytes, last));
            }
            C::ADD_CURVE_DATA | C::MODIFY_CURVE_DATA => {
                let modify = block.code == C::MODIFY_CURVE_DATA.0;
                let last = memory.curves.put_data(index, bytes, modify)?;
                return Ok(Reply::block(index, bytes, last));
            }
            C::GET_CURVE => {
                let (info, data) = memory.curves.open(index)?;
                return Ok(Reply::words([index, info, data]));
            }
            C::GET_CURVE_INFO => {
                let (bytes, last) = memory.curves.next_info(index)?;
                return Ok(Reply::block(index, bytes, last));
            }
            C::GET_CURVE_DATA => {
                let (bytes, last) = memory.curves.next_data(index)?;
                return Ok(Reply::block(index, bytes, last));
            }

            C::ERROR_COUNTERS => {
                let (logged, occurred) = memory.log.counters();
                return Ok(Reply::words([0, logged, occurred]));
            }
            C::ERROR_CODE | C::ERROR_TIME_LOW | C::ERROR_TIME_HIGH => {
                let entry = memory.log.entry(index).ok_or(Refusal::OutOfRange)?;
                return Ok(match RtcCommand(block.code) {
                    C::ERROR_CODE => Reply::value(index, entry.code.0.into()),
                    C::ERROR_TIME_LOW => Reply::value(index, entry.ms),
                    _ => Reply::value(index, entry.hours),
                });
            }
            C::ERROR_TEXT => {
                let part = block.words[1];
                let text = log::text(ErrorCode(index), part).ok_or(Refusal::OutOfRange)?;
                return Ok(Reply::value(index, u32::from_le_bytes(text)));
            }

            C::SAVE_TABLE => memory.save(Save::Table, now),
            C::DELETE_TABLE => memory.table.delete_all(),
            C::DELETE_ENTRY => {
                memory.table.delete(index)?;
                return Ok(Reply::words([index, 0, 0]));
            }
            C::WRITE_ENTRY => {
                let size = block.words[1];
                memory.table.begin(index, size)?;
                return Ok(Reply::words([index, size, 0]));
            }
            C::WRITE_ENTRY_DATA => {
                let last = memory.table.put(index, bytes)?;
                return Ok(Reply::block(index, bytes, last));
            }
            C::GET_ENTRY => {
                let size = memory.table.open(index)?;
                return Ok(Reply::words([index, size, 0]));
            }
            C::GET_ENTRY_DATA => {
                let (bytes, last) = memory.table.next(index)?;
                return Ok(Reply::block(index, bytes, last));
            }
            C(code @ 0x87..=0x8E) => {
                let group = u16::from(code - C::PRESENCE_0.0);
                return Ok(Reply::value(group * 4, !memory.table.used(group)));
            }
            _ => return Err(Refusal::NoSuchUpid),
        }
        Ok(Reply::DONE)
    }
}

fn bound(parameters: &parameters::Parameters, upid: u16, bound: Bound) -> Result<Reply, Refusal> {
    Ok(Reply::value(upid, parameters.bound(upid, bound)?))
}
