//! What a carrier on sockets takes by itself, counted: the other rows are of carriers in memory. The peers are in the
//! same thread and return what they receive.

use std::hint::black_box;
use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::time::Duration;

use fieldbeat::Time;
use fieldbeat_core::net::{Carriers, Handshake, HandshakeState, Os, Outbox, StreamPeer, UdpOptions};
use fieldbeat_modbus as modbus;

use crate::support::callgrind::counted;
use crate::support::count::{self, Ran};
use crate::support::rig;

/// Bytes of each telegram: only the kernel copies them.
const LENGTH: usize = 48;

/// The child: `cycles` cycles of the carrier that a bus of this protocol has, with so many peers.
pub fn of(protocol: &str, drives: usize, cycles: u64) -> Ran {
    let ran = if protocol == modbus::PROTOCOL { streams(drives, cycles) } else { datagrams(drives, cycles) };
    ran.unwrap_or_else(|error| rig::give_up(error))
}

fn address(local: SocketAddr) -> SocketAddrV4 {
    SocketAddrV4::new(Ipv4Addr::LOCALHOST, local.port())
}

fn datagrams(drives: usize, cycles: u64) -> io::Result<Ran> {
    let bind = |_| UdpSocket::bind((Ipv4Addr::LOCALHOST, 0));
    let peers: Vec<_> = (0..drives).map(bind).collect::<Result<_, _>>()?;
    let addresses: Vec<_> =
        peers.iter().map(|peer| peer.local_addr().map(address)).collect::<Result<_, _>>()?;
    let options = UdpOptions { peers: drives, waiting: 1, room: LENGTH, dscp: 0, groups: 0 };
    let mut carrier = Os::default().datagrams(SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0), &options)?;
    let mut outbox = Outbox::new(&addresses, LENGTH);
    (0..drives).for_each(|index| outbox.set_length(index, LENGTH));
    let mut bytes = [0; LENGTH];
    let mut turn = || {
        (0..drives).for_each(|index| outbox.post(index, true));
        counted(|| carrier.send(&mut outbox));
        for peer in &peers {
            let returned =
                peer.recv_from(&mut bytes).and_then(|(count, from)| peer.send_to(&bytes[..count], from));
            returned.unwrap_or_else(|error| rig::give_up(error));
        }
        let mut came = 0;
        counted(|| {
            while let Ok(count) = carrier.receive(&mut |datagram| _ = black_box(datagram)) {
                came += count;
                if count < carrier.batch() {
                    break;
                }
            }
        });
        assert_eq!(came, drives, "each datagram is returned");
    };
    turn();
    count::instrument();
    Ok(count::run(cycles, turn))
}

/// Nothing is said before the loop has the connection.
#[derive(Debug)]
struct Silent;

impl Handshake for Silent {
    fn begin(&mut self, _: Time, _: &mut Vec<u8>) -> HandshakeState {
        HandshakeState::Done
    }

    fn take(&mut self, _: Time, _: &[u8], _: &mut Vec<u8>) -> HandshakeState {
        HandshakeState::Done
    }
}

fn streams(drives: usize, cycles: u64) -> io::Result<Ran> {
    let listen = |_| TcpListener::bind((Ipv4Addr::LOCALHOST, 0));
    let listeners: Vec<_> = (0..drives).map(listen).collect::<Result<_, _>>()?;
    let peer =
        |listener: &TcpListener| Ok(StreamPeer::new(address(listener.local_addr()?), Box::new(Silent)));
    let mut carrier = Os::default().streams(listeners.iter().map(peer).collect::<io::Result<_>>()?)?;
    let accept = |listener: &TcpListener| {
        let (stream, _) = listener.accept()?;
        stream.set_nodelay(true)?;
        Ok(stream)
    };
    let mut peers: Vec<TcpStream> = listeners.iter().map(accept).collect::<io::Result<_>>()?;
    let mut open = 0;
    while open < drives {
        std::thread::sleep(Duration::from_millis(1));
        while carrier.opened().is_some() {
            open += 1;
        }
    }
    let (request, mut room) = ([0; LENGTH], [0; 2 * LENGTH]);
    let mut turn = || {
        counted(|| {
            carrier.look();
            for index in 0..drives {
                _ = black_box(carrier.send(index, &request));
            }
        });
        for peer in &mut peers {
            let mut bytes = [0; LENGTH];
            let returned = peer.read_exact(&mut bytes).and_then(|()| peer.write_all(&bytes));
            returned.unwrap_or_else(|error| rig::give_up(error));
        }
        let mut came = 0;
        while came < drives {
            counted(|| {
                carrier.look();
                while let Some(index) = carrier.ready() {
                    came += usize::from(matches!(carrier.receive(index, &mut room), Ok(Some((_, LENGTH)))));
                }
            });
        }
    };
    turn();
    count::instrument();
    Ok(count::run(cycles, turn))
}
