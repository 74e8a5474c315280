//! EtherNet/IP to MOONS' drives: class 1 packets by the clocks of both sides, on connections that sessions of the link
//! thread keep open.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat::Axis;
use fieldbeat::axis::{AxisPlan, Profile, Unit, Units};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethernet_ip;
use fieldbeat::bus::ethernet_ip::{
    EthernetIpPlan, Homing, HomingMethod, Inputs, Layout, MoonsDrive, Originator, Version, command, status,
};
use fieldbeat::sim::{SimDrive, Simulated};
use fieldbeat_ethernet_ip::PORT;
use fieldbeat_ethernet_ip::wire::io::Packet;
use fieldbeat_sim::ethernet_ip::{MoonsSettings, MoonsSim};

use crate::between::{Between, Message, Shared};
use crate::conformance::line::{GRID, PERIOD};
use crate::conformance::subject::{Calls, Can, Drive, SOON, Said, Subject};

/// MOONS' drives.
pub struct EthernetIp {
    /// Their packets come to a group, at the interval of ours. Else to this master only, in each cycle.
    pub multicast: bool,
}

/// Handed to a drive in place of a packet, it has the fault "open motor winding": nothing on the wire brings one about.
const FAULT: &[u8] = b"open winding";
const OPEN_WINDING: u16 = 0x0100;
/// Where a packet has its connection, its sequence number, its count and the command word.
const CONNECTION: usize = 6;
const SEQUENCE: usize = 10;
const COUNT: usize = 18;
const COMMAND: usize = 24;

fn address(index: usize) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 4, 2 + index as u8), PORT)
}

/// The command word of a packet to a drive.
fn word(request: &[u8]) -> u32 {
    let bytes = request.get(COMMAND..COMMAND + 4).and_then(|bytes| bytes.try_into().ok());
    bytes.map_or(0, u32::from_le_bytes)
}

impl EthernetIp {
    fn drive(&self, (index, drive): (usize, &Drive)) -> MoonsDrive {
        let mut plan = MoonsDrive::new(&drive.axis.name, *address(index).ip());
        plan.axis = drive.axis.clone();
        plan.steps_per_revolution = MoonsDrive::STEPS_PER_REVOLUTION;
        plan.jog = drive.jog;
        plan.input_rpi_ns = (!self.multicast).then_some(PERIOD);
        plan.homing = Some(Homing {
            method: HomingMethod::Seek,
            input: 0x4CB2,
            velocity: 2.0,
            acceleration: 50.0,
            distance: -2.0,
        });
        plan
    }
}

