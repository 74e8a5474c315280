//! What is wrong with the plan of a drive, and what `check` says of it.

use std::net::SocketAddrV4;

use super::plan::{
    Access, Delivery, EthernetIpPlan, Expected, Explicit, Homing, HomingMethod, IO_PORT, Layout,
    MOST_PER_REV, MULTIPLIER_MAX, MoonsDrive, RPI_RANGE_NS, Version, WATCHDOG_MAX_NS,
};
use super::wire::assembly::IoCode;
use super::wire::cip::DATA_MAX;
use fieldbeat_core::axis::{HeldBy, Load, PlanFault};
use fieldbeat_core::time::{Ns, S, US};

/// Of [`Expected::VENDOR`].
pub(super) const VENDOR_NAME: &str = "Applied Motion Products";

const NOTHING_STOPS: &str =
    "nothing stops the drive: a move runs to its target and a jog runs on (watchdog = \"off\")";

/// The most bytes of the configuration assembly that are sent.
pub(super) const CONFIGURATION_MAX: usize = DATA_MAX;
/// The highest number of an input that a drive can have.
pub(super) const INPUT_MAX: u8 = IoCode::MAX;
/// EG is half of the steps of a revolution, in 16 bits.
pub(super) const STEPS_MAX: f64 = 2.0 * u16::MAX as f64;

impl EthernetIpPlan {
    /// What is wrong with the bus itself, as of its first drive.
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
                wrong(index, "address", "is the master's own address, bind; give that of the drive");
            }
        }
        let of = |(index, drive): (usize, &MoonsDrive)| Some((index, drive.delivery_fault(self.bind)?));
        faults.extend(self.drives.iter().enumerate().filter_map(of));
        faults
    }
}

impl MoonsDrive {
    /// What contradicts itself, or would not work with a packet every `rpi_ns`; what every axis has left out.
    pub fn faults(&self, rpi_ns: u64) -> Vec<PlanFault> {
        // The cycle's own period.
        let period_ns = rpi_ns / u64::from(self.axis.divisor.max(1));
        let mut faults = Vec::new();
        self.interval_faults(period_ns, &mut faults);
        faults.extend(self.timeout_fault(period_ns));
        self.command_faults(period_ns, &mut faults);
        self.connection_faults(&mut faults);
        self.scale_faults(&mut faults);
        self.range_faults(&mut faults);
        self.homing_faults(&mut faults);
        let mut wrong = |key, message: &str| faults.push(PlanFault::new(key, message));
        if self.axis.limits.torque.is_some() {
            wrong("limits.torque", "has no effect: the drive takes no torque setpoints; leave it out");
        }
        if self.axis.limits.step.is_some() {
            let why = "has no effect: the drive makes its profiles itself, and takes no rows; leave it out";
            wrong("limits.step", why);
        }
        if self.enable_input.is_some_and(|input| !(1..=INPUT_MAX).contains(&input.number)) {
            wrong("enable_input", "must be an input of the drive, 1 ... 12");
        }
        if self.homed_register.is_some_and(|register| !register.is_ascii_digit()) {
            wrong("homed_register", "must be a register of the user, \"0\" ... \"9\"");
        }
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
        let mut wrong = |key, message| faults.push(PlanFault::new(key, message));
        let why = |ns: u64| match ns {
            _ if !(least..=most).contains(&ns) => Some(format!("must be {} ... {}", Ns(least), Ns(most))),
            _ => (!ns.is_multiple_of(US)).then(|| "must be in whole microseconds".to_owned()),
        };
        if let Some(why) = why(rpi) {
            let made = format!("makes a packet every {} (period x divisor)", Ns(rpi));
            wrong("divisor", format!("{made}, which {why}; change it or the period"));
        } else if let Some(why) = self.input_rpi_ns.and_then(why) {
            wrong("input_rpi", format!("{why}; leave it out for that of the master, {}", Ns(rpi)));
        } else if self.fresh_within_ns(period_ns) < input_rpi {
            let what = format!("is shorter than the interval of the drive's packets, {}", Ns(input_rpi));
            let why = "each would be too old before the next one comes; allow two of them";
            wrong("fresh_within", format!("{what}: {why}"));
        }
        if self.first_within_ns < input_rpi || self.first_within_ns > 60 * S {
            let least = Ns(input_rpi);
            wrong("first_within", format!("must be {least} ... 60 s: the first packet takes an interval"));
        }
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
        let rpi = self.rpi_ns(period_ns);
        let mut wrong = |key, message| faults.push(PlanFault::new(key, message));
        if !(1..=100).contains(&self.hold) {
            wrong("hold", "must be 1 ... 100 packets; 2 survive the loss of one".to_owned());
        }
        let seen_ns = self.least_effect_ns(period_ns);
        if self.effect_within_ns < seen_ns || self.effect_within_ns > 10 * S {
            let why = "twice the intervals of the packets in both directions";
            wrong("effect_within", format!("must be {} ... 10 s: {why}", Ns(seen_ns)));
        }
        let (within, least) = (self.watchdog.within_ns, rpi.saturating_mul(2));
        if within.is_none() && self.takes_commands() && !self.watchdog.accept_none {
            let why = "must be \"accept\" with watchdog = \"off\": nothing stops the drive if the master \
                       dies; or set ZS of the drive, and watchdog to that";
            wrong("no_drive_watchdog", why.to_owned());
        }
        if within.is_some_and(|within| !(least..=WATCHDOG_MAX_NS).contains(&within)) {
            let (least, most) = (Ns(least), Ns(WATCHDOG_MAX_NS));
            wrong(
                "watchdog",
                format!("must be {least} ... {most}: the drive's ZS has to outlast a lost packet"),
            );
        }
    }

