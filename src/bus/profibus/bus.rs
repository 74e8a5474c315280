//! All drives of one PROFIBUS wire: stations, the link layer and the port, as a [`Bus`].
//!
//! What is due is queued, and has its turn in the order of the plan, round and round. The next telegram leaves when the
//! one before is closed and the wire was idle, in `send` or in `poll`, as long as the window lasts. Global_Control, a
//! token and a search for other masters follow when the round is over; Global_Control does not wait for that for ever.

use std::os::fd::RawFd;
use std::sync::Arc;

use super::counters::Own;
use super::line::{Heard, Instead, Job, Line, Ready, Unrelated};
use super::notes::{Known, WireNotes};
use super::plan::ProfibusPlan;
use super::station::Station;
use super::wire::dp::GlobalControl;
use super::wire::sap::global_control;
use crate::bus::{Bus, Cycle, Ends, Exchange, Notes, OpenError, Slot, Unmatched};
use crate::net::{Broken, Carriers, Lock, Place, Serial};
use crate::rt::Regions;
use crate::time::{S, Time};

/// Steps of the wire in one call: a telegram and what follows from it each.
const MOST_STEPS: usize = 16;
/// Readings of the port in one call, and telegrams in one reading: what does not fit waits for the next one.
const MOST_READS: usize = 4;
const MOST_TELEGRAMS: usize = 32;
/// So many tokens of another master in a row are one: of all telegrams they alone have no check byte.
const TOKENS: u8 = 2;
/// A master that was not received for so long is gone, ns.
const OTHER_GONE_NS: u64 = S;
/// Cycles that the orderly end may wait for one telegram.
const END_WITHIN: u32 = 100;
/// After something that answers nothing, or a silent slot time, the wire is looked at before anything is sent, for so
/// many cycles. Otherwise what arrives is seen with the next answer, which it cannot be taken for.
const WATCHFUL: u16 = 1_000;

/// A wire and its drives.
pub(super) struct ProfibusBus {
    name: String,
    /// The drives whose exchange is queued, those that start up, a bit each.
    queued: u128,
    starting: u128,
    /// The drive whose turn is next.
    next: u8,
    /// The drive whose turn was last: what belongs to nobody is counted for it.
    last: u8,
    /// So many turns come before one may be acyclic again: each round has room for one.
    acyclic_after: usize,
    /// A drive is in Data_Exchange: Global_Control is sent.
    operates: bool,
    /// When Global_Control is due.
    control_at: Time,
    control_every_ns: u64,
    /// A round of turns has ended: a token is due.
    round_over: bool,
    token: bool,
    /// Rounds until the next search, and the address that it is for.
    gap: Option<u32>,
    rounds: u32,
    gap_address: u8,
    highest: u8,
    /// The wire is looked at before anything is sent: always, or in so many cycles more.
    always_looks: bool,
    watchful: u16,
    /// When the telegram under way began.
    began_at: Time,
    /// The slot of the grid.
    grid: Time,
    line: Line,
    stations: Vec<Station>,
    net: Box<dyn Serial>,
    /// The own slots of each drive: divisor and phase.
    own_slots: Vec<(u64, u64)>,
    /// Of the telegrams of another master: its address, how many in a row, and the slot of the newest.
    other: Option<(u8, u8)>,
    other_at: Time,
    end: End,
    waits: u32,
    notes: WireNotes,
    ends: Ends,
    unmatched: Unmatched,
    /// The port is this master's until it is closed.
    _lock: Lock,
}

/// How far the orderly end is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// It has not begun.
    None,
    /// Global_Control with Clear is next.
    Clear,
    /// This drive is unlocked next.
    Unlock(u8),
    Over,
}

impl std::fmt::Debug for ProfibusBus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ProfibusBus").field("name", &self.name).field("drives", &self.stations.len()).finish()
    }
}

