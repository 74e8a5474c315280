//! Set_Prm and Chk_Cfg as bytes.
//!
//! Facts: sheet, 6.

use super::settings::{LenzeSettings, UserPrm};
use fieldbeat_core::time::MS;

/// The first byte of Set_Prm.
mod status {
    pub const LOCK: u8 = 0x80;
    pub const UNLOCK: u8 = 0x40;
    pub const SYNC: u8 = 0x20;
    pub const FREEZE: u8 = 0x10;
    pub const WATCHDOG: u8 = 0x08;
    pub const RESERVED: u8 = 0x07;
}

/// The first byte of User_Prm, if the slave knows DP-V1.
mod dpv1 {
    pub const ENABLE: u8 = 0x80;
    pub const FAIL_SAFE: u8 = 0x40;
    pub const WATCHDOG_MS: u8 = 0x04;
    pub const RESERVED: u8 = 0x3B;
}

/// The least min Tsdr, bits.
const LEAST_TSDR: u8 = 11;

/// What a master has parametrised.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Parameters {
    /// Bits.
    pub min_tsdr: u16,
    pub watchdog_ns: Option<u64>,
    pub group: u8,
    pub dpv1: bool,
    pub fail_safe: bool,
}

impl Default for Parameters {
    fn default() -> Parameters {
        Parameters { min_tsdr: LEAST_TSDR.into(), watchdog_ns: None, group: 0, dpv1: false, fail_safe: false }
    }
}

/// What a Set_Prm wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Request {
    /// These parameters, and no other master.
    Lock(Parameters),
    /// Another min Tsdr.
    Keep(Parameters),
    /// Any master may have the slave.
    Unlock,
}

/// Why a Set_Prm is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    Length,
    /// Bits or times that are none.
    Malformed,
    /// Sync or Freeze.
    NotSupported,
    Ident,
    User,
}

impl Parameters {
    /// Reads a Set_Prm to a slave with these `settings` and the parameters `now`.
    pub(super) fn read(
        data: &[u8],
        settings: &LenzeSettings,
        max_tsdr: u16,
        now: Parameters,
    ) -> Result<Request, Refusal> {
        let [status, first, second, tsdr, high, low, group, ref user @ ..] = *data else {
            return Err(Refusal::Length);
        };
        let min_tsdr = if tsdr == 0 { now.min_tsdr } else { tsdr.into() };
        if status & status::RESERVED != 0 || (tsdr != 0 && tsdr < LEAST_TSDR) || min_tsdr > max_tsdr {
            return Err(Refusal::Malformed);
        }
        match status & (status::LOCK | status::UNLOCK) {
            0 => return Ok(Request::Keep(Parameters { min_tsdr, ..now })),
            status::LOCK => {}
            _ => return Ok(Request::Unlock),
        }
        if u16::from_be_bytes([high, low]) != settings.ident {
            return Err(Refusal::Ident);
        }
        if status & (status::SYNC | status::FREEZE) != 0 && !settings.dp.sync_freeze {
            return Err(Refusal::NotSupported);
        }
        let is_wanted = match &settings.dp.user_prm {
            UserPrm::Any => true,
            UserPrm::Length(length) => user.len() == *length,
            UserPrm::Exactly(bytes) => user == bytes,
        };
        let bits = user.first().copied().filter(|_| settings.dp.dpv1).unwrap_or(0);
        if !is_wanted || bits & dpv1::RESERVED != 0 {
            return Err(Refusal::User);
        }
        let unit_ns = if bits & dpv1::WATCHDOG_MS != 0 { MS } else { 10 * MS };
        let watched = status & status::WATCHDOG != 0;
        if watched && (first == 0 || second == 0) {
            return Err(Refusal::Malformed);
        }
        Ok(Request::Lock(Parameters {
            min_tsdr,
            watchdog_ns: watched.then(|| u64::from(first) * u64::from(second) * unit_ns),
            group,
            dpv1: bits & dpv1::ENABLE != 0,
            fail_safe: bits & dpv1::FAIL_SAFE != 0,
        }))
    }
}

/// The bytes of outputs and inputs of these identifier bytes; `None`: they are none.
pub(super) fn sizes(configuration: &[u8]) -> Option<(usize, usize)> {
    let mut sizes = (0, 0);
    let mut rest = configuration.iter().copied();
    let length = |byte: u8, most: u8| (usize::from(byte & most) + 1) * if byte & 0x40 != 0 { 2 } else { 1 };
    while let Some(byte) = rest.next() {
        match (byte >> 4 & 3, byte >> 6) {
            // Special: which length bytes follow, and how many of the manufacturer behind them.
            (0, which) => {
                if which & 2 != 0 {
                    sizes.0 += length(rest.next()?, 0x3F);
                }
                if which & 1 != 0 {
                    sizes.1 += length(rest.next()?, 0x3F);
                }
                let own = byte & 0x0F;
                for _ in 0..if own == 15 { 0 } else { own } {
                    rest.next()?;
                }
            }
            (direction, _) => {
                let length = length(byte, 0x0F);
                sizes.0 += length * usize::from(direction >> 1);
                sizes.1 += length * usize::from(direction & 1);
            }
        }
    }
    Some(sizes)
}
