//! A serial port of the operating system: opened for one program, with the settings of its wire (termios(3),
//! ioctl_tty(2)).
//!
//! `nix` has no rates but the standard ones: TCSETS2 with BOTHER takes any, such as the 500 kbit/s and 1.5 Mbit/s of
//! PROFIBUS.

use std::fs::OpenOptions;
use std::io;
use std::mem::zeroed;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt};

use super::serial::{Parity, SerialLine};
use crate::errors::no_descriptor;

/// The rate of a driver may differ from the requested one by this fraction: a receiver samples the last of 11 bits in
/// its middle, so that both ends together may be 4 % apart.
const RATE_TOLERANCE: f64 = 0.02;

/// In `serial_struct.flags`: the driver hands on each byte at once (linux/tty_flags.h). An FTDI adapter waits for up to
/// 16 ms otherwise.
const LOW_LATENCY: libc::c_int = 1 << 13;

/// `struct serial_struct` (linux/serial.h), which `libc` does not have.
#[repr(C)]
#[derive(Clone, Copy)]
struct SerialStruct {
    kind: libc::c_int,
    line: libc::c_int,
    port: libc::c_uint,
    irq: libc::c_int,
    flags: libc::c_int,
    xmit_fifo_size: libc::c_int,
    custom_divisor: libc::c_int,
    baud_base: libc::c_int,
    close_delay: libc::c_ushort,
    io_type: libc::c_char,
    reserved_char: [libc::c_char; 1],
    hub6: libc::c_int,
    closing_wait: libc::c_ushort,
    closing_wait2: libc::c_ushort,
    iomem_base: *mut libc::c_uchar,
    iomem_reg_shift: libc::c_ushort,
    port_high: libc::c_uint,
    iomap_base: libc::c_ulong,
}

/// Opens port `path` for this program alone, raw, with the settings of `line`; it never waits. For normal threads: a
/// driver may take some milliseconds.
///
/// # Errors
///
/// Each with the path and the remedy.
pub(crate) fn open(path: &str, line: &SerialLine) -> io::Result<OwnedFd> {
    let refused = |error: io::Error| refused(path, line, error);
    let port = OpenOptions::new()
        .read(true)
        .write(true)
        // Without waiting for a carrier, without becoming the controlling terminal, and in no child process (the
        // standard library opens with O_CLOEXEC).
        .custom_flags(libc::O_NOCTTY | libc::O_NONBLOCK)
        .open(path)
        .map_err(refused)?;
    let facts = port.metadata().map_err(refused)?;
    if !facts.file_type().is_char_device() {
        return Err(refused(io::Error::from_raw_os_error(libc::ENOTTY)));
    }
    let port = OwnedFd::from(port);
    let fd = port.as_raw_fd();
    // Whoever respects such a lock (picocom, pyserial, another master) does not use it, root included ...
    // SAFETY: plain numbers.
    done(unsafe { libc::flock(fd, libc::LOCK_EX | libc::LOCK_NB) }).map_err(refused)?;
    // ... and nobody else opens it from now on, but root.
    // SAFETY: a request without an argument.
    done(unsafe { libc::ioctl(fd, libc::TIOCEXCL) }).map_err(refused)?;
    if let Err(error) = set(&port, line, is_pseudo_terminal(facts.rdev())) {
        release(&port);
        return Err(refused(error));
    }
    low_latency(&port);
    flush(&port);
    Ok(port)
}

/// The other program may open it again. A pseudo-terminal would remember otherwise that it was one's own.
fn release(port: &OwnedFd) {
    // SAFETY: a request without an argument. It cannot fail on a port that is there.
    unsafe { libc::ioctl(port.as_raw_fd(), libc::TIOCNXCL) };
}

/// The descriptor of a connection: a socket, or a port, which others may use again wherever it is dropped.
#[derive(Debug)]
pub(crate) struct Descriptor {
    fd: OwnedFd,
    is_port: bool,
}

