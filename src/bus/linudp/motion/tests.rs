//! Commands as bytes and as meanings.

use proptest::prelude::*;

use super::*;

#[test]
fn a_header_is_id_and_count() {
    let stop = MotionCommand::vai_stop(Acceleration(1));
    assert_eq!((stop.header(0), stop.header(5), stop.header(0x1F)), (0x0170, 0x0175, 0x017F));
    assert_eq!(MotionCommand::new(0x210).header(3), 0x2103);
}

#[test]
fn names_say_one_command_and_keys_one_field() {
    let plain = |name: &str, other: u8| {
        name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == other)
    };
    for (index, info) in CATALOGUE.iter().enumerate() {
        assert!(plain(info.name, b'-'), "{}", info.name);
        assert_eq!(CommandInfo::of(info.id).map(|found| found.name), Some(info.name));
        assert_eq!(CommandInfo::named(info.name).map(|found| found.id), Some(info.id));
        assert!(CATALOGUE[..index].iter().all(|other| other.name != info.name), "{} twice", info.name);
        for (index, field) in info.fields.iter().enumerate() {
            assert!(plain(field.name, b'_'), "{}", field.name);
            assert!(info.fields[..index].iter().all(|other| other.name != field.name), "{}", info.name);
        }
        assert!(info.id <= 0xFFF && info.size() <= 30);
    }
    assert!(CommandInfo::of(0x006).is_none() && CommandInfo::named("vai_go_to").is_none());
}

#[test]
fn streams_carry_what_their_command_has_and_signs() {
    use StreamCommand as S;
    for (command, velocity, acceleration) in [
        (S::P, 0, 0),
        (S::Pv, -2, 0),
        (S::PConfigured, 0, 0),
        (S::PvConfigured, -2, 0),
        (S::Pva, -2, -3),
        (S::PvaConfigured, -2, -3),
    ] {
        let row = (Position(-1), SignedVelocity(-2), SignedAcceleration(-3));
        let block = MotionCommand::stream(command, row.0, row.1, row.2).block(1);
        assert_eq!(block.header >> 4, command.id());
        let stream = Decoded::Stream { command, position: -1, velocity, acceleration };
        assert_eq!(Decoded::of(&block), stream);
        assert_eq!(S::from_id(command.id()), Some(command));
    }
    assert_eq!(S::from_id(0x036), None);
}

const TRAPEZOID: Move = Move {
    value: -5,
    origin: Origin::Zero,
    start: Start::Demand,
    when: When::Now,
    shape: Shape::Trapezoid,
    velocity: Some(1_000_000),
    acceleration: Some(2_000_000),
    deceleration: Some(3_000_000),
    scaled: false,
};

