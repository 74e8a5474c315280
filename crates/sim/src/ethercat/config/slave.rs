//! The keys of `simulate` that every slave has, drive or not.

use crate::ethercat::{
    Behind, ClockKind, Left, MailboxSettings, Model, SiiContent, SiiSettings, SlaveSettings,
};
use fieldbeat_core::time::S;
use fieldbeat_ethercat::EthercatPlan;
use fieldbeat_keys::key::Key;
use fieldbeat_keys::keys;
use fieldbeat_keys::table::Table;

keys! {
    LEFT "left" = "none": "as another master has left it, with a station address, an FMMU, SYNC0 and its "
        "SII given away after a failed command: in `\"op\"`, in `\"op\"` with the watchdog switched off: "
        "`\"unwatched\"`, in `\"safeop\"`, or by its `\"watchdog\"` in SAFEOP with 001Bh";
    TYPE "type" = "(fits this file)": "the device that it is when simulated, whatever this file expects: "
        "`\"EK1100\"`, `\"EK1122\"`, `\"EL1002\"`, `\"EL1004\"`, `\"EL1008\"`, `\"EL1809\"`, `\"EL2002\"`, "
        "`\"EL2004\"`, `\"EL2008\"`, `\"EL2809\"` (two SyncManagers), `\"EL3102\"` (with a mailbox)";
    SERIAL "serial" = "(as `serial` of the drive, else `0`)": "serial number";
    ALIAS "alias" = "(as `alias` of the drive, else `0`)": "configured station alias; 0: none";
    IDENTIFICATION "identification" = "(as `identification` of the drive, else none)":
        "its answer to a request for its identification, 0 ... 65535";
    EMULATED "emulated" = "(`false` of a drive; of a device that of its type, and `true` without mailboxes)":
        "it has no processor: AL status is what AL control says, and nothing is checked (device emulation, "
        "0141h bit 0)";
    EXACT_MANAGERS "exact_managers" = "false": "compares its SyncManagers with its SII byte by byte: "
        "refuses PREOP with 0016h, SAFEOP with 001Dh or 001Eh";
    OUTPUT_CONTROL "output_control" = "(`0x64`; AKD `0x24`; `0x44` of outputs below 0x1000)":
        "control byte of its outputs in its SII, 0 ... 255";
    CLOCK "clock" = "(by `sync` and `short_clocks`)": "`\"long\"` (64 bits), `\"short\"` (32 bits) or "
        "`\"none\"`";
    FMMUS "fmmus" = "8": "number of its FMMUs, 0 ... 32";
    WIRED_TO "wired_to" = "none": "name of the slave whose digital inputs its digital outputs are wired to";
    OWNED_BY_SLAVE "owned_by_slave" = "false": "after power-on its processor has the SII: a master has to "
        "take it by force";
    READ_IN_PREOP "read_in_preop" = "false": "refuses PREOP with 0050h while the master has the SII";
    EIGHT_BYTES "eight_bytes" = "false": "a read returns eight bytes instead of four";
    BUSY "busy" = "100us": "time of a read, up to 1 s";
    LOADING "loading" = "0ms": "busy for so long after power-on, up to 60 s";
    SLIPS "slips" = "false": "the first read returns another address, and the words there";
    FAILS_EVERY "fails_every" = "0": "of so many reads one fails, and shows the error until the next "
        "command; 0: none";
    CONTENT "content" = "sound": "or `\"wrong-check\"` (checksum), `\"garbage\"` (noise in place of the "
        "categories), or `\"unloaded\"` (nothing was loaded)";
    DELAY "delay" = "0ms": "how much later it answers, up to 60 s";
    DELAY_EVERY "delay_every" = "1": "of so many answers one is late";
    LOSE_EVERY "lose_every" = "0": "of so many answers one is lost; 0: none";
    RESENDS "resends" = "true": "sends its last message again on request; `false`: only acknowledges that";
    SLAVE "slave" = "-": "name of the slave in front of it, at a branch; without `behind` it is at port 1 "
        "of the slave before it";
    PORT "port" = "-": "port of that slave that it is connected to, 1 ... 3. A frame leaves a slave by "
        "ports 3, 1 and 2, and positions count in that order";
}

/// The slaves of a bus by their names.
pub(super) struct Names<'a>(Vec<(&'a str, u16)>);

