//! Pseudo-terminals in place of serial ports.

use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::{AsRawFd, FromRawFd};
use std::os::unix::fs::symlink;
use std::path::Path;

/// A pseudo-terminal: our end, and the path of the port.
#[derive(Debug)]
pub struct Pty {
    /// Our end.
    pub end: File,
    /// The path of the port.
    pub path: String,
}

impl Pty {
    /// A new one, raw or not as the system makes them.
    #[expect(clippy::new_without_default, reason = "it opens something")]
    pub fn new() -> Pty {
        let mut name = [0; 64];
        // SAFETY: plain numbers; the descriptor is new and nobody else's; the kernel writes at most 64 bytes, with a
        // zero at their end.
        unsafe {
            let end = libc::posix_openpt(libc::O_RDWR | libc::O_NOCTTY | libc::O_CLOEXEC);
            assert!(end >= 0, "{}", io::Error::last_os_error());
            let end = File::from_raw_fd(end);
            assert_eq!((libc::grantpt(end.as_raw_fd()), libc::unlockpt(end.as_raw_fd())), (0, 0));
            assert_eq!(libc::ptsname_r(end.as_raw_fd(), name.as_mut_ptr(), name.len()), 0);
            let path = std::ffi::CStr::from_ptr(name.as_ptr()).to_str().unwrap().to_owned();
            Pty { end, path }
        }
    }

    /// At `link`, in place of what was there.
    pub fn at(self, link: &Path) -> Pty {
        let _ = std::fs::remove_file(link);
        symlink(&self.path, link).unwrap();
        self
    }

    /// Reads so many bytes at our end, which have to be these.
    pub fn expect(&mut self, bytes: &[u8]) {
        let mut got = vec![0; bytes.len()];
        self.end.read_exact(&mut got).unwrap();
        assert_eq!(got, bytes);
    }

    /// The settings of the port.
    pub fn settings(&self) -> libc::termios2 {
        // SAFETY: the kernel writes the settings of a live value, for which all bytes zero are valid.
        unsafe {
            let mut settings = std::mem::zeroed();
            assert_eq!(libc::ioctl(self.end.as_raw_fd(), libc::TCGETS2, &raw mut settings), 0);
            settings
        }
    }

    /// Takes over what has come to `other`'s end; whether there was anything.
    pub fn carry_to(&mut self, other: &mut Pty, room: &mut [u8]) -> bool {
        let mut ready = [libc::pollfd { fd: self.end.as_raw_fd(), events: libc::POLLIN, revents: 0 }];
        // SAFETY: the kernel reads and writes one live value.
        let count = unsafe { libc::poll(ready.as_mut_ptr(), 1, 0) };
        if count <= 0 || ready[0].revents & libc::POLLIN == 0 {
            return false;
        }
        // EIO: nobody has opened the port yet.
        let Ok(count) = self.end.read(room) else { return false };
        other.end.write_all(&room[..count]).unwrap();
        true
    }
}
