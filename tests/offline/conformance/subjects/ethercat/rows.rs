//! Slaves with one oddity each, as real ones have them, and all else as usual: what fails here is named by its row.
//!
//! Each row shows by the registers and counts of its simulated slaves that a master met the oddity.

use std::any::Any;
use std::ops::Range;

use fieldbeat::axis::Link;
use fieldbeat::bus::ethercat::{Area, Terminals};
use fieldbeat::sim::{FaultPlan, SimSegment};
use fieldbeat::time::{MS, S, Time};
use fieldbeat_core::axis::acyclic::long::Target as _;
use fieldbeat_core::net::frames::MAC;
use fieldbeat_ethercat::counters::Own;
use fieldbeat_ethercat::wire::frame::{BROADCAST, Builder, Command as Frame, position};
use fieldbeat_ethercat::wire::registers::{Features, Links, address};
use fieldbeat_ethercat::wire::sii::Status;
use fieldbeat_sim::ethercat::esc::Met;
use fieldbeat_sim::ethercat::{ClockKind, EthercatSim, MailboxSettings, Misuse, Model, SiiContent};

use super::FREE;
use super::slaves::{COUPLER, Front, IO, PLAIN, Slaves, UNWATCHED, WATCHED, area};
use crate::conformance::acyclic::{end, post};
use crate::conformance::machine::Machine;
use crate::conformance::subject::Subject;

/// Slaves with one oddity.
pub struct Row {
    pub slaves: Slaves,
    /// Fails if a machine in operation does not have it, or has not met it.
    met: fn(&mut Machine),
    /// Why the device in front is refused, if it is.
    refused: Option<&'static str>,
}

/// Slaves without one. Their SIIs return eight bytes, so that four are an oddity.
const USUAL: Row = Row { slaves: Slaves { eight: true, ..PLAIN }, met: |_| {}, refused: None };

/// The vendor of the drives.
const KOLLMORGEN: u32 = 0x6A;
/// The positions of the drives where nothing is in front of them.
const DRIVES: [u16; 2] = [0, 1];

/// Its AL status is what AL control says, an acknowledgement included.
pub const DEVICE_EMULATION: Row = Row {
    slaves: Slaves { front: &[Front { emulated: true, ..COUPLER }], ..USUAL.slaves },
    met: |m| {
        assert_eq!(register(m, 0, address::EMULATION), [1]);
        assert!([0, 1, 2].iter().all(|place| misuse(m, *place).needless_acknowledges == 0));
        assert_eq!([register(m, 0, address::AL_CONTROL), register(m, 0, address::AL_STATUS)], [[8, 0]; 2]);
    },
    ..USUAL
};

/// Those of an SII without a watchdog, which is remarked, and of one with it.
pub const EXACT_SYNC_MANAGERS: Row = Row {
    slaves: Slaves { fit: |of| of.exact_managers(if of.last { WATCHED } else { UNWATCHED }), ..USUAL.slaves },
    met: |m| {
        let control = |place| register::<1>(m, place, address::sync_manager(2) + 4)[0];
        assert_eq!(DRIVES.map(control), [UNWATCHED, WATCHED]);
        assert!(DRIVES.iter().all(|place| met(m, *place).exact_managers == 3), "PREOP, SAFEOP, OP");
        let remarks = m.sim.remarks();
        assert!(
            matches!(&remarks[..], [one] if one.contains("place 0: its SII arms no watchdog")),
            "{remarks:?}"
        );
    },
    ..USUAL
};

pub const TWO_SYNC_MANAGERS: Row = Row {
    slaves: Slaves {
        front: &[Front {
            outputs: &[area(0x1000, 1), area(0x1100, 1)],
            inputs: &[area(0x1200, 1), area(0x1300, 1)],
            ..IO
        }],
        ..USUAL.slaves
    },
    met: |m| {
        let is_on = |n| register::<1>(m, 0, address::sync_manager(n) + 6) == [1];
        assert_eq!([0, 1, 2, 3, 4].map(is_on), [true, true, true, true, false]);
        assert_moves(m, &["io"], [0xFF, 0xFF]);
    },
    ..USUAL
};

