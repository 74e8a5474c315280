//! What these drives' own messages can say: tables of the Host Command Reference 920-0002 W.

/// The operand of a buffered command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operand {
    /// Nothing.
    None,
    /// 8 bits.
    Byte,
    /// 16 bits.
    Word,
    /// 32 bits.
    Long,
    /// An I/O code.
    Io,
    /// Two I/O codes.
    TwoIos,
    /// 16 bits, and an I/O code beside them.
    FieldWord,
    /// A register beside it.
    Register,
    /// 32 bits, and a register beside them.
    RegisterLong,
}

/// A buffered command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Opcode {
    /// The mnemonic.
    pub name: &'static str,
    /// The code.
    pub code: u8,
    /// The operand.
    pub operand: Operand,
}

const fn op(name: &'static str, code: u8, operand: Operand) -> Opcode {
    Opcode { name, code, operand }
}

/// All buffered commands, sorted. Those whose operand the manual does not size count as 16 bits: up to 65535 every size
/// has the same bytes.
#[rustfmt::skip]
pub const OPCODES: [Opcode; 80] = {
    use Operand::{Byte, FieldWord, Io, Long, None, Register, RegisterLong, TwoIos, Word};
    [
        op("AC", 0x1E, Word), op("AD", 0xD2, Word), op("AF", 0x4C, Word), op("AG", 0x3B, Word),
        op("AI", 0x46, Word), op("AM", 0x16, Word), op("AN", 0x5F, Word), op("AO", 0x47, Word),
        op("AP", 0x4B, Word), op("AS", 0xD1, Word), op("AT", 0x4D, Word), op("AV", 0x3C, Word),
        op("AX", 0xBA, None), op("AZ", 0xA1, None), op("BD", 0x40, Word), op("BE", 0x41, Word),
        op("BO", 0x48, Word), op("CA", 0x61, Word), op("CC", 0x18, Word), op("CD", 0x4F, Word),
        op("CI", 0x19, Word), op("CJ", 0x96, None), op("CM", 0x10, Word), op("DC", 0xB7, Long),
        op("DE", 0x1F, Word), op("DI", 0xB6, Long), op("DL", 0x42, Word), op("EF", 0xD6, Word),
        op("EG", 0x26, Word), op("EI", 0x43, Word), op("EN", 0x2A, Word), op("EP", 0x98, Long),
        op("ER", 0x20, Word), op("EU", 0x2B, Word), op("FC", 0x6D, None), op("FD", 0x69, TwoIos),
        op("FE", 0xCC, Io), op("FI", 0xC0, FieldWord), op("FL", 0x66, None), op("FM", 0x6A, Io),
        op("FO", 0x68, Io), op("FP", 0x67, None), op("FS", 0x6B, Io), op("FX", 0xD3, Word),
        op("FY", 0x6C, Io), op("GG", 0xEF, Word), op("HG", 0x04, Word), op("HP", 0x05, Word),
        op("HW", 0xAB, Io), op("JA", 0x1B, Word), op("JD", 0xA3, None), op("JE", 0xA2, None),
        op("JL", 0x1C, Word), op("JS", 0x1A, Word), op("LM", 0xEA, Long), op("LP", 0xE9, Long),
        op("MD", 0x9E, None), op("ME", 0x9F, None), op("MO", 0x49, FieldWord), op("PD", 0x71, Word),
        op("PE", 0x72, Word), op("PF", 0x21, Word), op("PM", 0x44, Word), op("QX", 0x78, Byte),
        op("RE", 0xA4, None), op("RX", 0xAE, RegisterLong), op("SF", 0x06, Word), op("SH", 0x6E, Io),
        op("SI", 0x45, Word), op("SM", 0xB5, Byte), op("SO", 0x8B, Io), op("SP", 0xA5, Long),
        op("TI", 0xA8, Io), op("TO", 0x64, Word), op("TR", 0xAC, RegisterLong), op("TV", 0x65, Word),
        op("VC", 0x4A, Word), op("VE", 0x1D, Word), op("VR", 0x63, Word), op("WD", 0xBF, Register),
    ]
};

