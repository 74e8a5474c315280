//! The container of a recording: MCAP, in compressed chunks with an index each, so that a file can be read up to its
//! last whole chunk whatever becomes of the program. The library writes each number of a message on its own, to all
//! checksums, and compresses with C: here a message is encoded where it stands in its chunk.

use std::collections::BTreeMap;
use std::io::{self, Write};

use crc32fast::Hasher;
use mcap::MAGIC;
use mcap::records::op;

use super::lz4;

/// A chunk ends after so many bytes.
const CHUNK_BYTES: usize = 8 << 20;

/// A file while it is written.
pub struct Container<W> {
    out: W,
    /// The number of bytes that are written, and their checksum.
    at: u64,
    checksum: Hasher,
    /// The records that stand at its end again.
    schemas: Vec<Vec<u8>>,
    channels: Vec<Channel>,
    metadata: Vec<u8>,
    metadata_count: u32,
    /// The chunk that is being filled: its records, and when its messages begin and end.
    chunk: Vec<u8>,
    times: Option<(u64, u64)>,
    /// When all messages begin and end.
    all_times: Option<(u64, u64)>,
    /// The chunks so far.
    chunks: Vec<Chunk>,
    /// The number of messages of each channel in each of them.
    counts: Vec<u32>,
    /// The bytes that are written next.
    record: Vec<u8>,
}

/// A channel: its record, the places of its messages in the chunk, as they stand in its index, and their count.
struct Channel {
    record: Vec<u8>,
    index: Vec<u8>,
    messages: u64,
}

/// A chunk that was written.
struct Chunk {
    times: (u64, u64),
    start: u64,
    length: u64,
    bytes: u64,
    compressed: u64,
    /// The number of channels at that time.
    channels: usize,
}

/// Bytes of an entry of an index, and of an index besides its entries.
const INDEX_ENTRY: u64 = 16;
const INDEX: u64 = 15;

/// Bytes of a chunk in the summary, about, and of a topic that it has.
const INDEX_OF_CHUNK: usize = 100;
const INDEX_OF_TOPIC: usize = 10;

/// The summary is written in pieces of so many bytes.
const PIECE: usize = 1 << 20;

/// Of a record before its content: opcode and length.
const LENGTH: usize = 9;

/// Of a message before that of its own: channel, sequence and two times.
const MESSAGE: usize = 22;

/// Appends a record, whose content `content` appends.
fn record(out: &mut Vec<u8>, opcode: u8, content: impl FnOnce(&mut Vec<u8>)) {
    out.extend_from_slice(&[opcode, 0, 0, 0, 0, 0, 0, 0, 0]);
    let begin = out.len();
    content(out);
    end_record(out, begin);
}

/// The content of the last record, which begins there, is complete.
fn end_record(out: &mut [u8], begin: usize) {
    let length = (out.len() - begin) as u64;
    out[begin - size_of::<u64>()..begin].copy_from_slice(&length.to_le_bytes());
}

fn put_u16(out: &mut Vec<u8>, number: u16) {
    out.extend_from_slice(&number.to_le_bytes());
}

fn put_u32(out: &mut Vec<u8>, number: u32) {
    out.extend_from_slice(&number.to_le_bytes());
}

fn put_u64(out: &mut Vec<u8>, number: u64) {
    out.extend_from_slice(&number.to_le_bytes());
}

/// Appends bytes with their length before them.
fn put_bytes(out: &mut Vec<u8>, bytes: &[u8]) {
    put_u32(out, bytes.len() as u32);
    out.extend_from_slice(bytes);
}

fn put_text(out: &mut Vec<u8>, text: &str) {
    put_bytes(out, text.as_bytes());
}

fn put_map(out: &mut Vec<u8>, map: &BTreeMap<String, String>) {
    let mut all = Vec::new();
    for (key, value) in map {
        put_text(&mut all, key);
        put_text(&mut all, value);
    }
    put_bytes(out, &all);
}

/// Appends the numbers of channels that are not 0.
fn put_numbers(out: &mut Vec<u8>, numbers: impl Iterator<Item = (u16, u64)>) {
    let mut all = Vec::new();
    for (channel, number) in numbers.filter(|(_, number)| *number > 0) {
        put_u16(&mut all, channel);
        put_u64(&mut all, number);
    }
    put_bytes(out, &all);
}

impl<W> std::fmt::Debug for Container<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Container").field("at", &self.at).finish_non_exhaustive()
    }
}

impl<W: Write> Container<W> {
    /// Begins a file.
    pub fn begin(out: W) -> io::Result<Container<W>> {
        let mut file = Container {
            out,
            at: 0,
            checksum: Hasher::new(),
            schemas: Vec::new(),
            channels: Vec::new(),
            metadata: Vec::new(),
            metadata_count: 0,
            chunk: Vec::new(),
            times: None,
            all_times: None,
            chunks: Vec::new(),
            counts: Vec::new(),
            record: Vec::new(),
        };
        file.record.extend_from_slice(MAGIC);
        record(&mut file.record, op::HEADER, |out| {
            put_text(out, "");
            put_text(out, concat!("fieldbeat ", env!("CARGO_PKG_VERSION")));
        });
        file.write()?;
        Ok(file)
    }

