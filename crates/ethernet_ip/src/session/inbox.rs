//! What arrives at a session. A message counts if it answers the request under way: by its session, its sender context
//! or its connection and sequence number, and its service. Everything else is counted and dropped.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::requests::{STATUS, read_register};
use super::{Connected, Io, Joined, Life, Open, Phase, RequestKind, Session, Way, words};
use crate::exchange::{Connection, News, Outputs};
use crate::plan::{Access, Delivery, IO_PORT, Version};
use crate::target;
use crate::wire::assembly::status;
use crate::wire::cip::{Reply, Status, service};
use crate::wire::connection::{self, ConnectionError, Opened, timeout_factor};
use crate::wire::encapsulation::{self, Frame, Identity, Unconnected, command};
use crate::wire::message::{self, answer};
use fieldbeat_core::axis::acyclic::CallError;
use fieldbeat_core::time::Time;

impl Session {
    /// Takes in what arrived, split anywhere; `Err`: the connection cannot be used any more.
    pub(super) fn receive(&mut self, now: Time, bytes: &[u8], out: &mut Vec<u8>) -> Result<(), String> {
        let mut inbox = std::mem::take(&mut self.inbox);
        inbox.extend_from_slice(bytes);
        let mut used = 0;
        let result = loop {
            match Frame::next(inbox.get(used..).unwrap_or_default()) {
                Err(error) => break Err(error.to_string()),
                Ok(None) => break Ok(()),
                Ok(Some((frame, size))) => {
                    used += size;
                    if let Err(why) = self.frame(now, &frame, out) {
                        break Err(why);
                    }
                }
            }
        };
        inbox.drain(..used.min(inbox.len()));
        self.inbox = inbox;
        result
    }

    fn frame(&mut self, now: Time, frame: &Frame<'_>, out: &mut Vec<u8>) -> Result<(), String> {
        let header = frame.header;
        match header.command {
            // Nothing is meant by it.
            command::NOP => return Ok(()),
            command::REGISTER_SESSION
                if self.is_due(header.context, |what| what == RequestKind::Register) =>
            {
                return self.registered(now, frame, out);
            }
            command::SEND_RR_DATA
                if header.session == self.handle
                    && self.is_due(header.context, |what| what != RequestKind::Register) =>
            {
                if header.status != encapsulation::Status::OK {
                    return self.refused_by_encapsulation(header.status);
                }
                if let Some(unconnected) = Unconnected::parse(frame.data) {
                    return self.message(now, unconnected, out);
                }
            }
            command::SEND_UNIT_DATA
                if header.session == self.handle && header.status == encapsulation::Status::OK =>
            {
                if let Some(connected) = encapsulation::Connected::parse(frame.data)
                    && self.is_due_on(connected.connection, connected.sequence)
                {
                    let message = connected.message;
                    return self.message(now, Unconnected { message, outgoing: None, incoming: None }, out);
                }
            }
            _ => {}
        }
        self.unmatched += 1;
        Ok(())
    }

    /// Whether the request under way has this context, and is such a one.
    fn is_due(&self, received: u64, is_such: impl FnOnce(RequestKind) -> bool) -> bool {
        self.pending.as_ref().is_some_and(|pending| {
            matches!(pending.way, Way::Unconnected { context } if context == received)
                && is_such(pending.what)
        })
    }

    /// The same of a connection and a sequence number.
    fn is_due_on(&self, connection: u32, received: u16) -> bool {
        let Connected::Open { incoming, .. } = self.connected else { return false };
        incoming == connection
            && self.pending.as_ref().is_some_and(
                |pending| matches!(pending.way, Way::Connected { sequence, .. } if sequence == received),
            )
    }

    fn registered(&mut self, now: Time, frame: &Frame<'_>, out: &mut Vec<u8>) -> Result<(), String> {
        self.pending = None;
        let header = frame.header;
        if header.status != encapsulation::Status::OK || header.session == 0 {
            return Err(format!("the drive refuses to register a session: {}", header.status));
        }
        self.handle = header.session;
        self.ask(now, out, RequestKind::Identity);
        Ok(())
    }

    /// The encapsulation of the drive refused the request under way.
    fn refused_by_encapsulation(&mut self, status: encapsulation::Status) -> Result<(), String> {
        let what = self.pending.as_ref().map(|pending| pending.what);
        if status == encapsulation::Status::NO_SESSION || what != Some(RequestKind::Call) {
            return Err(format!("the drive refuses a message: {status}"));
        }
        self.pending = None;
        self.calls.over(&self.end, Err(CallError::Refused(target::encapsulation_refusal(status))));
        Ok(())
    }

