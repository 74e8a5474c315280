//! EtherCAT with CoE and CiA 402.

use fieldbeat_core::axis::State;
use fieldbeat_core::bus::cia402 as core402;
use fieldbeat_ethercat::faults::Fault;
use fieldbeat_ethercat::mode::Mode;
use fieldbeat_ethercat::object::catalogue::{self, Access, Drives};
use fieldbeat_ethercat::object::{Object, Type, number, pdo};
use fieldbeat_ethercat::wire::frame::{BROADCAST, Builder, Command, FRAME_MAX, datagrams};
use fieldbeat_ethercat::wire::mailbox::{self, Counter, Emergency, MailboxError, Message};
use fieldbeat_ethercat::wire::registers::{
    AlCode, AlState, AlStatus, Difference, Features, Fmmu, Links, SyncManager, address,
};
use fieldbeat_ethercat::wire::sdo::{AbortCode, Request, Response};
use fieldbeat_ethercat::wire::sii::{self, Category, Identity, Protocols, Status, Use};
use fieldbeat_ethercat::{Family, wire};
use fieldbeat_sim::ethercat::codec::mailbox::Kind;
use fieldbeat_sim::ethercat::codec::{self as own, cia402, frame, objects, registers};
use fieldbeat_sim::ethercat::sii::{Contents, Mailboxes};
use proptest::collection::vec;
use proptest::prelude::*;

const FAMILIES: [Family; 2] = [Family::S700, Family::Akd];

fn at(object: objects::Object) -> Object {
    Object::new(object.index, object.sub)
}

fn there(object: Object) -> objects::Object {
    objects::Object::new(object.index, object.sub)
}

