//! PROFIBUS DP to Lenze drives: one request at a time on a wire of bytes, each answered at once.

use std::any::Any;

use fieldbeat::Axis;
use fieldbeat::axis::{AxisPlan, Profile, Unit, Units};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::profibus;
use fieldbeat::bus::profibus::{DriveProfile, LenzeDrive, Numbers, ParameterPath, ProfibusPlan, Watchdog};
use fieldbeat::sim::{SimPlan, SimSerial, Simulated};
use fieldbeat::time::MS;
use fieldbeat_profibus::wire::sap;
use fieldbeat_profibus::wire::telegram::{Frame, Head, Next, Telegram};
use fieldbeat_profibus::wire::words::{DrivecomStatus, ProfidriveStatus};
use fieldbeat_sim::profibus::{LenzeSim, ProfibusSegment};

use crate::conformance::line::{GRID, LATENCY};
use crate::conformance::subject::{Calls, Can, Drive, NoMessage, SOON, Said, Subject};

/// Lenze drives on one wire.
pub struct Profibus {
    /// Control word, status word and states of PROFIdrive, parameters by DB47 of MSAC1. Else those of DRIVECOM, and its
    /// channel.
    pub profidrive: bool,
}

/// Three of the exchanges here fit into a window, and four do not.
const RATE: u32 = 3_000_000;
const PORT: &str = "/dev/ttyS1";
/// The address of the first drive.
const FIRST: u8 = 3;
/// Where the process data have control word or status word, and set point or actual value.
const WORD: usize = 8;
const VALUE: usize = 10;
const FAULT: u16 = 0x2310;

fn frame(bytes: &[u8]) -> Option<Frame<'_>> {
    match Next::parse(bytes) {
        Next::Telegram { telegram: Telegram::Data(frame), .. } => Some(frame),
        _ => None,
    }
}

fn word(data: &[u8], at: usize) -> Option<u16> {
    data.get(at..at + 2)?.try_into().ok().map(u16::from_be_bytes)
}

/// A telegram with another head.
fn with_head(bytes: &[u8], change: impl FnOnce(&mut Head)) -> Vec<u8> {
    let frame = frame(bytes).expect("it is a telegram with a head");
    let mut head = frame.head;
    change(&mut head);
    let mut room = [0; 255];
    let length = head.emit(frame.data, &mut room).expect("it fits");
    room[..length].to_vec()
}

impl Profibus {
    fn bus(&self, drives: &[Drive]) -> ProfibusPlan {
        let drive = |(index, drive): (usize, &Drive)| {
            let mut plan = LenzeDrive::new(&drive.axis.name, FIRST + index as u8);
            plan.axis = drive.axis.clone();
            if self.profidrive {
                plan.profile = DriveProfile::Profidrive;
                plan.enable_bit = plan.profile.usual_enable_bit();
                plan.parameters =
                    ParameterPath::Msac1 { slot: 0, index: 47, axis: 0, numbers: Numbers::FromTop };
            }
            plan.scale.full_rpm = 6_000.0;
            // What befalls a clause's drive is the clause's; its watchdog has its own tests.
            plan.watchdog = Watchdog { timeout_ns: None, accept_none: true };
            plan
        };
        let mut plan = ProfibusPlan::new(PORT, RATE, drives.iter().enumerate().map(drive).collect());
        // A request is a telegram, and nothing is sent between them; repetitions have their own tests.
        (plan.retries, plan.token, plan.gap) = (0, false, None);
        plan.global_control_ns = 1_000 * MS;
        plan
    }
}