/// The buffered command with this mnemonic.
pub fn opcode(name: &str) -> Option<Opcode> {
    OPCODES.into_iter().find(|opcode| opcode.name == name)
}

/// A parameter that immediate messages read and write (table 3).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Parameter {
    /// The mnemonic.
    pub name: &'static str,
    /// The index.
    pub index: u8,
    /// It cannot be written.
    pub read_only: bool,
}

const fn parameter_of(name: &'static str, index: u8) -> Parameter {
    // Bit 7 of an index is the flash memory of a write: what has it can only be read.
    Parameter { name, index, read_only: index & 0x80 != 0 }
}

/// All parameters. CP is printed with the index of CI.
#[rustfmt::skip]
pub const PARAMETERS: [Parameter; 52] = [
    parameter_of("AC", 0x1E), parameter_of("AM", 0x16), parameter_of("CC", 0x18), parameter_of("CI", 0x19),
    parameter_of("CM", 0x10), parameter_of("CP", 0x19), parameter_of("DE", 0x1F), parameter_of("DL", 0x42),
    parameter_of("EG", 0x26), parameter_of("EN", 0x2A), parameter_of("ER", 0x20), parameter_of("EU", 0x2B),
    parameter_of("GC", 0x12), parameter_of("HG", 0x04), parameter_of("HP", 0x05), parameter_of("JA", 0x1B),
    parameter_of("JL", 0x1C), parameter_of("JM", 0x55), parameter_of("JS", 0x1A), parameter_of("MO", 0x49),
    parameter_of("MV", 0x01), parameter_of("PD", 0x71), parameter_of("PE", 0x72), parameter_of("PF", 0x21),
    parameter_of("PK", 0x5D), parameter_of("PM", 0x44), parameter_of("PR", 0x59), parameter_of("PT", 0x3F),
    parameter_of("SF", 0x06), parameter_of("SI", 0x45), parameter_of("VC", 0x4A), parameter_of("VE", 0x1D),
    parameter_of("SC", 0x80), parameter_of("AL", 0x81), parameter_of("ISX", 0x82), parameter_of("IA", 0x83),
    parameter_of("EP high", 0x84), parameter_of("EP low", 0x85), parameter_of("IU", 0x86),
    parameter_of("IT", 0x87), parameter_of("IC", 0x88), parameter_of("IQ", 0x89), parameter_of("IX", 0x8A),
    parameter_of("IV actual", 0x8B), parameter_of("IV target", 0x8C), parameter_of("IS", 0x8D),
    parameter_of("firmware letter", 0x8E), parameter_of("sub-model", 0x90), parameter_of("is servo", 0x91),
    parameter_of("options", 0x92), parameter_of("BS", 0x94), parameter_of("IO", 0x95),
];

/// The parameter with this name.
#[cfg(test)]
pub fn parameter(name: &str) -> Option<Parameter> {
    PARAMETERS.into_iter().find(|parameter| parameter.name == name)
}

/// The registers with a meaning of their own. '0' ... '9' are the user's.
pub const REGISTERS: [(u8, &str); 20] = [
    (b'A', "acceleration"),
    (b'B', "deceleration"),
    (b'C', "distance of a speed change"),
    (b'D', "distance"),
    (b'V', "velocity"),
    (b'M', "jog speed"),
    (b'J', "jog speed, at once"),
    (b'P', "commanded absolute position"),
    (b'e', "encoder position"),
    (b'l', "absolute position"),
    (b's', "status"),
    (b'f', "alarm"),
    (b'x', "position error"),
    (b'v', "actual velocity"),
    (b'w', "target velocity"),
    (b't', "temperature"),
    (b'u', "supply voltage"),
    (b'q', "actual current"),
    (b'i', "inputs"),
    (b'y', "inputs"),
];
