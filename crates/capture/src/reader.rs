//! Reads a capture, whoever made it: pcapng and classic pcap, of both byte orders, packet by packet.

use std::io::{self, Read};

use fieldbeat_core::bus::reader::Reader;

use super::Direction;
use super::writer::{ORDER, block, option};

/// No block is longer: lengths beyond come from broken files.
const LONGEST: u32 = 64 << 20;

/// Classic pcap: times in µs, and in ns.
const PCAP: [u32; 2] = [0xA1B2_C3D4, 0xA1B2_3C4D];
/// Behind its first word, and before each of its packets.
const PCAP_HEADER: usize = 20;
const PCAP_PACKET: usize = 16;

/// The mistake in a capture.
#[derive(thiserror::Error)]
pub enum Wrong {
    /// The operating system refused.
    #[error("{0}; name a capture that this user may read (*.pcapng, *.pcap)")]
    Io(#[from] io::Error),
    /// Something else.
    #[error("not a capture; name one in the format pcapng or pcap, as Wireshark and tcpdump write it")]
    Foreign,
    /// It ends within a block.
    #[error("its end is missing: what is there was printed")]
    Cut,
    /// A block contradicts itself.
    #[error("it is damaged ({0}): what is before that was printed")]
    Damaged(&'static str),
}
fieldbeat_core::debug_as_display!(Wrong);

impl Wrong {
    /// Nothing of it could be read.
    pub fn is_all(&self) -> bool {
        matches!(self, Wrong::Io(_) | Wrong::Foreign)
    }
}

/// An interface of a capture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Interface {
    /// The name; without one its number.
    pub name: String,
    /// The description; of a capture that was made here the protocol of its bus.
    pub description: String,
    /// The type of its packets' first header.
    pub link_type: u16,
    /// Units of its times in a second.
    per_second: u128,
    /// Added to them, s.
    offset: i64,
}

/// A packet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Packet {
    /// The place of its interface.
    pub interface: usize,
    /// When, ns of UTC.
    pub utc_ns: Option<u64>,
    /// The direction.
    pub direction: Option<Direction>,
    /// It, as far as it was captured.
    pub bytes: Vec<u8>,
}

/// The form of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    PcapNg,
    Pcap,
}

/// A capture that is read once, from its begin to its end.
#[derive(Debug)]
pub struct Capture<R> {
    file: R,
    form: Form,
    is_big: bool,
    interfaces: Vec<Interface>,
    /// The block that was read last.
    block: Vec<u8>,
}

impl<R: Read> Capture<R> {
    /// That in `file`.
    pub fn open(file: R) -> Result<Capture<R>, Wrong> {
        let (interfaces, block) = (Vec::new(), Vec::new());
        let mut capture = Capture { file, form: Form::PcapNg, is_big: false, interfaces, block };
        if !capture.fill(4).map_err(none)? {
            return Err(Wrong::Foreign);
        }
        let first = capture.long(0);
        if first == block::SECTION {
            capture.section().map_err(none)?;
            return Ok(capture);
        }
        let is_pcap = |word: u32| PCAP.iter().position(|known| *known == word);
        let (resolution, is_big) = is_pcap(first)
            .map(|resolution| (resolution, false))
            .or_else(|| Some((is_pcap(first.swap_bytes())?, true)))
            .ok_or(Wrong::Foreign)?;
        (capture.form, capture.is_big) = (Form::Pcap, is_big);
        if !capture.fill(PCAP_HEADER).map_err(none)? {
            return Err(Wrong::Foreign);
        }
        // Above the link type the file says how long the checksum of a frame is.
        let link_type = capture.long(16) as u16;
        let per_second = [1_000_000, 1_000_000_000][resolution];
        let (name, description) = ("0".to_owned(), String::new());
        capture.interfaces.push(Interface { name, description, link_type, per_second, offset: 0 });
        Ok(capture)
    }

    /// The interfaces of this section so far.
    pub fn interfaces(&self) -> &[Interface] {
        &self.interfaces
    }

