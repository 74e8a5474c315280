//! A machine's TOML file, read into a checked [`Plan`]. Everything that can be found out before anything is sent is
//! found out here, and every mistake names its file, line and key, and says what would be right.
//!
//! | file | what |
//! |---|---|
//! | `reader` | a table, read key by key; unknown keys, ranges, words, places of mistakes |
//! | `value` | times with units, addresses, did-you-mean |
//! | `error` | the mistakes |
//! | `cycle` | `[cycle]`, and what would starve the host |
//! | `drive` | the keys that every `[[bus.drive]]` has |
//! | `linudp` | the keys of `protocol = "linudp-v2"` |
//! | `modbus` | the keys of `protocol = "modbus-tcp"` |
//! | `ethercat`, `ethercat_device` | the keys of `protocol = "ethercat"`; those of slaves that are no drives |
//! | `ethercat_values` | areas of memory, objects and PDOs as people write them |
//! | `faults` | the faults of simulated drives |
//! | `describe` | a plan in words |
//! | `linmot_table` | a LinMot drive's command table as a file of its own |
//! | `linmot_curve` | a LinMot drive's curve as a file of its own |
//!
//! # The file
//!
//! `[cycle]`, all keys optional:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `period` | `"1ms"` | period of the loop, 50 us ... 1 s |
//! | `core` | the last | core of the loop |
//! | `priority` | `80` | SCHED_FIFO priority |
//! | `guard` | `"off"` | final spin before each grid point: `"off"`, a time, or `"auto"` (calibrated) |
//! | `receive_deadline` | `0.5` | replies are taken until this share of the period |
//! | `wait` | `"poll"` | `"spin"` asks the socket again and again instead of sleeping |
//! | `overrun` | `"skip"` | keep the grid and skip the slots; `"stop"` at the first |
//! | `max_skip` | `10` | more than so many slots skipped in a row are a stop |
//! | `realtime` | `"prefer"` | `"require"` refuses to start without the rights, `"off"` is an ordinary thread |
//! | `memory` | `"process"` | what is locked: the whole process, or the loop's `"own"` |
//! | `task_budget` | none | longest the in-loop task may run |
//! | `heartbeat` | none | longest the application may be silent while an axis is enabled; longer stops all that are |
//! | `late` | a tenth of the period | a cycle that begins later than this after its grid point, or spends longer in a stage, is counted as late, with its cause |
//! | `black_box` | `"2s"` | how much of the past is kept, and written to a file at a fault or a lost drive |
//! | `reference` | none | the name of the one bus whose clock leads the grid: it follows that clock instead of this computer's (EtherCAT) |
//!
//! `[[bus]]`: `protocol`, `name` (default: the protocol), the keys of the protocol, `[bus.defaults]`, and one
//! `[[bus.drive]]` a drive. **What stands in `[bus.defaults]` holds for every drive of this bus that does not say
//! otherwise**, sub-tables key by key; `name`, `address` and `position` are each drive's own.
//!
//! `[[bus.drive]]`, lengths in the drive's units:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `name` | - | unique in the machine |
//! | `address` | - | see the protocol |
//! | `units` | the protocol's | `"mm"` or `"rev"`; LinUDP mm, the others rev |
//! | `scale` | the protocol's, for its own unit | LinUDP drive counts in one unit, 10000 a mm; the others revolutions of the motor, 1 a rev |
//! | `invert` | `false` | turn the direction round |
//! | `offset` | `0` | position of the drive's count zero |
//! | `modulo` | none | length of one turn of a rotary axis |
//! | `limits.position` | none | `[lowest, highest]` |
//! | `limits.velocity`, `limits.acceleration` | none | units/s, units/s² |
//! | `limits.step` | none | largest distance between two streamed rows |
//! | `limits.torque` | none | largest torque setpoint, per cent of the rated torque |
//! | `profile.velocity` | `100` mm/s, `1` rev/s | of moves that name none; at most the limit |
//! | `profile.acceleration` | `1000` mm/s², `10` rev/s² | at most the limit |
//! | `profile.deceleration` | `profile.acceleration` | |
//! | `divisor`, `phase` | `1`, `0` | an exchange every so many cycles, in which of them |
//! | `health.bucket` | `5` | so many misses in a row are a lost link |
//! | `health.leak` | `20` | so many good exchanges in a row outweigh one miss |
//! | `health.gate` | `10` | so many good exchanges in a row bring a link up |
//! | `health.probe_interval` | `"100ms"` | how often an absent drive is asked |
//! | `stop.how` | `"ramp"` | or the drive's own `"quick"` stop, or `"coast"` |
//! | `stop.deceleration` | `profile.deceleration` | of the ramp; may be more than the limit |
//! | `stop.then` | `"disable"` | power off at standstill, or `"hold"` (default where `held_by = "drive"`) |
//! | `stop.timeout` | `"3s"` | longest time to standstill |
//! | `stop.on_timeout` | `"disable"` | without standstill by then: power off, or `"hold"` (default as above) |
//! | `stop.standstill` | `5` mm/s, `0.05` rev/s | slower than this ... |
//! | `stop.standstill_for` | `20` | ... for so many good exchanges |
//! | `stop.group` | none | drives that name the same group stop together |
//! | `load` | `"level"` | `"vertical"`: the load drops when nothing holds it |
//! | `held_by` | - | what holds a vertical load: the drive's `"brake"`, or the powered `"drive"` alone, which is then never powered off |
//! | `setpoint_age` | `10` | cycles; a cyclic velocity or torque setpoint that is older stops the axis |
//! | `jog_deadman` | `"500ms"` | a jog that is not renewed for so long is stopped; `"off"`: it runs until replaced |
//! | `underrun` | `"stop"` | what an empty stream does: or `"hold"`, or `{ extrapolate = n }` exchanges |
//! | `on_found_running` | `"stop"` | a drive found enabled: stop it, or `"refuse"` to touch it |
//! | `enable_timeout` | `"5s"` | longest time for Enable, Disable, ResetFault |
//! | `home_timeout` | `"60s"` | longest time for Home |
//! | `command_queue`, `stream_queue`, `event_queue` | `64`, `1024`, `256` | room in entries |
//! | `parameter_queue` | `64` | room for acyclic calls |
//! | `sample_queue` | `0` | room for the feedback of every cycle; 0 keeps only the newest |
//!
//! `[[group]]`, axes that act together: `name`, and `axes`, the names of its drives in the order of its rows. They
//! share divisor, phase and stop group.
//!
//! `protocol = "linudp-v2"`:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `bind` (bus) | - | the adapter's own address, `"192.168.1.1"` or with another port than 41136 |
//! | `send` (bus) | `"batch"` | one system call for all requests, or one `"each"` with its own stamp |
//! | `address` | - | `"192.168.1.10"` or with another port than 49360 |
//! | `stream` | `"pva"` if the period fits, else `"off"` | [command](crate::bus::linudp::StreamCommand) of streamed motion |
//! | `monitor` | `false` | ask for the monitoring channels too: up to four [variables](crate::bus::linudp::upid::KNOWN) by name or UPID, to which the drive is set (in RAM) whenever it comes online; `true`: whatever is set in the drive |
//! | `reply_tag` | `false` | number the requests through the parameter channel |
//! | `no_drive_watchdog` | `"refuse"` | jogs and cyclic velocities are refused, or `"accept"`ed with a `leash` |
//! | `leash` | - | how far these run ahead, and on if the master dies; at most the range |
//! | `simulate` | below | the drive when it is simulated |
//!
//! `protocol = "modbus-tcp"`, where a parameter is text that is known here, `"06.042"` or its
//! [name](crate::bus::modbus::parameter::catalogue), or one with its size, `{ parameter = "18.011", bits = 32, decimals
//! = 1 }`:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `address` | - | `"192.168.1.20"` or with another port than 502; one drive an address and port |
//! | `unit` | 255, and 0 where that is not answered | the unit id of the drive |
//! | `slot` | `4` | where its Ethernet interface is: 4 onboard, 1 ... 3 an option |
//! | `addressing` | `"standard"` | how parameters become addresses, or `"modified"` |
//! | `map.control`, `map.status` | `"06.042"`, `"10.040"` | control word and status word |
//! | `map.reference`, `map.speed` | `"01.021"`, `"03.002"` | speeds, told and read |
//! | `map.trip` | `"10.020"` | the number of the last trip, or `"off"` |
//! | `monitor` | `["04.020"]` | up to four parameters that are shown besides, or `false` |
//! | `also_read` | `[]` | what is read besides, for the native process data; ranges as `"20.021 ... 20.030"` |
//! | `via` | `"direct"` | a block in each request, in turns; `"menu-0"`: all of it, side by side in menu 0, or `{ menu_0 = 11 }` from Pr 00.011 on |
//! | `reply_within` | `"50ms"` | a reply counts for so long |
//! | `set_up` | `true` | set the drive to what is needed, before it is enabled; `false` only looks |
//! | `watchdog.timeout` | `"500ms"` | without Modbus traffic for so long the drive trips (Pr S.15.009); `"off"` leaves that as it is |
//! | `watchdog.keypad` | `false` | the watchdog in the control word, about 1 s |
//! | `no_drive_watchdog` | `"refuse"` | a drive with neither of them is not enabled, or that is `"accept"`ed |
//! | `simulate` | below | the drive when it is simulated |
//!
//! `protocol = "ethercat"`, where an object is `"0x6041:0"`, its [name](crate::bus::ethercat::object::catalogue), or
//! one with its type, `"0x3612:0.i32"`; numbers of identities and addresses may be text with `0x`, too:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `interface` (bus) | - | the network interface, `"eth1"`; `"local:NAME"` is a line of simulated drives on this computer |
//! | `sync_ahead` (bus) | half of the period | how long before SYNC0 a frame leaves the master |
//! | `lrw` (bus) | `true` | outputs and inputs go in one datagram, which all slaves have to know; `false`: in two |
//! | `simulate` (bus) | below | the line when it is simulated |
//! | `position` | the one behind the slave before it in the file | its place on the line; 0 is next to the master |
//! | `type` | `"s700"` | or `"s300"`, `"s400"`, `"s600"`, which are the same here, or `"akd"` |
//! | `vendor`, `product`, `revision` | `0x6A`, the type's, `"any"` | who it has to be, or `"any"` |
//! | `pdo.outputs` | `"0x1702"` | what it is told: a fixed PDO that is known, a list of objects to map, or `{ pdo = "0x1704", objects = [...] }` |
//! | `pdo.inputs` | `"0x1B03"`; AKD `"0x1B24"` | what it tells |
//! | `mapping` | by the PDOs | `"fixed"` ones are selected, `"free"` ones mapped by the master; `"as-is"`: nothing is written |
//! | `mode` | by the setpoint | the mode of operation (6060h) for the setpoint in `pdo.outputs`: a number, or a name |
//! | `prbase` | `20` | increments a turn as a power of two |
//! | `check_prbase` | `true` | what the drive says of it, 608Fh:1 over 608Fh:2, is held against `prbase` |
//! | `velocity_rpm_per_count` | 2^20 increments a turn per 250 us; AKD `0.001` | rpm of a count of the velocity setpoint |
//! | `torque_permille_per_count` | `1` | per mille of the rated torque or current of a count of the torque setpoint |
//! | `rated_current` | none | of the motor, A; to tell the current |
//! | `watchdog` | `"100ms"` | without outputs for so long the slave falls back by itself; or `"off"` |
//! | `no_drive_watchdog` | `"refuse"` | with `watchdog = "off"` velocities and torques are refused, or `"accept"`ed |
//! | `mailbox.out`, `mailbox.in` | `[0x1800, 16]`, `[0x1C00, 16]`; AKD 1024 | where its mailboxes are: start and bytes |
//! | `buffers.outputs`, `buffers.inputs` | `0x1100`, `0x1140` | where its process data are |
//! | `sync` | `true` | it works by SYNC0 of its clock; `false`: by the arrival of the frame |
//! | `check_sii` | `true` | what its SII says of mailboxes and process data is held against the configuration |
//! | `start_up` | `[]` | what is written in PREOP: `[{ object = "0x35D5:1", value = 4 }]`; up to 4 bytes each, of an AKD and of devices texts up to 8 |
//! | `monitor` | `false` | up to four objects that are shown besides, read by the mailbox in turns |
//! | `home_method` | as the drive is set | method of homing (6098h) |
//! | `simulate` | below | the drive when it is simulated |
//!
//! `[[bus.device]]` of `"ethercat"` is a slave that is no drive: `name`, `position`, `vendor`, `product`, `revision`
//! (default `"any"`), `sync` (default `false`), `mailbox`, `check_sii`, `start_up` and `watchdog` as of a drive, and
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `outputs`, `inputs` | none | `{ start = 0x1000, length = 2 }`: where its process data are, and how many bytes |
//! | `simulate.outputs`, `simulate.inputs` | digital ones | its terminals: `{ digital = 8, analogue = 2 }`, bits and 16-bit words |
//!
//! `simulate`, of every protocol:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `seed` | `0` | of the random faults; each drive adds its place in the file |
//! | `drop`, `duplicate`, `corrupt`, `delay`, `reorder`, `stall`, `restart`, `inhibit`, `wrong_id` | `0` | how likely a datagram, or what is sent at once on a connection, meets this fault, 0 ... 1; `inhibit` opens the hardware enable (STO) |
//! | `delay_by` | one period of the drive | how much later what is delayed comes |
//! | `stall_for` | `"100ms"` | how long a stalled drive is silent |
//! | `inhibit_for` | `"100ms"` | how long the hardware enable stays open |
//! | `answer_time` | `"0us"` | from a request to its answer |
//!
//! `simulate` of `"linudp-v2"`:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `padding` | `14` | shortest payload, bytes: `0`, `14` or `64` |
//! | `filter` | `"none"` | which masters it answers: all, a `"single"` one, or the one with this address |
//! | `range` | `limits.position` and 5 units more, else 1000 units both ways | mechanical range |
//! | `home` | `0`, or the low end of the range | where the home switch is |
//! | `start` | the middle of the range | position at power-on |
//! | `mass` | `1` | kg |
//! | `stream_period` | one period of the drive | set in the drive for the configured streaming commands |
//! | `stream_patience` | `2.5` | periods without a setpoint before a stream ends in error 0083h |
//! | `stream_depth` | `8` | setpoints that a stream holds; one more ends it in error 0082h |
//! | `force_enable_bits` | `false` | bits 1-5 of the control word are forced to 1 |
//! | `running` | `false` | comes up enabled and moving, as if another master had died |
//! | `config_time` | `"0us"` | how long a command on the parameter channel takes; "busy" is answered meanwhile |
//! | `flash_time` | `"500ms"` | how long a save into flash takes, a single parameter a 500th of it; real drives took 39 ... 75 s |
//! | `flash` | `"silent"` | answers nothing while it saves; `"mute"`: nor says afterwards how it went; `"busy"`: answers that it is |
//! | `unknown_commands` | `"refuse"` | error 0081h at a motion command that it has no use for; `"ignore"` |
//! | `extend_sign` | `false` | values of less than 32 bits carry their sign in the bits above |
//!
//! `simulate` of `"modbus-tcp"`:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `split`, `cut` | `0` | how likely it comes a byte at a time; how likely a connection ends in the middle of a reply |
//! | `fc23` | `true` | it knows FC23, a write and a read in one request |
//! | `menu_0` | `true` | Pr 22.001 and on say what menu 0 shows |
//! | `connections` | `4` | how many masters it listens to at a time |
//! | `rated_speed`, `rated_torque` | `3000`, `5` | of the motor, rpm and N m |
//! | `inertia` | `0.005` | of all that turns, kg m² |
//! | `load`, `friction` | `1.5`, `0.1` | what the machine takes, N m: at rated speed, growing with it; and at any |
//! | `running` | none | comes up enabled and at this velocity, as if another master had died |
//!
//! `simulate` of an `"ethercat"` bus, where the keys of every protocol stand, too: each frame is a datagram of theirs:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `interface` | - | the network interface at the drives' end of the cable |
//! | `drift_ppm` | `[]` | how much faster than ours the clocks run, by place; the last one counts for all behind it |
//! | `line_delay` | `"500ns"` | what a frame takes from one slave to the next |
//! | `short_clocks` | `false` | the clocks have 32 bits and not 64 |
//!
//! `simulate` of its drives:
//!
//! | key | default | meaning |
//! |---|---|---|
//! | `dialect` | `"standard"` | how it answers SDOs, or as the `"manual"` prints it |
//! | `serial` | `0` | its serial number |
//! | `start` | `0` | position at power-on, units |
//! | `home` | `0.5` turns | where the home switch is, turns of the motor from there; `"none"` |
//! | `sync_after` | `100` | cycles inside of the window until it is synchronous |
//! | `hardware_enable` | `true` | STO is closed |
//! | `rated_torque`, `peak_torque` | `5`, `3000` | of the motor, N m, and the most that it pushes, per mille of that |
//! | `max_speed` | `6000` | of the motor, rpm |
//! | `inertia`, `friction` | `0.002`, `0.1` | of all that turns, kg m²; what the machine takes, N m |

