//! A reader of one axis' newest feedback, and how long and how often blocking calls look for it.

use std::time::Duration;

use super::cell::Reader;
use super::feedback::{Feedback, Link, StopCause};
use crate::rt::Wires;

/// How often the blocking calls look for events.
pub(super) const LOOK_EVERY: Duration = Duration::from_micros(500);

/// The application waits this much longer than the loop's own time-out, so that the loop's result comes first.
pub(super) const GRACE: Duration = Duration::from_millis(500);

/// A reader of one axis' newest feedback.
#[derive(Clone, Debug)]
pub struct Observer {
    reader: Reader<Feedback>,
    wires: Wires,
}

impl Observer {
    /// One of the machine with these wires.
    #[doc(hidden)]
    pub fn new(reader: Reader<Feedback>, wires: Wires) -> Observer {
        Observer { reader, wires }
    }

    /// The newest feedback. Of a loop that is [stuck](StopCause::LoopStuck) it is the last one: its age grows, its link
    /// is lost, and the axis counts as stopped.
    pub fn feedback(&self) -> Feedback {
        let feedback = self.reader.read();
        match self.wires.silence() {
            0 => feedback,
            silence => self.aged(feedback, silence),
        }
    }

    #[cold]
    fn aged(&self, mut feedback: Feedback, silence: u64) -> Feedback {
        feedback.grow_older(silence);
        if self.is_stuck() {
            feedback.link = Link::Lost;
            feedback.stopped = feedback.stopped.or(Some(StopCause::LoopStuck));
        }
        feedback
    }

    /// Whether the loop is stuck.
    #[doc(hidden)]
    pub fn is_stuck(&self) -> bool {
        self.wires.is_stuck()
    }

    /// The same of the machine with these wires.
    #[doc(hidden)]
    pub fn on(self, wires: &Wires) -> Observer {
        Observer { wires: wires.clone(), ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::cell::cell;

    #[test]
    fn feedback_of_a_stuck_loop_ages_and_says_so() {
        let wires = Wires::default();
        let online = Feedback { link: Link::Online, age: 3, ..Feedback::default() };
        let (mut writer, reader) = cell(online);
        let observer = Observer::new(reader, wires.clone());
        assert_eq!(observer.feedback(), online);
        wires.publish_silence(50);
        assert_eq!(observer.feedback(), Feedback { age: 53, ..online });
        assert!(wires.take(crate::rt::Taker::Watch));
        wires.publish_silence(100);
        let stuck = Feedback { age: 103, link: Link::Lost, stopped: Some(StopCause::LoopStuck), ..online };
        assert_eq!(observer.feedback(), stuck);
        wires.publish_silence(u64::MAX);
        assert_eq!(observer.feedback().age, u32::MAX);
        // What stopped it before stays its cause.
        writer.write(&Feedback { stopped: Some(StopCause::Limit), ..online });
        assert_eq!(observer.feedback().stopped, Some(StopCause::Limit));
    }
}
