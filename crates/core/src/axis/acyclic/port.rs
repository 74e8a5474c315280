//! The executor's end of the calls. On the real-time thread: bounded work, no allocation, no lock, no wait.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::{Answer, Call, CallError};
use crate::inputs::{Inlet, InputLog};
use crate::rt::Regions;
use crate::sync::{AtomicBool, AtomicU64, Consumer, Producer};

/// The most calls that end in one cycle without having been carried out.
const MOST_ENDS: usize = 64;

/// A call on its way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Posted {
    /// The id. Numbers grow by one; 0 is never used.
    pub number: u64,
    /// Common to all calls of one series, of which the first failure ends the series. 0 = a single call.
    pub series: u64,
    /// The time limit, from the start of its execution, ns.
    pub limit_ns: u64,
    /// The call.
    pub call: Call,
}

/// How a call ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Ended {
    pub number: u64,
    pub result: Result<Answer, CallError>,
}

/// The numbers of cancelled calls, each at the index of its number modulo the length: there are never more calls
/// under way than places.
#[derive(Clone, Debug)]
pub(super) struct Cancelled(Arc<[AtomicU64]>);

impl Cancelled {
    pub(super) fn new(capacity: usize) -> Cancelled {
        Cancelled((0..capacity.max(1)).map(|_| AtomicU64::new(0)).collect())
    }

    fn place(&self, number: u64) -> &AtomicU64 {
        // The remainder is below the length.
        &self.0[(number % self.0.len() as u64) as usize]
    }

    /// A number that has ended does not cancel a later one in its place.
    pub(super) fn set(&self, number: u64) {
        self.place(number).fetch_max(number, Ordering::Relaxed);
    }

    fn has(&self, number: u64) -> bool {
        self.place(number).load(Ordering::Relaxed) == number
    }
}

/// The calls that command a drive: those that can move it, or switch its power on or off. The protocol answers it for
/// each call, in its own folder.
#[derive(Clone, Debug)]
pub struct Commanding {
    refusal: fn(&Call, &[u32]) -> Option<CallError>,
    mapped: Arc<[u32]>,
}

impl Commanding {
    /// `refusal` says why a call is refused while the power of its drive is on; `None`: it is not. It gets `mapped`
    /// too: the addresses of the drive's cyclic outputs, which no call may write then.
    pub fn new(
        refusal: fn(&Call, &[u32]) -> Option<CallError>,
        mapped: impl IntoIterator<Item = u32>,
    ) -> Commanding {
        Commanding { refusal, mapped: mapped.into_iter().collect() }
    }

    /// No call does: there is no power to switch.
    pub fn none() -> Commanding {
        Commanding::new(|_, _| None, [])
    }

    /// Why this call is refused while power is on.
    pub(super) fn refusal(&self, call: &Call) -> Option<CallError> {
        (self.refusal)(call, &self.mapped)
    }
}

/// Whether the calls that command the drive are refused at present, and which those are.
#[derive(Clone, Debug)]
pub(super) struct Guard {
    pub commanding: Commanding,
    on: Arc<AtomicBool>,
}

impl Guard {
    pub(super) fn new(commanding: Commanding) -> Guard {
        Guard { commanding, on: Arc::default() }
    }

    /// Why this call is refused now.
    pub(super) fn refusal(&self, call: &Call) -> Option<CallError> {
        // The loop decides again when it builds the telegram: nothing else hangs on this flag.
        if self.on.load(Ordering::Relaxed) { self.commanding.refusal(call) } else { None }
    }
}

/// The source of calls and the destination of their ends.
#[derive(Debug)]
pub struct Port {
    calls: Inlet<Posted>,
    log: InputLog,
    ends: Producer<Ended>,
    cancelled: Cancelled,
    guard: Guard,
    /// The series whose call failed last.
    failed: u64,
    regions: Regions,
}

impl Port {
    pub(super) fn new(
        calls: Consumer<Posted>,
        ends: Producer<Ended>,
        cancelled: Cancelled,
        guard: Guard,
        regions: Regions,
    ) -> Port {
        Port {
            calls: Inlet::new(calls),
            log: InputLog::default(),
            ends,
            cancelled,
            guard,
            failed: 0,
            regions,
        }
    }

    /// The same for an executor that is the loop, whose inputs are in this log.
    pub fn logged(mut self, log: &InputLog) -> Port {
        (self.calls, self.log) = (self.calls.logged(log), log.source());
        self
    }

    /// Adds what it touches, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        regions.extend(&self.regions);
        regions.add(&*self.cancelled.0);
        regions.add(&*self.guard.on);
        regions.add(&*self.guard.commanding.mapped);
    }

    /// From now on the calls that command the drive are refused, or not.
    #[inline]
    pub fn guard(&mut self, on: bool) {
        if self.guard.on.load(Ordering::Relaxed) != on {
            self.guard.on.store(on, Ordering::Relaxed);
        }
    }

    /// Why a call of which nothing was sent yet must not be sent now.
    pub fn refusal(&self, posted: &Posted) -> Option<CallError> {
        self.guard.refusal(&posted.call)
    }

    /// Whether a call commands the drive.
    pub fn commands(&self, posted: &Posted) -> bool {
        self.guard.commanding.refusal(&posted.call).is_some()
    }

    /// Nothing is posted.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.calls.is_empty()
    }

    /// The next call to carry out. Cancelled calls, those of a series that has failed, and those that command a
    /// guarded drive end here, a bounded number in one cycle.
    #[inline]
    pub fn take(&mut self) -> Option<Posted> {
        // The usual case.
        if self.calls.is_empty() { None } else { self.take_if(|_| true) }
    }

    /// The same if it is `wanted`; else it stays the next one.
    pub fn take_if(&mut self, wanted: impl Fn(&Posted) -> bool) -> Option<Posted> {
        // Bounded by what is queued now: the application may go on posting.
        for _ in 0..self.calls.slots().min(MOST_ENDS) {
            let posted = *self.calls.peek()?;
            let over = if self.is_cancelled(&posted) {
                Some(CallError::Cancelled)
            } else if posted.series != 0 && posted.series == self.failed {
                Some(CallError::Skipped)
            } else {
                self.refusal(&posted)
            };
            if over.is_none() && !wanted(&posted) {
                return None;
            }
            self.calls.pop()?;
            match over {
                Some(why) => self.end(&posted, Err(why)),
                None => return Some(posted),
            }
        }
        None
    }

    /// Ends the calls that are queued now, a bounded number in one cycle.
    pub fn refuse_all(&mut self, why: CallError) {
        for _ in 0..self.calls.slots().min(MOST_ENDS) {
            let Some(posted) = self.calls.pop() else { return };
            self.end(&posted, Err(why));
        }
    }

    /// Whether the application has cancelled this call.
    pub fn is_cancelled(&self, posted: &Posted) -> bool {
        self.log.flag(false, self.cancelled.has(posted.number))
    }

    /// Ends a call whose execution had begun.
    pub fn end(&mut self, posted: &Posted, result: Result<Answer, CallError>) {
        if result.is_err() && posted.series != 0 {
            self.failed = posted.series;
        }
        // There is room for the end of every accepted call.
        let _ = self.ends.push(Ended { number: posted.number, result });
    }
}
