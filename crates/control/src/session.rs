//! Acyclic access to the drives of a running master, for other processes: the master's side of one conversation.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use fieldbeat_core::axis::acyclic::{Acyclic, Call, CallError, Carrier, Condition, Series};

/// How often a series under way is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(1);

/// The longest that one call may be given.
const LONGEST: Duration = Duration::from_secs(600);

/// The time limit of each call of a legacy, and for how long it is tried: a drive that saves to flash was met to be
/// silent for 75 s and more (C1250), and is given four times that.
const LEGACY_LIMIT: Duration = Duration::from_secs(20);
const LEGACY_PATIENCE: Duration = Duration::from_secs(300);

/// Legacies of one master that are left or carried out, at most: clients that come and go leave no more work than that.
const MOST_LEGACIES: usize = 32;

/// The remedy where there are as many.
const TOO_MANY_LEGACIES: &str =
    "what others have left to be done is still under way: check the links of the drives, and try again";

/// The count of the legacies of one master.
#[derive(Clone, Debug, Default)]
pub struct Legacies(Arc<AtomicUsize>);

impl Legacies {
    fn further(&self) -> Option<Counted> {
        let more = |count| (count < MOST_LEGACIES).then_some(count + 1);
        self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).ok().map(|_| Counted(self.clone()))
    }
}

/// One of them.
#[derive(Debug)]
struct Counted(Legacies);

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The drives, and what this conversation has of them. All of that ends with it.
#[derive(Debug)]
pub struct Session {
    drives: Vec<Held>,
    legacies: Legacies,
}

/// One drive.
#[derive(Debug)]
struct Held {
    acyclic: Acyclic,
    claim: Option<Box<dyn Any + Send>>,
    /// The calls to carry out should the conversation end before they are taken back.
    legacy: Option<(Counted, Vec<Call>)>,
}

impl Session {
    /// A session with these drives of a master, whose sessions share `legacies`.
    pub fn new(acyclics: Vec<Acyclic>, legacies: &Legacies) -> Session {
        let held = |acyclic| Held { acyclic, claim: None, legacy: None };
        Session { drives: acyclics.into_iter().map(held).collect(), legacies: legacies.clone() }
    }

    /// Whether an answer may take long: the calls of a drive take their time.
    pub fn is_slow(question: &Value) -> bool {
        question["ask"] == "calls"
    }

    /// Answers the questions that are about drives; `None` to any other.
    pub fn answer(&mut self, question: &Value, go_on: &dyn Fn() -> bool) -> Option<Result<Value, String>> {
        let request = question["ask"].as_str()?;
        if !["drive", "claim", "release", "condition", "calls", "bequeath"].contains(&request) {
            return None;
        }
        let name = question["drive"].as_str().unwrap_or_default();
        let Some(held) = self.drives.iter_mut().find(|held| held.acyclic.axis() == name) else {
            return Some(Err(format!(
                "this master has no drive {name:?}; does it run another configuration?"
            )));
        };
        let acyclic = &held.acyclic;
        Some(match request {
            "drive" => {
                let protocol = acyclic.notation().protocol();
                Ok(json!({ "protocol": protocol, "capacity": acyclic.capacity() }))
            }
            "claim" => match acyclic.claim() {
                Ok(claim) => {
                    held.claim = Some(claim);
                    Ok(json!({ "claimed": true }))
                }
                Err(error) => Ok(json!({ "failed": error })),
            },
            "release" => {
                held.claim = None;
                Ok(json!({ "released": true }))
            }
            "condition" => Ok(match acyclic.condition() {
                Ok(condition) => json!({ "condition": condition }),
                Err(error) => json!({ "failed": error }),
            }),
            "bequeath" => calls_of(acyclic, question).and_then(|calls| {
                let count = calls.len();
                // Another one of this conversation takes the place of the one before.
                let before = held.legacy.take().map(|(counted, _)| counted);
                if count > 0 {
                    let counted = before.or_else(|| self.legacies.further()).ok_or(TOO_MANY_LEGACIES)?;
                    held.legacy = Some((counted, calls));
                }
                Ok(json!({ "bequeathed": count }))
            }),
            _ => calls_of(acyclic, question).map(|calls| {
                let limit = question["limit_ms"].as_u64().map_or(Duration::ZERO, Duration::from_millis);
                json!(Attended { acyclic, go_on }.run(&calls, limit.min(LONGEST)))
            }),
        })
    }

    /// The conversation is over: carries out what it left to be done, while `go_on`. What it had claimed stays claimed
    /// until then.
    pub fn end(&mut self, go_on: &dyn Fn() -> bool) {
        for held in &mut self.drives {
            let attended = Attended { acyclic: &held.acyclic, go_on };
            let Some((_counted, calls)) = held.legacy.take() else { continue };
            for call in calls {
                // The client has gone: there is nobody to report to.
                let _ = attended.insist(call, LEGACY_LIMIT, LEGACY_PATIENCE);
            }
        }
    }
}

/// The calls of a question.
fn calls_of(acyclic: &Acyclic, question: &Value) -> Result<Vec<Call>, String> {
    let calls: Vec<Call> = serde_json::from_value(question["calls"].clone())
        .map_err(|error| format!("cannot read the calls: {error}; is it another version?"))?;
    if calls.len() > acyclic.capacity() {
        return Err(format!("{} calls at once; at most {}", calls.len(), acyclic.capacity()));
    }
    Ok(calls)
}

/// A drive, while somebody waits for it.
struct Attended<'a> {
    acyclic: &'a Acyclic,
    go_on: &'a dyn Fn() -> bool,
}

impl Carrier for Attended<'_> {
    fn run(&self, calls: &[Call], limit: Duration) -> Series {
        self.acyclic.run_while(calls, limit, || {
            sleep(LOOK_EVERY);
            (self.go_on)()
        })
    }

    fn condition(&self) -> Result<Condition, CallError> {
        self.acyclic.condition()
    }

    fn claim(&self) -> Result<Box<dyn Any + Send>, CallError> {
        self.acyclic.claim()
    }

    fn capacity(&self) -> usize {
        self.acyclic.capacity()
    }

    fn pause(&self, time: Duration) {
        let begun = Instant::now();
        while begun.elapsed() < time && (self.go_on)() {
            sleep(LOOK_EVERY);
        }
    }
}