    /// What the kind of the connection rules out.
    fn connection_faults(&self, faults: &mut Vec<PlanFault>) {
        if !self.cyclic {
            return;
        }
        let mut wrong = |key, message: &str| faults.push(PlanFault::new(key, message));
        let is_first = self.version == Some(Version::V1);
        if is_first && self.is_owned() {
            wrong("connection", "must be \"input-only\": a drive of version \"v1\" has no output assembly");
        }
        if is_first && self.layout == Layout::Page {
            wrong("layout", "concerns input assembly 0x65, which version \"v1\" has not; leave it out");
        }
        if self.connection == Access::ListenOnly && self.delivery != Delivery::Multicast {
            let why = "must be \"multicast\": who listens only gets the packets of another connection";
            wrong("delivery", why);
        }
        if self.is_owned() && self.heartbeat.is_some() {
            let why = "is for connections without outputs; leave it out, or set connection = \"input-only\"";
            wrong("heartbeat", why);
        }
        if self.heartbeat.is_some_and(|size| !matches!(size, 0 | 2 | 6)) {
            wrong("heartbeat", "must be 2, 6 or 0 bytes");
        }
        if self.configuration.as_ref().is_some_and(|bytes| bytes.len() > CONFIGURATION_MAX) {
            wrong("configuration", "must be at most 256 bytes");
        }
        if !self.takes_commands() && self.homing.is_some() {
            wrong("homing", "needs outputs: connection = \"owner\", and a drive of version \"v2\"");
        }
        if !self.takes_commands() && self.enable_input.is_some() {
            wrong("enable_input", "concerns commands, and this connection has none; leave it out");
        }
    }

    fn scale_faults(&self, faults: &mut Vec<PlanFault>) {
        let steps = self.steps_per_revolution;
        if !(1.0..=STEPS_MAX).contains(&steps) {
            faults.push(PlanFault::new("steps_per_rev", format!("must be 1 ... {STEPS_MAX}, as EG sets it")));
        }
        let encoder = self.encoder_counts_per_step;
        if !(encoder > 0.0 && encoder.is_finite()) {
            let why = "must be true, false or its counts of a revolution, above 0";
            faults.push(PlanFault::new("encoder", why));
        }
    }

