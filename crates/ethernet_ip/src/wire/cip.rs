//! Requests to an object of the drive, and replies (CIP, volume 1, chapter 2 and appendices A to C).

use std::fmt;

use super::Reader;

/// The services, as on the wire.
pub mod service {
    /// All attributes of an object.
    pub const GET_ATTRIBUTES_ALL: u8 = 0x01;
    /// One attribute.
    pub const GET_ATTRIBUTE_SINGLE: u8 = 0x0E;
    /// Sets one attribute.
    pub const SET_ATTRIBUTE_SINGLE: u8 = 0x10;
    /// A message of these drives' own: see `message`.
    pub const VENDOR: u8 = 0x3C;
    /// Closes a connection.
    pub const FORWARD_CLOSE: u8 = 0x4E;
    /// Opens a connection.
    pub const FORWARD_OPEN: u8 = 0x54;
    /// Opens a connection of more than 511 bytes.
    pub const LARGE_FORWARD_OPEN: u8 = 0x5B;
    /// Set in a reply.
    pub const REPLY: u8 = 0x80;
}

/// The objects, as on the wire.
pub mod class {
    /// Who the device is.
    pub const IDENTITY: u16 = 0x01;
    /// Passes messages to objects.
    pub const MESSAGE_ROUTER: u16 = 0x02;
    /// Process data.
    pub const ASSEMBLY: u16 = 0x04;
    /// Opens and closes connections.
    pub const CONNECTION_MANAGER: u16 = 0x06;
    /// These drives' own.
    pub const VENDOR: u16 = 0x64;
}

/// Which device is wanted; 0 = any. Without either there is no segment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Key {
    /// The vendor.
    pub vendor: u16,
    /// The product code.
    pub product_code: u16,
}

/// A segment of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Segment<'a> {
    /// A class.
    Class(u16),
    /// An instance.
    Instance(u16),
    /// An attribute.
    Attribute(u16),
    /// A connection point.
    Point(u16),
    /// An electronic key.
    Key(Key),
    /// Data for the target of a connection: that of a configuration assembly, at most [`DATA_MAX`] bytes. Without any
    /// there is no segment; a byte 0 completes the last word.
    Data(&'a [u8]),
}

/// The most bytes of data in a path: whole frames of 512 bytes are what every device takes.
pub const DATA_MAX: usize = 256;

