//! The control bytes of SyncManagers, and the watchdog behind them.

use super::*;
use fieldbeat_ethercat::plan::Watchdog;
use fieldbeat_ethercat::wire::registers::{AlCode, SyncManager};
use fieldbeat_ethercat::wire::sii::Use;
use fieldbeat_sim::ethercat::Application;

/// At power-on: 100 ms.
const DELIVERED: u16 = 1_000;

/// Terminals that accept the control bytes of their SII only, and what they would say.
#[derive(Debug)]
struct Strict(AlCode);

impl Application for Strict {
    fn mailbox(&mut self, _request: &[u8], _reply: &mut Vec<u8>) -> bool {
        false
    }

    fn may_enter(&mut self, _now: Time, state: AlState) -> Result<(), AlCode> {
        if state == AlState::SafeOp && self.0 != AlCode::NONE { Err(self.0) } else { Ok(()) }
    }

    fn process(&mut self, _now: Time, _outputs: &[u8], _inputs: &mut [u8]) {}
}

/// A segment of terminals with a mailbox whose SII has this control byte of the outputs, 36h and 32h of the mailboxes.
fn rig(control: u8, watchdog: Watchdog, check_sii: bool, refusal: AlCode) -> Rig {
    let area = |start, length| Area { start, length };
    let mut plan = drives(0);
    plan.devices = vec![coupler(0)];
    let slave = &mut plan.devices[0].slave;
    (slave.watchdog, slave.check_sii) = (watchdog, check_sii);
    slave.mailbox = Some([area(0x1800, 128), area(0x1900, 128)]);
    let mut segment = EthercatSegment::from(&plan);
    segment.plan.devices[0].slave.identity.vendor = Some(2);
    let mut contents = segment.devices[0].contents("I/O", Identity { vendor: 2, ..Identity::default() });
    let manager = |Area { start, length }: Area, control, usage| {
        (SyncManager { start, length, control, activate: 1 }, usage)
    };
    contents.managers = vec![
        manager(area(0x1800, 128), 0x36, Use::MailboxOut),
        manager(area(0x1900, 128), 0x32, Use::MailboxIn),
        manager(area(0x1000, 1), control, Use::Outputs),
        manager(area(0x1003, 1), 0x20, Use::Inputs),
    ];
    let mailbox = ethercat::sii::Mailboxes { out: (0x1800, 128), input: (0x1900, 128), protocols: 1 << 2 };
    contents.mailboxes = Some(mailbox);
    let settings = Settings { features: Features(0x0180), sii: contents.image(), ..Settings::default() };
    let mut rig = Rig::new(&plan);
    *rig.sim.segment() = ethercat::Segment::new(vec![Esc::new(settings, Box::new(Strict(refusal)))]);
    rig
}

#[test]
fn the_control_bytes_of_the_sii_stand_unless_the_watchdog_is_configured() {
    for (control, watchdog, check_sii, mailboxes, outputs, time) in [
        (0x24, Watchdog::AsDelivered, true, [0x36, 0x32], 0x24, DELIVERED),
        (0x44, Watchdog::AsDelivered, true, [0x36, 0x32], 0x44, DELIVERED),
        (0x44, Watchdog::AsDelivered, false, [0x26, 0x22], 0x24, DELIVERED),
        (0x24, Watchdog::After(50 * MS), true, [0x36, 0x32], 0x64, 500),
        (0x04, Watchdog::After(50 * MS), false, [0x26, 0x22], 0x64, 500),
        (0x44, Watchdog::Off, true, [0x36, 0x32], 0x04, 0),
    ] {
        let mut rig = rig(control, watchdog, check_sii, AlCode::NONE);
        rig.all_up(4_000);
        let set_of = |rig: &mut Rig, n| rig.peek(0, address::sync_manager(n) + 4, 1)[0];
        let set = [0, 1, 2, 3].map(|n| set_of(&mut rig, n));
        assert_eq!(set, [mailboxes[0], mailboxes[1], outputs, 0x20], "{control:#04x} {watchdog:?}");
        assert_eq!(rig.peek(0, address::WATCHDOG, 2), time.to_le_bytes(), "{control:#04x} {watchdog:?}");
        let is_left_to_it = watchdog == Watchdog::AsDelivered && check_sii;
        let remark = if is_left_to_it && control & 0x40 == 0 { Note::Unarmed } else { Note::None };
        assert_eq!(rig.line.remarks.get(0), remark, "{control:#04x} {watchdog:?} {check_sii}");
    }
}

