//! The session of one drive on the link thread: it registers, reads what the drive is, opens the class 1 connection of
//! the loop and closes it, and carries out the acyclic calls.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the state of the session, and the next request |
//! | `requests` | what is sent |
//! | `inbox` | what arrives: matched to the request under way, or counted and dropped |
//! | `opening` | the form in which a connection is requested |
//! | `calls` | the acyclic calls |
//! | `words` | why there is no connection, in words |
//!
//! One request at a time is under way, unconnected or on a class 3 connection. The end of the TCP connection is not
//! that of the class 1 connection: the loop goes on with it, and the next session finds it open. What the loop wants is
//! looked at by the session's own clock.

mod calls;
mod inbox;
mod opening;
mod requests;
mod words;

use std::collections::VecDeque;
use std::net::SocketAddrV4;
use std::sync::Arc;

use super::exchange::{Facts, News, Outputs, SessionEnd, Wish};
use super::plan::{Access, EthernetIpPlan, Explicit, MoonsDrive, Originator, Version};
use super::wire::connection::{Target, Triad, forward_close};
use super::wire::encapsulation;
use calls::Calls;
use fieldbeat_core::axis::acyclic::{CallError, Port};
use fieldbeat_core::net::{Groups, Handshake, HandshakeState, LinkNotes};
use fieldbeat_core::time::{MS, S, Time};
use opening::Form;

/// A drive that does not answer a request of the session's own within this time is given up.
const ANSWER_NS: u64 = S;
/// The longest time from a new connection to a registered session: three requests, and as much again.
pub(super) const HANDSHAKE_NS: u64 = 6 * ANSWER_NS;
/// The session looks at its queues and at the time at least so often; all sessions at the same instants.
const LOOK_NS: u64 = 50 * MS;
/// A session on which nothing was sent for so long gets a request: the drive closes it after 120 s (TCP/IP object,
/// attribute 13).
const IDLE_NS: u64 = 30 * S;
/// The same of a class 3 connection: it times out after 32 intervals of 1 s.
const CONNECTED_IDLE_NS: u64 = 10 * S;
/// The pause before a connection that has timed out or was refused is opened anew; it doubles with each refusal ...
const LEAST_PAUSE_NS: u64 = S;
/// ... up to this.
const MOST_PAUSE_NS: u64 = 16 * S;
/// The number of connections that may still be open in the drive and are remembered, to be closed.
const MOST_TO_CLOSE: usize = 4;

/// How far the session on the present TCP connection is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// There is no TCP connection.
    Absent,
    /// It is being registered, and the drive identified.
    Starting,
    /// It serves.
    Up,
}

/// Whether connections are opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Life {
    /// Yes.
    Serving,
    /// No more: what is open is being closed. The loop is owed the end of this connection.
    Ending { owed: Option<u32> },
    /// No more, and nothing is open.
    Ended,
}

/// The class 1 connection.
#[derive(Debug)]
enum Io {
    /// It may be opened from this instant on.
    Closed { from: Time },
    /// The opening is under way.
    Opening,
    /// The loop has it.
    Open { generation: u32, opened: Open, _group: Option<Joined> },
}

/// The class 3 connection.
#[derive(Clone, Copy, Debug)]
enum Connected {
    Closed,
    Open { outgoing: u32, incoming: u32, opened: Open, sequence: u16, used: Time },
}

/// The numbers that close a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Open {
    triad: Triad,
    target: Target,
}

/// A group that was joined; left when this is dropped.
#[derive(Debug)]
struct Joined {
    groups: Arc<dyn Groups>,
    group: SocketAddrV4,
}

impl Drop for Joined {
    fn drop(&mut self) {
        self.groups.leave(self.group);
    }
}

/// The request under way.
#[derive(Debug)]
struct Pending {
    what: RequestKind,
    way: Way,
    sent: Time,
    until: Time,
}

/// The kind of the request under way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RequestKind {
    Register,
    Identity,
    Profile,
    /// The register that says whether the drive has its reference.
    Homed(u8),
    /// The class 1 connection, with these outputs, of a drive of this version.
    Open(Open, Outputs, Version),
    /// The class 3 connection.
    OpenConnected(Open),
    /// The close of the first one of those that may still be open.
    Close,
    /// Something that every device answers.
    Probe,
    /// Whether the drive is enabled, before a call that commands it: without a class 1 connection the loop does not see
    /// it.
    Power,
    Call,
}

/// How it was requested.
#[derive(Debug)]
enum Way {
    Unconnected {
        context: u64,
    },
    Connected {
        sequence: u16,
        /// To be repeated after half of the time, once.
        repeat: Option<Vec<u8>>,
    },
}

