//! Masters of others at our slaves.

use std::process::Command;

use fieldbeat::bus::profibus::ProfibusPlan;
use fieldbeat::time::MS;
use fieldbeat_sim::profibus::DpState;

use super::cable::{By, Cable};
use super::telegrams::{TOKEN, Telegram, as_sd2, global_control, low, searched, start_up, started};
use super::{DRIVECOM, HIGHEST, OWN, PKW, PLAIN, Slaves, WATCHDOG_NS, plan};
use crate::peer::{Peer, package};
use crate::support::{Machine, checkout};

/// Nothing takes so many exchanges.
const EXCHANGES: usize = 500;

/// Another master, with the settings of a plan.
struct Master(Peer);

impl Master {
    fn start(mut program: Command, plan: &ProfibusPlan, addresses: &[u8], machine: &Machine) -> Master {
        let hex = |bytes: &[u8]| -> String { bytes.iter().map(|byte| format!("{byte:02x}")).collect() };
        program.arg(&plan.device).arg(plan.address.to_string()).arg(plan.drives[0].ident.to_string());
        program.arg((WATCHDOG_NS / (10 * MS)).to_string());
        for drive in plan.drives.iter().filter(|drive| addresses.contains(&drive.address)) {
            let (outputs, inputs) = drive.lengths().unwrap();
            let [user, configuration] = [&drive.user_prm, &drive.configuration].map(|bytes| hex(bytes));
            program.arg(format!("{}:{user}:{configuration}:{outputs}:{inputs}", drive.address));
        }
        let mut master = Master(Peer::start(program, machine.path("master.err")));
        assert_eq!(master.0.ask("running"), "ok");
        master
    }

    /// Gives a slave these outputs until its inputs are as wanted.
    fn until(&mut self, address: u8, outputs: &[u8], wanted: impl Fn(&[u8]) -> bool) -> Vec<u8> {
        let digits: String = outputs.iter().map(|byte| format!("{byte:02x}")).collect();
        let mut inputs = Vec::new();
        for _ in 0..EXCHANGES {
            let answer = self.0.ask(&format!("exchange {address} {digits}"));
            let digits = answer.strip_prefix("ok ").unwrap_or_else(|| panic!("{answer}"));
            let pairs = digits.as_bytes().chunks(2).map(|pair| std::str::from_utf8(pair).unwrap());
            inputs = pairs.map(|pair| u8::from_str_radix(pair, 16).unwrap()).collect();
            if wanted(&inputs) {
                return inputs;
            }
        }
        panic!("{outputs:02X?} is not followed by what it should be, but by {inputs:02X?}");
    }

    /// A job in the parameter channel, behind which the drive stays off; the answer that is wanted.
    fn job(&mut self, address: u8, job: [u8; 8], wanted: impl Fn(&[u8]) -> bool) -> [u8; 8] {
        let outputs = [&job[..], &[0; 4]].concat();
        self.until(address, &outputs, wanted).first_chunk().copied().unwrap()
    }

    /// Jobs of DRIVECOM: each with its handshake bit, its index and subindex.
    fn by_drivecom(&mut self) {
        for (job, answer) in [
            // C0061, 43 °C.
            ([0x71, 0, 0x5F, 0xC2, 0, 0, 0, 0], [0x71, 0, 0x5F, 0xC2, 0, 0x06, 0x8F, 0xB0]),
            // C0039/2: 1.0, written and read.
            ([0x32, 2, 0x5F, 0xD8, 0, 0, 0x27, 0x10], [0x30, 2, 0x5F, 0xD8, 0, 0, 0x27, 0x10]),
            ([0x71, 2, 0x5F, 0xD8, 0, 0, 0, 0], [0x71, 2, 0x5F, 0xD8, 0, 0, 0x27, 0x10]),
            // There is no such object.
            ([0x31, 0, 0x00, 0x01, 0, 0, 0, 0], [0xB1, 0, 0x00, 0x01, 0x06, 0x07, 0, 0]),
        ] {
            let is_answer = |inputs: &[u8]| inputs[0] & 0x40 == job[0] & 0x40 && inputs[1..4] == job[1..4];
            assert_eq!(self.job(DRIVECOM, job, is_answer), answer, "{job:02X?}");
        }
    }

    /// Jobs of PKW: each behind none.
    fn by_pkw(&mut self) {
        for (job, answer) in [
            ([0x10, 0x3D, 0, 0, 0, 0, 0, 0], [0x20, 0x3D, 0, 0, 0, 0x06, 0x8F, 0xB0]),
            ([0x80, 0x27, 2, 0, 0, 0, 0x27, 0x10], [0x50, 0x27, 2, 0, 0, 0, 0x27, 0x10]),
            ([0x60, 0x27, 2, 0, 0, 0, 0, 0], [0x50, 0x27, 2, 0, 0, 0, 0x27, 0x10]),
            ([0x17, 0xCF, 0, 0, 0, 0, 0, 0], [0x77, 0xCF, 0, 0, 0, 0, 0, 0]),
        ] {
            self.job(PKW, [0; 8], |inputs| inputs[..8] == [0; 8]);
            assert_eq!(self.job(PKW, job, |inputs| inputs[0] >> 4 != 0), answer, "{job:02X?}");
        }
    }

