//! The loop without a socket.

use std::net::SocketAddrV4;

use fieldbeat::Wait;
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::linudp::ControlWord;
use fieldbeat::bus::modbus::ControlWord as UnidriveControl;
use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::time::{MS, S};
use fieldbeat_core::net::{Datagrams, Frames, Outbox, Streams};
use fieldbeat_core::rt::MonotonicClock;
use fieldbeat_ethercat::wire::frame::FRAME_MAX;
use fieldbeat_ethernet_ip as ethernet_ip;
use fieldbeat_ethernet_ip::wire::io::Outgoing;
use fieldbeat_linudp::wire::{Request, ResponseDef};
use fieldbeat_profibus::wire::telegram;

use crate::support::fleet::{self, Fleet, Side};
use crate::support::lenze::{self, NullSerial, NullWires};
use crate::support::null::{NullCarrier, NullNet, NullPackets, NullStreams};
use crate::support::rig::{self, Calls, Pace, Rig};
use crate::support::segment::{NullSegment, NullSegments, Settled};
use crate::support::stats::{Interval, Line, median, over_rounds};
use crate::support::{Steal, in_turns, shown, unidrive};

/// Of the loop without a socket, ns a drive and cycle.
pub struct Without {
    pub back_to_back: Interval,
    pub paced: Interval,
    pub carrier: f64,
}

/// One slice of `cycles` back to back, or fewer paced, or of the carrier alone: each cycle, ns.
pub fn slice_of(fleet: Fleet, what: usize, cycles: usize) -> Vec<f64> {
    let slice = rig::on_loop_thread(|_| match what {
        0 => turns(fleet, Pace::BackToBack, cycles),
        1 => turns(fleet, Pace::Grid, PACED),
        _ => carrier_alone(fleet, cycles),
    });
    slice.unwrap_or_else(|error| rig::give_up(error))
}

/// The same of Lenze drives on wires. The loop waits by poll: spinning would be counted as its time.
pub fn slice_of_wires(count: usize, what: usize, cycles: usize) -> Vec<f64> {
    let wires = NullWires(lenze::wires("local:slice", count), rig::now);
    let run = |pace, cycles| {
        let buses = wires.0.iter().map(|wire| Box::new(wire.clone()) as Box<dyn BusPlan>);
        let cycle = rig::exchange_cycle(MS, Wait::Poll);
        let mut rig = Rig::new(cycle, buses.collect(), Pace::BackToBack, &wires, Calls::default());
        rig.enable();
        rig.set_pace(pace);
        (0..cycles).map(|_| rig.turn(|_| {}).busy_ns as f64).collect()
    };
    let slice = rig::on_loop_thread(|_| match what {
        0 => run(Pace::BackToBack, cycles),
        1 => run(Pace::Grid, PACED),
        _ => wires_alone(&wires.0, cycles),
    });
    slice.unwrap_or_else(|error| rig::give_up(error))
}

/// What the wires in memory take by themselves, ns a cycle: what is on each before it is used, an exchange of each
/// drive, and a token.
fn wires_alone(plans: &[ProfibusPlan], cycles: usize) -> Vec<f64> {
    let wire = |plan: &ProfibusPlan| (NullSerial::new(plan, rig::now), lenze::requests(plan));
    let mut wires: Vec<_> = plans.iter().map(wire).collect();
    let token = telegram::token(2, 2);
    let mut room = [0; 64];
    let mut cycle = || {
        let begin = MonotonicClock::read();
        for (wire, requests) in &mut wires {
            let _ = std::hint::black_box(wire.receive(0, &mut room));
            for request in requests {
                let _ = std::hint::black_box(wire.send(0, std::hint::black_box(request)));
                let _ = std::hint::black_box(wire.receive(0, &mut room));
            }
            let _ = std::hint::black_box(wire.send(0, &token));
        }
        MonotonicClock::read().since(begin) as f64
    };
    (0..cycles).map(|_| cycle()).collect()
}

/// Cycles of a slice at 1 kHz.
const PACED: usize = 100;

/// A segment of each length in memory, in operation.
pub struct StandingSegments(Vec<(usize, Rig, Settled)>);

