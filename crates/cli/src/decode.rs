//! `fieldbeat decode`: a capture in words.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, Write};
use std::path::PathBuf;

use clap::Args;
use fieldbeat_capture::decode::Decoder;
use fieldbeat_capture::reader::{Capture, Wrong};
use fieldbeat_config::PROTOCOLS;

use super::Stop;
use super::export::printed;

/// Arguments of `decode`.
#[derive(Debug, Args)]
#[command(after_help = "Example: fieldbeat decode run.pcapng")]
pub struct Decode {
    /// A capture in the format pcapng or pcap, of `fieldbeat export --pcapng`, Wireshark, tcpdump or others.
    file: PathBuf,
    /// Drives of this protocol have this port, too, in a capture that others made: modbus-tcp=1502.
    #[arg(long, value_name = "PROTOCOL=PORT", value_parser = port)]
    port: Vec<(&'static str, u16)>,
}

/// A protocol by its name in configurations, and a port.
fn port(text: &str) -> Result<(&'static str, u16), String> {
    let (name, port) = text.split_once('=').unwrap_or((text, ""));
    let protocol = PROTOCOLS.iter().find(|known| known.name == name).map(|known| known.name);
    protocol.zip(port.parse().ok()).ok_or_else(|| {
        let names: Vec<&str> = PROTOCOLS.iter().map(|known| known.name).collect();
        format!("write PROTOCOL=PORT, with one of {}", names.join(", "))
    })
}

impl Decode {
    /// Prints a line for each telegram, and one about all.
    pub fn run(self) -> Result<(), Stop> {
        let name = self.file.display();
        let wrong = |wrong: Wrong| {
            let text = format!("{name}: {wrong}");
            if wrong.is_all() { Stop::usage(text) } else { Stop::failed(text) }
        };
        let file = File::open(&self.file).map_err(|why| wrong(why.into()))?;
        let mut capture = Capture::open(BufReader::with_capacity(1 << 20, file)).map_err(wrong)?;
        let mut out = BufWriter::new(io::stdout().lock());
        let mut decoder = Decoder::new(self.port);
        let failed = loop {
            let packet = match capture.next_packet() {
                Ok(Some(packet)) => packet,
                Ok(None) => break None,
                Err(why) => break Some(why),
            };
            let Some(interface) = capture.interfaces().get(packet.interface) else { continue };
            let written = decoder.enter(interface, &packet, |telegram| writeln!(out, "{telegram}"));
            if written.is_err() {
                return printed(written);
            }
        };
        printed(writeln!(out, "{}", decoder.finish()).and_then(|()| out.flush()))?;
        failed.map_or(Ok(()), |why| Err(wrong(why)))
    }
}