    /// A message that is addressed as the answer to the request under way.
    fn message(&mut self, now: Time, come: Unconnected<'_>, out: &mut Vec<u8>) -> Result<(), String> {
        let fitting = Reply::parse(come.message)
            .filter(|reply| self.pending.as_ref().is_some_and(|pending| self.fits(pending.what, reply)));
        let Some((reply, pending)) = fitting.and_then(|reply| Some((reply, self.pending.take()?))) else {
            self.unmatched += 1;
            return Ok(());
        };
        if pending.what != RequestKind::Call {
            self.calls.settle(&self.end);
        }
        match pending.what {
            RequestKind::Register | RequestKind::Probe => {}
            RequestKind::Identity => self.identified(now, &reply, out)?,
            RequestKind::Profile => self.profiled(&reply)?,
            RequestKind::Homed(register) => {
                let value = answer(&read_register(register), reply.data).filter(|_| reply.status.is_ok());
                self.facts(value.map(|value| value != 0));
            }
            RequestKind::Open(open, outputs, version) => match Opened::parse(&reply, open.triad) {
                // The triad was compared above.
                Ok(opened) => self.opened(now, open, (outputs, version), &opened, &come),
                Err(ConnectionError::Refused(status)) => self.opening_refused(now, &status),
                Err(why) => {
                    self.close_later(open);
                    self.pause(now, 0, |pause_ns| words::unusable(&why, pause_ns));
                }
            },
            RequestKind::OpenConnected(open) => match Opened::parse(&reply, open.triad) {
                Ok(Opened { outgoing_id: outgoing, incoming_id: incoming, .. }) => {
                    self.connected =
                        Connected::Open { outgoing, incoming, opened: open, sequence: 0, used: now };
                }
                Err(ConnectionError::Refused(status)) => {
                    self.calls.end(Err(CallError::Refused(target::refusal(status))));
                }
                Err(_) => {
                    self.close_later(open);
                    self.calls.end(Err(CallError::Refused(target::BROKEN)));
                }
            },
            // Closed, or not there: nothing is left of it.
            RequestKind::Close => self.end_close(),
            RequestKind::Power => self.calls.power(match answer(&STATUS, reply.data) {
                _ if !reply.status.is_ok() => Err(target::refusal(reply.status)),
                Some(word) => Ok(word & u32::from(status::ENABLED) != 0),
                None => Err(target::BROKEN),
            }),
            RequestKind::Call => self.calls.answer(&self.end, &reply),
        }
        Ok(())
    }

    /// Whether this can be the answer.
    fn fits(&self, what: RequestKind, reply: &Reply<'_>) -> bool {
        let opens = |open: Open| Opened::parse(reply, open.triad) != Err(ConnectionError::Other);
        match what {
            RequestKind::Register => false,
            RequestKind::Identity => reply.service == service::GET_ATTRIBUTES_ALL,
            RequestKind::Profile | RequestKind::Probe => reply.service == service::GET_ATTRIBUTE_SINGLE,
            RequestKind::Homed(_) | RequestKind::Power => reply.service == service::VENDOR,
            RequestKind::Open(open, ..) | RequestKind::OpenConnected(open) => opens(open),
            RequestKind::Close => self.to_close.front().is_some_and(|open| {
                let closed = connection::closed(reply, open.triad);
                closed != Err(ConnectionError::Other)
            }),
            RequestKind::Call => self.calls.fits(reply),
        }
    }

    fn identified(&mut self, now: Time, reply: &Reply<'_>, out: &mut Vec<u8>) -> Result<(), String> {
        let identity = Identity::parse(reply.data).filter(|_| reply.status.is_ok());
        if let Some(identity) = &identity {
            self.device = format!("{} of vendor {}", identity.name, identity.vendor);
        }
        let expected = &self.drive.expected;
        let another = match identity {
            Some(identity) => words::another(&self.device, &identity, expected),
            // Vendor and product it compares itself, by the key.
            None => expected.serial.map(words::no_serial),
        };
        if let Some(why) = another.filter(|_| self.life == Life::Serving) {
            return Err(why);
        }
        // For the orderly end it does not matter what the drive is.
        if self.drive.version.is_some() || self.life != Life::Serving {
            self.phase = Phase::Up;
        } else {
            self.ask(now, out, RequestKind::Profile);
        }
        Ok(())
    }