impl Descriptor {
    /// That of a port.
    pub fn of_port(fd: OwnedFd) -> Descriptor {
        Descriptor { fd, is_port: true }
    }
}

impl From<OwnedFd> for Descriptor {
    fn from(fd: OwnedFd) -> Descriptor {
        Descriptor { fd, is_port: false }
    }
}

impl AsFd for Descriptor {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }
}

impl AsRawFd for Descriptor {
    fn as_raw_fd(&self) -> RawFd {
        self.fd.as_raw_fd()
    }
}

impl Drop for Descriptor {
    fn drop(&mut self) {
        if self.is_port {
            release(&self.fd);
        }
    }
}

/// Drops what was received and not read, and what was written and has not left. False: the port is gone.
pub(crate) fn flush(port: &impl AsRawFd) -> bool {
    // SAFETY: plain numbers.
    unsafe { libc::ioctl(port.as_raw_fd(), libc::TCFLSH, libc::TCIOFLUSH) >= 0 }
}

/// No real wire: it has no parity, and any rate (Unix98 slaves, Documentation/admin-guide/devices.txt).
fn is_pseudo_terminal(device: u64) -> bool {
    (136..=143).contains(&libc::major(device))
}

fn set(port: &OwnedFd, line: &SerialLine, pseudo: bool) -> io::Result<()> {
    let fd = port.as_raw_fd();
    // SAFETY: all bytes zero are valid settings.
    let mut settings: libc::termios2 = unsafe { zeroed() };
    // SAFETY: the kernel writes the settings of a live value.
    done(unsafe { libc::ioctl(fd, libc::TCGETS2, &raw mut settings) })?;
    // Raw: every byte as it comes. A byte with a wrong parity is read as 0, so that the telegram keeps its length.
    settings.c_iflag = libc::IGNBRK | if line.parity == Parity::Even { libc::INPCK } else { 0 };
    settings.c_oflag = 0;
    settings.c_lflag = 0;
    // No modem lines, no flow control, one stop bit.
    settings.c_cflag = libc::CS8 | libc::CREAD | libc::CLOCAL | libc::BOTHER;
    if line.parity == Parity::Even {
        settings.c_cflag |= libc::PARENB;
    }
    (settings.c_ispeed, settings.c_ospeed) = (line.rate, line.rate);
    // With O_NONBLOCK, VMIN = 1 never waits either: a read of nothing fails with EAGAIN, and 0 means that the port is
    // gone. With VMIN = 0 both would be 0.
    settings.c_cc[libc::VMIN] = 1;
    settings.c_cc[libc::VTIME] = 0;
    // SAFETY: the kernel reads the settings of a live value, and writes them below.
    done(unsafe { libc::ioctl(fd, libc::TCSETS2, &raw const settings) })?;
    // It takes what it can of them and reports no error.
    // SAFETY: as above.
    done(unsafe { libc::ioctl(fd, libc::TCGETS2, &raw mut settings) })?;
    let (wanted, rate) = (f64::from(line.rate), f64::from(settings.c_ospeed));
    if (rate - wanted).abs() > wanted * RATE_TOLERANCE || line.rate == 0 {
        let message = format!(
            "its driver has {} bit/s in place of {}: choose a rate that the adapter supports",
            settings.c_ospeed, line.rate
        );
        return Err(io::Error::new(io::ErrorKind::Unsupported, message));
    }
    if line.parity == Parity::Even && settings.c_cflag & libc::PARENB == 0 && !pseudo {
        let message = "its driver has no parity bit: use another adapter";
        return Err(io::Error::new(io::ErrorKind::Unsupported, message));
    }
    Ok(())
}

