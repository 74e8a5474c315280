//! The messages of a recording in Protocol Buffers (proto3). One table gives the fields of a message, their names and
//! where their values come from; the bytes and the description that stands in the file follow from it.

use std::borrow::Cow;

use prost_reflect::prost::Message as _;
use prost_reflect::prost_types::field_descriptor_proto::{Label, Type};
use prost_reflect::prost_types::{
    DescriptorProto, EnumDescriptorProto, EnumValueDescriptorProto, FieldDescriptorProto,
    FileDescriptorProto, FileDescriptorSet,
};

/// The package of all messages.
pub const PACKAGE: &str = "fieldbeat";

/// Of every enumeration, in the scope of its type.
const NAME: &str = "Name";

/// Numbers with names.
#[derive(Debug)]
pub struct Names {
    /// The name of their type.
    pub name: &'static str,
    /// From 0 on.
    pub values: fn() -> Vec<&'static str>,
}

/// Where a value comes from, by its type.
#[derive(Debug)]
pub enum Get<T> {
    /// Unsigned.
    U64(fn(&T) -> u64),
    /// Unsigned, of 32 bits.
    U32(fn(&T) -> u32),
    /// Signed, and small as a rule.
    I64(fn(&T) -> i64),
    /// Yes or no.
    Bool(fn(&T) -> bool),
    /// Of 64 bits.
    F64(fn(&T) -> f64),
    /// Of 32 bits.
    F32(fn(&T) -> f32),
    /// In words.
    Text(fn(&T) -> &str),
    /// A number that has a name: two fields, the second one with `_name` behind the name of the first one ...
    Named(fn(&T) -> u32, &'static Names),
    /// ... which is this.
    Name(&'static Names),
    /// One of several of 64 bits.
    Item(fn(&T) -> &[f64], usize),
    /// As they are.
    Bytes(fn(&T) -> &[u8]),
}

/// Takes the fields of a message, one after the other.
pub trait Visit {
    /// Unsigned.
    fn u64(&mut self, name: &'static str, value: u64);
    /// Unsigned, of 32 bits.
    fn u32(&mut self, name: &'static str, value: u32);
    /// Yes or no.
    fn bool(&mut self, name: &'static str, value: bool);
    /// Of 64 bits.
    fn f64(&mut self, name: &'static str, value: f64);
    /// Of 32 bits.
    fn f32(&mut self, name: &'static str, value: f32);
    /// A number that has a name: two fields, as of [`Get::Named`].
    fn named(&mut self, name: &'static str, value: u32, names: &'static Names);
}

/// A message that is written so often that its fields are known to the compiler.
pub trait Fields: Default {
    /// Gives all of them.
    fn visit(&self, to: &mut impl Visit);
}

/// A message: its name, and its fields, which are numbered from 1 on.
#[derive(Debug)]
pub struct Table<T> {
    name: String,
    fields: Vec<Field<T>>,
    /// The number of bytes made ready for it; texts take more.
    room: usize,
    /// Of one whose fields are known to the compiler.
    encode: Option<fn(&Begun, &T, &mut Vec<u8>)>,
}

/// The first fields of messages that have them in common.
#[derive(Debug, Default)]
pub struct Begun {
    bytes: Vec<u8>,
    fields: usize,
}

impl Begun {
    /// Makes them those of `table`, about `of`.
    pub fn begin<T>(&mut self, table: &Table<T>, of: &T) {
        self.bytes.clear();
        table.encode(of, &mut self.bytes);
        self.fields = table.fields.len();
    }
}

/// A field of a message.
#[derive(Debug)]
struct Field<T> {
    /// The bytes before its value, and their number.
    key: [u8; 4],
    key_length: usize,
    get: Get<T>,
    name: Cow<'static, str>,
}

impl<T> Field<T> {
    fn new(number: u64, name: Cow<'static, str>, get: Get<T>) -> Field<T> {
        let how = match get {
            Get::U64(_) | Get::U32(_) | Get::I64(_) | Get::Bool(_) | Get::Named(..) | Get::Name(_) => VARINT,
            Get::F64(_) | Get::Item(..) => FIXED_64,
            Get::F32(_) => FIXED_32,
            Get::Text(_) | Get::Bytes(_) => LENGTH,
        };
        let mut room = [0; LONGEST_FIELD];
        let key_length = put(&mut room, 0, number << 3 | how);
        let key = [room[0], room[1], room[2], room[3]];
        Field { key, key_length, get, name }
    }

    /// It takes no more, but what stands behind a length.
    fn longest(&self) -> usize {
        self.key_length
            + match self.get {
                Get::Bool(_) => 1,
                Get::U32(_) | Get::Named(..) | Get::Name(_) => 5,
                Get::F32(_) => 4,
                Get::F64(_) | Get::Item(..) => 8,
                Get::U64(_) | Get::I64(_) | Get::Text(_) | Get::Bytes(_) => 10,
            }
    }
}

/// The fields of a message that the compiler knows, for its description: their values are never taken from it.
struct Listed<T>(Vec<(Cow<'static, str>, Get<T>)>);

impl<T> Visit for Listed<T> {
    fn u64(&mut self, name: &'static str, _: u64) {
        self.0.push((name.into(), Get::U64(|_| 0)));
    }

    fn u32(&mut self, name: &'static str, _: u32) {
        self.0.push((name.into(), Get::U32(|_| 0)));
    }

    fn bool(&mut self, name: &'static str, _: bool) {
        self.0.push((name.into(), Get::Bool(|_| false)));
    }

    fn f64(&mut self, name: &'static str, _: f64) {
        self.0.push((name.into(), Get::F64(|_| 0.0)));
    }

    fn f32(&mut self, name: &'static str, _: f32) {
        self.0.push((name.into(), Get::F32(|_| 0.0)));
    }

    fn named(&mut self, name: &'static str, _: u32, names: &'static Names) {
        self.0.push((name.into(), Get::Named(|_| 0, names)));
    }
}

/// The most bytes of a message whose fields are known to the compiler.
const ROOM: usize = 256;

/// Writes the bytes of such a message.
struct Encoder {
    bytes: [u8; ROOM],
    at: usize,
    /// That of the last field.
    number: u64,
    /// Fields up to this one are written already.
    from: u64,
}

impl Encoder {
    /// Begins the next field, if it is to be written.
    #[inline(always)]
    fn begins(&mut self, how: u64, is_default: bool) -> bool {
        self.number += 1;
        let is_written = !is_default && self.number > self.from;
        if is_written {
            self.put(self.number << 3 | how);
        }
        is_written
    }

    #[inline(always)]
    fn put(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.bytes[self.at % ROOM] = value as u8 | 0x80;
            (self.at, value) = (self.at + 1, value >> 7);
        }
        self.bytes[self.at % ROOM] = value as u8;
        self.at += 1;
    }

    #[inline(always)]
    fn varint(&mut self, value: u64) {
        if self.begins(VARINT, value == 0) {
            self.put(value);
        }
    }

    #[inline(always)]
    fn fixed<const BYTES: usize>(&mut self, how: u64, value: [u8; BYTES]) {
        if self.begins(how, value == [0; BYTES])
            && let Some(room) = self.bytes.get_mut(self.at..self.at + BYTES)
        {
            room.copy_from_slice(&value);
            self.at += BYTES;
        }
    }
}

impl Visit for Encoder {
    #[inline(always)]
    fn u64(&mut self, _: &'static str, value: u64) {
        self.varint(value);
    }

    #[inline(always)]
    fn u32(&mut self, _: &'static str, value: u32) {
        self.varint(value.into());
    }

    #[inline(always)]
    fn bool(&mut self, _: &'static str, value: bool) {
        self.varint(value.into());
    }

    #[inline(always)]
    fn f64(&mut self, _: &'static str, value: f64) {
        self.fixed(FIXED_64, value.to_le_bytes());
    }

    #[inline(always)]
    fn f32(&mut self, _: &'static str, value: f32) {
        self.fixed(FIXED_32, value.to_le_bytes());
    }

    #[inline(always)]
    fn named(&mut self, _: &'static str, value: u32, _: &'static Names) {
        self.varint(value.into());
        self.varint(value.into());
    }
}

/// How a value is written: the last three bits of a field's key.
const VARINT: u64 = 0;
const FIXED_64: u64 = 1;
const LENGTH: u64 = 2;
const FIXED_32: u64 = 5;

impl<T> Table<T> {
    /// A message of these fields.
    pub fn new(name: &str, fields: Vec<(Cow<'static, str>, Get<T>)>) -> Table<T> {
        let with_names = fields.into_iter().flat_map(|(name, get)| {
            let of_number = match get {
                Get::Named(_, names) => Some((format!("{name}_name").into(), Get::Name(names))),
                _ => None,
            };
            [(name, get)].into_iter().chain(of_number)
        });
        let fields = (1..).zip(with_names).map(|(number, (name, get))| Field::new(number, name, get));
        let fields: Vec<_> = fields.collect();
        let room = fields.iter().map(Field::longest).sum::<usize>() + LONGEST_FIELD;
        Table { name: name.to_owned(), fields, room, encode: None }
    }

    /// A message whose fields are known to the compiler.
    pub fn of(name: &str) -> Table<T>
    where
        T: Fields,
    {
        let mut listed = Listed(Vec::new());
        T::default().visit(&mut listed);
        let table = Table::new(name, listed.0);
        assert!(table.room <= ROOM, "{name} takes {} bytes", table.room);
        let encode = |begun: &Begun, of: &T, out: &mut Vec<u8>| {
            let mut encoder = Encoder { bytes: [0; ROOM], at: 0, number: 0, from: begun.fields as u64 };
            of.visit(&mut encoder);
            out.extend_from_slice(&begun.bytes);
            out.extend_from_slice(&encoder.bytes[..encoder.at]);
        };
        Table { encode: Some(encode), ..table }
    }

    /// The name with the package.
    pub fn full_name(&self) -> String {
        format!("{PACKAGE}.{}", self.name)
    }

    /// Appends the bytes of the message about `of`. What is 0 is left out, as by every writer of proto3.
    pub fn encode(&self, of: &T, out: &mut Vec<u8>) {
        self.encode_behind(&Begun::default(), of, out);
    }

    /// The same behind the bytes of its first fields.
    pub fn encode_behind(&self, begun: &Begun, of: &T, out: &mut Vec<u8>) {
        if let Some(encode) = self.encode {
            return encode(begun, of, out);
        }
        out.extend_from_slice(&begun.bytes);
        let (room, mut at) = (self.room, out.len());
        out.resize(at + room, 0);
        let mut bytes = &mut out[..];
        let mut fields = self.fields.iter();
        fields.by_ref().take(begun.fields).for_each(drop);
        while let Some(field) = fields.next() {
            match field.get {
                Get::U64(get) => at = field.varint(bytes, at, get(of)),
                Get::U32(get) => at = field.varint(bytes, at, get(of).into()),
                Get::Named(get, _) => {
                    let (value, of_name) = (get(of).into(), fields.next());
                    at = field.varint(bytes, at, value);
                    at = of_name.map_or(at, |of_name| of_name.varint(bytes, at, value));
                }
                Get::Name(_) => {}
                Get::Bool(get) => at = field.varint(bytes, at, get(of).into()),
                Get::I64(get) => {
                    let value = get(of);
                    at = field.varint(bytes, at, ((value << 1) ^ (value >> 63)) as u64);
                }
                Get::F64(get) => at = field.fixed(bytes, at, get(of).to_le_bytes()),
                Get::Item(get, item) => {
                    let value = get(of).get(item).copied().unwrap_or(f64::NAN);
                    at = field.fixed(bytes, at, value.to_le_bytes());
                }
                Get::F32(get) => at = field.fixed(bytes, at, get(of).to_le_bytes()),
                Get::Text(get) => {
                    at = field.bytes(out, at, get(of).as_bytes(), room);
                    bytes = &mut out[..];
                }
                Get::Bytes(get) => {
                    at = field.bytes(out, at, get(of), room);
                    bytes = &mut out[..];
                }
            }
        }
        out.truncate(at);
    }

    /// The description in the file: a `FileDescriptorSet` of this message.
    pub fn descriptor(&self) -> Vec<u8> {
        let mut names_of: Vec<DescriptorProto> = Vec::new();
        let mut fields = Vec::new();
        for (number, Field { name, get, .. }) in (1..).zip(&self.fields) {
            let (kind, type_name) = match get {
                Get::U64(_) => (Type::Uint64, None),
                Get::U32(_) | Get::Named(..) => (Type::Uint32, None),
                Get::I64(_) => (Type::Sint64, None),
                Get::Bool(_) => (Type::Bool, None),
                Get::F64(_) | Get::Item(..) => (Type::Double, None),
                Get::F32(_) => (Type::Float, None),
                Get::Text(_) => (Type::String, None),
                Get::Bytes(_) => (Type::Bytes, None),
                Get::Name(names) => {
                    if names_of.iter().all(|known| known.name() != names.name) {
                        names_of.push(names.descriptor());
                    }
                    (Type::Enum, Some(format!(".{}.{}.{NAME}", self.full_name(), names.name)))
                }
            };
            fields.push(FieldDescriptorProto {
                name: Some(name.clone().into_owned()),
                number: Some(number),
                label: Some(Label::Optional as i32),
                r#type: Some(kind as i32),
                type_name,
                ..FieldDescriptorProto::default()
            });
        }
        let message = DescriptorProto {
            name: Some(self.name.clone()),
            field: fields,
            nested_type: names_of,
            ..DescriptorProto::default()
        };
        let file = FileDescriptorProto {
            name: Some(format!("{PACKAGE}/{}.proto", self.name)),
            package: Some(PACKAGE.to_owned()),
            message_type: vec![message],
            syntax: Some("proto3".to_owned()),
            ..FileDescriptorProto::default()
        };
        FileDescriptorSet { file: vec![file] }.encode_to_vec()
    }
}

impl Names {
    /// An enumeration in a scope of its own: its values would stand in that of the enumeration's own name, next to the
    /// fields.
    fn descriptor(&self) -> DescriptorProto {
        let value = |(number, name): (i32, &'static str)| EnumValueDescriptorProto {
            name: Some(identifier(name)),
            number: Some(number),
            options: None,
        };
        let names = EnumDescriptorProto {
            name: Some(NAME.to_owned()),
            value: (0..).zip((self.values)()).map(value).collect(),
            ..EnumDescriptorProto::default()
        };
        DescriptorProto {
            name: Some(self.name.to_owned()),
            enum_type: vec![names],
            ..DescriptorProto::default()
        }
    }
}

/// A name that Protocol Buffers takes: letters, digits and `_`, not beginning with a digit.
pub fn identifier(name: &str) -> String {
    let mut out = String::new();
    for letter in name.chars() {
        match letter {
            'a'..='z' | 'A'..='Z' | '0'..='9' => out.push(letter),
            _ if out.is_empty() || out.ends_with('_') => {}
            _ => out.push('_'),
        }
    }
    let out = out.trim_end_matches('_');
    let needs_letter = out.is_empty() || out.starts_with(|first: char| first.is_ascii_digit());
    if needs_letter { format!("v{out}") } else { out.to_owned() }
}

/// The most of [`Field::longest`]: a key has 4 bytes at most, a number 10.
const LONGEST_FIELD: usize = 16;

/// Each writes the field from `at` on, and returns where it ends.
impl<T> Field<T> {
    fn key<'a>(&self, bytes: &'a mut [u8], at: usize) -> &'a mut [u8; LONGEST_FIELD] {
        let room = bytes[at..].first_chunk_mut::<LONGEST_FIELD>().expect("there is room for each field");
        room[..4].copy_from_slice(&self.key);
        room
    }

    fn varint(&self, bytes: &mut [u8], at: usize, value: u64) -> usize {
        if value == 0 {
            return at;
        }
        at + put(self.key(bytes, at), self.key_length, value)
    }

    fn fixed<const BYTES: usize>(&self, bytes: &mut [u8], at: usize, value: [u8; BYTES]) -> usize {
        if value == [0; BYTES] {
            return at;
        }
        self.key(bytes, at)[self.key_length..][..BYTES].copy_from_slice(&value);
        at + self.key_length + BYTES
    }

    /// Makes `room` behind it, in which the next ones are written.
    fn bytes(&self, out: &mut Vec<u8>, at: usize, value: &[u8], room: usize) -> usize {
        if value.is_empty() {
            return at;
        }
        let begin = self.varint(out, at, value.len() as u64);
        out.truncate(begin);
        out.extend_from_slice(value);
        let end = out.len();
        out.resize(end + room, 0);
        end
    }
}

/// Writes a number from `at` on; where it ends.
fn put(room: &mut [u8; LONGEST_FIELD], mut at: usize, mut value: u64) -> usize {
    while value >= 0x80 {
        room[at % LONGEST_FIELD] = value as u8 | 0x80;
        (at, value) = (at + 1, value >> 7);
    }
    room[at % LONGEST_FIELD] = value as u8;
    at + 1
}

#[cfg(test)]
mod tests {

    use super::*;

    /// One field of each type.
    #[derive(Default)]
    struct All {
        u64: u64,
        u32: u32,
        i64: i64,
        bool: bool,
        f64: f64,
        f32: f32,
        text: &'static str,
        named: u32,
        items: [f64; 2],
        bytes: &'static [u8],
    }

    const COLOURS: Names = Names { name: "Colour", values: || vec!["-", "text", "blue (STO)"] };

    fn table() -> Table<All> {
        Table::new(
            "All",
            vec![
                ("u64".into(), Get::U64(|of| of.u64)),
                ("u32".into(), Get::U32(|of| of.u32)),
                ("i64".into(), Get::I64(|of| of.i64)),
                ("bool".into(), Get::Bool(|of| of.bool)),
                ("f64".into(), Get::F64(|of| of.f64)),
                ("f32".into(), Get::F32(|of| of.f32)),
                ("text".into(), Get::Text(|of| of.text)),
                ("named".into(), Get::Named(|of| of.named, &COLOURS)),
                ("item".into(), Get::Item(|of| &of.items, 1)),
                ("bytes".into(), Get::Bytes(|of| of.bytes)),
            ],
        )
    }

    #[test]
    fn zeros_take_no_bytes() {
        let mut out = vec![1, 2, 3];
        table().encode(&All::default(), &mut out);
        assert_eq!(out, [1, 2, 3]);
    }

    /// More fields than have a key of one byte.
    #[derive(Default)]
    struct Many([u64; 17], f64, f32, u32, bool);

    impl Fields for Many {
        fn visit(&self, to: &mut impl Visit) {
            self.0.iter().for_each(|number| to.u64("number", *number));
            to.f64("f64", self.1);
            to.f32("f32", self.2);
            to.named("named", self.3, &COLOURS);
            to.bool("bool", self.4);
        }
    }

    fn listed() -> Table<Many> {
        macro_rules! numbers {
            ($($at:literal)+) => { vec![$(("number".into(), Get::U64(|many: &Many| many.0[$at]))),+] };
        }
        let mut fields = numbers!(0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16);
        fields.push(("f64".into(), Get::F64(|many| many.1)));
        fields.push(("f32".into(), Get::F32(|many| many.2)));
        fields.push(("named".into(), Get::Named(|many| many.3, &COLOURS)));
        fields.push(("bool".into(), Get::Bool(|many| many.4)));
        Table::new("Many", fields)
    }

    #[test]
    fn fields_that_the_compiler_knows_have_the_bytes_of_those_of_a_list() {
        let (known, listed) = (Table::<Many>::of("Many"), listed());
        assert_eq!(known.descriptor(), listed.descriptor());
        for seed in 0..1_000 {
            let mut random = fastrand::Rng::with_seed(seed);
            let mut number = || if random.bool() { 0 } else { random.u64(..) >> random.u32(..64) };
            let numbers = std::array::from_fn(|_| number());
            let [a, b, c] = [number(), number(), number()];
            let values = [0.0, -0.0, f64::NAN, 1e-9, f64::MAX];
            let (wide, narrow) = (values[a as usize % 5], values[b as usize % 5] as f32);
            let many = Many(numbers, wide, narrow, c as u32, a % 2 == 1);
            // Its first fields may be known already, and are then given by whoever knows them.
            for fields in [0, 1, 7, 16, 17] {
                let begun = Begun { bytes: vec![9; fields], fields };
                let [mut one, mut other] = [vec![1, 2], vec![1, 2]];
                known.encode_behind(&begun, &many, &mut one);
                listed.encode_behind(&begun, &many, &mut other);
                assert_eq!(one, other, "{seed}, {fields}");
            }
        }
    }

    #[test]
    fn any_name_becomes_an_identifier() {
        for (name, expected) in [
            ("demand-current", "demand_current"),
            ("0x1E10", "v0x1E10"),
            ("hardware enable (STO) missing", "hardware_enable_STO_missing"),
            ("-", "v"),
            ("µ", "v"),
        ] {
            assert_eq!(identifier(name), expected);
        }
    }
}
