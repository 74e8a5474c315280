use super::super::codec::frame::Command::*;
use super::super::tests::{Bench, logical};
use super::*;

/// Memory that nothing guards.
const FREE: u16 = 0x0F80;

/// Two drives and a slave without a clock.
fn three() -> Bench {
    let blind = Settings { features: 0x0180, ..Settings::default() };
    Bench::new(vec![Settings::default(), Settings::default(), blind])
}

#[test]
fn working_counter_and_position_of_each_command() {
    let mut bench = three();
    let second = 0xFFFF;
    for (command, count, back) in [
        ((Nop, 0, 0), 0, 0),
        ((Aprd, second, FREE), 1, 2),
        ((Apwr, second, FREE), 1, 2),
        ((Aprw, second, FREE), 3, 2),
        ((Aprd, 0xFFFD, FREE), 0, 0),
        ((Fprd, 0x1002, FREE), 1, 0x1002),
        ((Fpwr, 0x1002, FREE), 1, 0x1002),
        ((Fprw, 0x1002, FREE), 3, 0x1002),
        ((Fprd, 0x2000, FREE), 0, 0x2000),
        ((Brd, 0, FREE), 3, 3),
        ((Bwr, 0, FREE), 3, 3),
        ((Brw, 0, FREE), 9, 3),
        ((Armw, second, FREE), 3, 2),
        ((Frmw, 0x1002, FREE), 3, 0x1002),
        ((Frmw, 0x2000, FREE), 3, 0x2000),
        (logical(Lrd, 5), 0, 5),
        (logical(Lwr, 5), 0, 5),
        (logical(Lrw, 5), 0, 5),
    ] {
        let (_, counted, address) = bench.send_whole(command, &[0; 4]);
        assert_eq!((counted, address), (count, back), "{command:?}");
    }
    for (command, count) in [
        // What the slave without a clock has of it, and what it does not have.
        ((Bwr, 0, address::DC_PORTS), 3),
        ((Bwr, 0, address::DC_TIME), 2),
        ((Frmw, 0x1001, address::DC_TIME), 2),
        ((Armw, 0, address::DC_TIME), 2),
        // What cannot be written, and what is not there.
        ((Bwr, 0, address::TYPE), 0),
        ((Brw, 0, address::TYPE), 3),
        ((Brd, 0, 0x4000), 0),
    ] {
        assert_eq!(bench.send(command, &[0; 4]).1, count, "{command:?}");
    }
}

#[test]
fn broadcast_reads_are_or_ed() {
    let mut bench = Bench::drives(|_| {});
    bench.all_to(&[AlState::SafeOp]);
    bench.go(1, AlState::Op);
    assert_eq!(bench.send((Brd, 0, address::AL_STATUS), &[0; 2]), (vec![0x0C, 0], 2));
    // What the master sends is or-ed too.
    assert_eq!(bench.send((Brd, 0, address::AL_STATUS), &[0xF0, 0]), (vec![0xFC, 0], 2));
    // The alias counts once it is switched on.
    let by_alias = (Fprd, 0x77, address::STATION);
    assert_eq!(bench.send(by_alias, &[0; 2]).1, 0);
    bench.write(0, 0x0103, &[1]);
    assert_eq!(bench.send(by_alias, &[0; 4]), (vec![0x01, 0x10, 0x77, 0], 1));
}

#[test]
fn read_write_commands_return_old_values_and_write_what_reaches_each_slave() {
    let values = |bench: &mut Bench| [0, 1, 2].map(|n| bench.read(n, FREE).map(|[byte]| byte).unwrap());
    for (was, command, sent, back, are) in [
        ([1, 2, 4], (Fprw, 0x1002, FREE), 0x80, 2, [1, 0x80, 4]),
        // Each writes what the ones before it have or-ed.
        ([1, 0x80, 4], (Brw, 0, FREE), 0x10, 0x95, [0x10, 0x11, 0x91]),
        // One reads, and those behind it write that.
        ([1, 2, 3], (Frmw, 0x1002, FREE), 9, 2, [9, 2, 2]),
        ([9, 2, 2], (Armw, 0, FREE), 5, 9, [9, 9, 9]),
    ] {
        let mut bench = three();
        (0..).zip(was).for_each(|(n, byte)| assert_eq!(bench.write(n, FREE, &[byte]), 1));
        assert_eq!(bench.send(command, &[sent]).0, [back], "{command:?}");
        assert_eq!(values(&mut bench), are, "{command:?}");
    }
}

#[test]
fn commands_that_the_features_lack_are_not_carried_out() {
    let mut bench = Bench::drives(|settings| settings.features = 0x0784);
    bench.all_to(&[AlState::SafeOp]);
    assert_eq!(bench.send(logical(Lrw, 0x1_0000), &[7; 28]), (vec![7; 28], 0));
    assert_eq!(bench.send(logical(Lrd, 0x1_0000), &[7; 28]).1, 2);
    assert_eq!(bench.send(logical(Lwr, 0x1_0000), &[7; 28]).1, 2);
    for command in [(Brw, 0, FREE), (Fprw, 0x1001, FREE), (Aprw, 0, FREE)] {
        assert_eq!(bench.send(command, &[7; 2]), (vec![7; 2], 0));
    }
}

#[test]
fn sync0_runs_the_application_on_its_time_and_no_output_does() {
    let mut bench = Bench::drives(|settings| (settings.clock_ns, settings.features) = (5_000, 0x018C));
    bench.all_to(&[AlState::SafeOp]);
    bench.write(0, address::DC_CYCLE, &1_000_u32.to_le_bytes());
    bench.write(0, address::DC_START, &7_000_u64.to_le_bytes());
    bench.write(0, address::DC_CONTROL, &[0, 3]);
    bench.scripts[0].script().cycles.clear();
    let begin = bench.now;
    bench.wait(4_500);
    bench.send(logical(Lrw, 0x1_0000), &[1; 28]);
    let at: Vec<u64> = bench.scripts[0].script().cycles.iter().map(|(at, _)| at.since(begin)).collect();
    assert_eq!(at, [2_000, 3_000, 4_000]);
    assert_eq!(bench.read(0, address::DC_START), Some(10_000_u64.to_le_bytes()), "the next one");
    bench.send((Bwr, 0, address::DC_ACTIVATION), &[0]);
    bench.wait(9_000);
    bench.send(logical(Lrw, 0x1_0000), &[1; 28]);
    assert_eq!(bench.scripts[0].script().cycles.len(), 4, "by the outputs again");
}
