//! Modbus TCP to Unidrives: each exchange writes and reads everything through menu 0 and is answered in its window, or
//! it does a part of it where the parameters are, and is answered some cycles later.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat::Axis;
use fieldbeat::axis::{AxisPlan, Profile, Unit, Units};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::modbus;
use fieldbeat::bus::modbus::{
    Addressing, ControlWord, ModbusPlan, Parameter, StatusWord, UnidriveDrive, Via, Watchdog, Width,
};
use fieldbeat::sim::{SimPlan, Simulated};
use fieldbeat::time::US;
use fieldbeat_modbus::PORT;
use fieldbeat_modbus::notation::{Service, Target};
use fieldbeat_modbus::wire;
use fieldbeat_modbus::wire::{ExceptionCode, Header, Registers, Request, Response};
use fieldbeat_sim::modbus::{Start, UnidriveSettings, Unidrives};

use crate::conformance::subject::{Calls, Can, Drive, NoMessage, SOON, Said, Subject};

/// One of the two ways to the cyclic parameters.
pub struct Modbus {
    pub direct: bool,
}

/// What menu 0 shows from its first place on, as set up by default.
const SHOWN: [Parameter; 6] = [
    Parameter::CONTROL_WORD,
    Parameter::REFERENCE,
    Parameter::STATUS_WORD,
    Parameter::SPEED,
    Parameter::TRIP,
    Parameter::LOAD,
];
/// Written to Pr 10.038 it is a trip of this number.
const USER_TRIP: (Parameter, u16) = (Parameter::new(10, 38), 40);

fn address(index: usize) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 2, 1 + index as u8), PORT)
}

/// The parameters of a block, each with its number.
fn values(address: u16, data: Registers<'_>) -> Vec<(Parameter, i32)> {
    let Some((first, width)) = Parameter::from_address(address, Addressing::Standard) else {
        return Vec::new();
    };
    let shown = |parameter: Parameter| match parameter.menu {
        0 => SHOWN.get(usize::from(parameter.number) - 1).copied(),
        _ => Some(parameter),
    };
    let value = |place: usize| {
        let number = match width {
            Width::Word => i32::from(data.word(place)? as i16),
            Width::Long => data.long(place)?,
        };
        Some((shown(first.offset(place as u8)?)?, number))
    };
    (0..data.len() / usize::from(width.registers())).filter_map(value).collect()
}

/// What a request writes.
fn written(request: &[u8]) -> Vec<(Parameter, i32)> {
    match Request::parse(request) {
        Ok((_, Request::Write { address, data } | Request::ReadWrite { write: address, data, .. })) => {
            values(address, data)
        }
        _ => Vec::new(),
    }
}

fn reference(request: &[u8]) -> Option<i32> {
    written(request).iter().find(|(parameter, _)| *parameter == Parameter::REFERENCE).map(|(_, value)| *value)
}