#[test]
fn an_sii_without_sync_managers_is_named_if_the_watchdog_is_left_to_it() {
    for (watchdog, remark) in
        [(Watchdog::AsDelivered, Note::NoManagers), (Watchdog::After(50 * MS), Note::None)]
    {
        let mut rig = rig(0x64, watchdog, true, AlCode::NONE);
        let mut plan = drives(0);
        plan.devices = vec![coupler(0)];
        plan.devices[0].slave.watchdog = watchdog;
        rig.line = Rig::new(&plan).line;
        let contents = ethercat::sii::Contents {
            identity: Identity { vendor: 2, ..Identity::default() },
            ..ethercat::sii::Contents::default()
        };
        let settings = Settings { features: Features(0x0180), sii: contents.image(), ..Settings::default() };
        *rig.sim.segment() = ethercat::Segment::new(vec![Esc::new(settings, Box::new(Strict(AlCode::NONE)))]);
        rig.all_up(4_000);
        assert_eq!(rig.line.remarks.get(0), remark);
    }
}

#[test]
fn a_refusal_names_the_watchdog_where_it_changes_the_control_byte() {
    let refused = |control, watchdog, code| {
        let mut rig = rig(control, watchdog, true, AlCode(code));
        rig.until("refused", 4_000, |rig| matches!(rig.note(0), Note::State { .. } | Note::Control { .. }));
        rig.note(0)
    };
    let to = AlState::SafeOp;
    for code in [0x17, 0x1D, 0x1F] {
        let named = Note::Control { to, code: AlCode(code), set: 0x64, own: 0x24 };
        assert_eq!(refused(0x24, Watchdog::After(100 * MS), code), named);
        let plain = Note::State { to, code: AlCode(code) };
        assert_eq!(refused(0x64, Watchdog::After(100 * MS), code), plain, "it changes nothing");
        assert_eq!(refused(0x24, Watchdog::AsDelivered, code), plain);
    }
    assert_eq!(
        refused(0x64, Watchdog::Off, 0x1D).text(0).unwrap(),
        "place 0: it refuses SAFEOP: AL status code 0x001d (invalid output configuration); probably for watchdog, \
         which makes the control byte of its outputs 0x24 where its SII has 0x64: leave watchdog out"
    );
    let other = AlCode(0x1E);
    assert_eq!(refused(0x24, Watchdog::After(100 * MS), other.0), Note::State { to, code: other });
}

#[test]
fn what_does_not_read_back_is_named_whether_watchdog_or_sync_manager() {
    let refused = |step: &str, register, other: &[u8]| {
        let mut rig = rig(0x64, Watchdog::AsDelivered, true, AlCode::NONE);
        rig.until(step, 500, |rig| at(&rig.line.slaves[0]).contains(step));
        rig.poke(0, register, other);
        rig.run(2);
        rig.note(0)
    };
    assert_eq!(refused("WatchdogCheck", address::WATCHDOG, &[7, 0]), Note::Watchdog);
    assert_eq!(refused("WatchdogCheck", address::WATCHDOG_DIVIDER, &[7, 0]), Note::Watchdog);
    for manager in [2, 3] {
        let note = refused("SyncManagersCheck", address::sync_manager(manager), &[0; 8]);
        assert_eq!(note, Note::Manager(manager));
        let text = note.text(0).unwrap();
        assert!(text.contains(&format!("SyncManager {manager} does not read back")), "{text}");
    }
}

/// Some slaves check the time of a watchdog that is not armed.
#[test]
fn the_watchdog_that_another_master_left_is_that_of_power_on_though_the_sii_arms_none() {
    for left in [[1, 0_u16], [0xFFFF, 0xFFFF]] {
        let mut rig = rig(0x24, Watchdog::AsDelivered, true, AlCode::NONE);
        let registers = [address::WATCHDOG_DIVIDER, address::WATCHDOG];
        for (register, word) in registers.into_iter().zip(left) {
            rig.poke(0, register, &word.to_le_bytes());
        }
        rig.all_up(4_000);
        let own = registers.map(|register| rig.peek(0, register, 2));
        assert_eq!(own, [0x09C2_u16, 1_000].map(|word| word.to_le_bytes().to_vec()));
    }
    // One that does not accept it comes up as it is.
    let mut rig = rig(0x24, Watchdog::AsDelivered, true, AlCode::NONE);
    rig.until("written", 500, |rig| at(&rig.line.slaves[0]).contains("SyncManagers(0)"));
    rig.poke(0, address::WATCHDOG, &[7, 0]);
    rig.all_up(4_000);
    assert_eq!(rig.peek(0, address::WATCHDOG, 2), [7, 0]);
}