/// Appends the padded path and returns its 16-bit words.
///
/// Segments have 8 bits wherever the value fits: several devices refuse the others (EIPScanner issues 30, 56, 92).
fn path(out: &mut Vec<u8>, segments: &[Segment<'_>]) -> u8 {
    let start = out.len();
    for segment in segments {
        match *segment {
            Segment::Class(class) => logical(out, 0x20, class),
            Segment::Instance(instance) => logical(out, 0x24, instance),
            Segment::Point(point) => logical(out, 0x2C, point),
            Segment::Attribute(attribute) => logical(out, 0x30, attribute),
            Segment::Key(Key { vendor: 0, product_code: 0 }) | Segment::Data([]) => (),
            Segment::Key(Key { vendor, product_code }) => {
                out.extend([0x34, 0x04]);
                // Of any device type and revision.
                out.extend([vendor, 0, product_code, 0].map(u16::to_le_bytes).as_flattened());
            }
            Segment::Data(data) => {
                // The words of more would not fit.
                let data = data.get(..DATA_MAX).unwrap_or(data);
                out.extend([0x80, data.len().div_ceil(2) as u8]);
                out.extend(data);
                out.extend((!data.len().is_multiple_of(2)).then_some(0));
            }
        }
    }
    // A handful of segments, one of them with data: at most some 150 words.
    ((out.len() - start) / 2) as u8
}

fn logical(out: &mut Vec<u8>, kind: u8, value: u16) {
    match u8::try_from(value) {
        Ok(value) => out.extend([kind, value]),
        Err(_) => {
            out.extend([kind | 1, 0]);
            out.extend(value.to_le_bytes());
        }
    }
}

/// Appends the words of a path, bytes that stand in front of it, and the path.
pub(super) fn sized_path(out: &mut Vec<u8>, between: &[u8], segments: &[Segment<'_>]) {
    let at = out.len();
    out.push(0);
    out.extend(between);
    let words = path(out, segments);
    if let Some(size) = out.get_mut(at) {
        *size = words;
    }
}

/// A request.
pub fn request(service: u8, path: &[Segment<'_>], data: &[u8]) -> Vec<u8> {
    let mut message = vec![service];
    sized_path(&mut message, &[], path);
    message.extend(data);
    message
}

/// A reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply<'a> {
    /// That of the request.
    pub service: u8,
    /// The outcome.
    pub status: Status,
    /// The data of the answer.
    pub data: &'a [u8],
}

impl<'a> Reply<'a> {
    /// `None` if it is no reply.
    pub fn parse(message: &'a [u8]) -> Option<Reply<'a>> {
        let mut reader = Reader(message);
        let [service, _, general, words] = reader.array()?;
        if service & service::REPLY == 0 {
            return None;
        }
        let mut additional = Reader(reader.bytes(2 * usize::from(words))?);
        let status = Status { general, extended: additional.word_le(), size: additional.word_le() };
        Some(Reply { service: service & !service::REPLY, status, data: reader.0 })
    }
}

/// The outcome of a request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// 0 is done.
    pub general: u8,
    /// More of it; with the general status 1 see [`extended_name`].
    pub extended: Option<u16>,
    /// A second word: with [`Status::OUTGOING_SIZE`] and [`Status::INCOMING_SIZE`] the size that the drive wants.
    pub size: Option<u16>,
}

impl Status {
    /// The general status of what has to do with connections.
    pub const CONNECTION_FAILURE: u8 = 0x01;
    /// The service is not supported.
    pub const NO_SERVICE: u8 = 0x08;

    /// The connection is in use, or was opened twice.
    pub const IN_USE: u16 = 0x0100;
    /// Somebody else owns the outputs.
    pub const OWNED: u16 = 0x0106;
    /// The size of a packet is wrong.
    pub const SIZE: u16 = 0x0109;
    /// The target is not configured.
    pub const NOT_CONFIGURED: u16 = 0x0110;
    /// The RPI is not supported.
    pub const RPI: u16 = 0x0111;
    /// Listen only: nobody else has a connection.
    pub const NOBODY_TO_LISTEN_TO: u16 = 0x0119;
    /// The size of the configuration data is wrong.
    pub const CONFIGURATION_SIZE: u16 = 0x0126;
    /// The size of our packets is wrong.
    pub const OUTGOING_SIZE: u16 = 0x0127;
    /// The size of the drive's packets is wrong.
    pub const INCOMING_SIZE: u16 = 0x0128;
    /// The configuration data is wrong, or its path.
    pub const CONFIGURATION: u16 = 0x0129;

    /// The request was executed.
    pub fn is_ok(&self) -> bool {
        self.general == 0
    }

    /// The extended status of a connection that failed.
    pub fn failure(&self) -> Option<u16> {
        self.extended.filter(|_| self.general == Status::CONNECTION_FAILURE)
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Status { general, extended, .. } = *self;
        if let Some((code, name)) = self.failure().and_then(|code| Some((code, extended_name(code)?))) {
            write!(f, "{name} ({code:#06x})")?;
            return match (code, self.size) {
                (Status::OUTGOING_SIZE | Status::INCOMING_SIZE, Some(size)) => {
                    write!(f, ": the drive wants {size} bytes")
                }
                (Status::CONFIGURATION_SIZE, Some(words)) => {
                    write!(f, ", whose 16-bit words are at most {words}")
                }
                _ => Ok(()),
            };
        }
        write!(f, "{} ({general:#04x}", general_name(general).unwrap_or("unknown status"))?;
        if let Some(extended) = extended {
            write!(f, ", extended {extended:#06x}")?;
        }
        f.write_str(")")
    }
}

/// The meaning of a general status (CIP, volume 1, appendix B-1).
pub fn general_name(general: u8) -> Option<&'static str> {
    Some(match general {
        0x00 => "ok",
        0x01 => "connection failure",
        0x02 => "resource unavailable",
        0x03 => "bad parameter value",
        0x04 => "error in a path segment",
        0x05 => "path destination unknown",
        0x06 => "partial transfer",
        0x07 => "connection lost",
        0x08 => "service not supported",
        0x09 => "invalid attribute value",
        0x0A => "error in the attribute list",
        0x0B => "already in this mode",
        0x0C => "not possible in the state of the object",
        0x0E => "attribute cannot be set",
        0x0F => "no privilege for it",
        0x10 => "not possible in the state of the device",
        0x11 => "reply too large",
        0x13 => "not enough data",
        0x14 => "attribute not supported",
        0x15 => "too much data",
        0x16 => "object does not exist",
        0x1E => "error in an embedded service",
        0x1F => "error of the vendor's own",
        0x20 => "invalid parameter",
        0x25 => "wrong key in the path",
        0x26 => "wrong size of the path",
        0x2C => "attribute cannot be read",
        _ => return None,
    })
}

/// The meaning of the extended status with the general status 1 (CIP, volume 1, table 3-5.33).
pub fn extended_name(extended: u16) -> Option<&'static str> {
    Some(match extended {
        0x0100 => "connection in use, or opened twice",
        0x0103 => "class and trigger of the transport not supported",
        0x0106 => "somebody else owns the outputs",
        0x0107 => "no such connection",
        0x0108 => "invalid connection parameter",
        0x0109 => "invalid connection size",
        0x0110 => "target not configured",
        0x0111 => "RPI not supported",
        0x0112 => "RPI not acceptable beside the existing connections",
        0x0113 => "no connection left",
        0x0114 => "another vendor or product than the key says",
        0x0115 => "another device type than the key says",
        0x0116 => "another revision than the key says",
        0x0117 => "invalid produced or consumed path",
        0x0118 => "invalid configuration path",
        0x0119 => "nobody has a connection that could be listened to",
        0x011A => "no connection left in the target object",
        0x011B => "RPI shorter than the production inhibit time",
        0x011C => "transport class not supported",
        0x011D => "production trigger not supported",
        0x011E => "direction not supported",
        0x011F => "O->T fixed or variable size not supported",
        0x0120 => "T->O fixed or variable size not supported",
        0x0121 => "O->T priority not supported",
        0x0122 => "T->O priority not supported",
        0x0123 => "O->T connection type not supported",
        0x0124 => "T->O connection type not supported",
        0x0125 => "redundant owner not supported",
        0x0126 => "wrong size of the configuration data",
        0x0127 => "wrong O->T size",
        0x0128 => "wrong T->O size",
        0x0129 => "invalid configuration data or path",
        0x012A => "invalid consuming path",
        0x012B => "invalid producing path",
        0x012F => "paths that do not go together",
        0x0132 => "null Forward_Open not supported",
        0x0133 => "time-out multiplier not acceptable",
        0x0135..=0x0139 => "not what the existing multicast connection has",
        0x0203 => "connection timed out",
        0x0204 => "unconnected request timed out",
        0x0205 => "parameter error in the unconnected request",
        0x0311 => "port not available",
        0x0315 => "invalid segment in the path",
        0x0316 => "path of Forward_Close does not match",
        0x031C => "miscellaneous",
        0x0800 => "link offline",
        0x0813 => "no multicast outside the subnet of the drive",
        _ => return None,
    })
}