impl ProfibusBus {
    /// Begins to open the port of `plan`, which is free of faults.
    pub(super) fn open(plan: &ProfibusPlan, carriers: &dyn Carriers) -> Result<ProfibusBus, OpenError> {
        let lock = carriers.lock(Place::Port(&plan.device)).map_err(|why| OpenError::InUse {
            bus: plan.name.clone(),
            what: plan.device.clone(),
            why,
        })?;
        let (mut stations, mut ends) = (Vec::new(), Ends::default());
        for drive in &plan.drives {
            let broken = || OpenError::Plan { bus: plan.name.clone(), drive: drive.axis.name.clone() };
            let (station, native, acyclic) = Station::new(drive, plan.address).ok_or_else(broken)?;
            stations.push(station);
            ends.push(native, acyclic);
        }
        let net = carriers.serial(&plan.device, &plan.line()).map_err(|source| OpenError::Interface {
            bus: plan.name.clone(),
            interface: plan.device.clone(),
            source,
            remedy: "look at device: a serial port, like \"/dev/ttyS1\"",
        })?;
        let known = |drive: &super::plan::LenzeDrive| Known {
            address: drive.address,
            ident: drive.ident,
            configuration: drive.configuration.clone(),
        };
        let known = plan.drives.iter().map(known).collect();
        let own_slot = |drive: &super::plan::LenzeDrive| (drive.axis.divisor.into(), drive.axis.phase.into());
        Ok(ProfibusBus {
            name: plan.name.clone(),
            queued: 0,
            starting: 0,
            next: 0,
            last: 0,
            acyclic_after: 0,
            operates: false,
            control_at: Time(0),
            control_every_ns: plan.global_control_ns,
            round_over: false,
            token: plan.token,
            gap: plan.gap,
            rounds: 0,
            gap_address: plan.address,
            highest: plan.highest_address,
            // What an adapter holds back, or returns, is no sign of what is on the wire.
            always_looks: plan.echo || plan.bits.latency_ns > 0,
            watchful: 0,
            began_at: Time(0),
            grid: Time(0),
            line: Line::new(plan),
            stations,
            own_slots: plan.drives.iter().map(own_slot).collect(),
            other: None,
            other_at: Time(0),
            end: End::None,
            waits: 0,
            notes: WireNotes::new(&plan.device, known, net.notes()),
            net,
            ends,
            unmatched: Unmatched::default(),
            _lock: lock,
        })
    }

    /// Takes over a port that was opened.
    #[cold]
    fn opened(&mut self, now: Time) {
        let is_timed = self.net.is_timed();
        self.line.opened(now, is_timed);
        self.always_looks |= !is_timed;
        if self.net.discard().is_err() {
            self.unmatched.errors += 1;
        }
    }

    /// The port can no longer be used.
    #[cold]
    fn broken(&mut self, broken: Broken, slots: &mut [Slot]) {
        self.line.closed();
        if broken == Broken::Absent {
            return;
        }
        let why = match broken {
            Broken::Closed => "the other end has closed it",
            _ => "the port has failed: look at its adapter",
        };
        self.net.abandon(0, why);
        (self.queued, self.starting, self.operates) = (0, 0, false);
        for (station, slot) in self.stations.iter_mut().zip(slots) {
            station.cut_off(slot);
        }
    }

    /// Takes in what has arrived before something is sent, unless nothing is likely to have.
    #[inline]
    fn look(&mut self, slots: &mut [Slot]) {
        if self.always_looks || self.watchful > 0 || !self.line.is_free() {
            self.take_in(slots);
        }
    }

    /// Takes in what has arrived.
    fn take_in(&mut self, slots: &mut [Slot]) {
        for _ in 0..MOST_READS {
            let room = self.line.room();
            let size = room.len();
            match self.net.receive(0, room) {
                Ok(None) => return,
                Ok(Some((at, count))) => {
                    self.line.received(at, count);
                    self.hear(at, slots);
                    // A whole telegram, and no more of it.
                    if count < size {
                        return;
                    }
                }
                Err(broken) => return self.broken(broken, slots),
            }
        }
    }

    /// What has arrived by `at`, telegram by telegram.
    #[inline]
    fn hear(&mut self, at: Time, slots: &mut [Slot]) {
        for _ in 0..MOST_TELEGRAMS {
            let Some(heard) = self.line.heard(at) else { return };
            match heard {
                Heard::Answer(Job::Drive(index), answer) => {
                    let place = usize::from(index);
                    let (Some(station), Some(slot)) = (self.stations.get_mut(place), slots.get_mut(place))
                    else {
                        continue;
                    };
                    slot.counters.own[Own::WireUs as usize] += at.since(self.began_at) / 1_000;
                    let usual = station.exchanges() && !station.starts();
                    station.answered(at, answer, slot);
                    // The answer to its first exchange ends the start-up.
                    if !usual || station.starts() {
                        self.changed(index);
                    }
                }
                Heard::Answer(Job::Own | Job::Gap(_), _) => {}
                other => {
                    let unusual = Unusual::of(&other);
                    self.unusual(unusual, slots);
                }
            }
        }
    }

