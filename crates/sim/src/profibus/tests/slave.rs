//! States, parametrisation, diagnosis, watchdog.

use super::*;

/// In Data_Exchange with this Set_Prm, Operate included.
fn with_prm(prm: &[u8]) -> Bench {
    let mut bench = Bench::with(|_| ());
    bench.configured(prm, &[0xF3, 0xF1]);
    bench.control(0, 0);
    assert_eq!(bench.slave().dp_state(), (DpState::DataExchange, Some(MASTER)));
    bench
}

#[test]
fn the_states_follow_each_other_and_nothing_is_exchanged_before() {
    let mut bench = Bench::with(|settings| settings.dp.ready_ns = 50 * MS);
    let active = (3, vec![]);
    assert_eq!(bench.exchange(&[0; 12]), active);
    assert_eq!(bench.diagnose(), [2, 5, 0, 255, 0, 0x82]);
    // A configuration before the parameters is refused.
    assert_eq!((bench.chk_cfg(&[0xF3, 0xF1]), bench.slave().misuse().state), (3, 1));
    assert_eq!(bench.set_prm(&PRM), 0xE5);
    assert_eq!(bench.diagnose(), [2, 0x0C, 0, MASTER, 0, 0x82]);
    assert_eq!((bench.exchange(&[0; 12]), bench.slave().dp_state().0), (active.clone(), DpState::WaitCfg));
    assert_eq!(bench.chk_cfg(&[0xF3, 0xF1]), 0xE5);
    assert_eq!((bench.diagnose()[0], bench.slave().dp_state().0), (2, DpState::Starting));
    assert_eq!(bench.exchange(&[0; 12]), active);
    bench.wait(50 * MS);
    assert_eq!(bench.diagnose(), [0, 0x0C, 0, MASTER, 0, 0x82]);
    assert_eq!(bench.exchange(&[0; 12]).0, 8);
    assert_eq!(bench.srd(Some((59, 62)), &[]), Some((8, vec![0xF3, 0xF1])));
    assert_eq!((bench.slave().events().exchanges, bench.slave().events().parametrised), (1, 1));
    assert_eq!(bench.slave().misuse().total(), 1);
}

#[test]
fn a_set_prm_that_does_not_fit_is_a_fault_by_its_name() {
    type Change<T> = fn(&mut T);
    let usual: Change<LenzeSettings> = |_| ();
    let length: Change<LenzeSettings> = |settings| settings.dp.user_prm = UserPrm::Length(3);
    let exactly: Change<LenzeSettings> = |settings| settings.dp.user_prm = UserPrm::Exactly(vec![0x80, 0, 0]);
    let none = Misuse::default();
    let (taken, refused, parameters) = ((2, 0x0C), (0x42, 5), Misuse { parameters: 1, ..none });
    let rows: [(Change<Vec<u8>>, Change<LenzeSettings>, _, _); 16] = [
        (|_| (), usual, taken, none),
        (|prm| prm[5] = 0x83, usual, refused, none),
        (|prm| prm[3] = 10, usual, refused, parameters),
        (|prm| prm[3] = 101, usual, refused, parameters),
        (|prm| prm[1] = 0, usual, refused, parameters),
        (|prm| prm[0] |= 1, usual, refused, parameters),
        (|prm| prm.truncate(6), usual, refused, Misuse { length: 1, ..none }),
        (|prm| prm[0] |= 0x20, usual, (0x52, 5), none),
        (|prm| prm[0] |= 0x30, |settings| settings.dp.sync_freeze = true, taken, none),
        (|prm| prm[7] |= 1, usual, refused, none),
        (|prm| prm[7] |= 1, |settings| settings.dp.dpv1 = false, taken, none),
        (|_| (), length, taken, none),
        (|prm| prm.push(0), length, refused, none),
        (|_| (), exactly, taken, none),
        (|prm| prm[9] = 1, exactly, refused, none),
        (|prm| prm[4] = 0x12, usual, refused, none),
    ];
    for (row, (change, settings, (first, second), misuse)) in rows.into_iter().enumerate() {
        let mut bench = Bench::with(settings);
        let mut prm = PRM.to_vec();
        change(&mut prm);
        assert_eq!(bench.set_prm(&prm), 0xE5, "row {row}: it is acknowledged all the same");
        let diagnosis = bench.diagnose();
        assert_eq!(bench.slave().dp_state().0 == DpState::WaitCfg, diagnosis[0] & 0x40 == 0);
        assert_eq!(
            (diagnosis[0], diagnosis[1], bench.slave().misuse()),
            (first, second, misuse),
            "row {row}"
        );
    }
}

