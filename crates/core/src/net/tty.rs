//! A serial port of the operating system: opened for one program, with the settings of its wire (termios(3),
//! ioctl_tty(2)).
//!
//! `nix` has no rates but the standard ones: TCSETS2 with BOTHER takes any, such as the 500 kbit/s and 1.5 Mbit/s of
//! PROFIBUS.
//!
//! `rs485` is the direction of an RS-485 transceiver.

use std::fs::OpenOptions;
use std::io;
use std::mem::zeroed;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};

use nix::errno::Errno;

use super::serial::{Parity, Rs485, SerialLine};
use crate::errors::no_descriptor;

mod rs485;

/// The rate of a driver may differ from the requested one by this fraction, ppm: IEC 61158-2 allows each station of a
/// PROFIBUS 0.3 %. A receiver alone would do with more, as it samples the last of 11 bits in its middle; but slaves
/// measure their timeouts in bits, and repeaters send each byte again at their own rate.
const RATE_TOLERANCE_PPM: u64 = 3_000;

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
pub fn open(path: &str, line: &SerialLine) -> io::Result<OwnedFd> {
    let port = claim(path).map_err(|error| refused(path, line, error))?;
    if let Err(error) = set(&port, line) {
        release(&port);
        return Err(refused(path, line, error));
    }
    low_latency(&port);
    flush(&port);
    Ok(port)
}

/// The settings of a port as its driver has them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tried {
    /// The rate that it sets, bit/s.
    pub rate: u32,
    /// Why it is refused with that, or with its parity.
    pub refused: Option<String>,
    /// It can switch the direction of RS-485.
    pub switches: bool,
}

/// Tries the settings of `line` on port `path`, and puts its own back. For a port that nobody uses; one that somebody
/// has locked is refused as it is.
pub fn try_out(path: &str, line: &SerialLine) -> io::Result<Tried> {
    let port = open_device(path)?;
    let mut is_locked: libc::c_int = 0;
    // SAFETY: the kernel writes one int. Root opens a port that is locked so.
    done(unsafe { libc::ioctl(port.as_raw_fd(), libc::TIOCGEXCL, &raw mut is_locked) })?;
    if is_locked != 0 {
        return Err(io::Error::from_raw_os_error(libc::EBUSY));
    }
    lock(&port)?;
    let tried = settings(&port).and_then(|before| {
        let refused = set(&port, &SerialLine { rs485: Rs485::Adapter, ..*line }).err();
        let rate = settings(&port)?.c_ospeed;
        apply(&port, &before)?;
        let refused = refused.map(|error| error.to_string());
        Ok(Tried { rate, refused, switches: rs485::is_available(&port) })
    });
    release(&port);
    tried
}

/// Opens it, and keeps others out.
fn claim(path: &str) -> io::Result<OwnedFd> {
    let port = open_device(path)?;
    lock(&port)?;
    Ok(port)
}

fn open_device(path: &str) -> io::Result<OwnedFd> {
    let port = OpenOptions::new()
        .read(true)
        .write(true)
        // Without waiting for a carrier, without becoming the controlling terminal, and in no child process (the
        // standard library opens with O_CLOEXEC).
        .custom_flags(libc::O_NOCTTY | libc::O_NONBLOCK)
        .open(path)?;
    if !port.metadata()?.file_type().is_char_device() {
        return Err(io::Error::from_raw_os_error(libc::ENOTTY));
    }
    Ok(port.into())
}

fn lock(port: &OwnedFd) -> io::Result<()> {
    let fd = port.as_raw_fd();
    // Whoever respects such a lock (picocom, pyserial, another master) does not use it, root included ...
    // SAFETY: plain numbers.
    done(unsafe { libc::flock(fd, libc::LOCK_EX | libc::LOCK_NB) })?;
    // ... and nobody else opens it from now on, but root.
    // SAFETY: a request without an argument.
    done(unsafe { libc::ioctl(fd, libc::TIOCEXCL) })
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
    /// It is no pseudo-terminal.
    pub is_timed: bool,
}

impl Descriptor {
    /// That of a port.
    pub fn of_port(fd: OwnedFd) -> Descriptor {
        let is_timed = is_pseudo_terminal(&fd).is_ok_and(|is_pseudo| !is_pseudo);
        Descriptor { fd, is_port: true, is_timed }
    }
}

