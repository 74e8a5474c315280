//! What only a PROFIBUS wire has: times in its bits, parametrisation, words of the process data, turns on the grid.

use fieldbeat::axis::Unit;
use fieldbeat::bus::profibus::{LenzeDrive, ProfibusPlan, RATES};
use fieldbeat::time::{MS, S, US};
use fieldbeat::{CyclePlan, Plan};
use fieldbeat_core::bus::Grid;
use fieldbeat_core::cycle::bound::stop_bound;

use super::{machine, read};

/// The plan of the only bus.
fn plan(text: &str) -> ProfibusPlan {
    let plan = read(text);
    let bus: &dyn std::any::Any = &*plan.buses[0];
    bus.downcast_ref::<ProfibusPlan>().expect("a PROFIBUS wire").clone()
}

#[test]
fn a_file_that_says_little_is_a_plan_built_in_code() {
    let mut of_file = plan(&machine("lenze", ""));
    assert_eq!(of_file.drives[0].axis.limits.velocity.take(), Some(20.0));
    let of_code = LenzeDrive::new("l", 3);
    assert_eq!(of_file.drives[0].axis.units.unit, Unit::Revolution);
    of_file.drives[0].axis = of_code.axis.clone();
    assert_eq!(of_file, ProfibusPlan::new("/dev/ttyS1", 1_500_000, vec![of_code]));
    let of_bus = plan(&machine("lenze-bus", "rate = 3000000\nlatency = \"125us\"\nbits.slot = 500"));
    assert_eq!(of_bus.slot_ns(), 500 * 1_000 / 3 + 1 + 125 * US);
    let of_drive = plan(&machine("lenze", "user_prm = [0x84, 1, 2]\nwatchdog = \"257ms\""));
    assert_eq!(of_drive.drives[0].watchdog_ns(), Some(258 * MS), "two factors make 258, not 257");
    for rate in RATES {
        let slow = machine("lenze-bus", &format!("rate = {rate}")).replace("\"4ms\"", "\"500ms\"");
        let of_file = plan(&slow.replace("velocity = 20", "velocity = 20\nwatchdog = \"5s\""));
        assert_eq!(of_file.bits, fieldbeat::bus::profibus::Bits::usual(rate), "{rate}");
    }
}

#[test]
fn turns_of_a_plan_built_in_code_are_laid_on_the_grid_of_the_cycle() {
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