    /// Writes what is in `record`.
    fn write(&mut self) -> io::Result<()> {
        self.out.write_all(&self.record)?;
        self.checksum.update(&self.record);
        self.at += self.record.len() as u64;
        self.record.clear();
        Ok(())
    }

    /// Writes metadata behind what was entered before.
    pub fn metadata(&mut self, name: &str, map: &BTreeMap<String, String>) -> io::Result<()> {
        self.end_chunk()?;
        record(&mut self.record, op::METADATA, |out| {
            put_text(out, name);
            put_map(out, map);
        });
        record(&mut self.metadata, op::METADATA_INDEX, |out| {
            put_u64(out, self.at);
            put_u64(out, self.record.len() as u64);
            put_text(out, name);
        });
        self.metadata_count += 1;
        self.write()
    }

    /// One more channel, whose messages in Protocol Buffers have the type `name` of `descriptor`.
    pub fn channel(
        &mut self,
        topic: &str,
        about: &BTreeMap<String, String>,
        name: &str,
        descriptor: &[u8],
    ) -> io::Result<u16> {
        let content = |out: &mut Vec<u8>| {
            put_text(out, name);
            put_text(out, "protobuf");
            put_bytes(out, descriptor);
        };
        let mut schema = Vec::new();
        content(&mut schema);
        // Behind its number.
        let known = self.schemas.iter().position(|known| known[LENGTH + size_of::<u16>()..] == schema);
        let place = known.unwrap_or(self.schemas.len());
        let (Ok(schema), Ok(channel)) = (u16::try_from(place + 1), u16::try_from(self.channels.len() + 1))
        else {
            return Err(io::Error::other("there are too many topics for a recording"));
        };
        if known.is_none() {
            let mut whole = Vec::new();
            record(&mut whole, op::SCHEMA, |out| {
                put_u16(out, schema);
                content(out);
            });
            self.chunk.extend_from_slice(&whole);
            self.schemas.push(whole);
        }
        let mut whole = Vec::new();
        record(&mut whole, op::CHANNEL, |out| {
            put_u16(out, channel);
            put_u16(out, schema);
            put_text(out, topic);
            put_text(out, "protobuf");
            put_map(out, about);
        });
        self.chunk.extend_from_slice(&whole);
        self.channels.push(Channel { record: whole, index: Vec::new(), messages: 0 });
        Ok(channel)
    }

    /// A message of a channel at an instant, whose content `content` appends.
    pub fn message(
        &mut self,
        channel: u16,
        sequence: u32,
        at: u64,
        content: impl FnOnce(&mut Vec<u8>),
    ) -> io::Result<()> {
        if self.chunk.len() > CHUNK_BYTES {
            self.end_chunk()?;
        }
        let of = &mut self.channels[usize::from(channel) - 1];
        let place = (self.chunk.len() as u64).to_le_bytes();
        let time = at.to_le_bytes();
        let mut entry = [0; INDEX_ENTRY as usize];
        entry[..8].copy_from_slice(&time);
        entry[8..].copy_from_slice(&place);
        of.index.extend_from_slice(&entry);
        let (from, to) = self.times.get_or_insert((at, at));
        (*from, *to) = (at.min(*from), at.max(*to));
        let begin = self.chunk.len() + LENGTH;
        let mut head = [0; LENGTH + MESSAGE];
        head[0] = op::MESSAGE;
        head[9..11].copy_from_slice(&channel.to_le_bytes());
        head[11..15].copy_from_slice(&sequence.to_le_bytes());
        head[15..23].copy_from_slice(&time);
        head[23..].copy_from_slice(&time);
        self.chunk.extend_from_slice(&head);
        content(&mut self.chunk);
        end_record(&mut self.chunk, begin);
        Ok(())
    }

    /// Ends the chunk, and lets go of it.
    pub fn flush(&mut self) -> io::Result<()> {
        self.end_chunk()?;
        self.out.flush()
    }

    fn end_chunk(&mut self) -> io::Result<()> {
        if self.chunk.is_empty() {
            return Ok(());
        }
        let times = self.times.take();
        if let Some((from, to)) = times {
            let (first, last) = self.all_times.get_or_insert((from, to));
            (*first, *last) = (from.min(*first), to.max(*last));
        }
        let (from, to) = times.unwrap_or_default();
        let mut compressed = 0;
        record(&mut self.record, op::CHUNK, |out| {
            put_u64(out, from);
            put_u64(out, to);
            put_u64(out, self.chunk.len() as u64);
            put_u32(out, crc32fast::hash(&self.chunk));
            put_text(out, lz4::NAME);
            let head = out.len();
            put_u64(out, 0);
            let begin = out.len();
            lz4::compress(&self.chunk, out);
            compressed = (out.len() - begin) as u64;
            out[head..begin].copy_from_slice(&compressed.to_le_bytes());
        });
        self.chunks.push(Chunk {
            times: (from, to),
            start: self.at,
            length: self.record.len() as u64,
            bytes: self.chunk.len() as u64,
            compressed,
            channels: self.channels.len(),
        });
        for (number, channel) in (1..).zip(&mut self.channels) {
            let count = channel.index.len() as u64 / INDEX_ENTRY;
            self.counts.push(count as u32);
            channel.messages += count;
            if count > 0 {
                record(&mut self.record, op::MESSAGE_INDEX, |out| {
                    put_u16(out, number);
                    put_bytes(out, &channel.index);
                });
                channel.index.clear();
            }
        }
        self.chunk.clear();
        self.write()
    }

