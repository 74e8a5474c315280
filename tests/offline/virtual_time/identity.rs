//! The drive is the one that is meant: on each wire by the numbers that it reports, compared before a write.

use fieldbeat::axis::{Command, Link};
use fieldbeat::config::{Configuration, parse};
use fieldbeat::sim::WorldOptions;
use fieldbeat::{Master, Simulation};

/// A machine as a user writes it, with its drives as the file has them.
fn machine(text: &str) -> Simulation {
    let read = parse(text, "machine.toml").unwrap_or_else(|errors| panic!("{text}: {errors}"));
    let Configuration { plan, simulation, .. } = read;
    let options = WorldOptions::default();
    Master::from_plan(plan)
        .simulate_with(simulation.build(), options)
        .unwrap_or_else(|error| panic!("{error}"))
}

#[test]
fn a_drive_with_another_number_stays_not_connected_and_both_are_named() {
    const LINMOT: &str = "protocol = \"linudp-v2\"\nbind = \"10.0.0.1\"";
    const MOONS: &str = "protocol = \"ethernet-ip\"\nbind = \"10.0.0.1\"";
    const LINE: &str = "protocol = \"ethercat\"\ninterface = \"local:line\"";
    // The bus, the keys of the drive, what it is instead, and what is said of that.
    for (bus, keys, other, said) in [
        (LINMOT, "address = \"10.0.0.2\"\nserial = 5\nserial_from = \"0x0066\"", "serial = 6", "is 6, not 5"),
        ("protocol = \"modbus-tcp\"", "address = \"10.0.0.2\"\nserial = 5", "serial = 6", "is 6, not 5"),
        // The default of the type.
        (MOONS, "address = \"10.0.0.2\"", "vendor = 1", "whose vendor is 1, not 60"),
        (MOONS, "address = \"10.0.0.2\"\nproduct = 5", "product = 6", "whose product is 6, not 5"),
        (MOONS, "address = \"10.0.0.2\"\nserial = 5", "serial = 6", "is 0x00000006, not 0x00000005"),
        (LINE, "serial = 5", "serial = 6", "is 0x00000006, not 0x00000005"),
        (LINE, "alias = 5", "alias = 6", "its station alias is 6, not 5"),
        (LINE, "identification = 5", "identification = 6", "its identification is 6, not 5"),
    ] {
        let text = |keys: &str| format!("[[bus]]\n{bus}\n[[bus.drive]]\nname = \"x\"\ndivisor = 4\n{keys}\n");
        let other = format!("{keys}\nsimulate = {{ {other} }}");
        let mut sim = machine(&text(&other));
        sim.run(10_000);
        assert_eq!(sim.feedback(0).link, Link::Unseen, "{other}");
        assert!(sim.axis(0).post(Command::Enable).is_err() || !sim.feedback(0).status.state.is_powered());
        let why = sim.finish().drives[0].not_connected.clone().unwrap_or_default();
        assert!(why.contains(said) && why.contains("drives or cables are exchanged"), "{other}: {why}");
        let mut sim = machine(&text(keys));
        sim.run(10_000);
        assert_eq!(sim.feedback(0).link, Link::Online, "{keys}");
    }
}

#[test]
fn any_restores_what_was_before_the_electronic_key() {
    let text = "[[bus]]\nprotocol = \"ethernet-ip\"\nbind = \"10.0.0.1\"\n[[bus.drive]]\nname = \"x\"\n\
                divisor = 4\naddress = \"10.0.0.2\"\nvendor = \"any\"\nsimulate = { vendor = 1, product = 14 }\n";
    // And the file of before, without these keys.
    let sample = std::fs::read_to_string("../../rt-config/moons.toml").expect("it is there");
    for text in [text, &sample] {
        let mut sim = machine(text);
        sim.run(10_000);
        assert_eq!(sim.feedback(0).link, Link::Online, "{text}");
    }
}