mod cycle;
mod describe;
mod drive;
mod error;
mod ethercat;
mod ethercat_device;
mod ethercat_values;
mod faults;
pub mod linmot_curve;
pub mod linmot_table;
mod linudp;
mod modbus;
mod reader;
mod value;

use std::collections::HashMap;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::time::Duration;

pub use cycle::starvation;
pub use describe::{describe, stop_bound, stop_bound_cycles};
pub use error::{ConfigError, ConfigErrors};

use crate::bus::BusPlan;
use crate::cycle::{CyclePlan, GroupPlan, Plan};
use crate::time::{MS, S, US};
use reader::{Page, Place, Table};

/// The sample that runs everywhere, without privileges or hardware.
const DEMO: &str = include_str!("../../rt-config/demo.toml");
/// Where it stands, for messages.
const DEMO_FILE: &str = "rt-config/demo.toml";

/// Reads the configuration at `path`.
pub fn load(path: impl AsRef<Path>) -> Result<Plan, ConfigErrors> {
    let (file, text) = read(path.as_ref(), "an existing configuration, for example rt-config/demo.toml")?;
    parse(&text, &file)
}

/// A file's name and text; `kind` says what kind of file it should be, with an example.
fn read(path: &Path, kind: &str) -> Result<(String, String), ConfigErrors> {
    let file = path.display().to_string();
    let bytes = std::fs::read(path).map_err(|error| unreadable(&file, &error, kind))?;
    match String::from_utf8(bytes) {
        Ok(text) => Ok((file, text)),
        Err(error) => {
            let valid = &error.as_bytes()[..error.utf8_error().valid_up_to()];
            let line = valid.iter().filter(|byte| **byte == b'\n').count() + 1;
            Err(whole_file(&file, Some(line), "not UTF-8; save the file as UTF-8 text".into()))
        }
    }
}