/// Where the driver has it.
fn low_latency(port: &OwnedFd) {
    // SAFETY: all bytes zero are a valid value: numbers and a null pointer that is only handed back.
    let mut serial: SerialStruct = unsafe { zeroed() };
    // SAFETY: the kernel writes a structure of this layout, or fails.
    if unsafe { libc::ioctl(port.as_raw_fd(), libc::TIOCGSERIAL, &raw mut serial) } >= 0 {
        serial.flags |= LOW_LATENCY;
        // SAFETY: the kernel reads a structure of this layout. A driver without the flag ignores it.
        unsafe { libc::ioctl(port.as_raw_fd(), libc::TIOCSSERIAL, &raw const serial) };
    }
}

fn done(result: libc::c_int) -> io::Result<()> {
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Why a port cannot be used, and the remedy.
fn refused(path: &str, line: &SerialLine, error: io::Error) -> io::Error {
    let message = match error.raw_os_error() {
        Some(libc::ENOENT | libc::ENODEV | libc::ENXIO | libc::EIO) => format!(
            "there is no serial port {path}: plug in its adapter, or look at the path (ls -l /dev/serial/by-id)"
        ),
        Some(libc::EACCES | libc::EPERM) => format!(
            "no right to use {path}: add this user to its group, which is dialout on most systems (sudo usermod -aG \
             dialout USER), and log in again"
        ),
        Some(libc::EBUSY | libc::EWOULDBLOCK) => {
            format!("{path} is in use by another program: end it (fuser -v {path} shows which)")
        }
        Some(libc::ENOTTY | libc::EISDIR) => {
            format!("{path} is no serial port: name one like /dev/ttyUSB0 or /dev/ttyS0")
        }
        Some(libc::EINVAL) => {
            format!("{path} cannot be set to {} bit/s: choose a rate that the adapter supports", line.rate)
        }
        _ => match no_descriptor(&error) {
            Some(remedy) => format!("cannot open {path}: {error}; {remedy}"),
            None => format!("cannot use {path}: {error}"),
        },
    };
    io::Error::new(error.kind(), message)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINE: SerialLine = SerialLine { rate: 500_000, parity: Parity::Even };

    #[test]
    fn each_refusal_names_the_port_and_the_remedy() {
        let text = |errno| refused("/dev/ttyUSB7", &LINE, io::Error::from_raw_os_error(errno)).to_string();
        for (errno, words) in [
            (libc::ENOENT, "plug in its adapter"),
            (libc::EIO, "plug in its adapter"),
            (libc::EACCES, "dialout"),
            (libc::EBUSY, "fuser -v /dev/ttyUSB7"),
            (libc::EWOULDBLOCK, "in use by another program"),
            (libc::ENOTTY, "is no serial port"),
            (libc::EINVAL, "500000 bit/s"),
            (libc::EMFILE, "ulimit -n"),
            (libc::ENOMEM, "Cannot allocate"),
        ] {
            let text = text(errno);
            assert!(text.contains(words) && text.contains("/dev/ttyUSB7"), "{text}");
            assert!(!text.contains('\n'), "{text}");
        }
    }

    #[test]
    fn what_is_no_serial_port_is_refused() {
        let text = |path: &str| open(path, &LINE).unwrap_err().to_string();
        assert!(text("/dev/no-such-port").contains("there is no serial port /dev/no-such-port"));
        assert!(text("/dev/null").contains("/dev/null is no serial port"), "{}", text("/dev/null"));
        assert!(text("/").contains("is no serial port"), "{}", text("/"));
        let file = tempfile::NamedTempFile::new().unwrap();
        let path = file.path().to_str().unwrap();
        assert!(text(path).contains("is no serial port"), "{}", text(path));
    }

    #[test]
    fn the_structure_is_that_of_the_kernel() {
        // linux/serial.h on a machine with 64 bits.
        #[cfg(target_pointer_width = "64")]
        assert_eq!(size_of::<SerialStruct>(), 72);
        assert_eq!(std::mem::offset_of!(SerialStruct, flags), 16);
    }
}