/// It is taken from the processor, which refuses PREOP until it is given back.
pub const SII_OF_ITS_PROCESSOR: Row = Row {
    slaves: Slaves { fit: |of| of.owned_sii(), ..USUAL.slaves },
    met: |m| {
        for place in DRIVES {
            assert_eq!((met(m, place).sii_forced, register(m, place, address::SII_OWNER)), (1, [1, 1]));
        }
    },
    ..USUAL
};

pub const SII_OF_FOUR_BYTES: Row =
    Row { slaves: Slaves { eight: false, ..USUAL.slaves }, met: |m| assert_reads(m, false, 15..30), ..USUAL };

/// What is read with the requested words is not read again.
pub const SII_OF_EIGHT_BYTES: Row = Row { met: |m| assert_reads(m, true, 5..15), ..USUAL };

pub const SII_WITH_A_WRONG_CHECKSUM: Row = Row {
    slaves: Slaves {
        front: &[Front { fit: |slave| slave.sii.content = SiiContent::WrongCheck, ..IO }],
        ..USUAL.slaves
    },
    met: |m| assert!(Status(u16::from_le_bytes(register(m, 0, address::SII_CONTROL))).unsound()),
    refused: Some("checksum"),
};

/// Their identity is that of the plan, so they come up by that. A watchdog that is left to the SII they have not.
pub const SII_OF_NOISE: Row = Row {
    slaves: Slaves {
        fit: |of| {
            of.slave.sii.content = SiiContent::Garbage;
            of.watchdog_of_its_sii();
        },
        ..USUAL.slaves
    },
    met: |m| {
        let remarks = m.sim.remarks();
        let named = remarks.iter().filter(|remark| remark.contains("its SII has no SyncManagers"));
        assert_eq!(named.count(), 2, "{remarks:?}");
    },
    ..USUAL
};

/// The first time only: as a vendor that would be another one.
pub const SII_OF_ANOTHER_ADDRESS: Row = Row {
    slaves: Slaves {
        fit: |of| {
            of.slave.sii.slips = true;
            of.plan.slave.identity.vendor = Some(KOLLMORGEN);
        },
        ..USUAL.slaves
    },
    met: |m| {
        assert_eq!(DRIVES.map(|place| met(m, place).sii_slipped), [1, 1]);
        // The one word is read again, not all of them after a refusal.
        assert_reads(m, true, 5..15);
    },
    ..USUAL
};

/// Of each three reads one, which shows that until it is acknowledged.
pub const SII_WITH_FAILING_READS: Row = Row {
    slaves: Slaves { fit: |of| of.slave.sii.fails_every = 3, ..USUAL.slaves },
    met: |m| assert!(DRIVES.iter().all(|place| met(m, *place).sii_failed >= 2)),
    ..USUAL
};

pub const SII_THAT_IS_NOT_LOADED: Row = Row {
    slaves: Slaves {
        front: &[Front { fit: |slave| slave.sii.content = SiiContent::Unloaded, ..IO }],
        ..USUAL.slaves
    },
    met: |m| {
        assert!(Status(u16::from_le_bytes(register(m, 0, address::SII_CONTROL))).unsound());
        assert!(met(m, 0).sii_failed >= 3);
    },
    refused: Some("it has not loaded its EEPROM"),
};

pub const SLOW_SII: Row = Row {
    slaves: Slaves { fit: |of| of.slow_sii(10 * MS, 200 * MS), ..USUAL.slaves },
    met: |m| {
        for place in DRIVES {
            let met = met(m, place);
            assert!(met.sii_busy > 3 * met.sii_reads, "{met:?}");
        }
    },
    ..USUAL
};

pub const DIGITAL_2: Row = Row {
    slaves: Slaves {
        front: &[output(Model::El2002, &[BYTE]), input(Model::El1002, &[area(0x1000, 1)])],
        ..USUAL.slaves
    },
    met: |m| assert_digital(m, [0x03, 0]),
    ..USUAL
};

pub const DIGITAL_4: Row = Row {
    slaves: Slaves {
        front: &[output(Model::El2004, &[BYTE]), input(Model::El1004, &[area(0x1000, 1)])],
        ..USUAL.slaves
    },
    met: |m| assert_digital(m, [0x0F, 0]),
    ..USUAL
};