/// Reads the configuration `text`; messages call it `file`.
pub fn parse(text: &str, file: &str) -> Result<Plan, ConfigErrors> {
    let page = Page::new(file, text);
    let entries = page.parse()?;
    let plan = machine(Table::root(&page, &entries));
    page.verdict()?;
    Ok(Plan { source: Some(PathBuf::from(file)), ..plan })
}

/// A time as people write it, on the command line as in a file: `"250us"`, `"0.5s"`, `"8h"`.
pub fn duration(text: &str) -> Result<Duration, String> {
    let ns = value::duration(text);
    ns.map(Duration::from_nanos)
        .ok_or_else(|| "write a number with its unit: ns, us, ms, s, min or h, for example 10s".into())
}

/// So many demos can run on one computer at a time, each with addresses of its own.
pub const DEMO_PLACES: usize = 8;

/// The demo with so many LinMots, 1 ... 128, two Unidrives and two Kollmorgens, and this period. A period that no
/// Kollmorgen takes, as 333 us, leaves them out. `place`, below [`DEMO_PLACES`], chooses the addresses: 127.77.x.y and
/// `local:demo` at 0, 127.78.x.y and `local:demo-2` at 1, and so on.
pub fn demo_plan(drives: usize, period_ns: u64, place: usize) -> Result<Plan, ConfigErrors> {
    if !(1..=128).contains(&drives) {
        return Err(whole_file(DEMO_FILE, None, format!("{drives} drives: the demo has 1 to 128")));
    }
    if place >= DEMO_PLACES {
        return Err(whole_file(DEMO_FILE, None, format!("place {place}: there are {DEMO_PLACES}")));
    }
    parse(&demo_text(drives, period_ns, place), DEMO_FILE)
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
        text = text.replace("127.77.", &format!("127.{}.", 77 + place));
        text = text.replace("\"local:demo\"", &format!("\"local:demo-{}\"", place + 1));
    }
    text
}

