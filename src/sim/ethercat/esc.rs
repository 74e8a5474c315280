//! One slave: its controller and its firmware, and the effects of a datagram's commands (ETG.1000.4, 5.4).

use super::chip::{Chip, Passage};
use super::firmware::Firmware;
use super::sii::Access;
use super::{Application, Drive};
use crate::bus::ethercat::wire::frame::{Command, DATAGRAM_HEADER, Place, WORKING_COUNTER};
use crate::bus::ethercat::wire::registers::{AlCode, AlState, Features, Fmmu, SyncManager, address};
use crate::bus::ethercat::wire::sii::word;
use crate::time::Time;

/// The feature bit of a slave without BRW, APRW and FPRW.
const NO_READ_WRITE: u16 = 1 << 10;
/// The cyclic unit is the master's, SYNC0 is on.
const SYNC0_ON: [u8; 2] = [0x00, 0x03];

/// The settings of a slave.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Type, revision and build.
    pub kind: [u8; 4],
    /// The features of its controller.
    pub features: Features,
    /// It has receive times, even without a clock: enough to measure delays.
    pub receive_times: bool,
    /// The number of its FMMUs, at most 32.
    pub fmmus: u8,
    /// The number of its SyncManagers, at most 32.
    pub sync_managers: u8,
    /// Its process memory from 1000h on, KiB, at most 60.
    pub ram_kib: u8,
    /// The words of its EEPROM; [`sii::Contents`](super::sii::Contents) makes them.
    pub sii: Vec<u16>,
    /// The timing of EEPROM access.
    pub sii_access: Access,
    /// The time of its clock at its start, ns.
    pub clock_ns: u64,
    /// How much faster than ours its clock runs.
    pub drift_ppm: f64,
    /// Comparisons in which its clock removes most of a difference to the reference.
    pub settling: u16,
    /// How long its firmware takes to read AL control or the mailbox.
    pub reaction_ns: u64,
    /// Its device id, if it shows one: bit 5 of its AL status, and the code register while there is no error.
    /// Default: none.
    pub device_id: Option<u16>,
    /// The code with which it falls back when outputs are missing. That of a Kollmorgen S300 ... S700 is not known;
    /// of those that its manual names only that of synchronisation would fit.
    pub watchdog_code: AlCode,
    /// The delay from the slave before it to this one, each way.
    pub delay_ns: u64,
}

/// Like a real Kollmorgen drive (AKD): a 32-bit clock. The EEPROM is blank, nothing takes time.
impl Default for Settings {
    fn default() -> Settings {
        Settings {
            kind: [0x04, 0x02, 0x00, 0x00],
            features: Features(0x0184),
            receive_times: true,
            fmmus: 8,
            sync_managers: 8,
            ram_kib: 8,
            sii: Vec::new(),
            sii_access: Access::default(),
            clock_ns: 0,
            drift_ppm: 0.0,
            settling: 32,
            reaction_ns: 0,
            device_id: None,
            watchdog_code: AlCode::WATCHDOG,
            delay_ns: 0,
        }
    }
}

/// A slave of the segment.
#[derive(Debug)]
pub struct Esc {
    settings: Settings,
    links: [bool; 2],
    deaf: bool,
    chip: Chip,
    firmware: Firmware,
    /// The data that came with a command that reads first.
    sent: Vec<u8>,
}

impl Esc {
    /// Just powered on, in INIT.
    pub fn new(settings: Settings, application: Box<dyn Application>) -> Esc {
        let has_mailbox =
            settings.sii.get(usize::from(word::PROTOCOLS)).is_some_and(|protocols| *protocols != 0);
        Esc {
            chip: Chip::new(&settings, settings.sii.clone()),
            firmware: Firmware::new(application, settings.watchdog_code, settings.reaction_ns, has_mailbox),
            links: [false; 2],
            deaf: false,
            sent: Vec::new(),
            settings,
        }
    }

    /// It is in OP with these SyncManagers and this FMMU for its outputs, as another master has left it, and its
    /// drive comes up running.
    pub(super) fn run(&mut self, managers: &[SyncManager], outputs: Fmmu) {
        let Some(cycle_ns) = self.drive().and_then(|drive| drive.cycle_ns()) else { return };
        for (n, manager) in (0..).zip(managers) {
            self.chip.write(address::sync_manager(n), &manager.to_bytes());
        }
        self.chip.write(address::fmmu(0), &outputs.to_bytes());
        self.chip.write(address::WATCHDOG, &[0; 2]);
        // They have one time.
        let offset = self.chip.clock().own().wrapping_neg();
        self.chip.write(address::DC_OFFSET, &offset.to_le_bytes());
        let start = self.chip.clock().system_time() + cycle_ns;
        self.chip.write(address::DC_CYCLE, &(cycle_ns as u32).to_le_bytes());
        self.chip.write(address::DC_START, &start.to_le_bytes());
        self.chip.write(address::DC_CONTROL, &SYNC0_ON);
        self.firmware.run(&mut self.chip);
    }

