//! What arrives: its room, the own telegram that comes back, and the telegrams in it.

use super::answer::{Answer, HEAD, Incoming, Other, Unrelated};
use super::{Echo, INBOX, Job, Line, State, Timing};
use crate::other::Sign;
use crate::wire::telegram::Next;
use fieldbeat_core::time::Time;

impl Line {
    /// Room for what arrives.
    #[inline]
    pub(in super::super) fn room(&mut self) -> &mut [u8] {
        if self.used > 0 {
            self.inbox.copy_within(usize::from(self.used)..usize::from(self.filled), 0);
            (self.filled, self.used) = (self.filled - self.used, 0);
        }
        if usize::from(self.filled) >= INBOX {
            // More than any telegram: noise.
            (self.filled, self.timing.garbled) = (0, true);
        }
        &mut self.inbox[usize::from(self.filled)..]
    }

    /// Takes in `count` bytes that have arrived in its room, the last of them by `at`.
    #[inline]
    pub(in super::super) fn received(&mut self, at: Time, count: usize) {
        self.filled += count as u16;
        if self.echo_left > 0 && self.is_echo() {
            return;
        }
        let Timing { state, free_at, garbled, idle_ns, .. } = &mut self.timing;
        let waits = matches!(state, State::Waiting);
        self.early = waits && self.is_timed && at < *free_at;
        if waits {
            return;
        }
        if at > *free_at {
            // The wire was idle before.
            *garbled = false;
        }
        *free_at = (*free_at).max(at + *idle_ns);
        if let State::Listening(since) = state {
            *since = at;
        }
    }

    /// True if the arrived bytes are the own telegram, and no more than it.
    #[cold]
    fn is_echo(&mut self) -> bool {
        let echoed = usize::from(self.length - self.echo_left);
        let count = usize::from(self.echo_left.min(self.filled));
        let own = self.request.get(echoed..echoed + count).unwrap_or_default();
        if self.inbox.get(..count) != Some(own) {
            // Something else is on the wire.
            self.echo_left = 0;
            return false;
        }
        self.echo_left -= count as u16;
        self.inbox.copy_within(count..usize::from(self.filled), 0);
        self.filled -= count as u16;
        self.filled == 0
    }

    /// The next thing that has arrived by `at`; `None`: no more.
    #[inline]
    pub(in super::super) fn incoming(&mut self, at: Time) -> Option<Incoming<'_>> {
        let begin = usize::from(self.used);
        let bytes = self.inbox.get(begin..usize::from(self.filled)).filter(|bytes| !bytes.is_empty())?;
        let waits = matches!(self.timing.state, State::Waiting) && !self.early && !self.timing.garbled;
        if waits && let Some(high) = self.expected.is_usual(bytes) {
            let length = bytes.len();
            self.used = self.filled;
            (self.timing.state, self.timing.free_at) = (State::Free, self.free_behind(at, length));
            let data = self.inbox.get(begin + HEAD..begin + length - 2).unwrap_or_default();
            return Some(Incoming::Answer(self.job, Answer::Data { high, data }));
        }
        self.parse(at)
    }

    /// The next thing in the inbox, whatever it is.
    #[inline(never)]
    fn parse(&mut self, at: Time) -> Option<Incoming<'_>> {
        let waits = matches!(self.timing.state, State::Waiting) && !self.early;
        let bytes = self.inbox.get(usize::from(self.used)..usize::from(self.filled))?;
        if self.timing.garbled {
            self.used = self.filled;
            self.timing.put_off(at, 0);
            return None;
        }
        let (telegram, size) = match Next::parse(bytes) {
            Next::Incomplete { at_least } => {
                match self.early {
                    true => self.used = self.filled,
                    false => self.timing.put_off(at, self.span_ns(at_least)),
                }
                return None;
            }
            Next::Malformed { why, .. } => {
                self.used = self.filled;
                if !self.early {
                    self.timing.garbled = true;
                    self.timing.put_off(at, 0);
                }
                return Some(Incoming::Other(Other::Malformed { why, expected: waits }));
            }
            Next::Telegram { telegram, size } => {
                self.used += size as u16;
                (telegram, size)
            }
        };
        let free_at = self.free_behind(at, size);
        Some(match self.expected.judge(telegram, self.address) {
            Ok(answer) if waits => {
                (self.timing.state, self.timing.free_at) = (State::Free, free_at);
                Incoming::Answer(self.job, answer)
            }
            Ok(_) => Incoming::Other(Other::Unrelated(Unrelated::Late, Some(self.expected.da))),
            Err(Other::Unrelated(_, from)) if !waits => {
                Incoming::Other(Other::Unrelated(Unrelated::Late, from))
            }
            // With the own address as its sender: from an adapter that returns it, or of a master with the same one.
            Err(Other::Master { address, sign }) if address == self.address => {
                if self.echo == Echo::Unknown && at <= self.known_at {
                    self.echo = Echo::Seen;
                }
                let is_listening = matches!(self.timing.state, State::Listening(_));
                let is_own = !is_listening && self.echo != Echo::Unknown;
                Incoming::Other(if is_own { Other::Own } else { Other::Master { address, sign } })
            }
            // A station that is no slave answers a search only.
            Err(Other::Master { address, sign: Sign::Answer })
                if !waits || !matches!(self.job, Job::Gap(_)) =>
            {
                Incoming::Other(Other::Master { address, sign: Sign::Request })
            }
            Err(other) => Incoming::Other(other),
        })
    }

    /// When the wire is free behind an answer of so many bytes, which were read at `at`. One that was in the port
    /// before it was looked for has ended sooner.
    #[inline]
    fn free_behind(&self, at: Time, size: usize) -> Time {
        let Timing { free_at, overdue_at, answer_by, idle_ns, .. } = self.timing;
        let ended = if self.used == self.filled { at.min(answer_by + self.span_ns(size)) } else { at };
        let free_at = free_at.max(ended + idle_ns);
        if self.left < self.retries { free_at.max(overdue_at) } else { free_at }
    }
}

impl Timing {
    /// More bytes may follow, for so long.
    #[cold]
    fn put_off(&mut self, at: Time, more_ns: u64) {
        let until = at + more_ns + self.idle_ns;
        match self.state {
            State::Waiting if self.garbled => self.overdue_at = until.max(self.free_at),
            State::Waiting => self.overdue_at = self.overdue_at.max(until),
            _ => self.free_at = self.free_at.max(until),
        }
    }
}
