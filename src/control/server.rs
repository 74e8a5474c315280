//! The master's side of the control socket.

use std::fs;
use std::io;
use std::os::fd::AsFd;
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{getsockopt, sockopt};
use serde_json::{Value, json};
use thiserror::Error;

use super::talk::{LOOK_EVERY, Talk, connect};

/// A client has so long to send its request, and so long to take the answer.
const PATIENCE: Duration = Duration::from_secs(1);

/// Between two questions of one conversation.
const PAUSE: Duration = Duration::from_secs(10);

/// Conversations at a time; whoever comes meanwhile waits in the kernel's queue.
const MOST_CONVERSATIONS: usize = 8;

/// Bytes of a question. The longest of this program is a series of 64 calls.
const LONGEST_QUESTION: usize = 16 << 10;

/// Why there is no control socket. The message ends with the remedy.
#[derive(Error)]
pub enum ServeError {
    /// Another process answers there.
    #[error("another master already listens at {0}; end it, or give this one another configuration")]
    Taken(PathBuf),
    /// The operating system refused.
    #[error("cannot listen at {path}: {error}; set XDG_RUNTIME_DIR to a directory of this user")]
    Io {
        /// The socket.
        path: PathBuf,
        /// What the operating system said.
        error: io::Error,
    },
}
crate::errors::debug_as_display!(ServeError);

/// A control socket that is answered. Dropping it removes the socket; a conversation that is under way then breaks off,
/// so that no client can delay the end of the program.
#[derive(Debug)]
pub struct Server {
    path: PathBuf,
    end: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
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
        let end = Arc::new(AtomicBool::new(false));
        let ending = Arc::clone(&end);
        let thread = std::thread::Builder::new()
            .name("fb-control".into())
            .spawn(move || {
                prepare();
                let go_on = || !ending.load(Ordering::Relaxed);
                let under_way = AtomicUsize::new(0);
                let talk = |stream: UnixStream| {
                    prepare();
                    // Whoever went away or talks nonsense is not answered, and that is all.
                    let mut answering = open();
                    let _ = converse(&stream, &go_on, &mut answering);
                    answering.end(&go_on);
                    under_way.fetch_sub(1, Ordering::Relaxed);
                };
                // All of them have ended when this does.
                std::thread::scope(|scope| {
                    while go_on() {
                        let room = under_way.load(Ordering::Relaxed) < MOST_CONVERSATIONS;
                        let Some(Ok((stream, _))) = room.then(|| listener.accept()) else {
                            std::thread::sleep(LOOK_EVERY);
                            continue;
                        };
                        under_way.fetch_add(1, Ordering::Relaxed);
                        let thread = std::thread::Builder::new().name("fb-control-talk".into());
                        if thread.spawn_scoped(scope, || talk(stream)).is_err() {
                            under_way.fetch_sub(1, Ordering::Relaxed);
                        }
                    }
                });
            })
            .map_err(failed)?;
        Ok(Server { path: path.to_owned(), end, thread: Some(thread) })
    }

    /// Where it answers.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
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

/// What answers the questions of one conversation.
pub trait Answering {
    /// The answer. One that takes long breaks off once `go_on` is false: nobody waits for it any more.
    fn answer(&mut self, question: &Value, go_on: &dyn Fn() -> bool) -> Result<Value, String>;

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
fn converse(stream: &UnixStream, go_on: &dyn Fn() -> bool, answering: &mut impl Answering) -> io::Result<()> {
    // An accepted socket waits, whatever its listener does.
    stream.set_nonblocking(false)?;
    let uid = getsockopt(stream, sockopt::PeerCredentials)?.uid();
    let ours = uid == 0 || uid == nix::unistd::geteuid().as_raw();
    let mut patience = PATIENCE;
    loop {
        let reply = match ours {
            true => {
                let line = Talk::new(stream, patience, go_on)?.line(LONGEST_QUESTION)?;
                if line.is_empty() {
                    return Ok(());
                }
                match serde_json::from_slice(&line) {
                    Ok(question) => answering.answer(&question, &|| go_on() && !hung_up(stream)),
                    Err(_) if line.len() == LONGEST_QUESTION => {
                        Err(format!("a request has at most {LONGEST_QUESTION} bytes"))
                    }
                    Err(error) => Err(format!("not a JSON object in one line: {error}")),
                }
            }
            false => Err("only the owner of this master has access".to_owned()),
        };
        let go_on_talking = reply.is_ok();
        let reply = match reply {
            Ok(value) => json!({ "ok": value }),
            Err(why) => json!({ "error": why }),
        };
        Talk::new(stream, PATIENCE, go_on)?.say(&format!("{reply}\n"))?;
        if !go_on_talking {
            return Ok(());
        }
        patience = PAUSE;
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
