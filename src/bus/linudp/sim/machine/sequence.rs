//! The command table runs: one entry after the other, waits and branches.
//!
//! Knows the entries as the table holds them. What the manuals leave open, and the choices here:
//!
//! - An entry runs its command, and its link follows at once, motion or not: a table that has to wait for a motion says
//!   so.
//! - At most [`ENTRIES`] entries a step, so that a loop of links that never waits keeps the drive busy and not more.
//! - The table ends behind an entry without a link, at any error, when state 8 is left (also by /Freeze), and when the
//!   bus sends another motion.
//! - In run mode 3 it begins at entry 1 as soon as the drive is in state 8 and homed.
//! - Inputs are low and triggers never come. Waiting times in a variable are in 100 us, like those in an entry.

use super::super::motion::{METRE, METRE_PER_S};
use super::super::parameters::allowed;
use super::super::upids;
use super::{Machine, Mode, RunMode, Task, counts};
use crate::bus::linudp::motion::{Comparison, Condition, Decoded, Quantity, Wait, When, Word};
use crate::bus::linudp::upid::Usage;
use crate::bus::linudp::wire::ErrorCode;
use crate::time::{Time, US};

/// The most entries that the drive executes in one step.
const ENTRIES: usize = 8;

/// The first entry of run mode 3.
const FIRST: u16 = 1;

/// One count of a waiting time, ns.
const WAIT_NS: u64 = 100 * US;

/// The position in the table.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sequence {
    entry: u16,
    /// For what its command waits; `None`: it is still to run.
    waiting: Option<Waiting>,
}

#[derive(Clone, Copy, Debug)]
enum Waiting {
    Until(Time),
    MotionFinished,
    InTarget,
    /// An input that never changes.
    Trigger,
    Comparison(Comparison),
}

impl Machine {
    /// The table goes on with this entry.
    pub(super) fn start_table(&mut self, entry: u16) -> Result<(), ErrorCode> {
        self.memory.table.get(entry).ok_or(ErrorCode::ENTRY_MISSING)?;
        self.sequence = Some(Sequence { entry, waiting: None });
        Ok(())
    }

    /// State 8 was entered.
    pub(super) fn enter_table(&mut self) {
        if self.settings.run_mode == RunMode::Table
            && self.homed
            && let Err(code) = self.start_table(FIRST)
        {
            self.fail(code);
        }
    }

    /// Runs the table as far as it gets now.
    pub(super) fn run_table(&mut self, now: Time) {
        for _ in 0..ENTRIES {
            let Some(sequence) = self.sequence.filter(|_| self.mode == Mode::Operating(Task::Commands))
            else {
                return;
            };
            match self.run_entry(sequence, now) {
                Ok(true) => {}
                Ok(false) => return,
                Err(code) => self.fail(code),
            }
        }
    }

    /// Runs an entry, or checks whether it is over; false while it waits.
    fn run_entry(&mut self, sequence: Sequence, now: Time) -> Result<bool, ErrorCode> {
        // It may have been deleted meanwhile.
        let entry = *self.memory.table.get(sequence.entry).ok_or(ErrorCode::ENTRY_MISSING)?;
        let next = if let Some(waiting) = sequence.waiting {
            if !self.is_over(waiting, now)? {
                return Ok(false);
            }
            entry.next
        } else {
            match Decoded::of(&entry.command().block(0)) {
                Decoded::Wait(wait) => {
                    let waiting = Some(self.waiting(wait, now));
                    self.sequence = Some(Sequence { waiting, ..sequence });
                    return Ok(true);
                }
                Decoded::If { condition, if_true, if_false } => {
                    Some(if self.holds(condition)? { if_true } else { if_false })
                }
                Decoded::TableEntry { entry, when: When::Now } => Some(entry),
                command => {
                    if !self.compute(&command) {
                        self.execute(&command, now)?;
                    }
                    entry.next
                }
            }
        };
        match next {
            // Its control word may have left state 8.
            Some(next) if self.sequence.is_some() => self.start_table(next)?,
            _ => self.sequence = None,
        }
        Ok(true)
    }