#[test]
fn the_families_of_moves_differ_as_the_manual_says() {
    let (p, v, a, d) = (Position(-5), Velocity(1_000_000), Acceleration(2_000_000), Acceleration(3_000_000));
    let j = Jerk(9);
    let same = Move { deceleration: Some(2_000_000), ..TRAPEZOID };
    let own = Move { velocity: None, acceleration: None, deceleration: None, ..TRAPEZOID };
    let small =
        Move { velocity: Some(1), acceleration: Some(2), deceleration: Some(3), scaled: true, ..TRAPEZOID };
    let (sp, sv, sa, sd) =
        (ScaledPosition(-5), ScaledVelocity(1), ScaledAcceleration(2), ScaledAcceleration(3));
    for (command, expected) in [
        (MotionCommand::vai_go_to(p, v, a, d), TRAPEZOID),
        (MotionCommand::vai_increment_demand(p, v, a, d), Move { origin: Origin::Demand, ..TRAPEZOID }),
        (MotionCommand::vai_increment_target(p, v, a, d), Move { origin: Origin::Target, ..TRAPEZOID }),
        (MotionCommand::vai_go_to_from_actual(p, v, a, d), Move { start: Start::Actual, ..TRAPEZOID }),
        (
            MotionCommand::vai_go_to_from_standstill(p, v, a, d),
            Move { start: Start::Standstill, ..TRAPEZOID },
        ),
        (
            MotionCommand::vai_increment_actual(p, v, a, d),
            Move { origin: Origin::Actual, start: Start::Actual, ..TRAPEZOID },
        ),
        (
            MotionCommand::vai_go_to_after_actual_command(p, v, a, d),
            Move { when: When::AfterActual, ..TRAPEZOID },
        ),
        (
            MotionCommand::vai_increment_target_on_falling_trigger(p, v, a, d),
            Move { origin: Origin::Target, when: When::Trigger { rising: false }, ..TRAPEZOID },
        ),
        (MotionCommand::vai_go_to_analog(v, a, d), Move { value: 0, origin: Origin::Analog, ..TRAPEZOID }),
        (MotionCommand::vai_predefined_go_to(p), own),
        (MotionCommand::vai_16bit_go_to(sp, sv, sa, sd), small),
        (MotionCommand::vai_predefined_16bit_go_to(sp), Move { scaled: true, ..own }),
        (MotionCommand::vai_predefined_acc_go_to(p, v), Move { velocity: Some(1_000_000), ..own }),
        (MotionCommand::vai_dec_acc_go_to(p, v, a), same),
        (MotionCommand::vai_increment_captured(p, v, a, d), Move { origin: Origin::Captured, ..TRAPEZOID }),
        (
            MotionCommand::vai_16bit_dec_acc_increment_captured(sp, sv, sa),
            Move { origin: Origin::Captured, deceleration: Some(2), ..small },
        ),
        (
            MotionCommand::vai_go_to_variable_2_from_actual(v, a, d),
            Move { value: 0, origin: Origin::Variable(2), start: Start::Actual, ..TRAPEZOID },
        ),
        (MotionCommand::sine_va_go_to(p, v, a), Move { shape: Shape::Sine, ..same }),
        (MotionCommand::bestehorn_vaj_go_to(p, v, a, j), Move { shape: Shape::Bestehorn(9), ..same }),
        (
            MotionCommand::bestehorn_vaj_go_to_analog(v, a, j),
            Move { value: 0, origin: Origin::Analog, shape: Shape::Bestehorn(9), ..same },
        ),
        (
            MotionCommand::vaji_increment_demand(p, v, a, d, j),
            Move { shape: Shape::JerkLimited(9), origin: Origin::Demand, ..TRAPEZOID },
        ),
    ] {
        assert_eq!(Decoded::of(&command.block(7)), Decoded::Move(expected), "{:03X}", command.id);
    }
    let press = MotionCommand::vai_dec_acc_press_from_standstill(p, v, a, CurrentLimit(4));
    let motion = Move { start: Start::Standstill, ..same };
    assert_eq!(Decoded::of(&press.block(0)), Decoded::Press { motion, current: 4 });
}

