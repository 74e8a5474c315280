//! Which connection a request opens, or why it opens none: the table of errors.
//!
//! Looks at what is open, changes nothing. Facts: sheet, 2.2 (the order of the key's checks), 2.5, 2.6; what they
//! leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | to the drive: nothing or multicast; from it: nothing, while the other one is something | 0x0123, 0x0124 |
//! | another class than 1 and 3 | 0x0103 |
//! | a redundant owner | 0x0125 |
//! | a class 3 connection longer than the drive can do | 0x0127 or 0x0128 with the longest |
//! | packets of variable size | are taken if the size is the right one |
//! | a second multicast connection that differs in class, trigger, priority, fixed or variable size | 0x0137, 0x0138, 0x0136, 0x0135 |

use super::adapter::Origin;
use super::assembly;
use super::cip::{Failure, Key};
use super::connections::{Connections, IO_PORT, Use};
use super::open::{Open, OpenPath, Parameters, Type};
use super::produce::Producer;
use super::settings::{Configuration, ConfigurationError, IdentitySettings, Ownership, ShortRpi};
use fieldbeat_core::time::{MS, US};

/// A connection as it would be opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Admitted {
    pub purpose: Use,
    /// us, to the drive and from it.
    pub api_us: (u32, u32),
    pub multicast: bool,
}

type Checked<T> = Result<T, Failure>;

/// Refuses with this extended status if `wrong`.
fn unless(wrong: bool, status: u16) -> Checked<()> {
    if wrong { Err(Failure::extended(status)) } else { Ok(()) }
}

/// What an open leads to.
pub(super) fn admit(
    open: &Open<'_>,
    origin: Origin,
    connections: &Connections,
    identity: &IdentitySettings,
) -> Checked<Admitted> {
    unless(connections.open.iter().any(|other| other.triad == open.triad), 0x0100)?;
    unless(open.multiplier > 7, 0x0133)?;
    unless(open.to.kind == Type::Null && open.from.kind == Type::Null, 0x0132)?;
    unless(open.trigger > 2 || !matches!(open.class, 1 | 3), 0x0103)?;
    let right = |kind, multicast| kind == Type::PointToPoint || multicast && kind == Type::Multicast;
    unless(!right(open.to.kind, false), 0x0123)?;
    unless(!right(open.from.kind, open.class == 1), 0x0124)?;
    unless(open.to.redundant || open.from.redundant, 0x0125)?;
    let path = OpenPath::parse(open.path).map_err(|_| Failure::extended(0x0315))?;
    path.key.map_or(Ok(()), |key| check_key(key, identity))?;
    let purpose = match open.class {
        3 => messages(open, &path, connections)?,
        _ => packets(open, &path, connections, identity)?,
    };
    let api_us = (interval(open.intervals_us.0, connections)?, interval(open.intervals_us.1, connections)?);
    let inhibit = path.inhibit.map_or(0, |ms| u64::from(ms) * MS);
    unless(inhibit > u64::from(open.intervals_us.1) * US, 0x011B)?;
    let multicast = open.from.kind == Type::Multicast;
    if let Use::ListenOnly(input) = purpose {
        // It gets the packets that somebody else has requested, at their interval.
        let is_like = |producer: &Producer| producer.input == input && producer.api_us == api_us.1;
        unless(!connections.producers.iter().any(is_like), 0x0112)?;
    }
    if let Some(input) = purpose.input().filter(|_| multicast) {
        shared(open, input, api_us.1, origin, connections)?;
    }
    Ok(Admitted { purpose, api_us, multicast })
}

/// Vendor and product, then the type, then the revision; 0 is any.
fn check_key(key: Key, identity: &IdentitySettings) -> Checked<()> {
    let differs = |wanted: u16, own: u16| wanted != 0 && wanted != own;
    unless(differs(key.vendor, identity.vendor) || differs(key.product, identity.product), 0x0114)?;
    unless(differs(key.device_type, identity.device_type), 0x0115)?;
    let (major, minor) = identity.revision;
    let wrong = match (key.major & 0x7F, key.major >> 7 == 1) {
        (wanted, true) => wanted != major || !(1..=minor).contains(&key.minor),
        (0, false) => false,
        (wanted, false) => wanted != major || key.minor != 0 && key.minor != minor,
    };
    unless(wrong, 0x0116)
}

/// A class 3 connection: to the message router, and nothing else in its path.
fn messages(open: &Open<'_>, path: &OpenPath<'_>, connections: &Connections) -> Checked<Use> {
    let plain = path.points == [None; 2] && path.configuration.is_none() && path.inhibit.is_none();
    unless((path.class, path.instance) != (2, 1) || path.surplus || !plain, 0x0315)?;
    let most = connections.settings.message_size;
    for (status, parameters) in [(0x0127, open.to), (0x0128, open.from)] {
        if !(2..=most).contains(&parameters.size) {
            return Err(Failure::sized(status, most));
        }
    }
    let count = connections.count(|purpose| purpose == Use::Messages);
    unless(count >= connections.settings.connections.2, 0x0113)?;
    Ok(Use::Messages)
}

