//! Reads the messages of a recording by the description that stands in the file, whichever version of the program wrote
//! it.

use std::collections::{BTreeMap, HashMap};
use std::fs::{File, OpenOptions};
use std::io::{self, BufReader, Cursor, Read, Seek, SeekFrom};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::rc::Rc;

use mcap::read::ChannelAccumulator;
use mcap::records::{MessageHeader, Record};
use mcap::{MAGIC, McapError};
use prost_reflect::{
    DescriptorPool, DynamicMessage, FieldDescriptor, Kind, MessageDescriptor, ReflectMessage, Value,
};
use thiserror::Error;

use super::machine::{FORMAT, MACHINE};
use super::schema::{PACKAGE, identifier};
use crate::log::layout::TOPIC;
use crate::log::records::{Records, Unsound};

/// The most bytes of a file's description of its machine: the most of it is the text of the configuration.
const MOST_ABOUT: u64 = 16 << 20;

/// A recording that is read once, from its begin to its end.
pub struct Reading {
    records: Records<Box<dyn Read>>,
    topics: Topics,
    seen: bool,
    /// It was read as far as possible.
    ended: bool,
}

/// The topics of a recording.
#[derive(Default)]
struct Topics {
    channels: ChannelAccumulator<'static>,
    /// By the number of its channel.
    known: HashMap<u16, Option<Rc<Topic>>>,
}

impl std::fmt::Debug for Reading {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Reading").field("ended", &self.ended).finish_non_exhaustive()
    }
}

/// A topic of ours.
#[derive(Debug)]
pub struct Topic {
    /// The name.
    pub name: String,
    /// Units, among others.
    pub about: HashMap<String, String>,
    descriptor: MessageDescriptor,
}

/// A message.
#[derive(Debug)]
pub struct Entry {
    /// The topic.
    pub topic: Rc<Topic>,
    /// When, ns of UTC.
    pub utc_ns: u64,
    message: DynamicMessage,
}

/// The mistake in a recording.
#[derive(Error)]
pub enum Wrong {
    /// The operating system refused.
    #[error("{0}; name a recording that this user may read (*.mcap)")]
    Io(#[from] io::Error),
    /// No MCAP, or of somebody else.
    #[error("not a recording of fieldbeat; name one (*.mcap)")]
    Foreign,
    /// The end is missing: the program was killed, or its disk was full.
    #[error("its end is missing, as of a program that was killed")]
    Cut,
    /// Changed.
    #[error("it is damaged ({0})")]
    Damaged(String),
    /// The same, but nobody knows where: its end says so.
    #[error("it is damaged ({0})")]
    Somewhere(String),
    /// The messages may mean something else: the version of the program that wrote it, and that of its format.
    #[error(
        "it was recorded by version {0} (format {1}): read it with that one, this is {this}",
        this = env!("CARGO_PKG_VERSION")
    )]
    Format(String, String),
    /// By another tool, and not with LZ4.
    #[error("its chunks are compressed ({0}): `mcap decompress` reads them")]
    Compressed(String),
}
fieldbeat_core::debug_as_display!(Wrong);

impl Wrong {
    /// Nothing of it could be read.
    pub fn is_all(&self) -> bool {
        matches!(self, Wrong::Io(_) | Wrong::Foreign | Wrong::Format(..) | Wrong::Compressed(_))
    }

    /// In words, with how much of the recording was exported.
    pub fn exported(&self) -> String {
        let what = match self {
            Wrong::Cut => ": what is there was exported",
            Wrong::Damaged(_) => ": what is before that was exported",
            Wrong::Somewhere(_) => ": what can be read was exported",
            Wrong::Io(_) | Wrong::Foreign | Wrong::Format(..) | Wrong::Compressed(_) => "",
        };
        format!("{self}{what}")
    }
}

impl From<Unsound> for Wrong {
    fn from(error: Unsound) -> Wrong {
        match error {
            error if error.is_somewhere() => Wrong::Somewhere(error.to_string()),
            Unsound::Mcap(error) => match error {
                McapError::Io(error) => Wrong::Io(error),
                McapError::BadMagic => Wrong::Foreign,
                McapError::UnexpectedEof | McapError::UnexpectedEoc => Wrong::Cut,
                McapError::UnsupportedCompression(by) => Wrong::Compressed(by),
                other => Wrong::Damaged(other.to_string()),
            },
            other => Wrong::Damaged(other.to_string()),
        }
    }
}