#[test]
fn the_other_families_are_read_as_the_manual_says() {
    let (curve, entry) = (CurveId::new(7).unwrap(), EntryId::new(9).unwrap());
    let (p, v, a, d) = (Position(-5), Velocity(1), Acceleration(2), Acceleration(3));
    let vad = Vad { velocity: 1, acceleration: 2, deceleration: 3 };
    let amplitude = AmplitudeScale::new(-6).unwrap();
    let time_scale = TimeScale::new(8).unwrap();
    let (rising, falling) = (When::Trigger { rising: true }, When::Trigger { rising: false });
    let start = CurveStart { curve: 7, from_actual: false, when: When::Now, fit: CurveFit::Plain };
    let in_time = CurveFit::InTime { offset: -5, time: 4, amplitude: -6 };
    let cam = |cam, from_actual, fit| Decoded::Cam { cam, curve: 7, start: 10, from_actual, fit };
    let until =
        |quantity, greater, limit| Decoded::Wait(Wait::Until(Comparison { quantity, greater, limit }));
    let branch = |condition| Decoded::If { condition, if_true: 9, if_false: 255 };
    let compare =
        |quantity, greater, limit| branch(Condition::Compare(Comparison { quantity, greater, limit }));
    let (yes, no) = (entry, EntryId::new(255).unwrap());
    type M = MotionCommand;
    for (command, expected) in [
        (M::no_operation(), Decoded::NoOperation),
        (M::control_word(Bits(0x83F)), Decoded::ControlWord(0x83F)),
        (M::live_parameter(Upid(0x14BE), Raw(7)), Decoded::LiveParameter { upid: 0x14BE, value: 7 }),
        (M::x4_outputs(Bits(3), Bits(1)), Decoded::Outputs { x6: false, mask: 3, value: 1 }),
        (M::x6_outputs(Bits(3), Bits(1)), Decoded::Outputs { x6: true, mask: 3, value: 1 }),
        (M::controller_set(ControllerSet::new(1).unwrap()), Decoded::ControllerSet(1)),
        (M::clear_events(), Decoded::ClearEvents),
        (M::master_homing(Position(i32::MIN)), Decoded::MasterHoming(i32::MIN)),
        (M::reset_firmware(), Decoded::ResetFirmware),
        (M::vai_stop(Acceleration(u32::MAX)), Decoded::Stop(Some(u32::MAX))),
        (M::vai_predefined_stop(), Decoded::Stop(None)),
        (M::vai_predefined_16bit_stop(), Decoded::Stop(None)),
        (M::vai_16bit_stop(ScaledAcceleration(u16::MAX)), Decoded::StopScaled(u16::MAX)),
        (
            M::vai_change_on_negative_transition(p, v, a, d),
            Decoded::ChangeProfile { positive: false, position: -5, profile: vad, scaled: false },
        ),
        (
            M::vai_16bit_change_on_positive_transition(
                ScaledPosition(-5),
                ScaledVelocity(1),
                ScaledAcceleration(2),
                ScaledAcceleration(3),
            ),
            Decoded::ChangeProfile { positive: true, position: -5, profile: vad, scaled: true },
        ),
        (
            M::vai_predefined_run_negative(),
            Decoded::Run { positive: false, velocity: None, acceleration: None },
        ),
        (
            M::vai_dec_acc_run_positive(v, a),
            Decoded::Run { positive: true, velocity: Some(1), acceleration: Some(2) },
        ),
        (M::vai_start_trigger_fall(), Decoded::StartTriggered { rising: false }),
        (M::indexing_07e(p, v, a, d), Decoded::Indexing { sub: 0xE, position: -5, profile: Some(vad) }),
        (M::indexing_071(p), Decoded::Indexing { sub: 1, position: -5, profile: None }),
        (
            M::stream_pva_stamped(p, SignedVelocity(-2), SignedAcceleration(-3)),
            Decoded::StreamStamped { position: -5, velocity: -2, acceleration: -3 },
        ),
        (M::stream_end(), Decoded::EndStream),
        (M::curve_start(curve), Decoded::Curve(start)),
        (M::curve_start_from_actual(curve), Decoded::Curve(CurveStart { from_actual: true, ..start })),
        (
            M::curve_start_to_target_on_falling_trigger(curve, p),
            Decoded::Curve(CurveStart { when: falling, fit: CurveFit::Target(-5), ..start }),
        ),
        (
            M::curve_start_to_target_in_time_on_rising_trigger(curve, p, CurveTime(4)),
            Decoded::Curve(CurveStart {
                when: rising,
                fit: CurveFit::TargetInTime { target: -5, time: 4 },
                ..start
            }),
        ),
        (
            M::curve_start_scaled(curve, p, time_scale, amplitude),
            Decoded::Curve(CurveStart {
                fit: CurveFit::Scaled { offset: -5, time_scale: 8, amplitude: -6 },
                ..start
            }),
        ),
        (
            M::curve_start_in_time(curve, p, CurveTime(4), amplitude),
            Decoded::Curve(CurveStart { fit: in_time, ..start }),
        ),
        (
            M::curve_start_in_time_on_falling_trigger(curve, p, CurveTime(4), amplitude),
            Decoded::Curve(CurveStart { when: falling, fit: in_time, ..start }),
        ),
        (M::curve_modify_start_address(curve, Offset(1)), Decoded::CurveAddress { curve: 7, address: 1 }),
        (
            M::curve_modify_info_short(curve, Offset(1), Short(-2)),
            Decoded::ModifyCurve { curve: 7, info: true, offset: 1, values: Written::Short(-2) },
        ),
        (
            M::curve_modify_three(curve, Offset(1), Long(-2), Long(3), Long(4)),
            Decoded::ModifyCurve { curve: 7, info: false, offset: 1, values: Written::Three([-2, 3, 4]) },
        ),
        (
            M::cam_to_position_on_falling_trigger(curve, Counts(10), p, Counts(11)),
            Decoded::DelayedCam {
                curve: 7,
                delay: 10,
                when: falling,
                fit: CamFit::TargetOver { target: -5, length: 11 },
            },
        ),
        (
            M::cam_from_actual_counts(curve, Counts(10)),
            Decoded::DelayedCam { curve: 7, delay: 10, when: When::Now, fit: CamFit::Plain },
        ),
        (M::encoder_cam_enable(), Decoded::EnableCams(true)),
        (M::encoder_cam_go_to_sync(), Decoded::GoToSync),
        (M::encoder_cam_set_counts(Counts(-1)), Decoded::EncoderCounts(-1)),
        (M::encoder_cam_1_start(curve, Counts(10)), cam(1, false, CamFit::Plain)),
        (M::encoder_cam_2_start_from_actual(curve, Counts(10)), cam(2, true, CamFit::Plain)),
        (M::encoder_cam_2_start_to_position(curve, Counts(10), p), cam(2, false, CamFit::Target(-5))),
        (
            M::encoder_cam_1_start_between(curve, Counts(10), p, Position(6), Counts(11)),
            cam(1, false, CamFit::Between { start: -5, target: 6, length: 11 }),
        ),
        (
            M::encoder_cam_1_start_scaled(curve, Counts(10), amplitude, Counts(11)),
            cam(1, false, CamFit::Scaled { amplitude: -6, length: 11 }),
        ),
        (M::encoder_cam_2_disable(), Decoded::EnableCam { cam: 2, enable: false }),
        (
            M::encoder_cam_1_scale(amplitude, Counts(11)),
            Decoded::ScaleCam { cam: 1, amplitude: -6, length: 11 },
        ),
        (M::table_start(entry), Decoded::TableEntry { entry: 9, when: When::Now }),
        (M::table_start_on_falling_trigger(entry), Decoded::TableEntry { entry: 9, when: falling }),
        (
            M::table_modify_short(entry, Offset(2), Short(-1)),
            Decoded::ModifyEntry { entry: 9, offset: 2, value: Written::Short(-1) },
        ),
        (
            M::table_modify_long(entry, Offset(6), Long(-1)),
            Decoded::ModifyEntry { entry: 9, offset: 6, value: Written::One(-1) },
        ),
        (M::wait_time(WaitTime(10)), Decoded::Wait(Wait::Time(10))),
        (M::wait_until_in_target(), Decoded::Wait(Wait::InTarget)),
        (M::wait_for_falling_trigger(), Decoded::Wait(Wait::Trigger { rising: false })),
        (M::wait_time_in_variable_2(), Decoded::Wait(Wait::Variable(2))),
        (M::wait_until_demand_position_greater(p), until(Quantity::DemandPosition, true, -5)),
        (M::wait_until_unsigned_difference_less(p), until(Quantity::UnsignedDifference, false, -5)),
        (M::wait_until_actual_velocity_less(SignedVelocity(-2)), until(Quantity::ActualVelocity, false, -2)),
        (M::wait_until_current_less(ShortCurrent(-2)), until(Quantity::Current, false, -2)),
        (M::variable_1_add(Long(-2)), Decoded::Variable { variable: 1, add: true, value: -2 }),
        (M::variable_2_set(Long(-2)), Decoded::Variable { variable: 2, add: false, value: -2 }),
        (M::variable_2_to_upid(Upid(8)), Decoded::VariableToUpid { variable: 2, upid: 8 }),
        (M::upid_to_variable_1(Upid(8)), Decoded::UpidToVariable { variable: 1, upid: 8 }),
        (M::upid_ram_to_rom(Upid(8)), Decoded::UpidToRom(8)),
        (M::if_variable_2_less(Long(-2), yes, no), compare(Quantity::Variable(2), false, -2)),
        (M::if_demand_position_greater(p, yes, no), compare(Quantity::DemandPosition, true, -5)),
        (M::if_difference_less(p, yes, no), compare(Quantity::Difference, false, -5)),
        (M::if_current_greater(Current(-2), yes, no), compare(Quantity::Current, true, -2)),
        (M::if_analog_input_less(Long(-2), yes, no), compare(Quantity::AnalogInput, false, -2)),
        (M::if_266(Long(-2), yes, no), branch(Condition::Unknown(-2))),
        (
            M::if_warn_word_equal(Bits(3), Bits(1), yes, no),
            branch(Condition::Masked { word: Word::Warn, mask: 3, value: 1 }),
        ),
        (M::winding_311(Number(1), Counts(2)), Decoded::Winding { id: 0x311, number: 1, revolutions: 2 }),
        (
            M::force_383(p, v, a, Force(-1), Force(2)),
            Decoded::Force {
                id: 0x383,
                value: -5,
                velocity: 1,
                acceleration: 2,
                deceleration: None,
                limit: Some(-1),
                target: Some(2),
            },
        ),
        (
            M::force_386(p, v, a, d),
            Decoded::Force {
                id: 0x386,
                value: -5,
                velocity: 1,
                acceleration: 2,
                deceleration: Some(3),
                limit: None,
                target: None,
            },
        ),
        (M::force_change_target(Force(-1)), Decoded::ForceTarget(-1)),
        (M::current_mode(Current(-2)), Decoded::CurrentMode(-2)),
        (M::position_mode(), Decoded::PositionMode),
    ] {
        assert_eq!(Decoded::of(&command.block(7)), expected, "{:03X}", command.id);
    }
}

