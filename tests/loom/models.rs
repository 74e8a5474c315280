//! The feedback cell, the newest setpoints, the doorbell, the acyclic queue, the word that owns the wires and the ring
//! of the log, built with the primitives of a model checker.
//!
//! The files are those of the library. What they need besides is here: its ring is a queue behind a lock, so that each
//! access is a point at which another thread may run, and there is no memory to be locked.

#[path = "."]
pub mod axis {
    //! As in the library.

    #[path = "../../crates/core/src/axis/acyclic/mod.rs"]
    pub mod acyclic;
    #[path = "../../crates/core/src/axis/cell.rs"]
    pub mod cell;
    #[path = "../../crates/core/src/axis/doorbell.rs"]
    pub mod doorbell;
    #[path = "../../crates/core/src/axis/feedback.rs"]
    pub mod feedback;
    #[path = "../../crates/core/src/axis/newest.rs"]
    pub mod newest;
    #[path = "../../crates/core/src/axis/pulse.rs"]
    pub mod pulse;

    pub use feedback::Feedback;

    pub mod command {
        //! What a setpoint is.

        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct CommandId(pub u64);

        #[derive(Clone, Copy, Debug, Default, PartialEq)]
        pub struct Setpoint {
            pub member: u32,
            pub parts: u32,
            pub number: u64,
            pub of: CommandId,
            pub value: f64,
        }

        crate::word! {
            CommandId: |id: CommandId| id.0, CommandId;
        }

        crate::parts! {
            Setpoint { member, parts, number, of, value }
        }
    }

    pub mod observer {
        //! What the queue needs of an axis.

        use std::time::Duration;

        use super::cell::Reader;
        use super::feedback::Feedback;
        use crate::rt::Wires;

        pub const LOOK_EVERY: Duration = Duration::ZERO;
        pub const GRACE: Duration = Duration::ZERO;

        #[derive(Clone, Debug)]
        pub struct Observer(pub Reader<Feedback>);

        impl Observer {
            pub fn new(reader: Reader<Feedback>, _wires: Wires) -> Observer {
                Observer(reader)
            }

            pub fn feedback(&self) -> Feedback {
                self.0.read()
            }

            pub fn is_stuck(&self) -> bool {
                false
            }
        }
    }
}
#[path = "../../crates/core/src/errors.rs"]
mod errors;
#[path = "../../crates/core/src/named.rs"]
mod named;
#[path = "../../crates/core/src/packed.rs"]
pub mod packed;
#[path = "../../crates/core/src/time.rs"]
pub mod time;

#[path = "."]
pub mod rt {
    //! Rings, the word that owns the wires, and no memory to be locked.

    #[path = "../../crates/core/src/rt/wires.rs"]
    mod wires;
    pub use wires::{Taker, Wires, Words};

    use std::sync::Arc;

    use crate::sync::{Consumer, Producer};

    /// Values that threads share.
    #[derive(Debug, Default)]
    pub struct Held<T>(Arc<T>);

    impl<T> Held<T> {
        pub fn first(&self) -> &T {
            &self.0
        }
    }

    impl<T> Clone for Held<T> {
        fn clone(&self) -> Held<T> {
            Held(Arc::clone(&self.0))
        }
    }

    #[derive(Clone, Debug, Default)]
    pub struct Regions;

    impl Regions {
        pub fn new() -> Regions {
            Regions
        }

        pub fn add<T: ?Sized>(&mut self, _part: &T) {}

        pub fn extend(&mut self, _other: &Regions) {}
    }

    pub fn ring<T>(capacity: usize, _regions: &mut Regions) -> (Producer<T>, Consumer<T>) {
        crate::sync::ring(capacity)
    }
}

#[path = "."]
pub mod inputs {
    //! Queues, no log of what is taken from them, and the ring of that log by itself.

    #[path = "../../crates/core/src/inputs/entry.rs"]
    pub mod entry;
    #[path = "../../crates/core/src/inputs/recording.rs"]
    pub mod recording;

    use crate::sync::Consumer;

    #[derive(Clone, Debug, Default)]
    pub struct InputLog;

    impl InputLog {
        pub fn source(&self) -> InputLog {
            InputLog
        }

        pub fn value(&self, _usual: u64, found: u64) -> u64 {
            found
        }

        pub fn flag(&self, _usual: bool, found: bool) -> bool {
            found
        }
    }

    #[derive(Debug)]
    pub struct Inlet<T>(Consumer<T>);

    impl<T: Copy> Inlet<T> {
        pub fn new(queue: Consumer<T>) -> Inlet<T> {
            Inlet(queue)
        }

