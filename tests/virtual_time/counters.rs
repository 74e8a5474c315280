//! Every counter of what is not a plain exchange, provoked by its own cause alone: exact counts, and no other moves.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat::bus::linudp::ReplyTag;
use fieldbeat::bus::linudp::wire::{RequestDef, Response};
use fieldbeat::bus::{Counters, Unmatched};
use fieldbeat::cycle::status::Numbers;
use fieldbeat::sim::FaultPlan;
use fieldbeat::time::US;

use crate::virtual_time::support::*;

/// All counters by name. A new one breaks the build here, and then it wants a case below.
fn named(counters: Counters, unmatched: Unmatched) -> [(&'static str, i64); 12] {
    // A protocol's own counters have their tests beside it.
    let Counters { sent, unsent, answered, missed, late, duplicate, suspect, malformed, foreign, own: _ } =
        counters;
    let Unmatched { datagrams, dropped, errors } = unmatched;
    [
        ("sent", sent),
        ("unsent", unsent),
        ("answered", answered),
        ("missed", missed),
        ("late", late),
        ("duplicate", duplicate),
        ("suspect", suspect),
        ("malformed", malformed),
        ("foreign", foreign),
        ("datagrams", datagrams),
        ("dropped", dropped),
        ("errors", errors),
    ]
    .map(|(name, count)| (name, count as i64))
}

struct Case {
    /// The counter that it is about.
    counter: &'static str,
    /// Every request has its own echo: nothing is suspect then.
    tagged: bool,
    provoke: fn(&mut Bench),
    /// All that is not as in a run without it.
    differs: &'static [(&'static str, i64)],
}

const CASES: [Case; 18] = [
    Case {
        counter: "sent",
        tagged: false,
        // A run that goes on for so much longer.
        provoke: |b| b.run(7),
        differs: &[("sent", 7), ("answered", 7)],
    },
    Case {
        counter: "answered",
        tagged: true,
        provoke: |b| b.run(5),
        differs: &[("sent", 5), ("answered", 5)],
    },
    Case {
        counter: "unsent",
        tagged: false,
        provoke: |b| b.tape(0).jammed = true,
        differs: &[("unsent", 3), ("sent", -3), ("answered", -3)],
    },
    Case {
        counter: "missed",
        tagged: true,
        provoke: |b| b.tape(0).mute = true,
        differs: &[("missed", 3), ("answered", -3)],
    },
    // No reply is late, and none is suspect, but for one that was missed.
    Case {
        counter: "late",
        tagged: true,
        provoke: |b| answer_after(b, 600 * US),
        differs: &[("late", 3), ("missed", 3), ("answered", -3)],
    },
    Case {
        counter: "late",
        tagged: false,
        provoke: |b| answer_after(b, 600 * US),
        differs: &[("late", 3), ("missed", 3), ("answered", -3)],
    },
    Case {
        counter: "late",
        tagged: true,
        // Behind the request after it.
        provoke: |b| answer_after(b, 1_300 * US),
        differs: &[("late", 3), ("missed", 3), ("answered", -3)],
    },
    Case {
        counter: "suspect",
        tagged: false,
        provoke: |b| b.tape(0).mute = true,
        differs: &[("suspect", 1), ("missed", 3), ("answered", -3)],
    },
    Case {
        counter: "duplicate",
        tagged: true,
        provoke: |b| inject(b, address(0), |reply| reply),
        differs: &[("duplicate", 1)],
    },
    Case {
        counter: "duplicate",
        tagged: false,
        provoke: |b| inject(b, address(0), |reply| reply),
        differs: &[("duplicate", 1)],
    },
    Case {
        counter: "malformed",
        tagged: false,
        provoke: |b| inject_bytes(b, address(0), &[0; 7]),
        differs: &[("malformed", 1)],
    },
    Case {
        counter: "malformed",
        tagged: false,
        // Longer than any.
        provoke: |b| inject_bytes(b, address(0), &[0; 200]),
        differs: &[("malformed", 1)],
    },
    Case {
        counter: "foreign",
        tagged: false,
        // The echo of something that was never asked.
        provoke: |b| inject(b, address(0), |reply| Response { request_def: RequestDef::CONFIG, ..reply }),
        differs: &[("foreign", 1)],
    },
    Case {
        counter: "foreign",
        tagged: true,
        // From a wrong port.
        provoke: |b| inject(b, SocketAddrV4::new(*address(0).ip(), 5), |reply| reply),
        differs: &[("foreign", 1)],
    },
    Case {
        counter: "datagrams",
        tagged: false,
        provoke: |b| {
            inject(b, SocketAddrV4::new(Ipv4Addr::new(10, 9, 9, 9), address(0).port()), |reply| reply)
        },
        differs: &[("datagrams", 1)],
    },
    Case {
        counter: "datagrams",
        tagged: false,
        provoke: |b| inject_bytes(b, SocketAddrV4::new(Ipv4Addr::new(10, 9, 9, 9), 5), &[]),
        differs: &[("datagrams", 1)],
    },
    Case {
        counter: "dropped",
        tagged: false,
        provoke: |b| b.tape(0).dropped = 3,
        differs: &[("dropped", 3)],
    },
    Case {
        counter: "errors",
        tagged: false,
        provoke: |b| b.tape(0).deaf_once = true,
        differs: &[("errors", 1)],
    },
];

