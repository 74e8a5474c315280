//! CiA 402: control word 6040h and status word 6041h, the states and the transitions between them; DRIVECOM has had the
//! same states before it.
//!
//! Knows no bus and no drive; the mode-specific bits are interpreted elsewhere. Facts: CAN manual of the S300 and
//! S700 ("Device control"), EtherCAT manual, IEC 61800-7-201. The state is [`State`], onto which all protocols map
//! theirs.

use crate::axis::State;

/// The relevant bits of each state, and their values. The CAN manual of the S300 prints bit 6 of the first as 1; the
/// standard, the AKD and the EMF2133IB have 0.
const STATES: [(State, u16, u16); 8] = [
    (State::NotReadyToSwitchOn, 0x4F, 0x00),
    (State::SwitchOnDisabled, 0x4F, 0x40),
    (State::ReadyToSwitchOn, 0x6F, 0x21),
    (State::SwitchedOn, 0x6F, 0x23),
    (State::OperationEnabled, 0x6F, 0x27),
    (State::QuickStopActive, 0x6F, 0x07),
    (State::FaultReactionActive, 0x4F, 0x0F),
    (State::Fault, 0x4F, 0x08),
];

/// The state in a status word; [`State::Unknown`]: no valid one.
#[inline]
pub fn state(status: u16) -> State {
    let known = STATES.iter().find(|(_, mask, value)| status & mask == *value);
    known.map_or(State::Unknown, |(state, ..)| *state)
}

/// The control word, 6040h.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct ControlWord(pub u16);

impl ControlWord {
    /// Bit 0: switch on.
    pub const SWITCH_ON: u16 = 1 << 0;
    /// Bit 1: enable voltage.
    pub const ENABLE_VOLTAGE: u16 = 1 << 1;
    /// Bit 2: 0 = quick stop.
    pub const NO_QUICK_STOP: u16 = 1 << 2;
    /// Bit 3: enable operation. In a Kollmorgen drive its rising edge makes setpoints count: the power stage is on
    /// before.
    pub const ENABLE_OPERATION: u16 = 1 << 3;
    /// Bit 4, of the mode: a new setpoint (profile position), start (homing), follow (interpolated position).
    pub const START: u16 = 1 << 4;
    /// Bit 5, of the mode: change set immediately (profile position).
    pub const AT_ONCE: u16 = 1 << 5;
    /// Bit 6, of the mode: the target is relative (profile position).
    pub const RELATIVE: u16 = 1 << 6;
    /// Bit 7: the rising edge resets a fault.
    pub const FAULT_RESET: u16 = 1 << 7;
    /// Bit 8: halt.
    pub const HALT: u16 = 1 << 8;

    /// All of `bits` are 1.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits == bits
    }

    /// With `bits` as 1.
    pub const fn with(self, bits: u16) -> ControlWord {
        ControlWord(self.0 | bits)
    }

    /// One of `bits` was 0 in the word before and is 1 now.
    pub const fn rises(self, before: ControlWord, bits: u16) -> bool {
        self.0 & !before.0 & bits != 0
    }

    /// The command; `None`: bit 7 is set, or bits 0 ... 3 are no command.
    pub fn command(self) -> Option<ControlCommand> {
        ControlCommand::ALL.into_iter().find(|command| {
            let (mask, value) = command.bits();
            self.0 & mask == value
        })
    }
}

/// The command in bits 0 ... 3 of a control word. A fault reset is no command: it is the rising edge of bit 7.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ControlCommand {
    /// Be ready to switch on.
    Shutdown,
    /// Switch the power stage on; from operation: disable operation.
    SwitchOn,
    /// Follow setpoints.
    EnableOperation,
    /// Power off, at once.
    DisableVoltage,
    /// Stop as fast as configured for it.
    QuickStop,
}

impl ControlCommand {
    /// All of them.
    pub const ALL: [ControlCommand; 5] = [
        ControlCommand::Shutdown,
        ControlCommand::SwitchOn,
        ControlCommand::EnableOperation,
        ControlCommand::DisableVoltage,
        ControlCommand::QuickStop,
    ];

    /// The control word of the command, with every other bit 0.
    pub const fn word(self) -> ControlWord {
        ControlWord(match self {
            ControlCommand::Shutdown => 0x0006,
            ControlCommand::SwitchOn => 0x0007,
            ControlCommand::EnableOperation => 0x000F,
            ControlCommand::DisableVoltage => 0x0000,
            ControlCommand::QuickStop => 0x0002,
        })
    }

    /// The relevant bits, and their values.
    pub const fn bits(self) -> (u16, u16) {
        let mask = match self {
            ControlCommand::Shutdown => 0x87,
            ControlCommand::SwitchOn | ControlCommand::EnableOperation => 0x8F,
            ControlCommand::DisableVoltage => 0x82,
            ControlCommand::QuickStop => 0x86,
        };
        (mask, self.word().0)
    }
}