    /// The next packet; `None` at the end of the file. After an error there is nothing more.
    pub fn next_packet(&mut self) -> Result<Option<Packet>, Wrong> {
        if self.form == Form::Pcap {
            return self.pcap_packet();
        }
        loop {
            if !self.fill(4)? {
                return Ok(None);
            }
            let kind = self.long(0);
            if kind == block::SECTION {
                self.interfaces.clear();
                self.section()?;
                continue;
            }
            self.body(None)?;
            let body = std::mem::take(&mut self.block);
            let packet = match kind {
                block::INTERFACE => {
                    let interface = self.interface(&body).ok_or(Wrong::Damaged("an interface"))?;
                    self.interfaces.push(interface);
                    None
                }
                block::PACKET => Some(self.packet(&body).ok_or(Wrong::Damaged("a packet"))?),
                block::SIMPLE => Some(self.simple(&body).ok_or(Wrong::Damaged("a packet"))?),
                _ => None,
            };
            self.block = body;
            if packet.is_some() {
                return Ok(packet);
            }
        }
    }

    /// Reads so many bytes; false at the end of the file.
    fn fill(&mut self, size: usize) -> Result<bool, Wrong> {
        self.block.clear();
        // Memory is taken for what is there only.
        let read = (&mut self.file).take(size as u64).read_to_end(&mut self.block)?;
        match read {
            0 => Ok(size == 0),
            read if read < size => Err(Wrong::Cut),
            _ => Ok(true),
        }
    }

    /// The word at `at` of what was read; 0 behind it.
    fn long(&self, at: usize) -> u32 {
        word(self.is_big, self.block.get(at..).unwrap_or_default()).unwrap_or(0)
    }

    /// Reads a block behind its kind and, of a section, behind its length and its order: what is before its second
    /// length.
    fn body(&mut self, length: Option<(u32, u32)>) -> Result<(), Wrong> {
        let (length, before) = match length {
            Some(read) => read,
            None if self.fill(4)? => (self.long(0), 8),
            None => return Err(Wrong::Cut),
        };
        if !length.is_multiple_of(4) || !(before + 4..=LONGEST).contains(&length) {
            return Err(Wrong::Damaged("the length of a block"));
        }
        let rest = (length - before) as usize;
        if !self.fill(rest)? {
            return Err(Wrong::Cut);
        }
        if self.long(rest - 4) != length {
            return Err(Wrong::Damaged("the lengths of a block"));
        }
        self.block.truncate(rest - 4);
        Ok(())
    }

    /// Reads the head of a section behind its kind.
    fn section(&mut self) -> Result<(), Wrong> {
        if !self.fill(8)? {
            return Err(Wrong::Cut);
        }
        self.is_big = match (self.block.get(4..).and_then(|order| word(false, order))).unwrap_or(0) {
            ORDER => false,
            order if order == ORDER.swap_bytes() => true,
            _ => return Err(Wrong::Damaged("the header of a section")),
        };
        self.body(Some((self.long(0), 12)))
    }

    fn interface(&self, body: &[u8]) -> Option<Interface> {
        let link_type = half(self.is_big, body)?;
        let mut interface = Interface {
            name: self.interfaces.len().to_string(),
            description: String::new(),
            link_type,
            per_second: 1_000_000,
            offset: 0,
        };
        for (code, value) in options(self.is_big, body.get(8..)?) {
            match (code, value) {
                // For a line on a terminal, whoever wrote the file.
                (option::NAME, name) if !name.is_empty() => {
                    interface.name = String::from_utf8_lossy(name).escape_debug().to_string();
                }
                (option::DESCRIPTION, text) => {
                    interface.description = String::from_utf8_lossy(text).into_owned()
                }
                (option::RESOLUTION, &[by, ..]) => {
                    let base = if by & 0x80 == 0 { 10_u128 } else { 2 };
                    interface.per_second = base.checked_pow(u32::from(by & 0x7F)).unwrap_or(0);
                }
                (option::OFFSET, value) => {
                    let bytes = value.first_chunk().copied()?;
                    interface.offset =
                        if self.is_big { i64::from_be_bytes(bytes) } else { i64::from_le_bytes(bytes) };
                }
                _ => {}
            }
        }
        Some(interface)
    }

    fn packet(&self, body: &[u8]) -> Option<Packet> {
        let long = |at: usize| word(self.is_big, body.get(at..)?);
        let interface = long(0)? as usize;
        let of = self.interfaces.get(interface)?;
        let ticks = u64::from(long(4)?) << 32 | u64::from(long(8)?);
        let mut reader = Reader(body.get(20..)?);
        let bytes = padded(&mut reader, long(12)? as usize)?.to_vec();
        let mut directions = options(self.is_big, reader.0)
            .filter(|(code, _)| *code == option::FLAGS)
            .filter_map(|(_, value)| direction(word(self.is_big, value)?));
        Some(Packet { interface, utc_ns: of.utc_ns(ticks), direction: directions.next(), bytes })
    }

