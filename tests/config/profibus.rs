//! What only a PROFIBUS wire has: times in its bits, parametrisation, words of the process data, turns on the grid.

use fieldbeat::axis::Unit;
use fieldbeat::bus::Grid;
use fieldbeat::bus::profibus::{
    DriveProfile, LenzeDrive, Numbers, ParameterPath, ProfibusPlan, RATES, Rs485, StatusBit,
};
use fieldbeat::config::Configuration;
use fieldbeat::time::{MS, S, US};
use fieldbeat::{CyclePlan, Plan};
use fieldbeat_config::describe;
use fieldbeat_core::cycle::bound::stop_bound;

use super::{keys, mistakes, read, read_all, tells_the_truth};

/// One drive with a fragment in the section of its bus or in its own. The fragment begins in line 6 or 10.
pub fn wire(section: &str, fragment: &str) -> String {
    let part = |name: &str| if name == section { fragment } else { "" };
    format!(
        "[cycle]\nperiod = \"4ms\"\n[[bus]]\nprotocol = \"profibus-dp\"\ndevice = \"/dev/ttyS1\"\n{}\n\
         [[bus.drive]]\nname = \"l\"\naddress = 3\n{}\n[bus.defaults]\nlimits.velocity = 20\n",
        part("bus"),
        part(""),
    )
}

/// The plan of the only bus.
fn plan(text: &str) -> ProfibusPlan {
    let plan = read(text);
    let bus: &dyn std::any::Any = &*plan.buses[0];
    bus.downcast_ref::<ProfibusPlan>().expect("a PROFIBUS wire").clone()
}

#[test]
fn the_lenze_sample_tells_the_truth() {
    let sample = tells_the_truth("rt-config/lenze.toml", 50);
    let common = keys(&super::machine("drive", "no_such_key = 1"));
    let of_its_own = |key: &String| !common.contains(key);
    for section in ["bus", ""] {
        for key in keys(&wire(section, "no_such_key = 1")).iter().filter(|key| of_its_own(key)) {
            assert!(sample.contains(key.as_str()), "{key}");
        }
    }
    for key in keys(&wire("bus", "bits.no_such_key = 1")) {
        assert!(sample.contains(&format!("bits.{key}")), "bits.{key}");
    }
    for key in keys(&wire("", "parameters.no_such_key = 1")) {
        assert!(sample.contains(&key), "parameters.{key}");
    }
}

#[test]
fn a_file_that_says_little_is_a_plan_built_in_code() {
    let mut of_file = plan(&wire("", ""));
    assert_eq!(of_file.drives[0].axis.limits.velocity.take(), Some(20.0));
    let of_code = LenzeDrive::new("l", 3);
    assert_eq!(of_file.drives[0].axis.units.unit, Unit::Revolution);
    of_file.drives[0].axis = of_code.axis.clone();
    assert_eq!(of_file, ProfibusPlan::new("/dev/ttyS1", 1_500_000, vec![of_code]));
    for rate in RATES {
        let slow = wire("bus", &format!("rate = {rate}")).replace("\"4ms\"", "\"500ms\"");
        let of_file = plan(&slow.replace("velocity = 20", "velocity = 20\nwatchdog = \"5s\""));
        assert_eq!(of_file.bits, fieldbeat::bus::profibus::Bits::usual(rate), "{rate}");
    }
}

