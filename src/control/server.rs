//! The master's side of the control socket.
//!
//! Clients that have not sent a whole request yet cost a descriptor each, and no thread: [`Clients`] bounds them. The
//! first request begins a conversation on a thread of its own. If there are too many conversations, the one that has
//! been silent for longest ends.

use std::collections::VecDeque;
use std::fs;
use std::io;
use std::os::fd::{AsFd, AsRawFd};
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{Shutdown, getsockopt, shutdown, sockopt};
use serde_json::{Value, json};
use thiserror::Error;

use super::protocol::{Exchange, LOOK_EVERY, connect};
use crate::errors::no_descriptor;
use crate::net::clients::{Client, Clients};

/// A client has so long to send its request, and so long to take the answer.
const PATIENCE: Duration = Duration::from_secs(1);

/// Whoever gets a stream has so long for each of its frames.
pub(super) const PATIENCE_OF_STREAM: Duration = Duration::from_secs(10);

/// Between two questions of one conversation.
const PAUSE: Duration = Duration::from_secs(10);

/// Conversations at a time. For a further one the longest silent of them ends; while none is silent, it waits.
const MOST_CONVERSATIONS: usize = 16;

/// Whole requests that wait for a conversation to end; each has its descriptor.
const MOST_WAITING: usize = 32;

/// How often the server looks whether it is to end while it has no conversation: a client and the end wake it up at
/// once.
const LOOK_IDLE_EVERY: Duration = Duration::from_secs(60);

/// Bytes of a question. The longest of this program is a series of 64 calls.
const LONGEST_QUESTION: usize = 16 << 10;

/// Why there is no control socket. The message ends with the remedy.
#[derive(Error)]
pub enum ServeError {
    /// Another process answers there.
    #[error("another master already listens at {0}; end it, or give this one another configuration")]
    Taken(PathBuf),
    /// The operating system refused.
    #[error("cannot listen at {path}: {error}; {}", remedy(.error))]
    Io {
        /// The socket.
        path: PathBuf,
        /// What the operating system said.
        error: io::Error,
    },
}
crate::errors::debug_as_display!(ServeError);

fn remedy(error: &io::Error) -> &'static str {
    no_descriptor(error).unwrap_or("set XDG_RUNTIME_DIR to a directory of this user")
}

/// A control socket that is answered. Dropping it removes the socket; a conversation that is under way then breaks off,
/// so that no client can delay the end of the program.
#[derive(Debug)]
pub struct Server {
    path: PathBuf,
    listener: Arc<UnixListener>,
    end: Arc<AtomicBool>,
    failed: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// A conversation, from the side of the server.
#[derive(Debug)]
struct Conversation {
    begun: Instant,
    /// Since when it waits for the next question, ms from its begin; 0: an answer is under way.
    silent_since: AtomicU64,
    /// It has to make room.
    dismissed: AtomicBool,
    ended: AtomicBool,
}

impl Conversation {
    fn new() -> Conversation {
        let [dismissed, ended] = std::array::from_fn(|_| AtomicBool::new(false));
        Conversation { begun: Instant::now(), silent_since: AtomicU64::new(0), dismissed, ended }
    }

    /// For how long it has been silent.
    fn silence(&self) -> Option<Duration> {
        let since = Duration::from_millis(self.silent_since.load(Ordering::Relaxed));
        (!since.is_zero()).then(|| self.begun.elapsed().saturating_sub(since))
    }

