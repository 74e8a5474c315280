//! How the mode of operation uses setpoints.

use super::*;

impl Drive {
    /// Evaluates a motion.
    pub(super) fn watch(&mut self, aim: Aim) {
        if !matches!(aim, Aim::Follow { .. } | Aim::GoTo { .. }) {
            return;
        }
        let behind = self.power.demand() - self.power.place();
        let window = self.objects.get(FOLLOWING_WINDOW);
        if window != i64::from(u32::MAX) && behind.abs() / TAU * self.per_turn() > window as f64 {
            return self.fail(fault::FOLLOWING);
        }
        if self.homing == Homing::Moving && !self.power.is_moving() && behind.abs() < REACHED.1 {
            self.found_home();
        }
    }

    fn found_home(&mut self) {
        let offset = self.objects.get(HOME_OFFSET) as f64;
        self.power.zero = self.power.place() - offset / self.per_turn() * TAU;
        (self.homing, self.power.homed, self.goal) = (Homing::Done, true, None);
    }

    /// Earlier setpoints no longer count: it stays where it is.
    pub(super) fn hold(&mut self) {
        self.track = Track::hold(self.power.place());
        (self.goal, self.acknowledged, self.homing) = (None, false, Homing::Idle);
    }

    /// rad/s per count of an object.
    pub(super) fn speed(&self, object: Object) -> f64 {
        self.objects.get(object) as f64 * self.settings.rpm_per_count * RPM
    }

    /// rad/s^2 of rpm/s of an object.
    pub(super) fn ramp(&self, object: Object) -> f64 {
        self.objects.get(object) as f64 * RPM
    }

    pub(super) fn profile_position(&mut self, word: u16, before: u16) {
        if rises(before, word, control::START) {
            let target = self.objects.get(TARGET_POSITION);
            let place = match word & control::RELATIVE != 0 {
                true => self.power.demand() + target as f64 / self.per_turn() * TAU,
                false => self.place_of(target),
            };
            let (up, down) = (self.ramp(ACCELERATION), self.ramp(DECELERATION));
            self.goal = Some(Aim::GoTo { place, speed: self.speed(PROFILE_VELOCITY), up, down });
        }
        self.acknowledged = word & control::START != 0;
    }

    pub(super) fn home(&mut self, word: u16, before: u16) {
        if rises(before, word, control::START) {
            self.power.homed = false;
            if self.objects.get(HOMING_METHOD) == HOME_HERE {
                return self.found_home();
            }
            let up = self.ramp(HOMING_ACCELERATION);
            let goal =
                |turns| Aim::GoTo { place: turns * TAU, speed: self.speed(HOMING_SPEED), up, down: up };
            self.goal = self.settings.home_turns.map(goal);
            self.homing = if self.goal.is_some() { Homing::Moving } else { Homing::Failed };
        } else if self.homing == Homing::Moving && word & control::START == 0 {
            (self.homing, self.goal) = (Homing::Idle, None);
        }
    }

    /// A position setpoint of a cycle.
    pub(super) fn follow(&mut self, now: Time) {
        let word = self.control.unwrap_or_default();
        let is_mapped = |object| self.selected(OUTPUT_PDO).is_some_and(|pdo| pdo.place(object).is_some());
        // The target of each mode, whatever is in it (CiA 402-2); of the vendor's mode whichever is mapped (assumed).
        let (object, wanted) = match self.mode() {
            mode::CYCLIC_POSITION => (TARGET_POSITION, true),
            mode::TRAJECTORY if is_mapped(TARGET_POSITION) => (TARGET_POSITION, true),
            mode::TRAJECTORY => (INTERPOLATION, true),
            mode::INTERPOLATED => (INTERPOLATION, word & control::START != 0),
            _ => return,
        };
        self.track = match wanted && self.state == State::OperationEnabled && word & control::HALT == 0 {
            true => {
                let (from, over_ns) = (self.track.at(now).0, self.sync.cycle_ns.unwrap_or(MS));
                let most = self.most_speed() * over_ns as f64 / S as f64;
                let way = self.place_of(self.objects.get(object)) - from;
                Track { from, to: from + way.clamp(-most, most), since: now, over_ns }
            }
            false => Track::hold(self.power.place()),
        };
    }

