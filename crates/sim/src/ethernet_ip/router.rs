//! The message router: which object a message is for, and its services.
//!
//! Facts: sheet, 2.3, 2.4, 5.6; what they leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | CIP Sync, Connection Configuration, Port | do not exist: nothing is known of their attributes |
//! | the outputs are written while nobody owns them | acts as a packet with this command word; while somebody does, 0x0C |
//! | Unconnected_Send, Multiple_Service_Packet, Reset | 0x08 |

use super::adapter::{Adapter, Extra, Origin};
use super::assembly;
use super::check;
use super::cip::{self, Failure, Request, Served, Target, general, refuse, service};
use super::drive::Drive;
use super::items::{any, item};
use super::open::{self, Open, Unreadable};

/// Classes.
mod class {
    pub const IDENTITY: u32 = 0x01;
    pub const ROUTER: u32 = 0x02;
    pub const ASSEMBLY: u32 = 0x04;
    pub const CONNECTIONS: u32 = 0x06;
    pub const QOS: u32 = 0x48;
    pub const VENDOR: u32 = 0x64;
    pub const TCP_IP: u32 = 0xF5;
    pub const LINK: u32 = 0xF6;
}

/// Marks of packets: urgent, scheduled, high, low, explicit.
const DSCP: [u8; 5] = [55, 47, 43, 31, 27];

/// Answers one message. Every message feeds the drive's own watchdog.
pub(super) fn message(
    adapter: &mut Adapter,
    origin: Origin,
    bytes: &[u8],
    drive: &mut Drive,
    out: &mut Vec<u8>,
    extra: &mut Extra,
) {
    drive.fed(origin.now);
    let request = match Request::parse(bytes) {
        Ok(request) => request,
        Err(service) => {
            return cip::refused(service.unwrap_or_default(), Failure::general(general::PATH_SIZE), out);
        }
    };
    let target = match Target::of(request.path) {
        Ok(target) => target,
        Err(failure) => return cip::refused(request.service, failure, out),
    };
    match (target.class, target.instance, request.service) {
        (class::CONNECTIONS, 1, service::OPEN | service::LARGE_OPEN) => {
            opened(adapter, origin, &request, drive, out, extra);
        }
        (class::CONNECTIONS, 1, service::CLOSE) => closed(adapter, origin, &request, drive, out),
        _ => cip::reply(request.service, out, |out| object(adapter, target, &request, drive, out)),
    }
}

fn object(
    adapter: &mut Adapter,
    target: Target,
    request: &Request<'_>,
    drive: &mut Drive,
    out: &mut Vec<u8>,
) -> Served {
    let exists = match (target.class, target.instance) {
        (class::ASSEMBLY, instance) => assembly_size(adapter, instance).is_some(),
        (class::LINK, 1 | 2) | (class::VENDOR, 0 | 1) => true,
        (class::IDENTITY | class::ROUTER | class::CONNECTIONS | class::QOS | class::TCP_IP, 1) => true,
        _ => false,
    };
    if !exists {
        return refuse(general::DESTINATION);
    }
    match (request.service, target.class, target.attribute) {
        (service::VENDOR, class::VENDOR, attribute) if target.instance == 1 => match attribute {
            Some(1) => drive.vendor(request.data, out),
            _ => refuse(general::ATTRIBUTE),
        },
        (service::GET_ALL, class::IDENTITY, _) => {
            identity(adapter, out);
            Ok(())
        }
        (service::GET, class::ROUTER | class::CONNECTIONS, _) => refuse(general::ATTRIBUTE),
        (service::GET, _, None) | (service::SET, class::ASSEMBLY | class::TCP_IP, None) => {
            refuse(general::ATTRIBUTE)
        }
        (service::GET, _, Some(attribute)) => get(adapter, target, attribute, drive, out),
        (service::SET, class::ASSEMBLY, Some(3)) => {
            set_assembly(adapter, target.instance, request.data, drive)
        }
        (service::SET, class::TCP_IP, Some(13)) => {
            let value = <[u8; 2]>::try_from(request.data).map(u16::from_le_bytes);
            let value = value.map_err(|_| Failure::general(length(request.data, 2)))?;
            if value > 3_600 {
                return refuse(general::VALUE);
            }
            adapter.sessions.inactivity_s = value;
            Ok(())
        }
        (service::SET, class::ASSEMBLY | class::TCP_IP, Some(attribute)) => {
            get(adapter, target, attribute, drive, &mut Vec::new())?;
            refuse(general::NOT_SETTABLE)
        }
        _ => refuse(general::SERVICE),
    }
}

