//! The application's end: a bounded queue of calls for any number of threads, tickets, and series of calls.
//!
//! The lock is between threads of the application only: the loop takes from a wait-free ring, whatever they do.

use std::any::Any;
use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::task::Waker;
use std::thread::sleep;
use std::time::{Duration, Instant};

use super::port::{Cancelled, Commanding, Ended, Guard, Port, Posted};
use super::{Answer, Call, CallError, Carrier, Condition, Notation, PostError, Series};
use crate::axis::observer::{GRACE, LOOK_EVERY, Observer};
use crate::axis::pulse::Pulse;
use crate::axis::{Feedback, cell};
use crate::rt::{self, Regions, Wires};
use crate::sync::{AtomicBool, Consumer, Mutex, MutexGuard, Producer};
use crate::time::nanos;

/// A call gets at least so many exchanges with its drive, however long the cycle is.
const EXCHANGES: u32 = 20;

/// The queue of one drive, before it has a name.
#[derive(Debug)]
pub struct AcyclicEnds {
    ends: Ends,
    shared: WithExecutor,
}

/// The state that the application's end shares with the executor.
#[derive(Debug)]
struct WithExecutor {
    capacity: usize,
    cancelled: Cancelled,
    guard: Guard,
    /// Wakes the executor, if that is not the loop.
    waker: Option<Waker>,
}

impl AcyclicEnds {
    /// Each post and each cancel wakes its executor, which is a thread outside the loop.
    pub fn waking(mut self, waker: Waker) -> AcyclicEnds {
        self.shared.waker = Some(waker);
        self
    }
}

/// A queue of `capacity` calls, some of them `commanding`: the application's end, and that of the executor.
pub fn queue(capacity: usize, commanding: Commanding) -> (AcyclicEnds, Port) {
    let capacity = capacity.max(1);
    let mut regions = Regions::new();
    let (call_in, call_out) = rt::ring(capacity, &mut regions);
    let (end_in, end_out) = rt::ring(capacity, &mut regions);
    let (cancelled, guard) = (Cancelled::new(capacity), Guard::new(commanding));
    let port = Port::new(call_out, end_in, cancelled.clone(), guard.clone(), regions);
    let ends = Ends {
        calls: call_in,
        ends: end_out,
        next: 1,
        next_series: 1,
        under_way: 0,
        ended: HashMap::new(),
        forgotten: Vec::new(),
    };
    (AcyclicEnds { ends, shared: WithExecutor { capacity, cancelled, guard, waker: None } }, port)
}

/// Acyclic access to one drive, for any number of threads.
#[derive(Clone, Debug)]
pub struct Acyclic {
    shared: Arc<Shared>,
    /// An application that waits here is alive: each look is a sign of life.
    pulse: Option<Pulse>,
}

#[derive(Debug)]
struct Shared {
    axis: String,
    notation: Arc<dyn Notation>,
    observer: Observer,
    /// The shortest time limit of a call.
    least: Duration,
    with_executor: WithExecutor,
    ends: Mutex<Ends>,
    claimed: AtomicBool,
}

#[derive(Debug)]
struct Ends {
    calls: Producer<Posted>,
    ends: Consumer<Ended>,
    next: u64,
    next_series: u64,
    /// Posted, and not known to have ended.
    under_way: usize,
    /// Ended, and their ticket is still held.
    ended: HashMap<u64, Result<Answer, CallError>>,
    /// Tickets that were dropped before their call ended.
    forgotten: Vec<u64>,
}

impl Acyclic {
    /// The acyclic access of axis `axis`, whose drive is exchanged with every `period`.
    #[doc(hidden)]
    pub fn new(
        axis: &str,
        ends: AcyclicEnds,
        notation: Arc<dyn Notation>,
        observer: Observer,
        period: Duration,
    ) -> Acyclic {
        let shared = Arc::new(Shared {
            axis: axis.to_owned(),
            notation,
            observer,
            least: period * EXCHANGES,
            with_executor: ends.shared,
            ends: Mutex::new(ends.ends),
            claimed: AtomicBool::new(false),
        });
        Acyclic { shared, pulse: None }
    }

    /// That of a drive `x` which no loop exchanges with, and the end of whoever carries out its calls.
    #[doc(hidden)]
    pub fn alone(capacity: usize, commanding: Commanding, notation: Arc<dyn Notation>) -> (Acyclic, Port) {
        let (ends, port) = queue(capacity, commanding);
        let (_, reader) = cell::cell(Feedback::default());
        let observer = Observer::new(reader, Wires::default());
        (Acyclic::new("x", ends, notation, observer, Duration::from_millis(1)), port)
    }

    /// The same for the application with this sign of life: a wait here beats its pulse.
    #[doc(hidden)]
    pub fn of_application(&self, pulse: &Pulse) -> Acyclic {
        Acyclic { pulse: Some(pulse.clone()), ..self.clone() }
    }

    /// Between two looks: a sign of life, and a short sleep.
    pub(in crate::axis) fn rest(&self) {
        if let Some(pulse) = &self.pulse {
            pulse.beat();
        }
        sleep(LOOK_EVERY);
    }