/// The longest period in which the demo's LinMots take a stream (LinUDP V2 manual, PVA streaming: 0.4 ... 10 ms).
pub const DEMO_STREAMS_UP_TO_NS: u64 = 10 * MS;

fn unreadable(file: &str, error: &io::Error, kind: &str) -> ConfigErrors {
    let reason = match error.raw_os_error() {
        Some(number) => nix::errno::Errno::from_raw(number).desc().to_owned(),
        None => error.to_string(),
    };
    let remedy = match error.kind() {
        io::ErrorKind::PermissionDenied => "let this user read it".to_owned(),
        _ => format!("name {kind}"),
    };
    whole_file(file, None, format!("cannot read {file}: {reason}; {remedy}"))
}

fn whole_file(file: &str, line: Option<usize>, message: String) -> ConfigErrors {
    ConfigError { file: file.to_owned(), line, key: None, value: None, message }.into()
}

/// Reads a `[[bus]]`.
type ReadBus = fn(&mut Table<'_>, &mut Machine, &CyclePlan) -> Box<dyn BusPlan>;

/// One word a protocol; the next one is one line more.
const PROTOCOLS: [(&str, ReadBus); 3] = [
    (crate::bus::linudp::PROTOCOL, linudp::bus),
    (crate::bus::modbus::PROTOCOL, modbus::bus),
    (crate::bus::ethercat::PROTOCOL, ethercat::bus),
];

/// Stands in for an address that was refused: the plan is not handed out then.
const NOWHERE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0);

