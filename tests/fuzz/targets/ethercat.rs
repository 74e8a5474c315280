//! A segment whose frames come back as they like.
//!
//! The rig does what the loop does: it prepares, sends, takes in, judges. Behind the carrier is a simulated segment of
//! two drives, whose processors have their SIIs and want them back before PREOP, and a terminal without a processor,
//! whose outputs are registers; the bytes choose commands, and what becomes of the frames: lost, late, twice, cut off,
//! with other bytes here and there, circulated, or somebody else's. What has to hold stands in the checks behind each
//! step; they know the frames and what is desired, and nothing of how the bus keeps its books: what is written is what
//! is desired, and a drive has answered only if a frame came that is the one that was sent, and its own part of it says
//! what is reported.

use std::collections::VecDeque;
use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::{Arc, Mutex, MutexGuard};

use fieldbeat::Cycle;
use fieldbeat::axis::{Command, Link, NativeOwner};
use fieldbeat::bus::BusPlan;
use fieldbeat::bus::ethercat::{
    Area, Device, EthercatPlan, Family, KollmorgenDrive, SlavePlan, Terminals, Watchdog,
};
use fieldbeat::sim::SimSegment;
use fieldbeat::time::{MS, Time, US};
use fieldbeat_core::bus::cia402::ControlWord;
use fieldbeat_core::bus::desired::{Desired, Motion, Power};
use fieldbeat_core::bus::{Bus, DriveEnds, Exchange, Opened, Slot};
use fieldbeat_core::net::frames::{MAC, Unsent};
use fieldbeat_core::net::{Carriers, Datagrams, Frames, UdpOptions};
use fieldbeat_core::rt::Regions;
use fieldbeat_ethercat::image::{Read, returned};
use fieldbeat_ethercat::wire::frame::{Command as DatagramCommand, Datagram, datagrams};
use fieldbeat_sim::ethercat::{EthercatSegment, EthercatSim, SiiSettings, SlaveSettings};

use super::commanded::Commanded;
use super::commands::command;
use super::input::Input;

const PERIOD_NS: u64 = MS;
const DRIVES: usize = 2;
/// Outputs of a drive, and AL status and inputs: 1702h, 1B03h.
const OUTPUTS: usize = 6;
const INPUTS: usize = 2 + 8;
/// Outputs of the terminal behind them.
const TERMINAL: usize = 1;
/// Increments of one turn.
const INCREMENTS: f64 = (1_u64 << 20) as f64;
/// In so many cycles an undisturbed line is up.
const UP: u32 = 2_000;

pub fn ethercat(data: &[u8]) {
    let mut input = Input(data);
    let mut rig = Rig::new();
    // Half of the programs disturb the bring-up.
    if input.flag() {
        rig.bring_up();
    }
    while !input.is_over() {
        rig.step(&mut input);
    }
}

/// The cable, and the line behind it.
struct Cable {
    line: EthercatSim,
    now: Time,
    /// What was sent last, and what came back of it and of those before.
    sent: Vec<u8>,
    before: VecDeque<Vec<u8>>,
    /// On the way to the master.
    inbox: VecDeque<Vec<u8>>,
    /// What the master has taken in since this was last looked at.
    taken: Vec<Vec<u8>>,
    /// It takes nothing.
    down: bool,
}

#[derive(Clone)]
struct Shared(Arc<Mutex<Cable>>);

impl Shared {
    fn get(&self) -> MutexGuard<'_, Cable> {
        self.0.lock().unwrap()
    }
}

impl Carriers for Shared {
    fn datagrams(&self, _: SocketAddrV4, _: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Err(io::ErrorKind::Unsupported.into())
    }

    fn frames(&self, _: &str, _: u16) -> io::Result<Box<dyn Frames>> {
        Ok(Box::new(self.clone()))
    }
}