    /// The name of its axis.
    pub fn axis(&self) -> &str {
        &self.shared.axis
    }

    /// The notation of its drive for addresses and values.
    pub fn notation(&self) -> &Arc<dyn Notation> {
        &self.shared.notation
    }

    /// Posts a call and returns at once.
    #[doc(hidden)]
    pub fn post(&self, call: Call, limit: Duration) -> Result<CallTicket, PostError> {
        let mut ends = self.ends();
        self.room(&mut ends, &[call])?;
        let ticket = self.enqueue(&mut ends, 0, call, limit);
        drop(ends);
        self.wake();
        Ok(ticket)
    }

    /// Posts calls that belong together, all or none: the first failure ends the later ones.
    #[doc(hidden)]
    pub fn post_series(&self, calls: &[Call], limit: Duration) -> Result<Vec<CallTicket>, PostError> {
        let mut ends = self.ends();
        self.room(&mut ends, calls)?;
        let series = ends.next_series;
        ends.next_series += 1;
        let tickets = calls.iter().map(|call| self.enqueue(&mut ends, series, *call, limit)).collect();
        drop(ends);
        self.wake();
        Ok(tickets)
    }

    fn wake(&self) {
        if let Some(waker) = &self.shared.with_executor.waker {
            waker.wake_by_ref();
        }
    }

    /// As [`Carrier::run`], for a caller that has other work meanwhile: `rest` is called between two looks, and
    /// once it returns false, the calls that have not ended are cancelled.
    #[doc(hidden)]
    pub fn run_while(&self, calls: &[Call], limit: Duration, mut rest: impl FnMut() -> bool) -> Series {
        let mut series = Series::default();
        for calls in calls.chunks(self.shared.with_executor.capacity) {
            if let Err(why) = self.run_some(calls, limit, &mut rest, &mut series.answers) {
                return Series { failed: Some(why), ..series };
            }
        }
        series
    }

    /// Runs as many calls as the queue has room for.
    fn run_some(
        &self,
        calls: &[Call],
        limit: Duration,
        rest: &mut impl FnMut() -> bool,
        answers: &mut Vec<Answer>,
    ) -> Result<(), CallError> {
        let mut rest = || if rest() { Ok(()) } else { Err(CallError::Cancelled) };
        let begun = Instant::now();
        let tickets = loop {
            match self.post_series(calls, limit) {
                Err(PostError::Full { .. }) if begun.elapsed() < limit + GRACE => rest()?,
                posted => break posted?,
            }
        };
        for mut ticket in tickets {
            answers.push(loop {
                match ticket.poll() {
                    Some(end) => break end?,
                    None => rest()?,
                }
            });
        }
        Ok(())
    }

    fn ends(&self) -> MutexGuard<'_, Ends> {
        self.shared.ends.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Nothing is carried out by a loop that is stuck.
    fn stuck(&self) -> Option<CallError> {
        self.shared.observer.is_stuck().then_some(CallError::Stuck)
    }

    /// Whether these calls can be posted now.
    fn room(&self, ends: &mut Ends, calls: &[Call]) -> Result<(), PostError> {
        let axis = || self.shared.axis.clone();
        // Dropped tickets are not polled.
        self.collect(ends);
        if ends.calls.is_abandoned() {
            return Err(PostError::Gone { axis: axis() });
        }
        let refusal = || calls.iter().find_map(|call| self.shared.with_executor.guard.refusal(call));
        if let Some(why) = self.stuck().or_else(refusal) {
            return Err(PostError::Refused { axis: axis(), why });
        }
        if ends.under_way + calls.len() > self.shared.with_executor.capacity {
            return Err(PostError::Full { axis: axis(), capacity: self.shared.with_executor.capacity });
        }
        Ok(())
    }

    /// Posts a call for which there is room.
    fn enqueue(&self, ends: &mut Ends, series: u64, call: Call, limit: Duration) -> CallTicket {
        let number = ends.next;
        ends.next += 1;
        let limit_ns = nanos(limit.max(self.shared.least));
        let posted = Posted { number, series, limit_ns, call };
        match ends.calls.push(posted) {
            Ok(()) => ends.under_way += 1,
            // Never more calls are under way than the ring has places.
            Err(_) => drop(ends.ended.insert(number, Err(CallError::Gone))),
        }
        CallTicket { acyclic: self.clone(), number, over: false }
    }

    /// Hands the ended calls to the holders of their tickets.
    fn collect(&self, ends: &mut Ends) {
        // Read first: what ends between the two reads is found the next time.
        let gone = ends.ends.is_abandoned();
        while let Ok(Ended { number, result }) = ends.ends.pop() {
            ends.under_way -= 1;
            match ends.forgotten.iter().position(|forgotten| *forgotten == number) {
                Some(place) => drop(ends.forgotten.swap_remove(place)),
                None => drop(ends.ended.insert(number, result)),
            }
        }
        if gone {
            ends.forgotten.clear();
        }
    }
}