impl Names<'_> {
    /// All of a plan.
    pub(super) fn of(plan: &EthercatPlan) -> Names<'_> {
        Names(plan.slaves().into_iter().map(|(owner, slave)| (plan.name_of(owner), slave.place)).collect())
    }
}

/// Reads the keys of the slave at `place`; a device can be a model.
pub(super) fn slave(table: &mut Table<'_>, place: u16, names: &Names<'_>, device: bool) -> SlaveSettings {
    let words = [
        ("op", (false, (0x08, 0))),
        ("safeop", (false, (0x04, 0))),
        ("watchdog", (false, (0x14, 0x001B))),
        ("unwatched", (true, (0x08, 0))),
    ];
    let left = table.word(LEFT, &words);
    SlaveSettings {
        model: device.then(|| table.word(TYPE, &Model::ALL)).flatten(),
        serial: device.then(|| table.integer(SERIAL, 0..=u32::MAX.into())).flatten(),
        alias: table.integer(ALIAS, 0..=u16::MAX.into()),
        identification: table.integer(IDENTIFICATION, 0..=u16::MAX.into()),
        emulated: table.flag(EMULATED),
        exact_managers: table.flag(EXACT_MANAGERS).unwrap_or_default(),
        output_control: table.integer(OUTPUT_CONTROL, 0..=0xFF),
        clock: table.word(
            CLOCK,
            &[("long", ClockKind::Long), ("short", ClockKind::Short), ("none", ClockKind::None)],
        ),
        fmmus: table.integer(FMMUS, 0..=32),
        sii: table.table("sii", sii),
        mailbox: table.table("mailbox", mailbox),
        behind: behind(table, names),
        wired_to: device.then(|| named(table, WIRED_TO, names)).flatten(),
        left: left.map(|(unwatched, al)| Left { unwatched, ..Left::by_another(place, al) }),
    }
}

fn sii(table: &mut Table<'_>) -> SiiSettings {
    let usual = SiiSettings::default();
    SiiSettings {
        owned_by_slave: table.flag(OWNED_BY_SLAVE).unwrap_or(usual.owned_by_slave),
        read_in_preop: table.flag(READ_IN_PREOP).unwrap_or(usual.read_in_preop),
        eight: table.flag(EIGHT_BYTES).unwrap_or(usual.eight),
        busy_ns: table.time(BUSY, 0..=S).unwrap_or(usual.busy_ns),
        loading_ns: table.time(LOADING, 0..=60 * S).unwrap_or(usual.loading_ns),
        slips: table.flag(SLIPS).unwrap_or(usual.slips),
        fails_every: table.integer(FAILS_EVERY, 0..=1_000_000).unwrap_or(usual.fails_every),
        content: table
            .word(
                CONTENT,
                &[
                    ("sound", SiiContent::Sound),
                    ("wrong-check", SiiContent::WrongCheck),
                    ("garbage", SiiContent::Garbage),
                    ("unloaded", SiiContent::Unloaded),
                ],
            )
            .unwrap_or(usual.content),
        ..usual
    }
}

fn mailbox(table: &mut Table<'_>) -> MailboxSettings {
    let usual = MailboxSettings::default();
    MailboxSettings {
        delay_ns: table.time(DELAY, 0..=60 * S).unwrap_or(usual.delay_ns),
        delay_every: table.integer(DELAY_EVERY, 1..=1_000_000).unwrap_or(usual.delay_every),
        lose_every: table.integer(LOSE_EVERY, 0..=1_000_000).unwrap_or(usual.lose_every),
        resends: table.flag(RESENDS).unwrap_or(usual.resends),
    }
}

/// The port that it is behind.
fn behind(table: &mut Table<'_>, names: &Names<'_>) -> Option<Behind> {
    table.optional("behind", |table| {
        let place = named(table, SLAVE, names);
        let port = table.integer(PORT, 1..=3);
        Some(Behind { place: place?, port: port? })
    })
}

/// The place of the slave with the name that a key gives.
fn named(table: &mut Table<'_>, key: Key, Names(names): &Names<'_>) -> Option<u16> {
    let known: Vec<&str> = names.iter().map(|(name, _)| *name).collect();
    let hint = format!("the name of a slave of this bus: {}", known.join(", "));
    table.text(key, None, &hint, |text| names.iter().find(|(name, _)| *name == text).map(|(_, place)| *place))
}
