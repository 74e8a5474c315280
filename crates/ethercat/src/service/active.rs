//! The transfer under way: its owner, its time limits, and how it ends.

use super::sdo::{End, Failure, Sdo};
use crate::object::{self, Type, long};
use crate::wire::sdo::AbortCode;
use fieldbeat_core::axis::acyclic::Posted;
use fieldbeat_core::time::Time;

/// The most times that an SDO is sent.
pub const ATTEMPTS: u8 = 3;
/// The same of one that nobody waits for: others wait behind it.
const PROBES: u8 = 2;

/// The transfer under way.
#[derive(Clone, Copy, Debug)]
pub struct Active {
    pub(super) by: By,
    pub(super) sdo: Sdo,
    /// It began then, and has to end within this time, ns.
    pub(super) begun: Time,
    limit_ns: u64,
    /// The present request is under way since then.
    pub(super) since: Time,
    /// How often it was begun.
    pub(super) attempts: u8,
    /// A frame with its first request was built.
    pub(super) gone_out: bool,
}

impl Active {
    /// Begins. `answer_ns`: the time that the slave may take for an answer.
    pub(super) fn new(now: Time, by: By, sdo: Sdo, answer_ns: u64) -> Active {
        let limit_ns = match by {
            By::Master => u64::from(ATTEMPTS) * answer_ns,
            By::Nobody => u64::from(PROBES) * answer_ns,
            By::Call(posted, _) => posted.limit_ns,
        };
        Active { by, sdo, begun: now, limit_ns, since: now, attempts: 1, gone_out: false }
    }

    /// The call of the application that this is.
    pub(super) fn call(&self) -> Option<&Posted> {
        if let By::Call(posted, _) = &self.by { Some(posted) } else { None }
    }

    /// Nobody waits for it.
    pub(super) fn is_nobodys(&self) -> bool {
        matches!(self.by, By::Nobody)
    }

    /// The whole time has passed.
    pub(super) fn is_over(&self, now: Time) -> bool {
        now.since(self.begun) > self.limit_ns
    }

    /// An answer is late, and the same may be requested again. What the application writes is not: it has given the
    /// time that this may take. (Nor is it when its answer was lost, which ends it.)
    pub(super) fn is_late(&self, now: Time, answer_ns: u64) -> bool {
        let most = match self.by {
            By::Call(..) if self.sdo.writes() => 1,
            By::Master | By::Call(..) => ATTEMPTS,
            By::Nobody => PROBES,
        };
        self.attempts < most && now.since(self.since) > answer_ns
    }

    /// It begins anew: its answer was lost, or is late.
    ///
    /// The slave may have carried out the request already. A read changes nothing. A download of the master gives an
    /// object a value: the same value again leaves it as it is, and since a slave works in the order of its requests no
    /// other value comes between the two, whether they are answered or not.
    pub(super) fn repeat(&mut self, now: Time) {
        self.sdo.restart();
        self.attempts += 1;
        self.since = now;
    }
}

/// The owner.
#[derive(Clone, Copy, Debug)]
pub enum By {
    /// The master.
    Master,
    /// The application: a call, and the type of its object where that is known.
    Call(Posted, Option<Type>),
    /// Nobody waits for it: its answer shows that the drive has answered all requests before it, and carried them out.
    Nobody,
}

/// A value of `size` bytes as the bits of its type, which may be longer.
pub fn bits(kind: Option<Type>, size: usize, data: &[u8]) -> u64 {
    let raw = long::raw(data.get(..size).unwrap_or(data));
    match kind {
        Some(kind) if kind.is_signed() && (1..kind.bytes()).contains(&size) => {
            let above = 64 - 8 * size as u32;
            kind.raw((raw << above) as i64 >> above)
        }
        _ => raw,
    }
}

/// The abort to a slave in the middle of a transfer that ends: it would wait for the next segment.
pub fn farewell(sdo: &Sdo, end: End) -> Option<AbortCode> {
    let code = match end {
        Err(Failure::Unusable(object::TOGGLE)) => AbortCode::TOGGLE,
        Err(Failure::Unusable(_)) => AbortCode::GENERAL,
        Err(Failure::GivenUp(_)) => AbortCode::TIMED_OUT,
        Ok(()) | Err(Failure::Abort(_)) => return None,
    };
    sdo.is_begun().then_some(code)
}