impl Frames for Shared {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let mut cable = self.get();
        if cable.down {
            return Err(Unsent::Down);
        }
        let (now, mut back) = (cable.now, frame.to_vec());
        cable.sent = frame.to_vec();
        cable.line.pass(now, &mut back);
        cable.before.push_front(back);
        cable.before.truncate(4);
        Ok(now)
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        let mut cable = self.get();
        let frame = cable.inbox.pop_front()?;
        let length = frame.len().min(room.len());
        room[..length].copy_from_slice(&frame[..length]);
        let reported = frame.len();
        cable.taken.push(frame);
        Some((cable.now, reported))
    }

    fn now(&mut self) -> Time {
        self.get().now
    }

    fn mac(&self) -> [u8; 6] {
        MAC
    }

    fn memory(&self, _: &mut Regions) {}
}

struct Rig {
    bus: Box<dyn Bus>,
    _drives: Vec<DriveEnds>,
    cable: Shared,
    machines: [Commanded; DRIVES],
    slots: [Slot; DRIVES],
    cycle: Cycle,
    terminal: Terminals,
    /// Its newest outputs.
    output: u8,
}

impl Rig {
    fn new() -> Rig {
        let drive = |place: u16| {
            let mut drive = KollmorgenDrive::new(format!("d{place}"), place, Family::S700);
            drive.slave.watchdog = Watchdog::After(100 * MS);
            drive
        };
        let mut plan = EthercatPlan::new("local:fuzz", (0..DRIVES as u16).map(drive).collect());
        let area = |start| vec![Area { start, length: TERMINAL as u16 }];
        let place = DRIVES as u16;
        let slave = SlavePlan { outputs: area(0x0F00), inputs: area(0x1000), ..SlavePlan::new(place) };
        plan.devices.push(Device { name: "io".into(), slave });
        let mut segment = EthercatSegment::from(&plan);
        let sii = SiiSettings { owned_by_slave: true, read_in_preop: true, ..SiiSettings::default() };
        let own = SlaveSettings { sii, ..SlaveSettings::default() };
        segment.settings.slaves.extend((0..place).map(|place| (place, own.clone())));
        let cable = Shared(Arc::new(Mutex::new(Cable {
            line: EthercatSim::new(&segment),
            now: Time(0),
            sent: Vec::new(),
            before: VecDeque::new(),
            inbox: VecDeque::new(),
            taken: Vec::new(),
            down: false,
        })));
        let slot = || Slot { due: true, link: Link::Online, ..Slot::default() };
        let grid = Time(1_000 * PERIOD_NS);
        let Opened { bus, mut ends, .. } = BusPlan::open(&plan, PERIOD_NS, &cable).expect("there is a cable");
        let terminal = ends.devices.remove(0).native.downcast().expect("it is a terminal");
        Rig {
            bus,
            _drives: ends.drives,
            terminal: *terminal,
            output: 0,
            cable,
            machines: std::array::from_fn(|index| Commanded::new(&plan, index, PERIOD_NS)),
            slots: std::array::from_fn(|_| slot()),
            cycle: Cycle { index: 0, grid, period_ns: PERIOD_NS, deadline: grid + PERIOD_NS / 2 },
        }
    }

    fn bring_up(&mut self) {
        for _ in 0..UP {
            self.turn(|cable| {
                let back = cable.before.front().cloned();
                cable.inbox.extend(back);
            });
        }
        assert!(self.slots.iter().all(|slot| slot.counters.answered > 0), "{:?}", self.slots);
        assert!(self.terminal.inputs().operational);
    }

    /// One command or none, and one cycle.
    fn step(&mut self, input: &mut Input<'_>) {
        match input.below(8) {
            0 => self.machines[input.below(DRIVES)].start(self.cycle.grid, Some(command(input))),
            1 => self.machines[input.below(DRIVES)].velocity(input.number()),
            2 => self.machines[0].start(self.cycle.grid, Some(Command::Enable)),
            3 => self.slots[input.below(DRIVES)].link = input.of(&[Link::Online, Link::Lost]),
            4 => self.cable.get().down = input.below(4) == 0,
            5 => {
                let place = input.below(DRIVES + 1);
                self.cable.get().line.cut((place < DRIVES).then_some(place));
            }
            6 => {
                self.output = self.output.wrapping_add(0x55);
                self.terminal.write(&[self.output; TERMINAL]).expect("it has so many");
            }
            _ => {}
        }
        self.turn(|cable| (0..input.below(4)).for_each(|_| deliver(cable, input)));
        self.cable.get().inbox.truncate(8);
    }