impl Subject for Modbus {
    fn name(&self) -> &'static str {
        if self.direct { "modbus-tcp, direct" } else { "modbus-tcp through menu 0" }
    }

    fn can(&self) -> Can {
        Can {
            jog: true,
            identified: true,
            round_trip: true,
            answers_after: if self.direct { 2 } else { 0 },
            whole: !self.direct,
            awaits: true,
            stream: true,
            ..Can::default()
        }
    }

    fn axis(&self, name: &str) -> AxisPlan {
        let units = Units { unit: Unit::Revolution, counts_per_unit: 1.0, offset: 0.0, modulo: None };
        let mut axis = AxisPlan::new(name, units);
        axis.profile = Profile { velocity: 8.0, acceleration: 80.0, deceleration: 80.0 };
        axis.stop.deceleration = 80.0;
        axis.jog_deadman = None;
        axis
    }

    fn plan(&self, drives: &[Drive]) -> Box<dyn BusPlan> {
        let drive = |(index, drive): (usize, &Drive)| {
            let mut plan = UnidriveDrive::new(&drive.axis.name, *address(index).ip());
            plan.axis = drive.axis.clone();
            plan.via = if self.direct { Via::Direct } else { Via::Menu0 { first: 1 } };
            plan.reply_within_ns = if self.direct { 2_500 * US } else { 500 * US };
            // What befalls a clause's drive is the clause's; its watchdogs have their own tests.
            plan.watchdog = Watchdog { timeout_ns: None, keypad: false, accept_none: true };
            plan
        };
        Box::new(ModbusPlan::new(drives.iter().enumerate().map(drive).collect()))
    }

    fn simulated(&self, drives: &[Drive]) -> Simulated {
        let settings = |(index, drive): (usize, &Drive)| UnidriveSettings {
            ramps_s: (0.01, 0.01),
            start: if drive.running { Start::Running(240.0) } else { Start::Idle },
            // One of them was commissioned to follow the control word, which it keeps when it restarts.
            commissioned: if self.direct { vec![([6, 43], 1)] } else { Vec::new() },
            ..UnidriveSettings::new(address(index))
        };
        SimPlan::from(Unidrives(drives.iter().enumerate().map(settings).collect())).build()
    }

    fn native(&self, axis: &mut Axis) -> Box<dyn FnMut(u16)> {
        let mut native = axis.native::<modbus::Native>().expect("it was not taken");
        Box::new(move |number| {
            let reference = i32::from(number % 100);
            let _ = native.write(modbus::NativeOutput { control: modbus::ControlWord::IDLE, reference });
        })
    }

    fn said(&self, before: Option<Said>, request: &[u8], reply: &[u8]) -> Option<Said> {
        let (_, request) = Request::parse(request).ok()?;
        let (_, response) = Response::parse(reply).ok()?;
        let (address, data) = match (request, response) {
            (Request::Read { address, .. }, Response::Read { data })
            | (Request::ReadWrite { read: address, .. }, Response::ReadWritten { data }) => (address, data),
            _ => return None,
        };
        let mut said = before;
        for (parameter, value) in values(address, data) {
            match parameter {
                Parameter::STATUS_WORD => {
                    let status = StatusWord(value as u16);
                    said = Some(Said {
                        powered: status.active(),
                        moving: status.active() && !status.zero_speed(),
                        homed: Some(false),
                        velocity: said.and_then(|said| said.velocity),
                        ..Said::default()
                    });
                }
                Parameter::SPEED => {
                    said = said.map(|said| Said { velocity: Some(f64::from(value) / 600.0), ..said });
                }
                _ => {}
            }
        }
        said
    }

    fn message(&self, bytes: &[u8]) -> Result<Option<usize>, NoMessage> {
        wire::frame(bytes).map_err(|_| NoMessage)
    }

    fn calls(&self) -> Calls {
        // The upper limit of "at speed": a bit of the status word.
        let free = Target { parameter: Parameter::new(3, 7), width: Width::Word };
        let missing = Target { parameter: Parameter::new(99, 99), width: Width::Word };
        Calls {
            read: Service::Read(free).into(),
            write: Service::Write(free, 77).into(),
            refused: (Service::Read(missing).into(), ExceptionCode::ADDRESS.0.into()),
            soon: SOON,
        }
    }

    fn requests_stop(&self, before: &[Vec<u8>], request: &[u8]) -> bool {
        let runs = |value: i32| ControlWord(value as u16).has_any(ControlWord::ANY_RUN);
        let ends = written(request)
            .iter()
            .any(|(parameter, value)| *parameter == Parameter::CONTROL_WORD && !runs(*value));
        let last = before.iter().rev().find_map(|request| reference(request));
        ends || last.zip(reference(request)).is_some_and(|(last, now)| now < last)
    }

    fn fault(&self, _reply: &[u8]) -> Option<Vec<u8>> {
        let (parameter, value) = USER_TRIP;
        let address = parameter.address(Addressing::Standard, Width::Word)?;
        let request = Request::WriteOne { address, value };
        let mut bytes = vec![0; request.size()];
        request.emit(Header { transaction: 1, unit: 255 }, &mut bytes);
        Some(bytes)
    }

    fn malformed(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        // With a function that no request has, a count of bytes that lies, and a message that ends too soon.
        let short = [&reply[..5], &[4], &reply[6..10]].concat();
        let lying = [&reply[..8], &[reply[8] ^ 2], &reply[9..]].concat();
        vec![[&reply[..5], &[3, reply[6], 7, 0]].concat(), lying, short]
    }

    fn foreign(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        // A transaction that was not begun.
        vec![[&[reply[0] ^ 0x40], &reply[1..]].concat()]
    }
}