impl From<McapError> for Wrong {
    fn from(error: McapError) -> Wrong {
        Unsound::from(error).into()
    }
}

impl Reading {
    /// A file.
    pub fn open(path: &Path) -> Result<Reading, Wrong> {
        Ok(Reading::new(Box::new(BufReader::with_capacity(1 << 20, open(path)?))))
    }

    /// The bytes of a file.
    pub fn of(bytes: Vec<u8>) -> Reading {
        Reading::new(Box::new(Cursor::new(bytes)))
    }

    fn new(source: Box<dyn Read>) -> Reading {
        Reading { records: Records::new(source), topics: Topics::default(), seen: false, ended: false }
    }
}

impl Topics {
    /// The entry of a record, if it is a message of ours.
    fn enter(&mut self, record: Record<'_>) -> Result<Option<Entry>, Wrong> {
        match record {
            Record::Schema { header, data } => self.channels.add_schema_from_slice(header, &data)?,
            Record::Channel(channel) => self.channels.add_channel(channel)?,
            Record::Metadata(of) if of.name == MACHINE => require_format(&of.metadata)?,
            Record::Message { header, data } => return self.entry(&header, &data),
            _ => {}
        }
        Ok(None)
    }

    /// The topic of a channel, unless it is that of somebody else, or the log of the loop.
    fn topic(&mut self, header: &MessageHeader) -> Result<Option<Rc<Topic>>, Wrong> {
        let &MessageHeader { channel_id: id, sequence, .. } = header;
        if let Some(known) = self.known.get(&id) {
            return Ok(known.clone());
        }
        let channel = self.channels.get(id).ok_or(McapError::UnknownChannel(sequence, id))?;
        let is_ours = |name: &str| name.strip_prefix(PACKAGE).is_some_and(|rest| rest.starts_with('.'));
        let schema = channel.schema.as_ref().filter(|schema| is_ours(&schema.name) && channel.topic != TOPIC);
        let topic = match schema {
            Some(schema) => {
                let damaged = || Wrong::Damaged(format!("the description of {}", channel.topic));
                let pool = DescriptorPool::decode(&*schema.data).map_err(|_| damaged())?;
                let descriptor = pool.get_message_by_name(&schema.name).ok_or_else(damaged)?;
                let about = channel.metadata.clone().into_iter().collect();
                Some(Rc::new(Topic { name: channel.topic.clone(), about, descriptor }))
            }
            None => None,
        };
        self.known.insert(id, topic.clone());
        Ok(topic)
    }

    fn entry(&mut self, header: &MessageHeader, data: &[u8]) -> Result<Option<Entry>, Wrong> {
        let Some(topic) = self.topic(header)? else { return Ok(None) };
        let decoded = DynamicMessage::decode(topic.descriptor.clone(), data);
        let decoded = decoded.map_err(|error| Wrong::Damaged(error.to_string()))?;
        Ok(Some(Entry { topic, utc_ns: header.log_time, message: decoded }))
    }
}

/// Refuses what says to be of another format; files of others do not say it.
fn require_format(about: &BTreeMap<String, String>) -> Result<(), Wrong> {
    // For a line on a terminal, whoever wrote the file.
    let text = |key: &str| about.get(key).map(|text| text.escape_debug().to_string());
    match text("format") {
        Some(format) if format != FORMAT => {
            Err(Wrong::Format(text("program").unwrap_or("?".to_owned()), format))
        }
        _ => Ok(()),
    }
}

/// Opens a file that begins like one.
fn open(path: &Path) -> Result<File, Wrong> {
    // A pipe is not waited for.
    let mut file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK).open(path)?;
    if !file.metadata()?.is_file() || !has_magic(&mut file)? {
        return Err(Wrong::Foreign);
    }
    Ok(file)
}

/// Whether what a file begins and ends with is there; it is at its begin afterwards.
fn has_magic(file: &mut File) -> Result<bool, Wrong> {
    let mut magic = [0; MAGIC.len()];
    file.read_exact(&mut magic).map_err(|_| Wrong::Foreign)?;
    file.rewind()?;
    Ok(magic == *MAGIC)
}

