//! Moves that end at an input: to a sensor, and homing.
//!
//! Facts: sheet, 5.4, 5.5; what they leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | FS, FY, FM | run in the direction of DI until the input has its condition, then stop with DE; FY ends after DI at the latest, FM looks from DC on |
//! | FD | runs at VE up to the first input, at VC up to the second one |
//! | SH, FH | run in the direction of DI to the input, stop, and come back to where it was met; they turn round at one limit and end at the second one. FH goes to the home switch as it is wired, with HV1, HA1 and HL1 |

use super::drive::Drive;
use super::motion::{Io, Motion, Move, Profile, rate};
use super::parameters::Name;

/// What ends a search.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sensor {
    /// FS.
    Stop,
    /// FM.
    Mask,
    /// FY.
    Safety,
    /// SH.
    Home,
}

/// A search for an input.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Search {
    pub ends_at: Io,
    /// From there on it runs at VC.
    pub slows_at: Option<Io>,
    pub begun_at: f64,
    /// It looks only after so much, and ends after so much, rad.
    pub mask: f64,
    pub most: f64,
    pub homing: bool,
    pub turned: bool,
    pub profile: Profile,
}

impl Search {
    /// It looks for the home switch.
    pub(super) fn is_homing(&self) -> bool {
        self.homing
    }
}

impl Drive {
    pub(super) fn find_profile(&self) -> Profile {
        let get = |name: &Name| self.parameters.indexed(name, 1);
        Profile {
            velocity: get(b"HV"),
            acceleration: get(b"HA"),
            deceleration: get(b"HL"),
            distance: self.parameters.get(b"DI"),
        }
    }

    pub(super) fn search(&mut self, kind: Move, profile: Profile) -> Option<Search> {
        let step = self.step_rad();
        let mut search = Search {
            ends_at: Io { number: 0, condition: b'L' },
            slows_at: None,
            begun_at: self.power.demand(),
            mask: 0.0,
            most: f64::INFINITY,
            homing: false,
            turned: false,
            profile,
        };
        match kind {
            Move::Double(first, second) => (search.slows_at, search.ends_at) = (Some(first), second),
            Move::Sensor(sensor, io) => {
                search.ends_at = io;
                match sensor {
                    Sensor::Stop => {}
                    Sensor::Mask => search.mask = f64::from(self.parameters.get(b"DC")).abs() * step,
                    Sensor::Safety => search.most = f64::from(profile.distance).abs() * step,
                    Sensor::Home => search.homing = true,
                }
            }
            _ => {
                let Some(home) = self.motor.home else {
                    self.refused.unsupported += 1;
                    return None;
                };
                let condition = if home.at.closed { b'L' } else { b'H' };
                (search.ends_at, search.homing) = (Io { number: home.at.input, condition }, true);
            }
        }
        Some(search)
    }

    /// The search ends, or slows down.
    pub(super) fn look(&mut self, search: Search, before: u16) {
        let inputs = self.inputs();
        let open = |word: u16, io: Io| io.number > 0 && word >> (io.number - 1).min(15) & 1 == 1;
        let met = |io: Io| (1..=8).contains(&io.number) && io.is_met(open(inputs, io), open(before, io));
        let done = (self.power.place() - search.begun_at).abs();
        let down = rate(search.profile.deceleration);
        if done >= search.most {
            self.brake(down, false, None, false);
        } else if search.slows_at.is_some_and(met) {
            let profile = search.profile;
            self.aim = profile.run(self.parameters.get(b"VC"), profile.direction());
            self.motion = Motion::Searching(Search { slows_at: None, ..search });
        } else if search.slows_at.is_none() && done >= search.mask && met(search.ends_at) {
            let back = search.homing.then(|| (self.power.place(), search.profile));
            self.brake(down, false, back, false);
        }
    }
}
