//! Codes and records of a drive that exchanges data meanwhile, by each path, against the strict drive.

use fieldbeat::axis::{CallError, Link, ParameterError, ParameterTicket, Parameters, Scalar};
use fieldbeat::bus::profibus::{Numbers, ParameterPath, ProfibusPlan};
use fieldbeat::{CyclePlan, Simulation};
use fieldbeat_sim::profibus::Channel;

use super::{Lenze, PORT, wire};
use crate::virtual_time::commanding::{Subject, never_in_any_sequence, never_meet, refuses_while_on};

const MSAC1: ParameterPath = ParameterPath::Msac1 { slot: 0, index: 47, axis: 0, numbers: Numbers::FromTop };

/// A path, and what a drive at its other end does.
#[derive(Clone, Copy, Debug)]
struct Way {
    path: ParameterPath,
    bare: bool,
    /// Polls until an answer of MSAC1 comes.
    delay: u16,
}

const WAYS: [Way; 6] = [
    Way { path: ParameterPath::Pkw { pause: true }, bare: false, delay: 0 },
    Way { path: ParameterPath::Drivecom, bare: false, delay: 0 },
    Way { path: ParameterPath::Drivecom, bare: true, delay: 0 },
    Way { path: MSAC1, bare: false, delay: 0 },
    Way { path: MSAC1, bare: false, delay: 3 },
    Way { path: ParameterPath::Pkw { pause: false }, bare: false, delay: 0 },
];

fn machine_on(way: Way, mut bus: ProfibusPlan) -> Lenze {
    bus.drives.iter_mut().for_each(|drive| drive.parameters = way.path);
    Lenze::with(bus, CyclePlan::default(), |segment| {
        for drive in &mut segment.drives {
            drive.acyclic.delay = way.delay;
            if way.bare {
                drive.channel = Channel::DrivecomBare;
            }
        }
    })
}

fn machine(way: Way, drives: usize) -> Lenze {
    machine_on(way, wire(1_500_000, drives))
}

impl Lenze {
    fn parameters(&mut self, index: usize) -> Parameters {
        self.sim.axis(index).parameter()
    }

    /// The end of an access while the machine turns.
    fn ended<T: Scalar>(
        &mut self,
        ticket: Result<ParameterTicket<T>, ParameterError>,
    ) -> Result<T, ParameterError> {
        let mut ticket = ticket?;
        for _ in 0..10_000 {
            if let Some(end) = ticket.poll() {
                return end;
            }
            self.sim.step();
        }
        panic!("an access without an end")
    }

    fn get(&mut self, index: usize, address: &str) -> Result<i32, ParameterError> {
        let ticket = self.parameters(index).post_read(address);
        self.ended(ticket)
    }

    fn put(&mut self, index: usize, address: &str, value: i32) -> Result<(), ParameterError> {
        let ticket = self.parameters(index).post_write(address, value);
        self.ended(ticket)
    }

    fn kept_to_the_rules(&self) {
        for index in 0..self.count {
            assert_eq!(self.misuse(index).total(), 0, "{:?}", self.misuse(index));
        }
    }
}