pub const DIGITAL_8: Row = Row {
    slaves: Slaves {
        front: &[output(Model::El2008, &[BYTE]), input(Model::El1008, &[area(0x1000, 1)])],
        ..USUAL.slaves
    },
    met: |m| assert_digital(m, [0xFF, 0]),
    ..USUAL
};

/// Outputs behind two SyncManagers, inputs behind one.
pub const DIGITAL_16: Row = Row {
    slaves: Slaves {
        front: &[output(Model::El2809, &[BYTE, area(0x0F01, 1)]), input(Model::El1809, &[area(0x1000, 2)])],
        ..USUAL.slaves
    },
    met: |m| assert_digital(m, [0xFF, 0xFF]),
    ..USUAL
};

/// Two are enough for outputs and inputs: the frames do not show their AL status.
pub const NO_FMMU_TO_SPARE: Row = Row {
    slaves: Slaves {
        front: &[Front {
            outputs: &[area(0x1000, 2)],
            inputs: &[area(0x1100, 2)],
            fit: |slave| slave.fmmus = Some(2),
            ..IO
        }],
        fit: |of| of.two_fmmus(),
        ..USUAL.slaves
    },
    met: |m| {
        assert_eq!([0, 1, 2].map(|place| register(m, place, address::RESOURCES)), [[2]; 3]);
        assert_moves(m, &["io"], [0xFF, 0xFF]);
    },
    ..USUAL
};

pub const TOO_FEW_FMMUS: Row = Row {
    slaves: Slaves {
        front: &[Front {
            outputs: &[BYTE, area(0x0F02, 1)],
            inputs: &[area(0x1000, 2)],
            fit: |slave| slave.fmmus = Some(2),
            ..IO
        }],
        ..USUAL.slaves
    },
    met: |m| assert_eq!(register(m, 0, address::RESOURCES), [2]),
    refused: Some("place 0: it has 2 FMMUs, too few for its outputs and inputs"),
};

/// They begin again every 4.3 s, each at another time.
pub const CLOCKS_OF_32_BITS: Row = Row {
    slaves: Slaves { fit: |of| of.slave.clock = Some(ClockKind::Short), ..USUAL.slaves },
    met: |m| {
        assert!(DRIVES.iter().all(|place| !features(m, *place).has_long_clock()));
        let missed = m.sim.status().missed;
        let mut before = [0; 2];
        let mut wraps = [0; 2];
        for _ in 0..9 {
            m.run(500);
            let times = system_times(m, DRIVES);
            for index in 0..2 {
                wraps[index] += u32::from(times[index] < before[index]);
            }
            before = times;
            assert!(times[0].abs_diff(times[1]) < 1_000, "{times:?}");
        }
        assert_eq!((wraps, m.sim.status().missed), ([1; 2], missed));
    },
    ..USUAL
};

pub const NO_CLOCKS: Row = Row {
    slaves: Slaves {
        fit: |of| {
            of.plan.slave.sync = false;
            of.slave.clock = Some(ClockKind::None);
        },
        ..USUAL.slaves
    },
    met: |m| assert!(DRIVES.iter().all(|place| !features(m, *place).has_clock())),
    ..USUAL
};

/// Cables of 500 ns: as a line, the clock of the last drive would be 1 us off.
pub const BRANCH: Row = Row {
    slaves: Slaves {
        front: &[Front { name: "junction", model: Some(Model::Ek1122), ..IO }],
        fit: |of| of.branch(),
        ..USUAL.slaves
    },
    met: |m| {
        let [first, last] = system_times(m, [1, 2]);
        assert!(first.abs_diff(last) < 200, "{first} {last}");
        let links = Links(u16::from_le_bytes(register(m, 0, address::LINKS)));
        assert_eq!([0, 1, 2, 3].map(|port| links.link(port)), [true, true, true, false]);
    },
    ..USUAL
};

