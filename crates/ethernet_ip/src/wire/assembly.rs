//! The process data of the drives, and the codes in it (MOONS' page of the STF and SSDC; Applied Motion, Host Command
//! Reference 920-0002 W, EtherNet/IP).

use std::fmt;
use std::str::FromStr;

use super::Reader;

/// The configuration assembly.
pub const CONFIGURATION: u16 = 0x66;

/// The outputs, bytes.
pub const OUTPUT_SIZE: usize = 64;
/// The elements of input assembly 0x65.
const ELEMENTS: usize = 14;

/// The assemblies of a drive: its value is the input assembly.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Version {
    /// Input assembly 0x64, no outputs.
    V1 = 0x64,
    /// Input assembly 0x65, output assembly 0x70.
    V2,
}

/// The order of the elements of input assembly 0x65.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Layout {
    /// Of the Host Command Reference, with the position error.
    #[default]
    Manual,
    /// Of the vendor's page, without it.
    Page,
}

/// The input assembly, bytes.
pub const fn input_size(version: Version) -> usize {
    match version {
        Version::V1 => 30,
        Version::V2 => 4 * ELEMENTS,
    }
}

/// The input assembly of a drive, in its own integers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Inputs {
    /// See [`status`].
    pub status: u16,
    /// See [`ALARMS`]. The meaning of the upper half is not known; the first version has none.
    pub alarm: u32,
    /// Supply voltage, 0.1 V.
    pub voltage: u32,
    /// Current: mA; of the first version 0.01 A.
    pub current: i32,
    /// Temperature of the drive, 0.1 °C.
    pub temperature: i32,
    /// The encoder's position, counts.
    pub encoder: i32,
    /// The absolute position, steps.
    pub absolute: i32,
    /// The position error, counts; only in the manual's layout.
    pub position_error: Option<i32>,
    /// The actual velocity, 1/240 rev/s.
    pub velocity: i32,
    /// The inputs of an extension board: open is 1.
    pub extended_inputs: u32,
    /// The inputs of the main board: open is 1.
    pub main_inputs: u32,
    /// The outputs, closed is 1; not in the manual's layout.
    pub outputs: Option<u32>,
    /// The analog inputs, 0 ... 16383; the first version has none.
    pub analog: Option<[u32; 2]>,
}

impl Inputs {
    /// The assembly of a drive; `None` if its size is another one.
    ///
    /// Of the two input words of the first version the extended one comes first, as in the example of the manual and on
    /// MOONS' page; the table of the manual has them the other way.
    #[inline]
    pub fn parse(data: &[u8], version: Version, layout: Layout) -> Option<Inputs> {
        if data.len() != input_size(version) {
            return None;
        }
        match version {
            Version::V1 => Inputs::first_version(Reader(data)),
            Version::V2 => Inputs::second_version(data, layout),
        }
    }

    fn first_version(mut reader: Reader<'_>) -> Option<Inputs> {
        // The address of the drive.
        reader.long_le()?;
        Some(Inputs {
            status: reader.word_le()?,
            alarm: reader.word_le()?.into(),
            voltage: reader.word_le()?.into(),
            current: (reader.word_le()? as i16).into(),
            temperature: (reader.word_le()? as i16).into(),
            encoder: reader.long_le()? as i32,
            absolute: reader.long_le()? as i32,
            position_error: None,
            velocity: (reader.word_le()? as i16).into(),
            extended_inputs: reader.word_le()?.into(),
            main_inputs: reader.word_le()?.into(),
            outputs: Some(reader.word_le()?.into()),
            analog: None,
        })
    }

    /// The assembly of a drive of the second version.
    #[inline(always)] // What is not needed of it is not decoded.
    pub(crate) fn second_version(data: &[u8], layout: Layout) -> Option<Inputs> {
        let (elements, []) = data.as_chunks() else { return None };
        let elements: &[[u8; 4]; ELEMENTS] = elements.try_into().ok()?;
        let element = |place: usize| u32::from_le_bytes(elements[place]);
        // The manual's layout has one more, and ends earlier.
        let (behind, is_page) = (7 + usize::from(layout == Layout::Manual), layout == Layout::Page);
        Some(Inputs {
            // The upper half is not used.
            status: element(0) as u16,
            alarm: element(1),
            voltage: element(2),
            current: element(3) as i32,
            temperature: element(4) as i32,
            encoder: element(5) as i32,
            absolute: element(6) as i32,
            position_error: (!is_page).then_some(element(7) as i32),
            velocity: element(behind) as i32,
            extended_inputs: element(behind + 1),
            main_inputs: element(behind + 2),
            outputs: is_page.then_some(element(10)),
            analog: Some([element(12), element(13)]),
        })
    }
}

