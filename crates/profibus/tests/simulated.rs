//! The scan of a wire with simulated drives, in virtual time.

use fieldbeat_core::net::Carriers;
use fieldbeat_core::time::MS;
use fieldbeat_profibus::config::scan::{Found, ScanError, scan};
use fieldbeat_profibus::wire::dp::DiagnosisStatus;
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
fn stations_are_found_with_their_ident_numbers_and_keep_waiting_for_their_master() {
    let found = scanned(|segment| {
        segment.drives[1].ident = 0x1234;
        segment.drives[1].configuration = vec![0xF3, 0xB1, 0x71];
    });
    let found = found.unwrap();
    let addresses: Vec<u8> = found.iter().map(|found| found.address).collect();
    assert_eq!(addresses, [3, 9]);
    assert_eq!(found[0].configuration, [0xF3, 0xF1]);
    assert_eq!(found[1].configuration, [0xF3, 0xB1, 0x71], "what it wants, whatever its master has");
    let seen: Vec<_> = found.iter().map(|found| found.diagnosis().unwrap()).collect();
    assert_eq!((seen[0].ident, seen[1].ident), (LenzeDrive::IDENT, 0x1234));
    for seen in &seen {
        assert!(seen.status.has(DiagnosisStatus::PRM_REQ), "{seen:?}");
        assert_eq!(seen.master, None);
    }
}

#[test]
fn what_a_wire_is_like_changes_no_station_or_is_named() {
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
