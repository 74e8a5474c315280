//! Slaves that are not like the usual ones, register by register.

use super::super::super::codec::frame::Command::*;
use super::super::super::codec::registers::AlState as S;
use super::super::super::tests::{Bench, logical};
use super::*;
use crate::ethercat::{Behind, MailboxSettings, Misuse};
use crate::testing::hex;

const DIGITAL_OUTPUT: u16 = 0x0F00;

/// Slaves of these kinds in a row.
fn row<const N: usize>(all: [SlaveSettings; N]) -> Bench {
    let device = |n| Device { name: format!("t{n}"), slave: SlavePlan::new(n) };
    let devices = (0..N as u16).map(device).collect();
    let plan = EthercatPlan { devices, ..EthercatPlan::new("local:test", Vec::new()) };
    let mut segment = EthercatSegment::from(plan);
    segment.settings.slaves.extend((0..).zip(all));
    bench(&segment)
}

fn model(model: Model) -> SlaveSettings {
    SlaveSettings { model: Some(model), ..SlaveSettings::default() }
}

/// A drive with these settings; its firmware reacts after a quarter of a millisecond.
fn drive_of(own: SlaveSettings) -> EthercatSegment {
    let plan = EthercatPlan::new("local:test", vec![KollmorgenDrive::new("x", 0, Family::S700)]);
    let mut segment = EthercatSegment::from(plan);
    segment.settings.slaves.insert(0, own);
    segment
}

fn drive(own: SlaveSettings) -> Bench {
    bench(&drive_of(own))
}

/// Requests a state and waits for the firmware.
fn go(bench: &mut Bench, state: S) -> (S, Option<u16>) {
    bench.control(0, state as u16);
    bench.wait(MS);
    bench.state(0)
}

/// Writes the SyncManagers of a drive as the sheet has them, with these control bytes of its process data.
fn manage(bench: &mut Bench, outputs: u8, inputs: u8) {
    for (n, bytes) in (0..).zip([
        [0x00, 0x18, 16, 0, 0x26, 0, 1, 0],
        [0x00, 0x1C, 16, 0, 0x22, 0, 1, 0],
        [0x00, 0x11, 6, 0, outputs, 0, 1, 0],
        [0x40, 0x11, 8, 0, inputs, 0, 1, 0],
    ]) {
        assert_eq!(bench.write(0, address::sync_manager(n), &bytes), 1);
    }
}

#[test]
fn in_device_emulation_al_status_is_a_copy_of_al_control() {
    let mut bench = row([model(Model::El2008)]);
    assert_eq!(bench.read(0, 0x0140), Some([0x04, 0x01]));
    for (control, status) in
        [(0x11, 0x11), (0x01, 0x01), (0x08, 0x08), (0x12, 0x12), (0x02, 0x02), (0x0104, 0x04)]
    {
        bench.control(0, control);
        assert_eq!(bench.read(0, address::AL_STATUS), Some([status, 0, 0, 0, 0, 0]), "{control:#x}");
    }
    assert_eq!(bench.segment.slave(0).unwrap().state(), S::SafeOp);
    // A drive has one, and refuses.
    let mut drive = drive(SlaveSettings::default());
    assert_eq!(drive.read(0, 0x0140), Some([0x08, 0x00]));
    assert_eq!(go(&mut drive, S::Op), (S::Init, Some(0x0011)));
}

#[test]
fn a_digital_output_terminal_moves_its_own_bits_in_op_only_and_until_its_watchdog() {
    let mut bench = row([model(Model::El2008)]);
    assert_eq!(bench.write(0, address::sync_manager(0), &[0x00, 0x0F, 1, 0, 0x44, 0, 1, 0]), 1);
    let fmmu = Fmmu::bytes(0, 1, DIGITAL_OUTPUT, Fmmu::WRITE);
    assert_eq!(bench.write(0, address::fmmu(0), &fmmu.to_bytes()), 1);
    let driven = |bench: &mut Bench, byte: u8| {
        assert_eq!(bench.send(logical(Lwr, 0), &[byte]).1, 1, "no processor locks it");
        bench.segment.slave(0).unwrap().driven().to_vec()
    };
    assert_eq!(driven(&mut bench, 0xA5), [0; 0]);
    for state in [S::PreOp, S::SafeOp] {
        bench.control(0, state as u16);
        assert_eq!(driven(&mut bench, 0xA5), [0; 0], "{state:?}");
    }
    bench.control(0, S::Op as u16);
    assert_eq!(driven(&mut bench, 0xA5), [0xA5]);
    bench.wait(100 * MS);
    bench.send((Nop, 0, 0), &[]);
    assert_eq!(bench.segment.slave(0).unwrap().driven(), [0; 0]);
    assert_eq!(bench.read(0, address::AL_STATUS), Some([8, 0, 0, 0, 0, 0]), "nothing reports it");
    assert_eq!(driven(&mut bench, 0x5A), [0x5A]);
}