fn machine(mut root: Table<'_>) -> Plan {
    let cycle = root.table("cycle", cycle::cycle);
    let mut machine = Machine { period_ns: cycle.period_ns, ..Machine::default() };
    if !root.gives("bus") {
        root.fault("bus", "missing; a machine needs a [[bus]] with at least one [[bus.drive]]");
    }
    let mut buses: Vec<Box<dyn BusPlan>> = Vec::new();
    for mut table in root.tables("bus") {
        table.require(
            "protocol",
            "\"linudp-v2\" is LinMot LinUDP V2, \"modbus-tcp\" Nidec Unidrive, \"ethercat\" Kollmorgen S300 ... S700",
        );
        if let Some(read) = table.word("protocol", &PROTOCOLS) {
            buses.push(read(&mut table, &mut machine, &cycle));
            table.finish();
        }
    }
    machine.check_groups(&root);
    cycle::check_reference(&root, &cycle, &buses);
    for message in machine.periods {
        root.fault("cycle.period", message);
    }
    let drives = buses.iter().map(|bus| bus.axes().len()).sum();
    cycle::check_period(&root, &cycle, drives);
    let mut plan = Plan { source: None, cycle, buses, groups: Vec::new() };
    if let Some(why) = plan.black_box_fault() {
        root.fault("cycle.black_box", why);
    }
    for mut table in root.tables("group") {
        let group = group(&mut table, &plan);
        plan.groups.extend(group);
        table.finish();
    }
    root.finish();
    plan
}