/// The session of one drive.
#[derive(Debug)]
pub struct Session {
    drive: MoonsDrive,
    originator: Originator,
    /// The address that class 1 packets leave from.
    bind: SocketAddrV4,
    index: u16,
    period_ns: u64,
    end: SessionEnd,
    groups: Option<Arc<dyn Groups>>,
    notes: LinkNotes,
    remarks: LinkNotes,
    calls: Calls,
    inbox: Vec<u8>,
    phase: Phase,
    life: Life,
    handle: u32,
    context: u64,
    pending: Option<Pending>,
    /// The drive by its name, for messages.
    device: String,
    version: Option<Version>,
    /// The facts for the loop are to be read.
    facts_due: bool,
    io: Io,
    form: Form,
    pause_ns: u64,
    connected: Connected,
    /// May still be open in the drive.
    to_close: VecDeque<Open>,
    /// The last connection serial number; `None`: there was none yet.
    serial: Option<u16>,
    generation: u32,
    /// For the loop, as soon as there is room.
    news: VecDeque<News>,
    /// A request was not answered: whether the drive still answers any is to be found out.
    probe_due: bool,
    last_sent: Time,
    next_look: Time,
    /// Messages that answered no request.
    unmatched: u64,
}

impl Session {
    /// The session of drive `index` of `plan`, which has one of this index. `groups`: for a drive whose packets come to
    /// a group.
    pub fn new(
        plan: &EthernetIpPlan,
        index: usize,
        period_ns: u64,
        end: SessionEnd,
        port: Port,
        groups: Option<Arc<dyn Groups>>,
    ) -> Session {
        let drive = plan.drives[index].clone();
        Session {
            originator: plan.originator,
            bind: plan.bind,
            // A bus has less than 65536 drives.
            index: index as u16,
            period_ns,
            end,
            groups,
            notes: LinkNotes::new(1),
            remarks: LinkNotes::new(1),
            calls: Calls::new(port),
            inbox: Vec::new(),
            phase: Phase::Absent,
            life: Life::Serving,
            handle: 0,
            context: 0,
            pending: None,
            device: "the drive".into(),
            version: drive.version,
            facts_due: true,
            io: Io::Closed { from: Time(0) },
            form: Form::new(&drive),
            pause_ns: LEAST_PAUSE_NS,
            connected: Connected::Closed,
            to_close: VecDeque::new(),
            serial: None,
            generation: 0,
            news: VecDeque::new(),
            probe_due: false,
            last_sent: Time(0),
            next_look: Time(0),
            unmatched: 0,
            drive,
        }
    }

    /// Why the class 1 connection is not open, although the session is: at index 0.
    pub fn notes(&self) -> LinkNotes {
        self.notes.clone()
    }

    /// The remarks on the drive although the connection is open: at index 0.
    pub fn remarks(&self) -> LinkNotes {
        self.remarks.clone()
    }

    fn note(&self, note: Option<String>) {
        self.notes.set(0, note.map(|words| format!("{}: {words}", self.drive.address)));
    }

    /// The access of its connection: a unit of the first version has no outputs to own.
    fn access(&self, version: Version) -> Access {
        match (version, self.drive.connection) {
            (Version::V1, Access::Owner) => Access::InputOnly,
            (_, access) => access,
        }
    }

    /// The loop's wishes and guard, and news for it.
    fn look(&mut self, now: Time) {
        self.next_look = Time((now.0 / LOOK_NS + 1).saturating_mul(LOOK_NS));
        self.calls.guard(self.end.is_guarded());
        self.calls.look();
        let abandoned = self.end.is_abandoned();
        while let Some(wish) = self.end.wish() {
            match wish {
                Wish::TimedOut { generation } => self.timed_out(now, generation),
                Wish::Close { .. } => self.close(),
            }
        }
        if abandoned {
            self.close();
        }
        if self.life != Life::Serving {
            self.calls.refuse_all(CallError::Gone);
        }
        self.flush();
    }

    fn tell(&mut self, news: News) {
        // What was read before is outdated: a loop that stands still makes nothing grow.
        if let (News::Read(_), Some(News::Read(_))) = (&news, self.news.back()) {
            self.news.pop_back();
        }
        self.news.push_back(news);
        self.flush();
    }

    fn flush(&mut self) {
        while let Some(news) = self.news.pop_front() {
            if !self.end.tell(news) {
                self.news.push_front(news);
                return;
            }
        }
    }

    /// Nothing of the drive's packets came: the loop has ended the connection.
    fn timed_out(&mut self, now: Time, timed_out: u32) {
        let Io::Open { generation, opened, .. } = &self.io else { return };
        if *generation != timed_out || self.life != Life::Serving {
            return;
        }
        self.close_later(*opened);
        self.io = Io::Closed { from: now + LEAST_PAUSE_NS };
        self.facts_due = true;
        self.tell(News::Closed { generation: timed_out });
    }

