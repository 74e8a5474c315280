//! LinUDP V2: requests of the master as the drive reads them, answers of the drive as the master reads them, objects
//! that are transferred, and the numbers of both.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat_core::time::Time;
use fieldbeat_linudp::curve::{Curve, CurveKind, Dimension};
use fieldbeat_linudp::motion::{CATALOGUE, CommandInfo};
use fieldbeat_linudp::table::Entry;
use fieldbeat_linudp::upid::{KNOWN, Type, Usage};
use fieldbeat_linudp::wire::{
    ControlWord, ErrorCode, MainState, MotionBlock, Refusal, Request, RequestDef, Response, ResponseDef,
    RtcBlock, RtcCommand, RtcStatus, StateVar, StatusWord, WarnWord,
};
use fieldbeat_linudp::{DRIVE_PORT, MASTER_PORT, StreamCommand};
use fieldbeat_sim::SimDrive;
use fieldbeat_sim::linudp::codec::channel::{self, ConfigBlock, command, usage};
use fieldbeat_sim::linudp::codec::commands::{StreamKind, layout, values, width};
use fieldbeat_sim::linudp::codec::{self, Report, control, errors, state, status, stored, sub_state, warn};
use fieldbeat_sim::linudp::{LinMotSettings, LinMotSim};
use proptest::prelude::*;

fn config() -> impl Strategy<Value = RtcBlock> {
    (0..16_u8, any::<u8>(), any::<[u16; 3]>())
        .prop_map(|(count, code, words)| RtcBlock { words, ..RtcBlock::answer(count, code) })
}

prop_compose! {
    fn request()(
        reserved in prop_oneof![Just(0), any::<u32>()],
        response in any::<u32>(),
        control in any::<Option<u16>>(),
        motion in any::<Option<(u16, [u8; 30])>>(),
        config in prop::option::of(config()),
    ) -> Request {
        Request {
            reserved: RequestDef(reserved & RequestDef::RESERVED.0),
            response_def: ResponseDef(response),
            control: control.map(ControlWord),
            motion: motion.map(|(header, parameters)| MotionBlock { header, parameters }),
            config,
        }
    }
}

fn block(config: &ConfigBlock) -> RtcBlock {
    RtcBlock { words: config.words, ..RtcBlock::answer(config.count, config.code) }
}

fn motion(motion: codec::Motion) -> MotionBlock {
    MotionBlock { header: motion.header, parameters: motion.parameters }
}

