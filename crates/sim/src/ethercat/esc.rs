//! One slave: its controller and its firmware, and the effects of a datagram's commands (ETG.1000.4, 5.4).

use std::ops::Range;

pub use super::chip::Met;
use super::chip::{Chip, Misuse, Passage};
use super::codec::frame::{COUNTER, Command, HEADER};
use super::codec::registers::{AlState, address, feature};
use super::firmware::Firmware;
use super::hardware::Settings;
use super::slave::Left;
use super::{Application, Drive};
use fieldbeat_core::time::Time;

/// The cyclic unit is the master's, SYNC0 is on.
const SYNC0_ON: [u8; 2] = [0x00, 0x03];

/// A slave of the segment.
#[derive(Debug)]
pub struct Esc {
    links: [bool; 4],
    deaf: bool,
    chip: Chip,
    firmware: Firmware,
    /// The data that came with a command that reads first.
    sent: Vec<u8>,
}

impl Esc {
    /// Just powered on, in INIT.
    pub fn new(settings: Settings, application: Box<dyn Application>) -> Esc {
        Esc {
            chip: Chip::new(settings.clone(), settings.sii),
            firmware: Firmware::new(application),
            links: [false; 4],
            deaf: false,
            sent: Vec::new(),
        }
    }

    /// Sets registers and state as another master has left them.
    pub(super) fn leave(&mut self, left: &Left) {
        for (n, manager) in (0..).zip(&left.managers) {
            self.chip.write(address::sync_manager(n), manager);
        }
        for (n, fmmu) in (0..).zip(&left.fmmus) {
            self.chip.write(address::fmmu(n), fmmu);
        }
        self.chip.write(address::STATION, &left.station.to_le_bytes());
        if left.unwatched {
            self.chip.write(address::WATCHDOG, &[0; 2]);
        }
        if let Some(cycle_ns) = left.sync0_ns {
            // They have one time.
            let offset = self.chip.clock.own().wrapping_neg();
            self.chip.write(address::DC_OFFSET, &offset.to_le_bytes());
            let start = self.chip.clock.system_time() + u64::from(cycle_ns);
            self.chip.write(address::DC_CYCLE, &cycle_ns.to_le_bytes());
            self.chip.write(address::DC_START, &start.to_le_bytes());
            self.chip.write(address::DC_CONTROL, &SYNC0_ON);
        }
        if left.sii_failed {
            self.chip.eeprom.fail();
        }
        if left.sii_given {
            self.chip.give_sii();
        }
        let (status, code) = left.al;
        self.firmware.leave(&mut self.chip, status, code);
        self.chip.misuse = Misuse::default();
    }

    /// The state it is in.
    pub fn state(&self) -> AlState {
        self.firmware.state
    }

    /// Why it refused a state, or fell back, until that is acknowledged.
    pub fn error(&self) -> Option<u16> {
        self.firmware.error
    }

    /// The segment's time that it has at `now`, ns.
    pub fn system_time(&mut self, now: Time) -> u64 {
        self.chip.advance(now);
        self.chip.clock.system_time()
    }

    /// The time at `now` until its next SYNC0, ns; `None`: there is none.
    pub fn sync0_in_ns(&mut self, now: Time) -> Option<u64> {
        self.advance(now);
        self.chip.clock.left_to_sync()
    }

    /// The drive behind it, if it is one.
    pub fn drive(&mut self) -> Option<&mut Drive> {
        self.firmware.drive()
    }

    /// Misuse by a master since power-on.
    pub fn misuse(&self) -> Misuse {
        self.chip.misuse
    }

    /// How often a master met special properties since power-on.
    pub fn met(&self) -> Met {
        self.chip.met
    }

    /// The outputs that it drives; none as long as none count.
    pub fn driven(&self) -> &[u8] {
        &self.firmware.outputs
    }

    /// Outputs of another slave are at its inputs.
    pub(super) fn sense(&mut self, levels: &[u8]) {
        self.firmware.sense(levels);
    }

    /// Makes the slave forward frames without carrying them out, or ends that.
    pub fn deafen(&mut self, deaf: bool) {
        self.deaf = deaf;
    }

    /// Power cycle: everything is lost except its EEPROM.
    pub fn restart(&mut self, now: Time) {
        let sii = std::mem::take(&mut self.chip.eeprom.words);
        self.chip = Chip::new(std::mem::take(&mut self.chip.settings), sii);
        self.chip.link(self.links);
        self.firmware.restart(now);
    }

