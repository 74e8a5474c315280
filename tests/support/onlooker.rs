//! Looks at simulated drives from outside, past every master: what became of the axes when nobody is left to tell.

use std::net::{SocketAddrV4, UdpSocket};
use std::time::Duration;

use fieldbeat::bus::linudp::MainState;
use fieldbeat_linudp::MASTER_PORT;
use fieldbeat_linudp::wire::{REQUEST_MAX, Request, Response, ResponseDef};

use super::{LONG, Machine, until};

/// A socket of its own. A request without any block changes nothing of a drive.
pub struct Onlooker(UdpSocket);

/// One look at a drive.
#[derive(Clone, Copy, Debug)]
pub struct Sight {
    /// The power stage is on.
    pub powered: bool,
    /// It takes motion commands.
    pub operating: bool,
    /// Its setpoint generator is running.
    pub moving: bool,
    /// Actual position, mm.
    pub position: f64,
}

impl Onlooker {
    /// One of the network of `machine`, with host number 250. Drives answer to the port of masters only.
    pub fn new(machine: &Machine) -> Onlooker {
        let socket = UdpSocket::bind(SocketAddrV4::new(machine.ip(250), MASTER_PORT)).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(1))).unwrap();
        Onlooker(socket)
    }

    /// What the drive at `address` is doing now.
    pub fn look(&self, address: SocketAddrV4) -> Sight {
        let mut request = [0; REQUEST_MAX];
        let length = Request { response_def: ResponseDef::CYCLIC, ..Request::default() }.emit(&mut request);
        let mut sight = None;
        assert!(until(LONG, || {
            sight = self.ask(address, &request[..length]);
            sight.is_some()
        }));
        sight.unwrap()
    }

    fn ask(&self, address: SocketAddrV4, request: &[u8]) -> Option<Sight> {
        // A reply that came too late for the look before is not taken for this one.
        self.0.set_nonblocking(true).ok()?;
        while self.0.recv(&mut [0; 1]).is_ok() {}
        self.0.set_nonblocking(false).ok()?;
        self.0.send_to(request, address).ok()?;
        let mut reply = [0; 128];
        let (length, from) = self.0.recv_from(&mut reply).ok()?;
        let reply = Response::parse(&reply[..length]).ok().filter(|_| from == address.into())?;
        let (status, state) = (reply.status?, reply.state?);
        Some(Sight {
            powered: state.main() >= MainState::HW_TESTS,
            operating: status.operation_enabled(),
            moving: status.motion_active(),
            position: f64::from(reply.actual?) * 1e-4,
        })
    }

    /// Waits until the drive at `address` is as wanted.
    #[track_caller]
    pub fn await_sight(&self, address: SocketAddrV4, wanted: impl Fn(&Sight) -> bool) -> Sight {
        let mut sight = self.look(address);
        assert!(
            until(LONG, || {
                sight = self.look(address);
                wanted(&sight)
            }),
            "{address}: {sight:?}"
        );
        sight
    }
}