/// What both have a name for.
#[test]
fn addresses_codes_and_numbers_are_the_same() {
    use registers::address as a;
    for (master, slave) in [
        (address::TYPE, a::TYPE),
        (address::RESOURCES, a::RESOURCES),
        (address::FEATURES, a::FEATURES),
        (address::STATION, a::STATION),
        (address::ALIAS, a::ALIAS),
        (address::PORT_LOOPS + 1, a::FIFO_SIZE),
        (address::ALIAS_ENABLE, a::ALIAS_ENABLE),
        (address::LINKS, a::LINKS),
        (address::AL_CONTROL, a::AL_CONTROL),
        (address::AL_STATUS, a::AL_STATUS),
        (address::AL_STATUS + 4, a::AL_CODE),
        (address::EMULATION - 1, a::PDI_CONTROL),
        (address::EVENT_MASK, a::EVENT_MASK),
        (address::ERRORS, a::ERRORS),
        (address::WATCHDOG_DIVIDER, a::WATCHDOG_DIVIDER),
        (address::WATCHDOG, a::WATCHDOG),
        (address::WATCHDOG_STATUS, a::WATCHDOG_STATUS),
        (address::SII_OWNER, a::SII_OWNER),
        (address::SII_CONTROL, a::SII_CONTROL),
        (address::SII_CONTROL + 2, a::SII_ADDRESS),
        (address::SII_DATA, a::SII_DATA),
        (address::FMMU, a::FMMU),
        (address::SYNC_MANAGER, a::SYNC_MANAGER),
        (address::DC_PORTS, a::DC_PORTS),
        (address::DC_TIME, a::DC_TIME),
        (address::DC_RECEIVED, a::DC_RECEIVED),
        (address::DC_OFFSET, a::DC_OFFSET),
        (address::DC_DELAY, a::DC_DELAY),
        (address::DC_DIFFERENCE, a::DC_DIFFERENCE),
        (address::DC_SPEED, a::DC_SPEED),
        (address::DC_FILTER, a::DC_FILTER),
        (address::DC_CONTROL, a::DC_CONTROL),
        (address::DC_ACTIVATION, a::DC_ACTIVATION),
        (address::DC_START, a::DC_START),
        (address::DC_CYCLE, a::DC_CYCLE),
    ] {
        assert_eq!(master, slave);
    }
    for n in 0..16 {
        assert_eq!((address::fmmu(n), address::sync_manager(n)), (a::fmmu(n), a::sync_manager(n)));
    }
    assert_eq!(wire::frame::ETHERTYPE, frame::ETHERTYPE);
    assert_eq!(SyncManager::STATUS, registers::SyncManager::STATUS);
    assert_eq!(
        [SyncManager::FULL, SyncManager::WATCHDOG],
        [registers::SyncManager::FULL, registers::SyncManager::WATCHDOG]
    );
    assert_eq!(AlStatus::ERROR, registers::al::ERROR);
    assert_eq!(AlStatus::IDENTIFICATION, registers::al::IDENTIFICATION);

    use registers::code;
    for (code, name) in [
        (code::NONE, "no error"),
        (code::INVALID_REQUEST, "invalid state change requested"),
        (code::UNKNOWN_STATE, "unknown state requested"),
        (code::NO_BOOT, "bootstrap not supported"),
        (code::MAILBOX, "invalid mailbox configuration (PREOP)"),
        (code::SYNC_MANAGER, "invalid SyncManager configuration"),
        (code::SYNCHRONISATION, "synchronisation error"),
        (code::WATCHDOG, "SyncManager watchdog"),
        (code::OUTPUTS, "invalid output configuration"),
        (code::INPUTS, "invalid input configuration"),
        (code::NO_SII, "SII not accessible"),
    ] {
        assert_eq!(AlCode(code).name(), Some(name));
    }

    use own::mailbox::abort;
    for (master, slave) in [
        (AbortCode::TOGGLE, abort::TOGGLE),
        (AbortCode::COMMAND, abort::COMMAND),
        (AbortCode::READ_ONLY, abort::READ_ONLY),
        (AbortCode::NOT_COMPLETE, abort::NOT_COMPLETE),
        (AbortCode::NO_OBJECT, abort::NO_OBJECT),
        (AbortCode::LENGTH, abort::LENGTH),
        (AbortCode::NO_SUB, abort::NO_SUB),
        (AbortCode::RANGE, abort::RANGE),
        (AbortCode::STATE, abort::STATE),
    ] {
        assert_eq!(master.0, slave);
    }
    for code in
        [abort::NOT_ZERO, abort::MAPPED, abort::NOT_MAPPABLE, abort::INCOMPATIBLE, abort::HIGH, abort::LOW]
    {
        assert!(AbortCode(code).name().is_some(), "{code:#010x}");
    }
    for code in [
        own::mailbox::refusal::PROTOCOL,
        own::mailbox::refusal::SERVICE,
        own::mailbox::refusal::SHORT,
        own::mailbox::refusal::SIZE,
    ] {
        assert!(MailboxError(code).name().is_some(), "{code}");
    }

    assert_eq!([number::OUTPUT_PDO, number::INPUT_PDO], [objects::OUTPUT_PDO, objects::INPUT_PDO]);
    macro_rules! numbers {
        ($($name:ident)*) => {
            $(assert_eq!(there(number::$name), objects::number::$name, stringify!($name));)*
        };
    }
    numbers! {
        ERROR_REGISTER MANUFACTURER_STATUS ERROR_COUNT LAST_ERROR DEVICE_NAME OUTPUT_CYCLE INPUT_CYCLE
        POSITION_2 INCREMENTAL_SPEED CYCLE_TIME ERROR_CODE CONTROL_WORD STATUS_WORD MODE MODE_DISPLAY
        INCREMENTS POSITION FOLLOWING_WINDOW VELOCITY_SETPOINT VELOCITY TARGET_TORQUE MAXIMUM_TORQUE
        CURRENT_SETPOINT TORQUE TARGET_POSITION HOME_OFFSET MAXIMUM_VELOCITY MAXIMUM_SPEED PROFILE_VELOCITY
        ACCELERATION DECELERATION FEED FEED_TURNS FACTOR DIVISOR HOMING_METHOD HOMING_SPEED
        HOMING_ACCELERATION INTERPOLATION CYCLE_UNITS CYCLE_POWER POSITIVE_TORQUE NEGATIVE_TORQUE
        FOLLOWING_ERROR TARGET_VELOCITY
    }
    macro_rules! modes {
        ($($name:ident)*) => {
            $(assert_eq!(Mode::$name.0, objects::mode::$name, stringify!($name));)*
        };
    }
    modes! {
        PROFILE_POSITION PROFILE_VELOCITY TORQUE HOMING INTERPOLATED CYCLIC_POSITION DIGITAL_VELOCITY
        DIGITAL_CURRENT TRAJECTORY
    }
    for mode in i8::MIN..=i8::MAX {
        assert_eq!(objects::has_mode(Family::S700, mode), Mode(mode).is_of_s700(), "{mode}");
        assert_eq!(objects::has_mode(Family::Akd, mode), Mode(mode).is_of_akd(), "{mode}");
    }
}