    /// The speed that its limits leave, rad/s: 607Fh in counts of a velocity, 6080h in rpm (CiA 402-2).
    fn most_speed(&self) -> f64 {
        let limits = [(MAXIMUM_VELOCITY, self.settings.rpm_per_count), (MAXIMUM_SPEED, 1.0)];
        let rpm = limits.map(|(object, rpm)| match self.objects.has(object) {
            true => self.objects.get(object) as f64 * rpm,
            false => f64::INFINITY,
        });
        rpm[0].min(rpm[1]) * RPM
    }

    /// The demand of the motor.
    pub(super) fn aim(&self, at: Time) -> Aim {
        let stop = STOP_RPM_S * RPM;
        match self.state {
            State::OperationEnabled => self.motion(at),
            State::SwitchedOn | State::QuickStopActive | State::FaultReactionActive => {
                Aim::Velocity { speed: 0.0, up: stop, down: stop }
            }
            _ => Aim::Off,
        }
    }

    /// The demand from the setpoints of the mode.
    fn motion(&self, at: Time) -> Aim {
        let word = self.control.unwrap_or_default();
        let (up, down) = (self.ramp(ACCELERATION), self.ramp(DECELERATION));
        let most = self.most_speed();
        let velocity = |speed: f64| Aim::Velocity { speed: speed.clamp(-most, most), up, down };
        let torque = |permille: f64| {
            let most = self.objects.get(MAXIMUM_TORQUE) as f64;
            Aim::Torque(self.torque(permille.max(-most).min(most)))
        };
        if word & control::HALT != 0 {
            return velocity(0.0);
        }
        match self.mode() {
            mode::PROFILE_VELOCITY => velocity(self.speed(TARGET_VELOCITY)),
            mode::DIGITAL_VELOCITY => velocity(self.speed(VELOCITY_SETPOINT)),
            mode::TORQUE => torque(self.objects.get(TARGET_TORQUE) as f64),
            mode::DIGITAL_CURRENT => {
                torque(self.objects.get(CURRENT_SETPOINT) as f64 * self.settings.permille_per_count)
            }
            mode::INTERPOLATED if word & control::START == 0 => velocity(0.0),
            mode::INTERPOLATED | mode::TRAJECTORY | mode::CYCLIC_POSITION => {
                let (place, speed) = self.track.at(at);
                let motor = &self.settings.motor;
                let given_way = motor.load_nm / (motor.inertia_kgm2 * (TAU * BANDWIDTH_HZ).powi(2));
                Aim::Follow { place: place - given_way, speed, acceleration: 0.0 }
            }
            _ => self.goal.unwrap_or(velocity(0.0)),
        }
    }

    /// Whether the target position or speed is reached.
    pub(super) fn is_reached(&self) -> bool {
        let is_there = |place: f64| (place - self.power.place()).abs() < REACHED.1;
        match self.aim(self.power.now()) {
            Aim::Off => false,
            Aim::Torque(_) => true,
            Aim::Velocity { speed, .. } => (self.power.speed() - speed).abs() < REACHED.0,
            Aim::Follow { place, .. } => is_there(place),
            Aim::GoTo { place, .. } => is_there(place) && !self.power.is_moving(),
        }
    }
}

/// A position setpoint, reached within a cycle. A late one is extrapolated for one cycle more.
#[derive(Clone, Copy, Debug)]
pub(super) struct Track {
    pub(super) from: f64,
    pub(super) to: f64,
    pub(super) since: Time,
    pub(super) over_ns: u64,
}

impl Track {
    pub(super) const fn hold(place: f64) -> Track {
        Track { from: place, to: place, since: Time(0), over_ns: 0 }
    }

    /// Position and speed at an instant.
    fn at(&self, now: Time) -> (f64, f64) {
        if self.over_ns == 0 {
            return (self.to, 0.0);
        }
        let most = 2 * self.over_ns;
        let passed = now.since(self.since).min(most);
        let way = self.to - self.from;
        let place = self.from + way * passed as f64 / self.over_ns as f64;
        (place, if passed == most { 0.0 } else { way * S as f64 / self.over_ns as f64 })
    }
}