/// Why a state is left.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Cause {
    /// A control word.
    ControlCommand(ControlCommand),
    /// The rising edge of bit 7.
    FaultReset,
}

/// A transition that a master causes. Those that a drive makes by itself (0, 1, 13, 14) are not among them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Transition {
    /// The number in the standard.
    pub number: u8,
    /// The state before.
    pub from: State,
    /// The state after.
    pub to: State,
    /// The cause.
    pub cause: Cause,
}

impl Transition {
    const fn new(number: u8, from: State, to: State, command: ControlCommand) -> Transition {
        Transition { number, from, to, cause: Cause::ControlCommand(command) }
    }

    /// All of them, by number. Where two commands cause the same one, the simpler comes first.
    pub const ALL: [Transition; 15] = {
        use ControlCommand::{DisableVoltage, EnableOperation, QuickStop, Shutdown, SwitchOn};
        use State::{
            Fault, OperationEnabled, QuickStopActive, ReadyToSwitchOn, SwitchOnDisabled, SwitchedOn,
        };
        [
            Transition::new(2, SwitchOnDisabled, ReadyToSwitchOn, Shutdown),
            Transition::new(3, ReadyToSwitchOn, SwitchedOn, SwitchOn),
            Transition::new(4, SwitchedOn, OperationEnabled, EnableOperation),
            Transition::new(5, OperationEnabled, SwitchedOn, SwitchOn),
            Transition::new(6, SwitchedOn, ReadyToSwitchOn, Shutdown),
            Transition::new(7, ReadyToSwitchOn, SwitchOnDisabled, DisableVoltage),
            Transition::new(7, ReadyToSwitchOn, SwitchOnDisabled, QuickStop),
            Transition::new(8, OperationEnabled, ReadyToSwitchOn, Shutdown),
            Transition::new(9, OperationEnabled, SwitchOnDisabled, DisableVoltage),
            Transition::new(10, SwitchedOn, SwitchOnDisabled, DisableVoltage),
            Transition::new(10, SwitchedOn, SwitchOnDisabled, QuickStop),
            Transition::new(11, OperationEnabled, QuickStopActive, QuickStop),
            Transition::new(12, QuickStopActive, SwitchOnDisabled, DisableVoltage),
            Transition { number: 15, from: Fault, to: SwitchOnDisabled, cause: Cause::FaultReset },
            Transition::new(16, QuickStopActive, OperationEnabled, EnableOperation),
        ]
    };

    /// The one that a control word causes in a drive in this state.
    pub fn caused(from: State, word: ControlWord, before: ControlWord) -> Option<Transition> {
        let command = word.command();
        Self::ALL.into_iter().find(|transition| {
            transition.from == from
                && match transition.cause {
                    Cause::ControlCommand(caused) => command == Some(caused),
                    Cause::FaultReset => word.rises(before, ControlWord::FAULT_RESET),
                }
        })
    }
}

/// The status word, 6041h. It is not valid outside of SAFEOP and OP.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct StatusWord(pub u16);

impl StatusWord {
    /// Bit 0: ready to switch on.
    pub const READY: u16 = 1 << 0;
    /// Bit 1: switched on.
    pub const SWITCHED_ON: u16 = 1 << 1;
    /// Bit 2: operation enabled.
    pub const OPERATION_ENABLED: u16 = 1 << 2;
    /// Bit 3: fault.
    pub const FAULT: u16 = 1 << 3;
    /// Bit 4: voltage enabled.
    pub const VOLTAGE: u16 = 1 << 4;
    /// Bit 5: 0 = quick stop.
    pub const NO_QUICK_STOP: u16 = 1 << 5;
    /// Bit 6: switching on is disabled.
    pub const SWITCH_ON_DISABLED: u16 = 1 << 6;
    /// Bit 7: a warning is present.
    pub const WARNING: u16 = 1 << 7;
    /// Bit 9: remote. A Kollmorgen drive always has it: its status word is never 0.
    pub const REMOTE: u16 = 1 << 9;
    /// Bit 10: target reached.
    pub const TARGET_REACHED: u16 = 1 << 10;
    /// Bit 12, of the mode: setpoint acknowledged (profile position), homed (homing), follows (interpolated position).
    pub const MODE_12: u16 = 1 << 12;
    /// Bit 13, of the mode: following error, homing error.
    pub const MODE_13: u16 = 1 << 13;

    /// All of `bits` are 1.
    pub const fn has(self, bits: u16) -> bool {
        self.0 & bits == bits
    }

    /// With `bits` as 1.
    pub const fn with(self, bits: u16) -> StatusWord {
        StatusWord(self.0 | bits)
    }

    /// The state; [`State::Unknown`]: no valid one.
    #[inline]
    pub fn state(self) -> State {
        state(self.0)
    }

