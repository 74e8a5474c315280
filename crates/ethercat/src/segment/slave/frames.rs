//! The content of a slave in the frames, and its possible share of their working counters.

use super::{Mapped, Note, Slave, Step};
use crate::image::AL_SIZE;
use crate::wire::registers::{AlState, AlStatus};
use fieldbeat_core::time::{MS, Time};

/// In OP for so long, ns, no frame of its way there comes back any more.
const UP_FOR_NS: u64 = 10 * MS;

impl Slave {
    /// The AL status in a frame that has come back; 0: it took no part. Without an FMMU for that, its last known
    /// state, if there is anything of its inputs.
    #[inline]
    pub fn shown_in(&self, received: &[u8]) -> AlStatus {
        if self.has_al {
            let al = received.get(self.offsets.al..).and_then(<[u8]>::first_chunk::<AL_SIZE>);
            return AlStatus(al.map_or(0, |bytes| u16::from_le_bytes(*bytes) & AlStatus::SHOWN));
        }
        AlStatus(self.way.al.filter(|_| self.has_inputs(received)).map_or(0, |al| al.number().into()))
    }

    /// There is anything of its inputs: the master sends zeros.
    pub fn has_inputs(&self, received: &[u8]) -> bool {
        received.get(self.offsets.inputs.clone()).unwrap_or_default().iter().any(|byte| *byte != 0)
    }

    /// The possible share of the working counter of such a frame, at least and at most.
    #[inline]
    pub fn counts(&self) -> (u16, u16) {
        let inputs = u16::from(self.has_al || !self.plan.inputs.is_empty());
        let all = inputs + self.written();
        let full = if self.way.mapped == Mapped::Inputs { inputs } else { all };
        match self.shown.state() {
            // Nothing shows whether it is there.
            _ if !self.has_al => (0, all),
            _ if self.shown.0 == 0 => (0, 0),
            Some(AlState::SafeOp | AlState::Op) if self.way.mapped != Mapped::None => match self.step {
                Step::Release | Step::Check { .. } => (full, all),
                _ => (full, full),
            },
            // Its earlier share: a slave that comes back may still take part, and one that comes up not yet.
            _ => (0, all),
        }
    }

    /// It is in OP with all of its process data, and its image shows it.
    #[inline]
    pub fn is_steady(&self) -> bool {
        const OP: Option<AlState> = Some(AlState::Op);
        self.wants_nothing() && self.way.was_operational && (self.way.al, self.reported) == (OP, OP)
    }

    /// The part of the working counter that it adds when it is steady.
    #[inline]
    pub fn full(&self) -> u16 {
        1 + self.written()
    }

    /// A write counts twice, if it is one datagram with the read.
    #[inline]
    fn written(&self) -> u16 {
        let times = if self.lrw { 2 } else { 1 };
        if self.plan.outputs.is_empty() { 0 } else { times }
    }

    /// Another master has taken it out of OP, by the state that its image shows: a slave that falls by itself reports
    /// an error (ETG.1000.6). One in INIT may have restarted, and is looked at first. It was in OP for a while: no
    /// older frame shows this.
    pub fn is_lowered(&self, now: Time) -> bool {
        let was_up = matches!(self.step, Step::Up) && !self.way.joined && self.way.al == Some(AlState::Op);
        let is_below = matches!(self.shown.state(), Some(AlState::PreOp | AlState::SafeOp));
        was_up && now.since(self.since) > UP_FOR_NS && is_below && !self.shown.error()
    }

    /// The image shows another state than before, or an error.
    pub fn show(&mut self, now: Time) {
        if !self.way.was_operational && !self.is_settled() {
            return;
        }
        self.way.al = self.shown.state();
        if !self.is_settled() || !self.shown.error() && self.way.al == Some(AlState::Op) {
            return;
        }
        // In SAFEOP it waits for the lock.
        let waits = matches!(self.step, Step::Lock) && self.shown == AlStatus::request(AlState::SafeOp);
        match self.way.al {
            _ if waits => {}
            Some(AlState::SafeOp | AlState::Op) => self.enter(now, Step::Code),
            // It says why, so it was not switched off.
            _ if self.shown.error() => self.enter(now, Step::Code),
            _ => self.start_over(now, 0, Note::Starting),
        }
    }
}
