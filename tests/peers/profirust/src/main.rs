//! The crate profirust as a master and as a decoder of telegrams; commanded by lines.
//!
//! | call | what |
//! |---|---|
//! | `profirust-peer master PORT OWN IDENT WATCHDOG-10-MS SLAVE...` | a master at address OWN |
//! | its line `running` | answered when all slaves exchange data |
//! | its line `exchange ADDRESS OUTPUTS` | a slave's outputs from now on; answered with its inputs behind them |
//! | `profirust-peer decode` | each line is bytes, answered with the telegrams that they are |
//!
//! Each SLAVE is `ADDRESS:USER_PRM:CONFIGURATION:OUTPUTS:INPUTS`, bytes as hexadecimal digits, lengths in bytes.
//! Each answer begins with `ok`. A mistake ends the program.

use std::error::Error as StdError;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write, stdin};
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::time::Duration;

use profirust::Baudrate;
use profirust::dp::{DpMaster, Peripheral, PeripheralEvent, PeripheralHandle, PeripheralOptions};
use profirust::fdl::{FdlActiveStation, FunctionCode, ParametersBuilder, Telegram};
use profirust::phy::ProfibusPhy;
use profirust::time::Instant;

type Done<T> = Result<T, Box<dyn StdError>>;

/// Slow, and a slot time of 213 ms: whoever runs this may have a busy computer.
const RATE: Baudrate = Baudrate::B187500;
const SLOT_BITS: u16 = 40_000;
/// It looks for other masters below this address, and then not for so many rounds: each of them costs a slot time.
const HIGHEST: u8 = 8;
const ROUNDS: u8 = 100;
/// Far more than a round takes: where one takes longer, Global_Control is never sent, but Data_Exchange is.
const ROUND_BITS: u32 = 16_000_000;
/// As a master has it.
const PRIORITY: i32 = 60;
/// The outputs of a slave are new in the first answer behind them, or in the second one if they came while one was
/// under way.
const ANSWERS: u64 = 3;

fn main() -> Done<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match arguments[..] {
        ["master", port, own, ident, watchdog, ref slaves @ ..] => {
            Master::new(port, own.parse()?, ident.parse()?, watchdog.parse()?, slaves)?.run()
        }
        ["decode"] => decode(),
        _ => Err("master or decode?".into()),
    }
}

fn say(line: &str) -> Done<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}")?;
    Ok(out.flush()?)
}

