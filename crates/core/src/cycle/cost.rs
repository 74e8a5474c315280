//! What the cycles of a plan cost on a host: the time of their stages, of a usual one and of the worst one, and of the
//! wires. An estimate from a few costs, stated or measured, for whoever decides before the start.

use std::fmt;
use std::fs;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::PathBuf;

use nix::ifaddrs::getifaddrs;

use super::{CyclePlan, Plan};
use crate::bus::load::{Load, Medium, Way};
use crate::rt::host;
use crate::time::{MS, Ns, S, US, three_digits};

/// The cost of handing something over and of taking its answer in, ns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Exchange {
    /// To send the request.
    pub send_ns: u64,
    /// To receive the reply.
    pub receive_ns: u64,
}

/// The times that this host takes for the parts of a cycle.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Costs {
    /// They were measured on this host.
    pub measured: bool,
    /// Of each [`Medium`], in their order.
    pub exchanges: [Exchange; 4],
    /// The time of an interface's driver for a frame, ns; by the interface's name.
    pub drivers: Vec<(String, u64)>,
}

/// The names of the media, in the file as in reports.
pub const MEDIA: [&str; 4] = ["datagram", "stream", "frame", "telegram"];

/// The loop's own work of a cycle, ns: to wake, to wait for replies.
const CYCLE_NS: u64 = 10 * US;
/// The loop's own work for a drive in a cycle, ns: twice what the bench `scale` measures with cold caches.
const DRIVE_NS: u64 = 500;
/// The factor of own work in the worst cycle, in which all drives are lost, or all have a fault: budgets of the bench.
const WORST: u64 = 4;
/// A cycle should take no more of its period than this, per cent.
const COMFORT: u64 = 70;

impl Default for Costs {
    /// Stated ones: from small virtual machines, rounded.
    fn default() -> Costs {
        let exchanges = [(2_200, 1_800), (6_000, 3_000), (4_000, 2_000), (5_000, 5_000)];
        let exchanges = exchanges.map(|(send_ns, receive_ns)| Exchange { send_ns, receive_ns });
        Costs { measured: false, exchanges, drivers: Vec::new() }
    }
}

impl Costs {
    /// The file in which what was measured is kept.
    pub fn file() -> PathBuf {
        host::state_directory().join("costs")
    }

    /// Those measured on this host, under this kernel; the stated ones if there are none.
    pub fn of_this_host() -> Costs {
        let measured = fs::read_to_string(Costs::file()).ok();
        measured.and_then(|text| Costs::parse(&text, &this_host())).unwrap_or_default()
    }

    /// As text of the file.
    pub fn to_text(&self) -> String {
        let mut text = format!("host {}\n", this_host());
        for (name, exchange) in MEDIA.iter().zip(&self.exchanges) {
            text += &format!("{name} {} {}\n", exchange.send_ns, exchange.receive_ns);
        }
        for (interface, ns) in &self.drivers {
            text += &format!("driver {interface} {ns}\n");
        }
        text
    }

    /// From the text of the file; `None`: it is of another host, or none.
    fn parse(text: &str, this_host: &str) -> Option<Costs> {
        let mut costs = Costs { measured: true, ..Costs::default() };
        let mut lines = text.lines();
        (lines.next()?.strip_prefix("host ")? == this_host).then_some(())?;
        for line in lines {
            match line.split(' ').collect::<Vec<_>>().as_slice() {
                ["driver", interface, ns] => costs.drivers.push(((*interface).to_owned(), ns.parse().ok()?)),
                [name, send_ns, receive_ns] => {
                    let place = MEDIA.iter().position(|known| known == name)?;
                    let [send_ns, receive_ns] = [send_ns.parse().ok()?, receive_ns.parse().ok()?];
                    costs.exchanges[place] = Exchange { send_ns, receive_ns };
                }
                _ => return None,
            }
        }
        // A cost of hours is none, and would overflow.
        let all = costs.exchanges.iter().flat_map(|of| [of.send_ns, of.receive_ns]);
        all.chain(costs.drivers.iter().map(|(_, ns)| *ns)).all(|ns| ns < S).then_some(costs)
    }