#[test]
fn a_strict_processor_compares_each_byte_of_its_sync_managers() {
    let strict =
        |output_control| SlaveSettings { exact_managers: true, output_control, ..SlaveSettings::default() };
    for (control, set, inputs, code) in [
        (Some(0x24), 0x64, 0x20, Some(0x001D)),
        (Some(0x24), 0x24, 0x20, None),
        (None, 0x24, 0x20, Some(0x001D)),
        (None, 0x64, 0x20, None),
        (None, 0x64, 0x00, Some(0x001E)),
    ] {
        let mut bench = drive(strict(control));
        manage(&mut bench, set, inputs);
        assert_eq!(go(&mut bench, S::PreOp), (S::PreOp, None));
        let expected = code.map_or((S::SafeOp, None), |code| (S::PreOp, Some(code)));
        assert_eq!(go(&mut bench, S::SafeOp), expected, "{control:?} {set:#x} {inputs:#x}");
    }
    let mut bench = drive(strict(None));
    manage(&mut bench, 0x64, 0x20);
    // With an interrupt.
    bench.manage(0, 0, &[0x00, 0x18, 16, 0, 0x36, 0, 1, 0]);
    assert_eq!(go(&mut bench, S::PreOp), (S::Init, Some(0x0016)));
}

fn own_sii(change: impl FnOnce(&mut SiiSettings)) -> SlaveSettings {
    let mut own = SlaveSettings::default();
    change(&mut own.sii);
    own
}

#[test]
fn an_sii_that_the_processor_has_or_needs_is_given_by_force_or_back() {
    let mut bench = drive(own_sii(|sii| sii.owned_by_slave = true));
    assert_eq!(sii(&mut bench, 0, word::VENDOR), None);
    bench.write(0, address::SII_OWNER, &[0]);
    assert_eq!(sii(&mut bench, 0, word::VENDOR), None, "it is held");
    bench.write(0, address::SII_OWNER, &[2]);
    bench.write(0, address::SII_OWNER, &[0]);
    assert_eq!(sii(&mut bench, 0, word::VENDOR), Some(0x6A));

    let mut bench = drive(own_sii(|sii| sii.read_in_preop = true));
    manage(&mut bench, 0x64, 0x20);
    assert_eq!(sii(&mut bench, 0, word::VENDOR), Some(0x6A));
    assert_eq!(go(&mut bench, S::PreOp), (S::Init, Some(0x0050)));
    bench.control(0, 0x11);
    bench.wait(MS);
    bench.write(0, address::SII_OWNER, &[1]);
    assert_eq!(go(&mut bench, S::PreOp), (S::PreOp, None));
    bench.write(0, address::SII_OWNER, &[0]);
    assert_eq!(sii(&mut bench, 0, word::VENDOR), None, "the processor keeps it");
}

