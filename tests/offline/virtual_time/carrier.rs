//! Acyclic calls in virtual time: whoever waits for one lets the machine turn meanwhile.

use std::any::Any;
use std::cell::RefCell;
use std::time::Duration;

use fieldbeat::Simulation;
use fieldbeat::axis::{Acyclic, CallError};
use fieldbeat_core::axis::acyclic::{Carrier, Condition};
use fieldbeat_core::axis::{Answer, Call, CallTicket, Series};

use crate::virtual_time::support::Bench;

/// Turns after which a call that has not ended never will: 200 s.
const MOST: u64 = 200_000;

/// What a call is given that does not care.
pub const LIMIT: Duration = Duration::from_secs(1);

/// A machine of a test.
pub trait Turns {
    fn sim(&mut self) -> &mut Simulation;

    fn turn(&mut self) {
        self.sim().step();
    }
}

impl Turns for Bench {
    fn sim(&mut self) -> &mut Simulation {
        &mut self.sim
    }

    fn turn(&mut self) {
        self.step();
    }
}

type Each<'a, B> = Box<dyn FnMut(&mut B, u64) + 'a>;

/// The drive of one axis, while its bench turns.
pub struct Turning<'a, B> {
    bench: RefCell<&'a mut B>,
    index: usize,
    /// Before each turn, with its number from the first call on.
    each: RefCell<Each<'a, B>>,
    turns: RefCell<u64>,
}

impl<'a, B: Turns> Turning<'a, B> {
    pub fn new(bench: &'a mut B, index: usize) -> Turning<'a, B> {
        Turning::with(bench, index, |_, _| ())
    }

    /// With something that happens on the way.
    pub fn with(bench: &'a mut B, index: usize, each: impl FnMut(&mut B, u64) + 'a) -> Turning<'a, B> {
        let (each, turns) = (RefCell::new(Box::new(each) as Each<'a, B>), RefCell::new(0));
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
        bench.turn();
        *self.turns.borrow_mut() += 1;
    }

    fn acyclic(&self) -> Acyclic {
        self.bench.borrow_mut().sim().axis(self.index).acyclic().clone()
    }
}

impl<B: Turns> Carrier for Turning<'_, B> {
    fn run(&self, calls: &[Call], limit: Duration) -> Series {
        let begun = self.turns();
        self.acyclic().run_while(calls, limit, || {
            let most = MOST.saturating_mul(calls.len() as u64);
            assert!(self.turns() - begun < most, "a call without an end: {calls:?}");
            self.turn();
            true
        })
    }

    crate::forward! { this => this.acyclic();
        fn condition(&self) -> Result<Condition, CallError>;
        fn claim(&self) -> Result<Box<dyn Any + Send>, CallError>;
        fn capacity(&self) -> usize;
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
