//! RTS as the direction of an RS-485 transceiver, switched by the driver of a port
//! (Documentation/driver-api/serial/serial-rs485.rst): only it knows when the last bit has left.

use std::io;
use std::os::fd::AsRawFd;

use super::done;

/// `struct serial_rs485` (linux/serial.h), which `libc` does not have.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Setting {
    flags: u32,
    /// ms.
    delay_before: u32,
    /// ms.
    delay_after: u32,
    rest: [u32; 5],
}

// Its flags.
const ENABLED: u32 = 1;
const RTS_ON_SEND: u32 = 1 << 1;
const RTS_AFTER_SEND: u32 = 1 << 2;
const POLARITY: u32 = RTS_ON_SEND | RTS_AFTER_SEND;
const RX_DURING_TX: u32 = 1 << 4;

impl Setting {
    /// A setting of `port`.
    fn get(port: &impl AsRawFd) -> io::Result<Setting> {
        let mut setting = Setting::default();
        // SAFETY: the kernel writes a structure of this layout, or fails.
        done(unsafe { libc::ioctl(port.as_raw_fd(), libc::TIOCGRS485, &raw mut setting) })?;
        Ok(setting)
    }

    /// Sets it. The kernel drops what the driver does not have.
    fn set(mut self, port: &impl AsRawFd) -> io::Result<()> {
        // SAFETY: the kernel reads and writes a structure of this layout, or fails.
        done(unsafe { libc::ioctl(port.as_raw_fd(), libc::TIOCSRS485, &raw mut self) })
    }

    /// The same, switched on and deaf while it sends. Its delays, and its polarity if it has one, may be the device
    /// tree's, which knows the transceiver.
    fn switched_on(self) -> Setting {
        let polarity = match self.flags & POLARITY {
            RTS_AFTER_SEND => RTS_AFTER_SEND,
            _ => RTS_ON_SEND,
        };
        Setting { flags: self.flags & !(POLARITY | RX_DURING_TX) | ENABLED | polarity, ..self }
    }

    /// Whether a driver that reports `self` does what was wanted. Some receive while they send, whatever is set.
    fn meets(self, wanted: Setting) -> bool {
        let switching = ENABLED | POLARITY;
        self.flags & switching == wanted.flags & switching
    }
}

/// Lets the driver of `port` switch the direction.
///
/// # Errors
///
/// It cannot: with the remedy, without the path.
pub(super) fn switch_on(port: &impl AsRawFd) -> io::Result<()> {
    let refused = |what| {
        let message =
            format!("{what}: set rs485 = \"adapter\" if the adapter switches by itself, or use another one");
        io::Error::new(io::ErrorKind::Unsupported, message)
    };
    let has_none = |error: io::Error| match error.raw_os_error() {
        Some(libc::ENOTTY | libc::EINVAL | libc::EOPNOTSUPP) => {
            refused("its driver does not switch the direction of RS-485 (TIOCSRS485)")
        }
        _ => error,
    };
    let wanted = Setting::get(port).map_err(has_none)?.switched_on();
    wanted.set(port).map_err(has_none)?;
    // It takes what it can and reports no error.
    if Setting::get(port)?.meets(wanted) {
        return Ok(());
    }
    Err(refused("its driver does not switch RTS as wanted (TIOCGRS485)"))
}

/// Whether the driver of `port` can switch the direction. Its setting stays as it is: a driver without it refuses that,
/// too.
pub(super) fn is_available(port: &impl AsRawFd) -> bool {
    Setting::get(port).and_then(|setting| setting.set(port)).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_structure_is_that_of_the_kernel() {
        assert_eq!((size_of::<Setting>(), std::mem::offset_of!(Setting, delay_after)), (32, 8));
    }

    #[test]
    fn polarity_and_delays_of_the_device_tree_stay() {
        let on = |flags| Setting { flags, delay_before: 1, ..Setting::default() }.switched_on();
        assert_eq!(on(0), Setting { flags: ENABLED | RTS_ON_SEND, delay_before: 1, ..Setting::default() });
        assert_eq!(on(RTS_AFTER_SEND).flags, ENABLED | RTS_AFTER_SEND);
        // Both would mean that RTS never changes; and our own bytes are not wanted.
        assert_eq!(on(POLARITY | RX_DURING_TX | 1 << 5).flags, ENABLED | RTS_ON_SEND | 1 << 5);
    }

    #[test]
    fn rs485_settings_reported_by_the_driver_are_compared() {
        let wanted = Setting::default().switched_on();
        let reports = |flags| Setting { flags, ..wanted }.meets(wanted);
        assert!(reports(ENABLED | RTS_ON_SEND) && reports(ENABLED | RTS_ON_SEND | RX_DURING_TX));
        assert!(![0, RTS_ON_SEND, ENABLED | RTS_AFTER_SEND, ENABLED].into_iter().any(reports));
    }
}
