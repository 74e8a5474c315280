//! What a first configuration of LinMots has, and how one is probed.

use std::net::{SocketAddrV4, UdpSocket};
use std::time::Duration;

use crate::plan::{DRIVE_PORT, MASTER_PORT};
use crate::wire::{REQUEST_MAX, Request, ResponseDef, ResponseView};
use fieldbeat_keys::outline::{
    Answer, Found, Known, Line, Outline, RANGE, Search, Unit, Usual, neighbour, own, own_address, probed,
};

/// A drive answers within a millisecond or two.
const PATIENCE: Duration = Duration::from_millis(300);
/// Longer than any answer.
const ROOM: usize = 1_024;

pub(super) const OUTLINE: Outline = Outline {
    period: "2ms",
    bus: &[Line::ask(
        "bind",
        "Address of this computer on the network of the drives",
        Usual::From(own_address),
    )],
    drive: &[Line::ask("address", "Address of the drive", Usual::From(neighbour))],
    unit: Unit { name: "mm", counts: "Drive counts in one unit", scale: "10000" },
    behind: &[
        RANGE,
        Line::ask(
            "no_drive_watchdog",
            "Jogs and velocities, although nothing stops this drive at once if the master dies (refuse or \
             accept)",
            Usual::Is("refuse"),
        ),
        Line::ask("leash", "How far it may run on then, in units", Usual::Needed)
            .only_if("no_drive_watchdog", "accept"),
    ],
    search: Search {
        question: "Probe addresses one by one? Each is sent one request without a command. A drive that \
             accepts a single master takes this computer for it until it is restarted",
        usual: false,
        probes: true,
        run: probe,
        port: DRIVE_PORT,
    },
};

/// Requests the status of each address, one after the other.
fn probe(
    known: &Known<'_>,
    addresses: &[SocketAddrV4],
    goes_on: &dyn Fn() -> bool,
) -> Result<Vec<Found>, String> {
    let own = own(known, MASTER_PORT);
    let socket = UdpSocket::bind(own).map_err(|error| {
        format!(
            "cannot send from {own}: {error}; it has to be an address of this computer, which no master uses"
        )
    })?;
    let ready = socket.set_read_timeout(Some(PATIENCE));
    ready.map_err(|error| format!("cannot receive answers: {error}"))?;
    let mut found = Vec::new();
    for address in addresses.iter().take_while(|_| goes_on()) {
        found.extend(probed(*address, DRIVE_PORT, || ask(&socket, *address)));
    }
    Ok(found)
}

/// Who answers. The request has neither a control word nor a command.
fn ask(socket: &UdpSocket, address: SocketAddrV4) -> Answer {
    let request = Request { response_def: ResponseDef::STATUS, ..Request::default() };
    let mut bytes = [0; REQUEST_MAX];
    let size = request.emit(&mut bytes);
    if socket.send_to(&bytes[..size], address).is_err() {
        return Answer::None;
    }
    let mut reply = [0; ROOM];
    // Another drive may answer late; it sends no more than that.
    for _ in 0..8 {
        match socket.recv_from(&mut reply) {
            Ok((size, from)) if from == address.into() => {
                let is_status = ResponseView::new(&reply[..size]).is_ok_and(|view| view.status().is_some());
                return if is_status { Answer::Drive("a LinMot") } else { Answer::None };
            }
            Ok(_) => {}
            Err(_) => return Answer::None,
        }
    }
    Answer::None
}
