//! LinUDP V2, with each kind of tag in its requests.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat::Axis;
use fieldbeat::axis::{AxisPlan, Units};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp;
use fieldbeat::bus::linudp::motion::Acceleration;
use fieldbeat::bus::linudp::motion::MotionCommand;
use fieldbeat::bus::linudp::{COUNTS_PER_MM, ControlWord, LinUdpDrive, LinUdpPlan, MainState, ReplyTag};
use fieldbeat::sim::{SimPlan, Simulated};
use fieldbeat_linudp::DRIVE_PORT;
use fieldbeat_linudp::upid;
use fieldbeat_linudp::wire::RtcBlock;
use fieldbeat_linudp::wire::{Refusal, Request, RequestDef, Response, ResponseDef, RtcCommand};
use fieldbeat_sim::linudp::{LinMotSettings, LinMots};

use crate::conformance::subject::{Calls, Can, Drive, SOON, Said, Subject};

/// With a tag each reply names its request; without it the protocol has nothing of the kind.
pub struct LinUdp {
    pub reply_tag: ReplyTag,
}

/// "Stop" of the motion command interface, 017xh.
const STOP: u16 = 0x017;
/// A curve that the drive does not have: error 0062h in state 8 (SG5 manual, 04Fx "run curve").
const NO_SUCH_CURVE: u16 = 0x040;

fn address(index: usize) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 1, 1 + index as u8), DRIVE_PORT)
}

impl Subject for LinUdp {
    fn name(&self) -> &'static str {
        match self.reply_tag {
            ReplyTag::Definition => "linudp",
            ReplyTag::Count => "linudp with counts",
            ReplyTag::Off => "linudp without a tag",
        }
    }

    fn can(&self) -> Can {
        Can {
            positions: true,
            home: true,
            jog: true,
            follow: true,
            picks: true,
            identified: self.reply_tag != ReplyTag::Off,
            round_trip: true,
            whole: true,
            ..Can::default()
        }
    }

    fn names_repeat(&self) -> bool {
        self.reply_tag == ReplyTag::Definition
    }

    fn axis(&self, name: &str) -> AxisPlan {
        AxisPlan::new(name, Units::millimetres(COUNTS_PER_MM))
    }

    fn plan(&self, drives: &[Drive]) -> Box<dyn BusPlan> {
        let drive = |(index, drive): (usize, &Drive)| {
            let mut plan = LinUdpDrive::new(&drive.axis.name, *address(index).ip());
            plan.axis = drive.axis.clone();
            // As without a tag: a later reply is late.
            (plan.reply_tag, plan.reply_within) = (self.reply_tag, Some(1));
            plan.leash = drive.jog.then_some(20.0);
            plan.stream = plan.stream.filter(|_| drive.follow);
            plan
        };
        let drives = drives.iter().enumerate().map(drive).collect();
        Box::new(LinUdpPlan::new(Ipv4Addr::new(10, 0, 0, 1), drives))
    }

    fn simulated(&self, drives: &[Drive]) -> Simulated {
        let settings = |(index, drive): (usize, &Drive)| LinMotSettings {
            start_position: (drive.start * drive.axis.units.counts_per_unit).round() as i32,
            start_running: drive.running,
            ..LinMotSettings::new(address(index))
        };
        SimPlan::from(LinMots(drives.iter().enumerate().map(settings).collect())).build()
    }

    fn native(&self, axis: &mut Axis) -> Box<dyn FnMut(u16)> {
        let mut native = axis.native::<linudp::Native>().expect("it was not taken");
        Box::new(move |number| {
            let config = RtcBlock { tag: 0, code: 0, words: [number; 3] };
            let motion =
                number.is_multiple_of(3).then(|| MotionCommand::vai_stop(Acceleration(number.into())));
            let _ = native.write(linudp::NativeOutput { control: None, motion, config: Some(config) });
        })
    }

    fn said(&self, _before: Option<Said>, _request: &[u8], reply: &[u8]) -> Option<Said> {
        let response = Response::parse(reply).ok()?;
        let (status, state) = (response.status?, response.state?);
        Some(Said {
            powered: state.main() >= MainState::HW_TESTS,
            moving: state.motion_active().unwrap_or(status.motion_active()),
            homed: Some(status.homed()),
            position: Some(response.actual?.into()),
            demand: Some(response.demand?.into()),
            ..Said::default()
        })
    }

    fn calls(&self) -> Calls {
        Calls {
            // The predefined velocity, of commands that are not used here.
            read: upid::call(RtcCommand::READ_RAM, 0x14BE, 0),
            write: upid::call(RtcCommand::WRITE_RAM, 0x14BE, 77),
            refused: (upid::call(RtcCommand::READ_RAM, 0xFFFF, 0), Refusal::NoSuchUpid.code().into()),
            soon: SOON,
        }
    }

    fn requests_stop(&self, _before: &[Vec<u8>], request: &[u8]) -> bool {
        let Ok(request) = Request::parse(request) else { return false };
        let aborts = |word: ControlWord| word.has(ControlWord::SWITCH_ON) && !word.has(ControlWord::NO_ABORT);
        request.motion.is_some_and(|motion| motion.header >> 4 == STOP) || request.control.is_some_and(aborts)
    }

    fn fault(&self, reply: &[u8]) -> Option<Vec<u8>> {
        let count = Response::parse(reply).ok()?.state?.count()?;
        let motion = MotionCommand::new(NO_SUCH_CURVE).block(count.wrapping_add(1) & 0xF);
        let request =
            Request { response_def: ResponseDef::CYCLIC, motion: Some(motion), ..Request::default() };
        let mut bytes = vec![0; request.size()];
        request.emit(&mut bytes);
        Some(bytes)
    }

    fn malformed(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        // Shorter than any telegram, than its own definition, and longer than any.
        let whole = Response::parse(reply).map_or(0, |reply| reply.response_def.size(RequestDef::NONE));
        let mut cases: Vec<Vec<u8>> = [0, 1, 7, 8, whole - 1].map(|length| reply[..length].to_vec()).into();
        cases.extend([vec![0; 129], vec![0; 1_400]]);
        cases
    }

    fn foreign(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        // Echoes of definitions that were never sent: a reserved bit of each.
        [3, 7].map(|byte| [&reply[..byte], &[reply[byte] ^ 0x80], &reply[byte + 1..]].concat()).into()
    }
}
