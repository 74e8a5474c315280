//! The scan of a wire with simulated drives, in virtual time.

use fieldbeat_core::net::Carriers;
use fieldbeat_core::time::MS;
use fieldbeat_profibus::config::scan::{Found, ScanError, scan};
use fieldbeat_profibus::{LenzeDrive, ProfibusPlan};
use fieldbeat_sim::profibus::{ForeignSettings, ProfibusSegment};
use fieldbeat_sim::{SimPlan, World, WorldOptions};

const PORT: &str = "/dev/ttyS1";

/// A scan of the wire of these drives in virtual time, the wire changed.
fn scanned(change: impl FnOnce(&mut ProfibusSegment)) -> Result<Vec<Found>, ScanError> {
    let drives = [3, 9].map(|address| LenzeDrive::new(format!("l{address}"), address));
    let plan = ProfibusPlan::new(PORT, 500_000, drives.into());
    let mut segment = ProfibusSegment::of(&plan);
    change(&mut segment);
    let world = World::new(SimPlan::from(segment).build(), WorldOptions::default()).unwrap();
    let mut port = world.serial(PORT, &plan.line()).unwrap();
    let own = ProfibusPlan { address: 0, drives: Vec::new(), ..plan };
    let mut left = 1_000_000;
    scan(&mut *port, &own, &mut |_, ns| {
        world.advance(ns.max(1));
        left -= 1;
        (left > 0).then(|| world.now())
    })
}

#[test]
fn stations_are_found_with_their_own_ident_numbers_and_configurations() {
    let own = vec![0xF3, 0xB1, 0x71];
    let found = scanned(|segment| {
        (segment.drives[1].ident, segment.drives[1].configuration) = (0x1234, own.clone());
    });
    let found = found.unwrap().into_iter().map(|found| {
        let ident = found.diagnosis().unwrap().ident;
        (found.address, ident, found.configuration)
    });
    assert!(found.eq([(3, LenzeDrive::IDENT, vec![0xF3, 0xF1]), (9, 0x1234, own)]));
}

#[test]
fn wire_settings_leave_every_station_working_or_are_named() {
    type Change = fn(&mut ProfibusSegment);
    type Found = Result<Vec<u8>, ScanError>;
    let wires: [(&str, Change, Found); 3] = [
        ("lost telegrams cost a round", |segment| segment.faults.drop = 0.05, Ok(vec![3, 9])),
        ("nobody is there", |segment| segment.drives.clear(), Err(ScanError::Silent)),
        (
            "another master is left alone",
            |segment| {
                segment.foreign = Some(ForeignSettings { every_ns: 500 * MS, ..ForeignSettings::new(1) });
            },
            Err(ScanError::OtherMaster(1)),
        ),
    ];
    for (what, change, expected) in wires {
        let found = scanned(change).map(|found| found.iter().map(|found| found.address).collect());
        assert_eq!(found, expected, "{what}");
    }
}