    /// The commands that work with variables; false if it is another one.
    fn compute(&mut self, command: &Decoded) -> bool {
        match *command {
            Decoded::Variable { variable, add, value } => {
                let before = if add { self.variable(variable) } else { 0 };
                self.set_variable(variable, before.wrapping_add(value));
            }
            Decoded::VariableToUpid { variable, upid } => {
                self.write_unheard(upid, self.variable(variable) as u32);
            }
            Decoded::UpidToVariable { variable, upid } => {
                if let Ok(index) = allowed(upid, Usage::RAM_READ) {
                    // The number itself, with its sign: a variable has 32 bits. The upper half of u32 wraps.
                    self.set_variable(variable, self.number(index) as i32);
                }
            }
            // Listed and not described: its name is taken as its meaning. It takes no time here.
            Decoded::UpidToRom(upid) => {
                if let Ok(index) = allowed(upid, Usage::RAM_READ) {
                    let value = self.read(index);
                    let _ = self.memory.parameters.write_rom(upid, value);
                }
            }
            _ => return false,
        }
        true
    }

    /// Variable 1 or 2.
    pub(super) fn variable(&self, variable: u8) -> i32 {
        self.memory.parameters.used(variable_upid(variable)) as i32
    }

    fn set_variable(&mut self, variable: u8, value: i32) {
        self.write_unheard(variable_upid(variable), value as u32);
    }

    fn waiting(&self, wait: Wait, now: Time) -> Waiting {
        match wait {
            Wait::Time(time) => Waiting::Until(now + u64::from(time) * WAIT_NS),
            Wait::Variable(variable) => {
                let time = u64::try_from(self.variable(variable)).unwrap_or(0);
                Waiting::Until(now + time * WAIT_NS)
            }
            Wait::MotionFinished => Waiting::MotionFinished,
            Wait::InTarget => Waiting::InTarget,
            Wait::Trigger { .. } => Waiting::Trigger,
            Wait::Until(comparison) => Waiting::Comparison(comparison),
        }
    }

    fn is_over(&self, waiting: Waiting, now: Time) -> Result<bool, ErrorCode> {
        Ok(match waiting {
            Waiting::Until(time) => now >= time,
            Waiting::MotionFinished => !self.setpoints.is_moving(),
            Waiting::InTarget => self.in_target(),
            Waiting::Trigger => false,
            Waiting::Comparison(comparison) => self.compares(comparison)?,
        })
    }

    fn holds(&self, condition: Condition) -> Result<bool, ErrorCode> {
        match condition {
            Condition::Compare(comparison) => self.compares(comparison),
            Condition::Masked { word, mask, value } => {
                let word = match word {
                    Word::X4Inputs | Word::X6Inputs => 0,
                    Word::Status => self.status().0,
                    Word::Warn => self.warn().0,
                };
                Ok(word & mask == value & mask)
            }
            Condition::Unknown(_) => Err(ErrorCode::UNKNOWN_COMMAND),
        }
    }

    fn compares(&self, comparison: Comparison) -> Result<bool, ErrorCode> {
        let demand = self.setpoints.demand();
        let actual = self.actual();
        let position = |value: f64| i64::from(counts(value, METRE));
        let velocity = |value: f64| i64::from(counts(value, METRE_PER_S));
        let value = match comparison.quantity {
            Quantity::DemandPosition => position(demand.position),
            Quantity::ActualPosition => position(actual.position),
            Quantity::Difference => position(demand.position - actual.position),
            Quantity::UnsignedDifference => position(demand.position - actual.position).abs(),
            Quantity::DemandVelocity => velocity(demand.velocity),
            Quantity::ActualVelocity => velocity(actual.velocity),
            Quantity::Current => self.current().into(),
            Quantity::Variable(variable) => self.variable(variable).into(),
            // None is wired.
            Quantity::AnalogInput => return Err(ErrorCode::UNKNOWN_COMMAND),
        };
        let limit = i64::from(comparison.limit);
        Ok(if comparison.greater { value > limit } else { value < limit })
    }
}

fn variable_upid(variable: u8) -> u16 {
    if variable == 1 { upids::VARIABLE_1 } else { upids::VARIABLE_2 }
}
