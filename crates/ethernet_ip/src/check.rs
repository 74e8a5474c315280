//! What is wrong with the plan of a drive, and what `check` says of it.

use std::net::SocketAddrV4;

use super::plan::{
    Access, Delivery, EthernetIpPlan, Expected, Explicit, Homing, HomingMethod, IO_PORT, Layout,
    MOST_PER_REV, MULTIPLIER_MAX, MoonsDrive, RPI_RANGE_NS, Version, WATCHDOG_MAX_NS,
};
use super::wire::assembly::IoCode;
use super::wire::cip::DATA_MAX;
use fieldbeat_core::axis::{Faults, HeldBy, Load, MonitorChannel, PlanFault};
use fieldbeat_core::time::{Ns, S, US};

/// Of [`Expected::VENDOR`].
pub(super) const VENDOR_NAME: &str = "Applied Motion Products";

const NOTHING_STOPS: &str =
    "nothing stops the drive: a move runs to its target and a jog runs on (watchdog = \"off\")";

/// Of a drive at the address of its bus.
pub(super) const OWN_ADDRESS: &str = "is the master's own address, bind; give that of the drive";

/// The most bytes of the configuration assembly that are sent.
pub(super) const CONFIGURATION_MAX: usize = DATA_MAX;
/// The highest number of an input that a drive can have.
pub(super) const INPUT_MAX: u8 = IoCode::MAX;
/// EG is half of the steps of a revolution, in 16 bits.
pub(super) const STEPS_MAX: f64 = 2.0 * u16::MAX as f64;

impl EthernetIpPlan {
    /// The mistakes of the bus itself, as of its first drive.
    pub(super) fn own_faults(&self) -> Vec<(usize, PlanFault)> {
        let mut faults = Vec::new();
        let mut wrong = |drive, key, message: &str| faults.push((drive, PlanFault::new(key, message)));
        let ip = self.bind.ip();
        if ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast() {
            let why = "must be the master's own address on the network of the drives: packets of several \
                       buses share the port, and drives compare it with that of their session";
            wrong(0, "bind", why);
        }
        if self.dscp > 63 {
            wrong(0, "dscp", "must be at most 63; 47 is scheduled traffic");
        }
        for (index, drive) in self.drives.iter().enumerate() {
            if drive.address.ip() == ip {
                wrong(index, "address", OWN_ADDRESS);
            }
        }
        let of = |(index, drive): (usize, &MoonsDrive)| Some((index, drive.delivery_fault(self.bind)?));
        faults.extend(self.drives.iter().enumerate().filter_map(of));
        faults
    }
}

impl MoonsDrive {
    /// The contradictions, and settings that would not work with a packet every `rpi_ns`; those of every axis left out.
    pub fn faults(&self, rpi_ns: u64) -> Vec<PlanFault> {
        // The cycle's own period.
        let period_ns = rpi_ns / u64::from(self.axis.divisor.max(1));
        let mut faults = Vec::new();
        self.interval_faults(period_ns, &mut faults);
        faults.extend(self.timeout_fault(period_ns));
        self.command_faults(period_ns, &mut faults);
        self.connection_faults(&mut faults);
        self.scale_faults(&mut faults);
        faults.extend(self.range_faults());
        self.homing_faults(&mut faults);
        faults.extend(self.axis.torque_fault("the drive takes no torque setpoints"));
        let why = "has no effect: the drive makes its profiles itself, and takes no rows; leave it out";
        faults.wrong_if(self.axis.limits.step.is_some(), "limits.step", why);
        let wrong = self.enable_input.is_some_and(|input| !(1..=INPUT_MAX).contains(&input.number));
        faults.wrong_if(wrong, "enable_input", "must be an input of the drive, 1 ... 12");
        let wrong = self.homed_register.is_some_and(|register| !register.is_ascii_digit());
        faults.wrong_if(wrong, "homed_register", "must be a register of the user, \"0\" ... \"9\"");
        faults
    }

