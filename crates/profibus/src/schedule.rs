//! The turns of the wire on the grid: how long each takes, whether all of them fit by divisor and phase, what would
//! fit, and the longest wait for a turn.
//!
//! A telegram begins inside a window, when the one before it is closed and the wire was idle. One that begins there and
//! ends later is taken in with the next window. Beyond its regular turns each round has room for one request that
//! nobody answers until its slot time is over, its repetition, and one acyclic telegram. A round is as many cycles as
//! the largest divisor.

use super::plan::{Bits, LenzeDrive, ParameterPath, ProfibusPlan, RATES};
use super::wire::msac1::RECORD_MAX;
use fieldbeat_core::axis::PlanFault;
use fieldbeat_core::bus::Grid;
use fieldbeat_core::time::Ns;

/// Bytes of a telegram around its data; with service access points; of one without data, and of a token.
const AROUND: usize = 9;
const WITH_SAPS: usize = AROUND + 2;
const SD1: usize = 6;
const TOKEN: usize = 3;
/// The head of a record of MSAC1 in its data, and the front of Set_Prm before User_Prm.
const RECORD_HEAD: usize = 4;
const SET_PRM: usize = 7;
/// The data of a diagnosis without an extended one, and of Global_Control.
const DIAGNOSIS: usize = 6;
const CONTROL: usize = 2;
/// The least common multiple of divisors up to which phases are looked at.
const MOST_CYCLES: u64 = 2_000;
/// The largest divisor of a drive.
const MOST_DIVISOR: u32 = 1_000;

/// Bytes of a request, and of its answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Bytes(usize, usize);

/// The tries of the turn of a drive, ns: the longest of them, and by how much it is longer with MSAC1.
#[derive(Clone, Copy, Debug)]
struct Tries {
    once_ns: u64,
    acyclic_more_ns: u64,
}

impl LenzeDrive {
    /// Data_Exchange. `None`: its configuration is none.
    fn exchange(&self) -> Option<Bytes> {
        let (outputs, inputs) = self.lengths()?;
        Some(Bytes(outputs + AROUND, inputs + AROUND))
    }

    /// The telegrams in place of Data_Exchange, but for MSAC1. The configuration that a drive wants is taken for
    /// one as long as its own, or as a diagnosis.
    fn others(&self) -> [Bytes; 4] {
        [
            Bytes(WITH_SAPS, WITH_SAPS + DIAGNOSIS + usize::from(self.extended_diagnosis)),
            Bytes(WITH_SAPS, WITH_SAPS + self.configuration.len()),
            Bytes(WITH_SAPS + SET_PRM + self.user_prm.len(), 1),
            Bytes(WITH_SAPS + self.configuration.len(), 1),
        ]
    }

    /// The longest request of MSAC1: a record that is written.
    fn acyclic(&self) -> Option<Bytes> {
        let record = WITH_SAPS + RECORD_HEAD;
        let by_msac1 = matches!(self.parameters, ParameterPath::Msac1 { .. });
        by_msac1.then_some(Bytes(record + RECORD_MAX, record))
    }
}

impl ProfibusPlan {
    /// From the begin of a request until the next one may begin, if it is answered at MaxTsdr, ns.
    fn answered_ns(&self, Bytes(request, answer): Bytes) -> u64 {
        let line = self.line();
        let bits = u64::from(self.bits.max_tsdr) + u64::from(self.bits.idle.max(self.bits.sync));
        (line.span_ns(request + answer) + line.bits_ns(bits)).saturating_add(self.bits.latency_ns)
    }

    /// The same if nobody answers it.
    fn silent_ns(&self, Bytes(request, _): Bytes) -> u64 {
        self.line().span_ns(request).saturating_add(self.slot_ns())
    }

    fn try_ns(&self, bytes: Bytes) -> u64 {
        self.answered_ns(bytes).max(self.silent_ns(bytes))
    }