/// The status for data of a wrong length.
fn length(data: &[u8], right: usize) -> u8 {
    if data.len() < right { general::NOT_ENOUGH } else { general::TOO_MUCH }
}

fn get(adapter: &Adapter, target: Target, attribute: u32, drive: &Drive, out: &mut Vec<u8>) -> Served {
    match target.class {
        class::IDENTITY => identity_attribute(adapter, attribute, out),
        class::ASSEMBLY => assembly_attribute(adapter, target.instance, attribute, drive, out),
        class::QOS => match attribute {
            1 => {
                out.push(0);
                Ok(())
            }
            4..=8 => {
                out.push(DSCP[attribute as usize - 4]);
                Ok(())
            }
            _ => refuse(general::ATTRIBUTE),
        },
        class::VENDOR if target.instance == 0 && attribute == 1 => {
            profile(adapter, out);
            Ok(())
        }
        class::TCP_IP => tcp_ip(adapter, attribute, out),
        class::LINK => {
            match attribute {
                // 100 Mbit/s; up, full duplex, negotiated.
                1 => out.extend(100_u32.to_le_bytes()),
                2 => out.extend(0x0F_u32.to_le_bytes()),
                3 => {
                    out.extend([0x02, 0x00]);
                    out.extend(adapter.ip().octets());
                }
                _ => return refuse(general::ATTRIBUTE),
            }
            Ok(())
        }
        _ => refuse(general::ATTRIBUTE),
    }
}

/// All attributes of the identity.
pub(super) fn identity(adapter: &Adapter, out: &mut Vec<u8>) {
    for attribute in 1..=7 {
        // They exist.
        let _ = identity_attribute(adapter, attribute, out);
    }
}

fn identity_attribute(adapter: &Adapter, attribute: u32, out: &mut Vec<u8>) -> Served {
    let identity = &adapter.settings.identity;
    match attribute {
        1 => out.extend(identity.vendor.to_le_bytes()),
        2 => out.extend(identity.device_type.to_le_bytes()),
        3 => out.extend(identity.product.to_le_bytes()),
        4 => out.extend([identity.revision.0, identity.revision.1]),
        // Bit 0: somebody owns it.
        5 => out.extend(u16::from(adapter.connections.is_owned()).to_le_bytes()),
        6 => out.extend(adapter.serial().to_le_bytes()),
        7 => {
            let name = &identity.name.as_bytes()[..identity.name.len().min(32)];
            out.push(name.len() as u8);
            out.extend(name);
        }
        _ => return refuse(general::ATTRIBUTE),
    }
    Ok(())
}

/// Bytes of an assembly that the drive has.
fn assembly_size(adapter: &Adapter, instance: u32) -> Option<usize> {
    let identity = &adapter.settings.identity;
    match u8::try_from(instance).ok()? {
        assembly::OUTPUT if identity.has_outputs() => Some(assembly::OUTPUT_SIZE),
        assembly::CONFIGURATION => Some(assembly::CONFIGURATION_SIZE),
        assembly::INPUT_ONLY | assembly::LISTEN_ONLY => Some(0),
        input if assembly::is_input(input, identity) => Some(assembly::input_size(input)),
        _ => None,
    }
}

fn assembly_attribute(
    adapter: &Adapter,
    instance: u32,
    attribute: u32,
    drive: &Drive,
    out: &mut Vec<u8>,
) -> Served {
    let size = assembly_size(adapter, instance).ok_or(Failure::general(general::DESTINATION))?;
    match (attribute, instance as u8) {
        (3, assembly::OUTPUT) => out.extend(adapter.outputs),
        (3, assembly::CONFIGURATION) => out.extend(adapter.configuration),
        (3, assembly::INPUT_ONLY | assembly::LISTEN_ONLY) => {}
        (3, input) => drive.report().append(input, adapter.ip(), &adapter.settings.firmware, out),
        (4, _) => out.extend((size as u16).to_le_bytes()),
        _ => return refuse(general::ATTRIBUTE),
    }
    Ok(())
}

fn set_assembly(adapter: &mut Adapter, instance: u32, data: &[u8], drive: &mut Drive) -> Served {
    let size = assembly_size(adapter, instance).ok_or(Failure::general(general::DESTINATION))?;
    match instance as u8 {
        assembly::OUTPUT | assembly::CONFIGURATION if data.len() != size => refuse(length(data, size)),
        assembly::OUTPUT if adapter.connections.is_owned() => refuse(general::CONFLICT),
        assembly::OUTPUT => {
            if let (Some(outputs), Ok(image)) = (assembly::Outputs::parse(data), data.try_into()) {
                adapter.outputs = image;
                drive.outputs(&outputs);
            }
            Ok(())
        }
        assembly::CONFIGURATION => {
            adapter.configuration.copy_from_slice(data);
            Ok(())
        }
        _ => refuse(general::NOT_SETTABLE),
    }
}

