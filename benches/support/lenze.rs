//! A Lenze drive as the benches have it, and a PROFIBUS wire whose drives are a few bytes in memory.

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::time::Duration;

use fieldbeat::axis::Limits;
use fieldbeat::bus::profibus::{LenzeDrive, ProfibusPlan};
use fieldbeat::time::{S, Time};
use fieldbeat_core::net::{Broken, Carriers, Datagrams, LinkNotes, Serial, SerialLine, Streams, UdpOptions};
use fieldbeat_core::rt::Regions;
use fieldbeat_profibus::wire::sap::Service;
use fieldbeat_profibus::wire::telegram::MAX;

use super::rig::{self, Scene};

/// Drives of a wire at the highest rate that are due in every cycle of 1 ms.
pub const A_WIRE: usize = 4;
/// The most drives of a segment without a repeater, next to the master.
pub const SEGMENT: usize = 31;
/// Each of so many is due in every cycle of so many: about [`A_WIRE`] in each.
pub const SEGMENT_EVERY: u32 = 8;
const RATE: u32 = 12_000_000;
/// The address of the first drive.
const FIRST: usize = 3;

/// A wire of so many drives, each in every cycle, or a segment of all that it can have, in turn. A miss is counted, it
/// does not end the measurement.
pub fn plan(port: &str, first: usize, count: usize) -> ProfibusPlan {
    let drive = |index: usize| {
        let mut drive = LenzeDrive::new(format!("l{}", first + index), (FIRST + index) as u8);
        drive.axis.limits = Limits { velocity: Some(20.0), ..Limits::default() };
        drive.axis.health.bucket = rig::bucket();
        drive.axis.stop.group = rig::group();
        drive.axis.enable_timeout = Duration::from_secs(60);
        // The longest: a machine that stands still for a while stops no drive.
        drive.watchdog.timeout_ns = Some(10 * S);
        drive
    };
    let mut plan = ProfibusPlan::new(port, RATE, (0..count).map(drive).collect());
    plan.name = port.to_owned();
    if count > A_WIRE { plan.in_turn(SEGMENT_EVERY) } else { plan }
}

/// So many drives on as many wires as they need; or on one, if they are a whole segment.
pub fn wires(prefix: &str, count: usize) -> Vec<ProfibusPlan> {
    if count == SEGMENT {
        return vec![plan(prefix, 0, count)];
    }
    let wire = |first| plan(&format!("{prefix}-{first}"), first, A_WIRE.min(count - first));
    (0..count).step_by(A_WIRE).map(wire).collect()
}

/// Data_Exchange to each drive of `plan`, enabled and at rest.
pub fn requests(plan: &ProfibusPlan) -> Vec<Vec<u8>> {
    let request = |drive: &LenzeDrive| {
        let (outputs, _) = drive.lengths()?;
        let mut data = vec![0; outputs];
        data[drive.process_at()..][..2].copy_from_slice(&[0x00, 0x7F]);
        let mut room = [0; MAX];
        let head = Service::DataExchange.head(drive.address, plan.address, true, true);
        let length = head.emit(&data, &mut room)?;
        Some(room[..length].to_vec())
    };
    plan.drives.iter().map(|drive| request(drive).expect("a drive with process data")).collect()
}

/// Start and end of telegrams, the bare acknowledgement.
const SD2: u8 = 0x68;
const ED: u8 = 0x16;
const SC: u8 = 0xE5;
/// In a request: station, function code, and its service where the address says so.
const DA: usize = 4;
const SA: usize = 5;
const DSAP: usize = 7;
const HAS_SAP: u8 = 0x80;
const SLAVE_DIAG: u8 = 60;
const SET_PRM: u8 = 61;
const CHK_CFG: u8 = 62;
/// Data of a slave, low priority.
const DATA_LOW: u8 = 8;
/// Control word and set point in a request, status word and actual value in an answer of 12 bytes.
const CONTROL: usize = 7 + 8;
const STATUS: usize = 7 + 8;
const ANSWER: usize = 9 + 12;

/// The status word (DRIVECOM) of a fault, and its bit of a set point that is reached.
const FAULT: u16 = 0x0218;
const REACHED: u16 = 0x0400;

/// One drive that answers from memory.
#[derive(Clone, Copy, Debug)]
struct Drive {
    answer: [u8; ANSWER],
    /// It is parametrised and configured.
    exchanges: bool,
}

/// A wire whose drives answer at once.
pub struct NullSerial {
    now: fn() -> Time,
    opened: bool,
    /// By address.
    drives: Vec<Option<Drive>>,
    reply: [u8; 32],
    /// Bytes of it that wait to be taken.
    length: usize,
    count: u8,
}

impl NullSerial {
    /// The wire of `plan`, by this clock.
    pub fn new(plan: &ProfibusPlan, now: fn() -> Time) -> NullSerial {
        let mut drives = vec![None; 127];
        for drive in &plan.drives {
            let mut answer = [0; ANSWER];
            answer[..7].copy_from_slice(&[SD2, 15, 15, SD2, plan.address, drive.address, DATA_LOW]);
            answer[ANSWER - 1] = ED;
            drives[usize::from(drive.address)] = Some(Drive { answer, exchanges: false });
        }
        rig::serial_opened();
        NullSerial { now, opened: false, drives, reply: [0; 32], length: 0, count: 0 }
    }

    /// The answer to a request, without a wire in between.
    pub fn answer(&mut self, request: &[u8], room: &mut [u8]) -> usize {
        self.hear(request);
        let length = std::mem::take(&mut self.length);
        room[..length].copy_from_slice(&self.reply[..length]);
        length
    }