    /// Remembers a connection that may still be open in the drive.
    fn close_later(&mut self, open: Open) {
        if self.to_close.len() == MOST_TO_CLOSE {
            // Not the first one: its close may be under way.
            self.to_close.remove(1);
        }
        self.to_close.push_back(open);
    }

    /// The first of them is closed, as far as can be known. At the orderly end it was the loop's.
    fn end_close(&mut self) {
        self.to_close.pop_front();
        self.tell_end();
    }

    /// The orderly end begins.
    fn close(&mut self) {
        if self.life != Life::Serving {
            return;
        }
        // What is under way is no longer waited for: its answer will answer nothing.
        if self.phase == Phase::Up {
            self.drop_pending();
        }
        self.disconnect();
        let generation = match std::mem::replace(&mut self.io, Io::Closed { from: Time(0) }) {
            Io::Open { generation, opened, .. } => {
                self.to_close.push_front(opened);
                generation
            }
            Io::Closed { .. } | Io::Opening => 0,
        };
        self.life = Life::Ending { owed: Some(generation) };
        if self.phase == Phase::Absent || generation == 0 {
            self.tell_end();
        }
    }

    /// The loop need not wait any longer.
    fn tell_end(&mut self) {
        if let Life::Ending { owed } = &mut self.life
            && let Some(generation) = owed.take()
        {
            self.tell(News::Closed { generation });
        }
    }

    /// Gives up the request under way.
    fn drop_pending(&mut self) {
        match self.pending.take().map(|pending| pending.what) {
            Some(RequestKind::Open(open, ..)) => {
                self.close_later(open);
                self.io = Io::Closed { from: Time(0) };
            }
            Some(RequestKind::OpenConnected(open)) => self.close_later(open),
            _ => {}
        }
    }

    /// The class 3 connection is not used any more.
    fn disconnect(&mut self) {
        if let Connected::Open { opened, .. } = self.connected {
            self.close_later(opened);
            self.connected = Connected::Closed;
        }
    }

    /// Sends what is next, as long as nothing is under way.
    fn serve(&mut self, now: Time, out: &mut Vec<u8>) -> HandshakeState {
        if self.phase == Phase::Up {
            while self.pending.is_none() && self.step(now, out) {}
        }
        if self.phase == Phase::Up { HandshakeState::Kept } else { HandshakeState::More }
    }

    /// The next request, or something that needs none; false if there is nothing to do now.
    fn step(&mut self, now: Time, out: &mut Vec<u8>) -> bool {
        if let Some(open) = self.to_close.front().copied() {
            self.request(now, out, RequestKind::Close, &forward_close(open.triad, open.target));
            return true;
        }
        match self.life {
            Life::Serving => {}
            Life::Ending { .. } => {
                self.tell_end();
                encapsulation::unregister_session(out, self.handle);
                self.life = Life::Ended;
                return false;
            }
            Life::Ended => return false,
        }
        if self.probe_due || self.calls.owes() {
            self.probe_due = false;
            self.ask(now, out, RequestKind::Probe);
        } else if self.facts_due {
            self.read_facts(now, out);
        } else if let (Io::Closed { from }, Some(version), true) = (&self.io, self.version, self.drive.cyclic)
            && *from <= now
            && self.news.is_empty()
        {
            self.open(now, out, version);
        } else if self.calls.advance(now) {
            self.call(now, out);
        } else {
            return self.keep_alive(now, out);
        }
        true
    }

    /// ZS and ZA are in no table of what explicit messages, registers or attributes read: they stay unknown.
    fn facts(&mut self, homed: Option<bool>) {
        self.facts_due = false;
        self.tell(News::Read(Facts { homed }));
    }

    /// After a refusal, in words that get the pause.
    fn pause(&mut self, now: Time, least_ns: u64, words: impl FnOnce(u64) -> String) {
        let pause_ns = self.pause_ns.max(least_ns);
        self.pause_ns = (2 * self.pause_ns).min(MOST_PAUSE_NS);
        self.io = Io::Closed { from: now + pause_ns };
        self.note(Some(words(pause_ns)));
    }

    /// Sends the next call, or opens the connection for it.
    fn call(&mut self, now: Time, out: &mut Vec<u8>) {
        let connected = self.drive.explicit == Explicit::Connected;
        if !self.drive.cyclic && self.calls.waits_for_power() {
            self.ask(now, out, RequestKind::Power);
        } else if connected && matches!(self.connected, Connected::Closed) {
            self.connect(now, out);
        } else if let Some((until, message)) = self.calls.send(&self.end) {
            if connected {
                self.send_connected(now, out, RequestKind::Call, until, message);
            } else {
                self.send(now, out, RequestKind::Call, until, &message, None);
            }
        }
    }

