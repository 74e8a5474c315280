//! The stream that a row belongs to, counted on the application's side.
//!
//! Rows are pushed without waiting, so the application may still push rows for a stream that has already ended,
//! before it has seen the end. Each row carries its stream's number, and a follow runs the rows of its own stream
//! only.

use super::command::{CommandId, Row};
use super::event::{Event, EventKind};

/// The streams of one axis.
#[derive(Debug)]
pub(super) struct Streams {
    /// The stream that rows are pushed to.
    pub(super) pushing: u32,
    /// The stream that the next follow runs.
    pub(super) to_follow: u32,
    /// The last follow that was posted and not yet seen to end.
    running: Option<(CommandId, u32)>,
    /// The position of the row before the next one, if there is one in this stream.
    pub(super) before: Option<f64>,
}

impl Default for Streams {
    fn default() -> Streams {
        Streams { pushing: 1, to_follow: 1, running: None, before: None }
    }
}

impl Streams {
    /// A row was queued. After the last one, rows belong to the next stream.
    pub(super) fn pushed(&mut self, row: Row) {
        self.before = Some(row.position);
        if row.last {
            if self.running.is_some_and(|(_, stream)| stream == self.pushing) {
                self.to_follow = self.pushing + 1;
            }
            self.begin(self.pushing + 1);
        }
    }

    /// A follow was queued.
    pub(super) fn followed(&mut self, id: CommandId) {
        self.running = Some((id, self.to_follow));
        self.before = None;
        if self.to_follow < self.pushing {
            self.to_follow += 1;
        }
    }

    /// The application sees an event: a stream that has ended accepts no more rows, and a stop has dropped all of
    /// them.
    pub(super) fn saw(&mut self, event: &Event) {
        match (event.kind, self.running) {
            (EventKind::Ended { id, .. }, Some((follow, stream))) if id == follow => {
                self.running = None;
                if self.pushing <= stream {
                    self.begin(stream + 1);
                }
                self.to_follow = self.to_follow.max(stream + 1);
            }
            (EventKind::Stopped(_), _) => {
                self.running = None;
                self.begin(self.pushing + 1);
                self.to_follow = self.pushing;
            }
            _ => {}
        }
    }

    fn begin(&mut self, stream: u32) {
        (self.pushing, self.before) = (stream, None);
    }
}
