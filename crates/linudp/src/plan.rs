//! A LinUDP bus as configured and checked.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::Duration;

use super::motion::StreamCommand;
use super::upid::Upid;
use fieldbeat_core::axis::{AxisPlan, Faults, MonitorChannel, PlanFault, Units};
use fieldbeat_core::bus::MOST_EARLIER;
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::time::{Ns, nanos};

/// The master's port, source and destination of everything (manual, 4.3).
pub const MASTER_PORT: u16 = 41136;
/// The drives' port (manual, 4.3).
pub const DRIVE_PORT: u16 = 49360;

/// Positions on the wire are 0.1 um (SG5 manual, units of the motion command interface).
pub const COUNTS_PER_MM: f64 = 10_000.0;

/// One master socket and its drives.
#[derive(Clone, Debug, PartialEq)]
pub struct LinUdpPlan {
    /// The name in messages.
    pub name: String,
    /// Where the master listens and sends from.
    pub bind: SocketAddrV4,
    /// The drives; one address each.
    pub drives: Vec<LinUdpDrive>,
}

/// One LinMot drive.
#[derive(Clone, Debug, PartialEq)]
pub struct LinUdpDrive {
    /// The settings of every protocol's axis. Counts are 0.1 um: 10 000 a millimetre.
    pub axis: AxisPlan,
    /// Where the drive listens.
    pub address: SocketAddrV4,
    /// Which drive it has to be; `None`: whatever answers there is taken.
    pub serial: Option<Serial>,
    /// The streaming command that Follow uses; `None`: Follow is refused.
    pub stream: Option<StreamCommand>,
    /// The variables of the four monitoring channels, if they are requested.
    pub monitor: MonitorPlan,
    /// By what a reply shows which request it answers.
    pub reply_tag: ReplyTag,
    /// For how many cycles a reply counts, that of its request included, while requests go on; `None`: for two if
    /// replies have a tag, else for one.
    pub reply_within: Option<u32>,
    /// How long the drive has to report that its power stage may not come on, although the master allows it, until its
    /// hardware enable (STO) counts as missing: its status may be some milliseconds older than the control word.
    pub sto_after: Duration,
    /// How far a jog runs ahead at most, user units. A LinUDP drive has no watchdog, so a jog is a target that rolls
    /// ahead of the axis; if the master dies the axis runs this far. `None`: jogs are refused (`no_drive_watchdog`).
    pub leash: Option<f64>,
}

impl LinUdpPlan {
    /// A bus of these drives, with the master on the usual port of `bind`.
    pub fn new(bind: Ipv4Addr, drives: Vec<LinUdpDrive>) -> LinUdpPlan {
        let bind = SocketAddrV4::new(bind, MASTER_PORT);
        LinUdpPlan { name: "linudp-v2".into(), bind, drives }
    }

    /// This bus in another machine. A drive is due so rarely that it takes its stream, or has none.
    pub(super) fn variant(&self, wanted: &Variant) -> Option<LinUdpPlan> {
        let mut plan = self.clone();
        plan.bind.set_ip(wanted.address(*plan.bind.ip()));
        plan.drives = wanted.hosts(&self.drives, |drive| (&mut drive.axis, &mut drive.address));
        for drive in &mut plan.drives {
            let least_ns = drive.stream.map_or(0, |stream| stream.period_range_ns().0);
            wanted.schedule(&mut drive.axis, least_ns);
            let every_ns = wanted.every_ns(&drive.axis);
            drive.stream = drive.stream.filter(|stream| stream.takes(every_ns));
        }
        Some(plan)
    }
}

impl LinUdpDrive {
    /// The usual cycles in which a reply counts that has a tag.
    const REPLY_WITHIN: u32 = 2;

    /// For how many cycles a reply counts.
    pub fn replies_within(&self) -> u32 {
        self.reply_within.unwrap_or(LinUdpDrive::REPLY_WITHIN).clamp(1, self.most_replies_within())
    }

    /// The most cycles in which no two open exchanges look alike, and one that is over looks like none of them.
    fn most_replies_within(&self) -> u32 {
        match (self.reply_tag, self.monitor) {
            (ReplyTag::Off, _) => 1,
            (ReplyTag::Definition, MonitorPlan::AsSet | MonitorPlan::Sources(_)) => 3,
            (ReplyTag::Definition, MonitorPlan::Off) | (ReplyTag::Count, _) => MOST_EARLIER as u32 + 1,
        }
    }

    /// The usual `sto_after`: a status is up to 2 ms old (sheet, 3.5).
    pub const STO_AFTER: Duration = Duration::from_millis(10);

