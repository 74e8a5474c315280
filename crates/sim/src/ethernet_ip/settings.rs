//! The settings of a simulated drive: its network interface, what its firmware decides, its motor and its inputs.

use std::net::{Ipv4Addr, SocketAddrV4};

use crate::FaultPlan;
use fieldbeat_core::time::{MS, S, US};
use fieldbeat_ethernet_ip::plan::Layout;

/// A simulated MOONS' drive. Where no document says what the drive does, the default is the strict side, and assumed.
#[derive(Clone, Debug, PartialEq)]
pub struct MoonsSettings {
    /// Where it listens for sessions: TCP, and UDP for discovery. Its class 1 packets use port 2222 of this host.
    pub address: SocketAddrV4,
    /// The faults between it and the master; each socket has its own.
    pub faults: FaultPlan,
    /// What it says of itself.
    pub identity: IdentitySettings,
    /// Sessions and connections.
    pub network: NetworkSettings,
    /// When its own packets come.
    pub clock: ClockSettings,
    /// What commands do.
    pub firmware: FirmwareSettings,
    /// Motor, encoder and what is wired.
    pub motor: MoonsMotorSettings,
    /// From power-on until it listens, ns. Default 500 ms.
    pub boot_ns: u64,
    /// Comes up enabled and jogging at this velocity, steps/s, as if another master had died.
    pub running: Option<f64>,
}

impl MoonsSettings {
    /// An STF of firmware 251.0, at rest, that does everything as the defaults say.
    pub fn new(address: SocketAddrV4) -> MoonsSettings {
        MoonsSettings {
            address,
            faults: FaultPlan::default(),
            identity: IdentitySettings::default(),
            network: NetworkSettings::default(),
            clock: ClockSettings::default(),
            firmware: FirmwareSettings::default(),
            motor: MoonsMotorSettings::default(),
            boot_ns: 500 * MS,
            running: None,
        }
    }
}

/// What a drive says of itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IdentitySettings {
    /// Vendor. Default 60, Applied Motion Products.
    pub vendor: u16,
    /// Device type; unknown for these drives. Default 43, a generic device.
    pub device_type: u16,
    /// Product code; unknown, too. Default 1.
    pub product: u16,
    /// Major and minor revision. Default 1.1.
    pub revision: (u8, u8),
    /// Serial number. Default: made of the address.
    pub serial: Option<u32>,
    /// Product name, up to 32 ASCII characters.
    pub name: String,
    /// Version of the Ethernet board, major and minor. Below 251 it has neither the assembly 0x65 nor 0x70.
    pub board: (u16, u16),
    /// Model and sub-model of the profile code. Default 0xB0, an STF.
    pub model: (u8, u8),
    /// Version of the drive's firmware, major and minor. Default 1.3.
    pub firmware: (u8, u8),
    /// Its letter. Default `J`.
    pub letter: u8,
    /// What kind of drive it is.
    pub kind: Kind,
}

impl IdentitySettings {
    /// The drive has the assemblies 0x65 and 0x70.
    pub fn has_outputs(&self) -> bool {
        self.board.0 >= 251
    }
}

impl Default for IdentitySettings {
    fn default() -> IdentitySettings {
        IdentitySettings {
            vendor: 60,
            device_type: 43,
            product: 1,
            revision: (1, 1),
            serial: None,
            name: "STF10-IP".into(),
            board: (251, 0),
            model: (0xB0, 0),
            firmware: (1, 3),
            letter: b'J',
            kind: Kind::Stepper,
        }
    }
}

/// What kind of drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kind {
    /// Open loop (STF): no "in position", no current command, host commands of the STF.
    #[default]
    Stepper,
    /// Step-servo (SSDC): reports "in position" and the position error, host commands of the step-servo drives.
    StepServo,
}