/// The drives of a bus, each over its `[bus.defaults]`; `read` is told its place, too.
fn drives<D>(bus: &mut Table<'_>, mut read: impl FnMut(&mut Table<'_>, usize) -> D) -> Vec<D> {
    let mut drives = Vec::new();
    for (index, mut table) in drive_tables(bus, &["name", "address"]).into_iter().enumerate() {
        drives.push(read(&mut table, index));
        table.finish();
    }
    drives
}

/// The tables of the drives of a bus, each over its `[bus.defaults]` but for the keys that are its `own`.
fn drive_tables<'a>(bus: &mut Table<'a>, own: &'static [&'static str]) -> Vec<Table<'a>> {
    let defaults = bus.sub_table("defaults");
    if !bus.gives("drive") {
        bus.fault("drive", "missing; a bus needs at least one [[bus.drive]]");
    }
    bus.tables("drive").into_iter().map(|table| table.over(&defaults, own)).collect()
}

/// A `[[group]]`: axes that act together.
fn group(table: &mut Table<'_>, plan: &Plan) -> Option<GroupPlan> {
    table.require("name", "how programs ask for it");
    table.require("axes", "the names of its drives, like [\"x\", \"y\"]");
    let name = table.text("name", "1 to 32 letters, digits, - _ or .", drive::plain_name);
    let axes = table.read("axes", |value| {
        let names = value.as_array().map(|array| array.iter().map(|name| name.get_ref().as_str()));
        let names: Option<Vec<&str>> = names.and_then(Iterator::collect);
        names
            .ok_or("must be the names of drives, like [\"x\", \"y\"]".into())
            .map(|names| names.into_iter().map(str::to_owned).collect::<Vec<_>>())
    });
    let group = GroupPlan { name: name?, axes: axes? };
    if plan.groups.iter().any(|other| other.name == group.name) {
        table.fault("name", "is taken by another group; names are unique");
    }
    if let Some(why) = group.fault(&plan.axes()) {
        table.fault("axes", why);
    }
    Some(group)
}