    fn of(&self, medium: Medium, interface: Option<&str>) -> Exchange {
        let Exchange { send_ns, receive_ns } = self.exchanges[medium as usize];
        let driver = self.drivers.iter().find(|(name, _)| Some(name.as_str()) == interface);
        Exchange { send_ns: send_ns + driver.map_or(0, |(_, ns)| *ns), receive_ns }
    }
}

/// Facts that say whether costs are those of this host.
fn this_host() -> String {
    let [kernel, cpu] = [host::kernel(), host::cpu()].map(|fact| fact.unwrap_or_else(|| "?".to_owned()));
    format!("{kernel}, {cpu}")
}

/// Time of the parts of a cycle, ns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stages {
    /// To hand all requests to the kernel.
    pub send_ns: u64,
    /// To take all replies in, the wait for them left out.
    pub receive_ns: u64,
    /// All else.
    pub own_ns: u64,
}

impl Stages {
    /// Together.
    pub fn total_ns(&self) -> u64 {
        self.send_ns + self.receive_ns + self.own_ns
    }
}

/// The load of a wire in its fullest slot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wire {
    /// The bus.
    pub bus: String,
    /// The interface.
    pub interface: String,
    /// The speed, Mbit/s.
    pub mbit_s: u64,
    /// Requests.
    pub count: usize,
    /// The time of the requests, and that of the replies, ns.
    pub ns: [u64; 2],
}

/// The cost of the cycles of a plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CycleCost {
    /// The period, ns.
    pub period_ns: u64,
    /// Until when replies are taken, ns after the grid point.
    pub deadline_ns: u64,
    /// The slot in which most drives are due.
    pub usual: Stages,
    /// The same when all drives are lost, or have a fault, at once.
    pub worst: Stages,
    /// The wires whose speed is known.
    pub wires: Vec<Wire>,
    /// By measured costs.
    pub measured: bool,
    /// The settings that would fit, if this does not.
    remedy: String,
}

/// The demand of a plan: who exchanges when, and by which way.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Demand {
    period_ns: u64,
    deadline_ns: u64,
    buses: Vec<BusDemand>,
    /// The longer periods that all buses take.
    periods: Vec<u64>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct BusDemand {
    name: String,
    load: Load,
    /// The interface and its speed.
    interface: Option<(String, Option<u64>)>,
    /// Divisor and phase of each drive.
    due: Vec<(u64, u64)>,
}

/// Bytes around a datagram and around a message on a connection: addresses and heads of Ethernet, IP, and UDP or TCP.
const HEADS: [usize; 2] = [14 + 20 + 8, 14 + 20 + 20];
/// The shortest frame without its checksum; and what follows or precedes each: checksum, preamble, gap (IEEE 802.3).
const SHORTEST: usize = 60;
const AROUND: usize = 4 + 8 + 12;
/// Past so many slots all drives are taken to be due at once.
const MOST_SLOTS: u64 = 4_096;

impl Demand {
    /// That of a plan, with the interfaces of this host.
    pub fn of(plan: &Plan) -> Demand {
        let period_ns = plan.cycle.period_ns;
        let buses = plan.buses.iter().filter_map(|bus| {
            let facts = bus.facts(plan.cycle.grid());
            let load = facts.load.clone()?;
            let axes = bus.axes();
            let due = axes.iter().map(|axis| (u64::from(axis.divisor).max(1), u64::from(axis.phase)));
            let interface = interface(&load.way, &facts.addresses());
            Some(BusDemand { name: bus.name().to_owned(), due: due.collect(), interface, load })
        });
        let buses = buses.collect();
        let takes = |period_ns: &u64| {
            let grid = CyclePlan { period_ns: *period_ns, ..plan.cycle.clone() }.grid();
            plan.buses.iter().all(|bus| bus.faults(*period_ns).is_empty() && bus.turn_faults(grid).is_empty())
        };
        let periods = LADDER.into_iter().filter(|longer| *longer > period_ns).filter(takes).collect();
        Demand { period_ns, deadline_ns: plan.cycle.deadline_ns(), buses, periods }
    }