    /// Packets of a group come to one port only.
    pub(super) fn delivery_fault(&self, bind: SocketAddrV4) -> Option<PlanFault> {
        let wrong = self.delivery == Delivery::Multicast && bind.port() != IO_PORT;
        let why = "needs the port 2222 in bind: packets of a group come to no other one";
        wrong.then(|| PlanFault::new("delivery", why))
    }

    /// Intervals of packets, and how long one counts.
    fn interval_faults(&self, period_ns: u64, faults: &mut Vec<PlanFault>) {
        let (rpi, input_rpi) = (self.rpi_ns(period_ns), self.input_rpi_ns(period_ns));
        let (least, most) = RPI_RANGE_NS;
        let why = |ns: u64| match ns {
            _ if !(least..=most).contains(&ns) => Some(format!("must be {} ... {}", Ns(least), Ns(most))),
            _ => (!ns.is_multiple_of(US)).then(|| "must be in whole microseconds".to_owned()),
        };
        if let Some(why) = why(rpi) {
            let made = format!("makes a packet every {} (period x divisor)", Ns(rpi));
            faults.wrong("divisor", format_args!("{made}, which {why}; change it or the period"));
        } else if let Some(why) = self.input_rpi_ns.and_then(why) {
            let own = Ns(rpi);
            faults.wrong("input_rpi", format_args!("{why}; leave it out for that of the master, {own}"));
        } else if self.fresh_within_ns(period_ns) < input_rpi {
            let what = format!("is shorter than the interval of the drive's packets, {}", Ns(input_rpi));
            let why = "each would be too old before the next one comes; allow two of them";
            faults.wrong("fresh_within", format_args!("{what}: {why}"));
        }
        let why = format!("must be {} ... 60 s: the first packet takes an interval", Ns(input_rpi));
        let within = self.first_within_ns;
        faults.wrong_if(within < input_rpi || within > 60 * S, "first_within", why);
    }

    /// A connection that ends before a loss has led to a stop would take the stop with it.
    fn timeout_fault(&self, period_ns: u64) -> Option<PlanFault> {
        let code = self.multiplier(period_ns);
        if code > MULTIPLIER_MAX {
            return Some(PlanFault::new("timeout_multiplier", "must be 4, 8, 16, 32, 64, 128, 256 or 512"));
        }
        if self.outlives_a_loss(period_ns) {
            return None;
        }
        let (ours, theirs) = (self.timeout_ns(period_ns), self.input_timeout_ns(period_ns));
        let better =
            |code: &u8| MoonsDrive { multiplier: Some(*code), ..self.clone() }.outlives_a_loss(period_ns);
        let none = "lower health.bucket or fresh_within, or bring input_rpi and the master's interval closer";
        let found = (0..=MULTIPLIER_MAX).find(better).map(|code| format!("use {} or more", 4_u32 << code));
        let remedy = found.unwrap_or(none.to_owned());
        let why = format!(
            "ends the connection after {}, before the stop request that follows a loss within {}; {remedy}",
            Ns(ours.min(theirs)),
            Ns(self.loss_to_stop_ns(period_ns)),
        );
        Some(PlanFault::new("timeout_multiplier", why))
    }

    /// How commands are held, and what the drive's own watchdog allows.
    fn command_faults(&self, period_ns: u64, faults: &mut Vec<PlanFault>) {
        let why = "must be 1 ... 100 packets; 2 survive the loss of one";
        faults.wrong_if(!(1..=100).contains(&self.hold), "hold", why);
        let seen_ns = self.least_effect_ns(period_ns);
        let what = "twice the intervals of the packets in both directions";
        let wrong = self.effect_within_ns < seen_ns || self.effect_within_ns > 10 * S;
        faults.wrong_if(wrong, "effect_within", format_args!("must be {} ... 10 s: {what}", Ns(seen_ns)));
        let (within, least) = (self.watchdog.within_ns, self.rpi_ns(period_ns).saturating_mul(2));
        let why = "must be \"accept\" with watchdog = \"off\": nothing stops the drive if the master dies; \
                   or set ZS of the drive, and watchdog to that";
        let unwatched = within.is_none() && self.takes_commands() && !self.watchdog.accept_none;
        faults.wrong_if(unwatched, "no_drive_watchdog", why);
        let wrong = within.is_some_and(|within| !(least..=WATCHDOG_MAX_NS).contains(&within));
        let (least, most) = (Ns(least), Ns(WATCHDOG_MAX_NS));
        let why = format!("must be {least} ... {most}: the drive's ZS has to outlast a lost packet");
        faults.wrong_if(wrong, "watchdog", why);
    }