    /// The time on the wire of Data_Exchange with drive `index`, with its idle time, ns; 0: there is none. It is its
    /// turn without the latency of the port.
    pub(super) fn wire_ns(&self, index: usize) -> u64 {
        self.usual_turn_ns(index).saturating_sub(self.bits.latency_ns)
    }

    /// The turn of drive `index` with Data_Exchange that is answered, ns; 0: there is none.
    pub fn usual_turn_ns(&self, index: usize) -> u64 {
        let exchange = self.drives.get(index).and_then(LenzeDrive::exchange);
        exchange.map_or(0, |bytes| self.answered_ns(bytes))
    }

    /// The longest of so many tries of a turn of drive `index`, ns, but for MSAC1: by then it is answered, or its slot
    /// time is over.
    fn longest_try_ns(&self, drive: &LenzeDrive) -> u64 {
        drive.exchange().into_iter().chain(drive.others()).map(|bytes| self.try_ns(bytes)).max().unwrap_or(0)
    }

    /// By so much a turn of drive `index` is longer with MSAC1.
    fn acyclic_more_ns(&self, drive: &LenzeDrive, than_ns: u64) -> u64 {
        drive.acyclic().map_or(0, |bytes| self.try_ns(bytes).saturating_sub(than_ns))
    }

    /// The longest turn of drive `index`, ns: with all repetitions, none of which is answered in time.
    pub fn longest_turn_ns(&self, index: usize) -> u64 {
        let Some(drive) = self.drives.get(index) else { return 0 };
        let once = self.longest_try_ns(drive);
        (once + self.acyclic_more_ns(drive, once)).saturating_mul(1 + u64::from(self.retries))
    }

    /// Global_Control, which nobody answers.
    fn control_ns(&self) -> u64 {
        let line = self.line();
        let idle = self.bits.idle_unanswered.max(self.bits.sync);
        line.span_ns(WITH_SAPS + CONTROL) + line.bits_ns(idle.into())
    }

    /// The token of a round.
    fn token_ns(&self) -> u64 {
        let line = self.line();
        line.span_ns(TOKEN) + line.bits_ns(self.bits.idle.max(self.bits.sync).into())
    }

    /// The part of the master's own telegrams that may still be under way in a slot: it begins in the window before.
    fn left_over_ns(&self, grid: Grid) -> u64 {
        let token = if self.token { self.token_ns() } else { 0 };
        let gap = if self.gap.is_some() { self.try_ns(Bytes(SD1, SD1)) } else { 0 };
        token.max(gap).max(self.control_ns()).saturating_sub(grid.period_ns.saturating_sub(grid.deadline_ns))
    }

    /// From the slot in which an exchange of each drive is due to the begin of its request, and to its end, at most:
    /// what the master sends itself, the turns of all the others and its own, each with all its repetitions, one of
    /// them acyclic. They begin when the drive may be addressed again: the turn before had begun by the slot.
    pub(super) fn turns(&self, grid: Grid) -> Vec<[u64; 2]> {
        let orders = self.orders();
        let catches_up = self.catches_up(&orders, grid);
        let within = |turns: &[Tries], is_all: bool| {
            let (free, behind) = self.all_tries(turns, grid);
            if catches_up {
                return free;
            }
            let once = if is_all { behind } else { behind.max(self.controlled(free, grid)) };
            // Where turns are long, it is due more than once.
            let more = once / self.global_control_ns.max(1);
            once.saturating_add(more.saturating_mul(grid.period_ns.max(self.control_ns())))
        };
        let of = |(order, drive): (&Vec<Tries>, &LenzeDrive)| {
            let (_, before) = order.split_last()?;
            Some(
                [within(before, false), within(order, true)]
                    .map(|ns| ns.saturating_add(drive.min_slave_interval_ns)),
            )
        };
        orders.iter().zip(&self.drives).filter_map(of).collect()
    }