    /// The state it is in.
    pub fn state(&self) -> AlState {
        self.firmware.state()
    }

    /// Why it refused a state, or fell back, until that is acknowledged.
    pub fn error(&self) -> Option<AlCode> {
        self.firmware.error()
    }

    /// The segment's time that it has at `now`, ns.
    pub fn system_time(&mut self, now: Time) -> u64 {
        self.chip.advance(now);
        self.chip.clock().system_time()
    }

    /// The time at `now` until its next SYNC0, ns; `None`: there is none.
    pub fn sync0_in_ns(&mut self, now: Time) -> Option<u64> {
        self.live(now);
        self.chip.clock().left_to_sync()
    }

    /// The drive behind it, if it is one.
    pub fn drive(&mut self) -> Option<&mut Drive> {
        self.firmware.drive()
    }

    /// It forwards frames and carries out none of them, until this is taken back.
    pub fn deafen(&mut self, deaf: bool) {
        self.deaf = deaf;
    }

    /// Power cycle: everything is lost except its EEPROM.
    pub fn restart(&mut self, now: Time) {
        let sii = self.chip.take_sii();
        self.chip = Chip::new(&self.settings, sii);
        self.chip.link(self.links);
        self.firmware.restart(now);
    }

    /// Advances to `now`, with or without a frame.
    pub fn live(&mut self, now: Time) {
        self.chip.advance(now);
        while let Some(late_ns) = self.chip.clock().take_sync() {
            self.firmware.cycle(&mut self.chip, now - late_ns);
        }
        self.firmware.work(&mut self.chip, now);
    }

    /// Which of its ports have a link.
    pub(super) fn link(&mut self, ports: [bool; 2]) {
        self.links = ports;
        self.chip.link(ports);
    }

    /// The delay from the slave before it.
    pub(super) fn delay_ns(&self) -> u64 {
        self.settings.delay_ns
    }

    /// Lets a frame with datagrams at these offsets pass.
    pub(super) fn pass(&mut self, passage: Passage, frame: &mut [u8], places: &[Place]) {
        let Passage { at, .. } = passage;
        self.live(at);
        if self.deaf {
            return;
        }
        let is_synchronous = self.chip.clock().next_sync().is_some();
        if !is_synchronous && !self.chip.managers().iter().any(|manager| manager.is_process(true)) {
            self.firmware.cycle(&mut self.chip, at);
        }
        self.chip.begin(passage);
        for place in places {
            if let Some(datagram) = frame.get_mut(place.at..place.end()) {
                self.datagram(datagram);
            }
        }
        if self.chip.takes_outputs() && !is_synchronous {
            self.firmware.cycle(&mut self.chip, at);
        }
        self.firmware.work(&mut self.chip, at);
    }

    /// Carries out one datagram.
    fn datagram(&mut self, datagram: &mut [u8]) {
        let Some((header, rest)) = datagram.split_first_chunk_mut::<DATAGRAM_HEADER>() else { return };
        let Some((data, counter)) = rest.split_last_chunk_mut::<WORKING_COUNTER>() else { return };
        let [number, _, a, b, c, d, _, _, e, f] = *header;
        let Some(command) = Command::new(number, u32::from_le_bytes([a, b, c, d])) else { return };
        let done = self.execute(command, u16::from_le_bytes([a, b]), data);
        *counter = u16::from_le_bytes(*counter).wrapping_add(done).to_le_bytes();
        if counts_position(command) {
            header[2..4].copy_from_slice(&u16::from_le_bytes([a, b]).wrapping_add(1).to_le_bytes());
        }
        let interrupts = u16::from_le_bytes([e, f]) | self.chip.interrupts();
        header[8..].copy_from_slice(&interrupts.to_le_bytes());
    }