proptest! {
    #[test]
    fn a_request_of_the_master_is_the_same_to_the_drive(request in request(), behind in 0..20_usize) {
        let mut bytes = [0xA5; 80];
        let size = request.emit(&mut bytes);
        let read = codec::Request::parse(&bytes[..size + behind]).unwrap();
        prop_assert_eq!(read.definitions, [request.definition().0, request.response_def.0]);
        prop_assert_eq!(read.control.map(ControlWord), request.control);
        prop_assert_eq!(read.motion.map(motion), request.motion);
        prop_assert_eq!(read.config.as_ref().map(block), request.config);
    }

    #[test]
    fn any_bytes_are_a_request_to_both_or_to_none(
        definition in 0..16_u32,
        rest in prop::collection::vec(any::<u8>(), 0..60),
    ) {
        let bytes = [&definition.to_le_bytes()[..], &rest].concat();
        let (master, drive) = (Request::parse(&bytes).ok(), codec::Request::parse(&bytes));
        prop_assert_eq!(drive.is_some(), master.is_some());
        if let (Some(master), Some(drive)) = (master, drive) {
            prop_assert_eq!(drive.control.map(ControlWord), master.control);
            prop_assert_eq!(drive.motion.map(motion), master.motion);
            let words = |config: RtcBlock| (config.count(), config.code, config.words);
            let read = |config: ConfigBlock| (config.count, config.code, config.words);
            prop_assert_eq!(drive.config.map(read), master.config.map(words));
        }
    }

    #[test]
    fn an_answer_of_the_drive_is_the_same_to_the_master(
        definitions in any::<[u32; 2]>(),
        (status, state, warn, error) in any::<(u16, u16, u16, u16)>(),
        (actual, demand, current) in any::<(i32, i32, i16)>(),
        monitor in any::<[u32; 4]>(),
        (count, code, words) in (0..16_u8, any::<u8>(), any::<[u16; 3]>()),
        padding in 0..20_usize,
    ) {
        let config = (definitions[0] & RequestDef::CONFIG.0 != 0).then_some(ConfigBlock { count, code, words });
        let report = Report { status, state, actual, demand, current, warn, error, monitor, config };
        let mut bytes = [0xA5; 80];
        let size = report.write(definitions, &mut bytes);
        prop_assert!(size <= codec::RESPONSE_MAX);
        let read = Response::parse(&bytes[..size + padding]).unwrap();
        // The master knows drives that leave out the last block.
        prop_assert!(config.is_some() || Response::parse(&bytes[..size - 1]).is_err());
        let has = |bit: u32| definitions[1] >> bit & 1 == 1;
        prop_assert_eq!((read.request_def.0, read.response_def.0), (definitions[0], definitions[1]));
        prop_assert_eq!(read.status, has(0).then_some(StatusWord(status)));
        prop_assert_eq!(read.state, has(1).then_some(StateVar(state)));
        prop_assert_eq!(read.actual, has(2).then_some(actual));
        prop_assert_eq!(read.demand, has(3).then_some(demand));
        prop_assert_eq!(read.current, has(4).then_some(current));
        prop_assert_eq!(read.warn, has(5).then_some(WarnWord(warn)));
        prop_assert_eq!(read.error, has(6).then_some(ErrorCode(error)));
        prop_assert_eq!(read.monitor, has(7).then_some(monitor));
        prop_assert_eq!(read.config, config.as_ref().map(block));
        if let Some(config) = read.config {
            prop_assert_eq!(config.value(), report.config.unwrap().value());
        }
    }

    #[test]
    fn the_fields_of_every_motion_command_are_the_same(parameters in any::<[u8; 30]>()) {
        for id in 0..=0xFFF {
            let (master, drive) = (CommandInfo::of(id), layout(id));
            match (master, drive) {
                (Some(info), Some(layout)) => {
                    prop_assert_eq!(values(layout, &parameters), info.values(&parameters), "{:03X}", id);
                    let size: usize = layout.chars().map(width).sum();
                    prop_assert_eq!(size, info.size(), "{:03X}", id);
                }
                (Some(_), None) => prop_assert!(is_of_no_use(id), "{:03X} is missing in the drive", id),
                (None, Some(_)) => prop_assert!(false, "{:03X} is missing in the master", id),
                (None, None) => {}
            }
        }
        prop_assert!(CATALOGUE.iter().filter(|info| layout(info.id).is_some()).count() > 150);
    }

    #[test]
    fn curves_and_entries_are_the_same(
        id in 1..=100_u16,
        is_time in any::<bool>(),
        x_length in 1..u32::MAX,
        words in any::<[u16; 3]>(),
        setpoints in prop::collection::vec(any::<i32>(), 2..20),
        share in 0.0..=1.0,
        entry in any::<[u8; 62]>(),
    ) {
        let [x, y, wizard] = words;
        let curve = Curve {
            id,
            kind: if is_time { CurveKind::Time } else { CurveKind::Cam },
            name: [b'n'; 22],
            x_length,
            x_dimension: Dimension(x),
            y_dimension: Dimension(y),
            wizard,
            wizard_parameters: [7; 7],
            setpoints: setpoints.clone(),
        };
        let (info, data) = curve.encode().unwrap();
        let read = stored::Curve::parse(&info, &data).unwrap();
        let expected = stored::Curve { id, is_time, length: x_length, setpoints };
        prop_assert_eq!(&read, &expected);
        let (drive, master) = (read.position_at(share), curve.position_at(share * f64::from(x_length)));
        prop_assert!((drive - master).abs() < 16.0, "{} {}", drive, master);

        let mut bytes = [0; 64];
        bytes[..2].copy_from_slice(&0xA701_u16.to_le_bytes());
        bytes[2..].copy_from_slice(&entry);
        let (master, drive) = (Entry::decode(&bytes).unwrap(), stored::Entry::parse(bytes).unwrap());
        let command = drive.command();
        prop_assert_eq!(drive.link(), master.next);
        prop_assert_eq!((command.id(), command.parameters), (master.command().id, master.command().parameters));
    }
}