    /// Restarts the processor while the controller keeps its power: the slave is in INIT with all registers as they
    /// were.
    pub fn restart_firmware(&mut self, now: Time) {
        self.firmware.restart(now);
        self.firmware.show(&mut self.chip);
    }

    /// Advances to `now`, with or without a frame.
    pub fn advance(&mut self, now: Time) {
        self.chip.advance(now);
        while let Some(late_ns) = self.chip.clock.take_sync() {
            self.firmware.cycle(&mut self.chip, now - late_ns);
        }
        self.firmware.work(&mut self.chip, now);
    }

    /// Which of its ports have a link.
    pub(super) fn link(&mut self, ports: [bool; 4]) {
        self.links = ports;
        self.chip.link(ports);
    }

    /// The delay from the slave before it.
    pub(super) fn delay_ns(&self) -> u64 {
        self.chip.settings.delay_ns
    }

    /// Lets a frame with datagrams at these offsets pass.
    pub(super) fn pass(&mut self, passage: Passage, frame: &mut [u8], places: &[Range<usize>]) {
        let Passage { at, .. } = passage;
        self.advance(at);
        if self.deaf {
            return;
        }
        let is_synchronous = self.chip.clock.next_sync().is_some();
        let has_outputs = self.chip.managers.iter().any(|manager| manager.is_process(true));
        if !is_synchronous && (!has_outputs || self.chip.settings.emulated) {
            self.firmware.cycle(&mut self.chip, at);
        }
        self.chip.begin(passage);
        for place in places {
            if let Some(datagram) = frame.get_mut(place.clone()) {
                self.datagram(datagram);
            }
        }
        if std::mem::take(&mut self.chip.outputs) && !is_synchronous {
            self.firmware.cycle(&mut self.chip, at);
        }
        self.firmware.work(&mut self.chip, at);
    }

    /// Carries out one datagram.
    fn datagram(&mut self, datagram: &mut [u8]) {
        let Some((header, rest)) = datagram.split_first_chunk_mut::<HEADER>() else { return };
        let Some((data, counter)) = rest.split_last_chunk_mut::<COUNTER>() else { return };
        let [number, _, a, b, c, d, _, _, e, f] = *header;
        let Some(command) = Command::of(number) else { return };
        let [position, register, interrupts] = [[a, b], [c, d], [e, f]].map(u16::from_le_bytes);
        let done = self.execute(command, position, register, data);
        *counter = u16::from_le_bytes(*counter).wrapping_add(done).to_le_bytes();
        if command.counts_slaves() {
            header[2..4].copy_from_slice(&position.wrapping_add(1).to_le_bytes());
        }
        header[8..].copy_from_slice(&(interrupts | self.chip.interrupts()).to_le_bytes());
    }

    /// The slave's share of the working counter.
    fn execute(&mut self, command: Command, to: u16, at: u16, data: &mut [u8]) -> u16 {
        use Command::{Aprd, Aprw, Apwr, Armw, Brd, Brw, Bwr, Fprd, Fprw, Fpwr, Frmw, Lrd, Lrw, Lwr};
        let is_meant = match command {
            Aprd | Apwr | Aprw | Armw => to == 0,
            Fprd | Fpwr | Fprw | Frmw => self.chip.is_called(to),
            _ => true,
        };
        let logical = u32::from(to) | u32::from(at) << 16;
        match command {
            Aprd | Fprd | Armw | Frmw if is_meant => self.chip.read(at, data, false).into(),
            Apwr | Fpwr if !is_meant => 0,
            Apwr | Fpwr | Bwr | Armw | Frmw => self.chip.write(at, data).into(),
            Aprw | Fprw | Brw if is_meant => self.exchange(at, data, command == Brw),
            Brd => self.chip.read(at, data, true).into(),
            Lrd => self.chip.read_logical(logical, data).into(),
            Lwr => self.chip.write_logical(logical, data).into(),
            Lrw if self.chip.settings.features & feature::NO_LRW == 0 => {
                // The received data are written, not the read data.
                let written = self.chip.write_logical(logical, data);
                u16::from(self.chip.read_logical(logical, data)) + 2 * u16::from(written)
            }
            _ => 0,
        }
    }

    /// Reads, then writes the received data.
    fn exchange(&mut self, at: u16, data: &mut [u8], or: bool) -> u16 {
        if self.chip.settings.features & feature::NO_READ_WRITE != 0 {
            return 0;
        }
        self.sent.clear();
        self.sent.extend_from_slice(data);
        let read = self.chip.read(at, data, or);
        u16::from(read) + 2 * u16::from(self.chip.write(at, &self.sent))
    }
}

#[cfg(test)]
mod tests;
