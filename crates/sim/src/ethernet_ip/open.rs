//! Forward_Open of both sizes and Forward_Close, as bytes.
//!
//! Knows no connection. Facts: sheet, 2.6 and 2.7.

use super::cip::{BadSegment, Failure, Key, Reader, Segment, Segments, general};

/// Who has opened a connection, and which one it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Triad {
    pub serial: u16,
    pub vendor: u16,
    pub originator: u32,
}

impl Triad {
    fn parse(from: &mut Reader<'_>) -> Option<Triad> {
        Some(Triad { serial: from.u16()?, vendor: from.u16()?, originator: from.u32()? })
    }

    pub(super) fn append(self, out: &mut Vec<u8>) {
        out.extend(self.serial.to_le_bytes());
        out.extend(self.vendor.to_le_bytes());
        out.extend(self.originator.to_le_bytes());
    }

    /// The connections of one originator.
    pub(super) fn same_originator(self, other: Triad) -> bool {
        (self.vendor, self.originator) == (other.vendor, other.originator)
    }
}

/// The type of one direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Type {
    Null,
    Multicast,
    PointToPoint,
    Reserved,
}

/// The network connection parameters of one direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Parameters {
    pub size: u16,
    pub variable: bool,
    pub priority: u8,
    pub kind: Type,
    pub redundant: bool,
}

impl Parameters {
    /// As they are with 32 bits; with 16 bits their upper half is that word, and the size is what is left of it.
    fn new(word: u32, size: u16) -> Parameters {
        Parameters {
            size,
            variable: word >> 25 & 1 == 1,
            priority: (word >> 26 & 3) as u8,
            kind: match word >> 29 & 3 {
                0 => Type::Null,
                1 => Type::Multicast,
                2 => Type::PointToPoint,
                _ => Type::Reserved,
            },
            redundant: word >> 31 == 1,
        }
    }

    fn parse(from: &mut Reader<'_>, large: bool) -> Option<Parameters> {
        if large {
            let word = from.u32()?;
            return Some(Parameters::new(word, word as u16));
        }
        let word = from.u16()?;
        Some(Parameters::new(u32::from(word) << 16, word & 0x1FF))
    }
}

/// A request to open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Open<'a> {
    /// The originator's id for packets to it.
    pub produced: u32,
    pub triad: Triad,
    pub multiplier: u8,
    /// us, to the drive and from it.
    pub intervals_us: (u32, u32),
    pub to: Parameters,
    pub from: Parameters,
    pub class: u8,
    pub trigger: u8,
    pub path: &'a [u8],
}

/// A request that could not be read: as far as it could, whose it is.
pub(super) type Unreadable = (Option<Triad>, Failure);

impl<'a> Open<'a> {
    pub(super) fn parse(data: &'a [u8], large: bool) -> Result<Open<'a>, Unreadable> {
        let mut from = Reader(data);
        let triad = from.take(10).and_then(|_| Triad::parse(&mut from));
        let short = (triad, Failure::general(general::NOT_ENOUGH));
        let mut open = Self::fixed(data, large).ok_or(short)?;
        let (path, words) = open.split();
        open.path = path;
        match path.len().cmp(&(2 * usize::from(words))) {
            std::cmp::Ordering::Equal => Ok(open),
            std::cmp::Ordering::Less => Err(short),
            std::cmp::Ordering::Greater => Err((triad, Failure::general(general::TOO_MUCH))),
        }
    }

    /// What is behind the fixed part, and how many words it is said to have.
    fn split(&self) -> (&'a [u8], u8) {
        self.path.split_first().map_or((&[], 0), |(words, path)| (path, *words))
    }

    /// The fixed part; its path has the number of words in front.
    fn fixed(data: &'a [u8], large: bool) -> Option<Open<'a>> {
        let mut from = Reader(data);
        from.take(6)?;
        let produced = from.u32()?;
        let triad = Triad::parse(&mut from)?;
        let multiplier = from.u8()?;
        from.take(3)?;
        let (to_us, to) = (from.u32()?, Parameters::parse(&mut from, large)?);
        let (from_us, back) = (from.u32()?, Parameters::parse(&mut from, large)?);
        let transport = from.u8()?;
        let path = (!from.0.is_empty()).then_some(from.0)?;
        Some(Open {
            produced,
            triad,
            multiplier,
            intervals_us: (to_us, from_us),
            to,
            from: back,
            class: transport & 0x0F,
            trigger: transport >> 4 & 7,
            path,
        })
    }
}

/// The path of an open.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct OpenPath<'a> {
    pub key: Option<Key>,
    pub class: u32,
    pub instance: u32,
    /// The connection points, in order.
    pub points: [Option<u32>; 2],
    /// ms.
    pub inhibit: Option<u8>,
    pub configuration: Option<&'a [u8]>,
    /// Something that no such path has.
    pub surplus: bool,
}

impl<'a> OpenPath<'a> {
    pub(super) fn parse(path: &'a [u8]) -> Result<OpenPath<'a>, BadSegment> {
        let mut parsed = OpenPath::default();
        let (mut class, mut instance) = (None, None);
        for (place, segment) in Segments::new(path).enumerate() {
            match segment? {
                Segment::Key(key) if place == 0 => parsed.key = Some(key),
                Segment::Inhibit(ms) if parsed.inhibit.is_none() => parsed.inhibit = Some(ms),
                Segment::Class(value) if class.is_none() => class = Some(value),
                Segment::Instance(value) if instance.is_none() && class.is_some() => instance = Some(value),
                Segment::Point(value) => match parsed.points.iter_mut().find(|point| point.is_none()) {
                    Some(point) if instance.is_some() => *point = Some(value),
                    _ => parsed.surplus = true,
                },
                Segment::Data(data) if parsed.configuration.is_none() => parsed.configuration = Some(data),
                _ => parsed.surplus = true,
            }
        }
        (parsed.class, parsed.instance) = (class.ok_or(BadSegment)?, instance.ok_or(BadSegment)?);
        Ok(parsed)
    }
}

/// The connection that a close is for, and the number of words of its path.
pub(super) fn close(data: &[u8]) -> Result<(Triad, u8), Unreadable> {
    let mut from = Reader(data);
    let triad = from.take(2).and_then(|_| Triad::parse(&mut from));
    let short = (triad, Failure::general(general::NOT_ENOUGH));
    let words = from.take(2).ok_or(short)?[0];
    let surplus = from.0.len().checked_sub(2 * usize::from(words)).ok_or(short)?;
    match (triad, surplus) {
        (Some(triad), 0) => Ok((triad, words)),
        (Some(_), _) => Err((triad, Failure::general(general::TOO_MUCH))),
        (None, _) => Err(short),
    }
}
