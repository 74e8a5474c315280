//! An EtherNet/IP bus as configured and checked.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::wire::assembly::Inputs;
pub use super::wire::assembly::{Layout, Version};
pub use super::wire::connection::{Access, Delivery};
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::axis::{AxisPlan, MonitorChannel, Units};
use fieldbeat_core::time::{MS, S};

/// The UDP port of class 1 packets, in both directions.
pub const IO_PORT: u16 = 2222;
/// The TCP and UDP port of explicit messages.
pub const PORT: u16 = 44_818;

/// Velocities on the wire are in 1/240 rev/s (0.25 rpm) ...
pub const VELOCITY_PER_REV: f64 = 240.0;
/// ... and accelerations in 1/6 rev/s² (10 rpm/s).
pub const ACCELERATION_PER_REV: f64 = 6.0;
/// The most of either (Host Command Reference, AC and VE); the least is 1.
pub const MOST_PER_REV: f64 = 32_000.0;

/// The interval of packets, ns. The range of these drives is not published; shorter ones would be bursts.
pub const RPI_RANGE_NS: (u64, u64) = (MS, 10 * S);
/// The highest code of the timeout multiplier: 512 intervals.
pub const MULTIPLIER_MAX: u8 = 7;
/// The least time-out of a connection that is chosen where none is given, ns (Schneider M580, table of multipliers).
const USUAL_TIMEOUT_NS: u64 = 100 * MS;
/// The longest time that the drive's own watchdog (ZS) can be set to, ns.
pub const WATCHDOG_MAX_NS: u64 = 10 * S;

/// One UDP socket and its drives, each with a session of its own.
#[derive(Clone, Debug, PartialEq)]
pub struct EthernetIpPlan {
    /// The name in messages.
    pub name: String,
    /// Where packets leave and arrive. Sessions leave from its address, too: a drive compares both.
    pub bind: SocketAddrV4,
    /// Who opens the connections. It stays the same after a crash: a drive lets only its owner of before open anew.
    pub originator: Originator,
    /// The mark of class 1 packets for switches and routers (DSCP, 0 ... 63).
    pub dscp: u8,
    /// The drives; one address each.
    pub drives: Vec<MoonsDrive>,
}

/// An originator of connections.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Originator {
    /// The vendor.
    pub vendor: u16,
    /// The serial number: unique among all originators of this vendor on the network.
    pub serial: u32,
}

/// One MOONS' STF or SSDC.
#[derive(Clone, Debug, PartialEq)]
pub struct MoonsDrive {
    /// The settings of every protocol's axis. Counts are motor steps, as the drive's EG sets them.
    pub axis: AxisPlan,
    /// Motor steps of a revolution, as the drive's EG sets them: velocities are revolutions on the wire.
    pub steps_per_revolution: f64,
    /// Where it takes sessions.
    pub address: SocketAddrV4,
    /// Which device has to be there.
    pub expected: Expected,
    /// The access of the connection.
    pub connection: Access,
    /// It has a class 1 connection. Without one there are explicit messages only: they need none, and own nothing.
    pub cyclic: bool,
    /// Which assemblies the drive has; `None`: as its profile code says.
    pub version: Option<Version>,
    /// The order of the elements of the input assembly 0x65.
    pub layout: Layout,
    /// How its packets come.
    pub delivery: Delivery,
    /// The interval of the drive's own packets, ns; `None`: that of ours.
    pub input_rpi_ns: Option<u64>,
    /// The connection times out after 4 << this many packets: 0 ... 7. `None`: the least with 100 ms in both
    /// directions, and behind the stop request that follows a loss.
    pub multiplier: Option<u8>,
    /// A packet counts for so long, ns; `None`: two of the drive's intervals.
    pub fresh_within_ns: Option<u64>,
    /// The first packet of the drive has to come within this time, ns.
    pub first_within_ns: u64,
    /// The bytes of the configuration assembly 0x66; `None`: without them, then with two zero bytes.
    pub configuration: Option<Vec<u8>>,
    /// The connection size of heartbeats; `None`: 2, then what the drive wants.
    pub heartbeat: Option<u8>,
    /// How explicit messages go.
    pub explicit: Explicit,
    /// A command word is held, and idle after it, for at least so many packets.
    pub hold: u8,
    /// A command whose effect is not seen within this time was not taken, ns.
    pub effect_within_ns: u64,
    /// The watchdog that stops the drive if the master dies.
    pub watchdog: Watchdog,
    /// The input that is its hardware enable; `None`: none is wired.
    pub enable_input: Option<EnableInput>,
    /// How it homes; `None`: homing is refused.
    pub homing: Option<Homing>,
    /// The Q register, as its character, that is not 0 while the drive has its reference; `None`: only what this master
    /// saw counts.
    pub homed_register: Option<u8>,
    /// It has an encoder: its position is the encoder's, else that of the commanded steps.
    pub encoder: bool,
    /// Encoder counts of a motor step, if it has one.
    pub encoder_counts_per_step: f64,
    /// Jogs are taken: the drive's own watchdog ends them if the master dies.
    pub jog: bool,
}