    /// The answer to a request, if there is one.
    fn hear(&mut self, request: &[u8]) {
        let [SD2, _, _, SD2, da, ..] = *request else { return };
        let Some(Some(drive)) = self.drives.get_mut(usize::from(da & !HAS_SAP)) else { return };
        if da & HAS_SAP == 0 {
            self.count = self.count.wrapping_add(1);
            drive.exchange(request, self.count);
            self.reply[..ANSWER].copy_from_slice(&drive.answer);
            self.length = ANSWER;
            return;
        }
        let master = request[SA] & !HAS_SAP;
        match request[DSAP] {
            SLAVE_DIAG => {
                // Parameters are missing; or its watchdog is on, and it is this master's.
                let status = if drive.exchanges { [0, 0x0C, 0, master] } else { [2, 5, 0, 0xFF] };
                let [ident_high, ident_low] = LenzeDrive::IDENT.to_be_bytes();
                let front = [SD2, 11, 11, SD2, master | HAS_SAP, da, DATA_LOW, 62, SLAVE_DIAG];
                self.reply[..9].copy_from_slice(&front);
                self.reply[9..13].copy_from_slice(&status);
                self.reply[13..15].copy_from_slice(&[ident_high, ident_low]);
                self.reply[15] = self.reply[DA..15].iter().fold(0, |sum: u8, byte| sum.wrapping_add(*byte));
                self.reply[16] = ED;
                self.length = 17;
            }
            SET_PRM => (self.reply[0], self.length) = (SC, 1),
            CHK_CFG => {
                drive.exchanges = true;
                (self.reply[0], self.length) = (SC, 1);
            }
            _ => {}
        }
    }
}

impl Drive {
    /// It is enabled, and turns as commanded, a little faster in each exchange.
    fn exchange(&mut self, request: &[u8], count: u8) {
        let Some([high, low, set_high, set_low]) =
            request.get(CONTROL..CONTROL + 4).map(|words| [words[0], words[1], words[2], words[3]])
        else {
            return;
        };
        let control = u16::from_be_bytes([high, low]);
        let status: u16 = match control & 0xF {
            0x6 => 0x0231,
            0x7 => 0x0233,
            0xF => 0x0237,
            _ => 0x0250,
        };
        let status = match () {
            () if rig::is_scene(Scene::Faulted) => FAULT,
            () if rig::is_scene(Scene::Unsteady) && count & 1 == 1 => status ^ REACHED,
            () => status,
        };
        let set_point = i16::from_be_bytes([set_high, set_low]);
        let actual = set_point + i16::from(count & 3);
        self.answer[STATUS..STATUS + 2].copy_from_slice(&status.to_be_bytes());
        self.answer[STATUS + 2..STATUS + 4].copy_from_slice(&actual.to_be_bytes());
        let checked = &self.answer[DA..ANSWER - 2];
        self.answer[ANSWER - 2] = checked.iter().fold(0, |sum: u8, byte| sum.wrapping_add(*byte));
    }
}

impl Drop for NullSerial {
    fn drop(&mut self) {
        rig::serial_closed(self.length > 0);
    }
}

impl Streams for NullSerial {
    /// None while an answer waits: a wait finds it at once. Otherwise one that is never readable: nothing waits for it
    /// in virtual time.
    fn fd(&self) -> Option<RawFd> {
        (self.length == 0).then_some(RawFd::MAX)
    }

    fn opened(&mut self) -> Option<usize> {
        (!std::mem::replace(&mut self.opened, true)).then_some(0)
    }

    fn look(&mut self) {}

    fn ready(&mut self) -> Option<usize> {
        None
    }

    fn receive(&mut self, _: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let length = std::mem::take(&mut self.length);
        if length == 0 {
            return Ok(None);
        }
        rig::reply_waits(false);
        room[..length].copy_from_slice(&self.reply[..length]);
        Ok(Some(((self.now)(), length)))
    }

    fn send(&mut self, _: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        if self.length > 0 {
            if rig::is_virtual() {
                rig::give_up("it sends while an answer waits");
            }
            // The host was away for longer than a slot time.
            self.discard()?;
        }
        if !rig::is_scene(Scene::Silent) {
            self.hear(bytes);
        }
        if self.length > 0 {
            rig::reply_waits(true);
        }
        Ok(((self.now)(), bytes.len()))
    }

    fn abandon(&mut self, _: usize, why: &'static str) {
        rig::give_up(format!("a wire in memory was given up: {why}"));
    }

    fn notes(&self) -> LinkNotes {
        LinkNotes::new(1)
    }

    fn memory(&self, _: &mut Regions) {}
}

impl Serial for NullSerial {
    fn unsent(&mut self) -> Result<usize, Broken> {
        Ok(0)
    }

    fn discard(&mut self) -> Result<(), Broken> {
        if std::mem::take(&mut self.length) > 0 {
            rig::reply_waits(false);
        }
        Ok(())
    }
}

/// Opens the wires of these plans in memory, by this clock; it has nothing else.
pub struct NullWires(pub Vec<ProfibusPlan>, pub fn() -> Time);

impl Carriers for NullWires {
    fn datagrams(&self, _: SocketAddrV4, _: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Err(io::ErrorKind::Unsupported.into())
    }

    fn serial(&self, port: &str, _: &SerialLine) -> io::Result<Box<dyn Serial>> {
        let plan = self.0.iter().find(|plan| plan.device == port).ok_or(io::ErrorKind::NotFound)?;
        Ok(Box::new(NullSerial::new(plan, self.1)))
    }
}
