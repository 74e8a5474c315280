//! Registers, memory, FMMUs and what they set off.

use super::*;

fn chip(change: impl FnOnce(&mut Settings)) -> Chip {
    let mut settings = Settings { features: 0x01CC, ..Settings::default() };
    change(&mut settings);
    let mut chip = Chip::new(settings, Vec::new());
    chip.show_state(AlState::SafeOp, false, code::NONE);
    chip
}

fn map(chip: &mut Chip, n: u16, fmmu: Fmmu) {
    assert!(chip.write(address::fmmu(n), &fmmu.to_bytes()));
}

#[test]
fn bytes_are_mapped_where_both_overlap() {
    let mut chip = chip(|_| {});
    map(&mut chip, 0, Fmmu::bytes(0x1_0000, 4, 0x1100, Fmmu::WRITE));
    map(&mut chip, 1, Fmmu::bytes(0x1_0004, 4, 0x1200, Fmmu::READ));
    assert!(chip.write_logical(0xFFFE, &[1, 2, 3, 4, 5]));
    assert_eq!(chip.bytes(0x10FF_u16), [0, 3, 4, 5, 0, 0]);
    assert!(chip.write(0x1200, &[6, 7, 8, 9]));
    let mut data = [0xEE; 4];
    assert!(chip.read_logical(0x1_0006, &mut data));
    assert_eq!(data, [8, 9, 0xEE, 0xEE]);
    assert!(!chip.read_logical(0x1_0000, &mut data[..4]), "outputs are not read");
    assert!(!chip.write_logical(0x1_0004, &data));
    // Of two that map one byte the first counts.
    map(&mut chip, 0, Fmmu { bits: (0, 3), ..Fmmu::bytes(0x40, 1, 0x0F00, Fmmu::WRITE) });
    map(&mut chip, 1, Fmmu { bits: (4, 7), ..Fmmu::bytes(0x40, 2, 0x0F01, Fmmu::WRITE) });
    assert!(chip.write_logical(0x40, &[0xFF, 0xFF]));
    assert_eq!(chip.bytes(0x0F00_u16), [0x0F, 0xF0, 0x0F], "of the second one only the other byte");
    // At the end of both spaces there is what there is.
    map(&mut chip, 0, Fmmu::bytes(u32::MAX - 1, 0xFFFF, 0x2FFE, Fmmu::WRITE));
    assert!(chip.write_logical(u32::MAX - 1, &[1, 2, 3, 4]));
    assert_eq!(chip.bytes(0x2FFE_u16), [1, 2]);
    map(&mut chip, 0, Fmmu { bits: (7, 0), length: 1, ..Fmmu::bytes(0, 1, 0x1000, Fmmu::WRITE) });
    assert!(!chip.write_logical(0, &[0xFF]), "it ends before it begins");
}

#[test]
fn bits_are_mapped_across_bytes_and_leave_their_neighbours() {
    let mut chip = chip(|_| {});
    // Ten bits from bit 6 on, to the memory from bit 3 on.
    let crooked = |kind| Fmmu { bits: (6, 7), physical: (0x0F00, 3), ..Fmmu::bytes(0x40, 2, 0x0F00, kind) };
    map(&mut chip, 0, crooked(Fmmu::WRITE));
    assert!(chip.write(0x0F00, &[0xFF, 0xFF]));
    assert!(chip.write_logical(0x40, &[0x40, 0x00]));
    assert_eq!(chip.bytes(0x0F00_u16), [0b0000_1111, 0b1110_0000], "ten bits from bit 3 on");
    // Elsewhere memory is written by bytes: what is not mapped has any value.
    let elsewhere = Fmmu { physical: (0x1100, 3), ..crooked(Fmmu::WRITE) };
    map(&mut chip, 0, elsewhere);
    assert!(chip.write(0x1100, &[0xFF, 0xFF]) && chip.write_logical(0x40, &[0x40, 0x00]));
    assert_eq!(chip.bytes(0x1100_u16), [0b0000_1000, 0]);
    assert!(chip.write(0x0F00, &[0b0101_0000, 0b0000_0001]));
    map(&mut chip, 0, crooked(Fmmu::READ));
    let mut data = [0b0011_1111, 0xFF];
    assert!(chip.read_logical(0x40, &mut data));
    assert_eq!(data, [0b1011_1111, 0b0000_1010]);
}

