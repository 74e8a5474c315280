//! The master's side of the control socket.
//!
//! Clients that have not sent a whole request yet cost a descriptor each, and no thread: [`Clients`] bounds them. The
//! first request begins a conversation on a thread of its own. If there are too many conversations, the one that has
//! been silent for longest ends, that of an operator only for another operator or a stop. Requests that may take long
//! occupy half of the places at most, those of operators have some more of their own, and a client that has left has
//! none, although its request may still be under way: so a stop waits for nobody.

use std::collections::VecDeque;
use std::fs;
use std::io;
use std::os::fd::{AsFd, AsRawFd};
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{Shutdown, getsockopt, shutdown, sockopt};
use serde_json::{Value, json};
use thiserror::Error;

use super::operate::OPERATOR_LIMIT;
use super::protocol::{Exchange, LOOK_EVERY, connect};
use super::watch::MOST_WATCHERS;
use fieldbeat_core::errors::no_descriptor;
use fieldbeat_core::net::clients::{Client, Clients};
use fieldbeat_core::rt::confine::{self, serve_only};

/// A client has so long to send its request, and so long to take the answer.
const PATIENCE: Duration = Duration::from_secs(1);

/// Whoever gets a stream has so long for each of its frames.
pub(super) const PATIENCE_OF_STREAM: Duration = Duration::from_secs(10);

/// Between two questions of one conversation.
const PAUSE: Duration = Duration::from_secs(10);

/// Conversations at a time. For a further one the longest silent of them ends; while none is silent, it waits.
const MOST_CONVERSATIONS: usize = 32;

/// Of these, those that do what may take long. All others but the streams are silent or answered within milliseconds,
/// so that one of them makes room.
const MOST_SLOW: usize = 16;

/// Neither a slow request nor a stream makes room: both together leave places for the others.
const _: () = assert!(MOST_SLOW + MOST_WATCHERS <= MOST_CONVERSATIONS - RESERVED);

/// Further conversations that begin with the request of an operator, and as many again that begin with a stop.
const RESERVED: usize = 8;

/// An operator makes no room for those that only look, unless it has been silent for so long: it has left long before,
/// and its axes are stopped. Clients wait longer than that for an answer.
const OPERATOR_IS_GONE: Duration = Duration::from_nanos(3 * OPERATOR_LIMIT);

/// Conversations that are over and whose end takes its time do not count, up to so many of them.
const MOST_ENDING: usize = 32;

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
        /// The error of the operating system.
        error: io::Error,
    },
}
fieldbeat_core::debug_as_display!(ServeError);

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
    /// Since when it waits for the next question, or to be allowed to begin, ms from its begin; 0: an answer is under
    /// way.
    silent_since: AtomicU64,
    /// The last question was an operator's, or a stop: it makes room after all others, and only for such a question.
    operates: AtomicBool,
    /// It has to make room.
    dismissed: AtomicBool,
    /// The client is gone.
    left: AtomicBool,
    ended: AtomicBool,
}

impl Conversation {
    fn new() -> Conversation {
        let [operates, dismissed, left, ended] = std::array::from_fn(|_| AtomicBool::new(false));
        let silent_since = AtomicU64::new(0);
        Conversation { begun: Instant::now(), silent_since, operates, dismissed, left, ended }
    }