/// Sessions and connections.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NetworkSettings {
    /// The network's mask: the multicast group is made of it, and originators elsewhere get none. Default /24.
    pub mask: Ipv4Addr,
    /// The most sessions at a time. Default 6.
    pub sessions: usize,
    /// A TCP connection without traffic for so many s ends; 0: never. Default 120.
    pub inactivity_s: u16,
    /// The most input-only, listen-only and class 3 connections at a time. Default 3, 3 and 6.
    pub connections: (usize, usize, usize),
    /// The largest class 3 connection, bytes with its sequence number. Default 504.
    pub message_size: u16,
    /// The connection size of heartbeats. Default 2.
    pub heartbeat: u16,
    /// Which configuration data a connection needs.
    pub configuration: Configuration,
    /// The extended status for other ones. Default 0x0129, as seen of an adapter.
    pub configuration_error: ConfigurationError,
    /// The shortest interval of packets, ns. Default 1 ms.
    pub least_rpi_ns: u64,
    /// What it does with a shorter one.
    pub short_rpi: ShortRpi,
    /// Intervals are rounded up to whole ticks of so many ns. Default 1 us: as requested.
    pub tick_ns: u64,
    /// Who may own the drive after its owner has timed out.
    pub ownership: Ownership,
    /// Class 3 connections time out. False: they stay until they are closed, as the vendor's page says.
    pub messages_time_out: bool,
    /// Until the first packet a connection lives for at least so long, ns. Default 10 s.
    pub first_packet_ns: u64,
    /// The port where it takes packets is in each reply to an open, with the address 0.0.0.0. Default true.
    pub announces_port: bool,
    /// Data is new only if its sequence count is ahead of the last, which begins with 0. False: if it differs.
    pub counts_forward: bool,
}

impl Default for NetworkSettings {
    fn default() -> NetworkSettings {
        NetworkSettings {
            mask: Ipv4Addr::new(255, 255, 255, 0),
            sessions: 6,
            inactivity_s: 120,
            connections: (3, 3, 6),
            message_size: 504,
            heartbeat: 2,
            configuration: Configuration::Accepted,
            configuration_error: ConfigurationError::Invalid,
            least_rpi_ns: MS,
            short_rpi: ShortRpi::Raised,
            tick_ns: US,
            ownership: Ownership::Released,
            messages_time_out: true,
            first_packet_ns: 10 * S,
            announces_port: true,
            counts_forward: true,
        }
    }
}

/// The configuration data that an open needs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Configuration {
    /// None, or the 2 bytes of assembly 0x66.
    #[default]
    Accepted,
    /// The 2 bytes.
    Required,
    /// None.
    Refused,
}

/// The extended status for other configuration data.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ConfigurationError {
    /// 0x0129.
    #[default]
    Invalid,
    /// 0x0126 with the most words.
    Size,
    /// 0x0110.
    NotConfigured,
}

/// What a drive does with an interval that is too short.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ShortRpi {
    /// Its reply has the shortest one that it can do.
    #[default]
    Raised,
    /// 0x0111.
    Refused,
}

/// Ownership after a time-out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Ownership {
    /// Everybody may open.
    #[default]
    Released,
    /// Only the originator of before, until the drive is restarted.
    Kept,
}

/// The clock of a drive's own packets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClockSettings {
    /// Its clock is so much too slow, ppm; negative: too fast. -500 000 ... 500 000.
    pub drift_ppm: i32,
    /// Each packet leaves up to so many ns late. Less than an interval.
    pub jitter_ns: u64,
    /// Seed of that.
    pub seed: u64,
}

