//! Control word and status word of both profiles, ramps, stops, faults.

use super::*;
use fieldbeat_profibus::DriveProfile;

const STATES: u16 = 0x6F;

#[test]
fn stops_take_their_ramps_and_coasting_takes_the_friction() {
    for (word, after_50ms, end) in [
        // C0105: 100 ms from 1500 rpm, 750 rpm are gone in 50.
        (0x02, 0.0..30.0, State::SwitchOnDisabled),
        // 0.5 N m on 0.005 kg m²: 955 rpm/s.
        (0x04, 670.0..720.0, State::SwitchOnDisabled),
        (0x06, 670.0..720.0, State::ReadyToSwitchOn),
        // Bits 4 to 6: by the quick stop ramp, not at all, by C0013 (500 ms).
        (0x6F, 0.0..30.0, State::OperationEnabled),
        (0x5F, 740.0..760.0, State::OperationEnabled),
        (0x3F, 570.0..620.0, State::OperationEnabled),
    ] {
        let mut bench = Bench::online(|_| ());
        bench.enable();
        bench.hold(600 * MS, 0x7F, 0x2000);
        assert!((bench.rpm() - 750.0).abs() < 1.0);
        let begin = bench.now;
        bench.words(word, 0x2000);
        bench.run(begin + 52 * MS);
        let rpm = bench.rpm();
        assert!(after_50ms.contains(&rpm.abs()), "{word:X}: {rpm}");
        bench.hold(1_000 * MS, word, 0x2000);
        assert_eq!(bench.slave().axis_state(), end, "{word:X}");
    }
    // A ramp of 0.5 s to 1500 rpm: half of it after 250 ms.
    let mut bench = Bench::online(|_| ());
    bench.enable();
    bench.hold(250 * MS, 0x7F, 0x4000);
    let half = bench.rpm();
    assert!((700.0..850.0).contains(&half), "{half}");
    // Where the bits are ignored it runs without them.
    let mut bench = Bench::online(|settings| settings.power.ramp_bits = false);
    bench.enable();
    bench.hold(600 * MS, 0x0F, -0x2000);
    assert!((bench.rpm() + 750.0).abs() < 1.0);
}

#[test]
fn the_open_hardware_enable_takes_the_power_and_is_shown() {
    let mut bench = Bench::online(|_| ());
    bench.enable();
    bench.hold(200 * MS, 0x7F, 0x1000);
    bench.medium.open_sto(0, bench.now + 300 * MS);
    let status = bench.hold(2 * MS, 0x7F, 0x1000).0;
    assert_eq!(status & 0x5F, 0x40, "{status:04X}");
    // It gets ready, and not on.
    bench.words(0x06, 0);
    let status = bench.hold(10 * MS, 0x07, 0).0;
    assert_eq!(status & 0x7F & !0x40, 0x21, "{status:04X}");
    bench.hold(300 * MS, 0x07, 0);
    assert_eq!(bench.words(0x07, 0).0 & 0x7F, 0x33);
    let mut open = Bench::online(|settings| {
        settings.motor.hardware_enable = false;
        settings.power.enable_bit = Some((12, false));
    });
    open.words(0x06, 0);
    assert_eq!(open.words(0x07, 0).0 & 0x1000, 0x1000, "the bit is set while it is open");
}

#[test]
fn a_fault_stays_until_a_rising_edge_resets_it() {
    for brakes in [false, true] {
        let mut bench = Bench::online(|settings| settings.power.brakes_on_fault = brakes);
        bench.enable();
        bench.hold(600 * MS, 0x7F, 0x2000);
        bench.slave().provoke(0x2310);
        let (status, _) = bench.words(0x7F, 0x2000);
        assert_eq!(status & 0x4F, if brakes { 0x0F } else { 0x08 }, "{status:04X}");
        // Too early for a reset while it reacts.
        bench.words(0xFF, 0);
        if brakes {
            bench.hold(200 * MS, 0x7F, 0);
            assert_eq!((bench.rpm(), bench.words(0x7F, 0).0 & 0x4F), (0.0, 0x08));
            bench.words(0x80, 0);
        }
        assert_eq!(bench.words(0x80, 0).0 & 0x4F, 0x40);
        assert_eq!(bench.words(0x06, 0).0 & STATES, 0x21);
    }
    let mut bench = Bench::online(|settings| settings.power.persistent_fault = Some(0x4210));
    for word in [0x80, 0, 0x80, 0] {
        assert_eq!(bench.words(word, 0).0 & 0x4F, 0x08);
    }
    // The bit in the first word is no edge.
    let mut bench = Bench::online(|_| ());
    bench.slave().provoke(1);
    assert_eq!((bench.words(0x80, 0).0 & 0x4F, bench.words(0x80, 0).0 & 0x4F), (8, 8));
    bench.words(0, 0);
    assert_eq!(bench.words(0x80, 0).0 & 0x4F, 0x40);
}