    /// Velocities and accelerations are 16 bits of small units on the wire.
    fn range_faults(&self, faults: &mut Vec<PlanFault>) {
        let axis = &self.axis;
        let (profile, limits, homing) = (&axis.profile, &axis.limits, self.homing.as_ref());
        let (velocity, acceleration) =
            (self.velocity_on_wire(1.0).abs(), self.acceleration_on_wire(1.0).abs());
        if !(velocity > 0.0 && velocity.is_finite() && acceleration.is_finite()) {
            return; // Reported for every axis, or above.
        }
        let mut reported = None;
        for (key, value, on_wire, per) in [
            ("profile.velocity", Some(profile.velocity), velocity, "s"),
            ("limits.velocity", limits.velocity, velocity, "s"),
            ("homing.velocity", homing.map(|homing| homing.velocity), velocity, "s"),
            ("profile.acceleration", Some(profile.acceleration), acceleration, "s²"),
            ("profile.deceleration", Some(profile.deceleration), acceleration, "s²"),
            ("limits.acceleration", limits.acceleration, acceleration, "s²"),
            ("stop.deceleration", Some(axis.stop.deceleration), acceleration, "s²"),
            ("homing.acceleration", homing.map(|homing| homing.acceleration), acceleration, "s²"),
        ] {
            let Some(value) = value else { continue };
            let (least, most) = (1.0 / on_wire, MOST_PER_REV / on_wire);
            // One acceleration may stand in for several of them.
            if (least..=most).contains(&value) || reported == Some((value, per)) {
                continue;
            }
            let unit = axis.units.unit;
            let (least, most) = (inside(least, f64::ceil), inside(most, f64::floor));
            let why = format!(
                "{value} is outside the range of the drive, {least} ... {most} {unit}/{per}; change it or \
                 check scale and steps_per_rev"
            );
            faults.push(PlanFault::new(key, why));
            reported = Some((value, per));
        }
    }

    fn homing_faults(&self, faults: &mut Vec<PlanFault>) {
        let Some(homing) = &self.homing else { return };
        let mut wrong = |key, message: String| faults.push(PlanFault::new(key, message));
        if IoCode::from_code(homing.input).is_none() {
            wrong("homing.input", "must be an input with its condition, like \"2L\"".to_owned());
        }
        let counts = (homing.distance * self.axis.units.counts_per_unit).abs();
        if !(1.0..=f64::from(i32::MAX)).contains(&counts) {
            let unit = self.axis.units.unit;
            let most = inside(f64::from(i32::MAX) / self.axis.units.counts_per_unit.abs(), f64::floor);
            let why = format!(
                "{} is no distance of the drive; use up to {most} {unit}, its sign is the direction",
                homing.distance
            );
            wrong("homing.distance", why);
        }
        let most = self.axis.limits.homing_velocity();
        if let Some(most) = most.filter(|most| homing.velocity > *most) {
            let why = format!("exceeds the limit while it homes, {most}; lower it, or raise limits.homing");
            wrong("homing.velocity", why);
        }
    }

    /// The drive stops by itself within this time, ns; `None`: it does not, or it is not known.
    pub(super) fn stops_within_ns(&self) -> Option<u64> {
        self.watchdog.within_ns.filter(|_| self.takes_commands())
    }

    /// What `check` says of it beyond its axis; the first line is its address.
    pub fn describe(&self, bind: SocketAddrV4, period_ns: u64) -> String {
        let motion = match self.takes_commands() {
            true => format!("{}\n{}", self.describe_motion(), self.describe_commands(period_ns)),
            false => {
                format!("no motion: {}; its values are shown, and calls are taken", self.why_no_commands())
            }
        };
        let shown: Vec<String> = self.shown().into_iter().flatten().map(|channel| channel.name).collect();
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
            format!("shows {}", shown.join(", ")),
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
