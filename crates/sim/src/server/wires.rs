//! A serial wire behind a real port: a local one of this host, to which a master connects, or a port of the operating
//! system at the other end of the master's cable.

use std::fs::File;
use std::io::{self, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::Mutex;

use nix::sys::epoll::{Epoll, EpollEvent, EpollFlags};

use super::sockets::{LISTENER, SharedBus, not_now};
use super::{BusStats, lock};
use crate::SerialWire;
use crate::fault::Way;
use crate::serial::Medium;
use fieldbeat_core::net::link::local_address;
use fieldbeat_core::net::{local, tty};
use fieldbeat_core::rt::MonotonicClock;
use fieldbeat_core::time::Time;

/// A wire and its port.
pub(super) struct Wire {
    medium: Medium,
    port: Port,
}

enum Port {
    /// One master at a time connects.
    Local { listener: UnixListener, master: Option<UnixStream> },
    /// The other end of its cable.
    Cable(File),
}

impl Wire {
    pub(super) fn open(mut wire: SerialWire) -> io::Result<Wire> {
        let port = match (local::name(&wire.port), &wire.own_port) {
            (Some(name), _) => listen(name)?,
            (None, Some(own)) => {
                let port = Port::Cable(File::from(tty::open(own, &wire.line)?));
                // Bytes take their time on the cable already.
                wire.line.rate = u32::MAX;
                port
            }
            (None, None) => {
                let message = format!(
                    "cannot simulate the wire at {}: name the port at the other end of its cable, \
                     simulate.port, or use one like {}wire",
                    wire.port,
                    local::PREFIX
                );
                return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
            }
        };
        wire.drives.iter_mut().for_each(|drive| drive.untimed());
        Ok(Wire { medium: Medium::new(wire), port })
    }
}

impl SharedBus for Wire {
    fn stats(&self) -> BusStats {
        BusStats::new(&self.medium.wire.port)
    }

    fn watch(&self, epoll: &Epoll, token: u64) -> nix::Result<()> {
        let event = EpollEvent::new(EpollFlags::EPOLLIN, token);
        match &self.port {
            Port::Local { listener, .. } => epoll.add(listener, event),
            Port::Cable(port) => epoll.add(port, event),
        }
    }

    fn next_due(&self) -> Option<Time> {
        self.medium.next_due()
    }

    /// A master connects, or something can be read.
    fn ready(&mut self, number: u32, room: &mut [u8], epoll: &Epoll, token: u64, stats: &Mutex<BusStats>) {
        let port: &mut dyn Read = match &mut self.port {
            Port::Local { listener, master } if number == LISTENER => {
                let Ok((stream, _)) = listener.accept() else { return };
                // A second master is refused: its connection is closed.
                let watched = master.is_none()
                    && stream.set_nonblocking(true).is_ok()
                    && epoll.add(&stream, EpollEvent::new(EpollFlags::EPOLLIN, token)).is_ok();
                if watched {
                    *master = Some(stream);
                }
                return;
            }
            Port::Local { master: None, .. } => return,
            Port::Local { master: Some(stream), .. } => stream,
            Port::Cable(port) => port,
        };
        let read = port.read(room);
        if !matches!(&read, Ok(1..)) && !read.as_ref().is_err_and(not_now) {
            match &mut self.port {
                Port::Local { master, .. } => *master = None,
                // It is gone: level-triggered, it would be reported for ever.
                Port::Cable(port) => drop(epoll.delete(&*port)),
            }
        }
        if let Ok(count @ 1..) = read {
            self.medium.write(MonotonicClock::read(), &room[..count]);
            lock(stats).received += 1;
        }
    }

    fn run_due(&mut self, stats: &Mutex<BusStats>) {
        if self.medium.next_due().is_none() {
            return;
        }
        let (now, mut answered) = (MonotonicClock::read(), 0);
        while self.medium.step(now, &mut |_, way, _| answered += u64::from(way == Way::Reply)) {}
        let (mut room, mut unsent) = ([0; 512], 0);
        // Whole telegrams, as a port's driver has them after a pause: whenever this thread gets a processor.
        while let count @ 1.. = self.medium.read_ended(&mut room) {
            let sent = match &mut self.port {
                Port::Local { master: Some(stream), .. } => stream.write(&room[..count]),
                Port::Local { master: None, .. } => Ok(0),
                Port::Cable(port) => port.write(&room[..count]),
            };
            unsent += u64::from(sent.unwrap_or(0) < count);
        }
        let mut stats = lock(stats);
        (stats.answered, stats.unsent) = (stats.answered + answered, stats.unsent + unsent);
        stats.injected = self.medium.injected();
    }
}

fn listen(name: &str) -> io::Result<Port> {
    let listener = UnixListener::bind_addr(&local_address(name)?).map_err(|error| match error.kind() {
        io::ErrorKind::AddrInUse => {
            let message = format!(
                "{}{name} is taken: another simulation serves it; end it, or give the wire another name",
                local::PREFIX
            );
            io::Error::new(error.kind(), message)
        }
        _ => error,
    })?;
    listener.set_nonblocking(true)?;
    Ok(Port::Local { listener, master: None })
}

#[cfg(test)]
mod tests;
