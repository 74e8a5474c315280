//! The message router's form of requests and replies, and their paths.
//!
//! Knows no object. Own byte code: it shares none with the master. Facts: sheet, 2.1 to 2.5.

/// General status values.
pub(super) mod general {
    pub const RESOURCES: u8 = 0x02;
    pub const SEGMENT: u8 = 0x04;
    pub const DESTINATION: u8 = 0x05;
    pub const VALUE: u8 = 0x09;
    pub const SERVICE: u8 = 0x08;
    pub const CONFLICT: u8 = 0x0C;
    pub const NOT_SETTABLE: u8 = 0x0E;
    pub const PRIVILEGE: u8 = 0x0F;
    pub const DEVICE_STATE: u8 = 0x10;
    pub const TOO_LARGE: u8 = 0x11;
    pub const NOT_ENOUGH: u8 = 0x13;
    pub const ATTRIBUTE: u8 = 0x14;
    pub const TOO_MUCH: u8 = 0x15;
    pub const PARAMETER: u8 = 0x20;
    pub const PATH_SIZE: u8 = 0x26;
}

/// Services.
pub(super) mod service {
    pub const GET_ALL: u8 = 0x01;
    pub const GET: u8 = 0x0E;
    pub const SET: u8 = 0x10;
    pub const VENDOR: u8 = 0x3C;
    pub const CLOSE: u8 = 0x4E;
    pub const OPEN: u8 = 0x54;
    pub const LARGE_OPEN: u8 = 0x5B;
}

/// Why a request is refused: general status, and additional words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Failure {
    pub general: u8,
    words: [u16; 2],
    count: u8,
}

impl Failure {
    /// Without an additional word.
    pub(super) const fn general(general: u8) -> Failure {
        Failure { general, words: [0; 2], count: 0 }
    }

    /// A connection failure with its extended status.
    pub(super) const fn extended(status: u16) -> Failure {
        Failure { general: 0x01, words: [status, 0], count: 1 }
    }

    /// The same with the value that would be right.
    pub(super) const fn sized(status: u16, right: u16) -> Failure {
        Failure { general: 0x01, words: [status, right], count: 2 }
    }

    fn words(&self) -> &[u16] {
        &self.words[..usize::from(self.count)]
    }
}

/// The result of a service: what it has appended to the reply counts only if it succeeds.
pub(super) type Served = Result<(), Failure>;

/// A result without data.
pub(super) const fn refuse<T>(status: u8) -> Result<T, Failure> {
    Err(Failure::general(status))
}

/// Little-endian values from the front of bytes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reader<'a>(pub &'a [u8]);

impl<'a> Reader<'a> {
    pub(super) fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (taken, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*taken)
    }

    pub(super) fn u8(&mut self) -> Option<u8> {
        self.array().map(u8::from_le_bytes)
    }

    pub(super) fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }
}

/// A request to an object.
#[derive(Clone, Copy, Debug)]
pub(super) struct Request<'a> {
    pub service: u8,
    pub path: &'a [u8],
    pub data: &'a [u8],
}

impl<'a> Request<'a> {
    /// `Err`: the service of a request whose path does not fit in it; `None`: not even a service.
    pub(super) fn parse(bytes: &'a [u8]) -> Result<Request<'a>, Option<u8>> {
        let mut from = Reader(bytes);
        let service = from.u8().ok_or(None)?;
        let words = from.u8().ok_or(Some(service))?;
        let path = from.take(2 * usize::from(words)).ok_or(Some(service))?;
        Ok(Request { service, path, data: from.0 })
    }
}

/// Appends the reply to `service` as begun by `write`: its data, or why it is refused.
pub(super) fn reply(service: u8, out: &mut Vec<u8>, write: impl FnOnce(&mut Vec<u8>) -> Served) {
    let start = out.len();
    out.extend([service | 0x80, 0, 0, 0]);
    if let Err(failure) = write(out) {
        out.truncate(start);
        refused(service, failure, out);
    }
}

/// Appends a reply that is no success.
pub(super) fn refused(service: u8, failure: Failure, out: &mut Vec<u8>) {
    out.extend([service | 0x80, 0, failure.general, failure.count]);
    out.extend(failure.words().iter().flat_map(|word| word.to_le_bytes()));
}

/// An electronic key of format 4.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Key {
    pub vendor: u16,
    pub device_type: u16,
    pub product: u16,
    pub major: u8,
    pub minor: u8,
}

/// A segment of a padded path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Segment<'a> {
    Class(u32),
    Instance(u32),
    Member(u32),
    Point(u32),
    Attribute(u32),
    Key(Key),
    /// Production inhibit time, ms.
    Inhibit(u8),
    Data(&'a [u8]),
}

/// A segment that these drives do not know, or that is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct BadSegment;

/// The segments of a path.
#[derive(Clone, Copy, Debug)]
pub(super) struct Segments<'a>(Reader<'a>);

impl<'a> Segments<'a> {
    pub(super) fn new(path: &'a [u8]) -> Segments<'a> {
        Segments(Reader(path))
    }

    fn segment(&mut self) -> Option<Segment<'a>> {
        let from = &mut self.0;
        let kind = from.u8()?;
        match kind {
            0x34 => {
                let format = (from.u8()?, from.u16()?, from.u16()?, from.u16()?, from.u8()?, from.u8()?);
                let (4, vendor, device_type, product, major, minor) = format else { return None };
                return Some(Segment::Key(Key { vendor, device_type, product, major, minor }));
            }
            0x43 => return from.u8().map(Segment::Inhibit),
            0x80 => {
                let words = from.u8()?;
                return from.take(2 * usize::from(words)).map(Segment::Data);
            }
            _ => {}
        }
        let value = match kind & 0xE3 {
            0x20 => from.u8()?.into(),
            0x21 => (from.u8()?, from.u16()?).1.into(),
            0x22 => (from.u8()?, from.u32()?).1,
            _ => return None,
        };
        Some(match kind & 0x1C {
            0x00 => Segment::Class(value),
            0x04 => Segment::Instance(value),
            0x08 => Segment::Member(value),
            0x0C => Segment::Point(value),
            0x10 => Segment::Attribute(value),
            _ => return None,
        })
    }
}

impl<'a> Iterator for Segments<'a> {
    type Item = Result<Segment<'a>, BadSegment>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.0.0.is_empty() {
            return None;
        }
        let segment = self.segment().ok_or(BadSegment);
        if segment.is_err() {
            self.0 = Reader(&[]);
        }
        Some(segment)
    }
}

/// The object that a request is for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Target {
    pub class: u32,
    pub instance: u32,
    pub attribute: Option<u32>,
}

impl Target {
    /// The target of a path: class, instance, and perhaps an attribute, in this order.
    pub(super) fn of(path: &[u8]) -> Result<Target, Failure> {
        let mut target = Target::default();
        for (place, segment) in Segments::new(path).enumerate() {
            match (place, segment) {
                (0, Ok(Segment::Class(class))) => target.class = class,
                (1, Ok(Segment::Instance(instance))) => target.instance = instance,
                (2, Ok(Segment::Attribute(attribute))) => target.attribute = Some(attribute),
                _ => return refuse(general::SEGMENT),
            }
        }
        // An empty path leads nowhere, nor does a class without an instance.
        if path.is_empty() { refuse(general::DESTINATION) } else { Ok(target) }
    }
}