/// Some answers come later than most masters wait, and sooner than its description says.
pub const SLOW_MAILBOX: Row = Row {
    slaves: Slaves {
        fit: |of| {
            let late = MailboxSettings { delay_ns: 800 * MS, delay_every: 7, ..MailboxSettings::default() };
            of.mailbox(late);
            of.plan.slave.sdo_timeout_ns = 2 * S;
        },
        soon: 900,
        ..USUAL.slaves
    },
    met: |m| assert!(DRIVES.iter().all(|place| met(m, *place).late_answers > 0)),
    ..USUAL
};

pub const LOST_ANSWERS: Row = Row {
    slaves: Slaves {
        fit: |of| of.mailbox(MailboxSettings { lose_every: 7, ..MailboxSettings::default() }),
        soon: 250,
        ..USUAL.slaves
    },
    met: |m| assert!(DRIVES.iter().all(|place| met(m, *place).lost_answers > 0)),
    ..USUAL
};

/// It is requested where a frame with a message was lost; then the call is.
pub const REPEAT_ACKNOWLEDGED_ONLY: Row = Row {
    slaves: Slaves { fit: |of| of.slave.mailbox.resends = false, ..USUAL.slaves },
    met: |m| {
        m.faults(0, FaultPlan { drop: 0.02, ..FaultPlan::default() });
        for _ in 0..150 {
            let mut tickets = [0, 1].map(|index| post(m, index, FREE.read()));
            for ticket in &mut tickets {
                assert_eq!(end(m, ticket, 500).err(), None);
            }
        }
        let repeats = DRIVES.map(|place| met(m, place).unheeded_repeats);
        assert!(repeats.iter().all(|repeats| *repeats > 2), "{repeats:?}");
        m.faults(0, FaultPlan::default());
        assert!((0..2).all(|index| m.feedback(index).link == Link::Online), "neither was set up anew");
    },
    ..USUAL
};

/// The cycle time, 60C2h, can only be read: they find their cycle by SYNC0.
pub const CYCLE_TIME_READ_ONLY: Row = Row {
    slaves: Slaves { fit: |of| of.drive.read_only = vec![0x60C2], ..USUAL.slaves },
    met: |m| {
        let remarks = m.sim.remarks();
        let named = |remark: &&String| remark.contains("it does not take the cycle time (0x60c2:2)");
        assert_eq!(remarks.iter().filter(named).count(), 2, "{remarks:?}");
    },
    ..USUAL
};

/// Drives of another maker, without 60C2h and 1002h: one has its reference once its homing was attained, the other one
/// by its encoder.
pub const WITHOUT_OPTIONAL_OBJECTS: Row = Row {
    slaves: Slaves {
        fit: |of| {
            of.drive.without = vec![0x60C2, 0x1002];
            of.plan.absolute = !of.last;
        },
        ..USUAL.slaves
    },
    met: |m| {
        let remarks = m.sim.remarks();
        assert_eq!(
            remarks.iter().filter(|remark| remark.contains("no such object")).count(),
            2,
            "{remarks:?}"
        );
        assert_eq!([0, 1].map(|index| m.feedback(index).status.homed), [true; 2]);
    },
    ..USUAL
};

/// Outputs of a small terminal.
const BYTE: Area = area(0x0F00, 1);

/// A terminal whose outputs are wired to the inputs of the next one.
const fn output(model: Model, outputs: &'static [Area]) -> Front {
    Front { name: "out", model: Some(model), outputs, fit: |slave| slave.wired_to = Some(1), ..IO }
}

const fn input(model: Model, inputs: &'static [Area]) -> Front {
    Front { name: "in", model: Some(model), inputs, ..IO }
}