/// What commands do.
#[derive(Clone, Debug, PartialEq)]
pub struct FirmwareSettings {
    /// The order of the elements of assembly 0x65.
    pub layout: Layout,
    /// Of V1's two input words the extended one comes first, as in the manual's worked example. Default true.
    pub extended_first: bool,
    /// What else than a change from 0 acts.
    pub edges: Edges,
    /// What idle does.
    pub idle: Idle,
    /// ZS at the first power-up: it stops without traffic for so many ms; 0: never. Default 500.
    pub zs_ms: u16,
    /// ZA at the first power-up, 1 ... 16. Default 13: stop with AM, stay enabled.
    pub za: u8,
    /// Packets without data feed that watchdog, too. Default false.
    pub heartbeats_feed: bool,
    /// A connection of the owner that times out stops the motor, with AM. Default false: only ZS does.
    pub lost_owner_stops: bool,
    /// Moves that wait behind a running one; a further one is refused. Inferred; default 15.
    pub buffer: usize,
    /// The status while jogging has "moving", too. Default false.
    pub moving_while_jogging: bool,
    /// Homing ends with position 0. Default false: nothing documents it.
    pub homing_zeroes: bool,
    /// The Q segments, 1 ... 12, and how long each runs, ns. Default: segment 1, for a second.
    pub segments: Vec<(u8, u64)>,
    /// An alarm whose cause does not go away: it comes back at each reset and each start.
    pub persistent_alarm: u16,
    /// A fault of the firmware: once enabled it takes neither a stop nor "disable" of its owner. ZS and alarms act.
    /// Default false.
    pub ignores_stops: bool,
}

impl Default for FirmwareSettings {
    fn default() -> FirmwareSettings {
        FirmwareSettings {
            layout: Layout::Manual,
            extended_first: true,
            edges: Edges::Stops,
            idle: Idle::Ignored,
            zs_ms: 500,
            za: 13,
            heartbeats_feed: false,
            lost_owner_stops: false,
            buffer: 15,
            moving_while_jogging: false,
            homing_zeroes: false,
            segments: vec![(1, S)],
            persistent_alarm: 0,
            ignores_stops: false,
        }
    }
}

/// A command word that changes from one value to another one, neither of them 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Edges {
    /// Only the two stops act.
    #[default]
    Stops,
    /// Nothing acts.
    Strict,
    /// It acts as if 0 had come between.
    Any,
}

/// What a drive does with packets of an owner that is idle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Idle {
    /// Nothing: their data does not exist.
    #[default]
    Ignored,
    /// It stops, with AM.
    Stops,
}

/// Motor, encoder, and what is wired.
#[derive(Clone, Debug, PartialEq)]
pub struct MoonsMotorSettings {
    /// Steps of a revolution as delivered (EG), 1 ... 131 070. Default 20 000.
    pub steps: u32,
    /// Encoder counts of a step; `None`: there is no encoder.
    pub encoder: Option<f64>,
    /// Where the motor stands at first, steps.
    pub start: i32,
    /// The mechanical range between the limit switches, steps from where the position was 0 at first.
    pub limits: Option<(i32, i32)>,
    /// The home switch.
    pub home: Option<HomeSwitch>,
    /// The input that is the hardware enable; it is held until somebody opens it. `None`: it has no input.
    pub enable: Option<Wired>,
    /// Supply voltage, 0.1 V. Default 48 V.
    pub voltage: u16,
    /// Current while it turns, mA; at rest it is half of it. Default 1500.
    pub current_ma: u16,
    /// Temperature at rest, 0.1 °C. Default 30 °C; it rises with use.
    pub temperature: i16,
    /// The two analogue inputs, 0 ... 16 383.
    pub analog: (u16, u16),
    /// Inertia of everything that turns, kg m², over 0. Default 0.0002.
    pub inertia_kgm2: f64,
    /// Friction without power, N m. Default 0.1.
    pub friction_nm: f64,
}

impl Default for MoonsMotorSettings {
    fn default() -> MoonsMotorSettings {
        MoonsMotorSettings {
            steps: 20_000,
            encoder: None,
            start: 0,
            limits: None,
            home: None,
            enable: None,
            voltage: 480,
            current_ma: 1_500,
            temperature: 300,
            analog: (8_192, 8_192),
            inertia_kgm2: 2e-4,
            friction_nm: 0.1,
        }
    }
}

/// An input, and its state while what is wired to it acts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wired {
    /// 1 ... 8.
    pub input: u8,
    /// It is closed then, else open.
    pub closed: bool,
}

/// A home switch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HomeSwitch {
    /// Its input.
    pub at: Wired,
    /// It acts between these, steps from where the position was 0 at first.
    pub range: (i32, i32),
}