/// What must be unique in the whole machine, and where it was seen first.
#[derive(Debug, Default)]
struct Machine {
    /// Drives, and devices that are none: which, and where.
    names: HashMap<String, (&'static str, Place)>,
    buses: HashMap<String, Place>,
    addresses: HashMap<Ipv4Addr, Vec<(SocketAddrV4, Claim, Place)>>,
    binds: Vec<(SocketAddrV4, Place)>,
    interfaces: HashMap<String, Place>,
    /// The period of the cycle.
    period_ns: u64,
    /// Why the period of the cycle does not suit a bus.
    periods: Vec<String>,
    /// Stop groups by id, with their members.
    groups: Vec<(String, Vec<Place>)>,
}

/// What a drive is told from the others by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Claim {
    /// Its IP address: that is what a datagram says.
    Host,
    /// Address and port: it has a connection of its own.
    Port,
}

impl Machine {
    /// The name of a `kind`, a drive or a device.
    fn claim_name(&mut self, table: &Table<'_>, kind: &'static str, name: &str) {
        if name.is_empty() {
            return; // Missing or wrong, and already reported.
        }
        if let Some((kind, first)) = self.names.get(name) {
            table.fault("name", format!("is the {kind} of {first} already; names are unique in the machine"));
        } else {
            self.names.insert(name.to_owned(), (kind, table.place("name")));
        }
    }