    fn is_silent(&self, silent: bool) {
        let now = u64::try_from(self.begun.elapsed().as_millis()).unwrap_or(u64::MAX).max(1);
        self.silent_since.store(if silent { now } else { 0 }, Ordering::Relaxed);
    }
}

impl Server {
    /// Answers at `path`, each conversation on a thread of its own, on which `prepare` runs first. What it answers to
    /// the questions of a conversation says what `open` makes for it; that is dropped at its end. A socket that a dead
    /// process left behind is replaced.
    pub fn start<A: Answering>(
        path: &Path,
        prepare: impl Fn() + Send + Sync + 'static,
        open: impl Fn() -> A + Send + Sync + 'static,
    ) -> Result<Server, ServeError> {
        let failed = |error| ServeError::Io { path: path.to_owned(), error };
        let listener = listen(path)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let listener = Arc::new(listener);
        let listening = Arc::clone(&listener);
        let (end, failed_flag) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
        let (ending, has_failed) = (Arc::clone(&end), Arc::clone(&failed_flag));
        let thread = std::thread::Builder::new()
            .name("fb-control".into())
            .spawn(move || {
                prepare();
                let go_on = || !ending.load(Ordering::Acquire);
                let serve_one = |client: Client<UnixStream>, conversation: Arc<Conversation>| {
                    // Whoever went away or sends nonsense is not answered, and that is all.
                    let work = AssertUnwindSafe(|| {
                        prepare();
                        let mut answering = open();
                        let _ = converse(client, &go_on, &conversation, &mut answering);
                        answering.end(&go_on);
                    });
                    if catch_unwind(work).is_err() {
                        has_failed.store(true, Ordering::Relaxed);
                    }
                    conversation.ended.store(true, Ordering::Relaxed);
                };
                // All of them have ended when this does.
                let serve = AssertUnwindSafe(|| {
                    std::thread::scope(|scope| {
                        let mut clients = Clients::new(PATIENCE, LONGEST_QUESTION);
                        let (mut waiting, mut under_way) = (VecDeque::new(), Vec::<Arc<Conversation>>::new());
                        while go_on() {
                            let accept = || listening.accept().map(|(stream, _)| stream);
                            let is_whole = |said: &[u8]| said.contains(&b'\n');
                            let idle = under_way.is_empty() && waiting.is_empty();
                            let timeout = if idle { LOOK_IDLE_EVERY } else { LOOK_EVERY };
                            waiting.extend(clients.turn(listening.as_fd(), timeout, accept, is_whole));
                            waiting.truncate(MOST_WAITING);
                            under_way.retain(|one| !one.ended.load(Ordering::Relaxed));
                            while under_way.len() < MOST_CONVERSATIONS
                                && let Some(client) = waiting.pop_front()
                            {
                                let conversation = Arc::new(Conversation::new());
                                let thread = std::thread::Builder::new().name("fb-session".into());
                                let of_thread = Arc::clone(&conversation);
                                if thread.spawn_scoped(scope, || serve_one(client, of_thread)).is_ok() {
                                    under_way.push(conversation);
                                }
                            }
                            let longest =
                                under_way.iter().filter(|one| !one.dismissed.load(Ordering::Relaxed));
                            if !waiting.is_empty()
                                && let Some(silent) = longest.max_by_key(|one| one.silence())
                                && silent.silence().is_some()
                            {
                                silent.dismissed.store(true, Ordering::Relaxed);
                            }
                        }
                    });
                });
                if catch_unwind(serve).is_err() {
                    has_failed.store(true, Ordering::Relaxed);
                }
            })
            .map_err(failed)?;
        Ok(Server { path: path.to_owned(), listener, end, failed: failed_flag, thread: Some(thread) })
    }

    /// Whether one of its threads panicked.
    pub fn has_failed(&self) -> bool {
        self.failed.load(Ordering::Relaxed)
    }

    /// Where it answers.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Release);
        // Ends the wait for the listener. Its result is not needed.
        let _ = shutdown(self.listener.as_raw_fd(), Shutdown::Both);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        let _ = fs::remove_file(&self.path);
    }
}

/// Binds `path`, and gives it to its owner alone before anybody can be let in.
fn listen(path: &Path) -> Result<UnixListener, ServeError> {
    let failed = |error| ServeError::Io { path: path.to_owned(), error };
    match connect(path, PATIENCE) {
        Ok(_) => return Err(ServeError::Taken(path.to_owned())),
        // Its process is dead. A file that is no socket refuses too, and is not ours to remove: bind reports it.
        Err(error) if error.kind() == io::ErrorKind::ConnectionRefused && is_socket(path) => {
            fs::remove_file(path).map_err(failed)?;
        }
        // Not there; or something else, which bind reports.
        Err(_) => {}
    }
    let listener = UnixListener::bind(path).map_err(failed)?;
    fs::set_permissions(path, PermissionsExt::from_mode(0o600)).map_err(failed)?;
    Ok(listener)
}

fn is_socket(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|about| about.file_type().is_socket())
}

/// Takes bytes, each time within a limit of time; an error: the other side is gone, too slow, or the server ends.
pub type Sender<'a> = dyn FnMut(&[u8]) -> io::Result<()> + 'a;

/// What answers the questions of one conversation.
pub trait Answering {
    /// The answer. One that takes long breaks off once `go_on` is false: nobody waits for it any more.
    fn answer(&mut self, question: &Value, go_on: &dyn Fn() -> bool) -> Result<Value, String>;

    /// Sends what `question` begins instead of an answer in a line, up to its end, by `send`; `None`: it is answered.
    fn stream(&mut self, question: &Value, send: &mut Sender<'_>) -> Option<io::Result<()>> {
        let _ = (question, send);
        None
    }

    /// The conversation is over: does what has to be done then, while `go_on`.
    fn end(&mut self, go_on: &dyn Fn() -> bool) {
        let _ = go_on;
    }
}