#[test]
fn faults_have_the_same_codes_registers_and_categories() {
    use objects::{category, error_register, fault};
    assert_eq!(
        [Fault::SYNCHRONISATION.code, Fault::FOLLOWING.code],
        [fault::SYNCHRONISATION, fault::FOLLOWING]
    );
    for fault in Fault::ALL {
        let Fault { code, register, clearing, .. } = fault;
        assert_eq!((register, clearing as u8), (error_register(code), category(code)), "{}", fault.name);
        let message = own::mailbox::emergency(code, register, [category(code), 0, 0, 0, 0]);
        assert_eq!(mailbox::parse(&message), Some(Message::Emergency(fault.emergency())));
    }
}

/// The type of an object as the slave has it.
fn kind(own: objects::Type) -> Type {
    match own {
        objects::Type::I8 => Type::I8,
        objects::Type::U8 => Type::U8,
        objects::Type::I16 => Type::I16,
        objects::Type::U16 => Type::U16,
        objects::Type::I32 => Type::I32,
        objects::Type::U32 => Type::U32,
        objects::Type::Text => Type::Text,
    }
}

/// The range of a number: a text has none.
fn range(kind: Type, range: (i64, i64)) -> (i64, i64) {
    if kind.is_string() { (0, 0) } else { range }
}

#[test]
fn drives_have_the_objects_that_the_master_knows() {
    for (family, drives) in [(Family::S700, Drives::S700), (Family::Akd, Drives::Akd)] {
        let slave: Vec<_> = objects::dictionary(family)
            .into_iter()
            .map(|(object, own, access, range)| {
                let access = match access {
                    objects::Access::Read => Access::ReadOnly,
                    objects::Access::PreOp => Access::PreOp,
                    objects::Access::Write => Access::ReadWrite,
                };
                (at(object), kind(own), access, self::range(kind(own), range))
            })
            .collect();
        let has = |known: &&catalogue::ObjectInfo| [Drives::All, drives].contains(&known.drives);
        let master = catalogue::all().filter(has);
        let master: Vec<_> = master
            .map(|known| (known.object, known.kind, known.access, range(known.kind, (known.min, known.max))))
            .collect();
        let differ: Vec<_> = slave.iter().filter(|row| !master.contains(row)).collect();
        let missing: Vec<_> = master.iter().filter(|row| !slave.contains(row)).collect();
        assert!(differ.is_empty() && missing.is_empty(), "{family:?}\n{differ:#?}\n{missing:#?}");
    }
}

#[test]
fn drives_have_the_pdos_that_the_master_knows() {
    for family in FAMILIES {
        let slave = objects::fixed_pdos(family);
        let master = pdo::fixed(family);
        assert_eq!(slave.len(), master.len());
        for layout in master {
            let own = slave.iter().find(|pdo| pdo.index == layout.pdo).expect("it has this PDO");
            assert_eq!((own.size(), own.is_output()), (layout.size(), layout.is_output()));
            let places: Vec<_> = own.places().map(|(object, place)| (at(object), place)).collect();
            let expected = layout.places().map(|(at, entry)| (entry.object, at..at + entry.kind.bytes()));
            assert_eq!(places, expected.collect::<Vec<_>>(), "{:#06x}", layout.pdo);
        }
    }
}

const STATES: [State; 8] = [
    State::NotReadyToSwitchOn,
    State::SwitchOnDisabled,
    State::ReadyToSwitchOn,
    State::SwitchedOn,
    State::OperationEnabled,
    State::QuickStopActive,
    State::FaultReactionActive,
    State::Fault,
];