#[test]
fn an_sii_is_busy_at_first_slips_once_and_may_be_wrong() {
    let mut bench = drive(own_sii(|sii| sii.loading_ns = 5 * MS));
    assert_eq!(bench.read(0, address::SII_CONTROL), Some([0, 0x80]));
    assert_eq!(sii(&mut bench, 0, word::VENDOR), None);
    bench.wait(5 * MS);
    assert_eq!(sii(&mut bench, 0, word::VENDOR), Some(0x6A));

    let mut bench = drive(own_sii(|sii| (sii.slips, sii.eight) = (true, true)));
    let read = |bench: &mut Bench| {
        bench.write(0, address::SII_CONTROL, &read_of(word::VENDOR));
        bench.wait(MS);
        bench.read::<14>(0, address::SII_CONTROL)
    };
    let slipped = [0x40, 0, 0x09, 0, 0, 0, 0, 0, 0, 0x06, 0, 0x03, 0, 0];
    assert_eq!(read(&mut bench), Some(slipped), "another address, and its words");
    assert_eq!(read(&mut bench), Some([0x40, 0, 0x08, 0, 0, 0, 0x6A, 0, 0, 0, 0x00, 0x06, 0x00, 0x03]));

    // The third of each three fails; the next command ends that.
    let mut bench = drive(own_sii(|sii| sii.fails_every = 3));
    let shown: Vec<u8> = (0..4).map(|_| read(&mut bench).unwrap()[1]).collect();
    assert_eq!(shown, [0, 0, 0x20, 0]);

    for (content, status, after) in [
        (SiiContent::Unloaded, 0x10, 0x30),
        (SiiContent::WrongCheck, 0x08, 0x08),
        (SiiContent::Garbage, 0x00, 0x00),
    ] {
        let mut bench = drive(own_sii(|sii| sii.content = content));
        assert_eq!(bench.read(0, address::SII_CONTROL), Some([0, status]), "{content:?}");
        assert_eq!(read(&mut bench).map(|read| read[1]), Some(after), "{content:?}");
        if content != SiiContent::Unloaded {
            assert_eq!(sii(&mut bench, 0, word::VENDOR), Some(0x6A), "{content:?}");
        }
        if content == SiiContent::Garbage {
            assert_eq!(sii(&mut bench, 0, word::CATEGORIES), Some(0x0002_2545), "noise");
        }
    }
}

#[test]
fn a_slave_left_by_another_master_keeps_its_registers_until_power_off() {
    let left = Left {
        station: 0x1003,
        al: (0x14, 0x001B),
        fmmus: vec![Fmmu::bytes(0x1_0000, 6, 0x1100, Fmmu::WRITE).to_bytes()],
        managers: vec![[0x00, 0x18, 16, 0, 0x26, 0, 1, 0], [0x00, 0x1C, 16, 0, 0x22, 0, 1, 0]],
        unwatched: true,
        sync0_ns: Some(1_000_000),
        sii_given: true,
        sii_failed: true,
    };
    let mut sim = EthercatSim::new(&drive_of(SlaveSettings { left: Some(left), ..SlaveSettings::default() }));
    assert_eq!(sim.drive(0).unwrap().al_state(), S::SafeOp);
    let mut bench = Bench::left(std::mem::replace(sim.segment(), Segment::new(Vec::new())));
    let at = |bench: &mut Bench, ado| bench.send((Fprd, 0x1003, ado), &[0; 8]);
    assert_eq!(at(&mut bench, address::AL_STATUS), (vec![0x14, 0, 0, 0, 0x1B, 0, 0, 0], 1));
    assert_eq!(at(&mut bench, address::SYNC_MANAGER).0[..6], [0x00, 0x18, 16, 0, 0x26, 0]);
    assert_eq!(at(&mut bench, address::FMMU).0, [0, 0, 1, 0, 6, 0, 0, 7]);
    assert_eq!(at(&mut bench, address::WATCHDOG).0[..2], [0, 0]);
    assert_eq!(at(&mut bench, address::DC_CONTROL).0[..2], [0, 3]);
    assert_eq!(bench.send((Fpwr, 0x1003, address::SII_CONTROL), &read_of(8)).1, 0);
    // A power cycle clears it.
    let now = bench.now;
    bench.segment.slave(0).unwrap().restart(now);
    assert_eq!(bench.send((Aprd, 0, address::STATION), &[0; 2]), (vec![0, 0], 1));
    assert_eq!(bench.send((Aprd, 0, address::AL_STATUS), &[0; 2]), (vec![1, 0], 1));
}

#[test]
fn the_inputs_of_a_drive_are_valid_as_soon_as_it_is_in_safeop() {
    let mut bench = drive(SlaveSettings::default());
    manage(&mut bench, 0x64, 0x20);
    go(&mut bench, S::PreOp);
    assert_eq!(go(&mut bench, S::SafeOp), (S::SafeOp, None));
    // Switch-on disabled, and the warning n17: it is not synchronous.
    assert_eq!(bench.read::<8>(0, 0x1140).map(|inputs| inputs[6..].to_vec()), Some(vec![0xC0, 0x02]));
}

/// Writes a message to its mailbox.
fn post(bench: &mut Bench, message: &str) {
    assert_eq!(bench.write(0, 0x1800, &hex(message)), 1);
}

