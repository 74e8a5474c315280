//! Why a drive has no connection, in words: each with its remedy.

use crate::plan::Expected;
use crate::wire::cip::Status;
use crate::wire::connection::ConnectionError;
use crate::wire::encapsulation::Identity;
use fieldbeat_core::time::Ns;

/// The remedy for a refused opening.
fn remedy(status: &Status) -> &'static str {
    match status.failure() {
        Some(Status::OWNED) => {
            "another controller controls the drive, or this one did before with another `originator`: end \
             that one, or wait until the drive has released it; connection = \"input-only\" needs no \
             ownership"
        }
        Some(Status::IN_USE) => {
            "a connection of before may still run: it ends by its time-out; or another controller uses the \
             same `originator`"
        }
        Some(Status::NOBODY_TO_LISTEN_TO) => {
            "listen-only needs another controller that is connected: use connection = \"input-only\""
        }
        Some(Status::OUTGOING_SIZE | Status::INCOMING_SIZE | Status::SIZE) => {
            "look at `version`, and at `heartbeat` of a connection that only reads"
        }
        Some(Status::CONFIGURATION_SIZE | Status::CONFIGURATION | Status::NOT_CONFIGURED) => {
            "look at `configuration`"
        }
        Some(Status::RPI | 0x0112 | 0x011B) => "look at `divisor`, `input_rpi` and the period of the cycle",
        Some(0x0113 | 0x011A) => "end other controllers and tools that are connected to the drive",
        Some(0x0123 | 0x0124 | 0x0813) => "look at `delivery`",
        Some(0x0114 | 0x0115) => {
            "drives or cables are exchanged: put them back, or correct vendor and product (\"any\": whatever \
             answers there)"
        }
        Some(0x0315) => {
            "the drive may not have these assemblies: look at `version`; or it takes no electronic key: \
             vendor = \"any\" and product = \"any\" leave that out"
        }
        Some(0x0133) => "look at `timeout_multiplier`",
        Some(0x0117 | 0x012A | 0x012B | 0x012F) => {
            "the drive may not have these assemblies: look at `version`"
        }
        _ => "look at the drive's manual",
    }
}

/// The drive is of the first version, which nobody has configured.
pub(super) const INPUT_ONLY: &str = "it is of version v1, which has no output assembly: its connection only \
     reads, and no command reaches it; set \
     version = \"v1\", or use a drive of version v2";

/// The remedy for answers to something else than the request.
const STRAY: &str = "look whether another device or a gateway has its address, and at its firmware";

/// The opening was refused.
pub(super) fn refused(status: &Status, pause_ns: u64) -> String {
    format!(
        "the drive refuses the connection: {status}; {}; tried again after {}",
        remedy(status),
        Ns(pause_ns)
    )
}

/// The answer to the opening cannot be used.
pub(super) fn unusable(why: &ConnectionError, pause_ns: u64) -> String {
    let remedy = match why {
        ConnectionError::Interval => "set `divisor` and `input_rpi` to intervals that it has",
        _ => STRAY,
    };
    format!("the drive opens the connection, but {why}: {remedy}; tried again after {}", Ns(pause_ns))
}

/// The drive's own packets would come too rarely.
pub(super) fn too_slow(api_ns: u64, counts_ns: u64, pause_ns: u64) -> String {
    format!(
        "the drive opens the connection, but sends every {} only, and a packet counts for {}: raise \
         `fresh_within`, or `divisor` or `input_rpi` to what it can do; tried again after {}",
        Ns(api_ns),
        Ns(counts_ns),
        Ns(pause_ns)
    )
}

/// The opening was not answered.
pub(super) fn unanswered(waited_ns: u64) -> String {
    format!("the drive does not answer the opening of the connection within {}", Ns(waited_ns))
}

/// The group of a connection cannot be joined.
pub(super) fn no_group(why: &str) -> String {
    format!("the group of the drive's packets cannot be joined: {why}; use delivery = \"point-to-point\"")
}

/// A request was not answered. `unmatched`: so many messages answered nothing.
pub(super) fn silent(what: &str, waited_ns: u64, unmatched: u64) -> String {
    let dropped = match unmatched {
        0 => String::new(),
        count => format!(
            "; {count} messages with the session, sender context or sequence of no request were dropped: \
             {STRAY}"
        ),
    };
    format!("the drive does not answer {what} within {}{dropped}", Ns(waited_ns))
}

/// It is another device than the expected one.
pub(super) fn another(device: &str, found: &Identity, expected: &Expected) -> Option<String> {
    fn differing<T: PartialEq>(expected: Option<T>, found: T, show: fn(&T) -> String) -> Option<[String; 2]> {
        expected.filter(|expected| *expected != found).map(|expected| [show(&found), show(&expected)])
    }
    let Expected { vendor, product, serial } = *expected;
    let parts = [
        ("vendor", differing(vendor, found.vendor, u16::to_string)),
        ("product", differing(product, found.product_code, u16::to_string)),
        ("serial", differing(serial, found.serial, |serial| format!("{serial:#010x}"))),
    ];
    let (key, [found, expected]) = parts.into_iter().find_map(|(key, part)| Some((key, part?)))?;
    Some(format!(
        "{device} is there, whose {key} is {found}, not {expected}: drives or cables are exchanged: put them \
         back, or correct {key} for another drive (\"any\": whatever answers there)"
    ))
}

/// It does not say which one it is.
pub(super) fn no_serial(expected: u32) -> String {
    format!("the drive does not report its serial number, which has to be {expected:#010x}: leave serial out")
}

/// It has no profile code.
pub(super) fn no_profile(device: &str, why: &str) -> String {
    format!(
        "{device} does not say which assemblies it has ({why}): if it is a MOONS' -IP drive, set `version` \
         to \"v1\" or \"v2\""
    )
}