    /// Writes a group of records of the summary. `groups` gets where it stands.
    fn end_group(&mut self, opcode: u8, groups: &mut Vec<u8>) -> io::Result<()> {
        self.end_group_from(self.at, opcode, groups)
    }

    /// The same of a group that began there, and of which a part is written already.
    fn end_group_from(&mut self, start: u64, opcode: u8, groups: &mut Vec<u8>) -> io::Result<()> {
        self.write()?;
        if self.at > start {
            record(groups, op::SUMMARY_OFFSET, |out| {
                out.push(opcode);
                put_u64(out, start);
                put_u64(out, self.at - start);
            });
        }
        Ok(())
    }

    /// About how many bytes the end of the file has.
    pub fn summary(&self) -> u64 {
        (INDEX_OF_CHUNK * self.chunks.len() + INDEX_OF_TOPIC * self.counts.len()) as u64
    }

    /// Ends the file. Returns what it was written to.
    pub fn finish(mut self) -> io::Result<W> {
        self.end_chunk()?;
        let checksum = std::mem::take(&mut self.checksum).finalize();
        record(&mut self.record, op::DATA_END, |out| put_u32(out, checksum));
        self.write()?;
        // From here on that of the summary.
        self.checksum = Hasher::new();
        let (start, mut groups) = (self.at, Vec::new());
        self.record.extend(self.schemas.concat());
        self.end_group(op::SCHEMA, &mut groups)?;
        self.channels.iter().for_each(|channel| self.record.extend_from_slice(&channel.record));
        self.end_group(op::CHANNEL, &mut groups)?;
        record(&mut self.record, op::STATISTICS, |out| {
            let (first, last) = self.all_times.unwrap_or_default();
            put_u64(out, self.channels.iter().map(|channel| channel.messages).sum());
            put_u16(out, self.schemas.len() as u16);
            put_u32(out, self.channels.len() as u32);
            put_u32(out, 0);
            put_u32(out, self.metadata_count);
            put_u32(out, self.chunks.len() as u32);
            put_u64(out, first);
            put_u64(out, last);
            put_numbers(out, (1..).zip(self.channels.iter().map(|channel| channel.messages)));
        });
        self.end_group(op::STATISTICS, &mut groups)?;
        let begin = self.at;
        let (chunks, all_counts) = (std::mem::take(&mut self.chunks), std::mem::take(&mut self.counts));
        let mut counts = &all_counts[..];
        for chunk in &chunks {
            let (of, rest) = counts.split_at(chunk.channels);
            counts = rest;
            chunk.put_index(of, &mut self.record);
            if self.record.len() > PIECE {
                self.write()?;
            }
        }
        self.end_group_from(begin, op::CHUNK_INDEX, &mut groups)?;
        self.record.append(&mut self.metadata);
        self.end_group(op::METADATA_INDEX, &mut groups)?;
        let offsets = self.at;
        self.record.append(&mut groups);
        record(&mut self.record, op::FOOTER, |out| {
            put_u64(out, start);
            put_u64(out, offsets);
            put_u32(out, 0);
        });
        // Of all before it.
        let end = self.record.len() - size_of::<u32>();
        self.checksum.update(&self.record[..end]);
        let checksum = self.checksum.clone().finalize();
        self.record[end..].copy_from_slice(&checksum.to_le_bytes());
        self.record.extend_from_slice(MAGIC);
        self.write()?;
        self.out.flush()?;
        Ok(self.out)
    }
}

impl Chunk {
    /// Appends its record of the summary; it has so many messages of each channel.
    fn put_index(&self, counts: &[u32], out: &mut Vec<u8>) {
        let begin = self.start + self.length;
        let mut end = begin;
        let mut places = Vec::new();
        for (channel, count) in (1..).zip(counts).filter(|(_, count)| **count > 0) {
            places.push((channel, end));
            end += INDEX + INDEX_ENTRY * u64::from(*count);
        }
        record(out, op::CHUNK_INDEX, |out| {
            put_u64(out, self.times.0);
            put_u64(out, self.times.1);
            put_u64(out, self.start);
            put_u64(out, self.length);
            put_numbers(out, places.into_iter());
            put_u64(out, end - begin);
            put_text(out, lz4::NAME);
            put_u64(out, self.compressed);
            put_u64(out, self.bytes);
        });
    }
}
