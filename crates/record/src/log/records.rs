//! The records of a recording, one after the other, for replays and exports: as far as they are sound.
//!
//! A chunk is read once its checksum is right. Those of the file, and the count of its messages, stand at its end: all
//! that can be read is given before an error of them.

use std::io::{ErrorKind, Read};

use mcap::McapError;
use mcap::records::{Record, Statistics, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use super::layout::LONGEST_RECORD;
use crate::recording::lz4::Decoder;

/// The mistake in a file.
#[derive(thiserror::Error)]
pub enum Unsound {
    /// Of the library.
    #[error(transparent)]
    Mcap(#[from] McapError),
    /// Something in a record is longer than the record.
    #[error("a length in it is broken")]
    Length,
    /// A record that does not belong there.
    #[error("its parts are not in their order")]
    Order,
    /// Messages are missing, or there twice.
    #[error("it has {0} messages, and counts {1}")]
    Count(u64, u64),
}
fieldbeat_core::debug_as_display!(Unsound);

impl Unsound {
    /// It is known at the end only: nobody knows where it is.
    pub(crate) fn is_somewhere(&self) -> bool {
        matches!(self, Unsound::Mcap(McapError::BadDataCrc { .. }) | Unsound::Count(..))
    }
}

/// The records of a file.
pub struct Records<R> {
    file: R,
    reader: LinearReader,
    place: Place,
    is_over: bool,
}

impl<R> std::fmt::Debug for Records<R> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Records").field("place", &self.place).finish_non_exhaustive()
    }
}

impl<R: Read> Records<R> {
    /// Those of `file`, from its begin.
    pub fn new(file: R) -> Records<R> {
        let options = LinearReaderOptions::default()
            .with_check_finishes_after_end_magic(true)
            .with_validate_chunk_crcs(true)
            // Before any of its messages is taken for true.
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_record_length_limit(LONGEST_RECORD);
        let mut reader = LinearReader::new_with_options(options);
        reader.add_decompressor(Decoder::default()).expect("it has a name");
        Records { file, reader, place: Place::default(), is_over: false }
    }