    /// The mistakes by the kind of the connection.
    fn connection_faults(&self, faults: &mut Vec<PlanFault>) {
        if !self.cyclic {
            return;
        }
        let is_first = self.version == Some(Version::V1);
        let why = "must be \"input-only\": a drive of version \"v1\" has no output assembly";
        faults.wrong_if(is_first && self.is_owned(), "connection", why);
        let why = "concerns input assembly 0x65, which version \"v1\" has not; leave it out";
        faults.wrong_if(is_first && self.layout == Layout::Page, "layout", why);
        let wrong = self.connection == Access::ListenOnly && self.delivery != Delivery::Multicast;
        let why = "must be \"multicast\": who listens only gets the packets of another connection";
        faults.wrong_if(wrong, "delivery", why);
        let why = "is for connections without outputs; leave it out, or set connection = \"input-only\"";
        faults.wrong_if(self.is_owned() && self.heartbeat.is_some(), "heartbeat", why);
        let wrong = self.heartbeat.is_some_and(|size| !matches!(size, 0 | 2 | 6));
        faults.wrong_if(wrong, "heartbeat", "must be 2, 6 or 0 bytes");
        let wrong = self.configuration.as_ref().is_some_and(|bytes| bytes.len() > CONFIGURATION_MAX);
        faults.wrong_if(wrong, "configuration", "must be at most 256 bytes");
        let mute = !self.takes_commands();
        let why = "needs outputs: connection = \"owner\", and a drive of version \"v2\"";
        faults.wrong_if(mute && self.homing.is_some(), "homing", why);
        let why = "concerns commands, and this connection has none; leave it out";
        faults.wrong_if(mute && self.enable_input.is_some(), "enable_input", why);
    }

    fn scale_faults(&self, faults: &mut Vec<PlanFault>) {
        let wrong = !(1.0..=STEPS_MAX).contains(&self.steps_per_revolution);
        faults.wrong_if(wrong, "steps_per_rev", format_args!("must be 1 ... {STEPS_MAX}, as EG sets it"));
        let encoder = self.encoder_counts_per_step;
        let why = "must be true, false or its counts of a revolution, above 0";
        faults.wrong_if(!(encoder > 0.0 && encoder.is_finite()), "encoder", why);
    }

    /// Velocities and accelerations are 16 bits of small units on the wire.
    fn range_faults(&self) -> Vec<PlanFault> {
        let axis = &self.axis;
        let (profile, limits, homing) = (&axis.profile, &axis.limits, self.homing.as_ref());
        let (velocity, acceleration) =
            (self.velocity_on_wire(1.0).abs(), self.acceleration_on_wire(1.0).abs());
        if !(velocity > 0.0 && velocity.is_finite() && acceleration.is_finite()) {
            return Vec::new(); // Reported for every axis, or above.
        }
        let values = [
            ("profile.velocity", Some(profile.velocity), velocity, "s"),
            ("limits.velocity", limits.velocity, velocity, "s"),
            ("homing.velocity", homing.map(|homing| homing.velocity), velocity, "s"),
            ("profile.acceleration", Some(profile.acceleration), acceleration, "s²"),
            ("profile.deceleration", Some(profile.deceleration), acceleration, "s²"),
            ("limits.acceleration", limits.acceleration, acceleration, "s²"),
            ("stop.deceleration", Some(axis.stop.deceleration), acceleration, "s²"),
            ("homing.acceleration", homing.map(|homing| homing.acceleration), acceleration, "s²"),
        ];
        let values = values.into_iter().filter_map(|(key, value, on_wire, per)| {
            Some((key, value?, [1.0 / on_wire, MOST_PER_REV / on_wire], per))
        });
        let shown = |[least, most]: [f64; 2]| [inside(least, f64::ceil), inside(most, f64::floor)];
        axis.range_faults(values, shown, "change it or check scale and steps_per_rev")
    }

