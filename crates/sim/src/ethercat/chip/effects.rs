//! The effects of a write.

use super::access::{Span, meets};
use super::*;

/// The bits that AL status copies from AL control in device emulation: state and error.
const SHOWN: u8 = 0x1F;

impl Chip {
    /// The effects of a write; whether anything was written.
    pub(super) fn has_written(&mut self, span: Span) -> bool {
        let Some(range) = span.range() else { return false };
        if range.start >= USER {
            self.buffers_written(&range);
        } else {
            self.registers_written(&range);
        }
        self.show();
        true
    }

    fn buffers_written(&mut self, range: &Range<usize>) {
        let now = self.passage.at;
        for n in 0..self.managers.len() {
            let manager = &mut self.managers[n];
            if !manager.has_written(range, &self.memory) {
                continue;
            }
            let setting = manager.setting;
            if setting.is_mailbox() {
                self.filled = Some(now);
                continue;
            }
            self.outputs = true;
            if setting.control & SyncManager::WATCHDOG != 0 {
                self.feed(now);
            }
        }
    }

    fn registers_written(&mut self, range: &Range<usize>) {
        let hit = |at: u16, size: usize| meets(range, at, size);
        if hit(address::AL_CONTROL, 2) {
            if self.settings.emulated {
                let [status, _] = self.word(address::AL_CONTROL).to_le_bytes();
                self.put(address::AL_STATUS, &[status & SHOWN]);
                self.events |= STATE_CHANGED;
            } else {
                self.requested = Some(self.passage.at);
            }
        }
        if hit(address::ERRORS, 0x14) {
            self.put(address::ERRORS, &[0; 0x14]);
        }
        if hit(address::WATCHDOG_COUNTER, 2) {
            self.put(address::WATCHDOG_COUNTER, &[0; 2]);
        }
        if hit(address::SII_OWNER, 1) {
            self.sii_owner();
        }
        if hit(address::SII_CONTROL, 2) {
            self.sii_command();
        }
        if hit(address::FMMU, Fmmu::SIZE * self.fmmus.len()) {
            for n in 0..self.fmmus.len() {
                self.fmmus[n] = Fmmu::new(self.bytes(address::fmmu(n as u16)));
            }
        }
        if hit(address::SYNC_MANAGER, SyncManager::SIZE * self.managers.len()) {
            for n in 0..self.managers.len() {
                let setting = SyncManager::new(self.bytes(address::sync_manager(n as u16)));
                self.managers[n].set(setting);
            }
        }
        if range.end > usize::from(address::DC_PORTS) {
            self.clock_written(range);
        }
    }

    /// The processor lets go of the SII by force only.
    fn sii_owner(&mut self) {
        let [owner, held] = self.bytes(address::SII_OWNER);
        let is_forced = owner & FORCED != 0 && held != 0;
        self.met.sii_forced += u32::from(is_forced);
        let held = if is_forced { 0 } else { held };
        self.put(address::SII_OWNER, &[owner & SLAVE_OWNS, held]);
    }

    fn sii_command(&mut self) {
        let [a, b, c, d] = self.bytes(address::SII_ADDRESS);
        let (control, word) = (self.word(address::SII_CONTROL), self.word(address::SII_DATA));
        self.met.sii_reads += u32::from(control & bit::COMMAND == bit::READ);
        if self.eeprom.command(self.passage.at, control, u32::from_le_bytes([a, b, c, d]), word) {
            self.show_sii();
        }
    }

    fn clock_written(&mut self, range: &Range<usize>) {
        let hit = |at: u16, size: usize| meets(range, at, size);
        if hit(address::DC_PORTS, 4) {
            self.latch();
        }
        if hit(address::DC_TIME, 4) {
            let bits = 8 * (range.end - usize::from(address::DC_TIME));
            let reference = self.quad(address::DC_TIME);
            self.clock.compare(reference, bits);
            // The value read there is its own time, also behind that in the same frame.
            let system_time = self.clock.system_time();
            self.put(address::DC_TIME, &system_time.to_le_bytes());
        }
        if hit(address::DC_OFFSET, 8) {
            let offset = self.quad(address::DC_OFFSET);
            self.clock.set_offset(offset);
        }
        if hit(address::DC_DELAY, 4) {
            self.clock.delay = u32::from_le_bytes(self.bytes(address::DC_DELAY));
        }
        if hit(address::DC_FILTER, 2) {
            self.clock.average(self.memory[usize::from(address::DC_FILTER)]);
        }
        if hit(address::DC_SPEED, 2) {
            self.clock.reset_filter();
        }
        if hit(address::DC_ACTIVATION, 1) {
            let is_on = self.memory[usize::from(address::DC_ACTIVATION)] & SYNC0 == SYNC0;
            match self.clock.next_sync() {
                // It continues as it is.
                Some(_) if is_on => {}
                None if is_on => {
                    let (start, cycle) = (self.quad(address::DC_START), self.bytes(address::DC_CYCLE));
                    self.clock.start(start, u32::from_le_bytes(cycle));
                }
                _ => self.clock.sync = None,
            }
        }
    }

    /// Latches when this frame came, and when it comes back. A port with nothing behind it keeps its time.
    fn latch(&mut self) {
        let own = self.clock.own();
        let Passage { at, back } = self.passage;
        self.put(address::DC_PORTS, &(own as u32).to_le_bytes());
        for (port, back) in (address::DC_PORTS..).step_by(4).zip(back) {
            if let Some(back) = back {
                self.put(port, &(own.wrapping_add(back.since(at)) as u32).to_le_bytes());
            }
        }
        self.put(address::DC_RECEIVED, &own.to_le_bytes());
    }
}