    /// The motor of a drive without a channel: on, a quarter of its full speed, at rest, off.
    fn turn(&mut self) {
        let word =
            |inputs: &[u8], place: usize| i16::from_be_bytes([inputs[2 * place], inputs[2 * place + 1]]);
        for (control, speed, state) in [
            (0x06_u16, 0_i16, 0x21),
            (0x07, 0, 0x23),
            (0x7F, 0, 0x27),
            (0x7F, 0x1000, 0x27),
            (0x7F, 0, 0x27),
            (0x06, 0, 0x21),
        ] {
            let outputs = [control.to_be_bytes(), speed.to_be_bytes(), [0; 2], [0; 2]].concat();
            self.until(PLAIN, &outputs, |inputs| {
                word(inputs, 0) & 0x6F == state && (word(inputs, 1) - speed).abs() <= 1
            });
        }
    }

    fn use_slave(&mut self, address: u8) {
        match address {
            DRIVECOM => self.by_drivecom(),
            PKW => self.by_pkw(),
            _ => self.turn(),
        }
    }
}

/// What has passed the cable: each exchange was answered by its slave, in the form that this has.
fn judge_exchanges(cable: &Cable, address: u8) {
    let telegrams = cable.telegrams();
    let mut count = 0;
    for pair in telegrams.windows(2) {
        let [(By::Master, request), (By::Drive, answer)] = pair else { continue };
        let Some(request) = Telegram::of(request).filter(|of| of.is_data_exchange() && of.to == address)
        else {
            continue;
        };
        assert_eq!(answer[0], if address == PLAIN { 0xA2 } else { 0x68 }, "{answer:02X?}");
        let answer = Telegram::of(answer).unwrap();
        assert_eq!((answer.to, answer.from, answer.has_saps), (OWN, address, false));
        assert_eq!((answer.function, answer.data.len()), (0x08, request.data.len()));
        count += 1;
    }
    assert!(count > 12, "{count}");
}

fn profirust() -> Command {
    let mut program = Command::new(package("profirust"));
    program.arg("master");
    program
}

#[test]
#[ignore = "needs root and a package registry: builds the crate profirust"]
fn profirust_brings_our_slaves_to_data_exchange_and_reads_their_parameters() {
    let (machine, cable) = (Machine::new(81), Cable::new());
    let (plan, addresses) = (plan(&cable.master), [DRIVECOM, PKW, PLAIN]);
    let slaves = Slaves::new(&plan, &cable);
    let mut master = Master::start(profirust(), &plan, &addresses, &machine);
    for address in addresses {
        master.use_slave(address);
    }
    slaves.have_no_complaint(&cable);
    for seen in slaves.seen() {
        assert_eq!(seen.state, Some((DpState::DataExchange, Some(OWN))));
        assert_eq!((seen.events.refused, seen.events.watchdogs), (0, 0));
        assert!(seen.events.parametrised == 1 || !cable.is_in_turns(&addresses), "{seen:?}");
    }
    drop(master);
    let requests = cable.requests();
    // It claims the token, and passes it to itself.
    assert_eq!(requests[..2], [TOKEN; 2]);
    assert!(requests[2..].contains(&TOKEN.to_vec()));
    // It looks for other masters up to the highest address, and at its own one, too.
    let mut searched = searched(&requests);
    searched.sort_unstable();
    searched.dedup();
    assert!(searched.iter().all(|station| *station < HIGHEST), "{searched:?}");
    assert!(searched.len() > 2, "{searched:?}");
    // All but Data_Exchange have low priority.
    assert!(requests.contains(&low(global_control(0))));
    for address in addresses {
        let theirs = started(&requests, address);
        assert_eq!(theirs.last().unwrap()[0], if address == PLAIN { 0xA2 } else { 0x68 });
        let theirs: Vec<_> = theirs.iter().map(|telegram| as_sd2(telegram)).collect();
        assert_eq!(theirs, start_up(address).into_iter().map(low).collect::<Vec<_>>(), "{address}");
        judge_exchanges(&cable, address);
    }
}

/// One slave a master: it takes the bare acknowledgement of one for that of all.
#[test]
#[ignore = "needs root, pyprofibus and pyserial (a package registry)"]
fn pyprofibus_brings_our_slaves_to_data_exchange_and_reads_their_parameters() {
    let (machine, cable) = (Machine::new(82), Cable::new());
    let (plan, addresses) = (plan(&cable.master), [DRIVECOM, PKW, PLAIN]);
    let slaves = Slaves::new(&plan, &cable);
    for (place, address) in addresses.into_iter().enumerate() {
        let mut program = Command::new(checkout("target/peers/python/bin/python"));
        program.arg(checkout("tests/peers/profibus/programs/master.py"));
        let mut master = Master::start(program, &plan, &[address], &machine);
        master.use_slave(address);
        assert_eq!(slaves.seen()[place].state, Some((DpState::DataExchange, Some(OWN))));
    }
    slaves.have_no_complaint(&cable);
    let requests = cable.requests();
    // It asks nobody but its slave for its status, and has no token.
    let mut searched = searched(&requests);
    searched.dedup();
    assert_eq!(searched, addresses);
    assert!(!requests.contains(&TOKEN.to_vec()));
    assert!(requests.contains(&global_control(0)));
    for address in addresses {
        let theirs = started(&requests, address);
        assert_eq!(theirs.last().unwrap()[0], if address == PLAIN { 0xA2 } else { 0x68 });
        let theirs: Vec<_> = theirs.iter().map(|telegram| as_sd2(telegram)).collect();
        assert_eq!(theirs, start_up(address), "{address}");
        judge_exchanges(&cable, address);
    }
}
