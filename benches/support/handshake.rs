//! Connections to simulated Unidrives, with the master's own handshake, for loops that are not ours.

use std::cell::RefCell;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddrV4, TcpStream};

use fieldbeat::bus::BusPlan;
use fieldbeat::bus::modbus::ModbusPlan;
use fieldbeat::time::S;
use fieldbeat_core::net::{Carriers, Datagrams, HandshakeState, StreamPeer, Streams, UdpOptions};
use fieldbeat_core::rt::MonotonicClock;
use fieldbeat_modbus::wire::ADU_MAX;

/// A connection to each drive of `plan`, with the master's own handshake: the drive is set up as ours is.
pub fn connect(plan: &ModbusPlan) -> io::Result<Vec<TcpStream>> {
    let peers = Peers::default();
    // It opens nothing: the peers are what was wanted.
    let _ = plan.open(S, &peers);
    peers.0.into_inner().into_iter().map(shake_hands).collect()
}

fn shake_hands(mut peer: StreamPeer) -> io::Result<TcpStream> {
    let mut stream = TcpStream::connect(peer.address)?;
    stream.set_nodelay(true)?;
    let (mut out, mut bytes) = (Vec::new(), [0; 2 * ADU_MAX]);
    let mut said = peer.handshake.begin(MonotonicClock::read(), &mut out);
    loop {
        stream.write_all(&out)?;
        out.clear();
        match said {
            HandshakeState::Done | HandshakeState::Kept => return Ok(stream),
            HandshakeState::Failed(why) => return Err(io::Error::other(why)),
            HandshakeState::More => {}
        }
        let count = stream.read(&mut bytes)?;
        if count == 0 {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        said = peer.handshake.take(MonotonicClock::read(), &bytes[..count], &mut out);
    }
}

/// Opens nothing, and keeps what was to be opened.
#[derive(Default)]
struct Peers(RefCell<Vec<StreamPeer>>);

impl Carriers for Peers {
    fn datagrams(&self, _: SocketAddrV4, _: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Err(ErrorKind::Unsupported.into())
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        self.0.replace(peers);
        Err(ErrorKind::Unsupported.into())
    }
}
