//! What only an EtherCAT segment has: places, PDOs, clocks, slaves that are no drives.

use fieldbeat::time::US;
use fieldbeat_config::describe;

use super::read;

/// One drive with a fragment in one section: `cycle`, `bus`, its own (empty), or a `device`. It begins in line 2, 6, 9
/// or 12.
pub fn line(section: &str, fragment: &str) -> String {
    let part = |name: &str| if name == section { fragment } else { "" };
    let device = match part("device") {
        "" => String::new(),
        fragment => format!("[[bus.device]]\nname = \"io\"\n{fragment}\n"),
    };
    format!(
        "[cycle]\n{}\n[[bus]]\nprotocol = \"ethercat\"\ninterface = \"eth1\"\n{}\n\
         [[bus.drive]]\nname = \"k\"\n{}\n{device}",
        part("cycle"),
        part("bus"),
        part(""),
    )
}

#[test]
fn a_segment_without_a_drive_is_told_by_its_devices() {
    let sample = std::fs::read_to_string("../../rt-config/terminals.toml").unwrap();
    let reported = describe(&read(&sample));
    assert_eq!(reported[0], "m.toml: 4 devices, 1 bus");
    for line in [
        "bus ethercat: ethercat, 4 devices",
        "  device coupler: eth1, place 0; vendor 0x2, product 0x44C2C52, any revision; 0 bytes out, 0 in",
        "  device switches: eth1, place 1; vendor 0x2, product 0x3F03052, any revision; 0 bytes out, 1 in \
         (0x1000)",
        "  device valves: eth1, place 2; vendor 0x2, product 0x7D83052, any revision; 1 byte out (0x0F00), 0 \
         in; its watchdog is as its SII has it (of most digital terminals 100 ms)",
        "  device pressure: eth1, place 3; vendor 0x2, product 0xC1E3052, any revision; 0 bytes out, 8 in \
         (0x1180)",
    ] {
        assert!(reported.iter().any(|other| other == line), "{line}\n{reported:#?}");
    }
}

#[test]
fn nothing_is_said_of_what_is_looked_at() {
    for (section, words) in [
        ("bus", "in separate datagrams"),
        ("", "are not compared with prbase"),
        ("", "its SII is not compared"),
        ("device", "its SII is not compared"),
    ] {
        let reported = describe(&read(&line(section, ""))).join("\n");
        assert!(!reported.contains(words), "{reported}");
    }
}

#[test]
fn a_line_built_in_code_is_checked_by_the_same_rules() {
    use fieldbeat::bus::BusPlan;
    use fieldbeat::bus::ethercat::{Device, EthercatPlan, Family, KollmorgenDrive, SlavePlan, Watchdog};
    let drive = |place| KollmorgenDrive::new(format!("k{place}"), place, Family::S700);
    let mut plan = EthercatPlan::new("local:line", vec![drive(0), drive(1)]);
    assert_eq!(BusPlan::faults(&plan, 1_000 * US), []);
    plan.drives[1].slave.watchdog = Watchdog::After(50 * US);
    let device = |name: &str| Device {
        name: name.into(),
        slave: SlavePlan { watchdog: Watchdog::After(100 * US), ..SlavePlan::new(1) },
    };
    plan.devices = vec![device("k0"), device("a b")];
    assert_eq!(plan.facts(fieldbeat::CyclePlan::default().grid()).devices, ["k0", "a b"]);
    plan.drives[0].axis.phase = 1;
    let reported: Vec<String> = BusPlan::faults(&plan, 300 * US)
        .into_iter()
        .map(|(index, fault)| format!("{index} {}: {}", fault.key, fault.message))
        .collect();
    for begin in [
        "0 phase: must be below divisor = 1",
        "0 device: k0: its name is taken",
        "0 device: \"a b\": its name must be",
        "0 period: drive k0 needs a period that is a whole multiple of 250 us",
        "1 watchdog: must be a whole multiple of 100 us",
        "0 device: k0: position: 1 is already the place of k1",
        "0 device: k0: watchdog: trips after 100 us without outputs",
    ] {
        assert!(reported.iter().any(|line| line.starts_with(begin)), "{begin}\n{reported:#?}");
    }
}
