//! A reader of one axis' newest feedback, and how long and how often blocking calls look for it.

use std::time::Duration;

use super::cell::Reader;
use super::feedback::Feedback;

/// How often the blocking calls look for events.
pub(super) const LOOK_EVERY: Duration = Duration::from_micros(500);

/// The application waits this much longer than the loop's own time-out, so that the loop's result comes first.
pub(super) const GRACE: Duration = Duration::from_millis(500);

/// A reader of one axis' newest feedback.
#[derive(Clone, Debug)]
pub struct Observer(pub(crate) Reader<Feedback>);

impl Observer {
    /// The newest feedback.
    pub fn feedback(&self) -> Feedback {
        self.0.read()
    }
}