    /// The first result that `take` gives for one of the next records; `None` at the end of a whole
    /// file. After an error there is nothing more.
    pub fn find<T, E: From<Unsound>>(
        &mut self,
        take: impl FnMut(Record<'_>) -> Result<Option<T>, E>,
    ) -> Result<Option<T>, E> {
        if self.is_over {
            return Ok(None);
        }
        let found = self.read(take);
        self.is_over = !matches!(found, Ok(Some(_)));
        found
    }

    fn read<T, E: From<Unsound>>(
        &mut self,
        mut take: impl FnMut(Record<'_>) -> Result<Option<T>, E>,
    ) -> Result<Option<T>, E> {
        let Records { file, reader, place, .. } = self;
        while let Some(event) = reader.next_event() {
            let record = match event {
                Ok(LinearReadEvent::ReadRequest(wanted)) => {
                    let read = loop {
                        match file.read(reader.insert(wanted)) {
                            Err(why) if why.kind() == ErrorKind::Interrupted => {}
                            read => break read,
                        }
                    };
                    reader.notify_read(read.map_err(|why| Unsound::Mcap(why.into()))?);
                    continue;
                }
                Ok(LinearReadEvent::Record { data, opcode }) => place.enter(opcode, data)?,
                // Only a file that begins without it is none.
                Err(McapError::BadMagic) if place.part == Part::Behind => return Err(Unsound::Order.into()),
                // A footer before the end of the data has the checksum of something else.
                Err(McapError::BadSummaryCrc { .. }) if place.part == Part::Data => {
                    return Err(Unsound::Order.into());
                }
                Err(why) => return Err(Unsound::Mcap(why).into()),
            };
            if let Some(found) = record.map(&mut take).transpose()?.flatten() {
                return Ok(Some(found));
            }
        }
        Ok(None)
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Part {
    #[default]
    Data,
    Summary,
    /// Behind the footer.
    Behind,
}

/// Where in the file a reader is.
#[derive(Debug, Default)]
struct Place {
    part: Part,
    messages: u64,
}

impl Place {
    /// The next record, if it is one that somebody reads.
    fn enter<'a>(&mut self, opcode: u8, data: &'a [u8]) -> Result<Option<Record<'a>>, Unsound> {
        match (self.part, opcode) {
            (Part::Data, op::DATA_END) => self.part = Part::Summary,
            (Part::Summary, op::FOOTER) => self.part = Part::Behind,
            (Part::Data, op::MESSAGE) => {
                self.messages += 1;
                return Ok(Some(mcap::parse_record(opcode, data)?));
            }
            (Part::Data, op::SCHEMA | op::CHANNEL | op::METADATA) => {
                lengths_fit(opcode, data).ok_or(Unsound::Length)?;
                return Ok(Some(mcap::parse_record(opcode, data)?));
            }
            (Part::Summary, op::STATISTICS) => {
                if let Record::Statistics(Statistics { message_count, .. }) =
                    mcap::parse_record(opcode, data)?
                    && message_count != self.messages
                {
                    return Err(Unsound::Count(self.messages, message_count));
                }
            }
            // No record begins with 0: a hole in a file is not read to its end.
            (Part::Behind, _) | (Part::Data, op::FOOTER) | (_, 0) => return Err(Unsound::Order),
            (Part::Summary, op::HEADER | op::MESSAGE | op::MESSAGE_INDEX | op::ATTACHMENT)
            | (Part::Summary, op::METADATA | op::DATA_END) => return Err(Unsound::Order),
            _ => {}
        }
        Ok(None)
    }
}

/// `None`: a text or a map in a record is longer than the record. The library takes memory for a text before it looks
/// for its bytes.
fn lengths_fit(opcode: u8, record: &[u8]) -> Option<()> {
    /// The bytes behind a text, or behind a map.
    fn skip(from: &[u8]) -> Option<(&[u8], &[u8])> {
        let (length, rest) = from.split_first_chunk()?;
        rest.split_at_checked(u32::from_le_bytes(*length).try_into().ok()?)
    }
    let (texts, has_map, numbers) = match opcode {
        op::SCHEMA => (2, false, 2),
        op::CHANNEL => (2, true, 4),
        op::METADATA => (1, true, 0),
        _ => return Some(()),
    };
    let mut rest = record.get(numbers..)?;
    for _ in 0..texts {
        (_, rest) = skip(rest)?;
    }
    if has_map {
        let (mut map, _) = skip(rest)?;
        while !map.is_empty() {
            (_, map) = skip(map)?;
        }
    }
    Some(())
}

/// In words.
impl From<Unsound> for String {
    fn from(why: Unsound) -> String {
        let Unsound::Mcap(why) = why else { return why.to_string() };
        match why {
            McapError::Io(why) => why.to_string(),
            McapError::BadMagic => "it is no MCAP file".into(),
            McapError::UnexpectedEof => "it ends within a record".into(),
            McapError::UnsupportedCompression(by) => {
                format!("its chunks are compressed ({by}): `mcap decompress` undoes that")
            }
            McapError::RecordTooLarge { .. } => Unsound::Length.to_string(),
            McapError::BadChunkCrc { .. } | McapError::DecompressionError(_) => {
                "a part of it has other bytes than were written".into()
            }
            McapError::BadDataCrc { .. } => {
                "somewhere before its end it has other bytes than were written".into()
            }
            McapError::BadSummaryCrc { .. } => "its summary has other bytes than were written".into(),
            other => other.to_string(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(text: &str) -> Vec<u8> {
        [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat()
    }

    fn map(texts: &[&str]) -> Vec<u8> {
        let inner: Vec<u8> = texts.iter().flat_map(|inner| text(inner)).collect();
        [&(inner.len() as u32).to_le_bytes(), &inner[..]].concat()
    }

    /// With the places of all lengths in it.
    fn examples() -> [(u8, Vec<u8>, Vec<usize>); 3] {
        let schema = [&[1, 0][..], &text("Axis"), &text("protobuf"), &[3, 0, 0, 0, 7, 8, 9]].concat();
        let channel =
            [&[1, 0, 1, 0][..], &text("/x"), &text("json"), &map(&["unit", "mm", "a", ""])].concat();
        let metadata = [text("fieldbeat"), map(&["period_ns", "1000000"])].concat();
        [
            (op::SCHEMA, schema, vec![2, 10]),
            (op::CHANNEL, channel, vec![4, 10, 18, 22, 30, 36, 41]),
            (op::METADATA, metadata, vec![0, 13, 17, 30]),
        ]
    }

    #[test]
    fn a_length_beyond_its_record_is_refused_before_memory_is_taken_for_it() {
        for (opcode, record, lengths) in examples() {
            assert!(Place::default().enter(opcode, &record).unwrap().is_some(), "{opcode}");
            for place in lengths {
                for bit in 24..32 {
                    let mut broken = record.clone();
                    broken[place + bit / 8] ^= 1 << (bit % 8);
                    let refused = Place::default().enter(opcode, &broken);
                    assert!(matches!(refused, Err(Unsound::Length)), "{opcode}, {place}: {refused:?}");
                }
            }
        }
    }

    #[test]
    fn a_record_that_was_cut_anywhere_is_refused() {
        for (opcode, record, _) in examples() {
            for length in 0..record.len() {
                assert!(Place::default().enter(opcode, &record[..length]).is_err(), "{opcode}, {length}");
            }
        }
    }
}