/// The description of a file's machine, which stands at its begin. All else of it is not read, but that its end is
/// there.
pub fn about(path: &Path) -> Result<BTreeMap<String, String>, Wrong> {
    let mut file = open(path)?;
    file.seek(SeekFrom::End(-(MAGIC.len() as i64)))?;
    if !has_magic(&mut file)? {
        return Err(Wrong::Cut);
    }
    let found = Records::new(file.take(MOST_ABOUT)).find(|record| match record {
        Record::Metadata(of) if of.name == MACHINE => {
            require_format(&of.metadata)?;
            Ok(Some(of.metadata))
        }
        Record::Message { .. } => Err(Wrong::Foreign),
        _ => Ok(None),
    });
    match found {
        // Its end is there.
        Ok(None) | Err(Wrong::Cut) => Err(Wrong::Foreign),
        Ok(Some(about)) => Ok(about),
        Err(wrong) => Err(wrong),
    }
}

/// Messages of others in the same file are passed over, and so is the log of the loop.
impl Iterator for Reading {
    type Item = Result<Entry, Wrong>;

    fn next(&mut self) -> Option<Result<Entry, Wrong>> {
        if self.ended {
            return None;
        }
        let next = self.records.find(|record| self.topics.enter(record)).transpose();
        // A recording of nothing is one; a file of others' messages is none.
        let next = next.or((!self.seen).then_some(Err(Wrong::Foreign)));
        let has_more = matches!(next, Some(Ok(_)));
        (self.seen, self.ended) = (self.seen || has_more, !has_more);
        next
    }
}

impl Topic {
    /// The names of its fields, in their order.
    pub fn fields(&self) -> impl Iterator<Item = String> {
        self.descriptor.fields().map(|field| field.name().to_owned())
    }

    /// The name and the unit of the monitored variable in a field.
    pub fn monitored(&self, field: &str) -> Option<(&String, &String)> {
        self.about.iter().find(|(name, _)| identifier(name) == field)
    }
}

impl Entry {
    /// All values as text, in the order of the fields.
    pub fn texts(&self) -> impl Iterator<Item = String> + '_ {
        let fields: Vec<_> = self.message.descriptor().fields().collect();
        fields.into_iter().map(|field| self.named(&field))
    }

    /// A value as text: nothing for what is not a number, the name of what has one.
    pub fn text(&self, field: &str) -> String {
        let field = self.message.descriptor().get_field_by_name(field);
        field.map_or(String::new(), |field| self.named(&field))
    }

    fn named(&self, field: &FieldDescriptor) -> String {
        let value = self.message.get_field(field);
        match (&*value, field.kind()) {
            (Value::EnumNumber(number), Kind::Enum(names)) => {
                names.get_value(*number).map_or_else(|| number.to_string(), |value| value.name().to_owned())
            }
            (value, _) => text(value),
        }
    }

    /// Bytes; none if there are none.
    pub fn bytes(&self, field: &str) -> Vec<u8> {
        match self.message.get_field_by_name(field).as_deref() {
            Some(Value::Bytes(bytes)) => bytes.to_vec(),
            _ => Vec::new(),
        }
    }

    /// A whole number; 0 if there is none. Yes is 1.
    pub fn number(&self, field: &str) -> u64 {
        match self.message.get_field_by_name(field).as_deref() {
            Some(Value::U64(number)) => *number,
            Some(Value::U32(number)) => u64::from(*number),
            Some(Value::Bool(yes)) => u64::from(*yes),
            _ => 0,
        }
    }

    /// One that may be negative.
    pub fn signed(&self, field: &str) -> i64 {
        match self.message.get_field_by_name(field).as_deref() {
            Some(Value::I64(number)) => *number,
            _ => 0,
        }
    }

    /// A measured value; not a number if there is none.
    pub fn float(&self, field: &str) -> f64 {
        match self.message.get_field_by_name(field).as_deref() {
            Some(Value::F64(value)) => *value,
            Some(Value::F32(value)) => f64::from(*value),
            _ => f64::NAN,
        }
    }
}

fn text(value: &Value) -> String {
    match value {
        Value::Bool(yes) => u8::from(*yes).to_string(),
        Value::I32(number) | Value::EnumNumber(number) => number.to_string(),
        Value::I64(number) => number.to_string(),
        Value::U32(number) => number.to_string(),
        Value::U64(number) => number.to_string(),
        Value::F32(number) if number.is_finite() => number.to_string(),
        Value::F64(number) if number.is_finite() => number.to_string(),
        Value::String(text) => text.clone(),
        Value::Bytes(bytes) => bytes.iter().map(|byte| format!("{byte:02x}")).collect(),
        _ => String::new(),
    }
}