    fn profiled(&mut self, reply: &Reply<'_>) -> Result<(), String> {
        let version = match message::version(reply.data) {
            _ if !reply.status.is_ok() => Err(reply.status.to_string()),
            found => found.ok_or("its profile code is too short".to_owned()),
        };
        self.version = Some(version.map_err(|why| words::no_profile(&self.device, &why))?);
        self.phase = Phase::Up;
        Ok(())
    }

    /// The class 1 connection is open.
    fn opened(
        &mut self,
        now: Time,
        open: Open,
        (outputs, version): (Outputs, Version),
        opened: &Opened,
        come: &Unconnected<'_>,
    ) {
        let (api_ns, counts_ns) =
            (u64::from(opened.incoming_api_us) * 1_000, self.drive.fresh_within_ns(self.period_ns));
        if api_ns > counts_ns {
            // Its packets would be too old before the next one comes, and the stop that `check` states too late.
            self.close_later(open);
            return self.pause(now, 0, |pause_ns| words::too_slow(api_ns, counts_ns, pause_ns));
        }
        let group = match self.join(come.incoming) {
            Ok(group) => group,
            Err(why) => {
                self.close_later(open);
                return self.pause(now, 0, |_| words::no_group(&why));
            }
        };
        self.form.accepted();
        self.pause_ns = super::LEAST_PAUSE_NS;
        // 0 is no generation.
        self.generation = self.generation.checked_add(1).unwrap_or(1);
        let connection = Connection {
            generation: self.generation,
            outgoing: opened.outgoing_id,
            incoming: opened.incoming_id,
            destination: self.destination(come.outgoing),
            source: *self.drive.address.ip(),
            outgoing_api_ns: u64::from(opened.outgoing_api_us) * 1_000,
            incoming_api_ns: api_ns,
            timeout_ns: api_ns * u64::from(timeout_factor(self.drive.multiplier(self.period_ns))),
            outputs,
            version,
            layout: self.drive.layout,
        };
        self.io = Io::Open { generation: self.generation, opened: open, _group: group };
        self.note(None);
        // A configured version is refused or described by `check`.
        let is_unconfigured = self.access(version) != self.drive.connection && self.drive.version.is_none();
        self.remarks.set(0, is_unconfigured.then(|| words::INPUT_ONLY.to_owned()));
        self.tell(News::Opened(connection));
    }

    /// Joins the group of the drive's packets, if they come to one.
    fn join(&self, group: Option<SocketAddrV4>) -> Result<Option<Joined>, String> {
        if self.drive.delivery == Delivery::PointToPoint {
            return Ok(None);
        }
        let group = group.ok_or("the drive does not say which one it is")?;
        let groups = self.groups.as_ref().ok_or("the bus has no room for groups")?;
        // The port is always that of class 1 packets.
        let group = SocketAddrV4::new(*group.ip(), if group.port() == 0 { IO_PORT } else { group.port() });
        groups.join(group).map_err(|error| error.to_string())?;
        Ok(Some(Joined { groups: std::sync::Arc::clone(groups), group }))
    }

    /// Where our packets go: the drive may name a port, and an address that is not 0.0.0.0.
    fn destination(&self, named: Option<SocketAddrV4>) -> SocketAddrV4 {
        let drive = *self.drive.address.ip();
        let (ip, port) = named.map_or((Ipv4Addr::UNSPECIFIED, 0), |named| (*named.ip(), named.port()));
        SocketAddrV4::new(
            if ip.is_unspecified() { drive } else { ip },
            if port == 0 { IO_PORT } else { port },
        )
    }

    fn opening_refused(&mut self, now: Time, status: &Status) {
        let access = self.access(self.version.unwrap_or(Version::V2));
        if self.form.refused(access, status) {
            self.io = Io::Closed { from: now };
            return;
        }
        // Whoever was the owner has timed out by then, if it is gone.
        let is_owned = status.failure() == Some(Status::OWNED) && access == Access::Owner;
        let least_ns = if is_owned { self.drive.timeout_ns(self.period_ns) } else { 0 };
        self.pause(now, least_ns, |pause_ns| words::refused(status, pause_ns));
    }
}