    /// The interfaces of this host that it needs.
    pub fn interfaces(&self) -> Vec<String> {
        self.buses.iter().filter_map(|bus| Some(bus.interface.as_ref()?.0.clone())).collect()
    }

    /// The cost of these cycles.
    pub fn cost(&self, costs: &Costs) -> CycleCost {
        let drives: u64 = self.buses.iter().map(|bus| bus.due.len() as u64).sum();
        let own_ns = CYCLE_NS + drives * DRIVE_NS;
        let usual = Stages { own_ns, ..self.fullest(costs) };
        let worst = Stages { own_ns: CYCLE_NS + WORST * drives * DRIVE_NS, ..usual };
        let wires: Vec<Wire> = self.buses.iter().filter_map(BusDemand::wire).collect();
        let wire_ns = wires.iter().flat_map(|wire| wire.ns).max().unwrap_or(0);
        let wanted = usual.total_ns().max(wire_ns) * 100 / COMFORT;
        let period = self.periods.iter().find(|longer| **longer >= wanted);
        let period = period.map(|ns| format!("period = \"{}\"", Ns(*ns).to_string().replace(' ', "")));
        let remedy = match (period, self.divisor(&usual, wire_ns)) {
            (Some(period), Some(divisor)) => format!("{period} in [cycle] fits, or {divisor}"),
            (Some(one), None) | (None, Some(one)) => format!("{one} fits"),
            (None, None) => "use fewer drives".to_owned(),
        };
        CycleCost {
            period_ns: self.period_ns,
            deadline_ns: self.deadline_ns,
            usual,
            worst,
            wires,
            measured: costs.measured,
            remedy,
        }
    }

    /// The slot that costs most to send and to receive.
    fn fullest(&self, costs: &Costs) -> Stages {
        let in_slot = |slot: Option<u64>| {
            let mut stages = Stages::default();
            for bus in &self.buses {
                let interface = bus.interface.as_ref().map(|(name, _)| name.as_str());
                let Exchange { send_ns, receive_ns } = costs.of(bus.load.medium, interface);
                let count = bus.count_in(slot) as u64;
                stages.send_ns += count * send_ns;
                stages.receive_ns += count * receive_ns;
            }
            stages
        };
        let slots = slots(self.buses.iter().flat_map(|bus| &bus.due));
        slots.map(in_slot).max_by_key(Stages::total_ns).unwrap_or_default()
    }

    /// The divisor by which the drives of the largest bus would fit.
    fn divisor(&self, usual: &Stages, wire_ns: u64) -> Option<String> {
        let shared = |bus: &&BusDemand| matches!(bus.load.medium, Medium::Datagrams | Medium::Streams);
        let bus = self.buses.iter().filter(shared).max_by_key(|bus| bus.due.len())?;
        let room = (self.period_ns * COMFORT / 100).checked_sub(usual.own_ns).filter(|room| *room > 0)?;
        let wanted = (usual.send_ns + usual.receive_ns).div_ceil(room);
        let wanted = wanted.max((wire_ns * 100).div_ceil(self.period_ns * COMFORT));
        let first = bus.due.iter().map(|(divisor, _)| *divisor).min()?;
        let divisor = first.checked_mul(wanted).filter(|divisor| *divisor > first && *divisor <= 1_000)?;
        Some(format!("divisor = {divisor} with the phases 0 ... {} in turn on bus {}", divisor - 1, bus.name))
    }
}

impl BusDemand {
    /// The exchanges, or frames, in a slot; `None`: as if all were due.
    fn count_in(&self, slot: Option<u64>) -> usize {
        match self.load.medium {
            Medium::Frames => self.load.frames.len(),
            _ => self
                .due
                .iter()
                .filter(|(divisor, phase)| slot.is_none_or(|slot| slot % divisor == *phase))
                .count(),
        }
    }