/// Commands that the drive has no hardware, no software key or no known meaning for: encoder cams, indexing, winding,
/// force control, a stream with time stamps, the address of a curve, comparing a variable with a UPID.
fn is_of_no_use(id: u16) -> bool {
    matches!(id >> 4, 0x06 | 0x07 | 0x10..=0x12 | 0x30 | 0x31 | 0x38) || matches!(id, 0x03A | 0x050)
}

#[test]
fn the_numbers_are_the_same() {
    use RtcCommand as Master;
    assert_eq!((codec::MASTER_PORT, codec::DRIVE_PORT), (MASTER_PORT, DRIVE_PORT));
    assert_eq!(codec::RESPONSE_MAX, fieldbeat_linudp::wire::RESPONSE_MAX);
    // Drive, master.
    for (drive, master) in [
        (control::SWITCH_ON, ControlWord::SWITCH_ON),
        (control::VOLTAGE_ENABLE, ControlWord::VOLTAGE_ENABLE),
        (control::NO_QUICK_STOP, ControlWord::NO_QUICK_STOP),
        (control::ENABLE_OPERATION, ControlWord::ENABLE_OPERATION),
        (control::NO_ABORT, ControlWord::NO_ABORT),
        (control::NO_FREEZE, ControlWord::NO_FREEZE),
        (control::GO_TO_POSITION, ControlWord::GO_TO_POSITION),
        (control::ERROR_ACKNOWLEDGE, ControlWord::ERROR_ACKNOWLEDGE),
        (control::JOG_PLUS, ControlWord::JOG_PLUS),
        (control::JOG_MINUS, ControlWord::JOG_MINUS),
        (control::HOME, ControlWord::HOMING),
        (control::GO_TO_INITIAL, ControlWord::GO_TO_INITIAL),
        (control::ENABLES, ControlWord::BASE.0),
        (control::ON, ControlWord::ON.0),
        (control::ON | control::HOME, ControlWord::HOME.0),
        (status::OPERATION_ENABLED, StatusWord::OPERATION_ENABLED),
        (status::SWITCH_ON_ACTIVE, StatusWord::SWITCH_ON_ACTIVE),
        (status::ENABLE_OPERATION, StatusWord::ENABLE_OPERATION),
        (status::ERROR, StatusWord::ERROR),
        (status::VOLTAGE_ENABLE, StatusWord::VOLTAGE_ENABLE),
        (status::NO_QUICK_STOP, StatusWord::NO_QUICK_STOP),
        (status::SWITCH_ON_LOCKED, StatusWord::SWITCH_ON_LOCKED),
        (status::WARNING, StatusWord::WARNING),
        (status::EVENT_HANDLER, StatusWord::EVENT_HANDLER),
        (status::SPECIAL_MOTION, StatusWord::SPECIAL_MOTION),
        (status::IN_TARGET, StatusWord::IN_TARGET),
        (status::HOMED, StatusWord::HOMED),
        (status::FATAL_ERROR, StatusWord::FATAL_ERROR),
        (status::MOTION_ACTIVE, StatusWord::MOTION_ACTIVE),
        (warn::POSITION_LAG, WarnWord::POSITION_LAG),
        (warn::NOT_HOMED, WarnWord::NOT_HOMED),
        (errors::MIN_POSITION, ErrorCode::MIN_POSITION.0),
        (errors::MAX_POSITION, ErrorCode::MAX_POSITION.0),
        (errors::POSITION_LAG, ErrorCode::POSITION_LAG.0),
        (errors::CURVE_NOT_DEFINED, ErrorCode::CURVE_NOT_DEFINED.0),
        (errors::NOT_HOMED, ErrorCode::NOT_HOMED.0),
        (errors::UNKNOWN_COMMAND, ErrorCode::UNKNOWN_COMMAND.0),
        (errors::STREAM_OVERFLOW, ErrorCode::STREAM_OVERFLOW.0),
        (errors::STREAM_UNDERFLOW, ErrorCode::STREAM_UNDERFLOW.0),
        (errors::STREAM_TOO_FAST, ErrorCode::STREAM_TOO_FAST.0),
        (errors::STREAM_TOO_SLOW, ErrorCode::STREAM_TOO_SLOW.0),
        (errors::WRONG_STATE, ErrorCode::WRONG_STATE.0),
        (errors::ENTRY_MISSING, ErrorCode::ENTRY_MISSING.0),
        (usage::RAM_READ, Usage::RAM_READ),
        (usage::RAM_WRITE, Usage::RAM_WRITE),
        (usage::ROM_READ, Usage::ROM_READ),
        (usage::ROM_WRITE, Usage::ROM_WRITE),
        (usage::LIVE, Usage::LIVE),
        (usage::NOT_HASHED, Usage::NOT_HASHED),
    ] {
        assert_eq!(drive, master);
    }
    for (drive, master) in [
        (state::NOT_READY, MainState::NOT_READY),
        (state::SWITCH_ON_DISABLED, MainState::SWITCH_ON_DISABLED),
        (state::READY_TO_SWITCH_ON, MainState::READY_TO_SWITCH_ON),
        (state::ERROR, MainState::ERROR),
        (state::HW_TESTS, MainState::HW_TESTS),
        (state::READY_TO_OPERATE, MainState::READY_TO_OPERATE),
        (state::OPERATION_ENABLED, MainState::OPERATION_ENABLED),
        (state::HOMING, MainState::HOMING),
        (state::GOING_TO_INITIAL, MainState::GOING_TO_INITIAL),
        (state::ABORTING, MainState::ABORTING),
        (state::FREEZING, MainState::FREEZING),
        (state::QUICK_STOP, MainState::QUICK_STOP),
        (state::GOING_TO_POSITION, MainState::GOING_TO_POSITION),
        (state::JOGGING_PLUS, MainState::JOGGING_PLUS),
        (state::JOGGING_MINUS, MainState::JOGGING_MINUS),
    ] {
        assert_eq!(StateVar(u16::from(drive) << 8).main(), master);
    }
    for sub in 0..=u8::MAX {
        let read = StateVar(u16::from_be_bytes([state::OPERATION_ENABLED, sub]));
        assert_eq!(read.count(), Some(sub & 0xF));
        assert_eq!(read.motion_active(), Some(sub & sub_state::MOTION_ACTIVE != 0));
        let homing = StateVar(u16::from_be_bytes([state::HOMING, sub]));
        assert_eq!(homing.finished(), sub == sub_state::FINISHED);
    }
    assert_eq!(
        [sub_state::EVENT_HANDLER, sub_state::MOTION_ACTIVE, sub_state::IN_TARGET, sub_state::HOMED],
        [StateVar::EVENT_HANDLER, StateVar::MOTION_ACTIVE, StateVar::IN_TARGET, StateVar::HOMED]
    );
    for code in 0..=u16::MAX {
        assert_eq!(errors::text(code).is_some(), ErrorCode(code).name().is_some(), "{code:04X}h");
        assert_eq!(errors::is_fatal(code), ErrorCode(code).is_fatal(), "{code:04X}h");
    }
    use channel::Refusal as R;
    for (drive, master) in [
        (R::NoSuchUpid, Refusal::NoSuchUpid),
        (R::WrongType, Refusal::WrongType),
        (R::OutOfRange, Refusal::OutOfRange),
        (R::AddressUsage, Refusal::AddressUsage),
        (R::ListNotStarted, Refusal::ListNotStarted),
        (R::EndOfList, Refusal::EndOfList),
        (R::OddAddress, Refusal::OddAddress),
        (R::WrongSize, Refusal::WrongSize),
        (R::CurveDefinition, Refusal::CurveDefinition),
        (R::SoftwareRuns, Refusal::SoftwareRuns),
    ] {
        assert_eq!(RtcStatus::of(drive as u8), RtcStatus::Refused(master));
    }
    let drive = [
        channel::status::DONE,
        channel::status::RUNNING,
        channel::status::BLOCK_NOT_FINISHED,
        channel::status::BUSY,
    ];
    let master = [RtcStatus::Done, RtcStatus::Running, RtcStatus::BlockNotFinished, RtcStatus::Busy];
    assert_eq!(drive.map(RtcStatus::of), master);
    for (drive, master) in [
        (command::NO_OPERATION, Master::NO_OPERATION),
        (command::READ_ROM, Master::READ_ROM),
        (command::READ_RAM, Master::READ_RAM),
        (command::WRITE_ROM, Master::WRITE_ROM),
        (command::WRITE_RAM, Master::WRITE_RAM),
        (command::WRITE_BOTH, Master::WRITE_BOTH),
        (command::READ_MINIMUM, Master::READ_MINIMUM),
        (command::READ_MAXIMUM, Master::READ_MAXIMUM),
        (command::READ_DEFAULT, Master::READ_DEFAULT),
        (command::START_LIST, Master::START_LIST),
        (command::NEXT_ITEM, Master::NEXT_ITEM),
        (command::START_MODIFIED_LIST, Master::START_MODIFIED_LIST),
        (command::NEXT_MODIFIED_ITEM, Master::NEXT_MODIFIED_ITEM),
        (command::RESTART, Master::RESTART),
        (command::DEFAULT_OS, Master::DEFAULT_OS),
        (command::DEFAULT_MC, Master::DEFAULT_MC),
        (command::DEFAULT_INTERFACE, Master::DEFAULT_INTERFACE),
        (command::DEFAULT_APPLICATION, Master::DEFAULT_APPLICATION),
        (command::STOP_SOFTWARE, Master::STOP_SOFTWARE),
        (command::START_SOFTWARE, Master::START_SOFTWARE),
        (command::SAVE_CURVES, Master::SAVE_CURVES),
        (command::DELETE_CURVES, Master::DELETE_CURVES),
        (command::ADD_CURVE, Master::ADD_CURVE),
        (command::ADD_CURVE_INFO, Master::ADD_CURVE_INFO),
        (command::ADD_CURVE_DATA, Master::ADD_CURVE_DATA),
        (command::MODIFY_CURVE, Master::MODIFY_CURVE),
        (command::MODIFY_CURVE_INFO, Master::MODIFY_CURVE_INFO),
        (command::MODIFY_CURVE_DATA, Master::MODIFY_CURVE_DATA),
        (command::GET_CURVE, Master::GET_CURVE),
        (command::GET_CURVE_INFO, Master::GET_CURVE_INFO),
        (command::GET_CURVE_DATA, Master::GET_CURVE_DATA),
        (command::ERROR_COUNTERS, Master::ERROR_COUNTERS),
        (command::ERROR_CODE, Master::ERROR_CODE),
        (command::ERROR_TIME_LOW, Master::ERROR_TIME_LOW),
        (command::ERROR_TIME_HIGH, Master::ERROR_TIME_HIGH),
        (command::ERROR_TEXT, Master::ERROR_TEXT),
        (command::SAVE_TABLE, Master::SAVE_TABLE),
        (command::DELETE_TABLE, Master::DELETE_TABLE),
        (command::DELETE_ENTRY, Master::DELETE_ENTRY),
        (command::WRITE_ENTRY, Master::WRITE_ENTRY),
        (command::WRITE_ENTRY_DATA, Master::WRITE_ENTRY_DATA),
        (command::GET_ENTRY, Master::GET_ENTRY),
        (command::GET_ENTRY_DATA, Master::GET_ENTRY_DATA),
        (command::PRESENCE, Master::PRESENCE_0),
        (command::LAST_PRESENCE, RtcCommand(Master::PRESENCE_0.0 + 7)),
    ] {
        assert_eq!(drive, master.0, "{master}");
    }
    for (master, sub) in StreamCommand::ALL.into_iter().zip(0..) {
        let drive = StreamKind::of(sub).unwrap();
        assert_eq!(master.id(), 0x030 | sub);
        assert_eq!(drive.has_velocity(), master.has_velocity());
        assert_eq!(drive.has_configured_period(), master.has_configured_period());
        assert_eq!(drive.periods_ns(), master.period_range_ns());
    }
    assert_eq!(StreamKind::of(6), None);
    for (drive, master) in [
        (channel::Type::Bool, Type::Bool),
        (channel::Type::U8, Type::U8),
        (channel::Type::U16, Type::U16),
        (channel::Type::S16, Type::S16),
        (channel::Type::U32, Type::U32),
        (channel::Type::S32, Type::S32),
        (channel::Type::Stringlet, Type::Text),
    ] {
        assert_eq!(drive.range(), master.range());
        for value in [drive.range().0, -1, 0, 1, drive.range().1] {
            if (drive.range().0..=drive.range().1).contains(&value) {
                for extend in [false, true] {
                    assert_eq!(drive.to_wire(value, extend), master.raw(value, extend), "{drive:?}");
                    assert_eq!(master.number(drive.to_wire(value, extend)), value);
                }
                assert_eq!(drive.from_wire(drive.to_wire(value, true)), Some(value));
            }
        }
    }
}

