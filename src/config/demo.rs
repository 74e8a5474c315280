//! The plan of `fieldbeat demo`.

use std::path::Path;

use super::{Configuration, parse};
use crate::keys::error::ConfigErrors;
use crate::keys::file::{regular, whole_file};
use crate::time::{MS, S, US};

/// The sample that runs everywhere, without privileges or hardware.
const DEMO: &str = include_str!("../../rt-config/demo.toml");
/// Where it stands: what the plan of the demo has as its source.
pub const DEMO_FILE: &str = "rt-config/demo.toml";

/// So many demos can run on one computer at a time, each with addresses of its own.
pub const DEMO_PLACES: usize = 8;

/// Whether the file at `path` is the configuration that `fieldbeat demo` has built in, as far as it can be read.
pub fn is_demo(path: impl AsRef<Path>) -> bool {
    regular(path.as_ref(), "").is_ok_and(|bytes| bytes == DEMO.as_bytes())
}

/// The demo with so many LinMots, 1 ... 128, two Unidrives and two Kollmorgens, and this period. A period that no
/// Kollmorgen takes, as 333 us, leaves them out. `place`, below [`DEMO_PLACES`], chooses the addresses: 127.77.x.y and
/// `local:demo` at 0, 127.241.x.y and `local:demo-2` at 1, and so on.
pub fn demo_plan(drives: usize, period_ns: u64, place: usize) -> Result<Configuration, ConfigErrors> {
    if !(1..=128).contains(&drives) {
        return Err(whole_file(DEMO_FILE, None, format!("{drives} drives: the demo has 1 to 128")));
    }
    if place >= DEMO_PLACES {
        return Err(whole_file(DEMO_FILE, None, format!("place {place}: there are {DEMO_PLACES}")));
    }
    // Each has a name of its own in messages, and so a control socket of its own.
    let file = if place == 0 { DEMO_FILE.to_owned() } else { format!("{DEMO_FILE}#{}", place + 1) };
    parse(&demo_text(drives, period_ns, place), &file)
}

/// The demo's file up to its first drive, with the period replaced, then as many drives as wanted: all that they share
/// stands in `[bus.defaults]`. In a cycle too fast for its streaming command a drive is due every few cycles only; in
/// one too slow for it there are no streams. Then the bus of the Unidrives, with exchanges as many milliseconds apart
/// as in the file, and the EtherCAT segment as it is.
fn demo_text(drives: usize, period_ns: u64, place: usize) -> String {
    const LINE: &str = "[[bus]]\nprotocol = \"ethercat\"";
    /// What a simulated LinMot tolerates without a setpoint: longer than a busy computer holds this process up.
    const PATIENCE_NS: u64 = 2 * S;
    let head = DEMO.split("[[bus.drive]]").next().unwrap_or(DEMO);
    let tail = DEMO.match_indices("[[bus]]").nth(1).map_or("", |(at, _)| &DEMO[at..]);
    // What an S700 takes and can be given.
    let has_line = match period_ns {
        ..3_000_000 => period_ns.is_multiple_of(250 * US) && period_ns != 2_750 * US,
        _ => period_ns.is_multiple_of(MS) && period_ns < 32 * MS,
    };
    let tail = if has_line { tail } else { tail.split(LINE).next().unwrap_or(tail) };
    let period_ns = period_ns.max(1);
    let every = (8 * MS / period_ns.max(50 * US)).max(2);
    let divisor = (400 * US).div_ceil(period_ns.max(50 * US));
    let setpoints = (PATIENCE_NS / (period_ns * divisor)).clamp(20, 1_000);
    let streams = if period_ns <= DEMO_STREAMS_UP_TO_NS { "stream =" } else { "stream = \"off\" # stream =" };
    let mut text = head
        .replace("period = \"1ms\"", &format!("period = \"{period_ns}ns\""))
        .replace("[bus.defaults]", &format!("[bus.defaults]\ndivisor = {divisor}"))
        .replace("stream_patience = 1000", &format!("stream_patience = {setpoints}"))
        .replace("stream_depth = 1000", &format!("stream_depth = {setpoints}"))
        .replace("\nstream =", &format!("\n{streams}"))
        .replace("reference =", if has_line { "reference =" } else { "# reference =" });
    for drive in 1..=drives {
        text += &format!("[[bus.drive]]\nname = \"a{drive}\"\naddress = \"127.77.0.{}\"\n\n", drive + 10);
    }
    for line in tail.lines() {
        match line {
            "divisor = 8" => text += &format!("divisor = {every}"),
            "phase = 2" => text += &format!("phase = {}", every / 4),
            "phase = 6" => text += &format!("phase = {}", every * 3 / 4),
            _ => text += line,
        }
        text.push('\n');
    }
    if place > 0 {
        text = text.replace("127.77.", &format!("127.{}.", 240 + place));
        text = text.replace("\"local:demo\"", &format!("\"local:demo-{}\"", place + 1));
    }
    text
}

/// The longest period in which the demo's LinMots take a stream (LinUDP V2 manual, PVA streaming: 0.4 ... 10 ms).
pub const DEMO_STREAMS_UP_TO_NS: u64 = 10 * MS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_demo_is_the_sample_file() {
        let sample = parse(DEMO, DEMO_FILE).unwrap();
        let built = demo_plan(8, 1_000_000, 0).unwrap();
        assert_eq!(format!("{sample:?}"), format!("{built:?}"));
    }
}