/// The message in its mailbox.
fn fetch(bench: &mut Bench) -> Option<[u8; 16]> {
    bench.wait(MS);
    bench.read(0, 0x1C00)
}

/// A drive in PREOP whose mailbox answers like this.
fn mailbox(mailbox: MailboxSettings) -> Bench {
    let mut bench = drive(SlaveSettings { mailbox, ..SlaveSettings::default() });
    manage(&mut bench, 0x64, 0x20);
    assert_eq!(go(&mut bench, S::PreOp), (S::PreOp, None));
    bench
}

const READ: &str = "0A00 0000 00 13 0020 40 001C 00 00000000";
const NEXT: &str = "0A00 0000 00 23 0020 40 1810 00 00000000";

#[test]
fn an_answer_is_slow_and_a_late_one_comes_before_the_next() {
    let usual = MailboxSettings::default();
    let mut bench = mailbox(MailboxSettings { delay_ns: 10 * MS, delay_every: 2, ..usual });
    post(&mut bench, READ);
    assert_eq!(fetch(&mut bench).map(|answer| answer[5]), Some(0x13), "the first one is quick");
    post(&mut bench, "0A00 0000 00 23 0020 40 001C 01 00000000");
    assert_eq!(fetch(&mut bench), None);
    post(&mut bench, "0A00 0000 00 33 0020 40 1810 01 00000000");
    bench.idle(10);
    assert_eq!(fetch(&mut bench).map(|answer| answer[5]), Some(0x23), "what nobody waits for any more");
    assert_eq!(fetch(&mut bench).map(|answer| (answer[5], answer[12])), Some((0x33, 0x6A)));
}

#[test]
fn an_answer_is_lost_and_a_repeat_acknowledged_without_one() {
    let usual = MailboxSettings::default();
    let mut bench = mailbox(MailboxSettings { lose_every: 2, resends: false, ..usual });
    post(&mut bench, READ);
    assert!(fetch(&mut bench).is_some());
    bench.write(0, 0x080E, &[3]);
    bench.wait(MS);
    bench.send((Nop, 0, 0), &[]);
    assert_eq!((bench.read(0, 0x080F), fetch(&mut bench)), (Some([2]), None));
    post(&mut bench, NEXT);
    assert_eq!(fetch(&mut bench), None, "lost");
    post(&mut bench, "0A00 0000 00 33 0020 40 1810 00 00000000");
    assert_eq!(fetch(&mut bench).map(|answer| answer[5]), Some(0x33));
}

#[test]
fn outputs_are_seen_at_the_inputs_that_they_are_wired_to() {
    let outputs = SlaveSettings { wired_to: Some(0), ..model(Model::El2008) };
    let mut bench = row([model(Model::El1004), outputs]);
    assert_eq!(bench.write(0, address::sync_manager(0), &[0x00, 0x10, 1, 0, 0x00, 0, 1, 0]), 1);
    assert_eq!(bench.write(1, address::sync_manager(0), &[0x00, 0x0F, 1, 0, 0x44, 0, 1, 0]), 1);
    bench.control(1, S::Op as u16);
    let mut seen = |byte: u8| {
        assert_eq!(bench.write(1, DIGITAL_OUTPUT, &[byte]), 1);
        bench.read(0, 0x1000)
    };
    assert_eq!([seen(0xA5), seen(0x0A)], [[0x05], [0x0A]].map(Some), "it has four inputs");
    bench.control(1, S::PreOp as u16);
    bench.send((Nop, 0, 0), &[]);
    assert_eq!(bench.read(0, 0x1000), Some([0]));
}