#[test]
fn a_spare_fmmu_maps_al_status_and_the_mailbox_flag_in_every_state() {
    for state in [AlState::Init, AlState::PreOp, AlState::SafeOp, AlState::Op] {
        let mut chip = chip(|_| {});
        chip.show_state(state, state == AlState::SafeOp, code::NONE);
        map(&mut chip, 2, Fmmu::bytes(0x2_0010, 2, address::AL_STATUS, Fmmu::READ));
        let mut data = [0xEE; 6];
        assert!(chip.read_logical(0x2_000E, &mut data));
        let error = if state == AlState::SafeOp { 0x10 } else { 0 };
        assert_eq!(data, [0xEE, 0xEE, state as u8 | error, 0, 0xEE, 0xEE]);
    }
    // A single bit shows that the mailbox is full.
    let mut chip = chip(|settings| settings.device_id = Some(0x1234));
    let mailbox = SyncManager { start: 0x1C00, length: 16, control: SyncManager::MAILBOX_IN, activate: 1 };
    assert!(chip.write(address::sync_manager(1), &mailbox.to_bytes()));
    map(&mut chip, 2, Fmmu { bits: (0, 0), ..Fmmu::bytes(0x0900_0000, 1, 0x080D, Fmmu::READ) });
    let mut flag = [0xF0];
    assert!(chip.read_logical(0x0900_0000, &mut flag) && flag == [0xF0]);
    chip.put_message(&[1; 16]);
    assert!(chip.read_logical(0x0900_0000, &mut flag) && flag == [0xF1]);
    // A device id stands in place of no error.
    assert_eq!(chip.bytes(address::AL_STATUS), [0x24, 0, 0, 0, 0x34, 0x12]);
    chip.show_state(AlState::SafeOp, true, code::WATCHDOG);
    assert_eq!(chip.bytes(address::AL_STATUS), [0x14, 0, 0, 0, 0x1B, 0]);
}

#[test]
fn start_and_cycle_of_a_running_sync0_cannot_be_changed() {
    let mut chip = chip(|_| {});
    chip.advance(Time(0));
    let set = |chip: &mut Chip, start: u32, cycle: u32| {
        assert!(chip.write(address::DC_START, &u64::from(start).to_le_bytes()));
        assert!(chip.write(address::DC_CYCLE, &cycle.to_le_bytes()));
    };
    set(&mut chip, 1_000, 500);
    assert!(chip.write(address::DC_CONTROL, &[0, 3]));
    set(&mut chip, 5_000, 700);
    assert!(chip.write(address::DC_CONTROL, &[0, 3]), "nor does it begin again");
    chip.advance(Time(1_600));
    let taken: Vec<u64> = std::iter::from_fn(|| chip.clock.take_sync()).collect();
    assert_eq!(taken, [600, 100]);
    assert!(chip.write(address::DC_ACTIVATION, &[0]));
    set(&mut chip, 5_000, 700);
    assert!(chip.write(address::DC_ACTIVATION, &[3]));
    assert_eq!(chip.clock.next_sync(), Some(5_000));
}

#[test]
fn missing_registers_are_neither_read_nor_written() {
    let mut chip = chip(|settings| {
        settings.features = 0x0180;
        (settings.receive_times, settings.fmmus) = (true, 2);
    });
    for (at, there) in [
        (address::TYPE, true),
        (address::fmmu(1), true),
        (address::fmmu(2), false),
        (address::sync_manager(8), false),
        (address::DC_PORTS, true),
        (address::DC_TIME, false),
        (0x2FFF, true),
        (0x3000, false),
        (0xFFFF, false),
    ] {
        assert_eq!(chip.read(at, &mut [0; 1], false), there, "{at:#06x}");
    }
    assert!(!chip.write(address::TYPE, &[0; 16]), "what it is cannot be written");
    assert!(!chip.write(address::AL_STATUS, &[8]));
    assert!(chip.write(0x2FFE, &[1, 2, 3, 4]), "as far as there is any");
}