    /// The interface of a bus without IP.
    fn claim_interface(&mut self, table: &Table<'_>, interface: &str) {
        if let Some(first) = self.interfaces.get(interface) {
            table.fault(
                "interface",
                format!("is that of the bus of {first} already; one bus an interface, put its drives there"),
            );
        } else {
            self.interfaces.insert(interface.to_owned(), table.place("interface"));
        }
    }

    /// The bus' name, or its protocol's where it has none.
    fn bus_name(&mut self, table: &mut Table<'_>, protocol: &str) -> String {
        let name = table.text("name", "1 to 32 letters, digits, - _ or .", drive::plain_name);
        let name = name.unwrap_or_else(|| protocol.to_owned());
        match self.buses.get(&name) {
            Some(first) if table.gives("name") => {
                table
                    .fault("name", format!("is the bus of {first} already; names are unique in the machine"));
            }
            Some(first) => {
                table.fault("name", format!("missing; the bus of {first} is called {name} already"));
            }
            None => {
                self.buses.insert(name.clone(), table.place("name"));
            }
        }
        name
    }

    fn claim_bind(&mut self, table: &Table<'_>, bind: SocketAddrV4) {
        let overlaps = |other: &SocketAddrV4| {
            let everywhere = bind.ip().is_unspecified() || other.ip().is_unspecified();
            other.port() == bind.port() && (everywhere || other.ip() == bind.ip())
        };
        if let Some((_, first)) = self.binds.iter().find(|(other, _)| overlaps(other)) {
            table.fault(
                "bind",
                format!("is taken by the bus of {first}; one bus an address, put its drives there"),
            );
        }
        let drives = self.addresses.get(bind.ip()).into_iter().flatten();
        let mut hosts = drives.filter(|(_, claim, _)| *claim == Claim::Host);
        if let Some((.., drive)) = hosts.find(|(address, ..)| *address == bind) {
            table.fault("bind", format!("is the drive of {drive}; give the master's own address"));
        }
        self.binds.push((bind, table.place("bind")));
    }

    fn claim_address(&mut self, table: &Table<'_>, address: SocketAddrV4, claim: Claim) {
        let by_host = |other: &Claim| claim == Claim::Host || *other == Claim::Host;
        let known = self.addresses.entry(*address.ip()).or_default();
        let mut binds = self.binds.iter().filter(|_| claim == Claim::Host);
        if let Some((_, first)) = binds.find(|(bind, _)| *bind == address) {
            table.fault("address", format!("is the master's own, bind of {first}; give the drive's"));
        } else if let Some((_, other, first)) =
            known.iter().find(|(taken, other, _)| by_host(other) || *taken == address)
        {
            let each = if by_host(other) { "an IP address" } else { "an address and port" };
            table.fault("address", format!("is the drive of {first} already; one drive {each}"));
        } else {
            known.push((address, claim, table.place("address")));
        }
    }

    /// The id of a stop group.
    fn group(&mut self, table: &Table<'_>, name: String) -> u16 {
        let place = table.place("group");
        let index = match self.groups.iter_mut().position(|(known, _)| *known == name) {
            Some(index) => {
                self.groups[index].1.push(place);
                index
            }
            None => {
                self.groups.push((name, vec![place]));
                self.groups.len() - 1
            }
        };
        u16::try_from(index).unwrap_or(u16::MAX)
    }

    /// A group of one is a slip of the pen, and the axes that should stop together would not.
    fn check_groups(&self, root: &Table<'_>) {
        for (name, members) in &self.groups {
            if let [only] = members.as_slice() {
                let others =
                    self.groups.iter().map(|(other, _)| other.as_str()).filter(|other| other != name);
                let hint = match value::closest(name, others) {
                    Some(meant) => format!("did you mean \"{meant}\"? "),
                    None => String::new(),
                };
                root.report(
                    only,
                    format!("no other drive is in this group; {hint}leave it out to stop alone"),
                );
            }
        }
    }
}

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
