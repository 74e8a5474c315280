//! A Unidrive and the parameters that command it.

use fieldbeat::axis::Acyclic;
use fieldbeat_core::axis::Call;
use fieldbeat_core::axis::acyclic::long;

use super::*;
use crate::virtual_time::commanding::{Subject, never_in_any_sequence, never_meet, refuses_while_on};

/// Preset reference 2, in 32 bits: the master never writes it.
const WATCHED: Parameter = Parameter::new(1, 22);

struct Unidrive {
    bench: Bench,
    received: usize,
}

fn unidrive(via: Via) -> Unidrive {
    Unidrive { bench: Bench::new(1, via, |_, _| {}), received: 0 }
}

impl Subject for Unidrive {
    const WATCHED: (&'static str, [u64; 2]) = ("01.022", [100, 200]);
    const COMMANDING: &'static [&'static str] = &[
        "06.042", "06.043", "06.015", "06.034", "06.000", "01.007", "01.014", "01.015", "01.021", "01.042",
        "02.003", "03.022", "03.023", "04.008", "04.011", "08.021", "10.032", "10.033", "10.038", "11.031",
        "00.011", "20.021", "22.011", "4.15.009", "4.15.013",
    ];
    const HARMLESS: (&'static str, u64) = ("02.011", 77);

    fn sim(&mut self) -> &mut Simulation {
        &mut self.bench.sim
    }

    fn is_on(&mut self) -> bool {
        let now = self.bench.now();
        self.bench.tap(0).status(now).active()
    }

    fn received(&mut self) -> usize {
        let address = WATCHED.address(Addressing::Standard, Width::Long).unwrap();
        let is_one = |request: &&Vec<u8>| match Request::parse(request) {
            Ok((_, Request::Write { address: written, .. })) => written == address,
            _ => false,
        };
        let received = std::mem::take(&mut self.bench.tap(0).received);
        self.received += received.iter().filter(is_one).count();
        self.received
    }
}

/// The same, which writes three parameters at once: the watched one is the first of them.
struct Blocks(Unidrive);

impl Subject for Blocks {
    const WATCHED: (&'static str, [u64; 2]) = Unidrive::WATCHED;
    const COMMANDING: &'static [&'static str] = &[];
    const HARMLESS: (&'static str, u64) = Unidrive::HARMLESS;

    fn writes(acyclic: &Acyclic, value: u64) -> Vec<Call> {
        let block = acyclic.notation().block(Self::WATCHED.0, 3).unwrap();
        assert_eq!(block.bytes, 4);
        long::write(block.address, &(value as u32).to_be_bytes().repeat(3))
    }

    crate::forward! { this => this.0;
        fn sim(&mut self) -> &mut Simulation;
        fn is_on(&mut self) -> bool;
        fn received(&mut self) -> usize;
    }
}

#[test]
fn a_unidrive_is_not_commanded_by_several_parameters_at_once_while_its_power_is_on() {
    for via in VIAS {
        refuses_while_on(Blocks(unidrive(via)));
        never_meet(Blocks(unidrive(via)));
        for seed in 0..2 {
            never_in_any_sequence(Blocks(unidrive(via)), seed, 150);
        }
    }
}

#[test]
fn a_unidrive_is_not_commanded_by_parameters_while_its_power_is_on() {
    for via in VIAS {
        refuses_while_on(unidrive(via));
        never_meet(unidrive(via));
        for seed in 0..2 {
            never_in_any_sequence(unidrive(via), seed, 150);
        }
    }
}
