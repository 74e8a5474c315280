//! Acyclic calls in virtual time: whoever waits for one lets the machine turn meanwhile.

use std::any::Any;
use std::cell::RefCell;
use std::time::Duration;

use fieldbeat::axis::{Acyclic, Answer, Call, CallError, CallTicket, Series};
use fieldbeat_core::axis::acyclic::{Carrier, Condition};

use crate::virtual_time::support::Bench;

/// Turns after which a call that has not ended never will: 200 s.
const MOST: u64 = 200_000;

/// What a call is given that does not care.
pub const LIMIT: Duration = Duration::from_secs(1);

type Each<'a> = Box<dyn FnMut(&mut Bench, u64) + 'a>;

/// The drive of one axis, while its bench turns.
pub struct Turning<'a> {
    bench: RefCell<&'a mut Bench>,
    index: usize,
    /// Before each turn, with its number from the first call on.
    each: RefCell<Each<'a>>,
    turns: RefCell<u64>,
}

impl<'a> Turning<'a> {
    pub fn new(bench: &'a mut Bench, index: usize) -> Turning<'a> {
        Turning::with(bench, index, |_, _| ())
    }

    /// With something that happens on the way.
    pub fn with(bench: &'a mut Bench, index: usize, each: impl FnMut(&mut Bench, u64) + 'a) -> Turning<'a> {
        let (each, turns) = (RefCell::new(Box::new(each) as Each<'a>), RefCell::new(0));
        Turning { bench: RefCell::new(bench), index, each, turns }
    }

    /// Turns since the first call.
    pub fn turns(&self) -> u64 {
        *self.turns.borrow()
    }

    fn turn(&self) {
        let mut bench = self.bench.borrow_mut();
        let turn = *self.turns.borrow();
        (self.each.borrow_mut())(&mut bench, turn);
        bench.step();
        *self.turns.borrow_mut() += 1;
    }

    fn acyclic(&self) -> Acyclic {
        self.bench.borrow_mut().sim.axis(self.index).acyclic().clone()
    }
}

impl Carrier for Turning<'_> {
    fn run(&self, calls: &[Call], limit: Duration) -> Series {
        let begun = self.turns();
        self.acyclic().run_while(calls, limit, || {
            let most = MOST.saturating_mul(calls.len() as u64);
            assert!(self.turns() - begun < most, "a call without an end: {calls:?}");
            self.turn();
            true
        })
    }

    fn condition(&self) -> Result<Condition, CallError> {
        self.acyclic().condition()
    }

    fn claim(&self) -> Result<Box<dyn Any + Send>, CallError> {
        self.acyclic().claim()
    }

    fn capacity(&self) -> usize {
        self.acyclic().capacity()
    }

    /// A turn is a millisecond.
    fn pause(&self, time: Duration) {
        (0..time.as_millis()).for_each(|_| self.turn());
    }
}

impl Bench {
    /// Posts a call.
    pub fn call(&mut self, index: usize, call: Call) -> CallTicket {
        self.sim.axis(index).acyclic().post(call, LIMIT).expect("there is room")
    }

    /// Turns until a call has ended.
    pub fn call_ended(&mut self, ticket: &mut CallTicket) -> Result<Answer, CallError> {
        for _ in 0..MOST {
            if let Some(end) = ticket.poll() {
                return end;
            }
            self.step();
        }
        panic!("a call without an end: {ticket:?}");
    }

    /// The value of a parameter.
    pub fn read(&mut self, index: usize, address: &str) -> Result<u64, CallError> {
        let call = self.sim.axis(index).acyclic().notation().read(address).expect("an address");
        let mut ticket = self.call(index, call);
        self.call_ended(&mut ticket).map(|answer| answer.value)
    }

    /// Writes a parameter.
    pub fn write(&mut self, index: usize, address: &str, value: u64) -> Result<(), CallError> {
        let call = self.sim.axis(index).acyclic().notation().write(address, value).expect("an address");
        let mut ticket = self.call(index, call);
        self.call_ended(&mut ticket).map(drop)
    }
}