impl From<OwnedFd> for Descriptor {
    fn from(fd: OwnedFd) -> Descriptor {
        Descriptor { fd, is_port: false, is_timed: true }
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

/// Reads what was received. Directly, as [`write()`]: a call of libc can be cancelled, which takes some 40 instructions
/// more in a process of several threads.
pub fn read(port: impl AsFd, room: &mut [u8]) -> nix::Result<usize> {
    let port = port.as_fd();
    // SAFETY: the descriptor is borrowed, and the kernel writes the bytes of a live slice.
    let count = unsafe { libc::syscall(libc::SYS_read, port.as_raw_fd(), room.as_mut_ptr(), room.len()) };
    Errno::result(count).map(|count| count as usize)
}

/// Writes the front of `bytes`.
pub fn write(port: impl AsFd, bytes: &[u8]) -> nix::Result<usize> {
    let port = port.as_fd();
    // SAFETY: the descriptor is borrowed, and the kernel reads the bytes of a live slice.
    let count = unsafe { libc::syscall(libc::SYS_write, port.as_raw_fd(), bytes.as_ptr(), bytes.len()) };
    Errno::result(count).map(|count| count as usize)
}

/// Drops what was received and not read, and what was written and has not left. False: the port is gone.
pub fn flush(port: &impl AsRawFd) -> bool {
    // SAFETY: plain numbers.
    unsafe { libc::ioctl(port.as_raw_fd(), libc::TCFLSH, libc::TCIOFLUSH) >= 0 }
}

/// No real wire: it has no parity, and any rate (Unix98 slaves, Documentation/admin-guide/devices.txt).
fn is_pseudo_terminal(port: &OwnedFd) -> io::Result<bool> {
    // SAFETY: all bytes zero are valid facts of a file.
    let mut facts: libc::stat = unsafe { zeroed() };
    // SAFETY: the kernel writes a live value.
    done(unsafe { libc::fstat(port.as_raw_fd(), &raw mut facts) })?;
    Ok((136..=143).contains(&libc::major(facts.st_rdev)))
}

/// The settings as the driver reports them.
fn settings(port: &OwnedFd) -> io::Result<libc::termios2> {
    // SAFETY: all bytes zero are valid settings.
    let mut settings: libc::termios2 = unsafe { zeroed() };
    // SAFETY: the kernel writes the settings of a live value.
    done(unsafe { libc::ioctl(port.as_raw_fd(), libc::TCGETS2, &raw mut settings) })?;
    Ok(settings)
}

fn apply(port: &OwnedFd, settings: &libc::termios2) -> io::Result<()> {
    // SAFETY: the kernel reads the settings of a live value.
    done(unsafe { libc::ioctl(port.as_raw_fd(), libc::TCSETS2, std::ptr::from_ref(settings)) })
}

fn set(port: &OwnedFd, line: &SerialLine) -> io::Result<()> {
    let mut settings = settings(port)?;
    // First of all: until it is set, a transceiver may be sending.
    if line.rs485 == Rs485::Driver {
        rs485::switch_on(port)?;
    }
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
    apply(port, &settings)?;
    // It takes what it can of them and reports no error.
    let taken = self::settings(port)?;
    if ![taken.c_ispeed, taken.c_ospeed].into_iter().all(|rate| is_near(line.rate, rate)) {
        let message = format!(
            "its driver has {} bit/s in place of {}, and 0.3 % off is the most: choose a rate that the \
             adapter supports",
            taken.c_ospeed, line.rate
        );
        return Err(io::Error::new(io::ErrorKind::Unsupported, message));
    }
    let has = |flags| taken.c_cflag & flags != 0;
    if line.parity == Parity::Even && (!has(libc::PARENB) || has(libc::PARODD)) && !is_pseudo_terminal(port)?
    {
        let message = "its driver has no even parity bit: use another adapter";
        return Err(io::Error::new(io::ErrorKind::Unsupported, message));
    }
    Ok(())
}

/// Whether a wire of `wanted` bits a second can have `rate`.
pub fn is_near(wanted: u32, rate: u32) -> bool {
    wanted > 0 && u64::from(rate.abs_diff(wanted)) * 1_000_000 <= u64::from(wanted) * RATE_TOLERANCE_PPM
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
            "there is no serial port {path}: plug in its adapter, or look at the path (ls -l \
             /dev/serial/by-id)"
        ),
        Some(libc::EACCES | libc::EPERM) => format!(
            "no right to use {path}: add this user to its group, which is dialout on most systems (sudo \
             usermod -aG dialout USER), and log in again"
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
    use fieldbeat_testing::Pty;

    const LINE: SerialLine = SerialLine { rate: 500_000, parity: Parity::Even, rs485: Rs485::Adapter };

    #[test]
    fn each_refusal_names_the_port_and_the_remedy() {
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
            let text = refused("/dev/ttyUSB7", &LINE, io::Error::from_raw_os_error(errno)).to_string();
            assert!(text.contains(words) && text.contains("/dev/ttyUSB7"), "{text}");
            assert!(!text.contains('\n'), "{text}");
        }
    }

    #[test]
    fn a_rate_may_be_three_parts_in_a_thousand_off() {
        assert!(is_near(1_500_000, 1_495_500) && is_near(1_500_000, 1_504_500));
        assert!(!is_near(1_500_000, 1_495_499) && !is_near(1_500_000, 1_504_501));
        // 921600 / 2, a usual UART's nearest to 500 kbit/s; and 45.45 kbit/s as a whole number.
        assert!(!is_near(500_000, 460_800) && is_near(45_450, 45_455));
        assert!(!is_near(0, 0) && is_near(u32::MAX, u32::MAX) && !is_near(9_600, u32::MAX));
    }

    #[test]
    fn a_driver_that_cannot_switch_the_direction_is_refused() {
        let pty = Pty::new();
        let text = open(&pty.path, &SerialLine { rs485: Rs485::Driver, ..LINE }).unwrap_err().to_string();
        assert!(text.contains(&pty.path) && text.contains("rs485 = \"adapter\""), "{text}");
        // It is free again, and unlocked.
        open(&pty.path, &LINE).unwrap();
    }

    #[test]
    fn the_structure_is_that_of_the_kernel() {
        // linux/serial.h on a machine with 64 bits.
        #[cfg(target_pointer_width = "64")]
        assert_eq!(size_of::<SerialStruct>(), 72);
        assert_eq!(std::mem::offset_of!(SerialStruct, flags), 16);
    }
}
