//! What only an EtherCAT segment has: places, PDOs, clocks, slaves that are no drives.

use fieldbeat::time::US;
use fieldbeat_config::describe;

use super::{machine, read};

#[test]
fn nothing_is_said_of_what_is_looked_at() {
    for (section, words) in [
        ("ethercat-bus", "in separate datagrams"),
        ("ethercat", "are not compared with prbase"),
        ("ethercat", "its SII is not compared"),
        ("ethercat-device", "its SII is not compared"),
    ] {
        let reported = describe(&read(&machine(section, ""))).join("\n");
        assert!(!reported.contains(words), "{reported}");
    }
}

#[test]
fn devices_of_a_line_built_in_code_have_names_of_their_own() {
    use fieldbeat::bus::BusPlan;
    use fieldbeat::bus::ethercat::{Device, EthercatPlan, Family, KollmorgenDrive, SlavePlan};
    let drive = |place| KollmorgenDrive::new(format!("k{place}"), place, Family::S700);
    let mut plan = EthercatPlan::new("local:line", vec![drive(0), drive(1)]);
    assert_eq!(BusPlan::faults(&plan, 1_000 * US), []);
    plan.devices = vec![
        Device { name: "k0".into(), slave: SlavePlan::new(2) },
        Device { name: "a b".into(), slave: SlavePlan::new(3) },
    ];
    assert_eq!(plan.facts(fieldbeat::CyclePlan::default().grid()).devices, ["k0", "a b"]);
    let reported: Vec<String> =
        BusPlan::faults(&plan, 1_000 * US).into_iter().map(|(_, fault)| fault.message).collect();
    for begin in ["k0: its name is taken", "\"a b\": its name must be"] {
        assert!(reported.iter().any(|line| line.starts_with(begin)), "{begin}\n{reported:#?}");
    }
}
