//! The sequencer of the drive: control word, hardware enable, trips, watchdogs.
//!
//! Knows the parameters by their values, and no motion: the present speed comes as an argument. Facts: SI-PROFIBUS
//! guide, control word; what the guide leaves open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | TRIP, RESET and the watchdog bit | count whenever 06.043 is 1, AUTO or not |
//! | forward and reverse at once | neither |
//! | a jog bit together with any run bit | the run bits alone |
//! | a run bit that still stands when a trip is reset, or the hardware enable comes back | the drive runs again |
//! | 06.004 = 1 or 3 | a run bit latches while NOT STOP is 1; nothing runs while it is 0. Otherwise NOT STOP does nothing |
//! | enabled by the control word, without a run bit | stands with power on (06.008 = 1), or without (0) |
//! | by terminals | they are parameters 06.030 ... 06.034; the power comes on with the first of them |
//! | a negative reference with 01.010 = 0 | is the minimum reference |
//! | 01.014 = 3, or 0 with 01.042 = 1, which REMOTE makes | preset 01.015, of which 0 and 9 are the first; else analogue reference 1 |
//! | 06.001 = 0 | a run bit that is taken away ends in coasting |

use std::collections::VecDeque;

use super::codec::{control as C, trip};
use super::database::Database;
use super::settings::UnidriveSettings;
use super::table;
use crate::power::{PowerDrive, Reset};
use fieldbeat_core::time::{MS, S};

/// From a write of the control word with its watchdog bit until the next one is due (assumed), ns.
const WATCHDOG_NS: u64 = S;
/// From trip 3 until it can be reset (M702 user guide), ns.
const OVER_CURRENT_NS: u64 = 10 * S;

/// Entries of the trip log: 10.020 ... 10.029.
const LOG: usize = 10;

/// Values of 06.004 with which run bits latch.
const LATCHING: [i32; 2] = [1, 3];
/// The value of 06.001 with which a stop is not a ramp.
const COASTING: i32 = 0;

/// The values of the terminals, and the bits of the control word with the same effect.
const TERMINALS: [(usize, u16); 6] = [
    (table::RUN_FORWARD, C::RUN_FORWARD),
    (table::JOG_FORWARD, C::JOG_FORWARD),
    (table::RUN_REVERSE, C::RUN_REVERSE),
    (table::REVERSE, C::REVERSE),
    (table::RUN, C::RUN),
    (table::NOT_STOP, C::NOT_STOP),
];

fn has(word: u16, bit: u16) -> bool {
    word & bit != 0
}

/// The power drive that it commands.
type Power = PowerDrive<u16>;

/// A run command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Run {
    reverse: bool,
    jog: bool,
}

/// The sequencer of one drive.
#[derive(Debug)]
pub(super) struct Sequencer {
    /// The trip of an interface that receives nothing any more.
    link_trip: u16,
    /// The newest first.
    log: VecDeque<u16>,
    /// Until the control word has to be written again, ns.
    served_ns: Option<u64>,
    /// Until something has to be received again, ns.
    received_ns: Option<u64>,
    latched: Option<Run>,
    running: Option<Run>,
    /// The power stage is on.
    active: bool,
}

impl Sequencer {
    pub(super) fn new(settings: &UnidriveSettings, power: &mut Power) -> Sequencer {
        let mut sequencer = Sequencer {
            link_trip: trip::slot_error(settings.interface.slot),
            log: VecDeque::with_capacity(LOG),
            served_ns: None,
            received_ns: None,
            latched: None,
            running: None,
            active: false,
        };
        sequencer.restart(power);
        sequencer
    }

    /// Power came back: the log survives it.
    pub(super) fn restart(&mut self, power: &mut Power) {
        power.restart();
        (self.served_ns, self.received_ns) = (None, None);
        (self.latched, self.running, self.active) = (None, None, false);
    }

    /// Trips the drive. The first trip stays.
    pub(super) fn trip(&mut self, power: &mut Power, trip: u16) {
        let wait_ns = if trip == trip::OVER_CURRENT { OVER_CURRENT_NS } else { 0 };
        if !power.fail(trip, Reset::After(wait_ns)) {
            return;
        }
        self.served_ns = None;
        self.log.truncate(LOG - 1);
        self.log.push_front(trip);
    }

    /// The control word was written while 06.043 is 1; whether it resets the drive.
    #[must_use]
    pub(super) fn control(&mut self, power: &mut Power, before: u16, word: u16) -> bool {
        let rising = |bit| has(word & !before, bit);
        // Each write with the bit serves the watchdog, one without it disarms it.
        if power.fault().is_none() || !has(word, C::KEYPAD_WATCHDOG) {
            self.served_ns = has(word, C::KEYPAD_WATCHDOG).then_some(WATCHDOG_NS);
        }
        if rising(C::TRIP) {
            self.trip(power, trip::CONTROL_WORD);
        }
        rising(C::RESET)
    }

    /// 10.038 was written; whether it resets the drive.
    #[must_use]
    pub(super) fn user_trip(&mut self, power: &mut Power, number: u16) -> bool {
        match number {
            0 | trip::USER_RESET => {}
            trip::USER_CLEAR => self.log.clear(),
            _ => self.trip(power, number),
        }
        number == trip::USER_RESET
    }

