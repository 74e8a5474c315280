//! What Wireshark's dissector of Modbus TCP makes of the frames between our master and our simulated drive.

use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat::axis::{Command, Jog};
use fieldbeat::bus::modbus::{ModbusPlan, Via};
use fieldbeat::{Master, Plan};
use fieldbeat_sim::modbus::{ReadWrite, UnidriveSettings};

use super::{PORT, drive, plan, serve};
use crate::capture::{dissect, on_loopback};
use crate::support::{LONG, Machine, until};

/// One message, as the dissector has it.
#[derive(Clone, Debug, PartialEq)]
struct Message {
    frame: u64,
    drive: Ipv4Addr,
    transaction: u64,
    unit: u64,
    function: u64,
    /// Else it is a reply.
    is_request: bool,
    exception: Option<u64>,
    /// Address and registers that are read or written, or that were written.
    block: Option<(u64, u64)>,
    /// The same of function 23, which does both.
    read: Option<(u64, u64)>,
    write: Option<(u64, u64)>,
    /// Of a reply: the frame of its request.
    request: Option<u64>,
    /// Registers: of function 23 as one string.
    values: Vec<u64>,
    data: String,
}

const FIELDS: [&str; 19] = [
    "frame.number",
    "ip.src",
    "ip.dst",
    "tcp.dstport",
    "mbtcp.trans_id",
    "mbtcp.prot_id",
    "mbtcp.unit_id",
    "modbus.func_code",
    "modbus.exception_code",
    "modbus.reference_num",
    "modbus.word_cnt",
    "modbus.read_reference_num",
    "modbus.read_word_cnt",
    "modbus.write_reference_num",
    "modbus.write_word_cnt",
    "modbus.request_frame",
    "modbus.regval_uint16",
    "modbus.data",
    "_ws.expert.message",
];

fn message(line: &str) -> Message {
    let fields: Vec<&str> = line.split('|').collect();
    let number = |at: usize| fields[at].parse::<u64>().ok();
    let is_request = number(3) == Some(PORT.into());
    assert_eq!((number(5), fields[18]), (Some(0), ""), "{line}");
    let message = Message {
        frame: number(0).unwrap(),
        drive: fields[if is_request { 2 } else { 1 }].parse().unwrap(),
        transaction: number(4).unwrap(),
        unit: number(6).unwrap(),
        function: number(7).unwrap(),
        is_request,
        exception: number(8),
        block: number(9).zip(number(10)),
        read: number(11).zip(number(12)),
        write: number(13).zip(number(14)),
        request: number(15),
        values: fields[16].split(',').filter_map(|value| value.parse().ok()).collect(),
        data: fields[17].replace(':', ""),
    };
    // tshark pairs all but exceptions.
    let is_paired = !is_request && message.exception.is_none();
    assert_eq!(message.request.is_some(), is_paired, "{line}");
    message
}

/// The exchanges with one drive, in order. One request at a time; the last one may have no reply any more.
fn exchanges(messages: &[Message], drive: Ipv4Addr) -> Vec<(Message, Option<Message>)> {
    let mut exchanges: Vec<(Message, Option<Message>)> = Vec::new();
    for message in messages.iter().filter(|message| message.drive == drive) {
        match (message.is_request, exchanges.last_mut()) {
            (true, before) => {
                assert!(before.is_none_or(|(_, reply)| reply.is_some()), "{message:?}");
                exchanges.push((message.clone(), None));
            }
            (false, Some((request, reply @ None))) => {
                let same = |of: &Message| (of.transaction, of.unit, of.function);
                assert_eq!(same(message), same(request));
                assert!(message.request.is_none_or(|frame| frame == request.frame), "{message:?}");
                *reply = Some(message.clone());
            }
            (false, _) => panic!("a second reply: {message:?}"),
        }
    }
    exchanges
}

/// What each function is answered with.
fn judge(request: &Message, reply: &Message) {
    let count = match (reply.exception, request.function) {
        (Some(_), _) => return,
        (None, 3) => request.block,
        (None, 23) => request.read,
        (None, 16) => {
            assert_eq!(reply.block, request.block, "{request:?} {reply:?}");
            return;
        }
        _ => panic!("{request:?}"),
    };
    // Four digits a register.
    let got = (reply.values.len() + reply.data.len() / 4) as u64;
    assert_eq!(count.map(|(_, registers)| registers), Some(got), "{request:?} {reply:?}");
}