#[test]
fn a_link_change_sets_an_event_until_dl_status_is_read() {
    let mut chip = chip(|_| {});
    assert_eq!(chip.bytes(address::TYPE), [4, 2, 0, 0, 8, 8, 8, 0x0F, 0xCC, 0x01]);
    chip.link([true, true, false, false]);
    assert_eq!(chip.word(address::LINKS), 0b0101_1010_0011_0000);
    chip.link([true, false, false, false]);
    assert_eq!(chip.word(address::LINKS), 0b0101_0110_0001_0000);
    assert_eq!(chip.interrupts(), 0, "masked");
    assert!(chip.write(address::EVENT_MASK, &[4, 0]));
    assert_eq!(chip.interrupts(), 4);
    assert!(chip.read(address::LINKS, &mut [0; 2], false));
    assert_eq!(chip.interrupts(), 0);
    chip.link([true, false, false, false]);
    assert_eq!(chip.interrupts(), 0, "nothing has changed");
}

#[test]
fn receive_times_are_latched_together_except_at_an_unused_port() {
    let mut chip = chip(|settings| settings.clock_ns = (1 << 32) + 500);
    chip.advance(Time(1_000));
    chip.begin(Passage { at: Time(1_000), back: [None, Some(Time(1_300)), None, None] });
    assert!(chip.write(address::DC_PORTS, &[0; 4]));
    assert_eq!(chip.bytes(address::DC_PORTS), [0xF4, 1, 0, 0, 0x20, 3, 0, 0]);
    assert_eq!(chip.quad(address::DC_RECEIVED), (1 << 32) + 500);
    chip.begin(Passage { at: Time(1_000), back: [None; 4] });
    assert!(chip.write(address::DC_PORTS, &[0]));
    assert_eq!(chip.bytes(address::DC_PORTS), [0xF4, 1, 0, 0, 0x20, 3, 0, 0], "it keeps its time");
}

#[test]
fn the_watchdog_runs_from_the_last_output_and_can_be_switched_off() {
    let mut chip = chip(|_| {});
    let outputs = SyncManager {
        start: 0x1100,
        length: 2,
        control: SyncManager::OUTPUTS | SyncManager::WATCHDOG,
        activate: 1,
    };
    assert!(chip.write(address::sync_manager(2), &outputs.to_bytes()));
    chip.begin(Passage { at: Time(5), back: [None; 4] });
    let mut written = |data: &[u8]| {
        assert!(chip.write(0x1100, data));
        std::mem::take(&mut chip.outputs)
    };
    assert_eq!([&[9][..], &[1, 2]].map(&mut written), [false, true], "the first one is not whole");
    assert!(chip.outputs().eq([1, 2]));
    // 1 000 ticks of 100 us.
    assert!(!chip.watchdog_expired(Time(100_000_004)));
    assert!(chip.watchdog_expired(Time(100_000_005)) && chip.watchdog_expired(Time(200_000_000)));
    chip.begin(Passage::default());
    assert_eq!(chip.bytes(address::WATCHDOG_STATUS), [0, 0, 1]);
    assert!(chip.write(address::WATCHDOG, &[0, 0]));
    assert!(!chip.watchdog_expired(Time(300_000_000)));
    assert!(chip.write(address::WATCHDOG_COUNTER, &[7]));
    assert_eq!(chip.bytes(address::WATCHDOG_STATUS), [1, 0, 0]);
    chip.show_state(AlState::PreOp, false, code::NONE);
    assert!(chip.outputs().next().is_none(), "locked, they count no more");
}