    fn turn(&mut self, deliver: impl FnOnce(&mut Cable)) {
        self.cycle.index += 1;
        self.cycle.grid = self.cycle.grid + PERIOD_NS;
        self.cycle.deadline = self.cycle.grid + PERIOD_NS / 2;
        for (machine, slot) in self.machines.iter_mut().zip(&mut self.slots) {
            machine.propose(self.cycle.grid, slot);
        }
        self.bus.prepare(&self.cycle, &mut self.slots);
        self.at(5 * US);
        let before = self.slots.clone();
        self.cable.get().sent.clear();
        self.bus.send(&self.cycle, &mut self.slots);
        self.check_outputs();
        self.check_terminal();
        for (machine, slot) in self.machines.iter_mut().zip(&mut self.slots) {
            machine.commit(slot);
        }
        for (slot, before) in self.slots.iter().zip(&before) {
            // What comes too late says nothing of the drive.
            assert_eq!(slot.status.at, before.status.at);
            assert!(!matches!(slot.exchange, Exchange::Answered { .. }));
            let counted = slot.counters.sent + slot.counters.unsent;
            assert_eq!(counted, before.counters.sent + before.counters.unsent + 1);
        }
        deliver(&mut self.cable.get());
        self.cable.get().taken.clear();
        self.at(100 * US);
        self.bus.receive(&self.cycle, &mut self.slots);
        self.check();
        for (machine, slot) in self.machines.iter_mut().zip(&mut self.slots) {
            machine.observe(self.cycle.grid, slot);
            slot.counters.missed +=
                u64::from(matches!(slot.exchange, Exchange::Owed { .. } | Exchange::Absent { .. }));
            slot.exchange = Exchange::Idle;
            let counters = slot.counters;
            assert_eq!(counters.sent, counters.answered + counters.missed, "{counters:?}");
        }
    }

    fn at(&mut self, ns: u64) {
        self.cable.get().now = self.cycle.grid + ns;
    }

    /// What is written to a drive is what is desired of it.
    fn check_outputs(&self) {
        let cable = self.cable.get();
        for (index, slot) in self.slots.iter().enumerate() {
            let Some((control, setpoint)) = written(&cable.sent, index) else { continue };
            let Desired { power, motion, setpoint: wanted, .. } = slot.desired;
            if motion.value == Motion::Native(NativeOwner::Application) {
                continue;
            }
            let (runs, desired) = (power.value == Power::EnableOperation, &slot.desired);
            let may =
                |bits: u16, may: bool| assert!(may || !control.has(bits), "{control:?} for {desired:?}");
            may(ControlWord::SWITCH_ON, runs || power.value == Power::SwitchOn);
            may(ControlWord::ENABLE_OPERATION, runs);
            may(ControlWord::START, runs && motion.value == Motion::Home);
            may(ControlWord::FAULT_RESET, power.value == Power::FaultReset);
            let native = matches!(motion.value, Motion::Native(_));
            let moves = runs && wanted.velocity != 0.0;
            assert!(setpoint == 0 || moves || native, "{setpoint} for {desired:?}");
        }
    }

    /// What is written to the terminal is what the application wrote last, or nothing.
    fn check_terminal(&self) {
        let cable = self.cable.get();
        if let Some([output]) = image(&cable.sent, DRIVES * OUTPUTS, TERMINAL) {
            assert!([0, self.output].contains(output), "{output:#x}, and not {:#x}", self.output);
        }
    }

