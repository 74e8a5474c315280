//! Buses that build requests which never leave: before each one that does, others, of which nothing may be seen. Each
//! request that leaves is built anew for that, too.

use std::os::fd::RawFd;

use fastrand::Rng;
use fieldbeat::axis::{NativeOwner, Profile};
use fieldbeat::bus::BusPlan;
use fieldbeat::{Cycle, OpenError, Time};
use fieldbeat_core::bus::counters::BusNumbers;
use fieldbeat_core::bus::desired::{Desired, Intent, Mode, Motion, Power};
use fieldbeat_core::bus::native::Inputs;
use fieldbeat_core::bus::{Bus, Opened, Slot, Waits};
use fieldbeat_core::net::Carriers;
use fieldbeat_core::rt::Regions;

/// A plan whose bus is one of these.
#[derive(Debug)]
pub struct ProposingPlan {
    pub plan: Box<dyn BusPlan>,
    pub seed: u64,
}

impl BusPlan for ProposingPlan {
    crate::forward_bus_plan!(plan);

    fn open(&self, period_ns: u64, carriers: &dyn Carriers) -> Result<Opened, OpenError> {
        Ok(Proposing::of(self.plan.open(period_ns, carriers)?, self.seed))
    }
}

/// Serials that the loop does not come to.
const PROPOSED: u64 = 1 << 40;

/// The bus, and what is drawn.
pub struct Proposing {
    bus: Box<dyn Bus>,
    random: Rng,
    serial: u64,
}

impl Proposing {
    /// The bus as it was opened, with what is drawn from this seed.
    pub fn of(opened: Opened, seed: u64) -> Opened {
        let proposing = Proposing { bus: opened.bus, random: Rng::with_seed(seed), serial: PROPOSED };
        Opened { bus: Box::new(proposing), ..opened }
    }

    fn intent<T>(&mut self, value: T, before: Intent<T>) -> Intent<T> {
        if self.random.bool() {
            return before;
        }
        self.serial += 1;
        Intent { serial: self.serial, value }
    }

    /// What might be desired in place of this.
    fn other(&mut self, desired: &Desired, at: f64) -> Desired {
        let random = &mut self.random;
        let profile = Profile {
            velocity: random.f64() * 100.0 + 1.0,
            acceleration: random.f64() * 1_000.0 + 1.0,
            deceleration: random.f64() * 1_000.0 + 1.0,
        };
        let owner = [NativeOwner::Master, NativeOwner::Application][random.usize(..2)];
        let motions = [
            Motion::Hold,
            Motion::Move { position: at + random.f64() * 10.0, profile },
            Motion::Velocity { velocity: profile.velocity, acceleration: profile.acceleration },
            Motion::Ramp { deceleration: profile.deceleration },
            Motion::Follow,
            Motion::EndStream,
            Motion::Halt,
            Motion::Home,
            Motion::Native(owner),
        ];
        let powers = [
            Power::Off,
            Power::Shutdown,
            Power::SwitchOn,
            Power::EnableOperation,
            Power::QuickStop,
            Power::FaultReset,
        ];
        let (power, motion) = (powers[random.usize(..powers.len())], motions[random.usize(..motions.len())]);
        let mode = [Mode::AsIs, Mode::Own, Mode::Homing][random.usize(..3)];
        let mut setpoint = desired.setpoint;
        setpoint.position += random.f64();
        setpoint.velocity += random.f64();
        Desired {
            power: self.intent(power, desired.power),
            mode: self.intent(mode, desired.mode),
            motion: self.intent(motion, desired.motion),
            setpoint,
        }
    }
}

impl Bus for Proposing {
    /// Builds something else, some times, and then what is desired.
    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        let desired: Vec<Desired> = slots.iter().map(|slot| slot.desired).collect();
        for _ in 0..self.random.u8(..3) {
            for (slot, desired) in slots.iter_mut().zip(&desired) {
                // One that is only read, and one that is as it should be, stand next to it.
                if desired.power.serial != 0 && self.random.u8(..4) > 0 {
                    slot.desired = self.other(desired, slot.status.position);
                }
            }
            self.bus.prepare(cycle, slots);
            slots.iter_mut().zip(&desired).for_each(|(slot, desired)| slot.desired = *desired);
        }
        self.bus.prepare(cycle, slots);
    }

    crate::forward! { this => this.bus;
        fn memory(&self, regions: &mut Regions);
        fn fd(&self) -> Option<RawFd>;
        fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]);
        fn receive(&mut self, cycle: &Cycle, slots: &mut [Slot]);
        fn poll(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]);
        fn waits(&self, cycle: &Cycle, slots: &[Slot]) -> Waits;
        fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool;
        fn numbers(&self) -> BusNumbers;
        fn native(&self, index: usize) -> Option<(&dyn Inputs, &[u8])>;
        fn helper_ended(&self) -> bool;
        fn lead(&mut self);
        fn phase_error(&mut self) -> Option<i64>;
    }
}