    /// A drive has come a step further in its start-up, or begins it.
    #[cold]
    fn changed(&mut self, index: u8) {
        let Some(station) = self.stations.get(usize::from(index)) else { return };
        let bit = 1_u128 << (index & 0x7F);
        self.starting = if station.starts() { self.starting | bit } else { self.starting & !bit };
        self.notes.set(index.into(), station.note());
        if station.exchanges() && station.starts() {
            // Its outputs count from the next Global_Control on.
            (self.operates, self.control_at) = (true, Time(0));
        }
    }

    /// Something arrived that answers nothing. It counts for its sender, or for the drive whose turn was last.
    #[cold]
    fn unusual(&mut self, what: Unusual, slots: &mut [Slot]) {
        self.watchful = WATCHFUL;
        let sender = |address: u8| self.stations.iter().position(|station| station.address() == address);
        let place = match what {
            Unusual::Telegram(_, Some(address)) => sender(address),
            _ => None,
        };
        let place = place.unwrap_or(self.last.into());
        let again = self.stations.get(place).is_some_and(Station::was_answered);
        let Some(counters) = slots.get_mut(place).map(|slot| &mut slot.counters) else { return };
        match what {
            Unusual::Garbage(why, expected) => {
                if expected {
                    counters.malformed += 1;
                    why.count(counters);
                } else {
                    self.unmatched_noise(slots);
                }
            }
            Unusual::Telegram(why, _) => {
                match why {
                    Unrelated::Station => Own::WrongStation,
                    Unrelated::Kind => Own::WrongAnswer,
                    Unrelated::Late => Own::OtherJob,
                }
                .count(counters);
                match why {
                    // It has answered already.
                    Unrelated::Late if again => counters.duplicate += 1,
                    Unrelated::Late => counters.late += 1,
                    Unrelated::Station | Unrelated::Kind => counters.foreign += 1,
                }
            }
            Unusual::OtherMaster(address, is_token) => self.other_master(address, is_token, slots),
        }
    }

    fn unmatched_noise(&mut self, slots: &mut [Slot]) {
        if let Some(slot) = slots.get_mut(usize::from(self.last)) {
            Own::Noise.count(&mut slot.counters);
        }
        self.unmatched.datagrams += 1;
    }

    /// A telegram of another master. Before the first own one the wire is its; afterwards it is this master's, and the
    /// axes stop.
    fn other_master(&mut self, address: u8, is_token: bool, slots: &mut [Slot]) {
        if let Some(slot) = slots.get_mut(usize::from(self.last)) {
            Own::SecondMaster.count(&mut slot.counters);
        }
        self.unmatched.datagrams += 1;
        let tokens = match self.other {
            Some((before, tokens)) if before == address => tokens.saturating_add(1),
            _ => 1,
        };
        (self.other, self.other_at) = (Some((address, tokens)), self.grid);
        if is_token && tokens < TOKENS {
            return;
        }
        self.notes.set_other(Some(address));
        if self.line.is_up() {
            slots.iter_mut().for_each(|slot| slot.notices.other_master = true);
        }
    }

    /// Continues with what is due at `now`.
    fn go_on(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) {
        for _ in 0..MOST_STEPS {
            match self.line.ready(now) {
                Ready::Wait => return,
                Ready::Free => {
                    if !self.start_next(cycle, now, slots) {
                        return;
                    }
                }
                Ready::Resend => {
                    if !self.hand_over(slots) {
                        return;
                    }
                }
                Ready::Claim => {
                    self.hand_over(slots);
                    return;
                }
                Ready::Overdue { job, instead, failed } => {
                    if !self.overdue(now, job, instead, failed, slots) {
                        return;
                    }
                }
            }
        }
    }

    /// Hands the telegram to the driver; false: none of it has left.
    fn hand_over(&mut self, slots: &mut [Slot]) -> bool {
        match self.net.send(0, self.line.to_send()) {
            Ok((at, count)) => self.line.sent(at, count),
            Err(broken) => {
                self.broken(broken, slots);
                false
            }
        }
    }

