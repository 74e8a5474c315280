//! The encapsulation: a header in front of every message except class 1 packets (EtherNet/IP, volume 2, chapter 2).

use std::fmt;
use std::net::SocketAddrV4;

use thiserror::Error;

use super::Reader;
use super::cpf::{self, Items, item};
use fieldbeat_core::axis::acyclic::long;

/// The header, bytes.
pub const HEADER: usize = 24;
/// The most data behind a header that is taken. The longest message of a drive is a tenth of it; a length beyond it
/// would only make the receiver wait for bytes that never come.
pub const DATA_MAX: usize = 4096;

/// The version of the encapsulation.
const VERSION: u16 = 1;

/// The commands, as on the wire.
pub mod command {
    /// Nothing; never answered.
    pub const NOP: u16 = 0x0000;
    /// The services of the drive.
    pub const LIST_SERVICES: u16 = 0x0004;
    /// Who is there.
    pub const LIST_IDENTITY: u16 = 0x0063;
    /// Interfaces other than CIP.
    pub const LIST_INTERFACES: u16 = 0x0064;
    /// Begins a session.
    pub const REGISTER_SESSION: u16 = 0x0065;
    /// Ends a session; never answered.
    pub const UNREGISTER_SESSION: u16 = 0x0066;
    /// An unconnected message.
    pub const SEND_RR_DATA: u16 = 0x006F;
    /// A message on a connection.
    pub const SEND_UNIT_DATA: u16 = 0x0070;
}

/// Whether a peer of EtherNet/IP can send this.
fn is_known(command: u16) -> bool {
    matches!(
        command,
        command::NOP
            | command::LIST_SERVICES
            | command::LIST_IDENTITY
            | command::LIST_INTERFACES
            | command::REGISTER_SESSION
            | command::UNREGISTER_SESSION
            | command::SEND_RR_DATA
            | command::SEND_UNIT_DATA
    )
}

/// The status in a header.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status(pub u32);

impl Status {
    /// Done.
    pub const OK: Status = Status(0);
    /// The session does not exist (any more).
    pub const NO_SESSION: Status = Status(0x64);

    /// The meaning; `None` for a number that the standard does not have.
    pub fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            0x00 => "ok",
            0x01 => "invalid or unsupported command",
            0x02 => "no memory for another session",
            0x03 => "incorrect data",
            0x64 => "invalid session handle",
            0x65 => "invalid length",
            0x69 => "unsupported protocol version",
            0x6A => "service not allowed on this port",
            _ => return None,
        })
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({:#06x})", self.name().unwrap_or("unknown encapsulation status"), self.0)
    }
}

/// The header without the length, and without the options: they are 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Header {
    /// See [`command`].
    pub command: u16,
    /// The session; 0 before there is one.
    pub session: u32,
    /// 0 in every request.
    pub status: Status,
    /// Chosen by the sender of the request, and echoed.
    pub context: u64,
}

/// Why a stream is not EtherNet/IP. No mark shows where the next message begins: the connection has to be closed.
#[derive(Clone, Copy, PartialEq, Eq, Error)]
pub enum Malformed {
    /// No message has this command.
    #[error("command {0:#06x} in the header: not an EtherNet/IP peer, or bytes were lost")]
    Command(u16),
    /// No message of a drive is so long.
    #[error(
        "{0} bytes announced where at most {DATA_MAX} are taken: not an EtherNet/IP peer, or bytes were lost"
    )]
    Length(u16),
}
fieldbeat_core::debug_as_display!(Malformed);

/// One message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// The header.
    pub header: Header,
    /// The data that follow.
    pub data: &'a [u8],
}

impl<'a> Frame<'a> {
    /// The message at the front of a stream, and its size; `None` while it is incomplete. A fault is reported as soon
    /// as its field has arrived.
    pub fn next(stream: &'a [u8]) -> Result<Option<(Frame<'a>, usize)>, Malformed> {
        let mut reader = Reader(stream);
        let Some(command) = reader.word_le() else { return Ok(None) };
        if !is_known(command) {
            return Err(Malformed::Command(command));
        }
        let Some(length) = reader.word_le() else { return Ok(None) };
        if usize::from(length) > DATA_MAX {
            return Err(Malformed::Length(length));
        }
        Ok(Frame::body(reader, command, length).map(|frame| (frame, HEADER + usize::from(length))))
    }

