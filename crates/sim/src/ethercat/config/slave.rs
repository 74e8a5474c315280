//! The keys of `simulate` that every slave has, drive or not.

use crate::ethercat::{
    Behind, ClockKind, Left, MailboxSettings, Model, SiiContent, SiiSettings, SlaveSettings,
};
use fieldbeat_core::time::S;
use fieldbeat_ethercat::EthercatPlan;
use fieldbeat_keys::table::Table;

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
    let left = table.word("left", &words);
    SlaveSettings {
        model: device.then(|| table.word("type", &Model::ALL)).flatten(),
        serial: device.then(|| table.integer("serial", 0..=u32::MAX.into(), "the serial number")).flatten(),
        alias: table.integer("alias", 0..=u16::MAX.into(), "the configured station alias; 0: none"),
        identification: table.integer(
            "identification",
            0..=u16::MAX.into(),
            "what it answers to a request for its identification",
        ),
        emulated: table.flag("emulated"),
        exact_managers: table.flag("exact_managers").unwrap_or_default(),
        output_control: table.integer(
            "output_control",
            0..=0xFF,
            "the control byte of its outputs, like 0x24",
        ),
        clock: table.word(
            "clock",
            &[("long", ClockKind::Long), ("short", ClockKind::Short), ("none", ClockKind::None)],
        ),
        fmmus: table.integer("fmmus", 0..=32, "the number of its FMMUs"),
        sii: table.table("sii", sii),
        mailbox: table.table("mailbox", mailbox),
        behind: behind(table, names),
        wired_to: device.then(|| named(table, "wired_to", names)).flatten(),
        left: left.map(|(unwatched, al)| Left { unwatched, ..Left::by_another(place, al) }),
    }
}

fn sii(table: &mut Table<'_>) -> SiiSettings {
    let usual = SiiSettings::default();
    SiiSettings {
        owned_by_slave: table.flag("owned_by_slave").unwrap_or(usual.owned_by_slave),
        read_in_preop: table.flag("read_in_preop").unwrap_or(usual.read_in_preop),
        eight: table.flag("eight_bytes").unwrap_or(usual.eight),
        busy_ns: table.time("busy", 0..=S, "the time of a read").unwrap_or(usual.busy_ns),
        loading_ns: table
            .time("loading", 0..=60 * S, "for how long it is busy after power-on")
            .unwrap_or(usual.loading_ns),
        slips: table.flag("slips").unwrap_or(usual.slips),
        fails_every: table
            .integer("fails_every", 0..=1_000_000, "of so many reads one fails; 0: none")
            .unwrap_or(usual.fails_every),
        content: table
            .word(
                "content",
                &[
                    ("sound", SiiContent::Sound),
                    ("wrong-check", SiiContent::WrongCheck),
                    ("garbage", SiiContent::Garbage),
                    ("unloaded", SiiContent::Unloaded),
                ],
            )
            .unwrap_or(usual.content),
    }
}

fn mailbox(table: &mut Table<'_>) -> MailboxSettings {
    let usual = MailboxSettings::default();
    MailboxSettings {
        delay_ns: table.time("delay", 0..=60 * S, "how much later it answers").unwrap_or(usual.delay_ns),
        delay_every: table
            .integer("delay_every", 1..=1_000_000, "of so many answers one is late")
            .unwrap_or(usual.delay_every),
        lose_every: table
            .integer("lose_every", 0..=1_000_000, "of so many answers one is lost; 0: none")
            .unwrap_or(usual.lose_every),
        resends: table.flag("resends").unwrap_or(usual.resends),
    }
}

/// The port that it is behind.
fn behind(table: &mut Table<'_>, names: &Names<'_>) -> Option<Behind> {
    let given = table.gives("behind");
    table.table("behind", |table| {
        if given {
            table.require("slave", "the name of the slave in front of it");
            table.require("port", "the port there that it is connected to, 1 to 3");
        }
        let place = named(table, "slave", names);
        let port = table.integer("port", 1..=3, "the port there that it is connected to");
        Some(Behind { place: place?, port: port? })
    })
}

/// The place of the slave with the name that a key gives.
fn named(table: &mut Table<'_>, key: &'static str, Names(names): &Names<'_>) -> Option<u16> {
    let known: Vec<&str> = names.iter().map(|(name, _)| *name).collect();
    let hint = format!("the name of a slave of this bus: {}", known.join(", "));
    table.text(key, None, &hint, |text| names.iter().find(|(name, _)| *name == text).map(|(_, place)| *place))
}