#[test]
fn what_no_manual_lists_is_unknown() {
    for unknown in [0x00A, 0x025, 0x036, 0x048, 0x08F, 0x0B7, 0x0C9, 0x0E2, 0x203, 0x256, 0x3A2, 0x999, 0xFFF]
    {
        assert_eq!(Decoded::of(&MotionCommand::new(unknown).block(0)), Decoded::Unknown, "{unknown:03X}");
    }
}

proptest! {
    #[test]
    fn any_block_is_read_and_its_count_changes_nothing(
        header in any::<u16>(),
        parameters in any::<[u8; 30]>(),
        count in 0_u16..16,
    ) {
        let read = Decoded::of(&MotionBlock { header, parameters });
        let counted = MotionBlock { header: header & !0xF | count, parameters };
        prop_assert_eq!(Decoded::of(&counted), read);
    }

    #[test]
    fn any_command_that_is_known_comes_back_from_its_values(
        index in any::<prop::sample::Index>(),
        parameters in any::<[u8; 30]>(),
    ) {
        let info = index.get(CATALOGUE);
        let values = info.values(&parameters);
        let block = MotionCommand { id: info.id, parameters }.block(0);
        prop_assert_ne!(Decoded::of(&block), Decoded::Unknown);
        let out_of_range = info.fields.iter().find(|field| field.kind.check(field.read(&parameters)).is_err());
        match info.command(&values) {
            Ok(command) => {
                prop_assert_eq!(out_of_range, None);
                prop_assert_eq!(&command.parameters[..info.size()], &parameters[..info.size()]);
                prop_assert!(command.parameters[info.size()..].iter().all(|byte| *byte == 0));
                prop_assert_eq!(Decoded::of(&command.block(0)), Decoded::of(&block));
            }
            Err((field, _)) => prop_assert_eq!(Some(&field), out_of_range),
        }
    }
}
