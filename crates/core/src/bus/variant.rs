//! A machine like another one on the same computer: its drives more or fewer, its period another, its addresses its
//! own.

use std::net::{Ipv4Addr, SocketAddrV4};

use crate::axis::AxisPlan;

/// The differences of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Variant {
    /// The period for which it was planned, ns.
    pub was_ns: u64,
    /// The period, ns.
    pub period_ns: u64,
    /// The number of drives on the bus, each like the first of them; `None`: those that it has.
    pub drives: Option<usize>,
    /// Which of the machines on this computer it is; 0 has the addresses of the plan.
    pub place: u8,
}

impl Variant {
    /// The address of this computer in place of `address`: in another one of its networks.
    pub fn address(&self, address: Ipv4Addr) -> Ipv4Addr {
        let [first, _, c, d] = address.octets();
        match self.place {
            0 => address,
            place => Ipv4Addr::new(first, 240_u8.saturating_add(place), c, d),
        }
    }

    /// The segment in place of `interface`, or the wire in place of a port.
    pub fn interface(&self, interface: &str) -> String {
        match self.place {
            0 => interface.to_owned(),
            place => format!("{interface}-{}", u32::from(place) + 1),
        }
    }

    /// Adapts the exchanges of `axis`: each cycle, or as far apart as they were, and never closer than `least_ns`. Its
    /// link is lost after the same time as before.
    pub fn schedule(&self, axis: &mut AxisPlan, least_ns: u64) {
        let (was, period_ns) = (u64::from(axis.divisor), self.period_ns.max(1));
        let was_every = self.was_ns.saturating_mul(was);
        let usual = if was == 1 { 1 } else { (was_every / period_ns).max(2) };
        let divisor = usual.max(least_ns.div_ceil(period_ns));
        let lost_after = was_every.saturating_mul(axis.health.bucket.into());
        let short = |number: u64| u32::try_from(number).unwrap_or(u32::MAX);
        axis.phase = short(u64::from(axis.phase) * divisor / was);
        axis.health.bucket = short(lost_after.div_ceil(period_ns.saturating_mul(divisor)));
        axis.divisor = short(divisor);
    }

    /// The drives of a bus that have IP addresses, which `parts` shows with their names: its own, or so many like the
    /// first of them.
    pub fn hosts<D: Clone>(
        &self,
        drives: &[D],
        parts: fn(&mut D) -> (&mut AxisPlan, &mut SocketAddrV4),
    ) -> Vec<D> {
        let mut all = match (self.drives, drives.first()) {
            (Some(count), Some(first)) => vec![first.clone(); count],
            _ => drives.to_vec(),
        };
        for (ahead, drive) in all.iter_mut().enumerate() {
            let (axis, address) = parts(drive);
            if self.drives.is_some() {
                axis.name = name_behind(&axis.name, ahead);
                *address = address_behind(*address, ahead);
            }
            address.set_ip(self.address(*address.ip()));
        }
        all
    }

    /// The time between two exchanges of `axis`, ns.
    pub fn every_ns(&self, axis: &AxisPlan) -> u64 {
        self.period_ns.saturating_mul(axis.divisor.into())
    }
}

/// The name of the drive `ahead` places behind the one that is called `first`: `a3` is two behind `a1`.
fn name_behind(first: &str, ahead: usize) -> String {
    let stem = first.trim_end_matches(|c: char| c.is_ascii_digit());
    let number = first[stem.len()..].parse::<usize>().unwrap_or(1);
    format!("{stem}{}", number.saturating_add(ahead))
}

/// The address `ahead` places behind `first`.
fn address_behind(first: SocketAddrV4, ahead: usize) -> SocketAddrV4 {
    let ip = u32::from(*first.ip()).saturating_add(u32::try_from(ahead).unwrap_or(u32::MAX));
    SocketAddrV4::new(Ipv4Addr::from(ip), first.port())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::Units;
    use crate::time::{MS, US};

    #[test]
    fn exchanges_keep_their_time_and_the_link_is_lost_after_the_same() {
        for (period_ns, was, least_ns, divisor, phase, bucket) in [
            (MS, 8, 0, 8, 6, 125),
            (250 * US, 8, 0, 32, 24, 125),
            (3 * MS, 8, 0, 2, 1, 167),
            (20 * MS, 8, 0, 2, 1, 25),
            (250 * US, 1, 0, 1, 0, 4_000),
            (250 * US, 1, 400 * US, 2, 0, 2_000),
            (4 * MS, 1, 400 * US, 1, 0, 250),
        ] {
            let mut axis = AxisPlan::new("x", Units::millimetres(1.0));
            (axis.divisor, axis.phase) = (was, if was == 1 { 0 } else { 6 });
            axis.health.bucket = 1_000 / was;
            Variant { was_ns: MS, period_ns, drives: None, place: 0 }.schedule(&mut axis, least_ns);
            let found = (axis.divisor, axis.phase, axis.health.bucket);
            assert_eq!(found, (divisor, phase, bucket), "{period_ns}");
        }
    }

    #[test]
    fn names_go_on_behind_the_first() {
        let behind = ["a1", "x", "axis-07", "9"].map(|first| name_behind(first, 2));
        assert_eq!(behind, ["a3", "x3", "axis-9", "11"]);
    }
}