fn bytes(digits: &str) -> Done<Vec<u8>> {
    let digits: Vec<u32> =
        digits.chars().map(|digit| digit.to_digit(16).ok_or("a digit?")).collect::<Result<_, _>>()?;
    Ok(digits.chunks(2).map(|pair| pair.iter().fold(0, |byte, digit| byte << 4 | *digit as u8)).collect())
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A port. The crate's own one insists on a parity bit, which pseudo-terminals do not have.
struct Port {
    port: File,
    unsent: Vec<u8>,
    received: Vec<u8>,
}

impl Port {
    fn open(path: &str) -> Done<Port> {
        let flags = libc::O_NOCTTY | libc::O_NONBLOCK;
        let port = OpenOptions::new().read(true).write(true).custom_flags(flags).open(path)?;
        // SAFETY: all bytes zero are valid settings; both calls take a live value and a descriptor that is open.
        let set = unsafe {
            let mut settings = std::mem::zeroed();
            libc::tcgetattr(port.as_raw_fd(), &raw mut settings);
            libc::cfmakeraw(&raw mut settings);
            libc::tcsetattr(port.as_raw_fd(), libc::TCSANOW, &raw const settings)
        };
        if set != 0 {
            return Err(std::io::Error::last_os_error().into());
        }
        Ok(Port { port, unsent: Vec::new(), received: Vec::new() })
    }

    fn flush(&mut self) {
        match self.port.write(&self.unsent) {
            Ok(count) => drop(self.unsent.drain(..count)),
            Err(error) => assert_eq!(error.kind(), ErrorKind::WouldBlock, "{error}"),
        }
    }
}

impl ProfibusPhy for Port {
    fn poll_transmission(&mut self, _now: Instant) -> bool {
        if !self.unsent.is_empty() {
            self.flush();
        }
        !self.unsent.is_empty()
    }

    fn transmit_data<F, R>(&mut self, _now: Instant, f: F) -> R
    where
        F: FnOnce(&mut [u8]) -> (usize, R),
    {
        let mut room = [0; 256];
        let (count, result) = f(&mut room);
        self.unsent.extend(&room[..count]);
        if count > 0 {
            self.flush();
        }
        result
    }

    fn receive_data<F, R>(&mut self, _now: Instant, f: F) -> R
    where
        F: FnOnce(&[u8]) -> (usize, R),
    {
        let mut room = [0; 256];
        match self.port.read(&mut room) {
            Ok(count) => self.received.extend(&room[..count]),
            Err(error) => assert_eq!(error.kind(), ErrorKind::WouldBlock, "{error}"),
        }
        let (count, result) = f(&self.received);
        self.received.drain(..count);
        result
    }
}

struct Slave {
    handle: PeripheralHandle,
    address: u8,
    answers: u64,
}

struct Master {
    dp: DpMaster<'static>,
    fdl: FdlActiveStation,
    port: Port,
    slaves: Vec<Slave>,
    lines: Receiver<String>,
}

impl Master {
    fn new(port: &str, own: u8, ident: u16, watchdog: u64, slaves: &[&str]) -> Done<Master> {
        let mut dp = DpMaster::new(Vec::new());
        let mut handles = Vec::new();
        for slave in slaves {
            let [address, user, configuration, outputs, inputs] = slave.split(':').collect::<Vec<_>>()[..]
            else {
                return Err(format!("{slave}?").into());
            };
            let address = address.parse()?;
            let options = PeripheralOptions {
                ident_number: ident,
                user_parameters: Some(bytes(user)?.leak()),
                config: Some(bytes(configuration)?.leak()),
                ..PeripheralOptions::default()
            };
            let [outputs, inputs] = [outputs.parse()?, inputs.parse()?].map(|length| vec![0; length]);
            let handle =
                dp.add(Peripheral::new(address, options, inputs, outputs).with_diag_buffer(vec![0; 64]));
            handles.push(Slave { handle, address, answers: 0 });
        }
        let parameters = ParametersBuilder::new(own, RATE)
            .slot_bits(SLOT_BITS)
            .highest_station_address(HIGHEST)
            .token_rotation_bits(ROUND_BITS)
            .gap_wait_rotations(ROUNDS)
            .watchdog_timeout(profirust::time::Duration::from_millis(10 * watchdog))
            .build_verified(&dp);
        let (tell, lines) = channel();
        std::thread::spawn(move || {
            stdin().lines().map_while(Result::ok).try_for_each(|line| tell.send(line))
        });
        Ok(Master {
            dp,
            fdl: FdlActiveStation::new(parameters),
            port: Port::open(port)?,
            slaves: handles,
            lines,
        })
    }

    fn run(mut self) -> Done<()> {
        let priority = libc::sched_param { sched_priority: PRIORITY };
        // SAFETY: the kernel reads a live value.
        if unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &raw const priority) } != 0 {
            return Err(std::io::Error::last_os_error().into());
        }
        self.fdl.set_online();
        self.dp.enter_operate();
        say("ready")?;
        loop {
            match self.lines.try_recv() {
                Ok(line) => self.obey(&line)?,
                Err(TryRecvError::Empty) => self.poll(),
                Err(TryRecvError::Disconnected) => return Ok(()),
            }
        }
    }

    fn poll(&mut self) {
        self.fdl.poll(Instant::now(), &mut self.port, &mut self.dp);
        if let Some((handle, PeripheralEvent::DataExchanged)) = self.dp.take_last_events().peripheral {
            self.slaves
                .iter_mut()
                .filter(|slave| slave.handle == handle)
                .for_each(|slave| slave.answers += 1);
        }
        std::thread::sleep(Duration::from_micros(100));
    }

    fn obey(&mut self, line: &str) -> Done<()> {
        match line.split(' ').collect::<Vec<_>>()[..] {
            ["running"] => {
                while !self.dp.iter().all(|(_, slave)| slave.is_running()) {
                    self.poll();
                }
                // Slaves take outputs only behind Global_Control, of which the first one came before they listened. By
                // itself the next one follows 50 slot times later.
                self.dp.enter_operate();
                say("ok")
            }
            ["exchange", address, outputs] => {
                let address: u8 = address.parse()?;
                let place =
                    self.slaves.iter().position(|slave| slave.address == address).ok_or("no such slave")?;
                let Slave { handle, answers, .. } = self.slaves[place];
                self.dp.get_mut(handle).pi_q_mut().copy_from_slice(&bytes(outputs)?);
                while self.slaves[place].answers < answers + ANSWERS {
                    self.poll();
                }
                say(&format!("ok {}", hexadecimal(self.dp.get_mut(handle).pi_i())))
            }
            _ => Err(format!("{line}?").into()),
        }
    }
}

fn decode() -> Done<()> {
    say("ready")?;
    for line in stdin().lines() {
        let bytes = bytes(&line?)?;
        let (mut said, mut rest) = (String::from("ok"), &bytes[..]);
        while !rest.is_empty() {
            let Some(Ok((telegram, length))) = Telegram::deserialize(rest) else {
                said += &format!(" none:{}", hexadecimal(rest));
                break;
            };
            said += &format!(" {}", describe(&telegram));
            rest = &rest[length..];
        }
        say(&said)?;
    }
    Ok(())
}

/// `token:DA:SA`, `acknowledge`, `KIND:DA:SA:DSAP:SSAP:FC:DATA`.
fn describe(telegram: &Telegram) -> String {
    match telegram {
        Telegram::Token(token) => format!("token:{}:{}", token.da, token.sa),
        Telegram::ShortConfirmation(_) => "acknowledge".into(),
        Telegram::Data(data) => {
            let head = &data.h;
            let sap = |sap: Option<u8>| sap.map_or("-".into(), |sap| sap.to_string());
            let kind = match head.fc {
                FunctionCode::Request { req, .. } => format!("{req:?}"),
                FunctionCode::Response { status, .. } => format!("{status:?}"),
            };
            let saps = [head.dsap, head.ssap].map(sap).join(":");
            let fc = head.fc.to_byte();
            format!("{kind}:{}:{}:{saps}:{fc:02x}:{}", head.da, head.sa, hexadecimal(data.pdu))
        }
    }
}
