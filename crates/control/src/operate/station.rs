//! The axes of a running master under [`Operation`]'s rules, on the machine's clock: a thread that looks at them, and
//! the sessions that may operate them.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::sleep;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::operated::Operated;
use super::operation::Operation;
use super::request::{Reply, Request};
use crate::server::Urgency;
use fieldbeat_core::axis::Axis;
use fieldbeat_core::rt::MonotonicClock;
use fieldbeat_core::rt::thread::helper_thread;
use fieldbeat_telemetry::Monitor;

/// How often the axes are looked at while somebody operates them, and while nobody does.
const LOOK_EVERY: Duration = Duration::from_millis(5);
const LOOK_IDLE_EVERY: Duration = Duration::from_millis(50);

/// The remedy where a master has no station.
const NOT_ALLOWED: &str =
    "this master does not let others operate its axes: start it with `fieldbeat run CONFIG --allow-control`";

/// The axes of a master for whoever may operate them. Cheap to clone; its thread ends with the last one.
#[derive(Clone, Debug)]
pub struct Station(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    operation: Mutex<Operation>,
    monitor: Monitor,
    sessions: AtomicU64,
    failed: AtomicBool,
}

impl Shared {
    fn operation(&self) -> MutexGuard<'_, Operation> {
        self.operation.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Station {
    /// Of these axes of a master, all of them in their order.
    ///
    /// # Errors
    ///
    /// The thread could not be started.
    pub fn start(axes: Vec<Axis>, monitor: Monitor) -> std::io::Result<Station> {
        let axes = axes.into_iter().zip(monitor.plan().monitored());
        let operated = |(axis, channels): (Axis, [Option<_>; _])| {
            Operated::new(axis, channels.into_iter().flatten().collect())
        };
        let axes = axes.map(operated).collect();
        let core = monitor.granted().core;
        let (sessions, failed) = (AtomicU64::new(0), AtomicBool::new(false));
        let shared =
            Arc::new(Shared { operation: Mutex::new(Operation::new(axes)), monitor, sessions, failed });
        let watched = Arc::downgrade(&shared);
        std::thread::Builder::new().name("fb-operate".into()).spawn(move || {
            helper_thread(core);
            while let Some(shared) = watched.upgrade() {
                let look = AssertUnwindSafe(|| {
                    let mut operation = shared.operation();
                    operation.tick(MonotonicClock::read());
                    operation.is_active()
                });
                let Ok(is_active) = catch_unwind(look) else {
                    shared.failed.store(true, Ordering::Release);
                    break;
                };
                drop(shared);
                sleep(if is_active { LOOK_EVERY } else { LOOK_IDLE_EVERY });
            }
        })?;
        Ok(Station(shared))
    }

    /// Whether its thread panicked: nothing ends what is not held any more, and the master has to end.
    pub fn has_failed(&self) -> bool {
        self.0.failed.load(Ordering::Acquire)
    }

    /// A session of one client.
    pub fn session(&self) -> OperatorSession {
        OperatorSession { number: self.0.sessions.fetch_add(1, Ordering::Relaxed), station: self.clone() }
    }
}

/// The requests of one client to a station. When it is dropped, the client has left.
#[derive(Debug)]
pub struct OperatorSession {
    station: Station,
    number: u64,
}

impl OperatorSession {
    /// The answer to a request that names this beat, and the next beat.
    pub fn request(&self, beat: u64, request: &Request) -> (u64, Result<Reply, String>) {
        let shared = &self.station.0;
        if self.station.has_failed() {
            return (
                0,
                Err("internal error: the operation of the axes panicked; the master ends".to_owned()),
            );
        }
        // The time is read under the lock, which may have been waited for.
        let mut operation = shared.operation();
        let (beat, mut result) = operation.request(MonotonicClock::read(), self.number, beat, request);
        drop(operation);
        if let Ok(Reply::State(state)) = &mut result {
            for (index, axis) in state.axes.iter_mut().enumerate() {
                axis.not_connected = shared.monitor.not_connected(index);
            }
        }
        (beat, result)
    }
}

impl Drop for OperatorSession {
    fn drop(&mut self) {
        self.station.0.operation().leave(self.number);
    }
}

/// A request on its way to another process.
#[derive(Debug, Serialize, Deserialize)]
pub struct Envelope {
    /// Always "operate".
    pub ask: String,
    /// The beat that it names.
    pub beat: u64,
    /// The request.
    pub request: Request,
}

/// The way back.
#[derive(Debug, Serialize, Deserialize)]
pub struct Return {
    /// The next beat.
    pub beat: u64,
    /// The answer, or why it is refused.
    pub reply: Result<Reply, String>,
}

/// How soon a question of another process is to be answered, if it is about operating the axes.
pub fn urgency(question: &Value) -> Option<Urgency> {
    let request = &question["request"];
    let is_stop = *request == json!(Request::Stop) || request["stop_axis"].is_u64();
    (question["ask"] == "operate").then_some(if is_stop { Urgency::Stop } else { Urgency::Operate })
}

/// Answers a question of another process, if it is about operating the axes: `None` to any other. `session`: what the
/// conversation has, if its master lets others operate. An error ends the conversation, and with it the session.
pub fn answer(session: Option<&OperatorSession>, question: &Value) -> Option<Result<Value, String>> {
    if question["ask"] != "operate" {
        return None;
    }
    let Some(session) = session else { return Some(Err(NOT_ALLOWED.to_owned())) };
    Some(match Envelope::deserialize(question) {
        Ok(Envelope { beat, request, .. }) => {
            let (beat, reply) = session.request(beat, &request);
            Ok(json!(Return { beat, reply }))
        }
        Err(error) => Err(format!("cannot read the request: {error}; is it another version?")),
    })
}
