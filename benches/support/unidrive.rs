//! A Unidrive as the benches have it, and what it answers when it is a few bytes in memory.

use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fieldbeat::axis::Limits;
use fieldbeat::bus::modbus::{
    Block, ControlWord, Mapping, Role, StatusWord, UnidriveDrive, Via, Watchdog, Width,
};
use fieldbeat::time::{MS, S};
use fieldbeat_modbus::parameter::DRIVE_UNIT;
pub use fieldbeat_modbus::wire::ADU_MAX;
use fieldbeat_modbus::wire::{Header, RegistersBuffer, Request, Response, function};
use fieldbeat_sim::modbus::UnidriveSettings;

use super::rig::{self, Scene};

/// Where a message has its id, its unit id and its function.
const TRANSACTION_HIGH: usize = 0;
const TRANSACTION_LOW: usize = 1;
const UNIT: usize = 6;
const FUNCTION: usize = 7;

/// Not the usual one, so that it needs no right.
const PORT: u16 = 1502;

/// A machine that stands still for a while trips no drive and loses no reply.
const WATCHDOG_NS: u64 = 5 * S;

static DIRECT: AtomicBool = AtomicBool::new(false);

/// From now on drives have the default mapping: their parameters stay where they are.
pub fn be_direct() {
    DIRECT.store(true, Ordering::Relaxed);
}

/// Whether they have it.
pub fn is_direct() -> bool {
    DIRECT.load(Ordering::Relaxed)
}

/// A drive as a machine might have it: all cyclic parameters side by side in menu 0, so that each exchange is one
/// request with function 23. A miss is counted, it does not end the measurement.
pub fn drive(address: Ipv4Addr) -> UnidriveDrive {
    let mut drive = UnidriveDrive::new(address.to_string(), address);
    drive.address.set_port(PORT);
    drive.via = if is_direct() { Via::Direct } else { Via::Menu0 { first: 1 } };
    drive.watchdog = Watchdog { timeout_ns: Some(WATCHDOG_NS), ..Watchdog::default() };
    drive.reply_within_ns = rig::reply_within_ns();
    drive.axis.limits = Limits { velocity: Some(50.0), ..Limits::default() };
    drive.axis.health.bucket = rig::bucket();
    drive.axis.stop.group = rig::group();
    drive.axis.enable_timeout = Duration::from_secs(60);
    drive
}

/// Such a drive, simulated. It obeys and is watched whoever its master is: the rivals set up nothing.
pub fn simulated(drive: &UnidriveDrive) -> UnidriveSettings {
    UnidriveSettings {
        // It follows the control word, and has a time-out of its interface.
        commissioned: vec![([6, 43], 1), ([15, 9], (WATCHDOG_NS / MS) as i32)],
        ..UnidriveSettings::of(drive)
    }
}

/// Which value of its block to read is the status word.
pub const STATUS_AT: usize = 2;

/// The blocks of such a drive in menu 0: all of it in one to write and one to read.
pub fn mapping(drive: &UnidriveDrive) -> Mapping {
    let mapping = mappings(drive).1.expect("it is in menu 0");
    assert_eq!((mapping.writes().len(), mapping.reads().len()), (1, 1), "one request for all of it");
    let front = [Role::Control, Role::Reference, Role::Status, Role::Speed];
    assert_eq!(mapping.reads()[0].roles[..4], front, "the benches know this order only");
    mapping
}

/// The request to the whole block of such a drive: this control word, and speed 0.
pub fn request(drive: &UnidriveDrive, control: ControlWord) -> ([u8; ADU_MAX], usize) {
    let mapping = mapping(drive);
    let (write, read) = (&mapping.writes()[0], &mapping.reads()[0]);
    let mut data = RegistersBuffer::new();
    data.push_long(control.0.into());
    data.push_long(0);
    let data = data.registers();
    let request =
        Request::ReadWrite { read: read.address, count: read.registers, write: write.address, data };
    let mut bytes = [0; ADU_MAX];
    let length = request.emit(Header { transaction: 0, unit: DRIVE_UNIT }, &mut bytes);
    (bytes, length)
}

/// The two blocks of such a drive: where its parameters are, and in menu 0.
pub fn mappings(drive: &UnidriveDrive) -> (Mapping, Option<Mapping>) {
    let direct = UnidriveDrive { via: Via::Direct, ..drive.clone() };
    match (Mapping::new(&direct), Mapping::new(drive)) {
        (Ok(direct), Ok(menu_0)) => (direct, Some(menu_0)),
        (Err(fault), _) | (_, Err(fault)) => rig::give_up(fault.message),
    }
}

/// A drive that answers from memory: it reads back what was written, is in operation while it is commanded to run, and
/// its speed is another one each time.
#[derive(Clone, Debug)]
pub struct Canned {
    reply: [u8; ADU_MAX],
    length: usize,
    // What the last request makes of it. A reply is written in eights, as the station reads it: to read over the edge
    // of what was just written holds a processor up, and of what the kernel has copied long before it does not.
    header: u64,
    written: [u32; 2],
    status: u32,
    speed: u32,
}

impl Canned {
    /// Where a request has its values, in function 23 to two parameters.
    const WRITTEN: [std::ops::Range<usize>; 2] = [17..21, 21..25];
    /// Where a reply has what was written, and behind it the status word and the speed.
    const READ_BACK: std::ops::Range<usize> = 9..17;
    const SAID: std::ops::Range<usize> = 17..25;

