//! Servers with FC23 and without: which functions the master uses, and what the drive carries out by them.

use fieldbeat::axis::NativeOwner;
use fieldbeat::bus::modbus::{Native, NativeOutput};
use fieldbeat_sim::modbus::ReadWrite;

use super::*;

const LACKING: [ReadWrite; 4] =
    [ReadWrite::Refused, ReadWrite::UpTo(3), ReadWrite::Ignored, ReadWrite::Closes];

/// A drive whose replies count for as long as usual.
fn bench(via: Via, server: ReadWrite) -> Bench {
    Bench::new(1, via, |_, drive| {
        drive.reply_within_ns = 250 * MS;
        drive.simulate.interface.read_write = server;
    })
}

/// The requests that were sent to it by FC23.
fn both(b: &Bench) -> usize {
    b.tap(0).received.iter().filter(|request| request[7] == function::READ_WRITE).count()
}

/// The control words that a drive carries out, each once, if it has FC23 or not.
fn commanded(b: &Bench, has_both: bool) -> Vec<u16> {
    let control = |address: u16| {
        let (parameter, width) = Parameter::from_address(address, Addressing::Standard).unwrap();
        (matches!(parameter, Parameter::CONTROL_WORD) || parameter == Parameter::new(0, 11)).then_some(width)
    };
    let tap = b.tap(0);
    let written = tap.received.iter().filter_map(|request| match Request::parse(request).unwrap().1 {
        Request::Write { address, data } => Some((control(address)?, data)),
        Request::ReadWrite { write, data, .. } if has_both => Some((control(write)?, data)),
        _ => None,
    });
    let mut words: Vec<u16> = written
        .map(|(width, data)| match width {
            Width::Word => data.word(0).unwrap(),
            Width::Long => data.long(0).unwrap() as u16,
        })
        .collect();
    words.dedup();
    words
}

/// Enabled, turning one way and the other, and off again.
fn work(b: &mut Bench) {
    b.ready();
    b.turning(0, 4.0);
    b.turning(0, -3.0);
    b.done(0, STOP);
    b.done(0, Command::Disable);
}

#[test]
fn a_server_without_function_23_is_commanded_as_one_that_has_it() {
    for via in VIAS {
        let mut served = bench(via, ReadWrite::Served);
        work(&mut served);
        let usual = commanded(&served, true);
        assert!(usual.len() >= 4, "{usual:?}");
        for server in LACKING {
            let what = format!("{via:?}, {server:?}");
            let mut b = bench(via, server);
            work(&mut b);
            // A first one that fits is answered.
            let answers = matches!(server, ReadWrite::UpTo(_)) && via == Via::Direct;
            if !answers {
                assert_eq!((both(&b), commanded(&b, false)), (1, usual.clone()), "{what}");
            }
            // Another connection, and the drive is another one.
            assert!(b.sim.world().restart(address(0)), "{what}");
            b.tap(0).received.clear();
            b.stopped(0, 2_000);
            b.online();
            // The stop sequence runs to its end before anything else is taken.
            b.run(100);
            b.recover(0);
            assert_eq!(both(&b), 0, "{what}: remembered");
            let drive = &b.finish().drives[0];
            assert_eq!(drive.counters.own[Own::NoReadWrite as usize], 1, "{what}");
            assert_eq!(drive.losses, 1, "{what}: by the restart alone");
        }
    }
}

#[test]
fn a_drive_configured_without_function_23_never_gets_it_and_is_read_as_usual() {
    for via in VIAS {
        let mut b = Bench::new(1, via, |_, drive| drive.functions = Functions::Apart);
        b.online();
        // Watched for long.
        b.run(30_000);
        b.sim.axis(0).post(Command::Enable).unwrap();
        for _ in 0..200 {
            b.run(1);
            assert!(b.feedback(0).age < 20, "{via:?}: {:?}", b.feedback(0));
        }
        for velocity in [4.0, -6.0] {
            b.turning(0, velocity);
            let rpm = b.tap(0).read(b.now(), Parameter::SPEED) as i16;
            assert!((f64::from(rpm) / 600.0 - velocity).abs() < 0.1, "{via:?}: {rpm} tenths of rpm");
        }
        assert_eq!(both(&b), 0, "{via:?}");
        let counters = b.finish().drives[0].counters;
        assert_eq!((own(&counters), counters.missed, counters.late), (vec![], 0, 0), "{via:?}");
    }
}

/// Its answers to FC23 are lost, so that nobody knows whether they were carried out.
#[test]
fn a_write_carried_out_without_answer_is_not_repeated() {
    for via in VIAS {
        let mut served = bench(via, ReadWrite::Served);
        work(&mut served);
        let mut b = bench(via, ReadWrite::Served);
        b.online();
        b.tap(0).reply = Some(Box::new(|reply| {
            if reply.get(7) == Some(&function::READ_WRITE) {
                reply.clear();
            }
        }));
        work(&mut b);
        assert_eq!(both(&b), 1, "{via:?}");
        assert_eq!(commanded(&b, true), commanded(&served, true), "{via:?}");
        let counters = b.finish().drives[0].counters;
        assert_eq!(own(&counters), [(key(Own::NoReadWrite), 1)], "{via:?}");
        assert_eq!((counters.missed, counters.unsent), (1, counters.unsent), "{via:?}");
    }
}

/// No drive has it, so that it says what it says to a function that it does not have; but not of which.
const NO_FUNCTION: u8 = 43;

/// From now on the drive does not have FC23.
fn without_function_23(request: &mut [u8]) {
    if request[7] == function::READ_WRITE {
        request[7] = NO_FUNCTION;
    }
}

/// Its refusals name FC23.
fn as_function_23(reply: &mut [u8]) {
    if reply.get(7) == Some(&(NO_FUNCTION | function::EXCEPTION)) {
        reply[7] = function::READ_WRITE | function::EXCEPTION;
    }
}

#[test]
fn each_native_output_goes_out_though_the_wire_takes_one_at_a_time_and_its_function_is_refused() {
    for via in VIAS {
        let mut b = bench(via, ReadWrite::Served);
        b.ready();
        let mut native = b.sim.axis(0).native::<Native>().unwrap();
        b.sim.axis(0).post(Command::Native(NativeOwner::Application)).unwrap();
        b.until("native mode", 100, |_| native.inputs().running);
        b.tap(0).received.clear();
        let mut lacks = false;
        b.tap(0).request = Some(Box::new(move |request| {
            // From the first of them on.
            lacks |= reference(request) == Some(1);
            if lacks {
                without_function_23(request);
            }
        }));
        b.tap(0).reply = Some(Box::new(|reply| as_function_23(reply)));
        for reference in 1..=10 {
            native.write(NativeOutput { control: ControlWord::FORWARD, reference }).unwrap();
        }
        b.run(100);
        let mut written: Vec<i32> =
            b.tap(0).received.iter().filter_map(|request| reference(request)).collect();
        written.dedup();
        written.retain(|reference| *reference > 0);
        assert_eq!(written, Vec::from_iter(1..=10), "{via:?}");
    }
}