        pub fn logged(self, _log: &InputLog) -> Inlet<T> {
            self
        }

        pub fn is_empty(&self) -> bool {
            self.0.is_empty()
        }

        pub fn slots(&mut self) -> usize {
            self.0.slots()
        }

        pub fn peek(&mut self) -> Option<Box<T>> {
            self.0.peek().ok()
        }

        pub fn pop(&mut self) -> Option<T> {
            self.0.pop().ok()
        }
    }
}

pub mod sync {
    //! The primitives of the model checker, by the names of the library's.

    use std::collections::VecDeque;
    use std::sync::Arc;

    pub use loom::sync::atomic::{AtomicBool, AtomicU64, Ordering, fence};
    pub use loom::sync::{Mutex, MutexGuard};

    /// A reader that has to wait lets the others run.
    #[derive(Debug)]
    pub struct Backoff;

    impl Backoff {
        pub fn new() -> Backoff {
            Backoff
        }

        pub fn snooze(&self) {
            loom::thread::yield_now();
        }
    }

    #[derive(Debug)]
    struct Ring<T> {
        queue: Mutex<VecDeque<T>>,
        capacity: usize,
        abandoned: AtomicBool,
    }

    #[derive(Debug)]
    pub struct Producer<T>(Arc<Ring<T>>);

    #[derive(Debug)]
    pub struct Consumer<T>(Arc<Ring<T>>);

    pub fn ring<T>(capacity: usize) -> (Producer<T>, Consumer<T>) {
        let queue = Mutex::new(VecDeque::new());
        let ring = Arc::new(Ring { queue, capacity, abandoned: AtomicBool::new(false) });
        (Producer(Arc::clone(&ring)), Consumer(ring))
    }

    impl<T> Ring<T> {
        fn length(&self) -> usize {
            self.queue.lock().unwrap().len()
        }
    }

    impl<T> Producer<T> {
        pub fn push(&mut self, value: T) -> Result<(), T> {
            let mut queue = self.0.queue.lock().unwrap();
            if queue.len() == self.0.capacity {
                return Err(value);
            }
            queue.push_back(value);
            Ok(())
        }

        pub fn is_abandoned(&self) -> bool {
            self.0.abandoned.load(Ordering::Acquire)
        }
    }

    impl<T> Consumer<T> {
        pub fn pop(&mut self) -> Result<T, ()> {
            self.0.queue.lock().unwrap().pop_front().ok_or(())
        }

        /// A copy, since the lock ends here.
        pub fn peek(&self) -> Result<Box<T>, ()>
        where
            T: Copy,
        {
            self.0.queue.lock().unwrap().front().copied().map(Box::new).ok_or(())
        }

        pub fn slots(&self) -> usize {
            self.0.length()
        }

        pub fn is_empty(&self) -> bool {
            self.0.length() == 0
        }

        pub fn is_abandoned(&self) -> bool {
            self.0.abandoned.load(Ordering::Acquire)
        }
    }

    impl<T> Drop for Producer<T> {
        fn drop(&mut self) {
            self.0.abandoned.store(true, Ordering::Release);
        }
    }

    impl<T> Drop for Consumer<T> {
        fn drop(&mut self) {
            self.0.abandoned.store(true, Ordering::Release);
        }
    }
}

/// Both ends of a queue of calls.
pub fn calls(capacity: usize) -> (axis::acyclic::Acyclic, axis::acyclic::Port) {
    use std::sync::Arc;
    use std::time::Duration;

    use axis::acyclic::{Acyclic, Commanding, queue};
    use axis::cell::cell;
    use axis::observer::Observer;

    let (ends, port) = queue(capacity, Commanding::none());
    let (_, reader) = cell(axis::Feedback::default());
    (Acyclic::new("x", ends, Arc::new(NoNotation), Observer(reader), Duration::ZERO), port)
}

/// Nothing here has an address.
#[derive(Debug)]
struct NoNotation;

impl axis::acyclic::Notation for NoNotation {
    fn protocol(&self) -> &'static str {
        "none"
    }

    fn place(&self, _address: &str) -> Result<axis::acyclic::Place, axis::acyclic::NotationError> {
        let call = axis::acyclic::Call::default();
        let values = axis::acyclic::Values::Unknown { form: String::new() };
        Ok(axis::acyclic::Place { read: Ok(call), write: Ok(call), values })
    }

    fn show(&self, _address: &str, raw: u64) -> String {
        raw.to_string()
    }

    fn reason(&self, status: u32) -> String {
        status.to_string()
    }
}
