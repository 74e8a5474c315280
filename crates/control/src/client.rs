//! The client of the control socket.

use std::io;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use nix::sys::socket::{getsockopt, sockopt};
use serde_json::Value;
use thiserror::Error;

use super::place;
use super::protocol::{Exchange, connect};

/// A master that lives answers sooner.
const PATIENCE: Duration = Duration::from_secs(5);

/// Bytes of an answer.
const LONGEST_ANSWER: usize = 16 << 20;

/// Why there is no answer. The message ends with the remedy.
#[derive(Error)]
pub enum AskError {
    /// There is no socket.
    #[error("no master answers at {0}; start it with `fieldbeat run`")]
    Nobody(PathBuf),
    /// A process that died left it behind.
    #[error("the master of {0} has died, only its socket is left; start it again with `fieldbeat run`")]
    Dead(PathBuf),
    /// It is another user's.
    #[error("{0} belongs to another user: only its owner and root have access; use sudo")]
    NotOurs(PathBuf),
    /// Somebody listens there whose place it is not.
    #[error(
        "{path} is served by user {user}, who does not own the directory; remove it, and start the master \
         again"
    )]
    OtherOwner {
        /// The socket.
        path: PathBuf,
        /// Who listens.
        user: u32,
    },
    /// The conversation broke off.
    #[error("no answer from {path}: {error}; try again, and check the load of this computer")]
    Io {
        /// The socket.
        path: PathBuf,
        /// The error of the operating system.
        error: io::Error,
    },
    /// It broke off before: an answer that is still on its way would be taken for that to another question.
    #[error("the connection to {0} has failed before: open another one")]
    Broken(PathBuf),
    /// It answered something else.
    #[error("{0} does not answer like this program; is it another version?")]
    Foreign(PathBuf),
    /// It knows the question, and says no.
    #[error("{0}")]
    Refused(String),
}
fieldbeat_core::debug_as_display!(AskError);

/// Sends one question to the master at `path`. It is this user's, root's, or that of whoever owns the directory. Its
/// answer may be shown on a terminal as it is: no text in it has control characters but the end of a line.
pub fn ask(path: &Path, question: &Value) -> Result<Value, AskError> {
    Conversation::open(path)?.ask(question, PATIENCE)
}

/// Question after question to one master, up to the first that fails.
#[derive(Debug)]
pub struct Conversation {
    path: PathBuf,
    /// None once a question has failed. One question at a time.
    stream: Mutex<Option<UnixStream>>,
}

impl Conversation {
    /// With the master at `path`; see [`ask`].
    pub fn open(path: &Path) -> Result<Conversation, AskError> {
        let own = || path.to_owned();
        let failed = |error| AskError::Io { path: own(), error };
        let stream = connect(path, PATIENCE).map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => AskError::Nobody(own()),
            io::ErrorKind::ConnectionRefused => AskError::Dead(own()),
            io::ErrorKind::PermissionDenied => AskError::NotOurs(own()),
            _ => failed(error),
        })?;
        let user = getsockopt(&stream, sockopt::PeerCredentials).map_err(|error| failed(error.into()))?.uid();
        let ours = [0, nix::unistd::geteuid().as_raw()].contains(&user);
        if !ours && path.parent().and_then(place::owner) != Some(user) {
            return Err(AskError::OtherOwner { path: own(), user });
        }
        Ok(Conversation { path: own(), stream: Mutex::new(Some(stream)) })
    }

    /// Sends a question; the answer may take `patience`. A question that fails ends the conversation.
    pub fn ask(&self, question: &Value, patience: Duration) -> Result<Value, AskError> {
        let mut held = self.stream.lock().unwrap_or_else(PoisonError::into_inner);
        let stream = held.take().ok_or_else(|| AskError::Broken(self.path.clone()))?;
        let answer = self.ask_over(&stream, question, patience)?;
        *held = Some(stream);
        Ok(answer)
    }

    /// Sends a question whose answer is no line, and gives the connection to its reader.
    pub(super) fn into_stream(self, question: &Value) -> Result<UnixStream, AskError> {
        let held = self.stream.into_inner().unwrap_or_else(PoisonError::into_inner);
        let stream = held.ok_or_else(|| AskError::Broken(self.path.clone()))?;
        let said = Exchange::new(&stream, PATIENCE, &|| true)
            .and_then(|exchange| exchange.say(&format!("{question}\n")));
        said.map_err(|error| AskError::Io { path: self.path, error })?;
        Ok(stream)
    }

    fn ask_over(&self, stream: &UnixStream, question: &Value, patience: Duration) -> Result<Value, AskError> {
        let own = || self.path.clone();
        let failed = |error| AskError::Io { path: own(), error };
        let exchange = Exchange::new(stream, patience, &|| true).map_err(failed)?;
        let said = exchange.say(&format!("{question}\n"));
        let line = exchange.line(LONGEST_ANSWER).map_err(failed)?;
        // Whoever did not take all of the question may have said why.
        if line.is_empty() {
            said.map_err(failed)?;
        }
        let mut reply: Value = serde_json::from_slice(&line).map_err(|_| AskError::Foreign(own()))?;
        if !reply.is_object() {
            return Err(AskError::Foreign(own()));
        }
        disarm(&mut reply);
        match (reply["ok"].take(), &reply["error"]) {
            (Value::Null, Value::String(why)) => Err(AskError::Refused(why.clone())),
            (Value::Null, _) => Err(AskError::Foreign(own())),
            (answer, _) => Ok(answer),
        }
    }
}

