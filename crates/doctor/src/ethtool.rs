//! Settings of a network interface, read by the ioctl that ethtool(8) uses (linux/ethtool.h, netdevice(7)). It only
//! reads.

use std::io;
use std::os::fd::AsRawFd;

use nix::sys::socket::{AddressFamily, SockFlag, SockType, socket};

/// The settings that the driver reports. One that it does not report is an error.
#[derive(Debug)]
pub(super) struct Nic {
    /// How long interrupts are held back.
    pub coalescing: io::Result<Coalescing>,
    /// Generic receive offload.
    pub gro: io::Result<bool>,
    /// Large receive offload.
    pub lro: io::Result<bool>,
}

/// How long an interface gathers packets before it interrupts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Coalescing {
    pub rx_us: u32,
    pub tx_us: u32,
    pub adaptive_rx: bool,
    pub adaptive_tx: bool,
}

// Commands and the bit of linux/ethtool.h.
const ETHTOOL_GCOALESCE: u32 = 0x0e;
const ETHTOOL_GFLAGS: u32 = 0x25;
const ETHTOOL_GGRO: u32 = 0x2b;
const ETH_FLAG_LRO: u32 = 1 << 15;

/// linux/sockios.h; the libc crate has it for some C libraries only.
const SIOCETHTOOL: libc::c_ulong = 0x8946;

impl Nic {
    /// Requests a value of the driver of `interface`.
    pub fn ask(interface: &str) -> Nic {
        let value = |command: u32| ask(interface, [command, 0]).map(|[_, value]| value);
        // `struct ethtool_coalesce`: the command and 22 numbers of 32 bits.
        let coalescing =
            ask::<23>(interface, std::array::from_fn(|at| if at == 0 { ETHTOOL_GCOALESCE } else { 0 }));
        Nic {
            coalescing: coalescing.map(|said| Coalescing {
                rx_us: said[1],
                tx_us: said[5],
                adaptive_rx: said[10] != 0,
                adaptive_tx: said[11] != 0,
            }),
            gro: value(ETHTOOL_GGRO).map(|value| value != 0),
            lro: value(ETHTOOL_GFLAGS).map(|flags| flags & ETH_FLAG_LRO != 0),
        }
    }
}

/// Hands `data`, which begins with a command, to the driver, and gives back what it made of it.
fn ask<const WORDS: usize>(interface: &str, mut data: [u32; WORDS]) -> io::Result<[u32; WORDS]> {
    /// `struct ifreq` of netdevice(7), as SIOCETHTOOL uses it: its union is 24 bytes where pointers have 64 bits, 16
    /// where they have 32.
    #[repr(C)]
    struct Ifreq {
        name: [u8; libc::IFNAMSIZ],
        data: *mut u32,
        rest: [usize; if size_of::<usize>() == 8 { 2 } else { 3 }],
    }
    let mut name = [0; libc::IFNAMSIZ];
    // The name ends with a zero.
    if interface.len() >= name.len() {
        return Err(io::ErrorKind::InvalidInput.into());
    }
    name[..interface.len()].copy_from_slice(interface.as_bytes());
    let mut request = Ifreq { name, data: data.as_mut_ptr(), rest: Default::default() };
    // Any socket will do (netdevice(7)).
    let socket = socket(AddressFamily::Inet, SockType::Datagram, SockFlag::SOCK_CLOEXEC, None)?;
    // SAFETY: `request` has the layout of struct ifreq, and its name ends with a zero. For the commands of this file
    // the kernel reads and writes behind its pointer the structure of that command, which is as long as `data`: two
    // words, or the 23 of ethtool_coalesce.
    match unsafe { libc::ioctl(socket.as_raw_fd(), SIOCETHTOOL as _, &raw mut request) } {
        0 => Ok(data),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopback_answers_and_an_unused_address_does_not() {
        // Every Linux has lo, with GRO and without interrupts to hold back.
        let lo = Nic::ask("lo");
        assert!(lo.gro.is_ok() && lo.lro.is_ok(), "{lo:?}");
        assert!(lo.coalescing.is_err(), "{lo:?}");
        for name in ["nobody-has-it", "a-name-that-is-longer-than-any"] {
            assert!(Nic::ask(name).gro.is_err());
        }
    }
}