#[test]
fn codes_are_read_and_written_by_each_path() {
    for way in WAYS {
        let mut m = machine(way, 2);
        m.online();
        assert_eq!(m.get(0, "C0061").unwrap(), 430_000, "{way:?}");
        m.put(0, "C0039/2", 1_504_000).unwrap();
        m.put(1, "C0039/2", -77).unwrap();
        for (index, value) in [(0, 1_504_000), (1, -77)] {
            assert_eq!(m.get(index, "C0039/2").unwrap(), value, "{way:?}");
            assert_eq!(m.look(index, |drive, _| drive.parameter(39, 2)), value, "{way:?}");
            assert_eq!(m.look(index, |drive, _| drive.eeprom_writes()), 1, "{way:?}");
        }
        // A value of 16 bits, and twice the same.
        let word = m.parameters(0).post_read::<u16>("C0093.u16");
        assert_eq!(m.ended(word).unwrap(), 2_133, "{way:?}");
        if !way.bare {
            // The reply says how many bits it has: they are obeyed, and an address that says others is refused.
            assert_eq!(m.get(0, "C0093").unwrap(), 2_133, "{way:?}");
            let refused = m.get(0, "C0093.i32").unwrap_err().to_string();
            let names_both = refused.contains("a word of 16 bits (format 42h), and its address says i32");
            assert!(names_both, "{way:?}: {refused}");
        }
        assert_eq!(m.get(0, "C0061").unwrap(), m.get(0, "C0061").unwrap());
        let refused = m.get(0, "C1999").unwrap_err().to_string();
        assert!(refused.contains("does not exist"), "{refused}");
        let refused = m.put(0, "C0039/2", 4_800_001).unwrap_err().to_string();
        assert!(refused.contains("a limit is exceeded") || refused.contains("too high"), "{refused}");
        let refused = m.get(0, "C0039/9").unwrap_err().to_string();
        assert!(refused.contains("subindex"), "{refused}");
        m.kept_to_the_rules();
        for counters in m.finish() {
            assert!(counters.missed == 0 && counters.malformed == 0, "{way:?}: {counters:?}");
        }
    }
}

#[test]
fn a_drive_that_restarts_in_a_write_leaves_it_uncertain_and_has_it_once() {
    for way in WAYS {
        for after in [0, 1, 2, 3, 4, 6, 9, 13] {
            let mut m = machine(way, 1);
            m.online();
            let mut ticket = m.parameters(0).post_write("C0039/2", 9).unwrap();
            m.sim.run(after);
            if let Some(end) = ticket.poll() {
                assert!(end.is_ok(), "{way:?} {after}");
                continue;
            }
            assert!(m.sim.world().restart_on(PORT, 0));
            let end = m.ended(Ok(ticket));
            let why = match &end {
                Err(ParameterError::Failed { why, .. }) => *why,
                other => panic!("{way:?} {after}: {other:?}"),
            };
            assert!(matches!(why, CallError::TimedOut | CallError::NotOnline), "{way:?} {after}: {why}");
            m.until("back", 20_000, |sim| sim.feedback(0).link == Link::Online);
            m.sim.run(200);
            let written = m.look(0, |drive, _| drive.eeprom_writes());
            assert!(written <= u64::from(why == CallError::TimedOut), "{way:?} {after}: {written} {why}");
            assert_eq!(m.get(0, "C0061").unwrap(), 430_000, "{way:?} {after}");
            m.kept_to_the_rules();
        }
    }
}

/// A drive and the codes that command it.
struct Guarded {
    m: Lenze,
    last: i32,
    received: usize,
}

fn guarded(way: Way) -> Guarded {
    Guarded { m: machine(way, 1), last: 0, received: 0 }
}

impl Subject for Guarded {
    const WATCHED: (&'static str, [u64; 2]) = ("C0039/2", [10_000, 20_000]);
    const COMMANDING: &'static [&'static str] = &["C0039", "C0011", "C0043", "C0135.u16", "C0999", "C0105"];
    const HARMLESS: (&'static str, u64) = ("C0012", 10_000);

    fn sim(&mut self) -> &mut Simulation {
        &mut self.m.sim
    }

    fn is_on(&mut self) -> bool {
        self.m.look(0, |drive, _| drive.axis_state()).is_powered()
    }

    fn received(&mut self) -> usize {
        // Each write has another value.
        let value = self.m.look(0, |drive, _| drive.parameter(39, 2));
        self.received += usize::from(value != self.last);
        self.last = value;
        self.received
    }
}

#[test]
fn a_lenze_drive_is_not_commanded_by_parameters_while_its_power_is_on() {
    for way in [WAYS[0], WAYS[1], WAYS[4], WAYS[5]] {
        refuses_while_on(guarded(way));
        never_meet(guarded(way));
        never_in_any_sequence(guarded(way), 1, 60);
    }
}
