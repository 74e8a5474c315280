//! Telegrams as they should not be, filters, padding, real-time config, restarts. Arbitrary bytes and what a careless
//! master sends are those of the fuzz target `drive`.

use super::*;

const OTHER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(127, 1, 1, 2), MASTER_PORT);

const STATUS: [u8; 8] = [0, 0, 0, 0, 0x7F, 0, 0, 0];

#[test]
fn a_status_request_is_answered_as_in_the_manual() {
    let mut bench = Bench::homed();
    bench.command(go_to(123_456, VAD));
    bench.until_standing();
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
    assert_eq!(bench.exchange(None).state.unwrap().count(), Some(0));
    let motion = Some(go_to(CM, VAD).block(5));
    let go_to = Request { response_def: ResponseDef::CYCLIC, motion, ..Request::default() };
    let mut bytes = [0; 64];
    go_to.emit(&mut bytes);
    // Header and the 16 bytes that are not 0.
    assert!(bench.raw(MASTER, &bytes[..8 + 18]).is_some());
    assert_eq!(bench.until_standing().actual, Some(CM));
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
    bench.command(go_to(10 * CM, VAD));
    bench.until_standing();
    bench.configure(RtcBlock::call(3, C::READ_RAM, 0x20A8, 0));
    bench.sim.restart(bench.now);
    assert_eq!(bench.configure(RtcBlock::command(0, C::READ_RAM)), RtcBlock::default());
    // Booting: both words are 0 and nothing is taken.
    for _ in 0..99 {
        let response = bench.exchange(Some(go_to(0, VAD).block(7)));
        assert_eq!((response.status, response.state), (Some(StatusWord(0)), Some(StateVar(0))));
    }
    bench.now = bench.now + MS;
    bench.enable();
    assert_eq!(bench.count, 0);
    let response = bench.exchange(None);
    assert!(!response.status.unwrap().homed() && response.warn.unwrap().0 != 0);
    // The sensor begins anew, wherever the motor is; homing finds the truth.
    assert_eq!(response.actual, Some(2 * CM));
    bench.control = ControlWord::HOME;
    let took = bench.until(|response| response.state.unwrap().finished());
    assert!(took > 1_000, "100 mm at 100 mm/s, in {took} ms");
    bench.control = ControlWord::ON;
    assert_eq!(bench.until_standing().actual, Some(0));
}

#[test]
fn a_drive_can_be_found_running() {
    let mut bench = Bench::new(|plan| plan.start_running = true);
    let first = Response::parse(&bench.raw(MASTER, &STATUS).unwrap()).unwrap();
    assert!(first.status.unwrap().has(StatusWord::MOTION_ACTIVE | StatusWord::HOMED));
    assert_eq!(first.state, Some(StateVar(0x08A5)));
    // It goes on for as long as nobody takes over, and turns round.
    let (mut low, mut high) = (i32::MAX, i32::MIN);
    for _ in 0..100 {
        bench.now = bench.now + S;
        let response = Response::parse(&bench.raw(MASTER, &STATUS).unwrap()).unwrap();
        assert_eq!(response.error, Some(ErrorCode::NONE));
        (low, high) = (low.min(response.actual.unwrap()), high.max(response.actual.unwrap()));
    }
    assert!(low < -15 * CM && high > 15 * CM, "{low} ... {high}");
    // A count that it already has does nothing, the next one stops it.
    bench.control = ControlWord::ON;
    let stop = MotionCommand::vai_stop(Acceleration(100_000));
    assert!(bench.exchange(Some(stop.block(5))).status.unwrap().motion_active());
    bench.exchange(Some(stop.block(6)));
    let stood = bench.until_standing();
    bench.now = bench.now + S;
    assert_eq!(bench.exchange(None).demand, stood.demand);
    // A power cycle ends it for good.
    bench.sim.restart(bench.now);
    bench.now = bench.now + S;
    assert!(!bench.exchange(None).status.unwrap().operation_enabled());
    // The longest silence costs a bounded number of steps; time that goes backwards is no time.
    let mut bench = Bench::new(|plan| plan.start_running = true);
    for now in [bench.now, Time(u64::MAX), Time(0)] {
        bench.now = now;
        assert!(bench.raw(MASTER, &STATUS).is_some());
    }
}
