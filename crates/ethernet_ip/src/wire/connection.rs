//! Opening and closing of connections, at the connection manager (CIP, volume 1, 3-5.5).

use thiserror::Error;

use super::assembly::{self, Version};
use super::cip::{self, Configuration, Key, Reply, Segment, Status, class, service};
use super::{Reader, io};

/// The path of the connection manager.
const MANAGER: [Segment<'static>; 2] = [Segment::Class(class::CONNECTION_MANAGER), Segment::Instance(1)];
/// How long a router on the way may try: 14 ticks of 2^10 ms. A drive ignores it.
const PATIENCE: [u8; 2] = [0x0A, 0x0E];
/// The largest connection of a Forward_Open that is not large, bytes.
const SMALL_MAX: u16 = 0x1FF;

/// After so many intervals without a packet a connection has timed out. `code`: 0 ... 7, a higher one counts as 7.
pub const fn timeout_factor(code: u8) -> u32 {
    4 << if code < 7 { code } else { 7 }
}

/// How packets go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Route {
    /// To a group.
    Multicast = 1,
    /// To one.
    PointToPoint,
}

/// How urgent packets are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Priority {
    /// Explicit messages.
    Low = 0,
    /// Process data.
    Scheduled = 2,
}

/// The network connection parameters of one direction, and its interval.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Direction {
    /// The requested packet interval, µs.
    pub rpi_us: u32,
    /// Everything from the CIP sequence count on, bytes.
    pub size: u16,
    /// `size` is the most: a packet may be shorter.
    pub variable: bool,
    /// How urgent they are.
    pub priority: Priority,
    /// How they go.
    pub route: Route,
    /// Several originators own the outputs together.
    pub redundant_owner: bool,
}

impl Direction {
    /// Process data of a fixed size.
    pub fn cyclic(rpi_us: u32, size: u16, route: Route) -> Direction {
        Direction {
            rpi_us,
            size,
            variable: false,
            priority: Priority::Scheduled,
            route,
            redundant_owner: false,
        }
    }

    /// Explicit messages up to this size.
    pub fn explicit(rpi_us: u32, size: u16) -> Direction {
        let (priority, route) = (Priority::Low, Route::PointToPoint);
        Direction { rpi_us, size, variable: true, priority, route, redundant_owner: false }
    }

    /// The upper 7 bits of the parameters.
    fn flags(&self) -> u8 {
        u8::from(self.redundant_owner) << 7
            | (self.route as u8) << 5
            | (self.priority as u8) << 2
            | u8::from(self.variable) << 1
    }

    fn emit(&self, out: &mut Vec<u8>, large: bool) {
        out.extend(self.rpi_us.to_le_bytes());
        let flags = self.flags();
        if large {
            out.extend((u32::from(flags) << 24 | u32::from(self.size)).to_le_bytes());
        } else {
            out.extend((u16::from(flags) << 8 | self.size & SMALL_MAX).to_le_bytes());
        }
    }
}

/// What tells a connection from every other one, on any network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Triad {
    /// Another one for each opening.
    pub serial: u16,
    /// The vendor of the originator.
    pub vendor: u16,
    /// The serial number of the originator.
    pub originator: u32,
}

impl Triad {
    fn emit(&self, out: &mut Vec<u8>) {
        out.extend(self.serial.to_le_bytes());
        out.extend(self.vendor.to_le_bytes());
        out.extend(self.originator.to_le_bytes());
    }

    fn read(reader: &mut Reader<'_>) -> Option<Triad> {
        Some(Triad { serial: reader.word_le()?, vendor: reader.word_le()?, originator: reader.long_le()? })
    }
}

/// What a connection may do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Access {
    /// It owns the outputs.
    #[default]
    Owner,
    /// It only reads, and is alone in that.
    InputOnly,
    /// It reads what another connection has requested.
    ListenOnly,
}

/// What a connection is to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target<'a> {
    /// Process data: class 1, cyclic.
    Assemblies {
        /// The point of what the originator sends.
        output: u16,
        /// The point of what the target sends.
        input: u16,
        /// Data for the configuration assembly.
        configuration: Configuration<'a>,
    },
    /// Explicit messages: class 3, server.
    Messages,
}

impl<'a> Target<'a> {
    /// The assemblies of a drive. A unit of the first version has no outputs to own: `access` must not be the owner.
    pub fn assemblies(access: Access, version: Version, configuration: Configuration<'a>) -> Target<'a> {
        let output = match access {
            Access::Owner => assembly::OUTPUT,
            Access::InputOnly => assembly::INPUT_ONLY,
            Access::ListenOnly => assembly::LISTEN_ONLY,
        };
        Target::Assemblies { output, input: assembly::input(version), configuration }
    }

    /// The class of the transport, its trigger and its direction.
    fn transport(&self) -> u8 {
        match self {
            Target::Assemblies { .. } => 0x01,
            Target::Messages => 0xA3,
        }
    }

    /// Appends the words of the path, `between` and the path.
    fn path(&self, out: &mut Vec<u8>, between: &[u8], key: Option<Key>) {
        let mut path = [Segment::Data(Configuration::NONE); 6];
        if let Some(key) = key {
            path[0] = Segment::Key(key);
        }
        match *self {
            Target::Assemblies { output, input, configuration } => {
                path[1] = Segment::Class(class::ASSEMBLY);
                path[2] = Segment::Instance(assembly::CONFIGURATION);
                path[3] = Segment::Point(output);
                path[4] = Segment::Point(input);
                path[5] = Segment::Data(configuration);
            }
            Target::Messages => {
                path[1] = Segment::Class(class::MESSAGE_ROUTER);
                path[2] = Segment::Instance(1);
            }
        }
        cip::sized_path(out, between, &path);
    }
}

/// The connection size of the drive's packets.
pub const fn incoming_size(version: Version) -> u16 {
    (io::COUNT + assembly::input_size(version)) as u16
}

/// Opens a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ForwardOpen<'a> {
    /// The id that our packets are to have; the drive chooses it: 0.
    pub outgoing_id: u32,
    /// The id that the drive's packets are to have, unless it sends to a group.
    pub incoming_id: u32,
    /// Whose connection it is.
    pub triad: Triad,
    /// See [`timeout_factor`].
    pub multiplier: u8,
    /// Our packets.
    pub outgoing: Direction,
    /// The drive's packets.
    pub incoming: Direction,
    /// Which device has to be there.
    pub key: Option<Key>,
    /// What it is to.
    pub target: Target<'a>,
    /// In the large form, which a connection of more than 511 bytes always has.
    pub large: bool,
}