    /// The message that is a datagram; `None` if it is not exactly one.
    pub fn datagram(datagram: &'a [u8]) -> Option<Frame<'a>> {
        let (frame, size) = Frame::next(datagram).ok()??;
        (size == datagram.len()).then_some(frame)
    }

    fn body(mut reader: Reader<'a>, command: u16, length: u16) -> Option<Frame<'a>> {
        let session = reader.long_le()?;
        let status = Status(reader.long_le()?);
        let context = u64::from_le_bytes(reader.array()?);
        reader.long_le()?;
        let data = reader.bytes(length.into())?;
        Some(Frame { header: Header { command, session, status, context }, data })
    }
}

/// Appends a message whose data `fill` appends: at most 65535 bytes, or the length in the header is wrong.
pub fn frame(out: &mut Vec<u8>, header: Header, fill: impl FnOnce(&mut Vec<u8>)) {
    let start = out.len();
    out.extend(header.command.to_le_bytes());
    out.extend([0; 2]);
    out.extend(header.session.to_le_bytes());
    out.extend(header.status.0.to_le_bytes());
    out.extend(header.context.to_le_bytes());
    out.extend([0; 4]);
    cpf::sized(out, start + 2, fill);
}

/// Appends: who is there? On a broadcast a drive waits at random up to so many ms as the lowest 16 bits of the context
/// say (0: 2000, 1 ... 499: 500).
pub fn list_identity(out: &mut Vec<u8>, context: u64) {
    frame(out, Header { command: command::LIST_IDENTITY, context, ..Header::default() }, |_| ());
}

/// Appends: begin a session.
pub fn register_session(out: &mut Vec<u8>, context: u64) {
    let header = Header { command: command::REGISTER_SESSION, context, ..Header::default() };
    frame(out, header, |out| {
        out.extend(VERSION.to_le_bytes());
        out.extend([0; 2]);
    });
}

/// Appends: end the session. The drive closes the connection without an answer.
pub fn unregister_session(out: &mut Vec<u8>, session: u32) {
    frame(out, Header { command: command::UNREGISTER_SESSION, session, ..Header::default() }, |_| ());
}

/// Appends an unconnected message. `incoming`: where a connection that it opens is to send, as a socket address item.
pub fn send_rr_data(
    out: &mut Vec<u8>,
    session: u32,
    context: u64,
    message: &[u8],
    incoming: Option<SocketAddrV4>,
) {
    let header = Header { command: command::SEND_RR_DATA, session, context, ..Header::default() };
    frame(out, header, |out| {
        interface(out);
        out.extend((2 + u16::from(incoming.is_some())).to_le_bytes());
        cpf::put(out, item::NULL, &[]);
        cpf::put(out, item::UNCONNECTED_DATA, message);
        if let Some(address) = incoming {
            cpf::put(out, item::INCOMING_ADDRESS, &cpf::socket_address(address));
        }
    });
}

/// Appends a message on the class 3 connection with this id of ours. Its answer has the same sequence number: that of
/// the message before means that it is to be answered again and not executed again.
pub fn send_unit_data(out: &mut Vec<u8>, session: u32, connection: u32, sequence: u16, message: &[u8]) {
    let header = Header { command: command::SEND_UNIT_DATA, session, ..Header::default() };
    frame(out, header, |out| {
        interface(out);
        out.extend(2_u16.to_le_bytes());
        cpf::put(out, item::CONNECTED_ADDRESS, &connection.to_le_bytes());
        cpf::put(out, item::CONNECTED_DATA, &[&sequence.to_le_bytes(), message].concat());
    });
}

/// Interface CIP, and no time-out of the encapsulation.
fn interface(out: &mut Vec<u8>) {
    out.extend([0; 6]);
}

/// The items of [`command::SEND_RR_DATA`] and [`command::SEND_UNIT_DATA`].
fn items(data: &[u8]) -> Option<Items<'_>> {
    let mut reader = Reader(data);
    let interface = reader.long_le()?;
    reader.word_le()?;
    if interface != 0 { None } else { Items::parse(reader.0) }
}

/// An unconnected message with what came along.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unconnected<'a> {
    /// The CIP message.
    pub message: &'a [u8],
    /// Where the drive wants the packets of a connection; 0.0.0.0: at its own address.
    pub outgoing: Option<SocketAddrV4>,
    /// Where it sends its own to.
    pub incoming: Option<SocketAddrV4>,
}