/// A class 1 connection.
fn packets(
    open: &Open<'_>,
    path: &OpenPath<'_>,
    connections: &Connections,
    identity: &IdentitySettings,
) -> Checked<Use> {
    let settings = &connections.settings;
    unless(path.class != 4, 0x012F)?;
    unless(path.instance != u32::from(assembly::CONFIGURATION) || path.surplus, 0x0315)?;
    let [Some(output), Some(input)] = path.points else { return Err(Failure::extended(0x0315)) };
    let input = u8::try_from(input).ok().filter(|input| assembly::is_input(*input, identity));
    let (Some(input), Some(output)) = (input, u8::try_from(output).ok()) else {
        return Err(Failure::extended(0x012F));
    };
    let purpose = match output {
        assembly::OUTPUT if identity.has_outputs() => Use::Owner(input),
        assembly::INPUT_ONLY => Use::InputOnly(input),
        assembly::LISTEN_ONLY => Use::ListenOnly(input),
        _ => return Err(Failure::extended(0x012F)),
    };
    let right = match purpose {
        Use::Owner(_) => assembly::OUTPUT_SIZE as u16 + 6,
        _ => settings.heartbeat,
    };
    sized(open.to, 0x0127, right)?;
    sized(open.from, 0x0128, assembly::input_size(input) as u16 + 2)?;
    check_configuration(path.configuration.unwrap_or_default(), connections)?;
    match purpose {
        Use::Owner(_) => {
            unless(connections.count(|purpose| matches!(purpose, Use::Owner(_))) > 0, 0x0106)?;
            let stranger = connections.last_owner.is_some_and(|owner| !owner.same_originator(open.triad));
            unless(settings.ownership == Ownership::Kept && stranger, 0x0106)?;
        }
        Use::InputOnly(_) => {
            let count = connections.count(|purpose| matches!(purpose, Use::InputOnly(_)));
            unless(count >= settings.connections.0, 0x0113)?;
        }
        Use::ListenOnly(_) => {
            unless(!connections.is_requested(input), 0x0119)?;
            let count = connections.count(|purpose| matches!(purpose, Use::ListenOnly(_)));
            unless(count >= settings.connections.1, 0x0113)?;
        }
        Use::Messages => {}
    }
    Ok(purpose)
}

fn sized(parameters: Parameters, status: u16, right: u16) -> Checked<()> {
    if parameters.size == right { Ok(()) } else { Err(Failure::sized(status, right)) }
}

fn check_configuration(data: &[u8], connections: &Connections) -> Checked<()> {
    let settings = &connections.settings;
    let right = match settings.configuration {
        Configuration::Accepted => matches!(data.len(), 0 | assembly::CONFIGURATION_SIZE),
        Configuration::Required => data.len() == assembly::CONFIGURATION_SIZE,
        Configuration::Refused => data.is_empty(),
    };
    let most = if settings.configuration == Configuration::Refused { 0 } else { 1 };
    match settings.configuration_error {
        _ if right => Ok(()),
        ConfigurationError::Invalid => Err(Failure::extended(0x0129)),
        ConfigurationError::Size => Err(Failure::sized(0x0126, most)),
        ConfigurationError::NotConfigured => Err(Failure::extended(0x0110)),
    }
}

/// The interval that the drive makes of a requested one.
fn interval(requested_us: u32, connections: &Connections) -> Checked<u32> {
    let settings = &connections.settings;
    let requested = u64::from(requested_us) * US;
    let least = settings.least_rpi_ns.max(US);
    unless(requested < least && settings.short_rpi == ShortRpi::Refused, 0x0111)?;
    let whole = requested.max(least).next_multiple_of(settings.tick_ns.max(US));
    u32::try_from(whole.div_ceil(US)).map_err(|_| Failure::extended(0x0111))
}

/// All originators of a group share its packets.
fn shared(open: &Open<'_>, input: u8, api_us: u32, origin: Origin, connections: &Connections) -> Checked<()> {
    let mask = connections.settings.mask.to_bits();
    unless(origin.peer.ip().to_bits() & mask != connections.ip.to_bits() & mask, 0x0813)?;
    unless(origin.port.is_some_and(|port| port != IO_PORT), 0x0108)?;
    let Some(producer) = connections.group_of(input) else { return Ok(()) };
    let first = &producer.like;
    unless(producer.api_us != api_us, 0x0112)?;
    unless(first.from.variable != open.from.variable, 0x0135)?;
    unless(first.from.priority != open.from.priority, 0x0136)?;
    unless(first.class != open.class, 0x0137)?;
    unless(first.trigger != open.trigger, 0x0138)
}