    /// One without a time, of the first interface. How much of it is there, its block says.
    fn simple(&self, body: &[u8]) -> Option<Packet> {
        self.interfaces.first()?;
        let length = word(self.is_big, body)? as usize;
        let bytes = body.get(4..)?;
        let bytes = bytes.get(..length).unwrap_or(bytes).to_vec();
        Some(Packet { interface: 0, utc_ns: None, direction: None, bytes })
    }

    fn pcap_packet(&mut self) -> Result<Option<Packet>, Wrong> {
        if !self.fill(PCAP_PACKET)? {
            return Ok(None);
        }
        let [seconds, fraction, length] = [0, 4, 8].map(|at| self.long(at));
        if length > LONGEST {
            return Err(Wrong::Damaged("the length of a packet"));
        }
        if !self.fill(length as usize)? {
            return Err(Wrong::Cut);
        }
        let Some(of) = self.interfaces.first() else { return Ok(None) };
        let ticks = u64::from(seconds) * of.per_second as u64 + u64::from(fraction);
        let (utc_ns, bytes) = (of.utc_ns(ticks), self.block.clone());
        Ok(Some(Packet { interface: 0, utc_ns, direction: None, bytes }))
    }
}

/// At the beginning of a file nothing of it is known: what is cut or damaged there is no capture.
fn none(wrong: Wrong) -> Wrong {
    if wrong.is_all() { wrong } else { Wrong::Foreign }
}

impl Interface {
    /// A time in its units, ns of UTC; `None`: it has none that can be said.
    fn utc_ns(&self, ticks: u64) -> Option<u64> {
        let ns = (u128::from(ticks) * 1_000_000_000).checked_div(self.per_second)?;
        let ns = i128::try_from(ns).ok()? + i128::from(self.offset) * 1_000_000_000;
        u64::try_from(ns).ok()
    }
}

fn direction(flags: u32) -> Option<Direction> {
    [Direction::Inbound, Direction::Outbound].into_iter().find(|of| *of as u32 == flags & 3)
}

fn half(is_big: bool, bytes: &[u8]) -> Option<u16> {
    let bytes = *bytes.first_chunk()?;
    Some(if is_big { u16::from_be_bytes(bytes) } else { u16::from_le_bytes(bytes) })
}

fn word(is_big: bool, bytes: &[u8]) -> Option<u32> {
    let bytes = *bytes.first_chunk()?;
    Some(if is_big { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
}

/// The next `length` bytes, and their padding; that of the last one may be missing.
fn padded<'a>(reader: &mut Reader<'a>, length: usize) -> Option<&'a [u8]> {
    let bytes = reader.bytes(length)?;
    let padding = length.next_multiple_of(4) - length;
    reader.bytes(padding.min(reader.0.len()))?;
    Some(bytes)
}

