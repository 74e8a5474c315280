//! The control bytes of SyncManagers, and the watchdog behind them.

use super::refused::Unwilling;
use super::*;
use fieldbeat_ethercat::plan::Watchdog;
use fieldbeat_ethercat::wire::registers::AlCode;
use fieldbeat_sim::ethercat::codec::registers::SyncManager;

/// At power-on: 100 ms.
const DELIVERED: u16 = 1_000;

/// Terminals with a mailbox that refuse SAFEOP with this code, if any; their SII has this control byte of the outputs,
/// 36h and 32h of the mailboxes, or no SyncManager and no mailbox at all.
fn rig(control: Option<u8>, watchdog: Watchdog, check_sii: bool, code: AlCode) -> Rig {
    let area = |start, length| Area { start, length };
    let mut plan = terminals();
    let slave = &mut plan.devices[0].slave;
    (slave.watchdog, slave.check_sii) = (watchdog, check_sii);
    slave.mailbox = control.map(|_| [area(0x1800, 128), area(0x1900, 128)]);
    let managers = control.map(|control| {
        [
            SyncManager::on(0x1800, 128, 0x36),
            SyncManager::on(0x1900, 128, 0x32),
            SyncManager::on(0x1000, 1, control),
            SyncManager::on(0x1100, 1, 0x20),
        ]
    });
    let mailboxes = ethercat::sii::Mailboxes { out: (0x1800, 128), input: (0x1900, 128), protocols: 1 << 2 };
    let contents = ethercat::sii::Contents {
        identity: IO,
        managers: managers.into_iter().flatten().collect(),
        mailboxes: control.map(|_| mailboxes),
        ..ethercat::sii::Contents::default()
    };
    let settings = Settings { features: 0x0180, sii: contents.image(), ..Settings::default() };
    let refuses = (code != AlCode::NONE).then_some(AlState::SafeOp);
    let strict = Unwilling { refuses, code, ..Unwilling::default() };
    Rig::of(&plan, vec![Esc::new(settings, Box::new(strict))])
}

#[test]
fn the_control_bytes_of_the_sii_stand_unless_the_watchdog_is_configured() {
    let (own, plain) = ([0x36, 0x32], [0x26, 0x22]);
    for (control, watchdog, check_sii, mailboxes, outputs, time, remark) in [
        (0x24, Watchdog::AsDelivered, true, own, 0x24, DELIVERED, Note::Unarmed),
        (0x44, Watchdog::AsDelivered, true, own, 0x44, DELIVERED, Note::None),
        (0x44, Watchdog::AsDelivered, false, plain, 0x24, DELIVERED, Note::None),
        (0x24, Watchdog::After(50 * MS), true, own, 0x64, 500, Note::None),
        (0x04, Watchdog::After(50 * MS), false, plain, 0x64, 500, Note::None),
        (0x44, Watchdog::Off, true, own, 0x04, 0, Note::None),
    ] {
        let what = format!("{control:#04x} {watchdog:?} {check_sii}");
        let mut rig = rig(Some(control), watchdog, check_sii, AlCode::NONE);
        rig.all_up(4_000);
        let set = [0, 1, 2, 3].map(|n| rig.peek(0, address::sync_manager(n) + 4, 1)[0]);
        assert_eq!(set, [mailboxes[0], mailboxes[1], outputs, 0x20], "{what}");
        assert_eq!(rig.peek(0, address::WATCHDOG, 2), time.to_le_bytes(), "{what}");
        assert_eq!(rig.line.remarks.get(0), remark, "{what}");
    }
    for (watchdog, remark) in
        [(Watchdog::AsDelivered, Note::NoManagers), (Watchdog::After(50 * MS), Note::None)]
    {
        let mut rig = rig(None, watchdog, true, AlCode::NONE);
        rig.all_up(4_000);
        assert_eq!(rig.line.remarks.get(0), remark, "an SII without SyncManagers");
    }
}

#[test]
fn a_refusal_names_the_watchdog_where_it_changes_the_control_byte() {
    let refused = |control, watchdog, code| {
        let mut rig = rig(Some(control), watchdog, true, AlCode(code));
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
        refused(0x64, Watchdog::Off, 0x1D).text(0, &Expected::default()).unwrap(),
        "place 0: it refuses SAFEOP: AL status code 0x001d (invalid output configuration); probably for \
         watchdog, which makes the control byte of its outputs 0x24 where its SII has 0x64: leave watchdog \
         out"
    );
    let other = AlCode(0x1E);
    assert_eq!(refused(0x24, Watchdog::After(100 * MS), other.0), Note::State { to, code: other });
}

#[test]
fn what_does_not_read_back_is_named_whether_watchdog_or_sync_manager() {
    let refused = |step: &str, register, other: &[u8]| {
        let mut rig = rig(Some(0x64), Watchdog::AsDelivered, true, AlCode::NONE);
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
        let text = note.text(0, &Expected::default()).unwrap();
        assert!(text.contains(&format!("SyncManager {manager} does not read back")), "{text}");
    }
}

/// Some slaves check the time of a watchdog that is not armed.
#[test]
fn the_watchdog_that_another_master_left_is_that_of_power_on_though_the_sii_arms_none() {
    for left in [[1, 0_u16], [0xFFFF, 0xFFFF]] {
        let mut rig = rig(Some(0x24), Watchdog::AsDelivered, true, AlCode::NONE);
        let registers = [address::WATCHDOG_DIVIDER, address::WATCHDOG];
        for (register, word) in registers.into_iter().zip(left) {
            rig.poke(0, register, &word.to_le_bytes());
        }
        rig.all_up(4_000);
        let own = registers.map(|register| rig.peek(0, register, 2));
        assert_eq!(own, [0x09C2_u16, 1_000].map(|word| word.to_le_bytes().to_vec()));
    }
    // One that does not accept it comes up as it is.
    let mut rig = rig(Some(0x24), Watchdog::AsDelivered, true, AlCode::NONE);
    rig.until("written", 500, |rig| at(&rig.line.slaves[0]).contains("SyncManagers(0)"));
    rig.poke(0, address::WATCHDOG, &[7, 0]);
    rig.all_up(4_000);
    assert_eq!(rig.peek(0, address::WATCHDOG, 2), [7, 0]);
}
