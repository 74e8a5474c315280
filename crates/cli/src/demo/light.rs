//! What the demo's terminals do: a light runs along the outputs, there and back with each swing of the wave, and is
//! looked for at the inputs, which the outputs are wired to.

use std::fmt;
use std::time::{Duration, Instant};

use fieldbeat_ethercat::Terminals;
use fieldbeat_master::{Master, MasterError};

/// Their names in the configuration of the demo.
const OUTPUTS: &str = "outputs";
const INPUTS: &str = "inputs";

/// A pattern that is not seen for so long, while both terminals are in operation, never comes. A busy computer may
/// delay the cycle for a second.
const PATIENCE: Duration = Duration::from_secs(3);
/// The last pattern is waited for so long at the end.
const LAST: Duration = Duration::from_millis(100);

/// The light. Its next pattern is written when the last one was seen, so that at most one of them is under way, and
/// never one that the inputs show already.
#[derive(Debug)]
pub struct Light {
    outputs: Terminals,
    inputs: Terminals,
    /// Time of one run there and back.
    run: Duration,
    begun: Instant,
    written: u64,
    seen: u64,
    /// The value that was written last and is not seen yet, and since when it could be.
    awaited: Option<(u8, Instant)>,
    /// The value that was seen last.
    shown: u8,
    /// A pattern was not seen in time.
    lost: bool,
}

impl Light {
    /// That of this master; `None` without terminals.
    ///
    /// # Errors
    ///
    /// Somebody else has them.
    pub fn of(master: &Master, run: Duration) -> Result<Option<Light>, MasterError> {
        if !master.devices().iter().any(|device| device.name == OUTPUTS) {
            return Ok(None);
        }
        Ok(Some(Light {
            outputs: master.device(OUTPUTS)?,
            inputs: master.device(INPUTS)?,
            run,
            begun: Instant::now(),
            written: 0,
            seen: 0,
            awaited: None,
            shown: 0,
            lost: false,
        }))
    }

    /// Lets it begin at the first output now.
    pub fn begin(&mut self) {
        self.begun = Instant::now();
    }

    /// Looks for the last pattern, and writes the next one when it is time.
    pub fn go_on(&mut self) {
        let now = Instant::now();
        if !self.look(now) || self.awaited.is_some() {
            return;
        }
        let next = pattern((now - self.begun).as_secs_f64() / self.run.as_secs_f64());
        if next != self.shown && self.outputs.write(&[next]).is_ok() {
            (self.written, self.awaited) = (self.written + 1, Some((next, now)));
        }
    }

    /// Waits a moment for the last pattern.
    pub fn end(&mut self) {
        let begun = Instant::now();
        while self.awaited.is_some() && begun.elapsed() < LAST {
            std::thread::sleep(Duration::from_millis(1));
            self.look(Instant::now());
        }
    }

    /// Looks for the last pattern; whether the terminals are in operation.
    fn look(&mut self, now: Instant) -> bool {
        let inputs = self.inputs.inputs();
        let operational = self.outputs.inputs().operational && inputs.operational;
        let Some((pattern, since)) = self.awaited else { return operational };
        if !operational {
            self.awaited = Some((pattern, now));
        } else if inputs.bytes() == [pattern] {
            (self.seen, self.shown, self.awaited) = (self.seen + 1, pattern, None);
        } else {
            self.lost |= now - since > PATIENCE;
            // Again, since the terminal forgets it when it leaves operation.
            let _ = self.outputs.write(&[pattern]);
        }
        operational
    }

    /// Whether patterns were written and waited for in operation, and none was ever seen.
    pub fn has_failed(&self) -> bool {
        self.lost && self.seen == 0
    }
}

impl fmt::Display for Light {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.written, self.seen) {
            (0, _) => {
                write!(f, "device {OUTPUTS}: no patterns written, since the terminals were not in operation")
            }
            (written, seen) => {
                write!(f, "device {OUTPUTS}: {written} patterns written, {seen} seen at the {INPUTS}")
            }
        }
    }
}

/// The output that is on after so many runs: the first to the last, and back.
fn pattern(runs: f64) -> u8 {
    let step = (runs.fract() * 14.0) as u32 % 14;
    1 << step.min(14 - step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_light_runs_to_the_last_output_and_back() {
        let run: Vec<u32> = (0..16).map(|n| pattern((f64::from(n) + 0.5) / 14.0).trailing_zeros()).collect();
        assert_eq!(run, [0, 1, 2, 3, 4, 5, 6, 7, 6, 5, 4, 3, 2, 1, 0, 1]);
    }
}