    /// A drive at this address, in millimetres, with everything else as it is when a configuration says nothing of it.
    pub fn new(name: impl Into<String>, address: Ipv4Addr) -> LinUdpDrive {
        LinUdpDrive {
            axis: AxisPlan::new(name, Units::millimetres(COUNTS_PER_MM)),
            address: SocketAddrV4::new(address, DRIVE_PORT),
            serial: None,
            stream: Some(StreamCommand::Pva),
            monitor: MonitorPlan::Off,
            reply_tag: ReplyTag::default(),
            reply_within: None,
            sto_after: LinUdpDrive::STO_AFTER,
            leash: None,
        }
    }
}

/// The serial number of a drive, or any number by which it is known from others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Serial {
    /// The parameter of 32 bits that has it: no public document names one.
    pub from: Upid,
    /// The number; `None`: any.
    pub number: Option<u32>,
}

/// By what a reply shows which request it answers: LinUDP has no sequence number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ReplyTag {
    /// Each request names other blocks than the one before it, and the reply echoes its definition: error
    /// code, warn word and monitoring channels come in turn, in eight combinations; monitoring channels that are shown
    /// come in each reply, and there are four.
    #[default]
    Definition,
    /// A real-time-config no-operation with a new count in each request, which the reply echoes: fourteen values, eight
    /// bytes more in both directions.
    Count,
    /// Nothing: all requests name the same blocks. After a missed exchange the next reply is suspect.
    Off,
}

impl ReplyTag {
    /// The words in the configuration.
    pub const WORDS: [(&'static str, ReplyTag); 3] =
        [("definition", ReplyTag::Definition), ("count", ReplyTag::Count), ("off", ReplyTag::Off)];
}

/// The variables of the four monitoring channels of a drive (LinUDP V2 manual, 4.4.9).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MonitorPlan {
    /// They are not requested.
    #[default]
    Off,
    /// Whatever is set in the drive, as raw numbers.
    AsSet,
    /// These variables: the drive is set so (in RAM only) whenever it comes online.
    Sources([Option<Upid>; 4]),
}

impl MonitorPlan {
    /// The variables to set in the drive.
    pub fn sources(self) -> [Option<Upid>; 4] {
        match self {
            MonitorPlan::Sources(sources) => sources,
            MonitorPlan::Off | MonitorPlan::AsSet => [None; 4],
        }
    }

    /// The name of a variable that two of the channels would show.
    fn shown_twice(self) -> Option<String> {
        let mut names: Vec<String> =
            self.channels().into_iter().flatten().map(|channel| channel.name).collect();
        names.sort_unstable();
        names.windows(2).find(|pair| pair[0] == pair[1]).map(|pair| pair[0].clone())
    }

    /// Names and units of the channels, for people.
    pub fn channels(self) -> [Option<MonitorChannel>; 4] {
        let of = |source: Upid| match source.known() {
            Some(known) => MonitorChannel { name: known.name.to_owned(), unit: known.quantity.unit },
            None => MonitorChannel { name: source.to_string(), unit: "" },
        };
        match self {
            MonitorPlan::Off => [const { None }; 4],
            MonitorPlan::AsSet => std::array::from_fn(|channel| {
                Some(MonitorChannel { name: format!("channel-{}", channel + 1), unit: "" })
            }),
            MonitorPlan::Sources(sources) => sources.map(|source| source.map(of)),
        }
    }
}

impl LinUdpDrive {
    /// The contradictions, and settings that would not work with an exchange every `period_ns`; those of every axis
    /// left out.
    pub fn faults(&self, period_ns: u64) -> Vec<PlanFault> {
        let mut faults = self.wire_faults();
        faults.extend(self.stream.and_then(|command| self.stream_fault(command, period_ns)));
        if let Some(name) = self.monitor.shown_twice() {
            faults.wrong("monitor", format_args!("has {name} twice; list each variable once"));
        }
        let most = self.most_replies_within();
        if self.reply_within.is_some_and(|within| !(1..=most).contains(&within)) {
            let range = if most == 1 { "1".to_owned() } else { format!("1 ... {most}") };
            let tag = match (self.reply_tag, self.monitor) {
                (ReplyTag::Off, _) => "replies have no tag (reply_tag = \"off\")",
                (_, MonitorPlan::Off) | (ReplyTag::Count, _) => "later replies could look like newer ones",
                _ => "with monitor only four replies in a row differ, unless reply_tag = \"count\"",
            };
            faults.wrong("reply_within", format_args!("must be {range}: {tag}"));
        }
        faults.extend(self.axis.torque_fault("a LinUDP drive takes no torque setpoints"));
        let why = "must be shorter than enable_timeout, or no Enable would report a missing hardware enable";
        faults.wrong_if(self.sto_after >= self.axis.enable_timeout, "sto_after", why);
        let (unit, range) = (self.axis.units.unit, self.axis.limits.position.map(|(low, high)| high - low));
        match (self.leash, range) {
            (Some(leash), _) if !(leash > 0.0 && leash.is_finite()) => {
                faults.wrong("leash", "must be above 0")
            }
            (Some(leash), Some(range)) if leash > range => {
                let far = "a jog runs that far if the master dies";
                faults.wrong("leash", format_args!("is longer than the range of {range} {unit}; {far}"));
            }
            _ => {}
        }
        faults
    }

