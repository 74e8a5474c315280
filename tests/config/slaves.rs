//! How the slaves of a simulated segment differ from the usual ones.

use super::ethercat::line;
use super::{mistakes, read_all};

#[test]
fn a_simulated_slave_takes_its_values_from_the_file() {
    let text = r#"
[[bus]]
protocol = "ethercat"
interface = "local:line"
simulate.settling = 1024
[[bus.drive]]
name = "k"
[bus.drive.simulate]
exact_managers = true
output_control = 0x24
clock = "short"
fmmus = 3
left = "watchdog"
sii = { owned_by_slave = true, read_in_preop = true, eight_bytes = true, busy = "2ms", loading = "50ms" }
mailbox = { delay = "1s", delay_every = 3, lose_every = 5, resends = false }
[[bus.device]]
name = "out"
outputs = { start = 0x1000, length = 1 }
simulate = { type = "EL2008", wired_to = "in", emulated = false, sii = { slips = true, fails_every = 5 } }
[[bus.device]]
name = "in"
inputs = { start = 0x1000, length = 1 }
simulate = { type = "EL1008", left = "unwatched", behind = { slave = "k", port = 2 }, sii.content = "garbage" }
"#;
    let all = format!("{:?}", read_all(text).simulation.buses[0]);
    for part in [
        "settling: 1024",
        "0: SlaveSettings { model: None, emulated: None, exact_managers: true, output_control: Some(36), clock: \
         Some(Short), fmmus: Some(3), sii: SiiSettings { owned_by_slave: true, read_in_preop: true, eight: true, \
         busy_ns: 2000000, loading_ns: 50000000, slips: false, fails_every: 0, content: Sound }, mailbox: \
         MailboxSettings { delay_ns: 1000000000, delay_every: 3, lose_every: 5, resends: false }, behind: None, \
         wired_to: None, left: Some(Left { station: 4098, alias_on: false, al: (20, 27)",
        "1: SlaveSettings { model: Some(El2008), emulated: Some(false)",
        "slips: true, fails_every: 5, content: Sound }",
        "slips: false, fails_every: 0, content: Garbage }",
        "wired_to: Some(2)",
        "behind: Some(Behind { place: 0, port: 2 })",
        "2: SlaveSettings { model: Some(El1008), emulated: None",
        "managers: [], unwatched: true, sync0_ns: Some(1000000), sii_given: true, sii_failed: true }",
    ] {
        assert!(all.contains(part), "{part}\n{all}");
    }
    for (section, fragment, at, message) in [
        (
            "device",
            "simulate.type = \"EL9999\"",
            12,
            "bus.device.simulate.type = \"EL9999\": must be \"EK1100\"",
        ),
        (
            "device",
            "simulate.wired_to = \"x\"",
            12,
            "bus.device.simulate.wired_to = \"x\": must be the name of a slave of this bus: k, io",
        ),
        (
            "device",
            "simulate.behind = { slave = \"k\", port = 4 }",
            12,
            "bus.device.simulate.behind.port = 4: must be at most 3; the port there",
        ),
        (
            "device",
            "simulate.behind.port = 2",
            12,
            "bus.device.simulate.behind.slave: missing; the name of the slave",
        ),
        (
            "device",
            "simulate.behind = { slave = \"io\", port = 2 }",
            12,
            "port 2 of position 1 does not lead to position 1: a frame leaves by ports 3, 1 and 2",
        ),
        ("", "simulate.type = \"EL1008\"", 9, "bus.drive.simulate.type: no such key"),
        ("", "simulate.left = \"preop\"", 9, "bus.drive.simulate.left = \"preop\": must be \"op\""),
        ("", "simulate.output_control = 256", 9, "must be at most 255; the control byte of its outputs"),
        ("", "simulate.sii.busy = \"2s\"", 9, "bus.drive.simulate.sii.busy = \"2s\": must be at most 1 s"),
        ("", "simulate.mailbox.delay_every = 0", 9, "must be at least 1; of so many answers one is late"),
    ] {
        let reported = mistakes(&line(section, fragment));
        let fits = |mistake: &String| mistake.contains(&format!(":{at}: ")) && mistake.contains(message);
        assert!(reported.iter().any(fits), "{fragment}: {reported:?}");
    }
}
