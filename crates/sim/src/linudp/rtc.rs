//! The drive's side of the real-time-config channel: counts, answers, and the effect of each command.
//!
//! Knows the block, not the telegram around it. A command runs if its count differs from the stored one; the same
//! count again gets the stored answer again. While a command takes its time (`config_time`) the answer is 02h and
//! 05h in turn, and 02h while it writes into a flash without falling silent, with the words of the previous answer,
//! as seen on real drives; a command with yet another count is not accepted then, and its count is not echoed.
//!
//! Open in the manuals, and the choices here:
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

use super::codec::channel::{ConfigBlock, Refusal, command as C, status, usage};
use super::codec::stored::INFO_SIZE;
use super::log::{self, Entry};
use super::machine::Machine;
use super::memory::Save;
use super::parameters::{allowed, check};
use fieldbeat_core::time::Time;

/// The consequence of a command after its telegram has been answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum After {
    Nothing,
    Restart,
    /// This telegram is not answered either.
    Silence,
}

/// The answer to a command that was not refused: status and words.
type Reply = (u8, [u16; 3]);

/// Done, with an index and a value.
const fn value(index: u16, value: u32) -> Reply {
    (status::DONE, [index, value as u16, (value >> 16) as u16])
}

/// A block of something longer, and whether it is the last one.
const fn block(index: u16, (bytes, is_last): ([u8; 4], bool)) -> Reply {
    let (_, words) = value(index, u32::from_le_bytes(bytes));
    (if is_last { status::DONE } else { status::BLOCK_NOT_FINISHED }, words)
}

/// The list that is being read.
#[derive(Clone, Copy, Debug)]
struct List {
    /// Of the UPIDs whose ROM differs from the default; else of all of them.
    modified: bool,
    /// The UPID to look from; `None` at the end.
    next: Option<u16>,
}