    /// The load of its wire in its fullest slot.
    fn wire(&self) -> Option<Wire> {
        let (interface, mbit_s) = self.interface.as_ref()?;
        let mbit_s = mbit_s.filter(|mbit_s| *mbit_s > 0)?;
        let time = |bytes: usize| bytes as u64 * 8_000 / mbit_s;
        let count = slots(self.due.iter()).map(|slot| self.count_in(slot)).max().unwrap_or(0);
        let ns = match self.load.medium {
            Medium::Frames => {
                let all: usize = self.load.frames.iter().map(|bytes| (*bytes).max(SHORTEST) + AROUND).sum();
                [time(all); 2]
            }
            Medium::Datagrams | Medium::Streams => {
                let head = HEADS[usize::from(self.load.medium == Medium::Streams)];
                self.load.bytes.map(|bytes| time(count * ((bytes + head).max(SHORTEST) + AROUND)))
            }
            Medium::Serial => return None,
        };
        Some(Wire { bus: self.name.clone(), interface: interface.clone(), mbit_s, count, ns })
    }
}

/// Periods that people take, ns.
const LADDER: [u64; 12] =
    [100 * US, 200 * US, 250 * US, 500 * US, MS, 2 * MS, 4 * MS, 5 * MS, 8 * MS, 10 * MS, 20 * MS, 50 * MS];

/// The slots in which drives of these divisors are due in different ways; `None`: there are too many of them.
fn slots<'a>(due: impl Iterator<Item = &'a (u64, u64)>) -> impl Iterator<Item = Option<u64>> {
    let count = due.fold(1, |slots, (divisor, _)| lcm(slots, *divisor));
    let all = if count > MOST_SLOTS { 0 } else { count };
    (0..all).map(Some).chain((all == 0).then_some(None))
}

fn lcm(one: u64, other: u64) -> u64 {
    let (mut a, mut b) = (one, other);
    while b > 0 {
        (a, b) = (b, a % b);
    }
    (one / a.max(1)).saturating_mul(other)
}

/// The interface of a way, and its speed in Mbit/s; nothing of what stays on this computer.
fn interface(way: &Way, drives: &[SocketAddrV4]) -> Option<(String, Option<u64>)> {
    let name = match way {
        Way::Port(_) => return None,
        Way::Interface(name) if name.contains(':') => return None,
        Way::Interface(name) => name.clone(),
        Way::Address(own) => {
            let first = drives.first().map(|drive| *drive.ip());
            let (name, local) = by_address(*own, first)?;
            if local {
                return None;
            }
            name
        }
    };
    let speed = host::link_speed(&name);
    Some((name, speed))
}

/// The interface that has `own`, or, if that is unspecified, the one with `drive` in its network; whether it is the
/// loopback.
fn by_address(own: Ipv4Addr, drive: Option<Ipv4Addr>) -> Option<(String, bool)> {
    let v4 =
        |address: Option<nix::sys::socket::SockaddrStorage>| Some(u32::from(address?.as_sockaddr_in()?.ip()));
    getifaddrs().ok()?.find_map(|interface| {
        let (address, mask) = (v4(interface.address)?, v4(interface.netmask).unwrap_or(u32::MAX));
        let is_it = match own.is_unspecified() {
            false => {
                address == u32::from(own) || own.is_loopback() && address & mask == u32::from(own) & mask
            }
            true => drive.is_some_and(|drive| address & mask == u32::from(drive) & mask),
        };
        is_it.then(|| (interface.interface_name.clone(), Ipv4Addr::from(address).is_loopback()))
    })
}

impl CycleCost {
    /// Why the plan cannot be carried, with what would fit; `None`: nothing says so.
    pub fn refusal(&self) -> Option<String> {
        let basis = self.basis();
        let CycleCost { usual, period_ns, remedy, .. } = self;
        let why = if usual.total_ns() > *period_ns {
            format!("a cycle takes about {usual}, more than its period of {}", Ns(*period_ns))
        } else {
            let wire = self.wires.iter().find(|wire| wire.ns.iter().any(|ns| ns > period_ns))?;
            format!("{wire}, more than the period of {}", Ns(*period_ns))
        };
        Some(format!("{why} ({basis}); {remedy}; cost = \"warn\" in [cycle] starts all the same"))
    }