    /// The answers of [`drive`].
    pub fn new() -> Canned {
        let drive = drive(Ipv4Addr::LOCALHOST);
        let mut data = RegistersBuffer::new();
        for _ in &mapping(&drive).reads()[0].roles {
            data.push_long(0);
        }
        let mut reply = [0; ADU_MAX];
        let length = Response::ReadWritten { data: data.registers() }.emit(Header::default(), &mut reply);
        let header = u64::from_be_bytes(std::array::from_fn(|place| reply[place]));
        let status = u32::from(StatusWord::HEALTHY | StatusWord::ZERO_SPEED);
        Canned { reply, length, header, written: [0; 2], status, speed: 0 }
    }

    /// Receives a request; false if it is none to the whole block.
    #[inline]
    pub fn hear(&mut self, request: &[u8]) -> bool {
        match request.get(FUNCTION) {
            Some(&function::READ_WRITE) if request.len() >= Self::WRITTEN[1].end => {
                for (value, place) in self.written.iter_mut().zip(Self::WRITTEN) {
                    *value = request[place].iter().fold(0, |value, byte| value << 8 | u32::from(*byte));
                }
                let runs = self.written[0] & u32::from(ControlWord::ANY_RUN) != 0;
                let state = if runs { StatusWord::ACTIVE } else { StatusWord::ZERO_SPEED };
                self.status = match rig::is_scene(Scene::Faulted) {
                    true => 0,
                    false => u32::from(StatusWord::HEALTHY | state),
                };
            }
            // Nothing is written before the first order.
            Some(&function::READ) => {}
            _ => return false,
        }
        let front = std::array::from_fn(|place| match place {
            TRANSACTION_HIGH | TRANSACTION_LOW | UNIT | FUNCTION => request[place],
            _ => self.reply[place],
        });
        self.header = u64::from_be_bytes(front);
        true
    }

    /// Answers over the last answer, which stands in `room` still: by far the most of it is the same.
    #[inline]
    pub fn answer_again(&mut self, room: &mut [u8]) -> usize {
        self.speed = self.speed.wrapping_add(1);
        if rig::is_scene(Scene::Unsteady) {
            self.status ^= u32::from(StatusWord::AT_SPEED) * (self.speed & 1);
        }
        room[..8].copy_from_slice(&self.header.to_be_bytes());
        room[Self::READ_BACK].copy_from_slice(&pair(self.written));
        room[Self::SAID].copy_from_slice(&pair([self.status, self.speed]));
        self.length
    }

    /// Writes the answer to the received request into `room`, and gives its length.
    #[inline]
    pub fn answer(&mut self, room: &mut [u8]) -> usize {
        room[..self.length].copy_from_slice(&self.reply[..self.length]);
        self.answer_again(room)
    }
}

/// A drive with the default mapping that answers from memory, as [`Canned`] does: its registers, wherever they are.
#[derive(Clone, Debug)]
pub struct Direct {
    registers: Vec<u16>,
    control: usize,
    status: usize,
    speed: usize,
    reply: [u8; ADU_MAX],
    length: usize,
}

impl Direct {
    /// Its parameters are 0.
    pub fn new() -> Direct {
        let mapping = mappings(&drive(Ipv4Addr::LOCALHOST)).0;
        let blocks = || mapping.writes().iter().chain(mapping.reads());
        let at = |role: Role| {
            let place = |block: &Block| {
                let before = block.roles.iter().position(|one| *one == role)?;
                // Of two registers the second one has the lower half.
                let place = if block.width == Width::Long { 2 * before + 1 } else { before };
                Some(usize::from(block.address) + place)
            };
            blocks().find_map(place).expect("it is cyclic")
        };
        let (control, status, speed) = (at(Role::Control), at(Role::Status), at(Role::Speed));
        let registers = vec![0; usize::from(u16::MAX) + 1];
        Direct { registers, control, status, speed, reply: [0; ADU_MAX], length: 0 }
    }

    /// Receives a request; false if it is none that a master makes.
    pub fn hear(&mut self, request: &[u8]) -> bool {
        let word = |at: usize| usize::from(u16::from_be_bytes([request[at], request[at + 1]]));
        let (read, write) = match request.get(FUNCTION) {
            Some(&function::READ) => (Some((word(8), word(10))), None),
            Some(&function::READ_WRITE) => (Some((word(8), word(10))), Some((word(12), word(14), 17))),
            Some(&function::WRITE) => (None, Some((word(8), word(10), 13))),
            _ => return false,
        };
        if let Some((address, count, at)) = write {
            for (place, register) in self.registers[address..address + count].iter_mut().enumerate() {
                *register = word(at + 2 * place) as u16;
            }
        }
        let runs = self.registers[self.control] & ControlWord::ANY_RUN != 0;
        let state = if runs { StatusWord::ACTIVE } else { StatusWord::ZERO_SPEED };
        self.registers[self.status] = StatusWord::HEALTHY | state;
        self.registers[self.speed] = self.registers[self.speed].wrapping_add(1);
        self.reply[..=FUNCTION].copy_from_slice(&request[..=FUNCTION]);
        self.length = match (read, write) {
            (Some((address, count)), _) => {
                self.reply[8] = 2 * count as u8;
                for (place, register) in self.registers[address..address + count].iter().enumerate() {
                    self.reply[9 + 2 * place..][..2].copy_from_slice(&register.to_be_bytes());
                }
                9 + 2 * count
            }
            _ => {
                self.reply[8..12].copy_from_slice(&request[8..12]);
                12
            }
        };
        self.reply[4..6].copy_from_slice(&(self.length as u16 - 6).to_be_bytes());
        true
    }

    /// Writes the answer to the received request into `room`, and gives its length.
    pub fn answer(&self, room: &mut [u8]) -> usize {
        room[..self.length].copy_from_slice(&self.reply[..self.length]);
        self.length
    }
}

/// Two values as they stand side by side on the wire.
fn pair([first, second]: [u32; 2]) -> [u8; 8] {
    (u64::from(first) << 32 | u64::from(second)).to_be_bytes()
}