#[test]
fn control_words_and_status_words_mean_the_same() {
    use core402::{ControlWord, StatusWord, Transition};
    for state in STATES {
        assert_eq!(StatusWord(cia402::status_of(state)).state(), state);
        for (before, word) in (0..0x100).flat_map(|before| (0..0x200).map(move |word| (before, word))) {
            let caused = Transition::caused(state, ControlWord(word), ControlWord(before));
            let next = caused.map(|transition| transition.to);
            assert_eq!(cia402::next(state, before, word), next, "{state:?} {before:#x} {word:#x}");
        }
    }
    assert_eq!(cia402::ENABLE_OPERATION, core402::ControlCommand::EnableOperation.word().0);
    use cia402::{control, status};
    let master = [ControlWord::START, ControlWord::RELATIVE, ControlWord::FAULT_RESET, ControlWord::HALT];
    assert_eq!(master, [control::START, control::RELATIVE, control::FAULT_RESET, control::HALT]);
    use StatusWord as S;
    let master = [S::VOLTAGE, S::WARNING, S::REMOTE, S::TARGET_REACHED, S::MODE_12, S::MODE_13];
    let slave = [status::VOLTAGE, status::WARNING, status::REMOTE, status::TARGET_REACHED];
    assert_eq!(master[..4], slave);
    assert_eq!(master[4..], [status::MODE_12, status::MODE_13]);
}

/// The ranges of the datagrams in a frame as the master finds them, up to a broken one.
fn places(frame: &[u8]) -> Option<Vec<std::ops::Range<usize>>> {
    let all = datagrams(frame).ok()?.map_while(Result::ok);
    Some(all.map(|datagram| datagram.place.at..datagram.place.end()).collect())
}

fn object() -> impl Strategy<Value = Object> {
    (any::<u16>(), any::<u8>()).prop_map(|(index, sub)| Object::new(index, sub))
}

/// A request as the slave has read it: object, complete access, content.
type Taken = (objects::Object, bool, Vec<u8>, String);

/// What the slave finds in a request.
fn taken(message: &[u8], long: bool) -> Result<Taken, u16> {
    let own::mailbox::Request { object, complete, kind } = own::mailbox::request(message, long)?;
    let (data, kind) = match kind {
        Kind::Upload => (Vec::new(), "upload".into()),
        Kind::Download(data) => (data.to_vec(), "download".into()),
        Kind::Begin(size, data) => (data.to_vec(), format!("begin {size}")),
        Kind::Segment { toggle, last, data } => (data.to_vec(), format!("segment {toggle} {last}")),
        Kind::Next(toggle) => (Vec::new(), format!("next {toggle}")),
        Kind::Abort => (Vec::new(), "abort".into()),
        Kind::Unknown => (Vec::new(), "unknown".into()),
        Kind::Information => (Vec::new(), "information".into()),
    };
    Ok((object, complete, data, kind))
}

/// The answer that the master reads in a message of the slave.
fn answer(message: &[u8]) -> (u8, Response<'_>) {
    match mailbox::parse(message) {
        Some(Message::Sdo { counter, response }) => (counter, response),
        other => panic!("{other:?}"),
    }
}