impl Subject for EthernetIp {
    fn name(&self) -> &'static str {
        if self.multicast { "ethernet-ip to groups" } else { "ethernet-ip" }
    }

    fn can(&self) -> Can {
        Can {
            positions: true,
            home: true,
            jog: true,
            picks: true,
            identified: true,
            whole: true,
            own_clock: true,
            sessions: true,
            steep_stops: true,
            ..Can::default()
        }
    }

    fn axis(&self, name: &str) -> AxisPlan {
        let units = Units {
            unit: Unit::Revolution,
            counts_per_unit: MoonsDrive::STEPS_PER_REVOLUTION,
            offset: 0.0,
            modulo: None,
        };
        let mut axis = AxisPlan::new(name, units);
        axis.profile = Profile { velocity: 5.0, acceleration: 50.0, deceleration: 50.0 };
        axis.stop.deceleration = 50.0;
        axis.jog_deadman = None;
        axis
    }

    fn plan(&self, drives: &[Drive]) -> Box<dyn BusPlan> {
        let bind = Ipv4Addr::new(10, 0, 4, 1);
        let mut plan =
            EthernetIpPlan::new(bind, drives.iter().enumerate().map(|one| self.drive(one)).collect());
        plan.originator = Originator::at(bind);
        if self.multicast {
            plan.drives
                .iter_mut()
                .for_each(|drive| drive.delivery = fieldbeat::bus::ethernet_ip::Delivery::Multicast);
        }
        Box::new(plan)
    }

    fn simulated(&self, drives: &[Drive]) -> Simulated {
        let simulated = |(index, drive): (usize, &Drive)| {
            let mut settings = MoonsSettings::of(&self.drive((index, drive)));
            settings.motor.start = (drive.start * drive.axis.units.counts_per_unit).round() as i32;
            // A motion of another master, steps/s.
            settings.running = drive.running.then_some(10_000.0);
            // What befalls a clause's drive is the clause's; its watchdog has its own tests.
            settings.firmware.zs_ms = 0;
            Box::new(Shared::new(Faulty(MoonsSim::new(settings)))) as Box<dyn SimDrive>
        };
        drives.iter().enumerate().map(simulated).collect::<Vec<_>>().into()
    }

    fn native(&self, axis: &mut Axis) -> Box<dyn FnMut(u16)> {
        let mut native = axis.native::<ethernet_ip::Native>().expect("it was not taken");
        Box::new(move |number| {
            if let Some(output) = ethernet_ip::NativeOutput::host("SO", 0, number.into()) {
                let _ = native.write(output);
            }
        })
    }

    fn said(&self, _before: Option<Said>, _request: &[u8], reply: &[u8]) -> Option<Said> {
        let packet = Packet::parse(reply).ok()?;
        let inputs = Inputs::parse(packet.data, Version::V2, Layout::Manual)?;
        let has = |bits: u16| inputs.status & bits != 0;
        let position = Some(inputs.absolute.into());
        Some(Said {
            powered: has(status::ENABLED),
            moving: has(status::MOVING | status::JOGGING | status::STOPPING | status::HOMING),
            // A drive does not tell.
            homed: None,
            position,
            demand: position,
            setpoint: None,
            at: None,
            velocity: None,
        })
    }

    fn calls(&self) -> Calls {
        let notation = self.plan(&[]).facts(GRID).notation;
        let call = |call: Result<_, _>| call.unwrap_or_else(|_| unreachable!("the notation has it"));
        Calls {
            // How near counts as in position: of step-servos.
            read: call(notation.read("PD")),
            write: call(notation.write("PD", 77)),
            // The identity has no such attribute.
            refused: (call(notation.read("0x01/1/77")), 0x14),
            soon: SOON,
        }
    }

    fn requests_stop(&self, _before: &[Vec<u8>], request: &[u8]) -> bool {
        word(request) & (command::STOP | command::STOP_FAST | command::DISABLE) != 0
    }

    fn fault(&self, _reply: &[u8]) -> Option<Vec<u8>> {
        Some(FAULT.into())
    }

    fn malformed(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        // Other items, too short, too long, a length that lies.
        let other = |at: usize| [&reply[..at], &[reply[at] ^ 1], &reply[at + 1..]].concat();
        vec![
            Vec::new(),
            reply[..17].to_vec(),
            reply[..reply.len() - 1].to_vec(),
            [reply, &[0]].concat(),
            other(0),
            other(2),
            other(14),
            other(16),
            vec![0; 300],
        ]
    }

    fn later(&self, packet: &[u8], by: u8) -> Option<Vec<u8>> {
        let Packet { sequence, count, .. } = Packet::parse(packet).ok()?;
        let mut packet = packet.to_vec();
        packet[SEQUENCE..SEQUENCE + 4].copy_from_slice(&sequence.wrapping_add(by.into()).to_le_bytes());
        packet[COUNT..COUNT + 2].copy_from_slice(&count.wrapping_add(by.into()).to_le_bytes());
        Some(packet)
    }

    fn foreign(&self, reply: &[u8]) -> Vec<Vec<u8>> {
        // Of a connection that is another one's, or was.
        [0, 3]
            .map(|byte| {
                let at = CONNECTION + byte;
                [&reply[..at], &[reply[at] ^ 0x40], &reply[at + 1..]].concat()
            })
            .into()
    }
}

/// A drive whose hardware can be given a fault.
struct Faulty(MoonsSim);

impl Between for Faulty {
    fn drive(&mut self) -> &mut dyn SimDrive {
        &mut self.0
    }

    fn receive(&mut self, message: Message<'_>, reply: &mut Vec<u8>) -> Option<SocketAddrV4> {
        if message.bytes == FAULT {
            self.0.provoke(OPEN_WINDING);
            return None;
        }
        message.reaches(&mut self.0, reply)
    }
}
