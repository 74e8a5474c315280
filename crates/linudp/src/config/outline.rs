//! What a first configuration of LinMots has, and how one is probed.

use std::net::{SocketAddrV4, UdpSocket};
use std::time::Duration;

use crate::plan::{DRIVE_PORT, MASTER_PORT};
use crate::upid::Upid;
use crate::wire::{ParseError, Request, Response, ResponseDef, RtcBlock, RtcCommand, RtcStatus};
use fieldbeat_keys::outline::{
    ADDRESS, Answer, BIND, Found, Known, Line, Outline, RANGE, Search, Unit, Usual, own, probed,
};

/// A drive answers within a millisecond or two.
const PATIENCE: Duration = Duration::from_millis(300);
/// One that is the only one to be probed is asked so often: a datagram may be lost, or late.
const MOST_ASKED: usize = 3;
/// Longer than any answer.
const ROOM: usize = 1_024;

pub(super) const OUTLINE: Outline = Outline {
    period: "2ms",
    bus: &[BIND],
    drive: &[ADDRESS],
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
        question: "Probe addresses one by one? Each is sent a request without a command. A drive that \
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
    let times = if addresses.len() == 1 { MOST_ASKED } else { 1 };
    let serial_from = (known.answer)("serial_from").and_then(|from| Upid::parse(&from));
    Ok(probed(addresses, DRIVE_PORT, goes_on, |address| {
        let answer = ask(&socket, address, times);
        let from = serial_from.filter(|_| matches!(answer, Answer::Drive(_)));
        (answer, from.and_then(|from| read(&socket, address, from)))
    }))
}

/// What a parameter of a drive has. A command runs if its count is another one than that of the last.
fn read(socket: &UdpSocket, address: SocketAddrV4, from: Upid) -> Option<u32> {
    (1..=14).find_map(|count| {
        let call = RtcBlock::call(count, RtcCommand::READ_RAM, from.0, 0);
        // A drive may be busy with it for a while.
        (0..8).find_map(|_| {
            let response_def = ResponseDef::STATUS.with(ResponseDef::CONFIG);
            let request = Request { response_def, config: Some(call), ..Request::default() };
            let block = exchange(socket, address, &request)?.ok()?.config?;
            let is_done = block.status() == RtcStatus::Done && block.count() == count;
            (is_done && block.index() == from.0).then_some(block.value())
        })
    })
}

/// A request, and the reply to it.
fn exchange(
    socket: &UdpSocket,
    address: SocketAddrV4,
    request: &Request,
) -> Option<Result<Response, ParseError>> {
    let mut bytes = [0; ROOM];
    let size = request.emit(&mut bytes);
    socket.send_to(&bytes[..size], address).ok()?;
    // Another drive may answer late; it sends no more than that.
    for _ in 0..8 {
        match socket.recv_from(&mut bytes) {
            Ok((size, from)) if from == address.into() => return Some(Response::parse(&bytes[..size])),
            Ok(_) => {}
            Err(_) => return None,
        }
    }
    None
}

/// Who answers one of so many requests. They have neither a control word nor a command.
fn ask(socket: &UdpSocket, address: SocketAddrV4, times: usize) -> Answer {
    let request = Request { response_def: ResponseDef::STATUS, ..Request::default() };
    let reply = (0..times).find_map(|_| exchange(socket, address, &request));
    match reply {
        Some(Ok(Response { status: Some(_), .. })) => Answer::Drive("a LinMot"),
        _ => Answer::None,
    }
}
