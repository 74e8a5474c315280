//! Acyclic access to a drive of a master in another process: the client side.

use std::any::Any;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::sleep;
use std::time::Duration;

use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use super::client::{AskError, Conversation};
use fieldbeat_core::axis::acyclic::{Call, CallError, Carrier, Condition, Series};

/// How long the master's own process may take beyond the calls themselves.
const MARGIN: Duration = Duration::from_secs(5);

/// Calls of one question: it has to fit into the bytes that a master reads.
const MOST_CALLS: usize = 64;

/// One drive of a master in another process. The conversation ends with this and all guards of what it has claimed.
#[derive(Debug)]
pub struct Remote {
    questions: Arc<Questions>,
    capacity: usize,
}

/// A conversation about one drive.
#[derive(Debug)]
struct Questions {
    path: PathBuf,
    conversation: Conversation,
    drive: String,
}

impl Remote {
    /// Drive `drive` of the master that answers at `path`.
    pub fn open(path: &Path, drive: &str) -> Result<Remote, AskError> {
        let conversation = Conversation::open(path)?;
        let answer = conversation.ask(&json!({ "ask": "drive", "drive": drive }), MARGIN)?;
        let capacity = answer["capacity"].as_u64().and_then(|capacity| usize::try_from(capacity).ok());
        let capacity = capacity.ok_or_else(|| AskError::Foreign(path.to_owned()))?.clamp(1, MOST_CALLS);
        let questions = Questions { path: path.to_owned(), conversation, drive: drive.to_owned() };
        Ok(Remote { questions: Arc::new(questions), capacity })
    }
}

impl Questions {
    fn ask(&self, what: &str, more: Value, patience: Duration) -> Result<Value, CallError> {
        let mut question = json!({ "ask": what, "drive": self.drive });
        if let (Value::Object(question), Value::Object(more)) = (&mut question, more) {
            question.extend(more);
        }
        self.conversation.ask(&question, patience).map_err(|_| match Conversation::open(&self.path) {
            Err(AskError::Nobody(_) | AskError::Dead(_)) => CallError::Gone,
            // Somebody listens there: it was this conversation that failed.
            _ => CallError::Lost,
        })
    }
}

fn read<T: DeserializeOwned>(value: &Value) -> Option<T> {
    T::deserialize(value).ok()
}

impl Carrier for Remote {
    fn run(&self, calls: &[Call], limit: Duration) -> Series {
        let mut all = Series::default();
        for calls in calls.chunks(self.capacity) {
            let limit_ms = u64::try_from(limit.as_millis()).unwrap_or(u64::MAX);
            // In a long cycle a call may take longer than its limit; the master keeps the time.
            let patience = limit.saturating_mul(calls.len() as u32).saturating_add(MARGIN);
            let request = json!({ "calls": calls, "limit_ms": limit_ms });
            let answer = self.questions.ask("calls", request, patience);
            let series: Series = match answer.and_then(|answer| read(&answer).ok_or(CallError::Lost)) {
                Ok(series) => series,
                Err(why) => return Series { failed: Some(why), ..all },
            };
            all.answers.extend(series.answers);
            if series.failed.is_some() {
                return Series { failed: series.failed, ..all };
            }
        }
        all
    }

    fn condition(&self) -> Result<Condition, CallError> {
        let answer = self.questions.ask("condition", Value::Null, MARGIN)?;
        read(&answer["condition"]).ok_or_else(|| read(&answer["failed"]).unwrap_or(CallError::Lost))
    }

    fn claim(&self) -> Result<Box<dyn Any + Send>, CallError> {
        let answer = self.questions.ask("claim", Value::Null, MARGIN)?;
        match answer["claimed"].as_bool() {
            Some(true) => Ok(Box::new(Claim(Arc::clone(&self.questions)))),
            _ => Err(read(&answer["failed"]).unwrap_or(CallError::Lost)),
        }
    }

    fn capacity(&self) -> usize {
        self.capacity
    }

    fn pause(&self, time: Duration) {
        sleep(time);
    }