#[test]
fn the_drive_has_the_parameters_that_the_master_knows_with_their_types() {
    let at = |port| SocketAddrV4::new(Ipv4Addr::LOCALHOST, port);
    let mut drive = LinMotSim::new(LinMotSettings::new(at(DRIVE_PORT)));
    let mut count = 0;
    let mut call = |command, upid, value| {
        count = count % 15 + 1;
        let config = Some(RtcBlock::call(count, command, upid, value));
        let (mut bytes, mut reply) = ([0; 64], Vec::new());
        let size = Request { config, ..Request::default() }.emit(&mut bytes);
        drive.receive(Time(0), at(MASTER_PORT), &bytes[..size], &mut reply);
        let answer = Response::parse(&reply).unwrap().config.unwrap();
        (answer.status(), answer.value())
    };
    for known in KNOWN {
        let upid = known.upid.0;
        let bounds = [RtcCommand::READ_MINIMUM, RtcCommand::READ_MAXIMUM].map(|bound| call(bound, upid, 0));
        let (low, high) = known.kind.range();
        for (status, raw) in bounds {
            assert_eq!(status, RtcStatus::Done, "{}", known.name);
            // Numbers with a sign have it in all 32 bits, or in their own.
            assert!((low..=high).contains(&known.kind.number(raw)), "{}", known.name);
        }
        let (status, _) = call(RtcCommand::WRITE_RAM, upid, (high + 1) as u32);
        let is_narrow = i64::from(u32::MAX) > high && low == 0;
        let refusals = [Refusal::WrongType, Refusal::AddressUsage].map(RtcStatus::Refused);
        assert!(!is_narrow || refusals.contains(&status), "{}: {status:?}", known.name);
    }
}