impl StandingSegments {
    pub fn new(lengths: &[usize]) -> StandingSegments {
        let segment = |count: usize| {
            let settled = Settled::default();
            let plan = Fleet::segment(count).ethercat(Side::Ours);
            let carriers = NullSegments(plan.clone(), rig::now, Settled::clone(&settled));
            let up = rig::on_loop_thread(|_| {
                let cycle = rig::exchange_cycle(MS, Wait::Spin);
                let buses: Vec<Box<dyn BusPlan>> = vec![Box::new(plan)];
                let mut rig = Rig::new(cycle, buses, Pace::BackToBack, &carriers, Calls::default());
                rig::leap(S);
                rig.enable();
                while settled.get().is_none() {
                    rig.turn(|_| {});
                }
                rig
            });
            (count, up.unwrap_or_else(|error| rig::give_up(error)), settled)
        };
        StandingSegments(lengths.iter().copied().map(segment).collect())
    }

    pub fn slice(&mut self, count: usize, what: usize, cycles: usize) -> Vec<f64> {
        let segment = self.0.iter_mut().find(|(length, ..)| *length == count);
        let (_, rig, settled) = segment.expect("it stands");
        let slice = rig::on_loop_thread(|_| {
            if what > 1 {
                return segment_alone(settled, cycles);
            }
            // To its time again, which the other ones have left.
            rig.set_pace(Pace::BackToBack);
            rig.turn(|_| {});
            let (pace, cycles) = if what == 0 { (Pace::BackToBack, cycles) } else { (Pace::Grid, PACED) };
            rig.set_pace(pace);
            (0..cycles).map(|_| rig.turn(|_| {}).busy_ns as f64).collect()
        });
        slice.unwrap_or_else(|error| rig::give_up(error))
    }
}

/// What the segment in memory takes by itself, ns a cycle.
fn segment_alone(settled: &Settled, cycles: usize) -> Vec<f64> {
    let mut segment = NullSegment::settled(settled, rig::now);
    let mut room = [0; FRAME_MAX];
    let frame = settled.get().map_or(&[][..], |(frame, _)| frame);
    let mut cycle = || {
        let begin = MonotonicClock::read();
        let _ = std::hint::black_box(segment.send(std::hint::black_box(frame)));
        let _ = std::hint::black_box(segment.receive(&mut room));
        MonotonicClock::read().since(begin) as f64
    };
    (0..cycles).map(|_| cycle()).collect()
}

pub fn without_socket(
    kind: &str,
    quick: bool,
    drives: &[usize],
    mut slice: impl FnMut(usize, usize, usize) -> Vec<f64>,
) -> Vec<Without> {
    let rounds = if quick { 5 } else { 21 };
    let steal = Steal::begin();
    // Medians of a cycle, ns: by number of drives, then by round.
    let mut medians: Vec<[Vec<f64>; 3]> = drives.iter().map(|_| Default::default()).collect();
    in_turns(rounds, 3 * drives.len(), |who| {
        let (place, what) = (who / 3, who % 3);
        let count = drives[place];
        // About a millisecond or two of work; at 1 kHz a tenth of a second.
        let cycles = (10_000 / count).clamp(200, 2_000);
        medians[place][what].push(median(&slice(count, what, cycles)));
    });

    println!(
        "\nthe loop without a socket, {kind}, ns a drive and cycle; {rounds} rounds, steal {} ms",
        shown(steal.ms())
    );
    println!("  drives           back to back            paced 1 kHz   the null carrier, taken off both");
    let mut table = Vec::new();
    for (count, [loops, paced, carrier]) in drives.iter().zip(&medians) {
        let each = *count as f64;
        let without_carrier = |all: &[f64]| {
            over_rounds(rounds, |rounds| {
                let chosen =
                    |all: &[f64]| median(&rounds.iter().map(|round| all[*round]).collect::<Vec<_>>());
                (chosen(all) - chosen(carrier)) / each
            })
        };
        let row = Without {
            back_to_back: without_carrier(loops),
            paced: without_carrier(paced),
            carrier: median(carrier) / each,
        };
        println!(
            "  {count:6} {:>22} {:>22} {:12.1}",
            row.back_to_back.to_string(),
            row.paced.to_string(),
            row.carrier
        );
        table.push(row);
    }

    for (what, name) in [(0, "back to back"), (1, "paced")] {
        let line = |rounds: &[usize]| {
            let points: Vec<_> = (drives.iter().zip(&medians))
                .map(|(count, by_what)| {
                    let chosen =
                        |what: usize| median(&rounds.iter().map(|r| by_what[what][*r]).collect::<Vec<_>>());
                    (*count as f64, chosen(what) - chosen(2))
                })
                .collect();
            (Line::through(&points), points)
        };
        let slope = over_rounds(rounds, |rounds| line(rounds).0.slope);
        let (fit, points) = line(&(0..rounds).collect::<Vec<_>>());
        // Round by round: a computer that is slower for a while is slower for all points of a round.
        let bend_of = |round: usize| {
            let (fit, points) = line(&[round]);
            points.iter().map(|(x, y)| (y / fit.at(*x) - 1.0).abs()).fold(0.0, f64::max)
        };
        let bend = over_rounds(rounds, |rounds| {
            median(&rounds.iter().map(|round| bend_of(*round)).collect::<Vec<_>>())
        });
        println!(
            "  {name}: {slope} ns a drive + {:.0} ns a cycle; farthest point {bend} off the line, R2 {:.4}",
            fit.intercept,
            fit.r_squared(&points)
        );
    }
    table
}