/// Which device has to be at the address of a drive; what is left out may be any. It is compared with its identity
/// object in each session, before a connection is opened; vendor and product go with each opening, too, as an
/// electronic key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expected {
    /// The vendor.
    pub vendor: Option<u16>,
    /// The product code.
    pub product: Option<u16>,
    /// The serial number.
    pub serial: Option<u32>,
}

/// That of a drive of this type.
impl Default for Expected {
    fn default() -> Expected {
        Expected { vendor: Some(Expected::VENDOR), ..Expected::ANY }
    }
}

impl Expected {
    /// Applied Motion Products: that MOONS' units report it is inferred.
    pub const VENDOR: u16 = 60;
    /// Whatever answers there.
    pub const ANY: Expected = Expected { vendor: None, product: None, serial: None };
}

/// How explicit messages go.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Explicit {
    /// Unconnected.
    #[default]
    Unconnected,
    /// On a class 3 connection.
    Connected,
}

/// The watchdog that makes the drive stop by itself when no packets come any more: its parameters ZS and ZA. They are
/// taken on trust: no message of the Host Command Reference reads them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Watchdog {
    /// The highest value of ZS, ns; `None`: it is 0, and the drive does not stop by itself.
    pub within_ns: Option<u64>,
    /// Motion is taken although the drive does not stop by itself.
    pub accept_none: bool,
}

/// An input that is the hardware enable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EnableInput {
    /// 1 ... 12.
    pub number: u8,
    /// The drive is enabled while the input is closed, else while it is open.
    pub closed: bool,
}

/// How a drive homes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Homing {
    /// The command.
    pub method: HomingMethod,
    /// The condition and input, as the drive counts them: 0x4CB2 is input 2, low.
    pub input: u16,
    /// Velocity, user units/s.
    pub velocity: f64,
    /// Acceleration and deceleration, user units/s².
    pub acceleration: f64,
    /// Which way, and how far at most, user units: the sign is the direction.
    pub distance: f64,
}

/// A homing command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HomingMethod {
    /// SH: to the input, ended by the limit inputs.
    Seek,
    /// FH: the drive's own homing.
    Find,
}

impl Default for Watchdog {
    /// The drive's own default: 500 ms.
    fn default() -> Watchdog {
        Watchdog { within_ns: Some(500 * MS), accept_none: false }
    }
}

impl EthernetIpPlan {
    /// A bus of these drives, with the master at the usual port of `bind`.
    pub fn new(bind: Ipv4Addr, drives: Vec<MoonsDrive>) -> EthernetIpPlan {
        EthernetIpPlan {
            name: super::PROTOCOL.into(),
            bind: SocketAddrV4::new(bind, IO_PORT),
            originator: Originator::at(bind),
            dscp: EthernetIpPlan::DSCP,
            drives,
        }
    }

    /// The usual mark of class 1 packets with the priority "scheduled" (QoS object).
    pub const DSCP: u8 = 47;
}

impl Originator {
    /// The vendor id of originators that name none.
    pub const VENDOR: u16 = 0xFB;

    /// That of a master at this address: another address is another serial number.
    pub fn at(bind: Ipv4Addr) -> Originator {
        Originator { vendor: Originator::VENDOR, serial: bind.to_bits() }
    }
}

impl MoonsDrive {
    /// The usual steps of a revolution (EG).
    pub const STEPS_PER_REVOLUTION: f64 = 20_000.0;

    /// A drive at this address with 20 000 steps a revolution, with everything else as it is when a configuration says
    /// nothing of it.
    pub fn new(name: impl Into<String>, address: Ipv4Addr) -> MoonsDrive {
        MoonsDrive {
            axis: AxisPlan::new(name, Units::revolutions(MoonsDrive::STEPS_PER_REVOLUTION)),
            steps_per_revolution: MoonsDrive::STEPS_PER_REVOLUTION,
            address: SocketAddrV4::new(address, PORT),
            expected: Expected::default(),
            connection: Access::Owner,
            cyclic: true,
            version: None,
            layout: Layout::Manual,
            delivery: Delivery::PointToPoint,
            input_rpi_ns: None,
            multiplier: None,
            fresh_within_ns: None,
            first_within_ns: S,
            configuration: None,
            heartbeat: None,
            explicit: Explicit::Unconnected,
            hold: 2,
            effect_within_ns: 200 * MS,
            watchdog: Watchdog::default(),
            enable_input: None,
            homing: None,
            homed_register: None,
            encoder: false,
            encoder_counts_per_step: 1.0,
            jog: true,
        }
    }

    /// The interval of our packets, ns, in a cycle of `period_ns`.
    pub fn rpi_ns(&self, period_ns: u64) -> u64 {
        period_ns.saturating_mul(u64::from(self.axis.divisor))
    }

    /// The interval that the drive's packets are requested with, ns.
    pub fn input_rpi_ns(&self, period_ns: u64) -> u64 {
        self.input_rpi_ns.unwrap_or(self.rpi_ns(period_ns))
    }

    /// How long one of its packets counts, ns.
    pub fn fresh_within_ns(&self, period_ns: u64) -> u64 {
        self.fresh_within_ns.unwrap_or(2 * self.input_rpi_ns(period_ns))
    }