    /// The request of `job` has no answer. False: it has not left the driver yet.
    #[cold]
    fn overdue(&mut self, now: Time, job: Job, instead: Instead, failed: bool, slots: &mut [Slot]) -> bool {
        if instead == Instead::Silence
            && let Ok(bytes @ 1..) = self.net.unsent()
        {
            self.line.still_sends(now, bytes, failed);
            return false;
        }
        let Job::Drive(index) = job else { return true };
        self.watchful = WATCHFUL;
        let place = usize::from(index);
        let (Some(station), Some(slot)) = (self.stations.get_mut(place), slots.get_mut(place)) else {
            return true;
        };
        match instead {
            Instead::Silence => Own::SlotTimes.count(&mut slot.counters),
            Instead::Part => Own::WrongEnd.count(&mut slot.counters),
            Instead::Garbage => {}
        }
        if failed {
            slot.counters.own[Own::WireUs as usize] += now.since(self.began_at) / 1_000;
            station.failed(slot);
            self.changed(index);
        } else {
            Own::Retries.count(&mut slot.counters);
        }
        true
    }

    /// Sends the next telegram; false: there is none, or it did not leave.
    #[inline]
    fn start_next(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) -> bool {
        if self.operates && now >= self.control_at {
            // Behind a round of the drives, as long as it is not late.
            let late = now >= self.control_at + self.control_every_ns;
            if self.queued == 0 || late {
                return self.control(now, GlobalControl::OPERATE, slots);
            }
        }
        if self.queued == 0 {
            return self.round_over && self.search(cycle, now, slots);
        }
        let behind = self.queued >> self.next;
        if behind == 0 {
            self.next = 0;
            return true;
        }
        let index = self.next + behind.trailing_zeros() as u8;
        self.queued &= !(1 << index);
        self.next = (index + 1) & 0x7F;
        self.last = index;
        if self.queued == 0 {
            self.round_over = true;
        }
        let place = usize::from(index);
        let (Some(station), Some(slot)) = (self.stations.get_mut(place), slots.get_mut(place)) else {
            return true;
        };
        if slot.exchange != Exchange::Queued {
            return true;
        }
        let may_be_acyclic = self.acyclic_after == 0;
        if !self.line.request(index, |out| station.request(slot, may_be_acyclic, out)) {
            station.unsent(slot);
            return true;
        }
        match self.net.send(0, self.line.to_send()) {
            Ok((at, count)) => {
                if self.line.sent(at, count) {
                    self.began_at = at;
                    self.acyclic_after = match station.is_acyclic() {
                        true => self.own_slots.len() - 1,
                        false => self.acyclic_after.saturating_sub(1),
                    };
                    let within = at + self.line.closed_within_ns();
                    let more = within.since(cycle.deadline).div_ceil(cycle.period_ns.max(1));
                    station.sent(at, cycle.deadline + more * cycle.period_ns, slot);
                    return true;
                }
                station.unsent(slot);
                true
            }
            Err(broken) => {
                station.unsent(slot);
                self.broken(broken, slots);
                false
            }
        }
    }

    /// Tells all drives that what they are sent counts, or not.
    #[cold]
    fn control(&mut self, now: Time, command: u8, slots: &mut [Slot]) -> bool {
        self.control_at = now + self.control_every_ns;
        let data = GlobalControl { command, groups: 0 }.data();
        self.line.broadcast(&global_control(self.line.address()), &data) && self.hand_over(slots)
    }

    /// In what is left of a round: a token, or a search for another master.
    #[cold]
    fn search(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) -> bool {
        self.round_over = false;
        if now >= cycle.deadline {
            return false;
        }
        self.rounds += 1;
        if self.gap.is_some_and(|every| self.rounds >= every) {
            self.rounds = 0;
            if let Some(address) = self.next_gap() {
                self.line.gap(address);
                return self.hand_over(slots);
            }
        }
        if !self.token {
            return false;
        }
        self.line.token();
        self.hand_over(slots)
    }

    /// The next address at which no drive of the plan is.
    fn next_gap(&mut self) -> Option<u8> {
        let own = self.line.address();
        for _ in 0..=self.highest {
            let after = self.gap_address + 1;
            self.gap_address = if after >= self.highest.min(126) { 0 } else { after };
            let taken = self.stations.iter().any(|station| station.address() == self.gap_address);
            if self.gap_address != own && !taken {
                return Some(self.gap_address);
            }
        }
        None
    }

    /// Those that start up have their turns in their own slots, whatever their link.
    #[cold]
    fn let_start(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        let next = cycle.index + 1;
        for (index, (slot, (divisor, phase))) in slots.iter_mut().zip(&self.own_slots).enumerate() {
            if self.starting >> index & 1 != 0 && next % divisor.max(&1) == *phase {
                slot.reachable = true;
            }
        }
    }
}

/// What arrived and answers nothing.
#[derive(Clone, Copy, Debug)]
enum Unusual {
    Garbage(Own, bool),
    Telegram(Unrelated, Option<u8>),
    /// Its address, and whether it was a token.
    OtherMaster(u8, bool),
}