#[test]
fn values_arrive_where_they_belong() {
    let of_bus = plan(&wire(
        "bus",
        "rate = 3000000\naddress = 5\nrs485 = \"driver\"\necho = true\nlatency = \"125us\"\nretries = 4\n\
         token = false\ngap = 7\nhighest_address = 31\nglobal_control = \"50ms\"\n\
         bits = { slot = 500, max_tsdr = 300, sync = 34, idle = 50 }",
    ));
    assert_eq!((of_bus.rate, of_bus.address, of_bus.rs485, of_bus.echo), (3_000_000, 5, Rs485::Driver, true));
    assert_eq!((of_bus.retries, of_bus.token, of_bus.gap), (4, false, Some(7)));
    assert_eq!((of_bus.highest_address, of_bus.global_control_ns), (31, 50 * MS));
    let bits = of_bus.bits;
    assert_eq!((bits.slot, bits.max_tsdr, bits.sync, bits.idle), (500, 300, 34, 50));
    assert_eq!((bits.idle_unanswered, bits.latency_ns), (300, 125 * US), "Tid2 follows MaxTsdr");
    assert_eq!(of_bus.slot_ns(), 500 * 1_000 / 3 + 1 + 125 * US);
    assert_eq!(plan(&wire("bus", "gap = \"off\"")).gap, None);
    // One that is slower than usual has a slot time to match.
    assert_eq!(plan(&wire("bus", "bits.max_tsdr = 400")).bits.slot, 416);

    let of_drive = plan(&wire(
        "",
        "divisor = 2\nident = 0x1234\nuser_prm = [0x84, 1, 2]\nconfiguration = [0xF5]\nchannel = false\n\
         watchdog = \"257ms\"\nmin_tsdr = 37\ngroups = [1, 8]\nwords = \"profidrive\"\nramp_bits = false\n\
         enable_bit = { bit = 12, set = false }\nfull_count = 24000\nfull_rpm = 2880\nset_point_word = 2\n\
         actual_word = 3\nfurther = [7, 0x100]\n\
         monitor = [{ name = \"torque\", word = 4, per_count = -0.5, signed = true, unit = \"%\" }]\nfault_at = 3\n\
         extended_diagnosis = 10\nno_drive_watchdog = \"accept\"\n\
         parameters = { path = \"msac1\", slot = 1, index = 48, axis = 1, numbers = \"code\" }",
    ));
    let drive = &of_drive.drives[0];
    assert_eq!(
        (drive.ident, &drive.user_prm[..], &drive.configuration[..]),
        (0x1234, &[0x84, 1, 2][..], &[0xF5][..])
    );
    assert_eq!((drive.channel, drive.min_tsdr, drive.group), (false, 37, 0x81));
    assert_eq!(
        (drive.watchdog_ns(), drive.watchdog.accept_none),
        (Some(258 * MS), true),
        "two factors make 258, not 257"
    );
    assert_eq!((drive.profile, drive.ramp_bits), (DriveProfile::Profidrive, false));
    assert_eq!(drive.enable_bit, Some(StatusBit { bit: 12, set: false }));
    let scale = drive.scale;
    assert_eq!((scale.full_count, scale.full_rpm, scale.set_point, scale.actual), (24_000, 2_880.0, 2, 3));
    assert_eq!(drive.further, [7, 0x100]);
    let shown = drive.show[0].as_ref().unwrap();
    assert_eq!((shown.name.as_str(), shown.word, shown.per_count), ("torque", 4, -0.5));
    assert_eq!((shown.signed, shown.unit, &drive.show[1]), (true, "%", &None));
    assert_eq!((drive.fault_at, drive.extended_diagnosis), (Some(3), 10));
    let path = ParameterPath::Msac1 { slot: 1, index: 48, axis: 1, numbers: Numbers::Code };
    assert_eq!(drive.parameters, path);

    let other =
        plan(&wire("", "watchdog = \"off\"\nenable_bit = \"off\"\nfault_at = \"off\"\nmonitor = false"));
    let drive = &other.drives[0];
    assert_eq!((drive.watchdog_ns(), drive.enable_bit, drive.fault_at), (None, None, None));
    for (text, pause) in [("", true), (", pause = false", false)] {
        let other = plan(&wire("", &format!("parameters = {{ path = \"pkw\"{text} }}")));
        assert_eq!(other.drives[0].parameters, ParameterPath::Pkw { pause });
    }
    let of_another = mistakes(&wire("", "parameters = { slot = 1, pause = true }"));
    let of = |key: &str, path: &str| format!("bus.drive.parameters.{key}: concerns path = \"{path}\" only");
    assert_eq!(of_another.len(), 2);
    assert!(of_another.iter().any(|said| said.replace(" = true", "").contains(&of("pause", "pkw"))));
    assert!(of_another.iter().any(|said| said.replace(" = 1", "").contains(&of("slot", "msac1"))));
    assert_eq!(plan(&wire("", "enable_bit = 9")).drives[0].enable_bit, Some(StatusBit { bit: 9, set: true }));
    assert_eq!(plan(&wire("", "words = \"profidrive\"")).drives[0].enable_bit, None);
}

#[test]
fn a_simulated_wire_is_as_its_keys_say() {
    let Configuration { simulation, .. } = read_all(&wire(
        "",
        "simulate = { ident = 7, answer_bits = 60, safe = \"quick stop\", job_time = \"3ms\", acyclic_delay = 4, \
         inertia = 0.02, running = 10 }",
    ));
    let said = format!("{simulation:?}");
    for part in [
        "ident: 7,",
        "answer_bits: Some(60)",
        "safe: QuickStop",
        "job_ns: 3000000",
        "delay: 4,",
        "inertia_kgm2: 0.02",
        "running: Some(600.0)",
    ] {
        assert!(said.contains(part), "{part} in {said}");
    }
}

#[test]
fn half_a_word_at_the_end_is_no_mismatch_of_the_simulated_drive() {
    // Five bytes behind the channel.
    let Configuration { simulation, .. } = read_all(&wire("", "configuration = [0xF3, 0xB4]\nsimulate = {}"));
    let said = format!("{simulation:?}");
    assert!(said.contains("inputs: [Status, Speed]"), "{said}");
}

#[test]
fn one_bus_a_port_and_one_drive_an_address() {
    let second = "[[bus]]\nprotocol = \"profibus-dp\"\nname = \"b\"\ndevice = \"/dev/ttyS1\"\n\
        [[bus.drive]]\nname = \"m\"\naddress = 3\nlimits.velocity = 20\n\
        [[bus.drive]]\nname = \"n\"\naddress = 3\nlimits.velocity = 20\n\
        [[bus.drive]]\nname = \"o\"\naddress = 2\nlimits.velocity = 20\n";
    assert_eq!(
        mistakes(&(wire("", "") + second)),
        [
            "m.toml:16: bus.device = \"/dev/ttyS1\": is already that of the bus of line 5; there is one bus per \
             device, add the drives to that bus",
            "m.toml:23: bus.drive.address = 3: is taken by another drive; one drive per address",
            "m.toml:27: bus.drive.address = 2: is the master's own address; give the one that is set at the module",
        ]
    );
}