    fn homing_faults(&self, faults: &mut Vec<PlanFault>) {
        let Some(homing) = &self.homing else { return };
        let wrong = IoCode::from_code(homing.input).is_none();
        faults.wrong_if(wrong, "homing.input", "must be an input with its condition, like \"2L\"");
        let (distance, unit) = (homing.distance, self.axis.units.unit);
        let most = inside(f64::from(i32::MAX) / self.axis.units.counts_per_unit.abs(), f64::floor);
        let why = format!(
            "{distance} is no distance of the drive; use up to {most} {unit}, its sign is the direction"
        );
        let counts = (distance * self.axis.units.counts_per_unit).abs();
        faults.wrong_if(!(1.0..=f64::from(i32::MAX)).contains(&counts), "homing.distance", why);
        let most = self.axis.limits.homing_velocity();
        if let Some(most) = most.filter(|most| homing.velocity > *most) {
            let remedy = "lower it, or raise limits.homing";
            let why = format!("exceeds the limit while it homes, {most}; {remedy}");
            faults.wrong("homing.velocity", why);
        }
    }

    /// The drive stops by itself within this time, ns; `None`: it does not, or it is not known.
    pub(super) fn stops_within_ns(&self) -> Option<u64> {
        self.watchdog.within_ns.filter(|_| self.takes_commands())
    }

    /// The lines of `check` beyond its axis; the first line is its address.
    pub fn describe(&self, bind: SocketAddrV4, period_ns: u64) -> String {
        let motion = match self.takes_commands() {
            true => format!("{}\n{}", self.describe_motion(), self.describe_commands(period_ns)),
            false => {
                format!("no motion: {}; its values are shown, and calls are taken", self.why_no_commands())
            }
        };
        let explicit = match self.explicit {
            Explicit::Unconnected => "unconnected",
            Explicit::Connected => "on a class 3 connection",
        };
        let lines = [
            format!("{bind} -> {}", self.address),
            self.expected.describe(),
            self.describe_connection(),
            self.describe_intervals(period_ns),
            motion,
            format!("shows {}", MonitorChannel::names(self.shown()).unwrap_or_default()),
            format!("explicit messages go {explicit}, one at a time"),
            format!("if the master dies: {}", self.describe_death()),
        ];
        lines.join("\n")
    }

    fn describe_connection(&self) -> String {
        let version = match self.version {
            Some(Version::V1) => "input assembly 0x64 (version \"v1\")",
            Some(Version::V2) => "input assembly 0x65 (version \"v2\")",
            None => "the input assembly that its firmware has (0x65, or 0x64 of \"v1\")",
        };
        let layout = match self.layout {
            _ if self.version == Some(Version::V1) => "",
            Layout::Manual => " in the order of the manual",
            Layout::Page => " in the order of the vendor's page",
        };
        let kind = match self.connection {
            Access::Owner => "owns its outputs (0x70): another owner is refused, or refuses this one",
            Access::InputOnly => "input only: no outputs",
            Access::ListenOnly => {
                "listen only: no outputs, and nothing without another connection of the drive"
            }
        };
        format!("{kind}; {version}{layout}")
    }