    /// Its share of the working counter.
    fn execute(&mut self, command: Command, first: u16, data: &mut [u8]) -> u16 {
        use Command::{Aprd, Aprw, Apwr, Armw, Brd, Brw, Bwr, Fprd, Fprw, Fpwr, Frmw, Lrd, Lrw, Lwr, Nop};
        let is_meant = match command {
            Aprd(..) | Apwr(..) | Aprw(..) | Armw(..) => first == 0,
            Fprd(..) | Fpwr(..) | Fprw(..) | Frmw(..) => self.chip.is_called(first),
            _ => true,
        };
        match command {
            Aprd(_, at) | Fprd(_, at) | Armw(_, at) | Frmw(_, at) if is_meant => {
                self.chip.read(at, data, false).into()
            }
            Apwr(_, at) | Fpwr(_, at) if is_meant => self.chip.write(at, data).into(),
            Aprw(_, at) | Fprw(_, at) if is_meant => self.exchange(at, data, false),
            Armw(_, at) | Frmw(_, at) | Bwr(at) => self.chip.write(at, data).into(),
            Brd(at) => self.chip.read(at, data, true).into(),
            Brw(at) => self.exchange(at, data, true),
            Lrd(at) => self.chip.read_logical(at, data).into(),
            Lwr(at) => self.chip.write_logical(at, data).into(),
            Lrw(at) if !self.settings.features.lacks_lrw() => {
                // The received data are written, not the read data.
                let written = self.chip.write_logical(at, data);
                u16::from(self.chip.read_logical(at, data)) + 2 * u16::from(written)
            }
            Nop | Lrw(_) | Aprd(..) | Apwr(..) | Aprw(..) | Fprd(..) | Fpwr(..) | Fprw(..) => 0,
        }
    }

    /// Reads, then writes the received data.
    fn exchange(&mut self, at: u16, data: &mut [u8], or: bool) -> u16 {
        if self.settings.features.0 & NO_READ_WRITE != 0 {
            return 0;
        }
        self.sent.clear();
        self.sent.extend_from_slice(data);
        let read = self.chip.read(at, data, or);
        u16::from(read) + 2 * u16::from(self.chip.write(at, &self.sent))
    }
}

/// Whether each slave adds 1 to the position in a command.
fn counts_position(command: Command) -> bool {
    use Command::{Aprd, Aprw, Apwr, Armw, Brd, Brw, Bwr};
    matches!(command, Aprd(..) | Apwr(..) | Aprw(..) | Armw(..) | Brd(_) | Bwr(_) | Brw(_))
}

#[cfg(test)]
mod tests {
    use super::super::testing::{Bench, with_mailbox};
    use super::*;
    use crate::bus::ethercat::wire::frame::position;
    use crate::bus::ethercat::wire::sii;

    /// Memory that nothing guards.
    const FREE: u16 = 0x0F80;

    /// Two drives and a slave without a clock.
    fn three() -> Bench {
        let blind = Settings { features: Features(0x0180), ..Settings::default() };
        Bench::new(vec![Settings::default(), Settings::default(), blind])
    }

    #[test]
    fn each_command_counts_as_often_as_it_is_carried_out() {
        let mut bench = three();
        let second = position(1);
        for (command, count) in [
            (Command::Nop, 0),
            (Command::Aprd(second, FREE), 1),
            (Command::Apwr(second, FREE), 1),
            (Command::Aprw(second, FREE), 3),
            (Command::Aprd(position(3), FREE), 0),
            (Command::Fprd(0x1002, FREE), 1),
            (Command::Fpwr(0x1002, FREE), 1),
            (Command::Fprw(0x1002, FREE), 3),
            (Command::Fprd(0x2000, FREE), 0),
            (Command::Brd(FREE), 3),
            (Command::Bwr(FREE), 3),
            (Command::Brw(FREE), 9),
            (Command::Armw(second, FREE), 3),
            (Command::Frmw(0x1002, FREE), 3),
            (Command::Frmw(0x2000, FREE), 3),
            // What the slave without a clock has of it, and what it does not have.
            (Command::Bwr(address::DC_PORTS), 3),
            (Command::Bwr(address::DC_TIME), 2),
            (Command::Frmw(0x1001, address::DC_TIME), 2),
            (Command::Armw(position(0), address::DC_TIME), 2),
            // What cannot be written, and what is not there.
            (Command::Bwr(address::TYPE), 0),
            (Command::Brw(address::TYPE), 3),
            (Command::Brd(0x4000), 0),
            (Command::Lrd(0), 0),
            (Command::Lwr(0), 0),
            (Command::Lrw(0), 0),
        ] {
            assert_eq!(bench.send(command, &[0; 4]).1, count, "{command:?}");
        }
    }