impl<'a> Unconnected<'a> {
    /// The data of [`command::SEND_RR_DATA`]; `None` if there is no message in it.
    pub fn parse(data: &'a [u8]) -> Option<Unconnected<'a>> {
        let items = items(data)?;
        items.clone().find(|item| item.kind == item::NULL && item.data.is_empty())?;
        let address = |kind| items.clone().find(|item| item.kind == kind)?.socket_address();
        Some(Unconnected {
            message: items.clone().find(|item| item.kind == item::UNCONNECTED_DATA)?.data,
            outgoing: address(item::OUTGOING_ADDRESS),
            incoming: address(item::INCOMING_ADDRESS),
        })
    }
}

/// A message on a class 3 connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Connected<'a> {
    /// The connection: in an answer the id that the drive sends with.
    pub connection: u32,
    /// That of the request.
    pub sequence: u16,
    /// The CIP message.
    pub message: &'a [u8],
}

impl<'a> Connected<'a> {
    /// The data of [`command::SEND_UNIT_DATA`]; `None` if there is no message in it.
    pub fn parse(data: &'a [u8]) -> Option<Connected<'a>> {
        let mut items = items(data)?;
        let address = items.next().filter(|item| item.kind == item::CONNECTED_ADDRESS)?;
        let message = items.next().filter(|item| item.kind == item::CONNECTED_DATA)?;
        let connection = u32::from_le_bytes(address.data.try_into().ok()?);
        let mut reader = Reader(message.data);
        Some(Connected { connection, sequence: reader.word_le()?, message: reader.0 })
    }
}

/// The identity of a device: the attributes of its identity object.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// The vendor: 60 is Applied Motion Products.
    pub vendor: u16,
    /// The device type.
    pub device_type: u16,
    /// The product code.
    pub product_code: u16,
    /// The revision, major and minor.
    pub revision: (u8, u8),
    /// The status bits.
    pub status: u16,
    /// The serial number: unique for the vendor.
    pub serial: u32,
    /// The name, printable.
    pub name: String,
}

impl Identity {
    /// All attributes of the object, as `GET_ATTRIBUTES_ALL` answers.
    pub fn parse(data: &[u8]) -> Option<Identity> {
        Identity::read(&mut Reader(data))
    }

    fn read(reader: &mut Reader<'_>) -> Option<Identity> {
        Some(Identity {
            vendor: reader.word_le()?,
            device_type: reader.word_le()?,
            product_code: reader.word_le()?,
            revision: (reader.byte()?, reader.byte()?),
            status: reader.word_le()?,
            serial: reader.long_le()?,
            name: {
                let length = reader.byte()?;
                long::text(reader.bytes(length.into())?)
            },
        })
    }
}

/// An answer to [`list_identity`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Where it says that it is: not always where the answer came from.
    pub address: SocketAddrV4,
    /// Who it is.
    pub identity: Identity,
    /// 3 is operational.
    pub state: u8,
}

impl Listed {
    /// The data of [`command::LIST_IDENTITY`]; `None` if it names nobody.
    pub fn parse(data: &[u8]) -> Option<Listed> {
        let item = Items::parse(data)?.find(|item| item.kind == item::IDENTITY)?;
        let mut reader = Reader(item.data);
        reader.word_le()?;
        let address = cpf::parse_socket_address(&reader.array()?)?;
        Some(Listed { address, identity: Identity::read(&mut reader)?, state: reader.byte()? })
    }
}