    /// For each drive the tries of all drives in turn, its own at the end.
    fn orders(&self) -> Vec<Vec<Tries>> {
        let tries = |drive| {
            let once_ns = self.longest_try_ns(drive);
            Tries { once_ns, acyclic_more_ns: self.acyclic_more_ns(drive, once_ns) }
        };
        let mut order: Vec<Tries> = self.drives.iter().map(tries).collect();
        let next = |_: &LenzeDrive| {
            order.rotate_left(1);
            order.clone()
        };
        self.drives.iter().map(next).collect()
    }

    /// The end of Global_Control, if the wire is free then.
    fn controlled(&self, free: u64, grid: Grid) -> u64 {
        grid.in_window(free).saturating_add(self.control_ns())
    }

    /// From a slot to the end of these turns with all repetitions, one of them acyclic; and the same with
    /// Global_Control before one of them, wherever that takes longest.
    fn all_tries(&self, turns: &[Tries], grid: Grid) -> (u64, u64) {
        let mut turns = turns.to_vec();
        if let Some(longest) = turns.iter_mut().max_by_key(|tries| tries.acyclic_more_ns) {
            longest.once_ns = longest.once_ns.saturating_add(longest.acyclic_more_ns);
        }
        let begun = self.left_over_ns(grid);
        turns.iter().fold((begun, begun), |(free, behind), Tries { once_ns, .. }| {
            let end =
                |free| (0..=self.retries).fold(free, |free, _| grid.in_window(free).saturating_add(*once_ns));
            (end(free), end(behind.max(self.controlled(free, grid))))
        })
    }

    /// Global_Control leaves when no drive waits any more, or when it is late by its own period. It is ahead of no
    /// drive if all turns with all repetitions end before any drive is due again.
    fn catches_up(&self, orders: &[Vec<Tries>], grid: Grid) -> bool {
        let divisor = self.drives.iter().map(|drive| drive.axis.divisor).min().unwrap_or(1);
        let all = orders.iter().map(|order| self.all_tries(order, grid).0).max().unwrap_or(0);
        // The stops of those that are lost are turns besides.
        grid.in_window(all) < grid.period_ns.saturating_mul(divisor.into())
            && all.saturating_mul(2) < self.global_control_ns
    }

    /// The exchanges that begin within `within_ns`, if all drives wait for their turn all the time and are answered.
    pub fn exchanges_within(&self, within_ns: u64, grid: Grid) -> u64 {
        let turns: Vec<u64> = (0..self.drives.len()).map(|index| self.usual_turn_ns(index)).collect();
        if turns.is_empty() || turns.contains(&0) || grid.deadline_ns == 0 {
            return 0;
        }
        let (mut free, mut count) = (0, 0);
        let mut not_before = vec![0; turns.len()];
        for (index, turn) in turns.iter().enumerate().cycle() {
            free = grid.in_window(free.max(not_before[index]));
            if free >= within_ns {
                break;
            }
            not_before[index] = free + self.drives[index].min_slave_interval_ns;
            (free, count) = (free + turn, count + 1);
        }
        count
    }