proptest! {
    #[test]
    fn frames_of_the_master_are_walked_by_the_slave(
        all in vec((0..15_u8, any::<u32>(), any::<u8>(), vec(any::<u8>(), 0..40)), 1..15),
    ) {
        let mut frame = [0; FRAME_MAX];
        let mut builder = Builder::new(&mut frame, BROADCAST, [0x10; 6]).unwrap();
        for (number, address, index, data) in &all {
            builder.push_with(Command::new(*number, *address).unwrap(), *index, data).unwrap();
        }
        let length = builder.finish();
        let frame = &frame[..length];
        let walked: Vec<_> = frame::datagrams(frame).unwrap().collect();
        prop_assert_eq!(&walked, &places(frame).unwrap());
        for (place, (number, address, _, data)) in walked.iter().zip(&all) {
            let datagram = &frame[place.clone()];
            let command = Command::new(*number, *address).unwrap();
            prop_assert_eq!(frame::Command::of(datagram[0]).unwrap() as u8, command.number());
            prop_assert_eq!(&datagram[2..6], &command.address().to_le_bytes());
            prop_assert_eq!(&datagram[frame::HEADER..datagram.len() - frame::COUNTER], &data[..]);
        }
    }

    /// The slave refuses a frame whose reserved bit is set, which the master ignores.
    #[test]
    fn any_bytes_are_the_same_frame_to_both(
        length in 0..60_u16,
        kind in prop_oneof![Just(1_u16), 0..16_u16],
        rest in vec(prop_oneof![Just(0_u8), Just(0x80), 0..12_u8, any::<u8>()], 0..60),
    ) {
        let head = (length | kind << 12).to_le_bytes();
        let frame = [&[0xFF; 6][..], &[0x10; 6], &[0x88, 0xA4], &head, &rest].concat();
        let walked: Option<Vec<_>> = frame::datagrams(&frame).map(Iterator::collect);
        prop_assert_eq!(walked, places(&frame).map(|all| all.into_iter().take(15).collect()));
    }

    #[test]
    fn registers_are_read_and_written_alike(bytes in any::<[u8; 16]>(), word in any::<u16>()) {
        let (master, slave) = (Fmmu::new(bytes), registers::Fmmu::new(bytes));
        prop_assert_eq!(
            (master.logical, master.length, master.bits, master.physical, master.active),
            (slave.logical, slave.length, slave.bits, slave.physical, slave.active)
        );
        for (output, kind) in [(true, registers::Fmmu::WRITE), (false, registers::Fmmu::READ)] {
            let written = Fmmu { output, ..master }.to_bytes();
            prop_assert_eq!(written, registers::Fmmu { kind, ..slave }.to_bytes());
            prop_assert_eq!(registers::Fmmu::new(written), registers::Fmmu { kind, ..slave });
            let (logical, length, (physical, _)) = (slave.logical, slave.length, slave.physical);
            prop_assert_eq!(
                Fmmu::bytes(logical, length, physical, output).to_bytes(),
                registers::Fmmu::bytes(logical, length, physical, kind).to_bytes()
            );
        }

        let bytes = *bytes.first_chunk().unwrap();
        let (master, slave) = (SyncManager::new(bytes), registers::SyncManager::new(bytes));
        prop_assert_eq!(master.to_bytes(), slave.to_bytes());
        prop_assert_eq!(
            (master.start, master.length, master.control, master.activate),
            (slave.start, slave.length, slave.control, slave.activate)
        );
        prop_assert_eq!(
            (master.is_output(), master.is_mailbox()),
            (slave.is_output(), slave.is_mailbox())
        );

        let number = |state: Option<registers::AlState>| state.map(|state| state as u8);
        prop_assert_eq!(AlStatus(word).state().map(AlState::number), number(registers::AlState::of(word)));
        prop_assert_eq!(AlStatus(word).error(), word & registers::al::ERROR != 0);
        use registers::feature;
        let features = Features(word);
        prop_assert_eq!(
            [features.has_clock(), features.has_long_clock(), features.lacks_lrw()],
            [feature::CLOCK, feature::LONG_CLOCK, feature::NO_LRW].map(|bit| word & bit != 0)
        );
        let ns = i32::from(word.cast_signed());
        prop_assert_eq!(Difference(registers::difference(ns.into())).ns(), i64::from(ns));
    }

    #[test]
    fn links_of_the_slave_are_those_that_the_master_sees(up in any::<[bool; 4]>()) {
        let links = Links(registers::links(up));
        prop_assert_eq!([0, 1, 2, 3].map(|port| (links.link(port), links.open(port))), up.map(|up| (up, up)));
    }

    #[test]
    fn requests_of_the_master_are_read_by_the_slave(
        object in object(),
        complete in any::<bool>(),
        toggle in any::<bool>(),
        last in any::<bool>(),
        size in any::<u32>(),
        value in any::<[u8; 4]>(),
        length in 1..=4_usize,
        counted in 0..8_u8,
        data in vec(any::<u8>(), 0..30),
    ) {
        let counter = (0..counted).fold(Counter::default(), |counter, _| counter.next());
        let own = there(object);
        // A segment of the standard has data.
        let segment = if data.is_empty() { &value[..] } else { &data };
        for (request, expected) in [
            (Request::Upload { object, complete }, (own, complete, Vec::new(), "upload".to_owned())),
            (
                Request::Download { object, value, length: length as u8 },
                (own, false, value[..length].to_vec(), "download".to_owned()),
            ),
            (
                Request::DownloadBegin { object, complete, size, data: &data },
                (own, complete, data.clone(), format!("begin {size}")),
            ),
            (
                Request::Abort { object, code: AbortCode(size) },
                (own, false, Vec::new(), "abort".to_owned()),
            ),
        ] {
            let mut message = [0xEE; 64];
            mailbox::emit(&request, counter, &mut message);
            prop_assert_eq!(taken(&message, true), Ok(expected));
            prop_assert_eq!(own::mailbox::counter(&message), counter.number());
        }
        for (request, data, expected) in [
            (Request::UploadSegment { toggle }, &[][..], format!("next {toggle}")),
            (
                Request::DownloadSegment { toggle, last, data: segment },
                segment,
                format!("segment {toggle} {last}"),
            ),
        ] {
            let mut message = [0xEE; 64];
            mailbox::emit(&request, counter, &mut message);
            let (_, complete, found, kind) = taken(&message, true).unwrap();
            prop_assert_eq!((complete, &found[..], kind), (false, data, expected));
        }
    }

    #[test]
    fn answers_of_the_slave_are_read_by_the_master(
        object in object(),
        complete in any::<bool>(),
        toggle in any::<bool>(),
        last in any::<bool>(),
        code in any::<u32>(),
        value in any::<[u8; 4]>(),
        length in 1..=4_usize,
        counter in 0..8_u8,
        data in vec(any::<u8>(), 1..30),
    ) {
        use own::mailbox as m;
        let own = there(object);
        let size = Some(code);
        for (body, expected) in [
            (m::written(own), Response::Downloaded { object }),
            (m::value(own, complete, length, value), Response::Value { object, data: &value[..length] }),
            (
                m::long_value(own, complete, code, &data),
                Response::Begun { object, size, data: &data },
            ),
            (m::segment(toggle, last, &data), Response::Segment { toggle, last, data: &data }),
            (m::segment_taken(toggle), Response::SegmentTaken { toggle }),
            (m::aborted(own, code), Response::Abort { object, code: AbortCode(code) }),
        ] {
            let message = m::response(counter, &body);
            prop_assert_eq!(answer(&message), (counter, expected));
        }
        for body in [m::written(own), m::aborted(own, code)] {
            let (counted, printed) = (m::response(0, &body), m::response_of_manual(&body));
            prop_assert_eq!(answer(&printed), answer(&counted));
        }
        let (register, [a, b, c, d]) = (length as u8, value);
        let vendor = [a, b, c, d, counter];
        let code = code as u16;
        let emergency = m::emergency(code, register, vendor);
        let expected = Message::Emergency(Emergency { code, register, vendor });
        prop_assert_eq!(mailbox::parse(&emergency), Some(expected));
        let refused = m::refused(counter, code);
        prop_assert_eq!(mailbox::parse(&refused[..10]), Some(Message::Refused(MailboxError(code))));
        let information = m::no_information(counter);
        prop_assert_eq!(mailbox::parse(&information), Some(Message::Other));
    }

    #[test]
    fn values_of_all_types_are_the_same_numbers(raw in any::<u64>()) {
        use objects::Type::{I8, I16, I32, U8, U16, U32};
        for own in [I8, I16, I32, U8, U16, U32] {
            let master = kind(own);
            prop_assert_eq!(own.bytes(), master.bytes());
            prop_assert_eq!(own.read(&raw.to_le_bytes()[..own.bytes()]), master.number(raw));
        }
    }

    #[test]
    fn an_sii_of_the_slave_is_read_by_the_master(
        identity in any::<[u32; 4]>(),
        alias in any::<u16>(),
        areas in any::<[u16; 4]>(),
        protocols in any::<u16>(),
        managers in vec((any::<u16>(), any::<u16>(), any::<u8>()), 0..6),
        entries in vec((any::<u16>(), any::<u8>(), any::<u8>()), 0..6),
    ) {
        use wire::sii::word;
        let [vendor, product, revision, serial] = identity;
        let pdo = objects::Pdo {
            index: alias,
            entries: entries.iter().map(|(index, sub, bits)| (objects::Object::new(*index, *sub), *bits)).collect(),
        };
        let contents = Contents {
            name: "drive",
            identity: own::sii::Identity { vendor, product, revision },
            serial,
            alias,
            mailboxes: Some(Mailboxes { out: (areas[0], areas[1]), input: (areas[2], areas[3]), protocols }),
            managers: managers.iter().map(|(a, b, c)| registers::SyncManager::on(*a, *b, *c)).collect(),
            inputs: vec![(pdo, 3)],
            ..Contents::default()
        };
        let image = contents.image();
        let long = |at: u16| u32::from(image[usize::from(at)]) | u32::from(image[usize::from(at) + 1]) << 16;
        let found = Identity {
            vendor: long(word::VENDOR),
            product: long(word::PRODUCT),
            revision: long(word::REVISION),
        };
        prop_assert_eq!(found, Identity { vendor, product, revision });
        prop_assert_eq!(long(word::SERIAL), serial);
        let [out, input] = [word::MAILBOX_OUT, word::MAILBOX_IN].map(usize::from);
        prop_assert_eq!([image[out], image[out + 1], image[input], image[input + 1]], areas);
        let coe = Protocols(image[usize::from(word::PROTOCOLS)]).coe();
        prop_assert_eq!(coe, protocols & own::sii::COE != 0);
        let bytes: Vec<u8> = image.iter().flat_map(|word| word.to_le_bytes()).collect();
        prop_assert_eq!(u16::from(sii::crc(bytes.first_chunk().unwrap())), image[7]);

        let mut next = 2 * usize::from(word::CATEGORIES);
        let mut found = Vec::new();
        while let Some(category) = Category::new(*bytes[next..].first_chunk().unwrap_or(&[0xFF; 4])) {
            let end = next + 4 + 2 * usize::from(category.words);
            match category.kind {
                Category::SYNC_MANAGERS => {
                    found.extend(bytes[next + 4..end].chunks(8).map(|entry| {
                        let (manager, usage) = sii::sync_manager(entry.try_into().unwrap());
                        prop_assert_eq!(usage, match (manager.is_mailbox(), manager.is_output()) {
                            (true, true) => Use::MailboxOut,
                            (true, false) => Use::MailboxIn,
                            (false, true) => Use::Outputs,
                            (false, false) => Use::Inputs,
                        });
                        Ok((manager.start, manager.length, manager.control))
                    }).collect::<Result<Vec<_>, _>>()?);
                }
                Category::TX_PDO => {
                    prop_assert_eq!(usize::from(bytes[next + 6]), entries.len());
                    let bits = bytes[next + 12..end].chunks(8).map(|entry| entry[5]);
                    prop_assert!(bits.eq(entries.iter().map(|(_, _, bits)| *bits)));
                }
                kind => prop_assert!([Category::STRINGS, Category::GENERAL].contains(&kind)),
            }
            next = end;
        }
        prop_assert_eq!(found, managers);
        prop_assert_eq!(next, bytes.len() - 2, "the end is the last word");
    }
}

#[test]
fn the_status_of_an_sii_has_the_same_bits() {
    use own::sii::bit;
    for status in (0..16).map(|bit| 1 << bit) {
        let master = Status(status);
        assert_eq!(master.busy(), status & bit::BUSY != 0);
        assert_eq!(master.reads_eight(), status & bit::EIGHT != 0);
        assert_eq!(master.failed(), status & (bit::REFUSED | bit::PROTECTED) != 0);
        assert_eq!(master.unsound(), status & (bit::CHECKSUM | bit::UNLOADED) != 0);
    }
    assert_eq!(Status::READ, bit::READ);
    assert_eq!([sii::FORCE, sii::PROCESSOR], [own::sii::FORCED, own::sii::SLAVE_OWNS]);
}