    /// The tight parts, a line each.
    pub fn warnings(&self) -> Vec<String> {
        let CycleCost { usual, worst, period_ns, deadline_ns, .. } = self;
        let mut lines = Vec::new();
        if usual.total_ns() * 100 > period_ns * COMFORT {
            lines.push(format!("tight: a cycle takes about {usual} of {}; {}", Ns(*period_ns), self.remedy));
        } else if worst.total_ns() > *period_ns {
            lines.push(format!(
                "tight: a cycle in which all drives are lost takes about {worst}, and the period is {}: slots are \
                 skipped then",
                Ns(*period_ns)
            ));
        }
        for wire in &self.wires {
            let there_ns = wire.ns[0].max(usual.send_ns);
            if there_ns + wire.ns[1].max(usual.receive_ns) > *deadline_ns {
                lines.push(format!(
                    "tight: {wire}, and replies are taken until {}: the last ones come too late; raise \
                     receive_deadline, or {}",
                    Ns(*deadline_ns),
                    self.remedy
                ));
            }
        }
        lines
    }

    /// The settings that would fit.
    pub fn remedy(&self) -> &str {
        &self.remedy
    }

    fn basis(&self) -> &'static str {
        match self.measured {
            true => "costs measured on this host",
            false => "by stated costs; `fieldbeat doctor CONFIG --measure` measures those of this host",
        }
    }

    /// In words, a line each.
    pub fn lines(&self) -> Vec<String> {
        let CycleCost { usual, worst, .. } = self;
        let mut lines = vec![format!(
            "a cycle takes about {usual}; {} if all drives are lost or have a fault at once ({})",
            Ns(three_digits(worst.total_ns())),
            self.basis()
        )];
        lines.extend(self.wires.iter().map(Wire::to_string));
        lines
    }
}

/// `716 us: send 290 us, receive 290 us, own work 136 us`.
impl fmt::Display for Stages {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [total, send, receive, own] =
            [self.total_ns(), self.send_ns, self.receive_ns, self.own_ns].map(|ns| Ns(three_digits(ns)));
        write!(f, "{total} (send {send}, receive {receive}, own work {own})")
    }
}