/// From now on each reply leaves so much later.
fn answer_after(b: &mut Bench, ns: u64) {
    assert!(b.world().set_faults(address(0), FaultPlan { answer_ns: ns, ..FaultPlan::default() }));
}

fn inject_bytes(b: &mut Bench, from: SocketAddrV4, bytes: &[u8]) {
    b.world().inject(MASTER, from, bytes, b.world().now());
}

/// Another telegram like the last one of the drive.
fn inject(b: &mut Bench, from: SocketAddrV4, change: fn(Response) -> Response) {
    let mut bytes = [0; 64];
    let size = change(b.tape(0).last()).emit(&mut bytes);
    inject_bytes(b, from, &bytes[..size]);
}

/// Three cycles with it, among as many without as it takes for all to be told.
fn run(tagged: bool, provoke: fn(&mut Bench)) -> Numbers {
    let mut b = Rig::new(2)
        .each(|_, drive| drive.reply_tag = if tagged { ReplyTag::Count } else { ReplyTag::Off })
        .start();
    b.ready();
    for index in 0..2 {
        b.post(index, slowly_to(100.0));
    }
    b.run(50);
    provoke(&mut b);
    b.run(3);
    answer_after(&mut b, 0);
    (b.tape(0).mute, b.tape(0).jammed) = (false, false);
    b.run(60);
    assert_eq!([0, 1].map(|index| b.feedback(index).stopped), [None; 2], "nothing of it is worth a stop");
    b.assert_grid();
    b.finish()
}

#[test]
fn every_counter_counts_its_own_cause_and_nothing_else() {
    let differences = |run: &Numbers, plain: &Numbers, drive: usize| -> Vec<(&'static str, i64)> {
        let of = |end: &Numbers| named(end.drives[drive].counters, end.buses[0].1);
        let more =
            of(run).into_iter().zip(of(plain)).map(|((name, count), (_, before))| (name, count - before));
        more.filter(|(_, more)| *more != 0).collect()
    };
    let plain = [false, true].map(|tagged| run(tagged, |_| {}));
    for (n, case) in CASES.iter().enumerate() {
        let what = format!("case {n}, {}", case.counter);
        let plain = &plain[usize::from(case.tagged)];
        let provoked = run(case.tagged, case.provoke);
        let found = differences(&provoked, plain, 0);
        assert_eq!(BTreeSet::from_iter(&found), BTreeSet::from_iter(case.differs), "{what}");
        assert!(found.iter().any(|(name, _)| *name == case.counter), "{what}");
        // Its neighbour sees only what belongs to the bus, or that the run was longer.
        let longer = ["sent", "answered"].contains(&case.counter);
        let mut shared = found;
        shared.retain(|(name, _)| longer || ["datagrams", "dropped", "errors"].contains(name));
        assert_eq!(differences(&provoked, plain, 1), shared, "{what}");
        let missed = provoked.drives.iter().map(|drive| drive.counters.missed + drive.counters.unsent);
        assert_eq!(provoked.status.missed, missed.sum::<u64>(), "{what}");
    }
    for (name, _) in named(Counters::default(), Unmatched::default()) {
        assert!(CASES.iter().any(|case| case.counter == name), "no case is about {name}");
    }
}
