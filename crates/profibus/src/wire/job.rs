//! A job for one code of the drive in the parameter channel: what both forms of the channel have in common.

use fieldbeat_core::axis::acyclic::Integer;
use fieldbeat_core::named;

/// The channel, either way.
pub type Channel = [u8; 8];

/// Reads or writes the value of a code.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Job {
    /// The number of the code.
    pub code: u16,
    /// The subcode; 0 if there is none.
    pub sub: u8,
    /// The bits of its value: 8, 16 or 32.
    pub bits: u32,
    /// The value to write.
    pub write: Option<u32>,
}

/// A value as a reply of the channel has it, of which it says no more than its size.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Raw {
    /// The bits: 8, 16, 24 or 32.
    pub bits: u32,
    /// The bits.
    pub raw: u32,
}

named! {
    /// The kind of the value of a code. The number is that of the format in a record of parameters, the name is how
    /// people write it behind the code.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
    pub enum Kind {
        /// As the catalogue says; 32 bits with a sign if it says nothing.
        Own = 0: "",
        /// 8 bits with a sign.
        I8 = 2: "i8",
        /// 16 bits with a sign.
        I16 = 3: "i16",
        /// 32 bits with a sign.
        I32 = 4: "i32",
        /// 8 bits.
        U8 = 5: "u8",
        /// 16 bits.
        U16 = 6: "u16",
        /// 32 bits.
        U32 = 7: "u32",
        /// Characters.
        Text = 9: "text",
    }
}

impl Kind {
    /// The numbers; `None`: it has none.
    pub const fn integer(self) -> Option<Integer> {
        let (bits, signed) = match self {
            Kind::I8 => (8, true),
            Kind::I16 => (16, true),
            Kind::Own | Kind::I32 => (32, true),
            Kind::U8 => (8, false),
            Kind::U16 => (16, false),
            Kind::U32 => (32, false),
            Kind::Text => return None,
        };
        Some(Integer { bits, signed })
    }
}