    /// Why the turns do not fit, and what would: the drive whose exchange is not over when the next one is due.
    pub(super) fn schedule_faults(&self, grid: Grid) -> Vec<(usize, PlanFault)> {
        let often = self.interval_faults(grid);
        if !often.is_empty() {
            return often;
        }
        let Err(Late { drive: index, after_ns }) = self.lay(grid) else { return self.watchdog_faults(grid) };
        let Some(drive) = self.drives.get(index) else { return Vec::new() };
        let phases = if self.drives.len() > 1 { " and phases in turn" } else { "" };
        let remedy = match (self.least_divisor(grid), self.least_rate(grid)) {
            (Some(divisor), Some(rate)) => format!("use divisor {divisor}{phases}, or rate {rate}"),
            (Some(divisor), None) => format!("use divisor {divisor}{phases}"),
            (None, Some(rate)) => format!("use rate {rate}"),
            (None, None) => "use less drives on this wire, or a longer period".to_owned(),
        };
        let every_ns = grid.period_ns.saturating_mul(drive.axis.divisor.into());
        let before = Bits { max_tsdr: 60, slot: 100, idle_unanswered: 60, ..self.bits };
        let is_slower = self.bits.max_tsdr > 60
            && self.rate == 45_450
            && ProfibusPlan { bits: before, ..self.clone() }.lay(grid).is_ok();
        let faster = match is_slower {
            true => {
                "; or bits = { max_tsdr = 60, slot = 100 } if the GSD of each drive has that MaxTsdr_45.45"
            }
            false => "",
        };
        let why = format!(
            "asks for an exchange every {}, which is over {} after its slot: a turn of the wire takes {} at \
             {} bit/s, and each round has room for a slot time, a repetition and an acyclic telegram; \
             {remedy}{faster}",
            Ns(every_ns),
            Ns(after_ns),
            Ns(self.usual_turn_ns(index)),
            self.rate,
        );
        vec![(index, PlanFault::new("divisor", why))]
    }

    /// No drive is addressed more often than it allows.
    fn interval_faults(&self, grid: Grid) -> Vec<(usize, PlanFault)> {
        let often = |(index, drive): (usize, &LenzeDrive)| {
            let least_ns = drive.min_slave_interval_ns;
            let every_ns = grid.period_ns.saturating_mul(drive.axis.divisor.into());
            let why = format!(
                "asks for an exchange every {}, more often than min_slave_interval = {} allows; use divisor {} \
                 or more",
                Ns(every_ns),
                Ns(least_ns),
                least_ns.div_ceil(grid.period_ns.max(1)),
            );
            (every_ns < least_ns).then(|| (index, PlanFault::new("divisor", why)))
        };
        self.drives.iter().enumerate().filter_map(often).collect()
    }

    /// A drive is addressed once in its divisor, and when it has waited for its turn: its watchdog has to outlast both.
    fn watchdog_faults(&self, grid: Grid) -> Vec<(usize, PlanFault)> {
        let short = |(index, (drive, [_, turn_ns])): (usize, (&LenzeDrive, [u64; 2]))| {
            let every_ns = grid.period_ns.saturating_mul(drive.axis.divisor.into());
            let silent_ns = every_ns.saturating_add(turn_ns);
            let why = format!(
                "must be above {}: so long may pass until the drive is addressed again, while others do not \
                 answer",
                Ns(silent_ns)
            );
            let is_short = drive.watchdog_ns().is_some_and(|watchdog| watchdog <= silent_ns);
            is_short.then(|| (index, PlanFault::new("watchdog", why)))
        };
        self.drives.iter().zip(self.turns(grid)).enumerate().filter_map(short).collect()
    }

    /// The least divisor that suits all drives, with their phases in turn.
    pub fn least_divisor(&self, grid: Grid) -> Option<u32> {
        let all: u64 = (0..self.drives.len()).map(|index| self.usual_turn_ns(index)).sum();
        let least = self.drives.iter().map(|drive| drive.min_slave_interval_ns).max().unwrap_or(0);
        let period_ns = grid.period_ns.max(1);
        let first = u32::try_from((all / period_ns).max(least.div_ceil(period_ns))).ok()?.max(1);
        (first..=MOST_DIVISOR).find(|divisor| self.in_turn(*divisor).lay(grid).is_ok())
    }

    /// This wire with the same divisor for all drives, and their phases in turn.
    pub fn in_turn(&self, divisor: u32) -> ProfibusPlan {
        let mut plan = self.clone();
        let count = plan.drives.len().max(1) as u64;
        for (index, drive) in plan.drives.iter_mut().enumerate() {
            drive.axis.divisor = divisor;
            drive.axis.phase = (index as u64 * u64::from(divisor) / count) as u32;
        }
        plan
    }

