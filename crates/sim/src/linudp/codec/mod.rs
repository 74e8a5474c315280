//! LinUDP V2 on the wire, from the drive's end: telegrams, words, states and codes.
//!
//! Written from the facts of the manuals and independent of the master's codec: a field that one of them misreads
//! cannot agree with itself. A test outside of both crates compares them. All fields are little-endian.
//!
//! | file | content |
//! |---|---|
//! | `mod` | request, response, bits of the words, main states |
//! | `channel` | the real-time-config channel: commands, status, access to parameters |
//! | `commands` | layouts of the motion commands |
//! | `errors` | error codes and their texts |
//! | `stored` | curves and command table entries |

#![expect(missing_docs, reason = "fields, bits and codes are named as in the manual")]

pub mod channel;
pub mod commands;
pub mod errors;
pub mod stored;

use self::channel::ConfigBlock;

/// The UDP port of every master.
pub const MASTER_PORT: u16 = 41136;
/// The UDP port of every drive.
pub const DRIVE_PORT: u16 = 49360;

/// The longest response: both definitions and all blocks.
pub const RESPONSE_MAX: usize = 50;

/// Bits of a request definition.
pub mod requested {
    pub const CONTROL: u32 = 1 << 0;
    pub const MOTION: u32 = 1 << 1;
    pub const CONFIG: u32 = 1 << 2;
}

/// Bits of the control word.
pub mod control {
    pub const SWITCH_ON: u16 = 1 << 0;
    pub const VOLTAGE_ENABLE: u16 = 1 << 1;
    pub const NO_QUICK_STOP: u16 = 1 << 2;
    pub const ENABLE_OPERATION: u16 = 1 << 3;
    pub const NO_ABORT: u16 = 1 << 4;
    pub const NO_FREEZE: u16 = 1 << 5;
    pub const GO_TO_POSITION: u16 = 1 << 6;
    pub const ERROR_ACKNOWLEDGE: u16 = 1 << 7;
    pub const JOG_PLUS: u16 = 1 << 8;
    pub const JOG_MINUS: u16 = 1 << 9;
    pub const HOME: u16 = 1 << 11;
    pub const GO_TO_INITIAL: u16 = 1 << 13;
    /// Bits 1-5, which parameters commonly force to 1.
    pub const ENABLES: u16 = 0x003E;
    /// A drive that is switched on.
    pub const ON: u16 = 0x003F;
}

/// Bits of the status word.
pub mod status {
    pub const OPERATION_ENABLED: u16 = 1 << 0;
    pub const SWITCH_ON_ACTIVE: u16 = 1 << 1;
    pub const ENABLE_OPERATION: u16 = 1 << 2;
    pub const ERROR: u16 = 1 << 3;
    pub const VOLTAGE_ENABLE: u16 = 1 << 4;
    pub const NO_QUICK_STOP: u16 = 1 << 5;
    pub const SWITCH_ON_LOCKED: u16 = 1 << 6;
    pub const WARNING: u16 = 1 << 7;
    pub const EVENT_HANDLER: u16 = 1 << 8;
    pub const SPECIAL_MOTION: u16 = 1 << 9;
    pub const IN_TARGET: u16 = 1 << 10;
    pub const HOMED: u16 = 1 << 11;
    pub const FATAL_ERROR: u16 = 1 << 12;
    pub const MOTION_ACTIVE: u16 = 1 << 13;
}

/// Bits of the warn word.
pub mod warn {
    pub const POSITION_LAG: u16 = 1 << 4;
    pub const NOT_HOMED: u16 = 1 << 7;
}

/// Main states: the high byte of the state variable.
pub mod state {
    pub const NOT_READY: u8 = 0;
    pub const SWITCH_ON_DISABLED: u8 = 1;
    pub const READY_TO_SWITCH_ON: u8 = 2;
    pub const ERROR: u8 = 4;
    pub const HW_TESTS: u8 = 5;
    pub const READY_TO_OPERATE: u8 = 6;
    pub const OPERATION_ENABLED: u8 = 8;
    pub const HOMING: u8 = 9;
    pub const GOING_TO_INITIAL: u8 = 11;
    pub const ABORTING: u8 = 12;
    pub const FREEZING: u8 = 13;
    pub const QUICK_STOP: u8 = 14;
    pub const GOING_TO_POSITION: u8 = 15;
    pub const JOGGING_PLUS: u8 = 16;
    pub const JOGGING_MINUS: u8 = 17;
}