/// The options of a block, as far as they are whole.
fn options(is_big: bool, bytes: &[u8]) -> impl Iterator<Item = (u16, &[u8])> {
    let mut reader = Reader(bytes);
    std::iter::from_fn(move || {
        let [code, length] = [half(is_big, reader.bytes(2)?)?, half(is_big, reader.bytes(2)?)?];
        let value = padded(&mut reader, length.into())?;
        (code != option::END).then_some((code, value))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::writer::Writer;

    fn written() -> Vec<u8> {
        let mut writer = Writer::new(Vec::new(), "test 1", "made up").unwrap();
        writer.interface(1, "eth", "linudp-v2", "synthetic").unwrap();
        writer.interface(147, "wire", "profibus-dp", "").unwrap();
        writer.packet(0, 1_790_000_000_123_456_789, Direction::Outbound, &[1, 2, 3]).unwrap();
        writer.packet(1, 7, Direction::Inbound, &[]).unwrap();
        let (packets, bytes) = writer.finish().unwrap();
        assert_eq!(packets, 2);
        bytes
    }

    fn read(bytes: &[u8]) -> (Vec<Packet>, Option<Wrong>) {
        let mut packets = Vec::new();
        let mut capture = match Capture::open(bytes) {
            Ok(capture) => capture,
            Err(wrong) => return (packets, Some(wrong)),
        };
        loop {
            match capture.next_packet() {
                Ok(Some(packet)) => packets.push(packet),
                Ok(None) => return (packets, None),
                Err(wrong) => return (packets, Some(wrong)),
            }
        }
    }

    #[test]
    fn a_written_capture_reads_back_equal() {
        let bytes = written();
        let mut capture = Capture::open(&bytes[..]).unwrap();
        let first = Packet {
            interface: 0,
            utc_ns: Some(1_790_000_000_123_456_789),
            direction: Some(Direction::Outbound),
            bytes: vec![1, 2, 3],
        };
        assert_eq!(capture.next_packet().unwrap(), Some(first));
        let names: Vec<_> = capture.interfaces().iter().map(|of| (&*of.name, of.link_type)).collect();
        assert_eq!(names, [("eth", 1), ("wire", 147)]);
        let second = capture.next_packet().unwrap().unwrap();
        assert_eq!((second.direction, second.bytes.len()), (Some(Direction::Inbound), 0));
        assert_eq!(capture.next_packet().unwrap(), None);
    }

    #[test]
    fn big_endian_sections_and_unknown_blocks_are_read() {
        let mut bytes = Vec::new();
        let mut block = |kind: u32, body: &[u8]| {
            let length = (body.len() as u32 + 12).to_be_bytes();
            bytes.extend([&kind.to_be_bytes()[..], &length, body, &length].concat());
        };
        block(block::SECTION, &[0x1A, 0x2B, 0x3C, 0x4D, 0, 1, 0, 0, 255, 255, 255, 255, 255, 255, 255, 255]);
        block(5, &[0; 12]);
        // Times in 2^-1 s, one second later.
        let interface =
            [0, 1, 0, 0, 0, 0, 0, 0, 0, 9, 0, 1, 0x81, 0, 0, 0, 0, 14, 0, 8, 0, 0, 0, 0, 0, 0, 0, 1];
        block(block::INTERFACE, &interface);
        block(
            block::PACKET,
            &[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 2, 0, 0, 0, 9, 8, 7, 0, 0, 0, 2, 0, 4, 0, 0, 0, 1],
        );
        block(block::SIMPLE, &[0, 0, 0, 1, 5, 0, 0, 0]);
        let (packets, wrong) = read(&bytes);
        assert!(wrong.is_none(), "{wrong:?}");
        let [first, second] = &packets[..] else { panic!("{packets:?}") };
        assert_eq!((first.utc_ns, first.direction), (Some(2_500_000_000), Some(Direction::Inbound)));
        assert_eq!((&first.bytes[..], &second.bytes[..], second.utc_ns), (&[8, 7][..], &[5][..], None));
    }

    #[test]
    fn classic_files_of_both_orders_are_read() {
        for (is_big, magic, ns) in [
            (false, PCAP[0], 3_000_000_007_000),
            (true, PCAP[0], 3_000_000_007_000),
            (true, PCAP[1], 3_000_000_000_007),
        ] {
            let word = |word: u32| if is_big { word.to_be_bytes() } else { word.to_le_bytes() };
            let words = [magic, 0, 0, 0, 65_535, 1, 3_000, 7, 2, 60];
            let bytes = [words.map(word).concat(), vec![4, 5]].concat();
            let (packets, wrong) = read(&bytes);
            assert!(wrong.is_none(), "{wrong:?}");
            assert_eq!((packets[0].utc_ns, &packets[0].bytes[..]), (Some(ns), &[4, 5][..]));
            let (packets, wrong) = read(&bytes[..bytes.len() - 1]);
            assert!(packets.is_empty() && matches!(wrong, Some(Wrong::Cut)), "{wrong:?}");
        }
    }

    #[test]
    fn a_file_that_was_cut_anywhere_is_read_up_to_there_and_what_is_none_is_refused() {
        let bytes = written();
        let whole = read(&bytes).0;
        let ends = [whole.len()];
        for length in 0..bytes.len() {
            let (packets, wrong) = read(&bytes[..length]);
            assert!(whole.starts_with(&packets));
            // Between two blocks it is whole.
            assert!(wrong.is_some() || packets.len() < ends[0], "{length}");
        }
        for none in [&b""[..], b"notes", &[0xD4, 0xC3], &bytes[4..]] {
            assert!(matches!(read(none).1, Some(Wrong::Foreign)), "{none:?}");
        }
    }

    #[test]
    fn no_bytes_make_it_panic() {
        let mut random = fastrand::Rng::with_seed(9);
        let whole = written();
        for _ in 0..20_000 {
            let mut bytes = whole.clone();
            for _ in 0..random.usize(1..5) {
                let at = random.usize(..bytes.len());
                bytes[at] = *random.choice(&[0, 1, 4, 0x7F, 0x80, 0xFF]).unwrap();
            }
            read(&bytes);
        }
    }
}