/// The channel's state.
#[derive(Debug, Default)]
pub(super) struct Channel {
    /// The last answer, with its count.
    answer: ConfigBlock,
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
        Channel { duration_ns, ..Channel::default() }
    }

    /// Takes in a block, and runs its command if its count is new.
    pub(super) fn take(&mut self, request: &ConfigBlock, machine: &mut Machine, now: Time) -> After {
        if now < self.busy_until || request.count == self.answer.count {
            return After::Nothing;
        }
        let result = self.run(request, machine, now);
        let (code, words) = result.unwrap_or_else(|refusal| (refusal as u8, [request.words[0], 0, 0]));
        if machine.memory.is_mute() {
            return After::Silence;
        }
        self.before = self.answer.words;
        self.answer = ConfigBlock { count: request.count, code, words };
        self.polled = false;
        if request.code == C::RESTART {
            self.busy_until = now;
            return After::Restart;
        }
        self.busy_until = machine.memory.saving_until().unwrap_or(now).max(now + self.duration_ns);
        After::Nothing
    }

    /// The drive's present answer; `saving`: it writes into its flash.
    pub(super) fn answer(&mut self, now: Time, saving: bool) -> ConfigBlock {
        if now >= self.busy_until {
            return self.answer;
        }
        self.polled = !self.polled;
        let code = if saving || self.polled { status::RUNNING } else { status::BUSY };
        ConfigBlock { words: self.before, code, ..self.answer }
    }

    fn run(&mut self, request: &ConfigBlock, machine: &mut Machine, now: Time) -> Result<Reply, Refusal> {
        let ConfigBlock { code, words, .. } = *request;
        let (index, raw) = (words[0], request.value());
        let bytes = raw.to_le_bytes();
        let is_stopped = machine.is_stopped();
        let memory = &mut machine.memory;
        match code {
            C::NO_OPERATION | C::RESTART => {}
            C::READ_ROM => return Ok(value(index, memory.parameters.rom(index)?)),
            C::READ_RAM => {
                let raw = match machine.serial(index) {
                    Some(serial) => serial,
                    None => machine.read(allowed(index, usage::RAM_READ)?),
                };
                return Ok(value(index, raw));
            }
            C::WRITE_ROM | C::WRITE_RAM | C::WRITE_BOTH => {
                let rom = if code == C::WRITE_RAM { 0 } else { usage::ROM_WRITE };
                let ram = if code == C::WRITE_ROM { 0 } else { usage::RAM_WRITE };
                check(index, raw, rom | ram)?;
                if rom != 0 {
                    memory.save(Save::Parameter(index, raw), now);
                }
                if ram != 0 {
                    machine.write(index, raw)?;
                }
                return Ok(value(index, raw));
            }
            C::READ_MINIMUM..=C::READ_DEFAULT => {
                return Ok(value(index, memory.parameters.bound(index, code)?));
            }

            C::START_LIST => self.list = Some(List { modified: false, next: Some(index) }),
            C::START_MODIFIED_LIST => self.list = Some(List { modified: true, next: Some(index) }),
            C::NEXT_ITEM | C::NEXT_MODIFIED_ITEM => {
                let list = self.list.as_mut().filter(|list| list.modified == (code == C::NEXT_MODIFIED_ITEM));
                let list = list.ok_or(Refusal::ListNotStarted)?;
                let found = list.next.and_then(|next| memory.parameters.next(next, list.modified));
                list.next = found.and_then(|(parameter, _)| parameter.upid.checked_add(1));
                let (parameter, rom) = found.ok_or(Refusal::EndOfList)?;
                return Ok(value(parameter.upid, if list.modified { rom } else { parameter.usage.into() }));
            }

            C::DEFAULT_OS..=C::DEFAULT_APPLICATION | C::SAVE_CURVES | C::SAVE_TABLE => {
                if !is_stopped {
                    return Err(Refusal::SoftwareRuns);
                }
                let what = match code {
                    C::SAVE_CURVES => Save::Curves,
                    C::SAVE_TABLE => Save::Table,
                    _ => Save::Defaults(u16::from(code - C::DEFAULT_OS)),
                };
                memory.save(what, now);
            }
            C::STOP_SOFTWARE => machine.stop_software(),
            C::START_SOFTWARE => machine.start_software(),

            C::DELETE_CURVES => memory.curves.delete_all(),
            C::ADD_CURVE | C::MODIFY_CURVE => {
                memory.curves.begin_curve(index, words[1], words[2], code == C::MODIFY_CURVE)?;
                return Ok((status::DONE, words));
            }
            C::ADD_CURVE_INFO | C::ADD_CURVE_DATA | C::MODIFY_CURVE_INFO | C::MODIFY_CURVE_DATA => {
                let is_data = matches!(code, C::ADD_CURVE_DATA | C::MODIFY_CURVE_DATA);
                let is_last = memory.curves.put(index, code >= C::MODIFY_CURVE, is_data, bytes)?;
                return Ok(block(index, (bytes, is_last)));
            }
            C::GET_CURVE => {
                let size = memory.curves.open(index).ok_or(Refusal::CurveDefinition)?;
                return Ok((status::DONE, [index, INFO_SIZE as u16, size]));
            }
            C::GET_CURVE_INFO | C::GET_CURVE_DATA => {
                return Ok(block(index, memory.curves.take(index, code == C::GET_CURVE_DATA)?));
            }

            C::ERROR_COUNTERS => {
                let (logged, occurred) = memory.log.counters();
                return Ok((status::DONE, [0, logged, occurred]));
            }
            C::ERROR_CODE..=C::ERROR_TIME_HIGH => {
                let Entry { code: error, ms, hours } = memory.log.entry(index).ok_or(Refusal::OutOfRange)?;
                return Ok(value(index, [error.into(), ms, hours][usize::from(code - C::ERROR_CODE)]));
            }
            C::ERROR_TEXT => {
                let text = log::text(index, words[1]).ok_or(Refusal::OutOfRange)?;
                return Ok(block(index, (text, true)));
            }

            C::DELETE_TABLE => memory.table.delete_all(),
            C::DELETE_ENTRY => {
                memory.table.delete_entry(index)?;
                return Ok(value(index, 0));
            }
            C::WRITE_ENTRY => {
                memory.table.begin_entry(index, words[1])?;
                return Ok(value(index, words[1].into()));
            }
            C::WRITE_ENTRY_DATA => {
                let is_last = memory.table.put(index, false, true, bytes)?;
                return Ok(block(index, (bytes, is_last)));
            }
            C::GET_ENTRY => {
                return Ok(value(index, memory.table.open(index).ok_or(Refusal::WrongSize)?.into()));
            }
            C::GET_ENTRY_DATA => return Ok(block(index, memory.table.take(index, true)?)),
            C::PRESENCE..=C::LAST_PRESENCE => {
                let group = u16::from(code - C::PRESENCE);
                return Ok(value(group * 4, !memory.table.used(group)));
            }
            _ => return Err(Refusal::NoSuchUpid),
        }
        Ok((status::DONE, [0; 3]))
    }
}