fn tcp_ip(adapter: &Adapter, attribute: u32, out: &mut Vec<u8>) -> Served {
    match attribute {
        // Configured; by its switches.
        1 => out.extend(1_u32.to_le_bytes()),
        2 | 3 => out.extend(0_u32.to_le_bytes()),
        4 => out.extend([2, 0, 0x20, 0xF6, 0x24, 0x01]),
        5 => {
            out.extend(adapter.ip().to_bits().to_le_bytes());
            out.extend(adapter.settings.network.mask.to_bits().to_le_bytes());
            out.extend([0; 14]);
        }
        6 => out.extend([0, 0]),
        13 => out.extend(adapter.sessions.inactivity_s.to_le_bytes()),
        _ => return refuse(general::ATTRIBUTE),
    }
    Ok(())
}

/// The profile code, big-endian.
fn profile(adapter: &Adapter, out: &mut Vec<u8>) {
    let identity = &adapter.settings.identity;
    out.extend(identity.board.0.to_be_bytes());
    out.extend(identity.board.1.to_be_bytes());
    out.extend([b'A', identity.model.0, identity.model.1]);
    out.extend([identity.firmware.0, identity.firmware.1, identity.letter]);
}

/// The reply to an open or a close that is refused.
fn unopened(request: &Request<'_>, (triad, failure): Unreadable, words: u8, out: &mut Vec<u8>) {
    cip::refused(request.service, failure, out);
    if let Some(triad) = triad {
        triad.append(out);
        out.extend([words, 0]);
    }
}

fn opened(
    adapter: &mut Adapter,
    origin: Origin,
    request: &Request<'_>,
    drive: &mut Drive,
    out: &mut Vec<u8>,
    extra: &mut Extra,
) {
    let open = match Open::parse(request.data, request.service == service::LARGE_OPEN) {
        Ok(open) => open,
        Err(unreadable) => return unopened(request, unreadable, 0, out),
    };
    let identity = &adapter.settings.identity;
    let admitted = check::admit(&open, origin, &adapter.connections, identity);
    let admitted = match admitted {
        Ok(admitted) => admitted,
        Err(failure) => return unopened(request, (Some(open.triad), failure), 0, out),
    };
    let done = adapter.connections.add(origin.now, origin.peer, &open, admitted, origin.port);
    if matches!(admitted.purpose, super::connections::Use::Owner(_)) {
        drive.owned();
    }
    if done.to.is_some() {
        extra.extend(adapter.connections.own_port().map(|port| (item::SOCKADDR_OUT, port)));
    }
    match done.to {
        Some(group) if group.ip().is_multicast() => extra.push((item::SOCKADDR_IN, group)),
        Some(_) => extra.extend(origin.port.map(|port| (item::SOCKADDR_IN, any(port)))),
        None => {}
    }
    out.extend([request.service | 0x80, 0, 0, 0]);
    out.extend(done.consumed.to_le_bytes());
    out.extend(done.produced.to_le_bytes());
    open.triad.append(out);
    out.extend(done.api_us.0.to_le_bytes());
    out.extend(done.api_us.1.to_le_bytes());
    out.extend([0, 0]);
}

fn closed(
    adapter: &mut Adapter,
    origin: Origin,
    request: &Request<'_>,
    drive: &mut Drive,
    out: &mut Vec<u8>,
) {
    let (triad, words) = match open::close(request.data) {
        Ok(close) => close,
        Err(unreadable) => return unopened(request, unreadable, 0, out),
    };
    let refused = |failure| ((Some(triad), failure), words);
    let checked = match adapter.connections.find(triad) {
        None => Err(refused(Failure::extended(0x0107))),
        Some(place) if adapter.connections.open[place].peer.ip() != origin.peer.ip() => {
            Err(refused(Failure::general(general::PRIVILEGE)))
        }
        Some(place) => Ok(place),
    };
    match checked {
        Err((unreadable, words)) => unopened(request, unreadable, words, out),
        Ok(place) => {
            for ended in adapter.connections.close(place) {
                adapter.ended(ended, false, drive);
            }
            out.extend([request.service | 0x80, 0, 0, 0]);
            triad.append(out);
            out.extend([0, 0]);
        }
    }
}
