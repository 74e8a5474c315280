//! The terminal of the panel: taken over, and given back whatever happens.

use std::io::{self, IsTerminal, Stdout, Write, stdin, stdout};
use std::mem::ManuallyDrop;
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crossbeam_channel::Receiver;
use fieldbeat_core::rt::confine::{Keep, give_up_rights};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::termios::{FlushArg, tcflush};
use ratatui::Terminal as Screen;
use ratatui::backend::CrosstermBackend;
use ratatui::crossterm::event::{
    self, DisableBracketedPaste, DisableFocusChange, EnableBracketedPaste, EnableFocusChange, Event,
    KeyboardEnhancementFlags, PopKeyboardEnhancementFlags, PushKeyboardEnhancementFlags,
};
use ratatui::crossterm::execute;
use ratatui::crossterm::terminal::{
    EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode,
};

use super::Stop;

/// The terminal is the panel's.
static IS_TAKEN: AtomicBool = AtomicBool::new(false);

/// A terminal answers sooner, over the slowest connection too.
const ANSWERS_WITHIN: Duration = Duration::from_secs(2);

/// Bytes before its answers: what was typed meanwhile.
const LONGEST_ANSWER: usize = 4_096;

/// Events that wait to be looked at.
const MOST_EVENTS: usize = 1_024;

/// Refuses to run without one.
pub fn require() -> Result<(), Stop> {
    if stdin().is_terminal() && stdout().is_terminal() {
        return Ok(());
    }
    Err(Stop::usage("jog needs a terminal for its keys and its screen: run it in one, without a pipe"))
}

/// The terminal while the panel has it.
pub struct Terminal {
    /// The screen. Never dropped: it would complain on a standard error that is gone, which is a panic.
    pub screen: ManuallyDrop<Screen<CrosstermBackend<Stdout>>>,
    /// It says that it reports keys that go up.
    pub has_releases: bool,
    /// The reported events, each with when it was read.
    pub events: Receiver<(Instant, Event)>,
    _taken: Taken,
}

impl Terminal {
    /// Takes it over.
    pub fn take() -> Result<Terminal, Stop> {
        require()?;
        let failed =
            |error: io::Error| Stop::failed(format!("cannot set up the terminal: {error}; try another one"));
        give_back_on_panic();
        IS_TAKEN.store(true, Ordering::SeqCst);
        let taken = Taken;
        enable_raw_mode().map_err(failed)?;
        // What was typed before the panel was there is not meant for it.
        tcflush(stdin(), FlushArg::TCIFLUSH).map_err(|error| failed(error.into()))?;
        execute!(stdout(), EnterAlternateScreen, EnableFocusChange, EnableBracketedPaste).map_err(failed)?;
        // Which keys are down, if it can tell. One that knows the question may still not do it: what it has set of it
        // is read back.
        let mut has_releases = false;
        if keyboard_flags().map_err(failed)?.is_some() {
            let flags = KeyboardEnhancementFlags::DISAMBIGUATE_ESCAPE_CODES
                | KeyboardEnhancementFlags::REPORT_EVENT_TYPES;
            execute!(stdout(), PushKeyboardEnhancementFlags(flags)).map_err(failed)?;
            let set = keyboard_flags().map_err(failed)?;
            has_releases = set.is_some_and(|set| set & flags.bits() == flags.bits());
        }
        let screen = ManuallyDrop::new(Screen::new(CrosstermBackend::new(stdout())).map_err(failed)?);
        let events = read().map_err(failed)?;
        Ok(Terminal { screen, has_releases, events, _taken: taken })
    }

    /// Whether somebody may still be at its other end.
    pub fn is_there(&self) -> bool {
        let input = stdin();
        let mut looked = [PollFd::new(input.as_fd(), PollFlags::empty())];
        let broken = PollFlags::POLLHUP | PollFlags::POLLERR | PollFlags::POLLNVAL;
        let found = poll(&mut looked, PollTimeout::ZERO);
        found.is_ok() && !looked[0].revents().is_some_and(|events| events.intersects(broken))
    }
}

/// Gives the terminal back when it is dropped.
struct Taken;

impl Drop for Taken {
    fn drop(&mut self) {
        give_back();
    }
}

