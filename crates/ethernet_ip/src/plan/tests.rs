//! What is wrong with a plan, and its message, stands in `tests/offline/config`.

use std::any::Any;

use super::*;
use fieldbeat_core::bus::variant::Variant;
use fieldbeat_core::bus::{BusPlan, Grid};
use fieldbeat_core::cycle::bound::{Paced, bound, stop_bound};
use fieldbeat_core::cycle::{CyclePlan, Plan};

/// That of the usual cycle.
const GRID: Grid = Grid { period_ns: MS, deadline_ns: MS / 2 };

/// With a packet every ten cycles of 1 ms.
fn drive() -> MoonsDrive {
    let mut drive = MoonsDrive::new("m", [192, 168, 1, 40].into());
    drive.axis.divisor = 10;
    drive
}

fn bus(drives: Vec<MoonsDrive>) -> EthernetIpPlan {
    EthernetIpPlan::new([192, 168, 1, 1].into(), drives)
}

#[test]
fn packets_are_whole_microseconds_apart_and_the_shorter_one_of_two_time_outs_counts() {
    let first = |drive: &MoonsDrive, period_ns| drive.faults(period_ns).first().map(|fault| fault.key);
    for (rpi_ns, expected) in [(999_000, Some("divisor")), (MS, None), (1_000_100, Some("divisor"))] {
        assert_eq!(first(&MoonsDrive::new("m", [192, 168, 1, 40].into()), rpi_ns), expected, "{rpi_ns}");
    }
    // The drive's packets come more often than ours.
    for (input_rpi_ns, expected) in [(None, None), (Some(2 * MS), Some("timeout_multiplier"))] {
        let drive = MoonsDrive { multiplier: Some(2), input_rpi_ns, ..drive() };
        assert_eq!(first(&drive, 10 * MS), expected, "{input_rpi_ns:?}");
    }
}

#[test]
fn the_bound_of_the_loop_is_what_a_connection_has_to_outlive() {
    for (divisor, bucket, fresh_within_ns) in [(10, 5, None), (4, 1, Some(5 * MS + 1)), (1, 7, Some(30 * MS))]
    {
        let mut drive = drive();
        (drive.axis.divisor, drive.axis.health.bucket, drive.fresh_within_ns) =
            (divisor, bucket, fresh_within_ns);
        let expected = drive.loss_to_stop_ns(MS);
        let bus = bus(vec![drive]);
        let (cycle, facts) = (CyclePlan::default(), bus.facts(GRID));
        let paced = Paced::of(GRID, &facts.drives[0], bus.axes()[0]);
        assert_eq!(expected, bound(&paced, &[paced]) * MS);
        let plan = Plan { source: None, cycle, buses: vec![Box::new(bus)], groups: Vec::new() };
        assert_eq!(expected, stop_bound(&plan, 0) * MS);
    }
}

#[test]
fn another_machine_has_addresses_of_its_own() {
    let plan = bus(vec![drive()]);
    let wanted = Variant { was_ns: MS, period_ns: MS / 4, drives: Some(3), place: 1 };
    let other = plan.variant(&wanted).unwrap() as Box<dyn Any>;
    let other = other.downcast::<EthernetIpPlan>().unwrap();
    assert_eq!(other.bind, SocketAddrV4::new([192, 241, 1, 1].into(), IO_PORT));
    assert_eq!(other.originator, Originator::at([192, 241, 1, 1].into()));
    let addresses: Vec<_> = other.drives.iter().map(|drive| drive.address.ip().octets()[3]).collect();
    assert_eq!(addresses, [40, 41, 42]);
    assert!(other.drives.iter().all(|drive| drive.rpi_ns(MS / 4) == 10 * MS));
    assert_eq!(other.faults(MS / 4), []);
}

#[test]
fn monitored_values_are_named_in_order_and_an_alarm_word_by_the_alarm_that_cut_the_current() {
    let inputs = Inputs {
        voltage: 242,
        temperature: 305,
        main_inputs: 0xFF,
        position_error: Some(-3),
        ..Inputs::default()
    };
    assert_eq!(MoonsDrive::monitor(&inputs), [Some(24.2), Some(30.5), Some(255.0), Some(-3.0)]);
    let names = |drive: &MoonsDrive| drive.shown().map(|channel| channel.map(|channel| channel.name));
    assert_eq!(names(&drive())[0].as_deref(), Some("supply-voltage"));
    assert_eq!(names(&drive())[3].as_deref(), Some("position-error"));
    assert_eq!(names(&MoonsDrive { layout: Layout::Page, ..drive() })[3], None);
    let name = bus(Vec::new()).facts(GRID).fault_names;
    assert_eq!([0x0002, 0x0202, 0].map(name), [Some("CCW limit"), Some("bad encoder"), None]);
}
