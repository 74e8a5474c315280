//! Questions at the terminal, a line each. The answers may come from a pipe.

use std::io::{BufRead, IsTerminal, Write, stdin, stdout};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};

use crate::interrupt::{Interrupt, LOOK_EVERY};
use crate::{Stop, print};

/// Where the answers come from.
pub struct Answers {
    /// Lines as they are typed; `None`: every default is taken.
    lines: Option<Receiver<String>>,
    interrupt: Interrupt,
    /// The typed text does not show: it is printed.
    echoes: bool,
}

impl Answers {
    /// From standard input, or the defaults.
    pub fn new(defaults: bool) -> Result<Answers, Stop> {
        let interrupt = Interrupt::catch().map_err(Stop::failed)?;
        if defaults {
            return Ok(Answers { lines: None, interrupt, echoes: true });
        }
        let (tell, lines) = channel();
        // A read is not ended by a signal: this thread ends with the program.
        let read = move || {
            // What is no UTF-8 is for the reader of the answer to refuse.
            let all = stdin().lock().split(b'\n').map_while(Result::ok);
            let texts = all.map(|line| String::from_utf8_lossy(&line).into_owned());
            texts.take_while(|line| tell.send(line.clone()).is_ok()).for_each(drop);
        };
        std::thread::Builder::new().name("fb-answers".into()).spawn(read).map_err(Stop::failed)?;
        Ok(Answers { lines: Some(lines), interrupt, echoes: !stdin().is_terminal() })
    }

    /// Whether every default is taken.
    pub fn are_defaults(&self) -> bool {
        self.lines.is_none()
    }

    /// Whether to go on.
    pub fn go_on(&self) -> bool {
        !self.interrupt.is_set()
    }

    /// Prints a line.
    pub fn say(&self, text: &str) -> Result<(), Stop> {
        print(text)
    }

    /// The answer to a question with a default in brackets, without spaces around it; the default if it is empty.
    pub fn ask(&self, question: &str, usual: &str) -> Result<String, Stop> {
        let brackets = if usual.is_empty() { String::new() } else { format!(" [{usual}]") };
        let mark = if question.ends_with(['?', '.']) { "" } else { ":" };
        self.prompt(&format!("{question}{brackets}{mark} "))?;
        let typed = self.line()?;
        let answer = if typed.is_empty() { usual } else { typed.as_str() };
        if self.echoes {
            self.say(answer)?;
        }
        Ok(answer.to_owned())
    }

    /// Yes or no.
    pub fn agrees(&self, question: &str, usual: bool) -> Result<bool, Stop> {
        loop {
            let answer = self.ask(question, if usual { "yes" } else { "no" })?;
            match answer.to_ascii_lowercase().as_str() {
                "y" | "yes" => return Ok(true),
                "n" | "no" => return Ok(false),
                _ => self.say("  must be yes or no")?,
            }
        }
    }

    fn prompt(&self, text: &str) -> Result<(), Stop> {
        let mut out = stdout().lock();
        let written = out.write_all(text.as_bytes()).and_then(|()| out.flush());
        written.map_err(|error| Stop::failed(format!("cannot write to standard output: {error}")))
    }

    fn line(&self) -> Result<String, Stop> {
        let Some(lines) = &self.lines else { return Ok(String::new()) };
        let broken = |what| Stop::failed(format!("{what}; nothing is written"));
        loop {
            if !self.go_on() {
                // Behind the prompt.
                self.say("")?;
                return Err(broken("interrupted"));
            }
            match lines.recv_timeout(LOOK_EVERY) {
                Ok(line) => return Ok(line.trim().to_owned()),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    self.say("")?;
                    return Err(broken("the answers have ended"));
                }
            }
        }
    }
}
