use std::any::Any;

use super::*;
use fieldbeat_core::axis::{HeldBy, Load, PlanFault, Unit};
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

/// The keys of its faults, with a packet every 10 ms.
fn keys(drive: &MoonsDrive) -> Vec<&'static str> {
    drive.faults(MS * u64::from(drive.axis.divisor)).into_iter().map(|fault| fault.key).collect()
}

fn bus(drives: Vec<MoonsDrive>) -> EthernetIpPlan {
    EthernetIpPlan::new([192, 168, 1, 1].into(), drives)
}

#[test]
fn what_a_drive_cannot_do_is_a_fault_of_its_key() {
    type Change = fn(&mut MoonsDrive);
    const SEEK: Homing = Homing {
        method: HomingMethod::Seek,
        input: 0x4CB2,
        velocity: 1.0,
        acceleration: 10.0,
        distance: -20.0,
    };
    // With the change before each, too.
    let changes: [(Change, &[&str]); 11] = [
        (|_| (), &[]),
        (|drive| drive.fresh_within_ns = Some(10 * MS - 1), &["fresh_within"]),
        (|drive| drive.fresh_within_ns = Some(10 * MS), &[]),
        (|drive| drive.homing = Some(SEEK), &[]),
        (
            |drive| {
                drive.connection = Access::InputOnly;
                drive.enable_input = Some(EnableInput { number: 3, closed: true });
            },
            &["homing", "enable_input"],
        ),
        (|drive| (drive.homing, drive.enable_input) = (None, None), &[]),
        (|drive| drive.connection = Access::ListenOnly, &["delivery"]),
        (|drive| (drive.connection, drive.version) = (Access::Owner, Some(Version::V1)), &["connection"]),
        (
            |drive| {
                drive.version = None;
                let method = HomingMethod::Find;
                drive.homing = Some(Homing { method, input: 2, velocity: 3.0, distance: 2e6, ..SEEK });
                drive.axis.limits.homing = Some(2.0);
            },
            &["homing.input", "homing.distance", "homing.velocity"],
        ),
        // A command has to be seen in time, and a lost packet must not end the watchdog.
        (
            |drive| {
                drive.homing = None;
                (drive.effect_within_ns, drive.watchdog.within_ns) = (40 * MS, Some(20 * MS));
            },
            &[],
        ),
        (
            |drive| (drive.effect_within_ns, drive.watchdog.within_ns) = (40 * MS - 1, Some(20 * MS - 1)),
            &["effect_within", "watchdog"],
        ),
    ];
    let mut fast = drive();
    let mut drive = drive();
    for (row, (change, expected)) in changes.into_iter().enumerate() {
        change(&mut drive);
        assert_eq!(keys(&drive), expected, "row {row}");
    }
    fast.axis.divisor = 1;
    assert_eq!(fast.faults(999_000)[0].key, "divisor");
    assert_eq!((fast.faults(MS), bus(vec![fast.clone()]).faults(MS)), (vec![], vec![]));
    assert_eq!(fast.faults(1_000_100)[0].key, "divisor", "no whole microseconds");
    (fast.input_rpi_ns, fast.first_within_ns) = (Some(11 * S), 20 * S);
    assert!(keys(&fast).contains(&"input_rpi"));
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
fn a_time_out_is_long_enough_for_a_stop_and_at_least_100_ms_or_a_fault_that_names_the_factor() {
    // 4, 8, 16 and 32 packets of 10 ms; after 90 ms, and after 240 ms, the stop has left.
    for (divisor, bucket, timeout_ms) in [(10, 5, 160), (10, 20, 320), (2, 1, 128), (50, 1, 400)] {
        let mut drive = drive();
        (drive.axis.divisor, drive.axis.health.bucket) = (divisor, bucket);
        assert_eq!((keys(&drive), drive.timeout_ns(MS)), (vec![], timeout_ms * MS), "{divisor} {bucket}");
    }
    let mut drive = drive();
    drive.multiplier = Some(1);
    let why = "ends the connection after 80 ms, before the stop request that follows a loss within 90 ms; \
         use 16 or more";
    assert_eq!(drive.faults(10 * MS), [PlanFault::new("timeout_multiplier", why)]);
    drive.multiplier = Some(2);
    assert_eq!(keys(&drive), [""; 0]);
    // The drive's packets come more often than ours: their time-out is the shorter one.
    drive.input_rpi_ns = Some(2 * MS);
    assert_eq!(keys(&drive), ["timeout_multiplier"]);
    // Commands are as far apart as their packets and the idle ones.
    assert_eq!(drive.command_every_ns(MS), 40 * MS);
    drive.hold = 3;
    assert_eq!(drive.command_every_ns(MS), 60 * MS);
}

/// 32000 is 133.3 rev/s, and 5333 rev/s²: not sixty times that, as a misprint in the tables says.
#[test]
fn the_range_of_the_wire_is_said_in_user_units() {
    let mut drive = drive();
    // A screw of 5 mm.
    drive.axis.units.counts_per_unit = 4_000.0;
    drive.axis.units.unit = Unit::Millimetre;
    assert_eq!(drive.velocity_on_wire(5.0), 240.0);
    assert_eq!(drive.acceleration_on_wire(5.0), 6.0);
    drive.axis.profile.velocity = 666.0;
    drive.axis.stop.timeout = std::time::Duration::from_secs(100);
    drive.axis.profile.acceleration = 26_666.0;
    assert_eq!(keys(&drive), [""; 0]);
    drive.axis.profile.velocity = 667.0;
    drive.axis.profile.deceleration = 26_667.0;
    drive.axis.stop.deceleration = 0.8;
    let faults = drive.faults(10 * MS);
    let keys: Vec<_> = faults.iter().map(|fault| fault.key).collect();
    assert_eq!(keys, ["profile.velocity", "profile.deceleration", "stop.deceleration"]);
    let why = "667 is outside the range of the drive, 0.02084 ... 666.6 mm/s; change it or \
        check scale and steps_per_rev";
    assert_eq!(faults[0].message, why);
}

#[test]
fn addresses_of_two_drives_and_of_the_master_differ_and_another_machine_has_its_own() {
    let keys = |plan: &EthernetIpPlan| {
        plan.faults(MS).into_iter().map(|(index, fault)| (index, fault.key)).collect::<Vec<_>>()
    };
    let mut other = drive();
    other.axis.name = "n".into();
    other.address.set_port(5);
    assert_eq!(keys(&bus(vec![drive(), other.clone()])), [(1, "address")]);
    other.address.set_ip([192, 168, 1, 1].into());
    let mut plan = bus(vec![drive(), other]);
    assert_eq!(plan.faults(MS).len(), 1);
    plan.bind.set_ip(Ipv4Addr::UNSPECIFIED);
    assert!(matches!(keys(&plan)[..], [(_, "bind")]));
    // A group sends to one port only.
    plan.bind = SocketAddrV4::new([192, 168, 1, 9].into(), 2223);
    plan.drives[1].delivery = Delivery::Multicast;
    assert_eq!(keys(&plan), [(1, "delivery")]);
    // Another machine has its own.
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
fn check_says_intervals_commands_and_what_happens_if_the_master_dies() {
    let mut drive = drive();
    drive.axis.load = Load::Vertical(HeldBy::Drive);
    let plan = bus(vec![drive.clone()]);
    let says = plan.describe(GRID).remove(0);
    let lines: Vec<&str> = says.lines().collect();
    assert_eq!(lines[0], "192.168.1.1:2222 -> 192.168.1.40:44818");
    for part in [
        "a packet to it every 10 ms, times out after 160 ms; one from it every 10 ms (to this master only), \
         times out after 160 ms (timeout_multiplier = 16); the first one within 1 s",
        "two commands, and two velocities, are 40 ms apart at least",
        "if the master dies: the drive begins to stop within 500 ms by its own watchdog (ZS, ZA), taken on \
         trust: no message of the manual reads them; ZA must leave it enabled, 13 or 14, since only the \
         drive holds its load",
    ] {
        assert!(says.contains(part), "{part}\n{says}");
    }
    let stops_within_ns = |plan: &EthernetIpPlan| plan.facts(GRID).drives[0].watchdog_ns;
    assert_eq!(stops_within_ns(&plan), Some(500 * MS));
    (drive.watchdog.within_ns, drive.watchdog.accept_none) = (None, true);
    assert_eq!(stops_within_ns(&bus(vec![drive.clone()])), None);
    drive.connection = Access::InputOnly;
    let says = drive.describe(plan.bind, MS);
    assert!(says.contains("no motion: the connection is \"input-only\""), "{says}");
    assert!(says.ends_with("if the master dies: nothing of this master moves the drive"), "{says}");
}

#[test]
fn what_is_shown_has_its_names_in_its_order_and_an_alarm_word_that_of_the_alarm_that_took_the_current() {
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