/// As it was before. What fails, fails because it is gone.
fn give_back() {
    if IS_TAKEN.swap(false, Ordering::SeqCst) {
        // A terminal that does not know the first one ignores it.
        let _ = execute!(stdout(), PopKeyboardEnhancementFlags);
        let _ = execute!(stdout(), DisableBracketedPaste, DisableFocusChange, LeaveAlternateScreen);
        let _ = execute!(stdout(), ratatui::crossterm::cursor::Show);
        let _ = disable_raw_mode();
    }
}

/// The message of a panic is to be read.
fn give_back_on_panic() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        // Those of other threads end no panel.
        if std::thread::current().name() == Some("main") {
            give_back();
        }
        before(panic);
    }));
}

/// The flags of kitty's keyboard protocol that the terminal has set. `None`: it knows none, or does not answer.
/// <https://sw.kovidgoyal.net/kitty/keyboard-protocol/#detection-of-support-for-this-protocol>
fn keyboard_flags() -> io::Result<Option<u8>> {
    // Every terminal answers what comes second: its device attributes.
    stdout().write_all(b"\x1b[?u\x1b[c")?;
    stdout().flush()?;
    let until = Instant::now() + ANSWERS_WITHIN;
    let mut said = Vec::new();
    while said.len() < LONGEST_ANSWER && answer(&said, b'c').is_none() {
        let input = stdin();
        let left = until.saturating_duration_since(Instant::now()).as_millis();
        let mut looked = [PollFd::new(input.as_fd(), PollFlags::POLLIN)];
        match poll(&mut looked, u16::try_from(left).unwrap_or(u16::MAX)) {
            Err(nix::errno::Errno::EINTR) => continue,
            Ok(1..) => {}
            _ => break,
        }
        let mut bytes = [0; 64];
        match nix::unistd::read(&input, &mut bytes) {
            Ok(count @ 1..) => said.extend(&bytes[..count]),
            Err(nix::errno::Errno::EINTR) => {}
            _ => break,
        }
    }
    Ok(answer(&said, b'u').and_then(|flags| std::str::from_utf8(flags).ok()?.parse().ok()))
}

/// The parameters of the answer `CSI ? parameters end` in what a terminal has said.
fn answer(said: &[u8], end: u8) -> Option<&[u8]> {
    let begin = b"\x1b[?";
    let mut answers = (0..said.len()).filter_map(|at| said[at..].strip_prefix(begin));
    answers.find_map(|rest| {
        let length = rest.iter().position(|byte| !(byte.is_ascii_digit() || *byte == b';'))?;
        (rest[length] == end).then_some(&rest[..length])
    })
}

/// Reads on a thread of its own, so that a terminal that hangs holds nothing up. It ends with the process: a read that
/// has begun cannot be ended.
fn read() -> io::Result<Receiver<(Instant, Event)>> {
    let (tell, events) = crossbeam_channel::bounded(MOST_EVENTS);
    std::thread::Builder::new().name("fb-keys".into()).spawn(move || {
        give_up_rights(Keep::Nothing);
        while let Ok(event) = event::read() {
            // With no room the panel hangs, and what was typed meanwhile counts for nothing.
            if let Err(crossbeam_channel::TrySendError::Disconnected(_)) =
                tell.try_send((Instant::now(), event))
            {
                break;
            }
        }
    })?;
    Ok(events)
}

/// How long the panel waits for an event.
pub const LOOK_EVERY: Duration = Duration::from_millis(10);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_answers_of_a_terminal_are_found_among_keys_and_each_other() {
        type Found = Option<&'static [u8]>;
        let answers: [(&[u8], Found, Found); 6] = [
            (b"\x1b[?62c", None, Some(b"62")),
            (b"\x1b[?0u\x1b[?62;22c", Some(b"0"), Some(b"62;22")),
            (b"e\x1b[C\x1b[?3u\x1b[?1;2c", Some(b"3"), Some(b"1;2")),
            (b"\x1b[?3", None, None),
            (b"\x1b[?\x1b[?31u", Some(b"31"), None),
            (b"\x1b[3u\x1b[c", None, None),
        ];
        for (said, flags, attributes) in answers {
            assert_eq!((answer(said, b'u'), answer(said, b'c')), (flags, attributes), "{said:?}");
        }
    }
}