    /// The Ethernet interface took in a request.
    pub(super) fn received(&mut self, timeout_ms: i32) {
        self.received_ns = u64::try_from(timeout_ms).ok().filter(|ms| *ms > 0).map(|ms| ms * MS);
    }

    /// Lets `dt_ns` pass: watchdogs, then the commands.
    pub(super) fn step(&mut self, dt_ns: u64, parameters: &Database, power: &mut Power, standing: bool) {
        if runs_out(&mut self.served_ns, dt_ns) {
            self.trip(power, trip::WATCHDOG);
        }
        if runs_out(&mut self.received_ns, dt_ns) {
            self.trip(power, self.link_trip);
        }
        let by_word = obeyed(parameters);
        let control = by_word.unwrap_or_else(|| terminals(parameters));
        let enabled = power.is_enabled()
            && power.fault().is_none()
            && parameters.is_on(table::DRIVE_ENABLE)
            && has(control, C::ENABLE);
        self.running = self.command(control, parameters).filter(|_| enabled);
        let stops = self.active && !standing;
        let holds = parameters.is_on(table::HOLD_ZERO_SPEED) && (self.active || by_word.is_some());
        let coasts = !standing && parameters.get(table::STOP_MODE) == COASTING;
        self.active = enabled && (self.running.is_some() || (stops || holds) && !coasts);
        if !enabled {
            self.latched = None;
        }
    }

    /// The run command of the control word, latched or not.
    fn command(&mut self, control: u16, parameters: &Database) -> Option<Run> {
        let command = run(control);
        if !LATCHING.contains(&parameters.get(table::START_LOGIC)) {
            return command;
        }
        self.latched = match has(control, C::NOT_STOP) {
            true => command.or(self.latched),
            false => None,
        };
        self.latched
    }

    /// The target of the ramp, 0.1 rpm.
    pub(super) fn pre_ramp(&self, parameters: &Database) -> i32 {
        let Some(run) = self.running else { return 0 };
        let reference = match run.jog {
            true => parameters.get(table::JOG_REFERENCE),
            false => selected(parameters),
        };
        if run.reverse { -reference } else { reference }
    }

    /// The power stage is on.
    pub(super) fn is_active(&self) -> bool {
        self.active
    }

    /// It is commanded to run.
    pub(super) fn is_running(&self) -> bool {
        self.running.is_some()
    }

    /// It is commanded to run backward.
    pub(super) fn is_reversed(&self) -> bool {
        self.running.is_some_and(|run| run.reverse)
    }

    /// An entry of the log, 0 being the newest.
    pub(super) fn logged(&self, index: u8) -> u16 {
        self.log.get(usize::from(index)).copied().unwrap_or(trip::NONE)
    }
}

/// The control word, while it is followed.
pub(super) fn obeyed(parameters: &Database) -> Option<u16> {
    let word = parameters.get(table::CONTROL_WORD) as u16;
    (parameters.is_on(table::CONTROL_WORD_ENABLE) && has(word, C::AUTO)).then_some(word)
}

/// The state of the terminals, as a control word.
fn terminals(parameters: &Database) -> u16 {
    let bits = TERMINALS.iter().filter(|(place, _)| parameters.is_on(*place));
    bits.fold(C::ENABLE, |word, (_, bit)| word | bit)
}

/// The run command in a control word.
fn run(word: u16) -> Option<Run> {
    let one = |forward: bool, reverse: bool, jog| (forward != reverse).then_some(Run { reverse, jog });
    if word & (C::RUN_FORWARD | C::RUN_REVERSE | C::RUN) != 0 {
        let (run, reverse) = (has(word, C::RUN), has(word, C::REVERSE));
        return one(
            has(word, C::RUN_FORWARD) || run && !reverse,
            has(word, C::RUN_REVERSE) || run && reverse,
            false,
        );
    }
    one(has(word, C::JOG_FORWARD), has(word, C::JOG_REVERSE), true)
}

/// The reference as selected, within its limits, 0.1 rpm.
pub(super) fn selected(parameters: &Database) -> i32 {
    let most = parameters.get(table::MAXIMUM_REFERENCE);
    let least = match parameters.is_on(table::BIPOLAR) {
        true => -most,
        false => parameters.get(table::MINIMUM_REFERENCE).min(most),
    };
    let preset = match parameters.get(table::PRESET_SELECTOR) {
        number @ 1..=8 => table::PRESET + number as usize - 1,
        _ => table::PRESET,
    };
    let place = match parameters.get(table::REFERENCE_SELECTOR) {
        3 => preset,
        0 if parameters.is_on(table::REMOTE) => preset,
        _ => table::ANALOGUE_REFERENCE,
    };
    parameters.get(place).clamp(least, most)
}

/// Takes `dt_ns` from the rest; true once, when nothing is left.
fn runs_out(left: &mut Option<u64>, dt_ns: u64) -> bool {
    *left = left.map(|left| left.saturating_sub(dt_ns));
    left.take_if(|left| *left == 0).is_some()
}