    /// The code of the timeout multiplier: the time-out is 4 << this many intervals.
    pub fn multiplier(&self, period_ns: u64) -> u8 {
        let least_ns = USUAL_TIMEOUT_NS.max(self.loss_to_stop_ns(period_ns).saturating_add(1));
        let usual =
            || (0..MULTIPLIER_MAX).find(|code| self.shortest_timeout_ns(period_ns, *code) >= least_ns);
        self.multiplier.unwrap_or_else(|| usual().unwrap_or(MULTIPLIER_MAX))
    }

    /// After how long the drive ends a connection on which nothing comes, ns.
    pub fn timeout_ns(&self, period_ns: u64) -> u64 {
        times(self.rpi_ns(period_ns), self.multiplier(period_ns))
    }

    /// After how long the master ends a connection on which nothing comes, ns.
    pub fn input_timeout_ns(&self, period_ns: u64) -> u64 {
        times(self.input_rpi_ns(period_ns), self.multiplier(period_ns))
    }

    /// The shorter one of both with this code.
    fn shortest_timeout_ns(&self, period_ns: u64, code: u8) -> u64 {
        times(self.rpi_ns(period_ns).min(self.input_rpi_ns(period_ns)), code)
    }

    /// Whether the connection lasts until a loss has led to a stop request.
    pub fn outlives_a_loss(&self, period_ns: u64) -> bool {
        self.shortest_timeout_ns(period_ns, self.multiplier(period_ns)) > self.loss_to_stop_ns(period_ns)
    }

    /// From the last packet of the drive to the stop request on the wire, ns: its misses as the loop judges them, the
    /// next own slot, and one more where the command that the stop replaces has to go first.
    pub fn loss_to_stop_ns(&self, period_ns: u64) -> u64 {
        let slots = u64::from(self.axis.health.bucket).saturating_add(2);
        let counts_ns = self.fresh_within_ns(period_ns).div_ceil(period_ns.max(1)).saturating_mul(period_ns);
        slots.saturating_mul(self.rpi_ns(period_ns)).saturating_add(counts_ns)
    }

    /// The shortest time between two commands, ns: each is held, and then idle is. Velocities of a jog come no faster.
    pub fn command_every_ns(&self, period_ns: u64) -> u64 {
        self.rpi_ns(period_ns).saturating_mul(2 * u64::from(self.hold.max(1)))
    }

    /// The effect of a command may take so long, ns: the packet with it, the drive's next one, and as much again for
    /// one that is lost.
    pub fn least_effect_ns(&self, period_ns: u64) -> u64 {
        self.rpi_ns(period_ns).saturating_add(self.input_rpi_ns(period_ns)).saturating_mul(2)
    }

    /// Whether its outputs are this master's.
    pub fn is_owned(&self) -> bool {
        self.cyclic && self.connection == Access::Owner
    }

    /// It takes commands: its outputs are this master's, and it has some.
    pub fn takes_commands(&self) -> bool {
        self.is_owned() && self.version != Some(Version::V1)
    }

    /// Revolutions of the motor in a user unit; negative if the axis is inverted.
    pub fn revolutions_per_unit(&self) -> f64 {
        self.axis.units.counts_per_unit / self.steps_per_revolution
    }

    /// User units/s as velocities are on the wire, not rounded.
    pub fn velocity_on_wire(&self, velocity: f64) -> f64 {
        velocity * self.revolutions_per_unit() * VELOCITY_PER_REV
    }

    /// User units/s² as accelerations are on the wire, not rounded.
    pub fn acceleration_on_wire(&self, acceleration: f64) -> f64 {
        acceleration * self.revolutions_per_unit() * ACCELERATION_PER_REV
    }

    /// The additional values that it shows, in the order of `monitor`.
    pub fn shown(&self) -> [Option<MonitorChannel>; MONITOR_CHANNELS] {
        let channel = |name: &str, unit| Some(MonitorChannel { name: name.to_owned(), unit });
        let has_error = self.layout == Layout::Manual && self.version != Some(Version::V1);
        [
            channel("supply-voltage", "V"),
            channel("temperature", "°C"),
            channel("inputs", ""),
            if has_error { channel("position-error", "counts") } else { None },
        ]
    }

    /// The values of that.
    #[inline]
    #[doc(hidden)]
    pub fn monitor(inputs: &Inputs) -> [Option<f64>; MONITOR_CHANNELS] {
        [
            Some(f64::from(inputs.voltage) / 10.0),
            Some(f64::from(inputs.temperature) / 10.0),
            Some(f64::from(inputs.main_inputs)),
            inputs.position_error.map(f64::from),
        ]
    }
}

/// A time-out: so many intervals.
const fn times(rpi_ns: u64, code: u8) -> u64 {
    rpi_ns.saturating_mul(4 << code)
}

impl Access {
    /// The words in the configuration.
    pub const WORDS: [(&'static str, Access); 3] =
        [("owner", Access::Owner), ("input-only", Access::InputOnly), ("listen-only", Access::ListenOnly)];
}

#[cfg(test)]
mod tests;