impl Row {
    /// Brings such a segment up, shows that the oddity was met, and goes to the orderly end.
    pub fn is_met(&self, subject: &'static dyn Subject) {
        // A row may lose frames, which is not what its links are lost by.
        let mut m = Machine::new(subject, 2, |_, drive| drive.axis.health.bucket = 50);
        m.ready();
        if self.refused.is_some() {
            // The drives are not kept waiting by it.
            m.run(1_000);
        }
        (self.met)(&mut m);
        m.sim.stop();
        m.until_end(20_000);
        for place in 0..self.slaves.front.len() as u16 + 2 {
            assert_eq!(register(&m, place, address::AL_STATUS), [1, 0], "INIT, and no error: place {place}");
            // A needless acknowledgement is what device emulation shows.
            let Misuse { needless_acknowledges, .. } = misuse(&m, place);
            let tolerated = Misuse { needless_acknowledges, ..Misuse::default() };
            assert_eq!(misuse(&m, place), tolerated, "place {place}");
        }
        let end = m.sim.finish();
        for drive in &end.drives {
            let own = |own: Own| drive.counters.own[own as usize];
            assert_eq!((own(Own::AlErrors), own(Own::WrongCount)), (0, 0), "{}", drive.name);
            assert_eq!(drive.not_connected, None, "{}", drive.name);
        }
        for device in end.devices {
            let (why, expected) =
                (device.not_operational.unwrap_or_default(), self.refused.unwrap_or_default());
            assert!(
                why.contains(expected) && why.is_empty() == expected.is_empty(),
                "{}: {why}",
                device.name
            );
        }
    }
}

fn segment<R>(m: &Machine, look: impl FnOnce(&mut EthercatSim, Time) -> R) -> R {
    m.line(|line, now| {
        let line: &mut dyn Any = line;
        look(line.downcast_mut().expect("it is a segment"), now)
    })
}

fn met(m: &Machine, place: u16) -> Met {
    segment(m, |line, _| line.slave(place.into()).expect("a slave").met())
}

fn misuse(m: &Machine, place: u16) -> Misuse {
    segment(m, |line, _| line.slave(place.into()).expect("a slave").misuse())
}

/// What any master reads there.
fn register<const N: usize>(m: &Machine, place: u16, register: u16) -> [u8; N] {
    let mut frame = vec![0; 64];
    let mut builder = Builder::new(&mut frame, BROADCAST, MAC).expect("there is room");
    let at = builder.push(Frame::Aprd(position(place), register), 0, N).expect("there is room");
    builder.finish();
    segment(m, |line, now| line.pass(now, &mut frame));
    frame[at.data()].try_into().expect("as many bytes")
}

fn features(m: &Machine, place: u16) -> Features {
    Features(u16::from_le_bytes(register(m, place, address::FEATURES)))
}

/// Before frames of `register` have passed: they come to one slave later than to another.
fn system_times(m: &Machine, places: [u16; 2]) -> [u64; 2] {
    segment(m, |line, now| places.map(|place| line.slave(place.into()).expect("a slave").system_time(now)))
}

/// Its SII was read so often, `eight` bytes at a time or four.
fn assert_reads(m: &Machine, eight: bool, times: Range<u32>) {
    for place in DRIVES {
        let status = Status(u16::from_le_bytes(register(m, place, address::SII_CONTROL)));
        let reads = met(m, place).sii_reads;
        assert!(status.reads_eight() == eight && times.contains(&reads), "{status:?}, {reads} reads");
    }
}

/// The outputs of the first of these devices are seen at the inputs of the last one, through this mask.
fn assert_moves(m: &mut Machine, names: &[&str], mask: [u8; 2]) {
    let mut devices: Vec<Terminals> =
        names.iter().map(|name| m.sim.device(name).expect("it is a device")).collect();
    for device in &devices {
        m.until("operational", 5_000, |_| device.inputs().operational);
    }
    for bytes in [[0x5A, 0x81], [0xA5, 0x7E], [0xFF; 2], [0; 2]] {
        let outputs = &bytes[..devices[0].sizes().0];
        devices[0].write(outputs).expect("they have this size");
        m.run(10);
        let seen: Vec<u8> = outputs.iter().zip(mask).map(|(byte, mask)| byte & mask).collect();
        assert_eq!(devices[devices.len() - 1].inputs().bytes(), seen, "{outputs:x?}");
    }
}

/// A digital terminal and the one that its outputs are wired to: their areas are registers, or begin there.
fn assert_digital(m: &mut Machine, mask: [u8; 2]) {
    assert_eq!(register(m, 0, address::SYNC_MANAGER), [0x00, 0x0F, 1, 0]);
    assert_moves(m, &["out", "in"], mask);
}
