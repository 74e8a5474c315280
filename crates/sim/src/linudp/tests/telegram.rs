//! Telegrams as they should not be, filters, padding, real-time config, restarts. Arbitrary bytes and what a careless
//! master sends are those of the fuzz target `drive`.

use super::*;

const OTHER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(127, 1, 1, 2), MASTER_PORT);

const STATUS: [u8; 8] = [0, 0, 0, 0, 0x7F, 0, 0, 0];

#[test]
fn a_status_request_is_answered_as_in_the_manual() {
    let mut bench = Bench::homed();
    bench.ends_at(go_to(123_456, VAD));
    let reply = bench.raw(MASTER, &STATUS).unwrap();
    let golden = [
        0x00, 0x00, 0x00, 0x00, 0x7F, 0x00, 0x00, 0x00, // echoes
        0x37, 0x0C, 0xC1, 0x08, // on, in target, homed; count 1
        0x40, 0xE2, 0x01, 0x00, 0x40, 0xE2, 0x01, 0x00, // 12.3456 mm
        0x00, 0x00, 0x00, 0x00, 0x00, 0x00, // no current, no warning, no error
    ];
    assert_eq!(reply, golden);
}

#[test]
fn telegrams_may_be_longer_or_end_within_the_motion_command_or_the_config_block() {
    let mut bench = Bench::homed();
    let mut long = [0xA5; 300];
    long[..8].copy_from_slice(&[0xF8, 0xFF, 0xFF, 0xFF, 0x7F, 0xFE, 0xFF, 0xFF]);
    let reply = bench.raw(MASTER, &long).unwrap();
    assert_eq!((reply.len(), &reply[..8]), (26, &long[..8]), "reserved bits do no harm");
    assert_eq!(bench.exchange(None).count(), 0);
    // Header and the 16 bytes that are not 0.
    let telegram = request(CYCLIC, None, Some(Motion { header: 0x0105, ..go_to(CM, VAD) }), None);
    assert!(bench.raw(MASTER, &telegram[..8 + 18]).is_some());
    assert_eq!(bench.until_standing().actual, CM);
    // Control and UPID of a parameter read.
    let reply = bench.raw(MASTER, &[4, 0, 0, 0, 0, 1, 0, 0, 0x01, 0x11, 0xA8, 0x20]).unwrap();
    // The sheet's example: it is the demand velocity that the first monitoring channel shows.
    assert_eq!(reply, [4, 0, 0, 0, 0, 1, 0, 0, 0x01, 0x00, 0xA8, 0x20, 0x0F, 0x1E, 0, 0]);
}

#[test]
fn a_master_has_the_masters_port_and_is_any_the_first_or_the_fixed_one() {
    let mut bench = Bench::new(|_| {});
    assert!(bench.raw(MASTER, &STATUS).is_some() && bench.raw(OTHER, &STATUS).is_some());
    let mut bench = Bench::new(|plan| plan.filter = MasterFilter::Single);
    // Neither of these becomes the single master.
    assert_eq!(bench.raw(SocketAddrV4::new(*OTHER.ip(), MASTER_PORT + 1), &STATUS), None);
    assert_eq!(bench.raw(OTHER, &STATUS[..5]), None);
    assert!(bench.raw(MASTER, &STATUS).is_some());
    assert_eq!(bench.raw(OTHER, &STATUS), None);
    assert!(bench.raw(MASTER, &STATUS).is_some());
    let ignored = Ignored { wrong_port: 1, malformed: 1, filtered: 1, ..Ignored::default() };
    assert_eq!(bench.sim.ignored(), ignored);
    bench.sim.restart(bench.now);
    assert!(bench.raw(OTHER, &STATUS).is_some());
    assert_eq!(bench.raw(MASTER, &STATUS), None);
    let mut bench = Bench::new(|plan| plan.filter = MasterFilter::Fixed(*OTHER.ip()));
    assert_eq!(bench.raw(MASTER, &STATUS), None);
    assert!(bench.raw(OTHER, &STATUS).is_some());
}

#[test]
fn a_restart_forgets_all_but_where_the_motor_is() {
    let mut bench = Bench::homed();
    bench.ends_at(go_to(10 * CM, VAD));
    bench.configure(3, C::READ_RAM, [0x20A8, 0, 0]);
    bench.sim.restart(bench.now);
    assert_eq!(bench.configure(0, C::READ_RAM, [0; 3]), Some(ConfigBlock::default()));
    // Booting: both words are 0 and nothing is taken.
    for _ in 0..99 {
        let report = bench.exchange(Some(Motion { header: 0x0107, ..go_to(0, VAD) }));
        assert_eq!((report.status, report.state), (0, 0));
    }
    bench.wait(MS);
    bench.enable();
    assert_eq!(bench.count, 0);
    let report = bench.exchange(None);
    assert!(!report.has(status::HOMED) && report.warn != 0);
    // The sensor begins anew, wherever the motor is; homing finds the truth.
    assert_eq!(report.actual, 2 * CM);
    let took = bench.home();
    assert!(took > 1_000, "100 mm at 100 mm/s, in {took} ms");
    assert_eq!(bench.until_standing().actual, 0);
}

#[test]
fn a_drive_can_be_found_running() {
    let mut bench = Bench::new(|plan| plan.start_running = true);
    let first = bench.look();
    assert!(first.has(status::MOTION_ACTIVE | status::HOMED));
    assert_eq!(first.state, 0x08A5);
    // It goes on for as long as nobody takes over, and turns round.
    let (mut low, mut high) = (i32::MAX, i32::MIN);
    for _ in 0..100 {
        bench.wait(S);
        let report = bench.look();
        assert_eq!(report.error, errors::NONE);
        (low, high) = (low.min(report.actual), high.max(report.actual));
    }
    assert!(low < -15 * CM && high > 15 * CM, "{low} ... {high}");
    // A count that it already has does nothing, the next one stops it.
    bench.control = control::ON;
    let stop = motion(0x017, &[100_000]);
    assert!(bench.exchange(Some(Motion { header: 0x0175, ..stop })).has(status::MOTION_ACTIVE));
    bench.exchange(Some(Motion { header: 0x0176, ..stop }));
    let stood = bench.until_standing();
    bench.wait(S);
    assert_eq!(bench.exchange(None).demand, stood.demand);
    // A power cycle ends it for good.
    bench.sim.restart(bench.now);
    bench.wait(S);
    assert!(!bench.exchange(None).has(status::OPERATION_ENABLED));
    // The longest silence costs a bounded number of steps; time that goes backwards is no time.
    let mut bench = Bench::new(|plan| plan.start_running = true);
    for now in [bench.now, Time(u64::MAX), Time(0)] {
        bench.now = now;
        assert!(bench.raw(MASTER, &STATUS).is_some());
    }
}