    /// Speed goes over the wire in 1 um/s = 10 counts/s and acceleration in 10 um/s² = 100 counts/s² (manual, 4.2): a
    /// value must be at least one of them, and fit into the signed 32 bits of the streaming commands.
    fn wire_faults(&self) -> Vec<PlanFault> {
        let profile = &self.axis.profile;
        let scale = self.axis.units.counts_per_unit.abs();
        if scale == 0.0 || !scale.is_finite() {
            return Vec::new(); // Reported for every axis.
        }
        let range = |counts: f64| [counts / scale, counts / scale * f64::from(i32::MAX)];
        let values = [
            ("profile.velocity", profile.velocity, range(10.0), "s"),
            ("profile.acceleration", profile.acceleration, range(100.0), "s²"),
            ("profile.deceleration", profile.deceleration, range(100.0), "s²"),
            ("stop.deceleration", self.axis.stop.deceleration, range(100.0), "s²"),
        ];
        self.axis.range_faults(values, |ends| ends, "change it or check scale")
    }

    fn stream_fault(&self, command: StreamCommand, period_ns: u64) -> Option<PlanFault> {
        if command.takes(period_ns) {
            return None;
        }
        let fitting: Vec<String> = StreamCommand::ALL
            .iter()
            .filter(|other| other.takes(period_ns))
            .map(|other| format!("\"{}\"", other.name()))
            .collect();
        let remedy = match fitting.is_empty() {
            true => "no streaming command fits, use \"off\" or another period".to_owned(),
            false => format!("use {} or \"off\"", fitting.join(", ")),
        };
        let (low, high) = command.period_range_ns();
        let why = format!(
            "needs a setpoint every {} ... {}, and this drive gets one every {} (period x divisor {}); \
             {remedy}",
            Ns(low),
            Ns(high),
            Ns(period_ns),
            self.axis.divisor
        );
        Some(PlanFault::new("stream", why))
    }

    /// The lines of `check` beyond its axis; the first line is its address.
    pub fn describe(&self, bind: SocketAddrV4, period_ns: u64) -> String {
        let unit = self.axis.units.unit;
        let setpoints = Ns(period_ns.saturating_mul(self.axis.divisor.into()));
        let mut lines = vec![format!("{bind} -> {}", self.address)];
        lines.push(match self.serial {
            Some(Serial { from, number: Some(number) }) => {
                format!("known by its serial number {number} ({from}, read before anything is written)")
            }
            _ => "known by its address only: an equal drive there is taken for it (serial and serial_from)"
                .to_owned(),
        });
        lines.push(match self.stream {
            Some(command) => {
                let (shortest, longest) = command.period_range_ns();
                format!(
                    "streams \"{}\", a setpoint every {setpoints} (the drive takes {} ... {})",
                    command.name(),
                    Ns(shortest),
                    Ns(longest)
                )
            }
            None if StreamCommand::ALL.iter().any(|command| command.takes(setpoints.0)) => {
                "no streams (stream = \"off\")".to_owned()
            }
            None => format!("no streams: no streaming command takes a setpoint every {setpoints}"),
        });
        lines.extend(match self.monitor {
            MonitorPlan::AsSet => Some("shows its monitoring channels as the drive has them set".to_owned()),
            _ => MonitorChannel::names(self.monitor.channels()).map(|names| {
                format!("shows {names}: the master sets this, in RAM, whenever the drive comes online")
            }),
        });
        lines.push(match self.replies_within() {
            1 => "a reply counts in the cycle of its request only".to_owned(),
            2 => "a reply counts in the cycle of its request and in the next one (reply_within)".to_owned(),
            within => format!(
                "a reply counts in the cycle of its request and in the next {} (reply_within)",
                within - 1
            ),
        });
        lines.push(format!(
            "a late reply is recognised by {}; a hardware enable (STO) counts as missing after {}",
            match (self.reply_tag, self.monitor) {
                (ReplyTag::Definition, MonitorPlan::Off) => "its response definition, one of eight in turn",
                (ReplyTag::Definition, _) => "its response definition, one of four in turn",
                (ReplyTag::Count, _) => "its count, one of fourteen in turn",
                (ReplyTag::Off, _) => "a missed exchange before it only",
            },
            Ns(nanos(self.sto_after))
        ));
        let jog = match self.leash {
            Some(leash) => format!("a jog or cyclic velocity runs at most {leash} {unit} further"),
            None => "jogs and cyclic velocities are refused".to_owned(),
        };
        let stream = match self.stream {
            Some(_) => ", a stream ends in the drive's own underflow error",
            None => "",
        };
        lines.push(format!(
            "if the master dies: a LinUDP drive has no watchdog, a move runs to its target, {jog}{stream}"
        ));
        lines.join("\n")
    }
}