/// `the wire of bus linmot (eth1, 100 Mbit/s) takes 1.72 ms for 256 requests and 1.72 ms for their replies`.
impl fmt::Display for Wire {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Wire { bus, interface, mbit_s, count, ns: [there, back] } = self;
        let [there, back] = [there, back].map(|ns| Ns(three_digits(*ns)));
        let what = if *count == 1 { "request" } else { "requests" };
        write!(
            f,
            "the wire of bus {bus} ({interface}, {mbit_s} Mbit/s) takes {there} for {count} {what} and {back} for \
             the replies"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Buses of so many drives, each with its medium, divisor and interface.
    fn demand(period_ns: u64, buses: &[(Medium, u64, usize, Option<u64>)]) -> Demand {
        let bus = |(medium, divisor, drives, speed): &(Medium, u64, usize, Option<u64>)| BusDemand {
            name: format!("{medium:?}").to_lowercase(),
            load: Load {
                medium: *medium,
                way: Way::Port(String::new()),
                bytes: [10, 8],
                frames: vec![1_000],
            },
            interface: speed.map(|speed| ("eth1".to_owned(), Some(speed))),
            due: (0..*drives as u64).map(|drive| (*divisor, drive % divisor)).collect(),
        };
        let buses = buses.iter().map(bus).collect();
        let periods = LADDER.into_iter().filter(|longer| *longer > period_ns).collect();
        Demand { period_ns, deadline_ns: period_ns / 2, buses, periods }
    }

    #[test]
    fn the_fullest_slot_counts_and_the_worst_cycle_has_more_of_its_own() {
        let of = |buses: &[(Medium, u64, usize, Option<u64>)]| demand(MS, buses).cost(&Costs::default());
        let all = of(&[(Medium::Datagrams, 1, 64, None), (Medium::Streams, 8, 10, None)]);
        // Of ten in turn by eight, two are due in one slot.
        let expected =
            Stages { send_ns: 64 * 2_200 + 2 * 6_000, receive_ns: 64 * 1_800 + 2 * 3_000, own_ns: 47_000 };
        assert_eq!(all.usual, expected);
        assert_eq!(all.worst, Stages { own_ns: 10_000 + 4 * 74 * 500, ..expected });
        assert!(all.refusal().is_none() && all.warnings().is_empty(), "{all:?}");
        // A frame serves all of them.
        assert_eq!(of(&[(Medium::Frames, 1, 64, None)]).usual.send_ns, 4_000);
    }

    #[test]
    fn a_plan_that_does_not_fit_is_refused_with_a_period_that_does() {
        let of = |period_ns, drives| {
            demand(period_ns, &[(Medium::Datagrams, 1, drives, None)]).cost(&Costs::default())
        };
        let why = of(500 * US, 256).refusal().unwrap();
        let expected = "a cycle takes about 1.16 ms (send 563 us, receive 461 us, own work 138 us), more \
             than its period of 500 us (by stated costs; ";
        assert!(why.starts_with(expected), "{why}");
        let remedy = "; period = \"2ms\" in [cycle] fits, or divisor = 5 with the phases 0 ... 4 in turn on \
             bus datagrams; cost = \"warn\" in [cycle] starts all the same";
        assert!(why.ends_with(remedy), "{why}");
        let tight = of(MS, 180);
        assert_eq!((tight.refusal(), tight.warnings().len()), (None, 1), "{tight:?}");
        // The divisor that is named fits.
        let divided = demand(500 * US, &[(Medium::Datagrams, 5, 256, None)]).cost(&Costs::default());
        assert!(
            divided.refusal().is_none()
                && divided.warnings().iter().all(|line| line.contains("all drives are lost")),
            "{divided:?}"
        );
    }

    #[test]
    fn a_wire_has_its_speed() {
        let of =
            |speed, medium| demand(MS, &[(medium, 1, 256, Some(speed))]).cost(&Costs::default()).wires[0].ns;
        // 256 frames of 84 bytes, gap and preamble included.
        assert_eq!(of(1_000, Medium::Datagrams), [172_032; 2]);
        assert_eq!(of(100, Medium::Datagrams), [1_720_320; 2]);
        assert_eq!(of(100, Medium::Frames), [81_920; 2]);
        let slow = demand(2 * MS, &[(Medium::Datagrams, 1, 256, Some(100))]).cost(&Costs::default());
        assert!(slow.refusal().is_none(), "{slow:?}");
        assert!(
            slow.warnings()[0].contains(
                "takes 1.72 ms for 256 requests and 1.72 ms for the replies, and replies are taken until 1 ms"
            ),
            "{slow:?}"
        );
        let slower = demand(MS, &[(Medium::Datagrams, 1, 128, Some(10))]).cost(&Costs::default());
        assert!(
            slower
                .refusal()
                .unwrap()
                .starts_with("the wire of bus datagrams (eth1, 10 Mbit/s) takes 8.6 ms for 128 "),
            "{slower:?}"
        );
    }

    #[test]
    fn costs_are_those_of_this_host_or_stated() {
        let mut costs = Costs { measured: true, ..Costs::default() };
        (costs.exchanges[1], costs.drivers) =
            (Exchange { send_ns: 7, receive_ns: 9 }, vec![("eth1".into(), 900)]);
        let text = costs.to_text();
        assert_eq!(Costs::parse(&text, &this_host()), Some(costs.clone()));
        assert_eq!(costs.of(Medium::Streams, Some("eth1")), Exchange { send_ns: 907, receive_ns: 9 });
        assert_eq!(costs.of(Medium::Streams, Some("eth2")).send_ns, 7);
        for wrong in [
            "",
            "host another",
            &text.replace("stream 7", "stream x"),
            &text.replace("900", "9000000000"),
            &(text.clone() + "more\n"),
        ] {
            assert_eq!(Costs::parse(wrong, &this_host()), None, "{wrong}");
        }
    }
}