    fn describe_intervals(&self, period_ns: u64) -> String {
        let how = match self.delivery {
            Delivery::PointToPoint => "to this master only",
            Delivery::Multicast => "to a group",
        };
        format!(
            "a packet to it every {}, times out after {}; one from it every {} ({how}), times out after {} \
             (timeout_multiplier = {}); the first one within {}",
            Ns(self.rpi_ns(period_ns)),
            Ns(self.timeout_ns(period_ns)),
            Ns(self.input_rpi_ns(period_ns)),
            Ns(self.input_timeout_ns(period_ns)),
            4_u32 << self.multiplier(period_ns),
            Ns(self.first_within_ns),
        )
    }

    fn describe_motion(&self) -> String {
        let jogs = if self.jog { "jogs and velocities" } else { "no jogs and velocities (jog = false)" };
        let homing = match &self.homing {
            Some(Homing { method: HomingMethod::Seek, .. }) => "homing to an input (SH)",
            Some(Homing { method: HomingMethod::Find, .. }) => "its own homing (FH)",
            None => "no homing (no `homing`)",
        };
        format!("takes moves, {jogs}, {homing}; no streams and torques: it makes its profiles itself")
    }

    fn describe_commands(&self, period_ns: u64) -> String {
        let rpi = self.rpi_ns(period_ns);
        format!(
            "a command is held for {} and until its effect is seen, within {} (effect_within; an absolute move \
             and a jog are sent up to four times), then idle for as long: two commands, and two velocities, \
             are {} apart at least; a stop replaces one under way, and waits {} at most for that",
            packets(self.hold),
            Ns(self.effect_within_ns),
            Ns(self.command_every_ns(period_ns)),
            Ns(rpi),
        )
    }

    fn why_no_commands(&self) -> &'static str {
        match self.connection {
            Access::InputOnly => "the connection is \"input-only\"",
            Access::ListenOnly => "the connection is \"listen-only\"",
            Access::Owner => "a drive of version \"v1\" has no output assembly",
        }
    }

    fn describe_death(&self) -> String {
        if !self.takes_commands() {
            return "nothing of this master moves the drive".to_owned();
        }
        let Some(within_ns) = self.watchdog.within_ns else {
            return NOTHING_STOPS.to_owned();
        };
        let held = match self.axis.load {
            Load::Vertical(HeldBy::Drive) => {
                "; ZA must leave it enabled, 13 or 14, since only the drive holds its load"
            }
            _ => "",
        };
        format!(
            "the drive begins to stop within {} by its own watchdog (ZS, ZA), taken on trust: no message of \
             the manual reads them{held}",
            Ns(within_ns)
        )
    }
}

impl Expected {
    /// By what a drive is known.
    fn describe(&self) -> String {
        let Expected { vendor, product, serial } = *self;
        let kind = match (vendor, product) {
            (None, None) => {
                "any device that answers there is commanded (vendor = \"any\"): no electronic key".to_owned()
            }
            _ => {
                let vendor = match vendor {
                    Some(Expected::VENDOR) => format!("vendor {} ({VENDOR_NAME})", Expected::VENDOR),
                    Some(other) => format!("vendor {other}"),
                    None => "any vendor".to_owned(),
                };
                let product = product.map_or("any product".into(), |product| format!("product {product}"));
                format!("has to be {vendor}, {product}: the electronic key of each opening")
            }
        };
        match serial {
            Some(serial) => format!("{kind}; known by its serial number {serial:#010x}"),
            None => format!(
                "{kind}; known by its address only: an equal drive there is taken for it (serial; fieldbeat \
                 pin)"
            ),
        }
    }
}

/// The end of a range with four digits, `rounded` into the range.
fn inside(end: f64, rounded: fn(f64) -> f64) -> f64 {
    // Whole powers of ten, so that the digits of the result are short.
    let places = 3 - end.abs().log10().floor() as i32;
    let (up, down) = (10_f64.powi(places.max(0)), 10_f64.powi((-places).max(0)));
    rounded(end * up / down) * down / up
}

fn packets(number: u8) -> String {
    format!("{number} packet{}", if number == 1 { "" } else { "s" })
}