#[test]
fn further_words_are_where_they_are_set_up() {
    let mut bench = Bench::with(|settings| {
        settings.channel = Channel::None;
        settings.configuration = vec![0xF3];
        settings.outputs =
            vec![OutputWord::Further, OutputWord::Control, OutputWord::Further, OutputWord::SetPoint];
        settings.inputs = vec![InputWord::Echo(2), InputWord::Torque, InputWord::Fault, InputWord::Status];
    });
    bench.configured(&PRM, &[0xF3]);
    bench.control(0, 0);
    let (_, data) = bench.exchange(&[1, 2, 0, 6, 0xAB, 0xCD, 0, 0]);
    assert_eq!(data, [0xAB, 0xCD, 0, 0, 0, 0, 0x02, 0x31]);
    bench.slave().provoke(0x7310);
    let (_, data) = bench.exchange(&[1, 2, 0, 6, 0, 0, 0, 0]);
    assert_eq!(data, [0, 0, 0, 0, 0x73, 0x10, 0x02, 0x18]);
}

#[test]
fn profidrive_has_its_own_words_and_ignores_them_without_bit_10() {
    let mut bench = Bench::online(|settings| settings.power.profile = DriveProfile::Profidrive);
    assert_eq!(bench.words(0x0400, 0).0 & 0x7F, 0x40);
    assert_eq!(bench.words(0x047E, 0).0 & 0x7F, 0x31);
    // Bit 3 is set already: both steps in turn.
    assert_eq!(bench.words(0x047F, 0).0 & 0x7F, 0x33);
    assert_eq!(bench.words(0x047F, 0).0 & 0x7F, 0x37);
    let status = bench.hold(600 * MS, 0x047F, 0x2000).0;
    assert_eq!(status, 0x0737);
    assert!((bench.rpm() - 750.0).abs() < 1.0);
    bench.hold(100 * MS, 0, 0);
    assert!((bench.rpm() - 750.0).abs() < 1.0, "ignored");
    // OFF1: the ramp, then ready. Taken back, it runs again.
    bench.hold(50 * MS, 0x047E, 0x2000);
    let slower = bench.rpm();
    assert!((550.0..700.0).contains(&slower), "{slower}");
    bench.hold(200 * MS, 0x047F, 0x2000);
    assert!((bench.rpm() - 750.0).abs() < 1.0);
    let status = bench.hold(400 * MS, 0x047E, 0x2000).0;
    assert_eq!((status & 0x7F, bench.rpm()), (0x31, 0.0));
    for (word, rpm, sto_open) in [(0x047D, 700.0..750.0, 0x60), (0x047B, 0.0..600.0, 0x50)] {
        bench.hold(4 * MS, 0x047E, 0);
        bench.hold(600 * MS, 0x047F, 0x2000);
        bench.hold(20 * MS, word, 0x2000);
        let now = bench.rpm();
        assert!(rpm.contains(&now), "{word:X}: {now}");
        let status = bench.hold(1_000 * MS, word, 0x2000).0;
        assert_eq!(status & 0x70, sto_open, "{word:X}: {status:X}");
        // Without a new ON it stays inhibited.
        assert_eq!(bench.words(0x047F, 0).0 & 0x47, 0x40);
    }
    bench.slave().provoke(9);
    assert_eq!(bench.words(0x047E, 0).0 & 0x48, 8);
    bench.words(0x04FE, 0);
    assert_eq!(bench.words(0x047E, 0).0 & 0x4F, 1);
    // Clear stops it although its word of zeros has no bit 10.
    bench.hold(20 * MS, 0x047F, 0);
    bench.control(2, 0);
    assert_eq!(bench.slave().axis_state(), State::SwitchOnDisabled);
    assert_eq!(bench.slave().misuse(), Misuse::default());
}

#[test]
fn a_drive_may_be_found_running_with_a_master_that_has_died() {
    let mut bench = Bench::with(|settings| settings.running = Some(-600.0));
    bench.wait(1_000 * MS);
    assert!((bench.rpm() + 600.0).abs() < 1.0);
    assert_eq!(bench.slave().dp_state(), (DpState::DataExchange, Some(MASTER)));
    // Without a watchdog; it waits for its master.
    assert_eq!(bench.diagnose(), [0, 4, 0, MASTER, 0, 0x82]);
    bench.set_prm(&PRM);
    bench.chk_cfg(&[0xF3, 0xF1]);
    assert!((bench.rpm() + 600.0).abs() < 1.0);
    assert_eq!(bench.words(0x7F, -0x1000).0 & STATES, 0x27);
    bench.hold(500 * MS, 0x7F, -0x1000);
    assert!((bench.rpm() + 375.0).abs() < 1.0);
}
