//! The result of a check: what was found, what is wanted, why, and the commands there and back.

use std::io;

use serde::Serialize;

use super::facts::{Root, shown};

/// The area of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Area {
    /// How the kernel schedules.
    Kernel,
    /// The rights of this user.
    Rights,
    /// The core of the loop, and what else runs on it.
    Core,
    /// How deep that core sleeps.
    Power,
    /// Clocks, timers, and a host above this one.
    Clock,
    /// Settings that move memory.
    Memory,
    /// The network to the drives.
    Network,
    /// The load of a cycle of the plan.
    Load,
    /// Measurements.
    Measured,
}

/// The meaning of a finding for the plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// As it should be.
    Good,
    /// It would be better otherwise.
    Poor,
    /// The plan is refused or certain to fail: this host is not ready for real time.
    Bad,
    /// Not known: this kernel does not report it, or not to this user.
    Unknown,
}

/// One thing about this host.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// The area that it belongs to.
    pub area: Area,
    /// The name of the checked property.
    pub name: String,
    /// The meaning for the plan.
    pub verdict: Verdict,
    /// The state found; why it is not known, if it is not.
    pub found: String,
    /// The wanted state.
    pub wanted: String,
    /// The reason.
    pub why: String,
    /// The commands that fix it, or what to do where no command does; a line each. `None`: nothing to be done.
    pub fix: Option<String>,
    /// The commands that undo them.
    pub undo: Option<String>,
}

impl Finding {
    /// One about the network of a bus.
    pub(super) fn network(bus: &str, name: &str, wanted: &str, why: &str) -> Finding {
        Finding::about(Area::Network, format!("{bus}: {name}"), wanted, why)
    }

    /// A finding that still has to be judged.
    pub(super) fn about(
        area: Area,
        name: impl Into<String>,
        wanted: impl Into<String>,
        why: impl Into<String>,
    ) -> Finding {
        let (name, wanted, why) = (name.into(), wanted.into(), why.into());
        let (verdict, found) = (Verdict::Unknown, String::new());
        Finding { area, name, verdict, found, wanted, why, fix: None, undo: None }
    }

    pub(super) fn good(self, found: impl Into<String>) -> Finding {
        Finding { verdict: Verdict::Good, found: found.into(), ..self }
    }

    pub(super) fn poor(self, found: impl Into<String>) -> Finding {
        Finding { verdict: Verdict::Poor, found: found.into(), ..self }
    }

    pub(super) fn bad(self, found: impl Into<String>) -> Finding {
        Finding { verdict: Verdict::Bad, found: found.into(), ..self }
    }

    /// `why` it is not known.
    pub(super) fn unknown(self, why: impl AsRef<str>) -> Finding {
        Finding { verdict: Verdict::Unknown, found: format!("not known: {}", why.as_ref()), ..self }
    }

    /// The text of a file below `root`; if there is none, the finding is that.
    pub(super) fn read(&mut self, root: &Root, path: &str) -> Option<String> {
        root.text(path).map_err(|error| *self = self.clone().unread(path, &error)).ok()
    }

    /// Not known, since `path` could not be read.
    pub(super) fn unread(self, path: &str, error: &io::Error) -> Finding {
        let path = shown(path);
        match error.kind() {
            io::ErrorKind::NotFound => self.unknown(format!("this kernel has no {path}")),
            io::ErrorKind::PermissionDenied => self.unknown(format!("this user may not read {path}")),
            _ => self.unknown(format!("{path}: {error}")),
        }
    }

    /// Adds the fix, and how to take it back.
    pub(super) fn fix(self, fix: impl Into<String>, undo: impl Into<String>) -> Finding {
        Finding { fix: Some(fix.into()), undo: Some(undo.into()), ..self }
    }

    /// Adds the fix, where nothing has to be undone.
    pub(super) fn advise(self, fix: impl Into<String>) -> Finding {
        Finding { fix: Some(fix.into()), undo: None, ..self }
    }

    /// Words for the kernel command line, as rt-config/host/kernel-cmdline.txt has them.
    pub(super) fn at_boot(self, words: impl std::fmt::Display) -> Finding {
        self.fix(
            format!(
                "add {words} to the kernel command line, restart\n(as in rt-config/host/kernel-cmdline.txt)"
            ),
            format!("remove {words} from the kernel command line, restart"),
        )
    }
}

/// The sample file that makes a setting permanent.
pub(super) fn keep(file: &str) -> String {
    format!("(permanently: rt-config/host/{file})")
}

/// The command that writes `value` into a file that only root may write.
pub(super) fn write(value: impl std::fmt::Display, path: &str) -> String {
    format!("echo {value} | sudo tee {}", shown(path))
}

/// A line for each of `items`.
pub(super) fn lines<T>(items: impl IntoIterator<Item = T>, line: impl FnMut(T) -> String) -> String {
    items.into_iter().map(line).collect::<Vec<_>>().join("\n")
}

/// Cores as the kernel writes them: `0-2,5`.
pub(super) fn list(cores: &[usize]) -> String {
    let mut ranges: Vec<(usize, usize)> = Vec::new();
    for core in cores {
        match ranges.last_mut() {
            Some((_, last)) if *last + 1 == *core => *last = *core,
            _ => ranges.push((*core, *core)),
        }
    }
    let range = |(first, last): &(usize, usize)| match first == last {
        true => first.to_string(),
        false => format!("{first}-{last}"),
    };
    ranges.iter().map(range).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_the_kernels() {
        for (cores, text) in [(&[][..], ""), (&[3], "3"), (&[0, 1, 2, 5], "0-2,5"), (&[1, 3, 4], "1,3-4")] {
            assert_eq!(list(cores), text);
        }
    }

    #[test]
    fn an_unreadable_file_is_reported_as_unknown() {
        let finding =
            |kind: io::ErrorKind| Finding::about(Area::Kernel, "x", "y", "z").unread("proc/x", &kind.into());
        assert_eq!(finding(io::ErrorKind::NotFound).found, "not known: this kernel has no /proc/x");
        assert_eq!(
            finding(io::ErrorKind::PermissionDenied).found,
            "not known: this user may not read /proc/x"
        );
        assert_eq!(finding(io::ErrorKind::NotFound).verdict, Verdict::Unknown);
    }
}