    /// The least rate at which the turns fit as they are.
    fn least_rate(&self, grid: Grid) -> Option<u32> {
        let faster = RATES.into_iter().filter(|rate| *rate > self.rate);
        let at = |rate: &u32| {
            let bits = Bits { latency_ns: self.bits.latency_ns, ..Bits::usual(*rate) };
            ProfibusPlan { rate: *rate, bits, ..self.clone() }.lay(grid).is_ok()
        };
        faster.into_iter().find(at)
    }

    /// The bus load, percent: by the exchanges of a round, and with its room. The latency of the port is no time on the
    /// wire.
    pub(super) fn loads(&self, grid: Grid) -> [f64; 2] {
        let wire = ProfibusPlan { bits: Bits { latency_ns: 0, ..self.bits }, ..self.clone() };
        let divisor = |drive: &LenzeDrive| u64::from(drive.axis.divisor.max(1));
        let cycles = self.drives.iter().map(divisor).max().unwrap_or(1);
        let round_ns = (cycles * grid.period_ns.max(1)) as f64;
        let turns =
            self.drives.iter().enumerate().map(|(index, drive)| {
                wire.usual_turn_ns(index) as f64 * cycles as f64 / divisor(drive) as f64
            });
        let (usual, room) = (turns.sum::<f64>(), wire.room_ns(grid));
        [usual, usual + (room.before + room.more) as f64].map(|ns| 100.0 * ns / round_ns)
    }

    /// Lays the turns on the grid, round after round, each of them with its room at its begin.
    fn lay(&self, grid: Grid) -> Result<(), Late> {
        let divisors = || self.drives.iter().map(|drive| u64::from(drive.axis.divisor.max(1)));
        let round = divisors().max().unwrap_or(1);
        let every = divisors().fold(1, lcm);
        if every > MOST_CYCLES {
            // The worst is that all are due at once.
            let mut plan = self.clone();
            plan.drives.iter_mut().for_each(|drive| drive.axis.phase = 0);
            return Layout::new(&plan, grid).round(0, round);
        }
        let mut layout = Layout::new(self, grid);
        for cycle in 0..every {
            layout.cycle(cycle)?;
        }
        // From now on it repeats itself.
        for cycle in every..2 * every {
            if layout.due(cycle).next().is_some() {
                layout.clone().round(cycle, round)?;
            }
            layout.cycle(cycle)?;
        }
        Ok(())
    }

    /// The room of a round: a request that nobody answers, or what the master sends in its place, and what one turn is
    /// longer if it is acyclic.
    fn room_ns(&self, grid: Grid) -> Room {
        let silent =
            self.drives.iter().filter_map(LenzeDrive::exchange).map(|bytes| self.silent_ns(bytes)).max();
        let more = |(index, drive): (usize, &LenzeDrive)| {
            let usual = self.usual_turn_ns(index);
            let others = drive.others().map(|bytes| self.answered_ns(bytes).saturating_sub(usual));
            others.into_iter().chain([self.acyclic_more_ns(drive, usual)]).max()
        };
        Room {
            before: silent.unwrap_or(0).max(self.control_ns()).max(self.left_over_ns(grid)),
            more: self.drives.iter().enumerate().filter_map(more).max().unwrap_or(0),
        }
    }
}

/// An exchange is not over when the next one of its drive is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Late {
    drive: usize,
    /// It is over so long after its slot.
    after_ns: u64,
}

#[derive(Clone, Copy, Debug)]
struct Room {
    /// Before the first turn of the round.
    before: u64,
    /// The first turn is longer.
    more: u64,
}

/// Turns on the grid, in the order in which the bus gives them.
#[derive(Clone, Debug)]
struct Layout<'a> {
    plan: &'a ProfibusPlan,
    grid: Grid,
    turns: Vec<u64>,
    /// Since when each drive waits.
    queued: Vec<Option<u64>>,
    /// No turn of each drive begins before.
    not_before: Vec<u64>,
    next: usize,
    free: u64,
    room: Option<Room>,
}