    /// The bits of a state, and no others.
    pub fn of(state: State) -> StatusWord {
        let known = STATES.iter().find(|(known, ..)| *known == state);
        StatusWord(known.map_or(0, |(.., value)| *value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_of_the_status_table_is_its_state_whatever_the_other_bits() {
        for (state, mask, value) in [
            (State::NotReadyToSwitchOn, 0x4F_u16, 0x00_u16),
            (State::SwitchOnDisabled, 0x4F, 0x40),
            (State::ReadyToSwitchOn, 0x6F, 0x21),
            (State::SwitchedOn, 0x6F, 0x23),
            (State::OperationEnabled, 0x6F, 0x27),
            (State::QuickStopActive, 0x6F, 0x07),
            (State::FaultReactionActive, 0x4F, 0x0F),
            (State::Fault, 0x4F, 0x08),
        ] {
            assert_eq!(StatusWord::of(state), StatusWord(value));
            let of_state = (0..=u16::MAX).filter(|word| StatusWord(*word).state() == state);
            let by_mask = (0..=u16::MAX).filter(|word| word & mask == value);
            assert!(of_state.eq(by_mask), "{state}");
        }
    }

    #[test]
    fn words_of_the_sheet_are_the_states_it_says() {
        assert_eq!(StatusWord(0x0637).state(), State::OperationEnabled);
        assert_eq!(StatusWord(0x0633).state(), State::SwitchedOn);
        // Ready with bit 5 = 0, or with bit 6 = 1: no row.
        assert_eq!(StatusWord(0x0001).state(), State::Unknown);
        assert_eq!(StatusWord(0x0060 | 0x0001).state(), State::Unknown);
        assert_eq!(StatusWord::of(State::Unknown), StatusWord(0));
    }

    #[test]
    fn every_row_of_the_command_table_is_its_command_whatever_the_other_bits() {
        // Bits 7, 3, 2, 1, 0; x = any.
        for (command, bits, word) in [
            (ControlCommand::Shutdown, "0x110", 0x0006),
            (ControlCommand::SwitchOn, "00111", 0x0007),
            (ControlCommand::EnableOperation, "01111", 0x000F),
            (ControlCommand::DisableVoltage, "0xx0x", 0x0000),
            (ControlCommand::QuickStop, "0x01x", 0x0002),
        ] {
            assert_eq!(command.word(), ControlWord(word));
            assert_eq!(command.word().command(), Some(command));
            for word in 0..=u16::MAX {
                let is_row = [7, 3, 2, 1, 0].iter().zip(bits.bytes()).all(|(bit, wanted)| match wanted {
                    b'x' => true,
                    digit => word >> bit & 1 == u16::from(digit - b'0'),
                });
                assert_eq!(ControlWord(word).command() == Some(command), is_row, "{word:#06x} {command:?}");
            }
        }
        assert_eq!(ControlWord(0x0080).command(), None, "a fault reset is an edge, no command");
    }

    #[test]
    fn the_word_of_a_transition_causes_it_from_its_state() {
        let expected = [
            (2, 0x06),
            (3, 0x07),
            (4, 0x0F),
            (5, 0x07),
            (6, 0x06),
            (7, 0x00),
            (7, 0x02),
            (8, 0x06),
            (9, 0x00),
            (10, 0x00),
            (10, 0x02),
            (11, 0x02),
            (12, 0x00),
            (15, 0x80),
            (16, 0x0F),
        ];
        for (transition, (number, word)) in Transition::ALL.into_iter().zip(expected) {
            let caused = Transition::caused(transition.from, ControlWord(word), ControlWord(0));
            assert_eq!((caused, transition.number), (Some(transition), number));
        }
    }

    #[test]
    fn a_reset_is_the_rising_edge_only_and_only_in_a_fault() {
        let reset = ControlWord(0x0080);
        let caused = |from, before| Transition::caused(from, reset, before).map(|one| one.number);
        assert_eq!(caused(State::Fault, ControlWord(0)), Some(15));
        assert_eq!(caused(State::Fault, reset), None);
        assert_eq!(caused(State::OperationEnabled, ControlWord(0)), None);
        assert_eq!(caused(State::FaultReactionActive, ControlWord(0)), None);
        // No other word leaves a fault.
        assert!(
            ControlCommand::ALL.iter().all(|command| {
                Transition::caused(State::Fault, command.word(), ControlWord(0)).is_none()
            })
        );
    }

    #[test]
    fn no_step_is_left_out_on_the_way_up() {
        let caused = |from, word| Transition::caused(from, ControlWord(word), ControlWord(0));
        assert_eq!(caused(State::SwitchOnDisabled, 0x0F), None);
        assert_eq!(caused(State::SwitchOnDisabled, 0x07), None);
        assert_eq!(caused(State::ReadyToSwitchOn, 0x0F), None);
        assert_eq!(caused(State::NotReadyToSwitchOn, 0x06), None);
    }
}