#[test]
fn a_fault_of_parameters_or_configuration_is_gone_with_right_ones() {
    let mut bench = Bench::with(|_| ());
    let mut wrong = PRM;
    wrong[4] = 0x12;
    bench.set_prm(&wrong);
    assert_eq!(bench.diagnose(), [0x42, 5, 0, 255, 0, 0x82]);
    bench.set_prm(&PRM);
    for wrong in [&[0xF3, 0xF0][..], &[0xF3], &[0xF3, 0xF1, 0], &[]] {
        assert_eq!(bench.chk_cfg(wrong), 0xE5);
        assert_eq!(bench.diagnose(), [6, 5, 0, 255, 0, 0x82], "{wrong:X?}");
        bench.set_prm(&PRM);
        assert_eq!(bench.diagnose()[..2], [2, 0x0C]);
    }
    bench.up();
    // In Data_Exchange right ones change nothing, wrong ones end it.
    assert_eq!((bench.set_prm(&PRM), bench.chk_cfg(&[0xF3, 0xF1])), (0xE5, 0xE5));
    assert_eq!(bench.exchange(&[0; 12]).0, 8);
    bench.chk_cfg(&[0xF3]);
    assert_eq!((bench.exchange(&[0; 12]).0, bench.diagnose()[0]), (3, 6));
    bench.up();
    bench.set_prm(&wrong);
    assert_eq!((bench.exchange(&[0; 12]).0, bench.diagnose()[0]), (3, 0x42));
    assert_eq!(bench.slave().misuse(), Misuse::default());
}

#[test]
fn another_master_is_locked_out_until_the_first_one_unlocks() {
    let mut bench = Bench::online(|_| ());
    let own = bench.master((3, None));
    assert_eq!(bench.diagnose(), [0x80, 0x0C, 0, MASTER, 0, 0x82]);
    assert_eq!((bench.set_prm(&PRM), bench.chk_cfg(&[0xF3, 0xF1])), (3, 3));
    assert_eq!((bench.exchange(&[0; 12]).0, bench.slave().misuse().state), (3, 2));
    // Reading is allowed.
    assert_eq!(bench.srd(Some((56, 62)), &[]).unwrap().1.len(), 12);
    assert_eq!(bench.srd(Some((57, 62)), &[]).unwrap(), (8, vec![0; 12]));
    let other = bench.master(own);
    assert_eq!(bench.exchange(&[0; 12]).0, 8, "its own goes on");
    let mut unlock = PRM;
    unlock[0] = 0x40;
    assert_eq!(bench.set_prm(&unlock), 0xE5);
    assert_eq!(bench.diagnose(), [2, 5, 0, 255, 0, 0x82]);
    bench.master(other);
    bench.configured(&PRM, &[0xF3, 0xF1]);
    assert_eq!((bench.diagnose()[3], bench.slave().events().parametrised), (3, 2));
    let mut quiet = Bench::online(|settings| settings.dp.shows_lock = false);
    quiet.master((3, None));
    assert_eq!(quiet.diagnose()[0], 0);
}

#[test]
fn each_telegram_of_its_own_master_feeds_the_watchdog_and_no_other() {
    let mut bench = with_prm(&PRM);
    for _ in 0..10 {
        bench.wait(60 * MS);
        bench.words(0, 0);
        bench.wait(60 * MS);
        // A repeated one does.
        let function = if bench.fcb == Some(true) { 0x5D } else { 0x7D };
        let again = bench.frame(None, function, &[0; 12]);
        assert!(bench.ask(&again).is_some());
    }
    assert_eq!(bench.slave().dp_state().0, DpState::DataExchange);
    for _ in 0..3 {
        bench.wait(40 * MS);
        bench.diagnose();
        bench.srd(Some((51, 51)), &[]);
    }
    assert_eq!((bench.slave().dp_state().0, bench.slave().events().watchdogs), (DpState::WaitPrm, 1));
    bench.up();
    let own = bench.master((3, None));
    for _ in 0..3 {
        bench.wait(30 * MS);
        bench.exchange(&[0; 12]);
    }
    bench.master(own);
    assert_eq!((bench.exchange(&[0; 12]).0, bench.slave().events().watchdogs), (3, 2));
}

#[test]
fn what_safe_outputs_do_is_a_setting() {
    for (safe, state, rpm) in [
        (Safe::Inhibit, State::SwitchOnDisabled, 300.0..375.0),
        (Safe::QuickStop, State::QuickStopActive, 100.0..300.0),
        (Safe::Fault, State::Fault, 300.0..375.0),
    ] {
        let mut bench = Bench::online(|settings| settings.dp.safe = safe);
        bench.enable();
        bench.hold(300 * MS, 0x7F, 0x1000);
        bench.control(2, 0);
        assert_eq!(bench.slave().axis_state(), state);
        // Outputs do not count until Operate.
        bench.words(0x7F, 0x1000);
        bench.wait(5 * MS);
        let now = bench.rpm();
        assert!(rpm.contains(&now), "{safe:?}: {now}");
        assert_eq!(bench.slave().axis_state(), state);
        bench.hold(2_000 * MS, 0x7F, 0x1000);
        assert_eq!(bench.rpm(), 0.0);
        let fault = (safe == Safe::Fault).then_some([3, 0x81, 0x30]);
        assert_eq!(bench.diagnose()[6..], fault.map_or(vec![], Vec::from));
        bench.control(0, 0);
        bench.words(0x06, 0);
        if safe == Safe::Fault {
            bench.words(0x80, 0);
            bench.words(0x06, 0);
        }
        assert_eq!(bench.slave().axis_state(), State::ReadyToSwitchOn, "{safe:?}");
    }
}