impl Unusual {
    fn of(heard: &Heard<'_>) -> Unusual {
        match *heard {
            Heard::Malformed { ref why, expected } => Unusual::Garbage(Own::of(why), expected),
            Heard::Unrelated(why, from) => Unusual::Telegram(why, from),
            Heard::OtherMaster { address, is_token } => Unusual::OtherMaster(address, is_token),
            Heard::Answer(..) => Unusual::Telegram(Unrelated::Late, None),
        }
    }
}

impl Bus for ProfibusBus {
    fn name(&self) -> &str {
        &self.name
    }

    fn memory(&self, regions: &mut Regions) {
        regions.add(self);
        self.net.memory(regions);
        self.notes.memory(regions);
        regions.add(&*self.own_slots);
        regions.add(&*self.stations);
        self.stations.iter().for_each(|station| station.memory(regions));
    }

    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.grid = cycle.grid;
        if self.net.opened().is_some() {
            self.opened(cycle.grid);
        }
        self.look(slots);
        self.watchful = self.watchful.saturating_sub(1);
        let up = self.line.is_up();
        for (index, (station, slot)) in self.stations.iter_mut().zip(slots.iter_mut()).enumerate() {
            // One that is queued stays so: here it is made sure of, after a panic in its turn for example.
            let waits = matches!(slot.exchange, Exchange::Idle | Exchange::Missed | Exchange::Queued);
            if !slot.due || !waits {
                continue;
            }
            if up && self.end == End::None {
                slot.exchange = Exchange::Queued;
                self.queued |= 1 << (index & 0x7F);
            } else {
                station.unsent(slot);
            }
        }
        self.go_on(cycle, cycle.grid, slots);
        if self.starting != 0 {
            self.let_start(cycle, slots);
        }
        if self.other.is_some() && cycle.grid.since(self.other_at) > OTHER_GONE_NS {
            self.other = None;
            self.notes.set_other(None);
        }
    }

    fn receive(&mut self, _cycle: &Cycle, slots: &mut [Slot]) {
        self.take_in(slots);
    }

    fn poll_at(&self) -> Option<Time> {
        self.line.look_at(self.queued != 0 || self.round_over)
    }

    fn waited_for(&self, cycle: &Cycle, slots: &[Slot]) -> usize {
        let waits = self.line.waits_for().and_then(|index| slots.get(usize::from(index)));
        usize::from(waits.is_some_and(|slot| slot.exchange.is_waited_for(cycle)))
    }

    fn poll(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) {
        self.look(slots);
        self.go_on(cycle, now, slots);
    }

    fn prepare(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        for (station, slot) in self.stations.iter_mut().zip(slots) {
            if slot.due || slot.exchange == Exchange::Queued {
                station.prepare(cycle, slot);
            }
        }
    }

    fn shut_down(&mut self, cycle: &Cycle, slots: &mut [Slot]) -> bool {
        let now = cycle.deadline;
        self.take_in(slots);
        self.waits += 1;
        if !self.line.is_up() || self.waits > END_WITHIN {
            self.end = End::Over;
        }
        match self.line.ready(now) {
            _ if self.end == End::Over => return true,
            Ready::Overdue { job, instead, failed } => {
                self.overdue(now, job, instead, failed, slots);
                return false;
            }
            Ready::Resend => {
                self.hand_over(slots);
                return false;
            }
            Ready::Wait | Ready::Claim => return false,
            Ready::Free => self.waits = 0,
        }
        self.end = match self.end {
            End::None => End::Clear,
            End::Clear => {
                self.control(now, GlobalControl::CLEAR, slots);
                End::Unlock(0)
            }
            End::Unlock(index) => {
                let Some(station) = self.stations.get_mut(usize::from(index)) else { return true };
                if station.unlocks() && self.line.request(index, |out| station.unlock(out)) {
                    self.hand_over(slots);
                }
                End::Unlock(index + 1)
            }
            End::Over => End::Over,
        };
        for slot in slots.iter_mut() {
            slot.expected_silence = true;
        }
        self.end == End::Over
    }

    fn unmatched(&self) -> Unmatched {
        self.unmatched
    }

    fn helper_ended(&self) -> bool {
        self.net.has_ended()
    }

    fn notes(&self) -> Option<Arc<dyn Notes>> {
        Some(Arc::new(self.notes.clone()))
    }

    fn ends(&mut self) -> Option<&mut Ends> {
        Some(&mut self.ends)
    }
}
