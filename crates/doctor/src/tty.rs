//! What the driver of a serial port makes of its settings: the only way to know is to try. A port in use is left alone.

use std::ffi::CString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::facts::Root;
use fieldbeat_core::net::SerialLine;
use fieldbeat_core::net::tty::{self, Tried};

/// Why the driver of a port was not tried.
#[derive(Debug)]
pub(super) enum Untried {
    /// Somebody has it open: the name and number of the process.
    InUse(String),
    /// Who has it open is not visible to this user.
    Hidden,
    /// It cannot be opened.
    Refused(io::Error),
}

/// Tries port `path` of this host with the settings of `line`, and puts its own back.
pub(super) fn try_out(root: &Root, path: &str, line: &SerialLine) -> Result<Tried, Untried> {
    require_access(path).map_err(Untried::Refused)?;
    match users(root, &root.resolved(path).ok_or(Untried::Hidden)?) {
        Users::None => tty::try_out(path, line).map_err(|error| match error.raw_os_error() {
            Some(libc::EBUSY | libc::EWOULDBLOCK) => Untried::InUse("another program".to_owned()),
            _ => Untried::Refused(error),
        }),
        Users::One(name) => Err(Untried::InUse(name)),
        Users::Hidden => Err(Untried::Hidden),
    }
}

/// Whether this user may open it, without doing so.
fn require_access(path: &str) -> io::Result<()> {
    let path = CString::new(path)?;
    // SAFETY: the kernel reads a text with a zero at its end.
    let denied = unsafe { libc::access(path.as_ptr(), libc::R_OK | libc::W_OK) } < 0;
    if denied { Err(io::Error::last_os_error()) } else { Ok(()) }
}

#[derive(Debug, PartialEq, Eq)]
enum Users {
    None,
    One(String),
    Hidden,
}

/// Who has `device` open. Each process's descriptors are links to what they stand for (proc_pid_fd(5)); those of others
/// are visible to root only.
fn users(root: &Root, device: &Path) -> Users {
    let mut found = Users::None;
    for pid in root.names("proc").into_iter().filter(|name| name.parse::<u32>().is_ok()) {
        let descriptors = match fs::read_dir(root.0.join(format!("proc/{pid}/fd"))) {
            Ok(descriptors) => descriptors,
            // It has ended by now.
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            Err(_) => {
                found = Users::Hidden;
                continue;
            }
        };
        let mut links = descriptors.flatten().filter_map(|entry| fs::read_link(entry.path()).ok());
        if links.any(|link| link == device) {
            let name = root.get(&format!("proc/{pid}/comm")).unwrap_or_else(|| "process".to_owned());
            return Users::One(format!("{name} ({pid})"));
        }
    }
    found
}

impl Root {
    /// The file that `path`, as a user writes it, leads to through links.
    pub(super) fn resolved(&self, path: &str) -> Option<PathBuf> {
        self.0.join(path.trim_start_matches('/')).canonicalize().ok()
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;
    use crate::facts::testing::Host;
    use fieldbeat_core::net::{Parity, Rs485};
    use fieldbeat_testing::Pty;

    const LINE: SerialLine = SerialLine { rate: 500_000, parity: Parity::Even, rs485: Rs485::Driver };

    #[test]
    fn the_process_that_has_a_port_open_is_named() {
        let host = Host::new(&[("dev/ttyS1", ""), ("proc/self/fd/x", ""), ("proc/7/comm", "picocom\n")]);
        let root = &host.0.root;
        let device = root.resolved("/dev/ttyS1").unwrap();
        assert_eq!(users(root, &device), Users::None);
        fs::create_dir_all(root.0.join("proc/7/fd")).unwrap();
        symlink(&device, root.0.join("proc/7/fd/3")).unwrap();
        assert_eq!(users(root, &device), Users::One("picocom (7)".into()));
        assert_eq!(users(root, &device.with_file_name("ttyS2")), Users::None);
        // One whose descriptors cannot be listed.
        let hidden = Host::new(&[("dev/ttyS1", ""), ("proc/8/fd", "no directory")]);
        assert_eq!(users(&hidden.0.root, &device), Users::Hidden);
    }

    #[test]
    fn a_driver_is_tried_without_a_trace_and_a_port_in_use_is_left_alone() {
        let pty = Pty::new();
        let before = pty.settings();
        let tried = tty::try_out(&pty.path, &LINE).unwrap();
        assert_eq!(tried, Tried { rate: 500_000, refused: None, switches: false });
        let after = pty.settings();
        assert_eq!((after.c_cflag, after.c_ospeed), (before.c_cflag, before.c_ospeed));
        let _used = tty::open(&pty.path, &SerialLine { rs485: Rs485::Adapter, ..LINE }).unwrap();
        let set = pty.settings();
        let error = tty::try_out(&pty.path, &SerialLine { rate: 9_600, ..LINE }).unwrap_err();
        assert!(matches!(error.raw_os_error(), Some(libc::EBUSY | libc::EWOULDBLOCK)), "{error}");
        assert_eq!((pty.settings().c_ospeed, pty.settings().c_lflag), (set.c_ospeed, set.c_lflag));
        // Among the processes of this host, this one has it.
        let root = Root("/".into());
        let Err(Untried::InUse(name)) = try_out(&root, &pty.path, &LINE) else { panic!("it was tried") };
        assert!(name.ends_with(&format!("({})", std::process::id())), "{name}");
        assert!(matches!(try_out(&root, "/dev/no-such-port", &LINE), Err(Untried::Refused(_))));
    }
}