    #[test]
    fn positions_are_counted_and_other_addresses_stay() {
        let mut bench = three();
        let at = |first: u16| u32::from(first) | u32::from(FREE) << 16;
        for (command, back) in [
            (Command::Aprd(0xFFFF, FREE), at(2)),
            (Command::Apwr(0, FREE), at(3)),
            (Command::Aprw(0xFFF0, FREE), at(0xFFF3)),
            (Command::Armw(0, FREE), at(3)),
            (Command::Brd(FREE), at(3)),
            (Command::Bwr(FREE), at(3)),
            (Command::Brw(FREE), at(3)),
            (Command::Fprd(0x1001, FREE), at(0x1001)),
            (Command::Fpwr(0x1001, FREE), at(0x1001)),
            (Command::Fprw(0x1001, FREE), at(0x1001)),
            (Command::Frmw(0x1001, FREE), at(0x1001)),
            (Command::Lrd(5), 5),
            (Command::Lwr(5), 5),
            (Command::Lrw(5), 5),
        ] {
            assert_eq!(bench.send_whole(command, &[0; 2]).2, back, "{command:?}");
        }
    }

    #[test]
    fn reads_of_all_are_or_ed_and_a_state_may_come_out_that_is_none() {
        let mut bench = Bench::drives(|_| {});
        bench.all_to(&[AlState::SafeOp]);
        bench.go(1, AlState::Op);
        assert_eq!(bench.send(Command::Brd(address::AL_STATUS), &[0; 2]), (vec![0x0C, 0], 2));
        // What the master sends is or-ed too.
        assert_eq!(bench.send(Command::Brd(address::AL_STATUS), &[0xF0, 0]), (vec![0xFC, 0], 2));
    }

    #[test]
    fn a_read_write_brings_what_was_there_and_leaves_what_came() {
        let mut bench = three();
        for n in 0..3 {
            bench.write(n, FREE, &[1 << n]);
        }
        assert_eq!(bench.send(Command::Fprw(0x1002, FREE), &[0x80]), (vec![2], 3));
        assert_eq!(bench.read(1, FREE), Some([0x80]));
        // Each writes what reaches it: what the ones before it have or-ed.
        assert_eq!(bench.send(Command::Brw(FREE), &[0x10]), (vec![0x95], 9));
        assert_eq!([0, 1, 2].map(|n| bench.read(n, FREE)), [[0x10], [0x11], [0x91]].map(Some));
    }

    #[test]
    fn one_reads_and_those_behind_it_write_that() {
        let mut bench = three();
        for n in 0..3 {
            bench.write(n, FREE, &[n as u8 + 1]);
        }
        assert_eq!(bench.send(Command::Frmw(0x1002, FREE), &[9]), (vec![2], 3));
        assert_eq!([0, 1, 2].map(|n| bench.read(n, FREE)), [[9], [2], [2]].map(Some));
        assert_eq!(bench.send(Command::Armw(position(0), FREE), &[5]), (vec![9], 3));
        assert_eq!([0, 1, 2].map(|n| bench.read(n, FREE)), [Some([9]); 3]);
    }

    #[test]
    fn the_alias_counts_once_it_is_switched_on() {
        let mut bench = Bench::new(vec![with_mailbox()]);
        let by_alias = Command::Fprd(0x77, address::STATION);
        assert_eq!(bench.send(by_alias, &[0; 2]).1, 0);
        bench.write(0, 0x0103, &[1]);
        assert_eq!(bench.send(by_alias, &[0; 4]), (vec![0x01, 0x10, 0x77, 0], 1));
    }

    #[test]
    fn process_data_counts_three_from_safeop_on_and_nothing_below() {
        let mut bench = Bench::drives(|_| {});
        let sent = [7; 28];
        let image = Command::Lrw(0x1_0000);
        assert_eq!(bench.send(image, &sent), (sent.to_vec(), 0));
        bench.scripts[0].script().inputs = vec![1; 8];
        bench.go(0, AlState::SafeOp);
        bench.send(image, &sent);
        let mut back = sent;
        back[12..20].fill(1);
        assert_eq!(bench.send(image, &sent), (back.to_vec(), 3));
        bench.go(1, AlState::SafeOp);
        assert_eq!(bench.send(image, &sent).1, 6);
        assert_eq!(bench.send(Command::Lrd(0x1_0000), &sent).1, 2);
        assert_eq!(bench.send(Command::Lwr(0x1_0000), &sent).1, 2);
        // Of a slave whose outputs are not in it only the inputs count.
        assert_eq!(bench.send(Command::Lrw(0x1_000C), &[0; 8]).1, 1);
        assert_eq!(bench.send(Command::Lrw(0x1_0006), &[0; 6]).1, 2);
    }