impl<F: Fn(&Value) -> Result<Value, String>> Answering for F {
    fn answer(&mut self, question: &Value, _go_on: &dyn Fn() -> bool) -> Result<Value, String> {
        self(question)
    }
}

/// Whether the other side has closed its end. One that only says no more, and listens, has not.
fn hung_up(stream: &UnixStream) -> bool {
    let mut looked = [PollFd::new(stream.as_fd(), PollFlags::empty())];
    let found = poll(&mut looked, PollTimeout::ZERO);
    found.is_ok_and(|found| found > 0)
}

/// Answers question after question, until the other side ends it.
fn converse(
    client: Client<UnixStream>,
    go_on: &dyn Fn() -> bool,
    conversation: &Conversation,
    answering: &mut impl Answering,
) -> io::Result<()> {
    let Client { stream, said: mut line, .. } = client;
    let stream = &stream;
    stream.set_nonblocking(false)?;
    let uid = getsockopt(stream, sockopt::PeerCredentials)?.uid();
    let ours = uid == 0 || uid == nix::unistd::geteuid().as_raw();
    loop {
        if line.is_empty() {
            return Ok(());
        }
        // What follows a line is nobody's.
        line.truncate(line.iter().position(|byte| *byte == b'\n').map_or(line.len(), |end| end + 1));
        let question = serde_json::from_slice(&line);
        if let (true, Ok(question)) = (ours, &question) {
            let go_on = || go_on() && !hung_up(stream);
            let mut send = |bytes: &[u8]| Exchange::new(stream, PATIENCE_OF_STREAM, &go_on)?.send(bytes);
            if let Some(ended) = answering.stream(question, &mut send) {
                return ended;
            }
        }
        let reply = match ours {
            true => match question {
                Ok(question) => answering.answer(&question, &|| go_on() && !hung_up(stream)),
                Err(_) if line.len() == LONGEST_QUESTION => {
                    Err(format!("a request has at most {LONGEST_QUESTION} bytes"))
                }
                Err(error) => Err(format!("not a JSON object in one line: {error}")),
            },
            false => Err("only the owner of this master has access".to_owned()),
        };
        let goes_on = reply.is_ok();
        let reply = match reply {
            Ok(value) => json!({ "ok": value }),
            Err(why) => json!({ "error": why }),
        };
        Exchange::new(stream, PATIENCE, go_on)?.say(&format!("{reply}\n"))?;
        if !goes_on {
            return Ok(());
        }
        conversation.is_silent(true);
        let waits = || go_on() && !conversation.dismissed.load(Ordering::Relaxed);
        line = Exchange::new(stream, PAUSE, &waits)?.line(LONGEST_QUESTION)?;
        conversation.is_silent(false);
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};

    use super::super::{AskError, Conversation, ask};
    use super::*;

    /// Nothing takes this long, however busy the host.
    const LONG: Duration = Duration::from_secs(60);

    fn echo(question: &Value) -> Result<Value, String> {
        match question["ask"].as_str() {
            Some("echo") => Ok(question.clone()),
            _ => Err("I only know echo".to_owned()),
        }
    }

    #[test]
    fn a_question_is_answered_and_a_wrong_one_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.sock");
        let server = Server::start(&path, || {}, || echo).unwrap();
        assert_eq!(fs::metadata(server.path()).unwrap().permissions().mode() & 0o777, 0o600);
        let question = json!({ "ask": "echo", "x": 1 });
        assert_eq!(ask(&path, &question).unwrap(), question);
        let refused = ask(&path, &json!({ "ask": "life" })).unwrap_err();
        assert!(matches!(&refused, AskError::Refused(why) if why == "I only know echo"), "{refused}");
        assert!(matches!(Server::start(&path, || {}, || echo), Err(ServeError::Taken(_))));
        // Nonsense, half a line, nothing at all: the next one is answered all the same.
        for bytes in [&b"x\n"[..], b"{\"ask\"", b"", &[0xff; 4096]] {
            let mut stream = UnixStream::connect(&path).unwrap();
            stream.write_all(bytes).unwrap();
        }
        assert_eq!(ask(&path, &question).unwrap(), question);
        drop(server);
        assert!(!path.exists());
        assert!(matches!(ask(&path, &question), Err(AskError::Nobody(_))));
    }

    #[test]
    fn the_socket_of_a_dead_process_is_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.sock");
        drop(UnixListener::bind(&path).unwrap());
        assert!(path.exists() && matches!(ask(&path, &json!({})), Err(AskError::Dead(_))));
        let _server = Server::start(&path, || {}, || echo).unwrap();
        assert!(ask(&path, &json!({ "ask": "echo" })).is_ok());
    }

    #[test]
    fn what_is_no_socket_is_left_alone() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.sock");
        fs::write(&path, "precious").unwrap();
        assert!(matches!(Server::start(&path, || {}, || echo), Err(ServeError::Io { .. })));
        assert_eq!(fs::read_to_string(&path).unwrap(), "precious");
    }

    #[test]
    fn whoever_asks_byte_by_byte_is_broken_off_and_holds_up_neither_the_next_one_nor_the_end() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.sock");
        let server = Server::start(&path, || {}, || echo).unwrap();
        let slow = || UnixStream::connect(&path).unwrap();
        // As often as it is let, up to two minutes: the server has patience for a second.
        let goes_on = |mut stream: UnixStream| {
            (0..2_400).all(|_| {
                std::thread::sleep(LOOK_EVERY);
                stream.write_all(b" ").is_ok()
            })
        };
        let first = slow();
        assert!(ask(&path, &json!({ "ask": "echo" })).is_ok());
        assert!(!goes_on(first), "never broken off");
        // One that asks on and on when the server ends: between two questions it would wait for 10 s.
        let asking = Conversation::open(&path).unwrap();
        let question = json!({ "ask": "echo" });
        assert!(asking.ask(&question, LONG).is_ok());
        std::thread::scope(|scope| {
            scope.spawn(|| drop(server));
            let goes_on = (0..2_400).all(|_| {
                std::thread::sleep(LOOK_EVERY);
                asking.ask(&question, LONG).is_ok()
            });
            assert!(!goes_on, "the end waits for who asks on");
        });
    }

    /// Clients that say nothing, and conversations that were begun and are silent since, delay nobody.
    #[test]
    fn silent_clients_by_the_thousand_hold_up_no_question() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.sock");
        let server = Server::start(&path, || {}, || echo).unwrap();
        let question = json!({ "ask": "echo" });
        let limit = nix::sys::resource::getrlimit(nix::sys::resource::Resource::RLIMIT_NOFILE).unwrap().0;
        let mut silent = std::collections::VecDeque::new();
        for number in 0..3_000_u64 {
            // The server hangs up on the oldest of them; here the newest few hundred stay open.
            if number > limit / 4 {
                silent.pop_front();
            }
            silent.push_back(connect(&path, LONG).unwrap());
            if number % 500 == 499 {
                assert_eq!(ask(&path, &question).unwrap(), question, "behind {number}");
            }
        }
        let conversations: Vec<Conversation> = (0..4 * MOST_CONVERSATIONS)
            .map(|_| {
                let conversation = Conversation::open(&path).unwrap();
                assert!(conversation.ask(&question, LONG).is_ok());
                conversation
            })
            .collect();
        assert_eq!(ask(&path, &question).unwrap(), question);
        // The newest is none the worse for it.
        assert!(conversations.last().unwrap().ask(&question, LONG).is_ok());
        assert!(!server.has_failed());
    }

    #[test]
    fn a_panic_in_an_answer_ends_its_conversation_and_no_other() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.sock");
        let panics = |question: &Value| match question["ask"].as_str() {
            Some("panic") => std::panic::resume_unwind(Box::new("on purpose")),
            _ => echo(question),
        };
        let server = Server::start(&path, || {}, move || panics).unwrap();
        for _ in 0..3 * MOST_CONVERSATIONS {
            assert!(ask(&path, &json!({ "ask": "panic" })).is_err());
        }
        assert!(server.has_failed());
        assert!(ask(&path, &json!({ "ask": "echo" })).is_ok());
    }

    #[test]
    fn an_answer_that_is_taken_slowly_is_broken_off() {
        /// At the pace below 13 s of it; the server has patience for one.
        const LENGTH: usize = 4 << 20;
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.sock");
        let long = |question: &Value| match question["ask"] {
            Value::Null => Ok(Value::String("x".repeat(LENGTH))),
            _ => echo(question),
        };
        let _server = Server::start(&path, || {}, move || long).unwrap();
        let mut stream = UnixStream::connect(&path).unwrap();
        stream.write_all(b"{}\n").unwrap();
        let (mut taken, mut bytes) = (0, [0; 8 << 10]);
        while let Ok(count @ 1..) = stream.read(&mut bytes) {
            taken += count;
            std::thread::sleep(LOOK_EVERY / 2);
        }
        assert!(taken < LENGTH, "all of it was kept for whoever takes it slowly");
        assert!(ask(&path, &json!({ "ask": "echo" })).is_ok());
    }

    #[test]
    fn a_question_without_end_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.sock");
        let _server = Server::start(&path, || {}, || echo).unwrap();
        let refused = ask(&path, &json!({ "ask": "x".repeat(2 * LONGEST_QUESTION) })).unwrap_err();
        assert!(
            matches!(&refused, AskError::Refused(why) if why.contains("at most 16384 bytes")),
            "{refused}"
        );
    }
}