#[test]
fn an_analogue_terminal_has_objects_and_changing_inputs() {
    let mut bench = row([model(Model::El3102)]);
    for (n, bytes) in (0..).zip([
        [0x00, 0x10, 128, 0, 0x26, 0, 1, 0],
        [0x80, 0x10, 128, 0, 0x22, 0, 1, 0],
        [0x00, 0x11, 0, 0, 0x24, 0, 0, 0],
        [0x80, 0x11, 8, 0, 0x20, 0, 1, 0],
    ]) {
        assert_eq!(bench.write(0, address::sync_manager(n), &bytes), 1);
    }
    assert_eq!(go(&mut bench, S::PreOp), (S::PreOp, None));
    let mut ask = |request: &str| {
        let mut message = hex(request);
        message.resize(128, 0);
        assert_eq!(bench.write(0, 0x1000, &message), 1);
        bench.wait(MS);
        bench.send((Nop, 0, 0), &[]);
        let answer: [u8; 128] = bench.read(0, 0x1080).unwrap();
        answer[8..22].to_vec()
    };
    for (count, request, answer) in [
        (1, "40 1810 02 00000000", "43 1810 02 5230 1E0C"),
        (2, "40 131C 01 00000000", "4B 131C 01 001A"),
        (3, "40 131C 02 00000000", "4B 131C 02 021A"),
        (4, "40 021A 09 00000000", "43 021A 09 1011 1060"),
        (5, "40 1060 07 00000000", "4F 1060 07 00"),
        (6, "40 0810 00 00000000", "41 0810 00 06000000 454C33313032"),
        (7, "2B 0080 13 34120000", "60 0080 13"),
        (1, "40 0080 13 00000000", "4B 0080 13 3412"),
        (2, "2F 0010 00 01000000", "80 0010 00 02000106"),
        (3, "40 0020 00 00000000", "80 0020 00 00000206"),
    ] {
        let answer = hex(answer);
        let came = ask(&format!("0A00 0000 00 {count}3 0020 {request}"));
        assert_eq!(came[..answer.len()], answer, "{request}");
    }
    assert_eq!(go(&mut bench, S::SafeOp), (S::SafeOp, None));
    let first: [u8; 8] = bench.read(0, 0x1180).unwrap();
    bench.idle(3);
    let now: [u8; 8] = bench.read(0, 0x1180).unwrap();
    assert_eq!([now[2].wrapping_sub(first[2]), first[6].wrapping_sub(now[6])], [3, 3]);
    assert_eq!([now[1] ^ first[1], now[5] ^ first[5]], [0x80; 2], "the toggle bits");
}

#[test]
fn a_branch_shows_its_links_and_when_a_frame_was_at_each_port() {
    let behind = Some(Behind { place: 0, port: 2 });
    let far = SlaveSettings { behind, ..model(Model::Ek1100) };
    let mut bench = row([model(Model::Ek1100), model(Model::El2008), far]);
    assert_eq!(bench.read(0, 0x0007), Some([0x3B]), "MII, EBUS, EBUS or MII, none");
    assert_eq!(bench.read(0, address::LINKS).map(u16::from_le_bytes), Some(0b0110_1010_0111_0000));
    bench.send((Bwr, 0, address::DC_PORTS), &[0; 4]);
    let times: [u8; 16] = bench.read(0, address::DC_PORTS).unwrap();
    let times: Vec<u32> = times.chunks(4).map(|time| u32::from_le_bytes(time.try_into().unwrap())).collect();
    let since = |port: usize| times[port].wrapping_sub(times[0]);
    assert_eq!(([1, 2].map(since), times[3]), ([1_000, 2_000], 0), "500 ns each way to either");
}

#[test]
fn misuse_is_counted() {
    let mut bench = row([model(Model::El2008)]);
    let misuse = |bench: &mut Bench| bench.segment.slave(0).unwrap().misuse();
    bench.write(0, 0x0101, &[0]);
    bench.write(0, 0x0103, &[0]);
    bench.control(0, 0x01);
    assert_eq!(misuse(&mut bench), Misuse::default());
    bench.write(0, 0x0101, &[0; 3]);
    bench.write(0, 0x1000, &[7]);
    bench.control(0, 0x11);
    let manager = |bench: &mut Bench, length| {
        bench.write(0, address::sync_manager(0), &[0, 0x0F, length, 0, 0x44, 0, 1, 0])
    };
    assert_eq!([1, 1, 2].map(|length| manager(&mut bench, length)), [1; 3]);
    assert_eq!(bench.read(0, address::SYNC_MANAGER), Some([0, 0x0F, 1, 0]), "it is on, and stays as it is");
    let counted = Misuse { fifo_sizes: 1, needless_acknowledges: 1, locked_managers: 1, early_writes: 1 };
    assert_eq!(misuse(&mut bench), counted);
    // Off, and then as wanted.
    bench.send((Bwr, 0, address::SYNC_MANAGER), &[0; 8]);
    manager(&mut bench, 2);
    assert_eq!(bench.read(0, address::SYNC_MANAGER), Some([0, 0x0F, 2, 0]));
    assert_eq!(misuse(&mut bench), counted);
}
