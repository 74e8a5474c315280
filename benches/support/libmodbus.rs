//! A blocking client over libmodbus (C): the way most masters speak Modbus TCP. Compiled here, and run as a process of
//! its own on the loop's core and at its priority.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};

use fieldbeat::time::Time;
use fieldbeat_core::rt::Granted;
use fieldbeat_modbus::parameter::DRIVE_UNIT;

use super::fleet::{Fleet, Side};
use super::{handshake, rig, unidrive};

/// The compiled client.
#[derive(Debug)]
pub struct Libmodbus(PathBuf);

/// One that runs.
#[derive(Debug)]
pub struct Client {
    child: Child,
    said: BufReader<ChildStdout>,
    slots: usize,
}

impl Libmodbus {
    /// Compiles it; an error says what is missing.
    pub fn compile() -> Result<Libmodbus, String> {
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("support/libmodbus.c");
        let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("libmodbus-client");
        let output = Command::new("cc")
            .args(["-O2", "-Wall", "-o"])
            .args([&program, &source])
            .arg("-lmodbus")
            .output()
            .map_err(|error| format!("cannot run cc: {error}; install a C compiler"))?;
        if output.status.success() {
            return Ok(Libmodbus(program));
        }
        let said = String::from_utf8_lossy(&output.stderr);
        let first = said.lines().find(|line| line.contains("error")).unwrap_or_default();
        Err(format!("its client cannot be compiled: {first}; install libmodbus (Debian: libmodbus-dev)"))
    }

    /// Starts it with its drive, which is served, and waits until that one is in operation.
    pub fn start(&self, granted: &Granted) -> Result<Client, String> {
        let plan = Fleet::unidrives(1).modbus(Side::Libmodbus);
        // The drive is set up as ours is; it stays so when the connection ends.
        drop(handshake::connect(&plan).map_err(|error| error.to_string())?);
        let drive = &plan.drives[0];
        let mapping = unidrive::mapping(drive);
        let (write, read) = (&mapping.writes()[0], &mapping.reads()[0]);
        let fifo = granted.policy == "SCHED_FIFO";
        let mut child = Command::new(&self.0)
            .args([drive.address.ip().to_string(), drive.address.port().to_string(), DRIVE_UNIT.to_string()])
            .args([write.address, read.address, read.registers].map(|number| number.to_string()))
            // Its low word.
            .arg((2 * unidrive::STATUS_AT + 1).to_string())
            .arg(if fifo { rig::PRIORITY } else { 0 }.to_string())
            .arg(granted.core.map_or_else(|| "-1".to_owned(), |core| core.to_string()))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| format!("cannot run the client over libmodbus: {error}"))?;
        let said =
            child.stdout.take().map(BufReader::new).ok_or("the client over libmodbus has no output")?;
        let mut client = Client { child, said, slots: 0 };
        let mut line = String::new();
        match client.said.read_line(&mut line) {
            Ok(_) if line.trim() == "ready" => Ok(client),
            _ => Err(client.why()),
        }
    }
}

impl Client {
    /// Tells it its grid: `slots` of them from `begin` on.
    pub fn run(&mut self, begin: Time, period_ns: u64, slots: usize) -> io::Result<()> {
        self.slots = slots;
        // Closed behind it: nothing more is said.
        let mut input = self.child.stdin.take().ok_or(io::ErrorKind::BrokenPipe)?;
        writeln!(input, "{} {period_ns} {slots}", begin.0)
    }

    /// Waits for its end: its round trips, ns.
    pub fn end(mut self) -> Result<Vec<u64>, String> {
        let mut text = String::new();
        if self.said.read_to_string(&mut text).is_err()
            || !self.child.wait().is_ok_and(|status| status.success())
        {
            return Err(self.why());
        }
        let mut numbers = text.split_whitespace().map_while(|number| number.parse::<u64>().ok());
        let (executed, skipped) = (numbers.next().unwrap_or(0), numbers.next().unwrap_or(0));
        let round_trips: Vec<u64> = numbers.collect();
        if executed + skipped != self.slots as u64 || round_trips.len() as u64 != executed {
            return Err(format!(
                "the client over libmodbus executed {executed} and skipped {skipped} of {} slots, \
                 and reported {} round trips",
                self.slots,
                round_trips.len()
            ));
        }
        Ok(round_trips)
    }

    /// Why it ended.
    fn why(mut self) -> String {
        // It may run on, or have ended.
        let _ = self.child.kill();
        let mut said = String::new();
        if let Some(mut errors) = self.child.stderr.take() {
            let _ = errors.read_to_string(&mut said);
        }
        let status = self.child.wait().map_or_else(|error| error.to_string(), |status| status.to_string());
        format!("the client over libmodbus ended ({status}): {}", said.trim())
    }
}