    /// Who has answered is in a frame that is the one that was sent; and what is reported of it, it has said there. Of
    /// several such frames any may be the one that was taken: others may have been refused for their counters.
    fn check(&self) {
        let cable = self.cable.get();
        for (index, slot) in self.slots.iter().enumerate() {
            if !matches!(slot.exchange, Exchange::Answered { .. }) {
                continue;
            }
            let said = |frame: &Vec<u8>| said(&cable.sent, frame, index);
            let said: Vec<(u16, u32)> = cable.taken.iter().filter_map(said).collect();
            assert!(!said.is_empty(), "drive {index} has not answered: {slot:?}");
            let position = slot.status.position;
            let reported = position.is_finite().then(|| (position * INCREMENTS).round() as i64 as u32);
            let is_it = |&(al, position): &(u16, u32)| {
                al & 0x0F != 0 && reported.is_none_or(|reported| reported == position)
            };
            assert!(said.iter().any(is_it), "drive {index} has said {said:?}, and not {reported:?}");
        }
    }
}

/// The control word and the setpoint for drive `index` in a frame that was sent; `None`: it has none.
fn written(sent: &[u8], index: usize) -> Option<(ControlWord, i32)> {
    let bytes = image(sent, index * OUTPUTS, OUTPUTS)?;
    let setpoint = i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    Some((ControlWord(u16::from_le_bytes([bytes[4], bytes[5]])), setpoint))
}

/// So many bytes of the process data in a frame, from there on.
fn image(sent: &[u8], from: usize, length: usize) -> Option<&[u8]> {
    let content = |datagram: Datagram<'_>| {
        let DatagramCommand::Lrw(_) = datagram.command()? else { return None };
        Some(datagram.place.data().start + from)
    };
    let at = datagrams(sent).ok()?.map_while(Result::ok).find_map(content)?;
    sent.get(at..at + length)
}

/// The AL status of drive `index` and its position in a frame that is the reply to `sent`; `None`: it is none.
fn said(sent: &[u8], frame: &[u8], index: usize) -> Option<(u16, u32)> {
    let (mut found, mut states) = (None, false);
    for datagram in datagrams(sent).ok()?.map_while(Result::ok) {
        let command = datagram.command()?;
        let stays = !states && !matches!(command, DatagramCommand::Brd(_));
        states |= matches!(command, DatagramCommand::Brd(_));
        let Read::Good(_) = returned(sent, frame, datagram.place, stays) else { return None };
        if matches!(command, DatagramCommand::Lrw(_)) {
            let at = datagram.place.data().start + DRIVES * OUTPUTS + TERMINAL + index * INPUTS;
            let bytes = frame.get(at..at + INPUTS)?;
            let position = u32::from_le_bytes([bytes[2], bytes[3], bytes[4], bytes[5]]);
            found = Some((u16::from_le_bytes([bytes[0], bytes[1]]), position));
        }
    }
    found
}

/// Something comes to the master: a reply, with this or that done to it, or anything.
fn deliver(cable: &mut Cable, input: &mut Input<'_>) {
    let age = if input.below(4) == 0 { input.below(4) } else { 0 };
    let Some(mut frame) = cable.before.get(age).cloned() else { return };
    match input.below(8) {
        0 => frame.truncate(input.below(256)),
        1 => {
            let bytes = input.below(32);
            frame = input.bytes(bytes).to_vec();
        }
        2 => {
            // Any bytes behind a header that is ours.
            frame.truncate(17);
            let count = 8 * input.below(12);
            frame.extend_from_slice(input.bytes(count));
        }
        3 => frame.extend_from_slice(input.bytes(3)),
        4 | 5 => {
            for _ in 0..input.below(8) {
                let (at, change) = (usize::from(input.word()) % frame.len().max(1), input.byte());
                if let Some(byte) = frame.get_mut(at) {
                    *byte ^= change;
                }
            }
        }
        6 => {
            // Other data in one of its datagrams, which is as it should be.
            let number = input.below(8);
            let places: Vec<_> = datagrams(&frame)
                .into_iter()
                .flatten()
                .map_while(Result::ok)
                .map(|datagram| datagram.place)
                .collect();
            if let Some(place) = places.get(number) {
                let bytes = input.bytes(place.length.min(24));
                frame[place.data()][..bytes.len()].copy_from_slice(bytes);
                let counter = place.data().end;
                frame[counter] ^= input.of(&[0, 0, 0, 1, 2, 3]);
            }
        }
        _ => {}
    }
    cable.inbox.push_back(frame);
}