#[test]
#[ignore = "needs root and tshark: captures on loopback"]
fn tshark_finds_nothing_wrong_with_modbus() {
    let machine = Machine::new(20);
    let mut drives: Vec<_> = (0..3_u8)
        .map(|index| {
            let mut drive = drive(SocketAddrV4::new(machine.ip(11 + index), PORT));
            drive.axis.name = format!("d{index}");
            drive
        })
        .collect();
    drives[1].via = Via::Menu0 { first: 11 };
    let simulated = drives.iter().enumerate().map(|(index, drive)| {
        let mut settings = UnidriveSettings::new(drive.address);
        if index == 2 {
            settings.interface.read_write = ReadWrite::Refused;
        }
        settings
    });
    let _server = serve(simulated);
    let capture = on_loopback(&machine);
    let plan = Plan { buses: vec![Box::new(ModbusPlan::new(drives.clone()))], ..plan(drives[0].clone()) };
    let master = Master::from_plan(plan).start().unwrap();
    master.wait_online(LONG).unwrap();
    let mut axes: Vec<_> = (0..3).map(|index| master.axis(&format!("d{index}")).unwrap()).collect();
    for axis in &mut axes {
        let parameter = axis.parameter();
        parameter.write("20.021", 12_345).unwrap();
        axis.enable().unwrap();
        axis.post(Command::Jog(Jog { velocity: -2.5, acceleration: 100.0 })).unwrap();
        assert!(until(LONG, || (axis.feedback().status.velocity + 2.5).abs() < 0.1), "{:?}", axis.feedback());
        assert_eq!(parameter.read::<i32>("20.021").unwrap(), 12_345);
        parameter.read::<i32>("17.099").unwrap_err();
        axis.stop().unwrap();
    }
    let end = master.finish().end;
    let file = capture.end();
    let port = format!("mbtcp.tcp.port:{PORT}");
    let others = dissect(
        &file,
        // What a busy host answers late is sent again.
        "tcp.len > 0 && !mbtcp && !tcp.analysis.retransmission || _ws.malformed",
        &["-o", &port],
        &["frame.number", "_ws.col.Protocol", "_ws.col.Info"],
    );
    assert!(others.is_empty(), "{others:?}");
    let lines = dissect(&file, "mbtcp", &["-o", &port], &FIELDS);
    let messages: Vec<Message> = lines.iter().map(|line| message(line)).collect();
    for (index, (drive, end)) in drives.iter().zip(&end.drives).enumerate() {
        let exchanges = exchanges(&messages, *drive.address.ip());
        for (request, reply) in &exchanges {
            reply.iter().for_each(|reply| judge(request, reply));
        }
        let refused = |(request, reply): &(Message, Option<Message>)| {
            reply.as_ref().and_then(|reply| reply.exception).map(|code| (request.function, code))
        };
        // Function 23, where it is not known; the parameter that nobody has.
        let unknown = if index == 2 { &[(23, 1), (3, 2)][..] } else { &[(3, 2)] };
        assert_eq!(exchanges.iter().filter_map(refused).collect::<Vec<_>>(), unknown);
        // The handshake counts its requests from 1 on, and so does the loop behind it.
        let begin = exchanges.iter().rposition(|(request, _)| request.transaction == 1).unwrap();
        let cyclic = &exchanges[begin..];
        assert_eq!(cyclic.len() as u64, end.counters.sent, "{:?}", end.counters);
        let replies = cyclic.iter().filter(|(_, reply)| reply.is_some()).count() as u64;
        assert!((end.counters.answered..=end.counters.sent).contains(&replies), "{:?}", end.counters);
        // The requested ones: 20.021, and "run in reverse" with the status, or all of menu 0.
        let has = |wanted: &dyn Fn(&Message) -> bool| cyclic.iter().any(|(request, _)| wanted(request));
        let parameter = (0x47E4, 2);
        let block =
            |request: &Message, function, block| (request.function, request.block) == (function, Some(block));
        assert!(has(&|request| block(request, 16, parameter) && request.values == [0, 12_345]));
        let reported = cyclic.iter().find(|(request, _)| block(request, 3, parameter)).unwrap();
        assert_eq!(reported.1.as_ref().unwrap().values, [0, 12_345]);
        let both = |request: &Message, read, write, data: &str| {
            (request.read, request.write) == (Some(read), Some(write)) && request.data.starts_with(data)
        };
        match index {
            0 => {
                assert!(has(&|request| both(request, (0x040F, 1), (0x0281, 1), "0189")));
                // Which block is read with which one that is written depends on how long it turned on this host.
                assert!(has(&|request| request.read == Some((0x412D, 2))));
                let turned = Some((0x4078, 2));
                assert!(has(&|request| request.write == turned && request.data.starts_with("000005dc")));
            }
            1 => assert!(has(&|request| both(request, (0x400A, 12), (0x400A, 4), "00000189000005dc"))),
            _ => {
                assert!(has(&|request| block(request, 16, (0x0281, 1)) && request.values == [0x0189]));
                assert!(has(&|request| block(request, 16, (0x4078, 2)) && request.values == [0, 1500]));
                let both = cyclic.iter().filter(|(request, _)| request.function == 23);
                assert_eq!(both.count(), 1, "the first one shows that it is not known");
            }
        }
    }
}