    fn bequeath(&self, calls: &[Call]) -> Result<(), CallError> {
        self.questions.ask("bequeath", json!({ "calls": calls }), MARGIN).map(drop)
    }
}

/// The exclusive part of a drive, held until this is dropped, or the conversation ends.
#[derive(Debug)]
struct Claim(Arc<Questions>);

impl Drop for Claim {
    fn drop(&mut self) {
        // If it does not arrive, the conversation has ended, and the claim with it.
        let _ = self.0.ask("release", Value::Null, MARGIN);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::thread::JoinHandle;

    use crossbeam_channel::Receiver;
    use tempfile::TempDir;

    use super::super::{Answering, Legacies, Server, Session};
    use super::*;
    use fieldbeat_core::axis::acyclic::{Acyclic, Answer, Commanding};
    use fieldbeat_linudp::notation::Upids;

    const LIMIT: Duration = Duration::from_secs(60);

    /// A call that is never answered, and so taken up again by nobody.
    const SILENT: u64 = 99;

    struct Only(Session);

    impl Answering for Only {
        fn answer(&mut self, question: &Value, go_on: &dyn Fn() -> bool) -> Result<Value, String> {
            self.0.answer(question, go_on).unwrap_or_else(|| Err("what?".to_owned()))
        }

        fn end(&mut self, go_on: &dyn Fn() -> bool) {
            self.0.end(go_on);
        }
    }

    /// A master with drive `x`, which answers each call with its value.
    struct Master {
        acyclic: Acyclic,
        taken: Receiver<u64>,
        end: Arc<AtomicBool>,
        drive: Option<JoinHandle<()>>,
        server: Option<Server>,
        path: PathBuf,
        _directory: TempDir,
    }

    impl Master {
        fn start(capacity: usize) -> Master {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join("a.sock");
            let (acyclic, mut port) = Acyclic::alone(capacity, Commanding::none(), Arc::new(Upids));
            let (tell, taken) = crossbeam_channel::unbounded();
            let end = Arc::new(AtomicBool::new(false));
            let ending = Arc::clone(&end);
            let drive = std::thread::spawn(move || {
                let mut silent = None;
                while !ending.load(Ordering::Relaxed) {
                    if let Some(posted) = silent.filter(|posted| port.is_cancelled(posted)) {
                        port.end(&posted, Err(CallError::Cancelled));
                        silent = None;
                    }
                    if let Some(posted) = silent.is_none().then(|| port.take()).flatten() {
                        let value = posted.call.value;
                        tell.send(value).unwrap();
                        match value {
                            SILENT => silent = Some(posted),
                            _ => port.end(&posted, Ok(Answer { value, ..Answer::default() })),
                        }
                    }
                    std::thread::yield_now();
                }
            });
            let shared = acyclic.clone();
            let legacies = Legacies::default();
            let open = move || Only(Session::new(vec![shared.clone()], &legacies));
            let server = Some(Server::start(&path, || {}, open).unwrap());
            Master { acyclic, taken, end, drive: Some(drive), server, path, _directory: directory }
        }

        fn remote(&self) -> Remote {
            Remote::open(&self.path, "x").unwrap()
        }

        /// The next call that the drive takes.
        fn takes(&self) -> u64 {
            self.taken.recv_timeout(LIMIT).unwrap()
        }
    }

    impl Drop for Master {
        fn drop(&mut self) {
            drop(self.server.take());
            self.end.store(true, Ordering::Relaxed);
            let _ = self.drive.take().map(JoinHandle::join);
        }
    }

    fn call(value: u64) -> Call {
        Call { value, ..Call::default() }
    }

    #[test]
    fn a_question_fits_any_room_of_the_queue() {
        let master = Master::start(1_000);
        let most = Call { service: u32::MAX, address: u32::MAX, value: u64::MAX };
        let series = master.remote().run(&[most; 200], LIMIT);
        assert_eq!((series.answers.len(), series.failed), (200, None));
    }

    #[test]
    fn a_claim_lasts_as_long_as_its_guard_or_its_conversation() {
        let master = Master::start(8);
        let (one, other) = (master.remote(), master.remote());
        let guard = one.claim().unwrap();
        for remote in [&one, &other] {
            assert_eq!(remote.claim().err(), Some(CallError::Claimed));
        }
        drop(guard);
        let guard = other.claim().unwrap();
        assert_eq!(one.claim().err(), Some(CallError::Claimed));
        // The guard holds on to the conversation.
        drop(other);
        assert_eq!(one.claim().err(), Some(CallError::Claimed));
        drop(guard);
        assert!(one.claim().is_ok());
        // Somebody dies with a claim: their conversation ends, and nobody says a word.
        let dead = master.remote();
        std::mem::forget(dead.claim().unwrap());
        let questions = &dead.questions.conversation;
        assert!(questions.ask(&json!({ "ask": "nonsense" }), LIMIT).is_err());
        // The master's side of it ends on its own time.
        while master.acyclic.claim().is_err() {
            sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_client_that_disconnects_leaves_only_bequeathed_calls() {
        let master = Master::start(8);
        let remote = master.remote();
        remote.bequeath(&[call(1)]).unwrap();
        remote.bequeath(&[call(5), call(6)]).unwrap();
        let question = json!({
            "ask": "calls", "drive": "x", "calls": [call(SILENT), call(2)], "limit_ms": 600_000,
        });
        // Long enough for a busy host to take up the first call.
        let late = remote.questions.conversation.ask(&question, Duration::from_secs(1));
        assert!(late.is_err());
        // The second one of the series is never taken up.
        assert_eq!([master.takes(), master.takes(), master.takes()], [SILENT, 5, 6]);
        assert_eq!(remote.condition(), Err(CallError::Lost));
        assert_eq!(remote.run(&[call(3)], LIMIT).failed, Some(CallError::Lost));
        let remote = master.remote();
        remote.bequeath(&[call(7)]).unwrap();
        remote.bequeath(&[]).unwrap();
        drop((remote.claim().unwrap(), remote));
        // Its claim goes last of all.
        while master.acyclic.claim().is_err() {
            sleep(Duration::from_millis(1));
        }
        assert_eq!(master.remote().run(&[call(8)], LIMIT).answers.len(), 1);
        assert_eq!(master.takes(), 8);
    }

    #[test]
    fn clients_that_come_and_go_leave_so_much_to_be_done_and_no_more() {
        let master = Master::start(8);
        let leave = || {
            let remote = master.remote();
            let left = remote.bequeath(&[call(SILENT)]);
            // Another one takes the place of the one before, and none frees it.
            assert_eq!(left.is_ok(), remote.bequeath(&[call(SILENT)]).is_ok());
            left.is_ok()
        };
        let kept: Vec<Remote> = (0..3).map(|_| master.remote()).collect();
        for remote in &kept {
            assert!(remote.bequeath(&[call(1)]).is_ok());
        }
        let left = (0..100).filter(|_| leave()).count();
        assert_eq!(left, 32 - kept.len());
        // They are all under way, and everybody else is answered.
        drop(master.remote());
        assert!(kept[0].bequeath(&[]).is_ok());
        assert!(leave());
        assert!(!leave());
    }

    #[test]
    fn the_end_of_the_master_waits_for_no_client() {
        let mut master = Master::start(8);
        let remote = master.remote();
        remote.bequeath(&[call(SILENT)]).unwrap();
        let client = std::thread::spawn(move || {
            let series = remote.run(&[call(SILENT)], Duration::from_secs(600));
            (series.failed, remote)
        });
        assert_eq!(master.takes(), SILENT);
        drop(master.server.take());
        let (failed, remote) = client.join().unwrap();
        // The conversation ends a little before the socket.
        assert!(matches!(failed, Some(CallError::Lost | CallError::Gone)), "{failed:?}");
        assert_eq!(remote.condition(), Err(CallError::Gone));
    }
}
