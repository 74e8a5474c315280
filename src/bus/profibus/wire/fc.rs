//! The function code (FC) of a telegram: what is requested, or what became of it (sheet, 5).

use crate::named::named;

/// Bit 6: a request.
const REQUEST: u8 = 1 << 6;
/// Bit 5 of a request: the frame count bit.
const FCB: u8 = 1 << 5;
/// Bit 4 of a request: the frame count bit is valid.
const FCV: u8 = 1 << 4;

/// A function code as on the wire. Bit 7 is reserved, and no function code has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct FunctionCode(pub u8);

impl FunctionCode {
    /// What it requests; `None`: it is that of a reply, or has no function of the standard.
    #[inline]
    pub fn request(self) -> Option<Request> {
        let function =
            RequestFunction::ALL.into_iter().find(|function| *function as u8 | REQUEST == self.0 & 0xCF)?;
        Some(Request { function, fcb: self.0 & FCB != 0, fcv: self.0 & FCV != 0 })
    }

    /// What it replies; `None`: it is that of a request, or has no function of the standard.
    #[inline]
    pub fn reply(self) -> Option<Reply> {
        use ReplyFunction::{
            DataHigh, DataHighNoResource, DataLow, DataLowNoResource, NoData, NoResource, NotActive, Ok,
            UserError,
        };
        let function = match self.0 & 0xCF {
            0x0 => Ok,
            0x1 => UserError,
            0x2 => NoResource,
            0x3 => NotActive,
            0x8 => DataLow,
            0x9 => NoData,
            0xA => DataHigh,
            0xC => DataLowNoResource,
            0xD => DataHighNoResource,
            _ => return None,
        };
        let station = match self.0 >> 4 & 3 {
            0 => StationType::Slave,
            1 => StationType::MasterNotReady,
            2 => StationType::MasterReady,
            _ => StationType::MasterInRing,
        };
        Some(Reply { station, function })
    }
}

/// A request.
///
/// The count is that of a pair of stations, over all services: the first request has `fcb` without `fcv`, the next
/// ones `fcv`, and `fcb` toggles with each new request. Whoever gets the same `fcb` again repeats its answer. What is
/// not answered has neither of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Request {
    /// What is requested.
    pub function: RequestFunction,
    /// The frame count bit.
    pub fcb: bool,
    /// The frame count bit is valid.
    pub fcv: bool,
}

impl Request {
    /// As on the wire.
    #[inline]
    pub const fn code(self) -> FunctionCode {
        let fcb = if self.fcb { FCB } else { 0 };
        let fcv = if self.fcv { FCV } else { 0 };
        FunctionCode(REQUEST | fcb | fcv | self.function as u8)
    }

    /// Without a count: FDL status, and what is not answered.
    #[inline]
    pub const fn uncounted(function: RequestFunction) -> Request {
        Request { function, fcb: false, fcv: false }
    }
}

/// A reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Reply {
    /// What kind of station replies.
    pub station: StationType,
    /// What became of the request.
    pub function: ReplyFunction,
}

impl Reply {
    /// As on the wire.
    #[inline]
    pub const fn code(self) -> FunctionCode {
        FunctionCode((self.station as u8) << 4 | self.function as u8)
    }
}

named! {
    /// What is requested.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
    pub enum RequestFunction {
        /// Data, acknowledged.
        SdaLow = 0x3: "SDA low",
        /// Data, not acknowledged.
        SdnLow = 0x4: "SDN low",
        /// Data, acknowledged, of high priority.
        SdaHigh = 0x5: "SDA high",
        /// Data, not acknowledged, of high priority.
        SdnHigh = 0x6: "SDN high",
        /// Data to several stations, one of which replies.
        MulticastSrd = 0x7: "multicast SRD",
        /// Whether there is a station, and of what kind.
        FdlStatus = 0x9: "FDL status",
        /// Data both ways.
        SrdLow = 0xC: "SRD low",
        /// Data both ways, of high priority.
        SrdHigh = 0xD: "SRD high",
        /// The station's identity.
        Ident = 0xE: "ident",
        /// The state of a service access point.
        LsapStatus = 0xF: "LSAP status",
    }
}

named! {
    /// What kind of station replies.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
    pub enum StationType {
        /// A slave.
        Slave = 0: "slave",
        /// A master that is not ready for the token.
        MasterNotReady = 1: "master, not ready",
        /// A master that is ready for the token.
        MasterReady = 2: "master without token",
        /// A master in the token ring.
        MasterInRing = 3: "master in the ring",
    }
}

named! {
    /// What became of a request.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
    pub enum ReplyFunction {
        /// Done.
        Ok = 0x0: "ok",
        /// The user of the service refused it.
        UserError = 0x1: "UE: user error",
        /// No room for the data.
        NoResource = 0x2: "RR: no resource",
        /// The service is not active: of Data_Exchange, the slave is not in that state.
        NotActive = 0x3: "RS: service not active",
        /// Data.
        DataLow = 0x8: "DL: data",
        /// Done, no data to reply with.
        NoData = 0x9: "NR: no data",
        /// Data of high priority: in Data_Exchange, a diagnosis is pending.
        DataHigh = 0xA: "DH: data of high priority",
        /// Data, but the request's had no room.
        DataLowNoResource = 0xC: "RDL: data, no resource",
        /// Data of high priority, but the request's had no room.
        DataHighNoResource = 0xD: "RDH: data of high priority, no resource",
    }
}

impl ReplyFunction {
    /// The request was refused.
    pub const fn is_refusal(self) -> bool {
        matches!(self, ReplyFunction::UserError | ReplyFunction::NoResource | ReplyFunction::NotActive)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_of_the_sheet_are_what_it_says() {
        let srd = |code, fcb, fcv| {
            let request = Request { function: RequestFunction::SrdHigh, fcb, fcv };
            assert_eq!((FunctionCode(code).request(), request.code()), (Some(request), FunctionCode(code)));
        };
        srd(0x6D, true, false);
        srd(0x5D, false, true);
        srd(0x7D, true, true);
        assert_eq!(Request::uncounted(RequestFunction::FdlStatus).code(), FunctionCode(0x49));
        assert_eq!(Request::uncounted(RequestFunction::SdnHigh).code(), FunctionCode(0x46));
        let reply = |code, function| {
            let reply = Reply { station: StationType::Slave, function };
            assert_eq!((FunctionCode(code).reply(), reply.code()), (Some(reply), FunctionCode(code)));
        };
        reply(0x00, ReplyFunction::Ok);
        reply(0x03, ReplyFunction::NotActive);
        reply(0x08, ReplyFunction::DataLow);
        reply(0x0A, ReplyFunction::DataHigh);
        let ring = Reply { station: StationType::MasterInRing, function: ReplyFunction::Ok };
        assert_eq!(FunctionCode(0x30).reply(), Some(ring));
    }

    #[test]
    fn every_byte_is_a_request_a_reply_or_neither_and_the_same_byte_again() {
        let mut counts = [0; 3];
        for byte in 0..=u8::MAX {
            let code = FunctionCode(byte);
            match (code.request(), code.reply()) {
                (Some(request), None) => {
                    assert_eq!(request.code(), code);
                    counts[0] += 1;
                }
                (None, Some(reply)) => {
                    assert_eq!(reply.code(), code);
                    counts[1] += 1;
                }
                (None, None) => counts[2] += 1,
                (Some(_), Some(_)) => panic!("{byte:#04x} is both"),
            }
        }
        // 10 functions with 4 counts each, 9 functions of 4 kinds of stations each.
        assert_eq!(counts, [40, 36, 180]);
    }
}
