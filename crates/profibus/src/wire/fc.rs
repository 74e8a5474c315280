//! The function code (FC) of a telegram: what is requested, or what became of it (sheet, 5).

/// A function code as on the wire. Bit 7 is reserved, and no function code has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct FunctionCode(pub u8);

/// The requested function: of those of the standard, the ones that this master uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Function {
    /// SDN high: data, not acknowledged.
    SdnHigh = 0x6,
    /// FDL status: whether there is a station, and of what kind.
    FdlStatus = 0x9,
    /// SRD low: data both ways.
    SrdLow = 0xC,
    /// SRD high: the same, of high priority.
    SrdHigh = 0xD,
}

impl FunctionCode {
    /// Bit 6: a request.
    const REQUEST: u8 = 1 << 6;
    /// Bit 5 of a request: the frame count bit.
    const FCB: u8 = 1 << 5;
    /// Bit 4 of a request: the frame count bit is valid.
    const FCV: u8 = 1 << 4;

    /// That of a request.
    ///
    /// The count is that of a pair of stations, over all services: the first request has `fcb` without `fcv`, the next
    /// ones `fcv`, and `fcb` toggles with each new request. Whoever gets the same `fcb` again repeats its answer. FDL
    /// status and what is not answered have neither of them.
    #[inline]
    pub const fn request(function: Function, fcb: bool, fcv: bool) -> FunctionCode {
        let fcb = if fcb { FunctionCode::FCB } else { 0 };
        let fcv = if fcv { FunctionCode::FCV } else { 0 };
        FunctionCode(FunctionCode::REQUEST | fcb | fcv | function as u8)
    }
}

/// The function of an answer: there is no room for the data of the request.
pub const NO_RESOURCE: u8 = 0x2;

/// The function of an answer: the service is not active, as Data_Exchange of a slave that is not in it.
pub const NOT_ACTIVE: u8 = 0x3;

/// Why a request was refused, from the function of its answer.
pub const fn refusal(function: u8) -> &'static str {
    match function {
        0x1 => "UE: user error",
        NO_RESOURCE => "RR: no resource",
        NOT_ACTIVE => "RS: service not active",
        _ => "a function that is no refusal",
    }
}