    fn is_dismissed(&self) -> bool {
        self.dismissed.load(Ordering::Relaxed)
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

/// A whole request that waits for a conversation.
struct Waiting {
    urgency: Urgency,
    client: Client<UnixStream>,
}

/// Enters what `arrived`: the most urgent first, and what has waited for longest first among equals. The last of those
/// that have no room are hung up on.
fn enter<A: Answering>(waiting: &mut VecDeque<Waiting>, arrived: Vec<Client<UnixStream>>) {
    for client in arrived {
        let urgency = question(&client.said).as_ref().map_or(Urgency::Usual, A::urgency);
        let place = waiting.partition_point(|one| one.urgency <= urgency);
        waiting.insert(place, Waiting { urgency, client });
    }
    waiting.truncate(MOST_WAITING);
}

/// Lets as many of the silent ones go as requests wait for a place. The most urgent request takes the first free place,
/// so a request that only looks ends none but those that have been silent for longest and do not operate: an operator
/// is silent between any two of its beats, and its axes stop with its conversation.
fn make_room(under_way: &[Arc<Conversation>], waiting: impl Iterator<Item = Urgency>) {
    let here = || under_way.iter().filter(|one| !one.left.load(Ordering::Relaxed));
    let going = here().filter(|one| one.is_dismissed()).count();
    for urgency in waiting.skip(going) {
        let silent = here().filter(|one| !one.is_dismissed()).filter_map(|one| {
            let silence = one.silence()?;
            let operates = one.operates.load(Ordering::Relaxed) && silence < OPERATOR_IS_GONE;
            (!operates || urgency <= Urgency::Operate).then_some((!operates, silence, one))
        });
        let Some((.., silent)) = silent.max_by_key(|(idle, silence, _)| (*idle, *silence)) else { return };
        silent.dismissed.store(true, Ordering::Relaxed);
    }
}

/// How many conversations leave a place for a further one that begins like this.
fn places(urgency: Urgency) -> usize {
    MOST_CONVERSATIONS
        + match urgency {
            Urgency::Stop => 2 * RESERVED,
            Urgency::Operate => RESERVED,
            Urgency::Usual | Urgency::Slow => 0,
        }
}

impl Server {
    /// Answers at `path`, each conversation on a thread of its own. `prepare` runs before, on the thread that starts
    /// these: what it does to that one holds for them. What it answers to the questions of a conversation says what
    /// `open` makes for it; that is dropped at its end. A socket that a dead process left behind is replaced.
    pub fn start<A: Answering>(
        path: &Path,
        prepare: impl FnOnce() + Send + 'static,
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
                // Without filters it answers all the same; the start and the doctor say so.
                let _ = serve_only(confine::Server::Control);
                let go_on = || !ending.load(Ordering::Acquire);
                let slow = AtomicUsize::new(0);
                let serve_one = |client: Client<UnixStream>, conversation: Arc<Conversation>| {
                    // Whoever went away or sends nonsense is not answered, and that is all.
                    let work = AssertUnwindSafe(|| {
                        let mut answering = open();
                        let _ = converse(client, &go_on, &conversation, &slow, &mut answering);
                        conversation.left.store(true, Ordering::Relaxed);
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
                            let arrived = clients.turn(listening.as_fd(), timeout, accept, is_whole);
                            enter::<A>(&mut waiting, arrived);
                            under_way.retain(|one| !one.ended.load(Ordering::Relaxed));
                            let left =
                                under_way.iter().filter(|one| one.left.load(Ordering::Relaxed)).count();
                            let mut taken = under_way.len() - left.min(MOST_ENDING);
                            while waiting.front().is_some_and(|next| taken < places(next.urgency))
                                && let Some(Waiting { client, .. }) = waiting.pop_front()
                            {
                                let conversation = Arc::new(Conversation::new());
                                let thread = std::thread::Builder::new().name("fb-session".into());
                                let of_thread = Arc::clone(&conversation);
                                if thread.spawn_scoped(scope, || serve_one(client, of_thread)).is_ok() {
                                    under_way.push(conversation);
                                    taken += 1;
                                }
                            }
                            make_room(&under_way, waiting.iter().map(|one| one.urgency));
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

/// How soon a question is to be answered, the most urgent first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Urgency {
    /// Before all others: a stop.
    Stop,
    /// Before what only looks: another request of an operator.
    Operate,
    /// Within milliseconds, or a stream.
    Usual,
    /// It may take long.
    Slow,
}

/// The source of answers to the questions of one conversation.
pub trait Answering {
    /// How soon `question` is to be answered.
    fn urgency(question: &Value) -> Urgency
    where
        Self: Sized,
    {
        let _ = question;
        Urgency::Usual
    }

    /// The answer. One that takes long breaks off once `go_on` is false: nobody waits for it any more.
    fn answer(&mut self, question: &Value, go_on: &dyn Fn() -> bool) -> Result<Value, String>;

    /// Sends what `question` begins instead of an answer in a line, up to its end, by `send`; `None`: it is answered.
    /// Until then it has its place: whoever implements it bounds the number of streams.
    fn stream(&mut self, question: &Value, send: &mut Sender<'_>) -> Option<io::Result<()>> {
        let _ = (question, send);
        None
    }

    /// The conversation is over: does what has to be done then, while `go_on`. Its client has left, and nobody waits.
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

/// The question in what was said: what follows its line is nobody's.
fn question(said: &[u8]) -> serde_json::Result<Value> {
    serde_json::from_slice(said.split(|byte| *byte == b'\n').next().unwrap_or_default())
}

/// One of the places for what may take long.
struct Slow<'a>(&'a AtomicUsize);

impl<'a> Slow<'a> {
    fn begin(taken: &'a AtomicUsize) -> Option<Slow<'a>> {
        let more = |taken| (taken < MOST_SLOW).then_some(taken + 1);
        taken.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).ok().map(|_| Slow(taken))
    }

    /// Waits for one while `go_on`. Meanwhile the conversation counts as silent.
    fn wait(
        taken: &'a AtomicUsize,
        conversation: &Conversation,
        go_on: &dyn Fn() -> bool,
    ) -> Option<Slow<'a>> {
        let mut slow = Slow::begin(taken);
        conversation.is_silent(slow.is_none());
        while slow.is_none() && go_on() {
            std::thread::sleep(LOOK_EVERY);
            slow = Slow::begin(taken);
        }
        conversation.is_silent(false);
        slow
    }
}

impl Drop for Slow<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Answers question after question, until the other side ends it.
fn converse<A: Answering>(
    client: Client<UnixStream>,
    go_on: &dyn Fn() -> bool,
    conversation: &Conversation,
    slow: &AtomicUsize,
    answering: &mut A,
) -> io::Result<()> {
    let Client { stream, said: mut line, .. } = client;
    let stream = &stream;
    stream.set_nonblocking(false)?;
    let uid = getsockopt(stream, sockopt::PeerCredentials)?.uid();
    let ours = uid == 0 || uid == nix::unistd::geteuid().as_raw();
    let is_here = || go_on() && !hung_up(stream);
    let waits = || go_on() && !conversation.is_dismissed();
    loop {
        if line.is_empty() {
            return Ok(());
        }
        let question = question(&line);
        let urgency = question.as_ref().map_or(Urgency::Usual, A::urgency);
        conversation.operates.store(urgency <= Urgency::Operate, Ordering::Relaxed);
        if let (true, Ok(question)) = (ours, &question) {
            let mut send = |bytes: &[u8]| Exchange::new(stream, PATIENCE_OF_STREAM, &is_here)?.send(bytes);
            if let Some(ended) = answering.stream(question, &mut send) {
                return ended;
            }
        }
        let reply = match (ours, question) {
            (true, Ok(question)) if urgency == Urgency::Slow => {
                match Slow::wait(slow, conversation, &|| is_here() && !conversation.is_dismissed()) {
                    Some(_slow) => answering.answer(&question, &is_here),
                    None => Err("too many requests to drives are under way: try again".to_owned()),
                }
            }
            (true, Ok(question)) => answering.answer(&question, &is_here),
            (true, Err(_)) if line.len() == LONGEST_QUESTION => {
                Err(format!("a request has at most {LONGEST_QUESTION} bytes"))
            }
            (true, Err(error)) => Err(format!("not a JSON object in one line: {error}")),
            (false, _) => Err("only the owner of this master has access".to_owned()),
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
        // From here on it waits for its client, and makes room for who does not wait. Not before: a question that was
        // taken is answered.
        conversation.is_silent(true);
        line = Exchange::new(stream, PAUSE, &waits)?.line(LONGEST_QUESTION)?;
        conversation.is_silent(false);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::io::{Read, Write};
    use std::iter;

    use super::super::{AskError, Conversation, ask};
    use super::*;

    /// Nothing takes this long, however busy the host.
    const LONG: Duration = Duration::from_secs(60);

    /// A directory, and a socket in it.
    pub(crate) fn socket() -> (tempfile::TempDir, PathBuf) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.sock");
        (directory, path)
    }

    fn echo(question: &Value) -> Result<Value, String> {
        match question["ask"].as_str() {
            Some("echo") => Ok(question.clone()),
            _ => Err("I only know echo".to_owned()),
        }
    }

    #[test]
    fn a_question_is_answered_and_a_wrong_one_refused() {
        let (_directory, path) = socket();
        let server = Server::start(&path, || {}, || echo).unwrap();
        assert_eq!(fs::metadata(server.path()).unwrap().permissions().mode() & 0o777, 0o600);
        let question = json!({ "ask": "echo", "x": 1 });
        assert_eq!(ask(&path, &question).unwrap(), question);
        let refused = ask(&path, &json!({ "ask": "life" })).unwrap_err();
        assert!(matches!(&refused, AskError::Refused(why) if why == "I only know echo"), "{refused}");
        let endless = ask(&path, &json!({ "ask": "x".repeat(2 * LONGEST_QUESTION) })).unwrap_err();
        let most = "at most 16384 bytes";
        assert!(matches!(&endless, AskError::Refused(why) if why.contains(most)), "{endless}");
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
    fn the_socket_of_a_dead_process_is_replaced_and_what_is_no_socket_is_left_alone() {
        let (_directory, path) = socket();
        drop(UnixListener::bind(&path).unwrap());
        assert!(path.exists() && matches!(ask(&path, &json!({})), Err(AskError::Dead(_))));
        let server = Server::start(&path, || {}, || echo).unwrap();
        assert!(ask(&path, &json!({ "ask": "echo" })).is_ok());
        drop(server);
        fs::write(&path, "precious").unwrap();
        assert!(matches!(Server::start(&path, || {}, || echo), Err(ServeError::Io { .. })));
        assert_eq!(fs::read_to_string(&path).unwrap(), "precious");
    }

    #[test]
    fn a_client_that_sends_byte_by_byte_is_disconnected_and_delays_neither_others_nor_the_end() {
        let (_directory, path) = socket();
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
        // One that sends questions when the server ends: between two questions it would wait for 10 s.
        let busy = Conversation::open(&path).unwrap();
        let question = json!({ "ask": "echo" });
        assert!(busy.ask(&question, LONG).is_ok());
        std::thread::scope(|scope| {
            scope.spawn(|| drop(server));
            let goes_on = (0..2_400).all(|_| {
                std::thread::sleep(LOOK_EVERY);
                busy.ask(&question, LONG).is_ok()
            });
            assert!(!goes_on, "the end waits for a busy client");
        });
    }

    #[test]
    fn silent_clients_by_the_thousand_hold_up_no_question() {
        let (_directory, path) = socket();
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

    /// Answers `slow` when it is let, or nobody waits for it; its end takes its time on request.
    struct Busy {
        go: Arc<AtomicBool>,
        ending: Arc<AtomicUsize>,
        ends_slowly: bool,
    }

    impl Answering for Busy {
        fn urgency(question: &Value) -> Urgency {
            match question["ask"].as_str() {
                Some("stop") => Urgency::Stop,
                Some("operate") => Urgency::Operate,
                Some("slow") => Urgency::Slow,
                _ => Urgency::Usual,
            }
        }

        fn answer(&mut self, question: &Value, go_on: &dyn Fn() -> bool) -> Result<Value, String> {
            self.ends_slowly |= question["ends_slowly"] == true;
            while question["ask"] == "slow" && go_on() && !self.go.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(1));
            }
            Ok(question["ask"].clone())
        }

        fn end(&mut self, go_on: &dyn Fn() -> bool) {
            self.ending.fetch_add(1, Ordering::Relaxed);
            while self.ends_slowly && go_on() && !self.go.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(1));
            }
            self.ending.fetch_sub(1, Ordering::Relaxed);
        }
    }

    /// A server of them, what lets them go, and how many of them end.
    fn busy(path: &Path) -> (Server, Arc<AtomicBool>, Arc<AtomicUsize>) {
        let (go, ending) = (Arc::<AtomicBool>::default(), Arc::<AtomicUsize>::default());
        let (of_each, ends) = (Arc::clone(&go), Arc::clone(&ending));
        let open = move || Busy { go: Arc::clone(&of_each), ending: Arc::clone(&ends), ends_slowly: false };
        (Server::start(path, || {}, open).unwrap(), go, ending)
    }

    fn post(path: &Path, question: &Value) -> UnixStream {
        let mut stream = connect(path, LONG).unwrap();
        stream.write_all(format!("{question}\n").as_bytes()).unwrap();
        stream
    }

    #[test]
    fn slow_requests_on_all_places_hold_up_neither_a_stop_nor_a_look() {
        let (_directory, path) = socket();
        let (_server, go, _) = busy(&path);
        let slow: Vec<UnixStream> =
            (0..2 * MOST_CONVERSATIONS).map(|_| post(&path, &json!({ "ask": "slow" }))).collect();
        for _ in 0..20 {
            for what in ["stop", "operate", "status"] {
                let conversation = Conversation::open(&path).unwrap();
                assert_eq!(conversation.ask(&json!({ "ask": what }), LONG).unwrap(), what);
            }
        }
        // A conversation that has begun with a look occupies no place by what it requests then.
        let looks = Conversation::open(&path).unwrap();
        looks.ask(&json!({ "ask": "status" }), LONG).unwrap();
        let refused = std::thread::spawn(move || looks.ask(&json!({ "ask": "slow" }), LONG));
        let others: Vec<Conversation> = (0..2 * MOST_CONVERSATIONS)
            .map(|_| {
                let other = Conversation::open(&path).unwrap();
                other.ask(&json!({ "ask": "status" }), LONG).unwrap();
                other
            })
            .collect();
        // It was silent for longest.
        assert!(refused.join().unwrap().is_err());
        drop(others);
        // Those that were let begin are answered in the end.
        go.store(true, Ordering::Relaxed);
        let answered = slow.into_iter().filter(|stream| {
            let mut text = String::new();
            stream.set_read_timeout(Some(LONG)).unwrap();
            let _ = io::BufRead::read_line(&mut io::BufReader::new(stream), &mut text);
            text == "{\"ok\":\"slow\"}\n"
        });
        assert!(answered.count() >= MOST_SLOW);
    }

    #[test]
    fn a_stop_comes_before_all_that_waits_and_silent_clients_make_room_for_it() {
        let (_directory, path) = socket();
        let mut waiting = VecDeque::new();
        let mut clients = Clients::new(LONG, LONGEST_QUESTION);
        let listener = UnixListener::bind(&path).unwrap();
        listener.set_nonblocking(true).unwrap();
        let mut sent = Vec::new();
        let questions = ["slow", "status", "operate", "stop"];
        for what in questions.iter().cycle().take(4 * MOST_WAITING) {
            sent.push(post(&path, &json!({ "ask": what })));
            let accept = || listener.accept().map(|(stream, _)| stream);
            let arrived = clients.turn(listener.as_fd(), LONG, accept, |said| said.ends_with(b"\n"));
            enter::<Busy>(&mut waiting, arrived);
        }
        // Only the most urgent are left, of a quarter of all.
        assert_eq!(waiting.len(), MOST_WAITING);
        assert!(waiting.iter().all(|one| one.urgency == Urgency::Stop));
        // Whoever waits for longest goes, and an operator after all others.
        let all = [(59_901, true), (59_903, false), (59_902, false), (0, false)]
            .map(|(since, of)| silent_since(since, of));
        let going = || all.iter().map(|one| one.is_dismissed()).collect::<Vec<_>>();
        let wait = |urgency: Urgency, count: usize| make_room(&all, iter::repeat_n(urgency, count));
        for expected in [[false, false, true, false], [false, true, true, false], [true, true, true, false]] {
            let before = going().into_iter().filter(|going| *going).count();
            wait(Urgency::Operate, before + 1);
            assert_eq!(going(), expected);
        }
        wait(Urgency::Stop, 10);
        assert_eq!(going(), [true, true, true, false], "it is at work");
        // One that has left, and is still at work, makes no more room than it has made.
        let mut more: Vec<_> = all.into_iter().collect();
        more[..3].iter().for_each(|one| one.left.store(true, Ordering::Relaxed));
        more.push(silent_since(59_904, true));
        make_room(&more, iter::once(Urgency::Stop));
        assert!(more[4].is_dismissed());
    }

    /// A conversation that began a minute ago, and is silent since this time after its begin, ms; 0: it is at work.
    fn silent_since(ms: u64, operates: bool) -> Arc<super::Conversation> {
        let mut one = super::Conversation::new();
        one.begun = one.begun.checked_sub(Duration::from_secs(60)).unwrap();
        one.silent_since.store(ms, Ordering::Relaxed);
        one.operates.store(operates, Ordering::Relaxed);
        Arc::new(one)
    }

    #[test]
    fn an_operator_makes_room_for_another_one_and_for_a_stop_alone() {
        use Urgency::{Operate, Slow, Stop, Usual};
        // Its beats come; it has been silent for so long that it has left; one that only looks.
        let dismissed = |waiting: &[Urgency]| {
            let all = [(60_000, true), (50_000, true), (59_000, false)].map(|(ms, of)| silent_since(ms, of));
            make_room(&all, waiting.iter().copied());
            all.map(|one| one.is_dismissed())
        };
        for (waiting, expected) in [
            (&[Slow][..], [false, true, false]),
            (&[Usual, Slow], [false, true, true]),
            (&[Usual; 32], [false, true, true]),
            (&[Operate, Usual, Slow, Slow], [false, true, true]),
            (&[Stop, Operate, Slow], [false, true, true]),
            (&[Operate, Operate, Operate], [true, true, true]),
            (&[Stop, Stop, Stop, Slow], [true, true, true]),
        ] {
            assert_eq!(dismissed(waiting), expected, "{waiting:?}");
        }
    }

    /// The conversation would end at any of the requests that find no place, and its axes would stop.
    #[test]
    fn no_request_that_only_looks_or_is_slow_ends_an_operator() {
        let (_directory, path) = socket();
        let (_server, _go, _) = busy(&path);
        let operator = Conversation::open(&path).unwrap();
        let beat = |what: &str| assert_eq!(operator.ask(&json!({ "ask": what }), LONG).unwrap(), what);
        beat("operate");
        let mut slow = Vec::new();
        let mut looks = Vec::new();
        // It is an operator after a stop, too.
        for what in ["operate", "stop"] {
            for _ in 0..2 * MOST_CONVERSATIONS {
                slow.push(post(&path, &json!({ "ask": "slow" })));
                beat(what);
            }
            for _ in 0..MOST_CONVERSATIONS {
                let look = Conversation::open(&path).unwrap();
                assert_eq!(look.ask(&json!({ "ask": "status" }), LONG).unwrap(), "status");
                looks.push(look);
                beat(what);
            }
        }
        // There was no room for all of these.
        assert!(looks[0].ask(&json!({ "ask": "status" }), LONG).is_err());
    }

    #[test]
    fn a_panic_in_an_answer_ends_its_conversation_and_no_other() {
        let (_directory, path) = socket();
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
        let (_directory, path) = socket();
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
}