/// The output assembly of a drive, in its own integers. Velocities are in 1/240 rev/s (0.25 rpm), accelerations in 10
/// rpm/s: "10 rev/s/s" in the tables is a misprint, as the examples of the manual show.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outputs {
    /// See [`command`].
    pub command: u32,
    /// JS: the speed of a jog, with its direction.
    pub jog_speed: i32,
    /// JA: the acceleration of a jog.
    pub jog_acceleration: u32,
    /// JL: the deceleration of a jog.
    pub jog_deceleration: u32,
    /// VE: the velocity of a move.
    pub velocity: u32,
    /// AC: the acceleration of a move.
    pub acceleration: u32,
    /// DE: the deceleration of a move, and of the stop with it.
    pub deceleration: u32,
    /// DI: the distance or the position, motor steps.
    pub distance: i32,
    /// GC: the current, 0.01 A.
    pub current: i32,
    /// The letters of a host command.
    pub letters: Letters,
    /// The first register: data, an I/O code or a segment.
    pub register_1: u32,
    /// The second register.
    pub register_2: u32,
}

impl Outputs {
    /// As on the wire.
    #[inline]
    pub fn bytes(&self) -> [u8; OUTPUT_SIZE] {
        let elements = [
            self.command,
            self.jog_speed as u32,
            self.jog_acceleration,
            self.jog_deceleration,
            self.velocity,
            self.acceleration,
            self.deceleration,
            self.distance as u32,
            self.current as u32,
            self.letters.0.into(),
            self.register_1,
            self.register_2,
            0,
            0,
            0,
            0,
        ];
        let mut bytes = [0; OUTPUT_SIZE];
        for (bytes, element) in bytes.as_chunks_mut().0.iter_mut().zip(elements) {
            *bytes = element.to_le_bytes();
        }
        bytes
    }
}

/// Two letters of a host command, the first one in the upper byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Letters(pub u16);

impl Letters {
    /// "SO"; `None` if these are not two capital letters.
    pub fn new(letters: &str) -> Option<Letters> {
        let &[first, second] = letters.as_bytes() else { return None };
        let capital = first.is_ascii_uppercase() && second.is_ascii_uppercase();
        capital.then_some(Letters(u16::from_be_bytes([first, second])))
    }
}

/// The bits of the status word (SC).
pub mod status {
    /// The motor has current.
    pub const ENABLED: u16 = 0x0001;
    /// Sampling.
    pub const SAMPLING: u16 = 0x0002;
    /// A fault has taken the current from the motor.
    pub const FAULT: u16 = 0x0004;
    /// In position; servo and step-servo only.
    pub const IN_POSITION: u16 = 0x0008;
    /// Moving.
    pub const MOVING: u16 = 0x0010;
    /// Jogging.
    pub const JOGGING: u16 = 0x0020;
    /// Stopping.
    pub const STOPPING: u16 = 0x0040;
    /// Waiting for an input.
    pub const WAITING_FOR_INPUT: u16 = 0x0080;
    /// Saving parameters.
    pub const SAVING: u16 = 0x0100;
    /// An alarm is present, a fault or not.
    pub const ALARM: u16 = 0x0200;
    /// Homing.
    pub const HOMING: u16 = 0x0400;
    /// Waiting for a time.
    pub const WAITING_FOR_TIME: u16 = 0x0800;
    /// A wizard of the vendor's program runs.
    pub const WIZARD: u16 = 0x1000;
    /// Checking the encoder.
    pub const CHECKING_ENCODER: u16 = 0x2000;
    /// A Q program runs.
    pub const PROGRAM: u16 = 0x4000;
    /// Initialising after power-up.
    pub const INITIALIZING: u16 = 0x8000;

    /// The meaning of each bit, the lowest first.
    pub const NAMES: [&str; 16] = [
        "enabled",
        "sampling",
        "fault",
        "in position",
        "moving",
        "jogging",
        "stopping",
        "waiting for an input",
        "saving",
        "alarm",
        "homing",
        "waiting for a time",
        "wizard running",
        "checking the encoder",
        "Q program running",
        "initialising",
    ];
}

/// A bit of the alarm word (AL).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Alarm {
    /// The meaning.
    pub name: &'static str,
    /// It takes the current from the motor.
    pub fault: bool,
}

const fn alarm(name: &'static str, fault: bool) -> Alarm {
    Alarm { name, fault }
}

/// The alarms, that of the lowest bit first. 0x2000 and 0x8000 are of the step-servos only.
pub const ALARMS: [Alarm; 16] = [
    alarm("position limit", true),
    alarm("CCW limit", false),
    alarm("CW limit", false),
    alarm("over temperature", true),
    alarm("internal voltage", true),
    alarm("over voltage", true),
    alarm("under voltage", false),
    alarm("over current", true),
    alarm("open motor winding", true),
    alarm("bad encoder", true),
    alarm("communication error", false),
    alarm("bad flash", false),
    alarm("no move: the motor is disabled", false),
    alarm("current foldback", false),
    alarm("blank Q segment", false),
    alarm("NV memory double error", false),
];