impl Layout<'_> {
    fn new(plan: &ProfibusPlan, grid: Grid) -> Layout<'_> {
        let turns: Vec<u64> = (0..plan.drives.len()).map(|index| plan.usual_turn_ns(index)).collect();
        let (queued, not_before) = (vec![None; turns.len()], vec![0; turns.len()]);
        Layout { plan, grid, queued, not_before, turns, next: 0, free: 0, room: None }
    }

    fn due(&self, cycle: u64) -> impl Iterator<Item = usize> {
        let drives = self.plan.drives.iter().enumerate();
        let is_due = move |axis: &fieldbeat_core::axis::AxisPlan| {
            cycle % u64::from(axis.divisor.max(1)) == u64::from(axis.phase)
        };
        drives.filter(move |(_, drive)| is_due(&drive.axis)).map(|(index, _)| index)
    }

    /// The round of so many cycles that begins in this one, and has its room.
    fn round(mut self, first: u64, cycles: u64) -> Result<(), Late> {
        self.room = Some(self.plan.room_ns(self.grid));
        for cycle in first..first + cycles {
            self.cycle(cycle)?;
            if self.queued.iter().all(Option::is_none) {
                return Ok(());
            }
        }
        let waits = self.queued.iter().enumerate().find_map(|(index, since)| Some((index, (*since)?)));
        waits.map_or(Ok(()), |(drive, since)| Err(Late { drive, after_ns: self.free.saturating_sub(since) }))
    }

    /// Enters the exchanges that begin in this cycle.
    fn cycle(&mut self, cycle: u64) -> Result<(), Late> {
        let begin = cycle * self.grid.period_ns;
        for index in self.due(cycle).collect::<Vec<_>>() {
            if let Some(since) = self.queued[index].replace(begin) {
                return Err(Late { drive: index, after_ns: begin - since });
            }
        }
        self.free = self.free.max(begin);
        let before = self.room.as_ref().map_or(0, |room| room.before);
        if before > 0 {
            self.room.iter_mut().for_each(|room| room.before = 0);
            self.free = self.grid.in_window(self.free) + before;
        }
        let mut served = false;
        loop {
            self.free = self.grid.in_window(self.free);
            if self.free >= begin + self.grid.period_ns {
                return Ok(());
            }
            let waits = |index: &usize| self.queued[*index].is_some();
            let count = self.turns.len();
            let mut order = (self.next..count).chain(0..self.next.min(count)).filter(waits);
            if let Some(index) = order.clone().find(|index| self.not_before[*index] <= self.free) {
                self.turn(index)?;
                served = true;
            } else if let Some(earliest) = order.by_ref().map(|index| self.not_before[index]).min() {
                self.free = earliest;
            } else {
                break;
            }
        }
        if served && self.plan.token && self.free < begin + self.grid.deadline_ns {
            self.free += self.plan.token_ns();
        }
        Ok(())
    }

    fn turn(&mut self, index: usize) -> Result<(), Late> {
        let more = self.room.take().map_or(0, |room| room.more);
        self.not_before[index] = self.free + self.plan.drives[index].min_slave_interval_ns;
        self.free += self.turns[index] + more;
        self.next = index + 1;
        let Some(since) = self.queued[index].take() else { return Ok(()) };
        let after_ns = self.free - since;
        let divisor = u64::from(self.plan.drives[index].axis.divisor.max(1));
        if self.grid.cycles_behind(after_ns) >= divisor {
            return Err(Late { drive: index, after_ns });
        }
        Ok(())
    }
}

fn lcm(a: u64, b: u64) -> u64 {
    let (mut x, mut y) = (a, b);
    while y > 0 {
        (x, y) = (y, x % y);
    }
    (a / x.max(1)).saturating_mul(b)
}

#[cfg(test)]
mod tests;