#[test]
fn outputs_count_from_operate_on_and_for_the_groups_that_are_meant() {
    let mut prm = PRM;
    prm[6] = 0b0110;
    let mut bench = Bench::with(|_| ());
    bench.configured(&prm, &[0xF3, 0xF1]);
    let state = |bench: &mut Bench| {
        bench.words(0x06, 0);
        bench.slave().axis_state()
    };
    assert_eq!(state(&mut bench), State::SwitchOnDisabled);
    bench.control(0, 0b1001);
    assert_eq!(state(&mut bench), State::SwitchOnDisabled, "another group");
    bench.control(0, 0b0100);
    assert_eq!(state(&mut bench), State::ReadyToSwitchOn);
    // Neither another group, nor another master, takes it back.
    for (master, groups, expected) in [
        (MASTER, 0b1000, State::ReadyToSwitchOn),
        (3, 0, State::ReadyToSwitchOn),
        (MASTER, 0, State::SwitchOnDisabled),
    ] {
        bench.master = master;
        bench.control(2, groups);
        bench.master = MASTER;
        assert_eq!(bench.slave().axis_state(), expected, "{master} {groups}");
    }
    assert_eq!(bench.slave().misuse(), Misuse::default());
    for command in [0x01, 0x40, 0x20, 0x08] {
        bench.control(command, 0);
    }
    assert_eq!(bench.slave().misuse(), Misuse { control: 4, ..Misuse::default() });
    let mut early = Bench::with(|settings| settings.dp.needs_operate = false);
    early.configured(&PRM, &[0xF3, 0xF1]);
    assert_eq!(state(&mut early), State::ReadyToSwitchOn);
}

#[test]
fn outputs_of_a_wrong_length_end_data_exchange_and_none_are_safe_ones_if_parametrised() {
    for length in [11, 13, 0] {
        let mut bench = with_prm(&PRM);
        assert_eq!(bench.exchange(&vec![0; length]), (3, vec![]));
        assert_eq!(bench.diagnose()[..2], [6, 5], "{length}");
        assert_eq!(bench.slave().misuse(), Misuse { output_length: 1, ..Misuse::default() });
    }
    let mut bench = with_prm(&[0x88, 1, 10, 11, 0, 0x82, 0, 0xC0, 0, 0]);
    bench.words(0x06, 0);
    let (function, data) = bench.exchange(&[]);
    assert_eq!((function, data.len(), bench.slave().axis_state()), (8, 12, State::SwitchOnDisabled));
    assert_eq!(bench.slave().misuse(), Misuse::default());
}

#[test]
fn a_fault_is_due_until_its_diagnosis_is_read_and_again_when_it_is_gone() {
    let mut bench = with_prm(&PRM);
    assert_eq!(bench.exchange(&[0; 12]).0, 8);
    bench.slave().provoke(0x2310);
    assert_eq!((bench.exchange(&[0; 12]).0, bench.exchange(&[0; 12]).0), (0xA, 0xA));
    assert_eq!(bench.diagnose(), [8, 0x0C, 0, MASTER, 0, 0x82, 3, 0x23, 0x10]);
    assert_eq!(bench.exchange(&[0; 12]).0, 8);
    bench.words(0x80, 0);
    assert_eq!(bench.exchange(&[0; 12]).0, 0xA);
    assert_eq!(bench.diagnose(), [0, 0x0C, 0, MASTER, 0, 0x82]);
    bench.slave().set_static_diagnosis(true);
    assert_eq!((bench.exchange(&[0; 12]).0, bench.diagnose()[1]), (0xA, 0x0E));
    // Another master's reading does not count.
    bench.slave().set_static_diagnosis(false);
    let own = bench.master((3, None));
    bench.diagnose();
    bench.master(own);
    assert_eq!(bench.exchange(&[0; 12]).0, 0xA);
}

#[test]
fn identifier_bytes_say_how_long_the_process_data_are() {
    for (bytes, sizes) in [
        (&[0xF3, 0xF1][..], Some((12, 12))),
        (&[0x10], Some((0, 1))),
        (&[0x2F, 0x50], Some((16, 2))),
        // Special: both, 4 words out, 2 bytes in, one byte of the manufacturer.
        (&[0xC1, 0x43, 0x01, 9], Some((8, 2))),
        (&[0x00, 0x30], Some((1, 1))),
        (&[0x0F, 0x80, 0x03], Some((4, 0))),
        (&[0xC0, 0x43], None),
    ] {
        assert_eq!(prm::sizes(bytes), sizes, "{bytes:X?}");
    }
}