/// The alarms of a word. What its upper half says is not known.
pub fn alarms(word: u32) -> impl Iterator<Item = Alarm> {
    ALARMS.into_iter().enumerate().filter(move |(bit, _)| word >> bit & 1 != 0).map(|(_, alarm)| alarm)
}

/// The bits of the command word. The drive acts on the change from [`command::IDLE`] to one of them.
pub mod command {
    /// Nothing.
    pub const IDLE: u32 = 0;
    /// Gives the motor current.
    pub const ENABLE: u32 = 1 << 1;
    /// Takes the current from the motor.
    pub const DISABLE: u32 = 1 << 2;
    /// FL: a relative move.
    pub const MOVE_RELATIVE: u32 = 1 << 3;
    /// FP: an absolute move.
    pub const MOVE_ABSOLUTE: u32 = 1 << 4;
    /// FS: until a sensor.
    pub const MOVE_TO_SENSOR: u32 = 1 << 5;
    /// FD: with two sensors.
    pub const MOVE_TO_TWO_SENSORS: u32 = 1 << 6;
    /// FY: until a sensor, but no farther than a safety distance.
    pub const MOVE_TO_SENSOR_SAFELY: u32 = 1 << 7;
    /// FM: until a sensor, which is masked for a distance.
    pub const MOVE_TO_SENSOR_MASKED: u32 = 1 << 8;
    /// FO: a move that sets an output.
    pub const MOVE_WITH_OUTPUT: u32 = 1 << 9;
    /// FC: a move that changes its speed.
    pub const MOVE_WITH_SPEED_CHANGE: u32 = 1 << 10;
    /// SH: seek home.
    pub const SEEK_HOME: u32 = 1 << 11;
    /// FH: find home.
    pub const FIND_HOME: u32 = 1 << 12;
    /// FE: follow the encoder.
    pub const FOLLOW_ENCODER: u32 = 1 << 13;
    /// Stops with the largest deceleration (AM).
    pub const STOP_FAST: u32 = 1 << 14;
    /// Stops with the deceleration that is set (DE).
    pub const STOP: u32 = 1 << 15;
    /// Begins a jog.
    pub const JOG: u32 = 1 << 16;
    /// Changes the speed of a jog.
    pub const JOG_SPEED: u32 = 1 << 17;
    /// A host command, with its letters and registers: the only one that also acts when these change.
    pub const HOST: u32 = 1 << 18;
    /// QX: executes a segment of the Q program.
    pub const EXECUTE_SEGMENT: u32 = 1 << 19;
    /// AR: resets alarms. The motor stays without current.
    pub const RESET_ALARM: u32 = 1 << 20;
    /// GC: commands a current; servo and step-servo only.
    pub const CURRENT: u32 = 1 << 21;
}

/// An input or output with a condition, as registers and sensor moves have it: "2L" is 0x4CB2.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct IoCode {
    number: u8,
    condition: Condition,
}

/// When an input counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Condition {
    /// While it is high (open).
    High = b'H',
    /// While it is low (closed).
    Low = b'L',
    /// When it rises.
    Rising = b'R',
    /// When it falls.
    Falling = b'F',
}

impl Condition {
    fn from_letter(letter: u8) -> Option<Condition> {
        let all = [Condition::High, Condition::Low, Condition::Rising, Condition::Falling];
        all.into_iter().find(|condition| *condition as u8 == letter)
    }
}

impl IoCode {
    /// The highest number.
    pub const MAX: u8 = 12;
    /// The lower byte of number 0, which is the index of the encoder.
    const BASE: u8 = 0xB0;

    /// `None` beyond [`MAX`](Self::MAX).
    pub fn new(number: u8, condition: Condition) -> Option<IoCode> {
        (number <= IoCode::MAX).then_some(IoCode { number, condition })
    }

    /// The code on the wire.
    pub fn code(self) -> u16 {
        u16::from_be_bytes([self.condition as u8, IoCode::BASE + self.number])
    }

    /// The reverse; `None` if it is none.
    pub fn from_code(code: u16) -> Option<IoCode> {
        let [letter, number] = code.to_be_bytes();
        IoCode::new(number.checked_sub(IoCode::BASE)?, Condition::from_letter(letter)?)
    }
}

impl FromStr for IoCode {
    type Err = NoIoCode;

    fn from_str(text: &str) -> Result<IoCode, NoIoCode> {
        let parse = || {
            let (letter, digits) = text.as_bytes().split_last()?;
            let is_number = digits.len() <= 2 && digits.iter().all(u8::is_ascii_digit);
            let number = text.get(..digits.len()).filter(|_| is_number)?.parse().ok()?;
            IoCode::new(number, Condition::from_letter(*letter)?)
        };
        parse().ok_or(NoIoCode)
    }
}

impl fmt::Display for IoCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.number, char::from(self.condition as u8))
    }
}

/// Text that is no [`IoCode`].
#[derive(Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("no input with a condition: 0 ... 12, then H, L, R or F, as in 2L")]
pub struct NoIoCode;
fieldbeat_core::debug_as_display!(NoIoCode);
