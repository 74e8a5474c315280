//! Access rights of a master to registers and memory.

use super::misuse::is_locked;
use super::*;

impl Chip {
    /// The event bits that it adds to each datagram.
    pub(in super::super) fn interrupts(&self) -> u16 {
        self.events & self.word(address::EVENT_MASK)
    }

    /// Whether a station address, or an alias, is its own.
    pub(in super::super) fn is_called(&self, station: u16) -> bool {
        let by_alias =
            self.memory[usize::from(address::ALIAS_ENABLE)] & 1 != 0 && station == self.word(address::ALIAS);
        station == self.word(address::STATION) || by_alias
    }

    pub(super) fn may_read(&self, at: usize) -> bool {
        self.exists(at)
            && (at < USER || self.managers.iter().all(|m| !m.area().contains(&at) || m.may_read()))
    }

    pub(super) fn may_write(&self, at: usize) -> bool {
        let is_open = match at {
            0x0010..0x0012 | 0x0100..0x0104 | 0x0200..0x0202 | 0x0300..0x0314 => true,
            0x0120..0x0122 => self.requested.is_none(),
            0x0400..0x0402 | 0x0410..0x0412 | 0x0420..0x0422 | 0x0442..0x0444 | 0x0500 => true,
            0x0502..0x0510 => self.eeprom.job.is_none() && self.bytes(address::SII_OWNER) == [0; 2],
            0x0600..0x0800 => true,
            0x0800..0x0900 => !matches!(at % SyncManager::SIZE, 5 | 7) && !is_locked(at, &self.memory),
            0x0900..0x0904 | 0x0910..0x0918 | 0x0920..0x092C | 0x0930..0x0936 => true,
            0x0980..0x0982 | 0x0990..0x0998 | 0x09A0..0x09A8 => true,
            _ => at >= USER,
        };
        is_open
            && self.exists(at)
            && (at < USER || self.managers.iter().all(|m| !m.area().contains(&at) || m.may_write()))
    }

    /// Whether there is a register, or memory.
    fn exists(&self, at: usize) -> bool {
        match at {
            0x0000..0x0600 => true,
            0x0600..0x0800 => (at - 0x0600) / Fmmu::SIZE < self.fmmus.len(),
            0x0800..0x0900 => (at - 0x0800) / SyncManager::SIZE < self.managers.len(),
            0x0900..0x0910 | 0x0918..0x0920 => self.settings.receive_times || self.has_clock(),
            0x0910..0x0A00 => self.has_clock(),
            USER..PROCESS => true,
            _ => (PROCESS..END).contains(&at),
        }
    }

    /// Reads what may be read; with `or` it is or-ed with the given data. Whether anything could be read.
    pub(in super::super) fn read(&mut self, at: u16, data: &mut [u8], or: bool) -> bool {
        let mut span = Span::default();
        for (at, byte) in (usize::from(at)..).zip(data) {
            if self.may_read(at) {
                *byte = self.memory[at] | if or { *byte } else { 0 };
                span.add(at);
            }
        }
        self.has_read(span)
    }

    /// Writes what may be written. Whether anything could be written.
    pub(in super::super) fn write(&mut self, at: u16, data: &[u8]) -> bool {
        self.count_misuse(at, data);
        let mut span = Span::default();
        // The pulse runs: its start and cycle are accepted and discarded (assumed; the manuals only forbid it).
        let runs = self.memory[usize::from(address::DC_ACTIVATION)] & CYCLIC != 0;
        for (at, byte) in (usize::from(at)..).zip(data) {
            if self.may_write(at) {
                if !(runs && matches!(at, 0x0990..0x0998 | 0x09A0..0x09A8)) {
                    self.memory[at] = *byte;
                }
                span.add(at);
            }
        }
        self.has_written(span)
    }

    /// The effects of a read; whether anything was read.
    pub(super) fn has_read(&mut self, span: Span) -> bool {
        let Some(range) = span.range() else { return false };
        self.managers.iter_mut().for_each(|manager| manager.has_read(&range));
        if meets(&range, address::LINKS, 2) {
            self.events &= !LINKS_CHANGED;
        }
        if meets(&range, address::AL_STATUS, 2) {
            self.events &= !STATE_CHANGED;
        }
        if meets(&range, address::SII_CONTROL, 2) && self.eeprom.job.is_some() {
            self.met.sii_busy += 1;
        }
        true
    }
}

/// From the first to the last byte that was accessed.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Span(Option<(usize, usize)>);

impl Span {
    pub(super) fn add(&mut self, at: usize) {
        self.0 = Some(self.0.map_or((at, at), |(first, last)| (first.min(at), last.max(at))));
    }

    pub(super) fn range(self) -> Option<Range<usize>> {
        self.0.map(|(first, last)| first..last + 1)
    }
}

/// Whether a range touches a register.
pub(super) fn meets(range: &Range<usize>, at: u16, size: usize) -> bool {
    let at = usize::from(at);
    range.start < at + size && at < range.end
}