impl Carrier for Acyclic {
    fn run(&self, calls: &[Call], limit: Duration) -> Series {
        self.run_while(calls, limit, || {
            self.rest();
            true
        })
    }

    fn condition(&self) -> Result<Condition, CallError> {
        if self.ends().calls.is_abandoned() {
            return Err(CallError::Gone);
        }
        if let Some(why) = self.stuck() {
            return Err(why);
        }
        let feedback = self.shared.observer.feedback();
        Ok(Condition::of(feedback.link, feedback.status.state))
    }

    fn claim(&self) -> Result<Box<dyn Any + Send>, CallError> {
        match self.shared.claimed.swap(true, Ordering::AcqRel) {
            true => Err(CallError::Claimed),
            false => Ok(Box::new(Claim(Arc::clone(&self.shared)))),
        }
    }

    fn capacity(&self) -> usize {
        self.shared.with_executor.capacity
    }

    fn pause(&self, time: Duration) {
        let begun = Instant::now();
        while begun.elapsed() < time {
            self.rest();
        }
    }
}

/// A resource that a drive has only one of, held until this is dropped.
#[derive(Debug)]
struct Claim(Arc<Shared>);

impl Drop for Claim {
    fn drop(&mut self) {
        self.0.claimed.store(false, Ordering::Release);
    }
}

/// A call under way. If dropped before its end, it is cancelled.
#[derive(Debug)]
pub struct CallTicket {
    acyclic: Acyclic,
    number: u64,
    /// The end was returned.
    over: bool,
}

impl CallTicket {
    /// The result of the call, once, if it has ended. Never waits for the loop.
    pub fn poll(&mut self) -> Option<Result<Answer, CallError>> {
        if self.over {
            return None;
        }
        let mut ends = self.acyclic.ends();
        let gone = ends.ends.is_abandoned();
        self.acyclic.collect(&mut ends);
        let unserved = || gone.then_some(CallError::Gone).or_else(|| self.acyclic.stuck()).map(Err);
        let result = ends.ended.remove(&self.number).or_else(unserved)?;
        self.over = true;
        Some(result)
    }

    /// Waits for the result of the call. Its own time limit begins with its execution; the calls before it in the
    /// queue are waited for too.
    pub fn wait(&mut self) -> Result<Answer, CallError> {
        loop {
            if let Some(result) = self.poll() {
                return result;
            }
            if self.over {
                return Err(CallError::Cancelled);
            }
            self.acyclic.rest();
        }
    }

    /// Cancels the call: it ends as cancelled, unless it has ended already. If it was already sent, the drive may
    /// still carry it out.
    pub fn cancel(&self) {
        self.acyclic.shared.with_executor.cancelled.set(self.number);
        self.acyclic.wake();
    }
}

impl Drop for CallTicket {
    fn drop(&mut self) {
        if self.over {
            return;
        }
        self.cancel();
        let mut ends = self.acyclic.ends();
        self.acyclic.collect(&mut ends);
        if ends.ended.remove(&self.number).is_none() && !ends.ends.is_abandoned() {
            ends.forgotten.push(self.number);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::acyclic::Numbers;

    /// Nothing takes this long, however busy the host.
    const LIMIT: Duration = Duration::from_secs(60);

    /// Both ends of axis `x`.
    fn both(capacity: usize) -> (Acyclic, Port) {
        Acyclic::alone(capacity, Commanding::none(), Arc::new(Numbers))
    }

    #[test]
    fn a_call_without_room_was_never_sent_and_says_so() {
        let (acyclic, mut port) = both(2);
        let tickets = acyclic.post_series(&[Call::default(); 2], LIMIT).unwrap();
        let call = Call { value: 7, ..Call::default() };
        assert_eq!(acyclic.run(&[call], Duration::ZERO).failed, Some(CallError::Full));
        drop(tickets);
        assert_eq!(port.take(), None, "all others were cancelled");
    }

    #[test]
    fn an_insisted_call_is_repeated_until_it_is_done_or_refused() {
        for (last, expected) in [
            (Ok(Answer { value: 3, ..Answer::default() }), Ok(3)),
            (Err(CallError::Refused(0xD7)), Err(CallError::Refused(0xD7))),
        ] {
            let (acyclic, mut port) = both(2);
            let other_end = std::thread::spawn(move || {
                for result in [Err(CallError::NotOnline), Err(CallError::Restarted), last] {
                    let posted = loop {
                        match port.take() {
                            Some(posted) => break posted,
                            None => std::thread::yield_now(),
                        }
                    };
                    port.end(&posted, result);
                }
                port
            });
            let insisted = acyclic.insist(Call::default(), LIMIT, Duration::from_secs(60));
            assert_eq!(insisted.map(|answer| answer.value), expected);
            other_end.join().unwrap();
        }
        let (acyclic, port) = both(2);
        drop(port);
        assert_eq!(acyclic.insist(Call::default(), LIMIT, Duration::MAX), Err(CallError::Gone));
    }
}
