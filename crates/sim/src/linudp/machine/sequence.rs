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

use super::super::codec::channel::usage;
use super::super::codec::errors;
use super::super::demand::{METRE, METRE_PER_S};
use super::super::parameters::allowed;
use super::super::upids;
use super::command::{Command, Sequence};
use super::{Machine, Mode, Task, counts};
use fieldbeat_core::time::{Time, US};

/// The most entries that the drive executes in one step.
const ENTRIES: usize = 8;

/// One count of a waiting time, ns.
const WAIT_NS: u64 = 100 * US;

impl Machine {
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
    fn run_entry(&mut self, sequence: Sequence, now: Time) -> Result<bool, u16> {
        // It may have been deleted meanwhile.
        let entry = self.memory.table.entry(sequence.entry)?;
        let command = Command::of(entry.command());
        let [a, b, c, d, _] = command.values();
        let next = if let Some((wait, until)) = sequence.waiting {
            if !self.is_over(&wait, until, now)? {
                return Ok(false);
            }
            entry.link()
        } else {
            match (command.family, command.sub) {
                (0x21 | 0x22, sub) => {
                    let is_variable = matches!(sub, 0x8 | 0x9);
                    let time = if is_variable { self.variable(1 + sub % 2).into() } else { a };
                    let waiting = Some((command, now + u64::try_from(time).unwrap_or(0) * WAIT_NS));
                    self.sequence = Some(Sequence { waiting, ..sequence });
                    return Ok(true);
                }
                (0x26, 0x2..=0x5) => {
                    // The inputs X4 and X6 are low.
                    let word = match command.sub {
                        0x4 => self.status(),
                        0x5 => self.warn(),
                        _ => 0,
                    };
                    let holds = (i64::from(word) ^ b) & a == 0;
                    Some(if holds { c } else { d } as u16)
                }
                (0x25 | 0x26, _) => Some(if self.compares(&command)? { b } else { c } as u16),
                (0x20, 0x0) => Some(a as u16),
                _ => {
                    if !self.compute(&command) {
                        self.execute(&command, now)?;
                    }
                    entry.link()
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
    fn compute(&mut self, command: &Command) -> bool {
        let [value, ..] = command.values();
        let upid = value as u16;
        match (command.family, command.sub) {
            (0x24, sub @ 0x0..=0x3) => {
                let variable = 1 + sub / 2;
                let before = if sub % 2 == 1 { self.variable(variable) } else { 0 };
                self.set_variable(variable, before.wrapping_add(value as i32));
            }
            (0x24, sub @ (0x8 | 0x9)) => self.write_unanswered(upid, self.variable(1 + sub % 2) as u32),
            (0x24, sub @ (0xC | 0xD)) => {
                if let Ok(index) = allowed(upid, usage::RAM_READ) {
                    // The number itself, with its sign: a variable has 32 bits. The upper half of u32 wraps.
                    self.set_variable(1 + sub % 2, self.number(index) as i32);
                }
            }
            // Listed and not described: its name is taken as its meaning. It takes no time here.
            (0x24, _) => {
                if let Ok(index) = allowed(upid, usage::RAM_READ) {
                    let value = self.read(index);
                    let _ = self.memory.parameters.write_rom(upid, value);
                }
            }
            _ => return false,
        }
        true
    }

    /// Variable 1 or 2.
    pub(super) fn variable(&self, variable: u16) -> i32 {
        self.memory.parameters.used(upids::VARIABLE_1 + variable - 1) as i32
    }

    fn set_variable(&mut self, variable: u16, value: i32) {
        self.write_unanswered(upids::VARIABLE_1 + variable - 1, value as u32);
    }

    fn is_over(&self, wait: &Command, until: Time, now: Time) -> Result<bool, u16> {
        Ok(match (wait.family, wait.sub) {
            (0x21, 0x1) => !self.setpoints.is_moving(),
            (0x21, 0x2) => self.in_target(),
            // An input that never changes.
            (0x21, 0x3 | 0x4) => false,
            (0x21, _) => now >= until,
            _ => self.compares(wait)?,
        })
    }

    /// Whether a quantity of the drive is above or below the limit of a wait, 22xx, or of a branch, 25xx and 26xx.
    fn compares(&self, command: &Command) -> Result<bool, u16> {
        let demand = self.setpoints.demand();
        let actual = self.actual();
        let position = |value: f64| i64::from(counts(value, METRE));
        let velocity = |value: f64| i64::from(counts(value, METRE_PER_S));
        let value = match (command.family, command.sub / 2) {
            (0x25, variable @ (0 | 1)) => self.variable(1 + variable).into(),
            (0x22, 0) | (0x25, 4) => position(demand.position),
            (0x22, 1) | (0x25, 5) => position(actual.position),
            (0x22, 2) | (0x25, 6) => position(demand.position - actual.position),
            (0x22, 3) => position(demand.position - actual.position).abs(),
            (0x22, 4) => velocity(demand.velocity),
            (0x22, 5) => velocity(actual.velocity),
            (0x22 | 0x25, _) => self.current().into(),
            // The analog input, of which none is wired, and 266x, of which the sources do not say what it compares.
            _ => return Err(errors::UNKNOWN_COMMAND),
        };
        let [limit, ..] = command.values();
        let is_greater = (command.sub % 2 == 1) == (command.family == 0x25);
        Ok(if is_greater { value > limit } else { value < limit })
    }
}