/// What `check` says of a drive.
fn of(plan: &Plan, name: &str) -> Vec<String> {
    let reported = describe(plan);
    let begin = reported.iter().position(|line| line.starts_with(&format!("  drive {name}: "))).unwrap();
    let rest = reported[begin + 1..].iter().take_while(|line| line.starts_with("    "));
    std::iter::once(&reported[begin]).chain(rest).map(|line| line.trim_start().to_owned()).collect()
}

#[test]
fn the_turns_are_laid_on_the_grid_of_the_cycle() {
    let text = |period: &str, drives: usize| {
        let of = |index: usize| {
            format!("[[bus.drive]]\nname = \"l{index}\"\naddress = {}\nlimits.velocity = 20\n", 3 + index)
        };
        let drives: String = (0..drives).map(of).collect();
        format!(
            "[cycle]\n{period}\n[[bus]]\nprotocol = \"profibus-dp\"\ndevice = \"local:w\"\nrate = 12000000\n{drives}"
        )
    };
    // Four drives in each cycle, if its window is long enough.
    let plan = read(&text("receive_deadline = 0.8", 4));
    let said = of(&plan, "l0");
    let refused = mistakes(&text("receive_deadline = 0.5", 4));
    let [refused] = &refused[..] else { panic!("{refused:?}") };
    assert!(refused.contains("bus.drive.divisor: asks for an exchange every 1 ms"), "{refused}");
    assert!(refused.contains("use divisor 2 and phases in turn"), "{refused}");
    // What a drive says besides.
    let expected = [
        "drive l0: local:w, address 3",
        "its turn: 12 bytes of outputs and 12 of inputs, 8 of them the parameter channel; 107.917 us on the wire, \
         215.834 us at most; all drives in turn 431.668 us",
        "start-up takes it over: Set_Prm (3 bytes of User_Prm) for ident number 0x0082 locks it to this master, and \
         its outputs are 0 until Data_Exchange: a motor that turned by another master coasts; one that another master \
         has locked is left alone, and named; DRIVECOM words",
        "takes velocities, 1500 rpm at a count of 16384; no moves, no streams, no homing",
        "parameters by the DRIVECOM channel in the process data",
        "a parameter that is written again and again wears the drive's EEPROM, unless saving is off: C0003 = 0",
        "if the master dies: stops within 100 ms by its own watchdog, which Set_Prm sets and its diagnosis has to show \
         as on before it is enabled; what it does then is the drive's setting",
        "an exchange every cycle (1 ms), over 1 cycle (1 ms) later at most: its turn on the wire",
    ];
    assert_eq!(said[..expected.len()], expected);
    let wire = "  wire: 12000000 bit/s, 8E1, this master at address 2: a telegram at a time, the adapter switches its \
                direction; slot time 83.334 us (1000 bits), MaxTsdr 800 bits, one repetition at most";
    assert!(describe(&plan).iter().any(|line| line == wire), "{:#?}", describe(&plan));
    // 4 x 107.9 us of each ms; with Set_Prm that is not answered within its slot time, 14 bytes of 11 bits and 1000.
    let turns = "  turns: 4000 exchanges/s, where 8000 would begin inside the windows; bus load 43.2 %, 53.4 % in a \
                 round with a slot time, a repetition and an acyclic telegram";
    assert!(describe(&plan).iter().any(|line| line == turns), "{:#?}", describe(&plan));
    // A plan that was built in code is refused by the same words.
    let mut drives: Vec<LenzeDrive> =
        (0..4).map(|index| LenzeDrive::new(format!("l{index}"), 3 + index)).collect();
    drives.iter_mut().for_each(|drive| drive.axis.limits.velocity = Some(20.0));
    let bus = ProfibusPlan::new("local:w", 12_000_000, drives);
    let plan = |bus: &ProfibusPlan| Plan { buses: vec![Box::new(bus.clone())], ..Plan::default() };
    let errors = plan(&bus).check().unwrap_err().to_string();
    assert!(
        errors.starts_with("bus profibus-dp: drive l3: divisor: asks for an exchange every 1 ms"),
        "{errors}"
    );
    let grid = CyclePlan::default().grid();
    assert_eq!(grid, Grid { period_ns: MS, deadline_ns: MS / 2 });
    let fits = bus.in_turn(bus.least_divisor(grid).unwrap());
    plan(&fits).check().unwrap_or_else(|errors| panic!("{errors}"));
    assert!(bus.exchanges_within(S, grid) >= 4_000);
    // The longest wait, and with it the bound, grows with the window that is left.
    let bounds = [0.5, 0.8].map(|receive_deadline| {
        let cycle = CyclePlan { receive_deadline, ..CyclePlan::default() };
        stop_bound(&Plan { cycle, ..plan(&fits) }, 0)
    });
    assert!(bounds[0] >= bounds[1], "{bounds:?}");
}
