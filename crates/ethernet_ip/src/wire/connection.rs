//! Opening and closing of connections, at the connection manager (CIP, volume 1, 3-5.5).

use thiserror::Error;

use super::assembly::{self, Version};
use super::cip::{self, Key, Reply, Segment, Status, class, service};
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

/// How packets come: its value is on the wire.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Delivery {
    /// To this master only.
    #[default]
    PointToPoint = 2,
    /// To a group that the drive chooses.
    Multicast = 1,
}

/// One direction of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Direction {
    /// The requested packet interval, µs.
    pub rpi_us: u32,
    /// Everything from the CIP sequence count on, bytes.
    pub size: u16,
    /// How its packets come.
    pub delivery: Delivery,
}

impl Direction {
    /// `kind`: the priority of the packets, and whether they may be shorter.
    fn emit(&self, out: &mut Vec<u8>, kind: u8, large: bool) {
        out.extend(self.rpi_us.to_le_bytes());
        let flags = (self.delivery as u8) << 5 | kind;
        if large {
            out.extend((u32::from(flags) << 24 | u32::from(self.size)).to_le_bytes());
        } else {
            out.extend((u16::from(flags) << 8 | self.size & SMALL_MAX).to_le_bytes());
        }
    }
}

/// The numbers that distinguish a connection from every other one, on any network.
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

/// The access of a connection: its value is the output assembly, or what stands in its place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Access {
    /// It owns the outputs.
    #[default]
    Owner = 0x70,
    /// It only reads, and is alone in that.
    InputOnly = 0x67,
    /// It reads what another connection has requested.
    ListenOnly,
}

/// The target of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// Process data: class 1, cyclic.
    Assemblies {
        /// The access. A drive of the first version has no outputs to own.
        access: Access,
        /// Which assemblies the drive has.
        version: Version,
    },
    /// Explicit messages: class 3, server.
    Messages,
}

impl Target {
    /// The class of the transport, its trigger and its direction; and the packets: scheduled and of a fixed size, or of
    /// low priority and any size up to that.
    fn transport(self) -> (u8, u8) {
        match self {
            Target::Assemblies { .. } => (0x01, 2 << 2),
            Target::Messages => (0xA3, 1 << 1),
        }
    }

    /// Appends the words of the path, `between` and the path.
    fn path(self, out: &mut Vec<u8>, between: &[u8], key: Key, configuration: &[u8]) {
        let [class, instance, points @ ..] = match self {
            Target::Assemblies { access, version } => [
                Segment::Class(class::ASSEMBLY),
                Segment::Instance(assembly::CONFIGURATION),
                Segment::Point(access as u16),
                Segment::Point(version as u16),
            ],
            Target::Messages => {
                let none = Segment::Data(&[]);
                [Segment::Class(class::MESSAGE_ROUTER), Segment::Instance(1), none, none]
            }
        };
        let [output, input] = points;
        let path = [Segment::Key(key), class, instance, output, input, Segment::Data(configuration)];
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
    /// The id that the drive's packets are to have, unless it sends to a group. It chooses that of ours.
    pub incoming_id: u32,
    /// The owner of the connection.
    pub triad: Triad,
    /// See [`timeout_factor`].
    pub multiplier: u8,
    /// Our packets.
    pub outgoing: Direction,
    /// The drive's packets.
    pub incoming: Direction,
    /// Which device has to be there.
    pub key: Key,
    /// The target.
    pub target: Target,
    /// Data for the configuration assembly.
    pub configuration: &'a [u8],
    /// In the large form, which a connection of more than 511 bytes always has.
    pub large: bool,
}

impl ForwardOpen<'_> {
    /// The request.
    pub fn message(&self) -> Vec<u8> {
        let large = self.large || self.outgoing.size.max(self.incoming.size) > SMALL_MAX;
        let service = if large { service::LARGE_FORWARD_OPEN } else { service::FORWARD_OPEN };
        let mut message = cip::request(service, &MANAGER, &PATIENCE);
        message.extend([0; 4]);
        message.extend(self.incoming_id.to_le_bytes());
        self.triad.emit(&mut message);
        message.extend([self.multiplier, 0, 0, 0]);
        let (transport, kind) = self.target.transport();
        self.outgoing.emit(&mut message, kind, large);
        self.incoming.emit(&mut message, kind, large);
        message.push(transport);
        self.target.path(&mut message, &[], self.key, self.configuration);
        message
    }
}

/// The request to close a connection. Drives look at the triad only.
pub fn forward_close(triad: Triad, target: Target) -> Vec<u8> {
    let mut message = cip::request(service::FORWARD_CLOSE, &MANAGER, &PATIENCE);
    triad.emit(&mut message);
    target.path(&mut message, &[0], Key::default(), &[]);
    message
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
    /// The drive's answer to the opening of the connection with this triad.
    pub fn parse(reply: &Reply<'_>, triad: Triad) -> Result<Opened, ConnectionError> {
        let opened =
            answered(reply, &[service::FORWARD_OPEN, service::LARGE_FORWARD_OPEN], triad, Opened::read)?;
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

/// The drive's answer to the closing of the connection with this triad.
pub fn closed(reply: &Reply<'_>, triad: Triad) -> Result<(), ConnectionError> {
    answered(reply, &[service::FORWARD_CLOSE], triad, |reader| Some(((), Triad::read(reader)?)))
}

/// The result of `read` for the answer to one of these services, if it is that with this triad. A refusal repeats the
/// triad; some devices leave it out.
fn answered<T>(
    reply: &Reply<'_>,
    services: &[u8],
    triad: Triad,
    read: impl FnOnce(&mut Reader<'_>) -> Option<(T, Triad)>,
) -> Result<T, ConnectionError> {
    if !services.contains(&reply.service) {
        return Err(ConnectionError::Other);
    }
    let mut reader = Reader(reply.data);
    if !reply.status.is_ok() {
        let other = Triad::read(&mut reader).is_some_and(|answered| answered != triad);
        return Err(if other { ConnectionError::Other } else { ConnectionError::Refused(reply.status) });
    }
    match read(&mut reader) {
        None => Err(ConnectionError::Short),
        Some((_, answered)) if answered != triad => Err(ConnectionError::Other),
        Some((found, _)) => Ok(found),
    }
}