/// Busy time of each cycle, ns.
pub fn turns(fleet: Fleet, pace: Pace, cycles: usize) -> Vec<f64> {
    let cycle = rig::exchange_cycle(MS, Wait::Spin);
    let mut rig = Rig::new(cycle, fleet.buses(Side::Ours), pace, &NullNet, Calls::default());
    rig.enable();
    (0..cycles).map(|_| rig.turn(|_| {}).busy_ns as f64).collect()
}

/// What the null carrier takes for a cycle by itself, ns.
pub fn carrier_alone(fleet: Fleet, cycles: usize) -> Vec<f64> {
    match fleet {
        Fleet { moons: 1.., .. } => packets_alone(fleet.moons, cycles),
        Fleet { unidrives: 1.., .. } => streams_alone(fleet.unidrives, cycles),
        _ => datagrams_alone(fleet.linmots, cycles),
    }
}

fn packets_alone(drives: usize, cycles: usize) -> Vec<f64> {
    let at = |index| SocketAddrV4::new(*fleet::address(Side::Ours, index).ip(), ethernet_ip::IO_PORT);
    let peers: Vec<_> = (0..drives).map(at).collect();
    let (carrier, packet) = (NullPackets::of(&peers), Outgoing::owner(1));
    let mut outbox = Outbox::new(&peers, packet.bytes().len());
    for index in 0..drives {
        outbox.room(index).copy_from_slice(packet.bytes());
        outbox.set_length(index, packet.bytes().len());
    }
    exchanges_alone(carrier, outbox, cycles)
}

fn streams_alone(drives: usize, cycles: usize) -> Vec<f64> {
    let mut carrier = NullStreams::new(drives);
    let drive = unidrive::drive(*fleet::address(Side::Ours, 0).ip());
    let (request, length) = unidrive::request(&drive, UnidriveControl::FORWARD);
    // Each drive has its own, as in the loop.
    let requests = vec![request; drives];
    let mut rooms = vec![[0; 2 * unidrive::ADU_MAX]; drives];
    let mut cycle = || {
        let begin = MonotonicClock::read();
        while carrier.opened().is_some() {}
        carrier.look();
        for (index, request) in requests.iter().enumerate() {
            let _ = std::hint::black_box(carrier.send(index, &request[..length]));
        }
        carrier.look();
        while let Some(index) = carrier.ready() {
            let _ = std::hint::black_box(carrier.receive(index, &mut rooms[index]));
        }
        MonotonicClock::read().since(begin) as f64
    };
    (0..cycles).map(|_| cycle()).collect()
}

fn datagrams_alone(drives: usize, cycles: usize) -> Vec<f64> {
    let carrier = NullCarrier::new(drives);
    let peers: Vec<_> = (0..drives).map(|index| fleet::address(Side::Ours, index)).collect();
    let request =
        Request { response_def: ResponseDef::CYCLIC, control: Some(ControlWord::ON), ..Request::default() };
    let mut outbox = Outbox::new(&peers, request.size());
    for index in 0..drives {
        let length = request.emit(outbox.room(index));
        outbox.set_length(index, length);
    }
    exchanges_alone(carrier, outbox, cycles)
}

/// Sends all of the outbox, and takes in what comes.
fn exchanges_alone(mut carrier: impl Datagrams, mut outbox: Outbox, cycles: usize) -> Vec<f64> {
    let drives = outbox.len();
    let mut cycle = || {
        (0..drives).for_each(|index| outbox.post(index, true));
        let begin = MonotonicClock::read();
        carrier.send(&mut outbox);
        while let Ok(count) = carrier.receive(&mut |datagram| {
            std::hint::black_box(datagram);
        }) && count == carrier.batch()
        {}
        MonotonicClock::read().since(begin) as f64
    };
    (0..cycles).map(|_| cycle()).collect()
}