    fn keep_alive(&mut self, now: Time, out: &mut Vec<u8>) -> bool {
        if let Connected::Open { used, .. } = self.connected
            && now.since(used) >= CONNECTED_IDLE_NS
        {
            return self.send_connected(
                now,
                out,
                RequestKind::Probe,
                now + 2 * ANSWER_NS,
                RequestKind::Probe.message(),
            );
        }
        if now.since(self.last_sent) >= IDLE_NS {
            self.ask(now, out, RequestKind::Probe);
            return true;
        }
        false
    }

    /// The request under way was not answered in time; `Err`: the drive is given up.
    fn expire(&mut self, now: Time, out: &mut Vec<u8>) -> Result<(), String> {
        let Some(pending) = &mut self.pending else { return Ok(()) };
        if let Way::Connected { sequence, repeat } = &mut pending.way
            && now.since(pending.sent) >= pending.until.since(pending.sent) / 2
            && let Connected::Open { outgoing, .. } = self.connected
            && let Some(message) = repeat.take()
        {
            // The same number again: the drive answers again, and does not carry it out again.
            encapsulation::send_unit_data(out, self.handle, outgoing, *sequence, &message);
            self.last_sent = now;
        }
        if now < pending.until {
            return Ok(());
        }
        let waited_ns = pending.until.since(pending.sent);
        let connected = matches!(pending.way, Way::Connected { .. });
        let what = pending.what;
        self.pending = None;
        let unmatched = self.unmatched;
        let silent = |what| Err(words::silent(what, waited_ns, unmatched));
        match what {
            RequestKind::Register => return silent("the registration of a session"),
            RequestKind::Identity => return silent("a request for its identity"),
            RequestKind::Profile => return silent("a request for its profile code"),
            RequestKind::Homed(_) => return silent("a request for a register"),
            RequestKind::Probe if !connected => return silent("a request that every device answers"),
            RequestKind::Close => {
                self.end_close();
                if self.life == Life::Serving {
                    return silent("the closing of a connection");
                }
            }
            // It may be open all the same.
            RequestKind::Open(open, ..) => {
                self.close_later(open);
                self.pause(now, 0, |_| words::unanswered(waited_ns));
            }
            RequestKind::OpenConnected(open) => {
                self.close_later(open);
                self.calls.silent();
            }
            RequestKind::Power | RequestKind::Call => {
                self.calls.silent();
                self.probe_due = true;
            }
            RequestKind::Probe => {}
        }
        if connected {
            self.disconnect();
        }
        Ok(())
    }
}

impl Handshake for Session {
    fn begin(&mut self, now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.look(now);
        self.inbox.clear();
        self.pending = None;
        self.handle = 0;
        if let Life::Ending { .. } = self.life
            && self.to_close.is_empty()
        {
            self.tell_end();
            self.life = Life::Ended;
        }
        if self.life == Life::Ended {
            return HandshakeState::Failed("this master has ended its session".into());
        }
        self.phase = Phase::Starting;
        self.facts_due = true;
        let context = self.next_context();
        encapsulation::register_session(out, context);
        self.wait(now, RequestKind::Register, Way::Unconnected { context }, now + ANSWER_NS);
        HandshakeState::More
    }

    fn take(&mut self, now: Time, bytes: &[u8], out: &mut Vec<u8>) -> HandshakeState {
        match self.receive(now, bytes, out) {
            Ok(()) => self.serve(now, out),
            Err(why) => HandshakeState::Failed(why),
        }
    }

    fn next_due(&self) -> Option<Time> {
        Some(self.next_look)
    }

    fn run(&mut self, now: Time, out: &mut Vec<u8>) -> HandshakeState {
        self.look(now);
        if self.phase == Phase::Absent {
            self.calls.refuse_all(CallError::NotOnline);
            return HandshakeState::More;
        }
        match self.expire(now, out) {
            Ok(()) => self.serve(now, out),
            Err(why) => HandshakeState::Failed(why),
        }
    }

    /// Only of the session: the class 1 connection goes on.
    fn closed(&mut self, now: Time, _why: &str) {
        let was_opening = matches!(self.io, Io::Opening);
        self.drop_pending();
        if was_opening {
            self.io = Io::Closed { from: now + LEAST_PAUSE_NS };
        }
        // A drive may keep it open beyond the end of its session.
        self.disconnect();
        self.phase = Phase::Absent;
        self.calls.refuse_all(CallError::NotOnline);
        self.tell_end();
    }

    fn has_ended(&self) -> bool {
        self.life == Life::Ended
    }
}

#[cfg(test)]
mod tests;