/// Bits of the sub state, the low byte of the state variable: in state 8 next to the command count, and the value of a
/// finished motion of the drive's own.
pub mod sub_state {
    pub const EVENT_HANDLER: u8 = 1 << 4;
    pub const MOTION_ACTIVE: u8 = 1 << 5;
    pub const IN_TARGET: u8 = 1 << 6;
    pub const HOMED: u8 = 1 << 7;
    pub const FINISHED: u8 = 0x0F;
    pub const JOGGING: u8 = 0x01;
}

/// A motion command: its header, and its parameters, which are 0 where the master sent none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Motion {
    pub header: u16,
    pub parameters: [u8; 30],
}

impl Motion {
    /// Master id and sub id.
    pub fn id(&self) -> u16 {
        self.header >> 4
    }

    pub fn count(&self) -> u8 {
        (self.header & 0xF) as u8
    }
}

/// A request, as far as the drive reads it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Request {
    /// Both definitions as they came, reserved bits included: the response repeats them.
    pub definitions: [u32; 2],
    pub control: Option<u16>,
    pub motion: Option<Motion>,
    pub config: Option<ConfigBlock>,
}

impl Request {
    /// `None`: shorter than its definition. Only the last block may be incomplete, and only behind its first word.
    pub fn parse(bytes: &[u8]) -> Option<Request> {
        let (definitions, mut rest) = bytes.split_first_chunk::<8>()?;
        let [request, response] = words(definitions);
        let control = match request & requested::CONTROL {
            0 => None,
            _ => Some(u16::from_le_bytes(block(&mut rest, true)?)),
        };
        let is_last = request & requested::CONFIG == 0;
        let motion = match request & requested::MOTION {
            0 => None,
            _ => {
                let [low, high, parameters @ ..]: [u8; 32] = block(&mut rest, !is_last)?;
                Some(Motion { header: u16::from_le_bytes([low, high]), parameters })
            }
        };
        let config = if is_last { None } else { Some(ConfigBlock::parse(block(&mut rest, false)?)) };
        Some(Request { definitions: [request, response], control, motion, config })
    }
}

fn words(bytes: &[u8; 8]) -> [u32; 2] {
    let [a, b, c, d, e, f, g, h] = *bytes;
    [u32::from_le_bytes([a, b, c, d]), u32::from_le_bytes([e, f, g, h])]
}

/// Takes a block from the front of `rest`: all of it, or at least its first word, the others being 0.
fn block<const N: usize>(rest: &mut &[u8], whole: bool) -> Option<[u8; N]> {
    let (taken, behind) = rest.split_at(rest.len().min(N));
    let mut bytes = [0; N];
    bytes[..taken.len()].copy_from_slice(taken);
    *rest = behind;
    (taken.len() >= if whole { N } else { 2 }).then_some(bytes)
}

/// The drive's report: every block that a response can have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Report {
    pub status: u16,
    pub state: u16,
    /// 0.1 um.
    pub actual: i32,
    /// 0.1 um.
    pub demand: i32,
    /// mA.
    pub current: i16,
    pub warn: u16,
    pub error: u16,
    pub monitor: [u32; 4],
    /// Present if, and only if, the request has such a block.
    pub config: Option<ConfigBlock>,
}

impl Report {
    /// Writes the response to a request with these definitions; returns its size, without padding.
    pub fn write(&self, definitions: [u32; 2], to: &mut [u8]) -> usize {
        let mut size = 0;
        let mut put = |bytes: &[u8]| {
            to[size..size + bytes.len()].copy_from_slice(bytes);
            size += bytes.len();
        };
        definitions.iter().for_each(|definition| put(&definition.to_le_bytes()));
        for bit in (0..8).filter(|bit| definitions[1] >> bit & 1 == 1) {
            match bit {
                0 => put(&self.status.to_le_bytes()),
                1 => put(&self.state.to_le_bytes()),
                2 => put(&self.actual.to_le_bytes()),
                3 => put(&self.demand.to_le_bytes()),
                4 => put(&self.current.to_le_bytes()),
                5 => put(&self.warn.to_le_bytes()),
                6 => put(&self.error.to_le_bytes()),
                _ => self.monitor.iter().for_each(|channel| put(&channel.to_le_bytes())),
            }
        }
        if let Some(config) = &self.config {
            put(&config.bytes());
        }
        size
    }
}