impl Subject for Profibus {
    fn name(&self) -> &'static str {
        if self.profidrive { "profibus-dp with PROFIdrive" } else { "profibus-dp with DRIVECOM" }
    }

    fn can(&self) -> Can {
        Can {
            jog: true,
            identified: true,
            round_trip: true,
            answers_after: 1,
            whole: true,
            awaits: true,
            half_duplex: true,
            bytes: true,
            comes_up_off: true,
            ..Can::default()
        }
    }

    fn axis(&self, name: &str) -> AxisPlan {
        let units = Units { unit: Unit::Revolution, counts_per_unit: 1.0, offset: 0.0, modulo: None };
        let mut axis = AxisPlan::new(name, units);
        axis.profile = Profile { velocity: 8.0, acceleration: 80.0, deceleration: 80.0 };
        axis.stop.deceleration = 80.0;
        axis.limits.velocity = Some(50.0);
        axis.jog_deadman = None;
        axis
    }

    fn plan(&self, drives: &[Drive]) -> Box<dyn BusPlan> {
        Box::new(self.bus(drives))
    }

    fn simulated(&self, drives: &[Drive]) -> Simulated {
        let mut segment = ProfibusSegment::of(&self.bus(drives));
        for (settings, drive) in segment.drives.iter_mut().zip(drives) {
            settings.motor.ramps_s = (0.01, 0.01, 0.01);
            settings.boot_ns = 2 * MS;
            settings.running = drive.running.then_some(240.0);
        }
        SimPlan::from(segment).build()
    }

    fn native(&self, axis: &mut Axis) -> Box<dyn FnMut(u16)> {
        let mut native = axis.native::<profibus::Native>().expect("it was not taken");
        Box::new(move |number| {
            let mut output = profibus::NativeOutput { mask: 1 << (number % 4), ..Default::default() };
            output.words[1..].fill(number % 16);
            let _ = native.write(output);
        })
    }

    fn said(&self, before: Option<Said>, request: &[u8], reply: &[u8]) -> Option<Said> {
        let reply = frame(reply).filter(|frame| frame.head.dsap.is_none())?;
        let (status, actual) = (word(reply.data, WORD)?, word(reply.data, VALUE)? as i16);
        let state = match self.profidrive {
            true => ProfidriveStatus(status).state(),
            false => DrivecomStatus(status).state(),
        };
        let powered = state.is_powered();
        let turned = frame(request).and_then(|frame| word(frame.data, VALUE)).is_some_and(|count| count != 0);
        Some(Said {
            powered,
            // From 1/256 of its full speed on.
            moving: powered && (turned || actual.unsigned_abs() >= 0x40),
            homed: before.and_then(|before| before.homed).or(Some(false)),
            // 0x4000 is 6000 rpm.
            velocity: Some(f64::from(actual) / f64::from(0x4000) * 100.0),
            ..Said::default()
        })
    }

    fn message(&self, bytes: &[u8]) -> Result<Option<usize>, NoMessage> {
        match Next::parse(bytes) {
            Next::Incomplete { .. } => Ok(None),
            Next::Telegram { size, .. } => Ok(Some(size)),
            Next::Malformed { .. } => Err(NoMessage),
        }
    }

    fn calls(&self) -> Calls {
        let notation = self.plan(&[]).facts(GRID).notation;
        let call = |call: Result<_, _>| call.unwrap_or_else(|_| unreachable!("the notation has it"));
        Calls {
            read: call(notation.read("C0012")),
            write: call(notation.write("C0012", 5_000)),
            refused: (call(notation.read("C1999")), if self.profidrive { 0 } else { 0x0607_0000 }),
            soon: SOON,
        }
    }

    fn requested(&self, telegram: &[u8]) -> Option<usize> {
        let da = frame(telegram)?.head.da;
        (FIRST..FIRST + 32).contains(&da).then(|| usize::from(da - FIRST))
    }

    fn is_exchange(&self, telegram: &[u8], open: bool) -> bool {
        let dsap = frame(telegram).and_then(|frame| frame.head.dsap);
        match dsap {
            None => true,
            Some(dsap) => open && matches!(dsap, sap::SLAVE_DIAG | sap::MSAC1),
        }
    }

    fn opens(&self, telegram: &[u8], open: bool) -> bool {
        let dsap = frame(telegram).and_then(|frame| frame.head.dsap);
        match dsap {
            None => true,
            Some(sap::SET_PRM | sap::CHK_CFG) => false,
            Some(_) => open,
        }
    }

    fn answer_ns(&self) -> u64 {
        // Two telegrams of 21 bytes, and 11 bits of min Tsdr.
        let bits = 2 * 21 * 11 + 11;
        (bits * 1_000_000_000_u64).div_ceil(RATE.into()) - 2 * LATENCY
    }

    fn requests_stop(&self, before: &[Vec<u8>], request: &[u8]) -> bool {
        let of = |bytes: &[u8]| {
            let data = frame(bytes).filter(|frame| frame.head.dsap.is_none())?.data;
            Some((word(data, WORD)?, i32::from(word(data, VALUE)? as i16)))
        };
        let Some((control, value)) = of(request) else { return false };
        let last = before.iter().rev().find_map(|request| of(request));
        control & 0x7F != 0x7F || last.is_some_and(|(_, last)| value.abs() < last.abs())
    }

    fn fault(&self, _reply: &[u8]) -> Option<Vec<u8>> {
        Some(FAULT.to_be_bytes().into())
    }

    fn provoke_slave(&self, drive: &mut dyn SimSerial) {
        let drive: &mut dyn Any = drive;
        if let Some(drive) = drive.downcast_mut::<LenzeSim>() {
            drive.provoke(FAULT);
        }
    }

    fn malformed(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        let other = |at: usize| [&reply[..at], &[reply[at] ^ 1], &reply[at + 1..]].concat();
        let last = reply.len() - 1;
        // A start, a length, the second start, data, the check byte, the end.
        [0, 1, 3, 10, last - 1, last].map(other).into()
    }

    fn foreign(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        vec![
            with_head(reply, |head| head.sa ^= 0x40),
            with_head(reply, |head| (head.dsap, head.ssap) = (Some(62), Some(60))),
        ]
    }
}