    #[test]
    fn a_slave_does_not_do_what_its_features_lack() {
        let mut bench = Bench::drives(|settings| settings.features = Features(0x0784));
        bench.all_to(&[AlState::SafeOp]);
        assert_eq!(bench.send(Command::Lrw(0x1_0000), &[7; 28]), (vec![7; 28], 0));
        assert_eq!(bench.send(Command::Lrd(0x1_0000), &[7; 28]).1, 2);
        assert_eq!(bench.send(Command::Lwr(0x1_0000), &[7; 28]).1, 2);
        for command in [Command::Brw(FREE), Command::Fprw(0x1001, FREE), Command::Aprw(0, FREE)] {
            assert_eq!(bench.send(command, &[7; 2]), (vec![7; 2], 0));
        }
    }

    #[test]
    fn the_eeprom_is_read_by_its_registers_and_by_its_owner_only() {
        let access = Access { busy_ns: 1_000, ..Access::default() };
        let mut bench = Bench::new(vec![Settings { sii_access: access, ..with_mailbox() }]);
        let begin = sii::read(word::MAILBOX_OUT);
        assert_eq!(bench.write(0, address::SII_OWNER, &[1]), 1);
        assert_eq!(bench.write(0, address::SII_CONTROL, &begin), 0);
        for owner in [sii::FORCE, sii::MASTER] {
            assert_eq!(bench.write(0, address::SII_OWNER, &[owner]), 1);
        }
        assert_eq!(bench.write(0, address::SII_CONTROL, &begin), 1);
        assert_eq!(bench.read(0, address::SII_CONTROL), Some([0x00, 0x81]));
        assert_eq!(bench.write(0, address::SII_CONTROL, &begin), 0, "busy");
        bench.wait(1_000);
        assert_eq!(bench.read(0, address::SII_CONTROL), Some([0, 0]));
        assert_eq!(bench.read(0, address::SII_DATA), Some([0x00, 0x18, 0x00, 0x04]));
    }

    #[test]
    fn a_power_cycle_loses_all_but_the_eeprom() {
        let mut bench = Bench::drives(|_| {});
        let now = bench.now;
        bench.segment.slave(0).unwrap().restart(now);
        assert_eq!(bench.scripts[0].script().restarts, 1);
        assert_eq!(bench.send(Command::Aprd(0, address::STATION), &[0; 4]), (vec![0, 0, 0x77, 0], 1));
        assert_eq!(bench.send(Command::Aprd(0, address::AL_STATUS), &[0; 2]), (vec![1, 0], 1));
        assert_eq!(bench.send(Command::Aprd(0, address::SYNC_MANAGER), &[0; 4]), (vec![0; 4], 1));
        assert_eq!(bench.state(1), (AlState::PreOp, None));
        let slave = bench.segment.slave(0).unwrap();
        assert_eq!((slave.state(), slave.error()), (AlState::Init, None));
    }

    #[test]
    fn sync0_runs_the_application_on_its_time_and_no_output_does() {
        let mut bench =
            Bench::drives(|settings| (settings.clock_ns, settings.features) = (5_000, Features(0x018C)));
        bench.all_to(&[AlState::SafeOp]);
        bench.write(0, address::DC_CYCLE, &1_000_u32.to_le_bytes());
        bench.write(0, address::DC_START, &7_000_u64.to_le_bytes());
        bench.write(0, address::DC_CONTROL, &[0, 3]);
        bench.scripts[0].script().cycles.clear();
        let begin = bench.now;
        bench.wait(4_500);
        bench.send(Command::Lrw(0x1_0000), &[1; 28]);
        let at: Vec<u64> = bench.scripts[0].script().cycles.iter().map(|(at, _)| at.since(begin)).collect();
        assert_eq!(at, [2_000, 3_000, 4_000]);
        assert_eq!(bench.read(0, address::DC_START), Some(10_000_u64.to_le_bytes()), "the next one");
        bench.send(Command::Bwr(address::DC_ACTIVATION), &[0]);
        bench.wait(9_000);
        bench.send(Command::Lrw(0x1_0000), &[1; 28]);
        assert_eq!(bench.scripts[0].script().cycles.len(), 4, "by the outputs again");
    }
}