impl ForwardOpen<'_> {
    /// Appends the request.
    pub fn emit(&self, out: &mut Vec<u8>) {
        let large = self.large || self.outgoing.size.max(self.incoming.size) > SMALL_MAX;
        let service = if large { service::LARGE_FORWARD_OPEN } else { service::FORWARD_OPEN };
        cip::request(out, service, &MANAGER, &PATIENCE);
        out.extend(self.outgoing_id.to_le_bytes());
        out.extend(self.incoming_id.to_le_bytes());
        self.triad.emit(out);
        out.extend([self.multiplier, 0, 0, 0]);
        self.outgoing.emit(out, large);
        self.incoming.emit(out, large);
        out.push(self.target.transport());
        self.target.path(out, &[], self.key);
    }
}

/// Appends the request to close a connection. Drives look at the triad only.
pub fn forward_close(out: &mut Vec<u8>, triad: Triad, target: &Target<'_>) {
    cip::request(out, service::FORWARD_CLOSE, &MANAGER, &PATIENCE);
    triad.emit(out);
    let target = match *target {
        // The data was for the opening.
        Target::Assemblies { output, input, .. } => {
            Target::Assemblies { output, input, configuration: Configuration::NONE }
        }
        Target::Messages => Target::Messages,
    };
    target.path(out, &[0], None);
}

/// Why a connection is not open, or not closed.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum ConnectionError {
    /// The drive refused.
    #[error("{0}")]
    Refused(Status),
    /// The answer is to another request.
    #[error("the answer belongs to another connection")]
    Other,
    /// The answer is too short.
    #[error("the answer is incomplete")]
    Short,
    /// No packet could ever be due.
    #[error("the drive answered an interval of 0")]
    Interval,
}
fieldbeat_core::debug_as_display!(ConnectionError);

/// A connection that is open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Opened {
    /// The id of our packets.
    pub outgoing_id: u32,
    /// The id of the drive's packets.
    pub incoming_id: u32,
    /// Our packets have to come at this interval, µs; not 0.
    pub outgoing_api_us: u32,
    /// The drive's packets come at this interval, µs; not 0.
    pub incoming_api_us: u32,
}

impl Opened {
    /// What the drive answered to the opening of the connection with this triad.
    pub fn parse(reply: &Reply<'_>, triad: Triad) -> Result<Opened, ConnectionError> {
        if !matches!(reply.service, service::FORWARD_OPEN | service::LARGE_FORWARD_OPEN) {
            return Err(ConnectionError::Other);
        }
        if !reply.status.is_ok() {
            return Err(refused(reply, triad));
        }
        let mut reader = Reader(reply.data);
        let (opened, answered) = Opened::read(&mut reader).ok_or(ConnectionError::Short)?;
        if answered != triad {
            return Err(ConnectionError::Other);
        }
        if opened.outgoing_api_us == 0 || opened.incoming_api_us == 0 {
            return Err(ConnectionError::Interval);
        }
        Ok(opened)
    }

    fn read(reader: &mut Reader<'_>) -> Option<(Opened, Triad)> {
        let (outgoing_id, incoming_id) = (reader.long_le()?, reader.long_le()?);
        let triad = Triad::read(reader)?;
        let (outgoing_api_us, incoming_api_us) = (reader.long_le()?, reader.long_le()?);
        Some((Opened { outgoing_id, incoming_id, outgoing_api_us, incoming_api_us }, triad))
    }
}

/// What the drive answered to the closing of the connection with this triad.
pub fn closed(reply: &Reply<'_>, triad: Triad) -> Result<(), ConnectionError> {
    if reply.service != service::FORWARD_CLOSE {
        return Err(ConnectionError::Other);
    }
    if !reply.status.is_ok() {
        return Err(refused(reply, triad));
    }
    match Triad::read(&mut Reader(reply.data)) {
        None => Err(ConnectionError::Short),
        Some(answered) if answered != triad => Err(ConnectionError::Other),
        Some(_) => Ok(()),
    }
}

/// A refusal repeats the triad; some devices leave it out.
fn refused(reply: &Reply<'_>, triad: Triad) -> ConnectionError {
    match Triad::read(&mut Reader(reply.data)) {
        Some(answered) if answered != triad => ConnectionError::Other,
        _ => ConnectionError::Refused(reply.status),
    }
}