/// Takes out of every text what would steer a terminal.
fn disarm(value: &mut Value) {
    let armed = |c: char| c.is_control() && c != '\n';
    match value {
        Value::String(text) => text.retain(|c| !armed(c)),
        Value::Array(values) => values.iter_mut().for_each(disarm),
        Value::Object(values) => {
            let named = std::mem::take(values).into_iter();
            values.extend(named.map(|(name, mut value)| {
                disarm(&mut value);
                (name.replace(armed, ""), value)
            }));
        }
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, Permissions};
    use std::os::unix::fs::{PermissionsExt, chown};
    use std::os::unix::net::UnixListener;
    use std::sync::Arc;

    use serde_json::json;

    use super::super::Server;
    use super::super::server::tests::socket;
    use super::*;

    #[test]
    fn no_answer_steers_a_terminal() {
        let (_directory, path) = socket();
        let answer = |question: &Value| match question["ask"].as_str() {
            Some(_) => Ok(json!({ "text": "a\x1b[2J\nb\u{9b}1m\r", "\x1bk": ["\x07", 1] })),
            None => Err("no\x1b[2J".to_owned()),
        };
        let _server = Server::start(&path, || {}, move || answer).unwrap();
        let answer = ask(&path, &json!({ "ask": "status" })).unwrap();
        assert_eq!(answer, json!({ "text": "a[2J\nb1m", "k": ["", 1] }));
        assert_eq!(ask(&path, &json!({})).unwrap_err().to_string(), "no[2J");
    }

    #[test]
    fn a_late_answer_is_not_taken_for_that_to_another_question() {
        let (_directory, path) = socket();
        let hold = Arc::new(Mutex::new(()));
        let held = Arc::clone(&hold);
        let answer = move |question: &Value| {
            drop(held.lock().unwrap_or_else(PoisonError::into_inner));
            Ok(question.clone())
        };
        let _server = Server::start(&path, || {}, move || answer.clone()).unwrap();
        let conversation = Conversation::open(&path).unwrap();
        let (first, second) = (json!({ "ask": 1 }), json!({ "ask": 2 }));
        assert_eq!(conversation.ask(&first, PATIENCE).unwrap(), first);
        let holding = hold.lock().unwrap();
        let late = conversation.ask(&first, Duration::from_millis(100)).unwrap_err();
        assert!(matches!(late, AskError::Io { .. }), "{late}");
        drop(holding);
        let broken = conversation.ask(&second, PATIENCE).unwrap_err();
        assert!(matches!(broken, AskError::Broken(_)), "{broken}");
        // Another conversation is none the worse for it.
        assert_eq!(ask(&path, &second).unwrap(), second);
    }

    #[test]
    #[ignore = "needs root: listens as another user"]
    fn a_listener_in_the_directory_of_another_user_gets_no_request() {
        let nobody = 65534;
        let (directory, path) = socket();
        fs::set_permissions(&directory, Permissions::from_mode(0o777)).unwrap();
        let place = path.clone();
        let thread = std::thread::spawn(move || {
            // SAFETY: takes three numbers. The system call, unlike the function of that name, changes this thread
            // alone.
            assert_eq!(unsafe { libc::syscall(libc::SYS_setresuid, nobody, nobody, nobody) }, 0);
            UnixListener::bind(place).unwrap()
        });
        let listener = thread.join().unwrap();
        let requested = |mode| {
            fs::set_permissions(&directory, Permissions::from_mode(mode)).unwrap();
            ask(&path, &json!({})).unwrap_err()
        };
        assert!(matches!(requested(0o777), AskError::OtherOwner { user, .. } if user == nobody));
        assert!(matches!(requested(0o755), AskError::OtherOwner { user, .. } if user == nobody));
        chown(&directory, Some(nobody), None).unwrap();
        // It gets the request, and ends.
        drop(std::thread::spawn(move || (0..3).for_each(|_| drop(listener.accept()))));
        assert!(!matches!(requested(0o755), AskError::OtherOwner { .. }));
    }
}
