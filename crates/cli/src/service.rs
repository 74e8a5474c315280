//! The service manager: notified when the master runs, and fed only while its cycles advance.

use std::time::{Duration, Instant};

use fieldbeat_master::Master;
use sd_notify::{NotifyState, notify, watchdog_enabled};

/// The notifications to systemd (sd_notify(3)). Elsewhere nobody listens, and that is all.
#[derive(Debug)]
pub struct Service {
    /// How often it wants to be fed: in half of its time-out.
    feed_every: Option<Duration>,
    fed: Instant,
    /// Cycles executed and slots skipped when it was fed last: a loop that skips lives too.
    planned: u64,
}

impl Service {
    /// The master runs.
    pub fn ready() -> Service {
        // Nobody listening is no error.
        let _ = notify(&[NotifyState::Ready, NotifyState::Status("the cycle runs")]);
        Service { feed_every: watchdog_enabled().map(|limit| limit / 2), fed: Instant::now(), planned: 0 }
    }

    /// Feeds the watchdog if it is time and the loop went on meanwhile.
    pub fn look(&mut self, master: &Master) {
        let Some(every) = self.feed_every else { return };
        let planned = master.status().planned;
        if self.fed.elapsed() >= every && planned > self.planned {
            (self.fed, self.planned) = (Instant::now(), planned);
            let _ = notify(&[NotifyState::Watchdog]);
        }
    }

    /// The orderly end has begun.
    pub fn stopping(&self) {
        let _ = notify(&[NotifyState::Stopping]);
    }
}
