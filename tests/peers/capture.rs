//! Captures by tshark.

use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::{Cable, LONG, Machine, Program, until};

/// A running capture.
pub struct Capture<M> {
    tshark: Program,
    file: PathBuf,
    /// Sends a text that the filter passes.
    marker: M,
}

impl<M: Fn(&str)> Capture<M> {
    /// Captures on `interface`, inside `namespace` if there is one.
    pub fn start(
        namespace: Option<&str>,
        interface: &str,
        filter: &str,
        file: PathBuf,
        marker: M,
    ) -> Capture<M> {
        let mut command = match namespace {
            Some(namespace) => Cable::command(namespace, "tshark"),
            None => Command::new("tshark"),
        };
        command.args(["-i", interface, "-f", filter, "-w"]).arg(&file);
        let capture = Capture { tshark: Program::spawn(&mut command), file, marker };
        // It says that it captures before it does.
        capture.see("the begin");
        capture
    }

    /// Sends `text` until it is in the file, and with it all that was sent before.
    fn see(&self, text: &str) {
        let seen = until(LONG, || {
            (self.marker)(text);
            let file = std::fs::read(&self.file).unwrap_or_default();
            file.windows(text.len()).any(|bytes| bytes == text.as_bytes())
        });
        assert!(seen, "{}", self.tshark.err());
    }

    /// Ends the capture: all that was sent before is in this file.
    pub fn end(self) -> PathBuf {
        self.see("the end");
        self.tshark.signal(libc::SIGINT);
        let ended = self.tshark.end();
        assert!(!ended.err.contains("dropped"), "{}", ended.err);
        self.file
    }
}

/// All that goes to and fro in the network of this machine, on loopback.
pub fn on_loopback(machine: &Machine) -> Capture<impl Fn(&str) + use<>> {
    let [own, to] = [240, 241].map(|host| machine.ip(host));
    let socket = UdpSocket::bind((own, 0)).unwrap();
    let filter = format!("net {}/24", machine.ip(0));
    Capture::start(None, "lo", &filter, machine.path("lo.pcapng"), move |text| {
        let _ = socket.send_to(text.as_bytes(), (to, 9));
    })
}

/// What the dissectors make of `file`: these fields of each frame that `filter` passes, a line each, with `|` between
/// them.
pub fn dissect(file: &Path, filter: &str, options: &[&str], fields: &[&str]) -> Vec<String> {
    let mut command = Command::new("tshark");
    command.arg("-r").arg(file).args(["-Y", filter, "-T", "fields", "-E", "separator=|"]).args(options);
    for field in fields {
        command.args(["-e", field]);
    }
    let read = Program::spawn(&mut command).end();
    read.expect(0);
    read.out.lines().map(str::to_owned).collect()
}
