//! Where the log is in a recording, and what describes its machine there.

use std::collections::BTreeMap;

use fieldbeat_core::cycle::REVISION;

use fieldbeat_telemetry::log::MachineOf;

/// The version of the log's layout, and of the looks that the loop makes.
pub const LAYOUT: &str = "3";
/// The topic of the log. Each message has some words of it, which end with a whole cycle: a message of Protocol Buffers
/// like all others of a recording, since some readers refuse a file in which a channel has no schema.
pub const TOPIC: &str = "/wire";
/// Where what passes connections is while the link thread has them: handshakes and sessions. A replay does without.
pub const LINK_TOPIC: &str = "/link";
/// The metadata before the log, and before all messages ...
pub const BEGIN: &str = "fieldbeat.wire";
/// ... and that behind it, with the first cycle that it has not ...
pub const END: &str = "fieldbeat.wire.end";
/// ... under this key, if there was no room for it.
pub const CUT_AT: &str = "cut_at";

/// No record of a recording is longer: a chunk ends after 8 MiB and one more message, and the ring of the log has 64.
/// Lengths beyond come from broken files.
pub(crate) const LONGEST_RECORD: usize = 128 << 20;

/// The values of the first metadata.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Begin {
    /// The version of the log's layout.
    pub layout: String,
    /// The program that wrote it: its version, with the commit that it was built from where that is known.
    pub version: String,
    /// The revision of its loop.
    pub revision: u32,
    /// The plan, resolved; `None`: a record of before it was kept.
    pub plan: Option<String>,
    /// Where the plan comes from.
    pub machine: MachineOf,
    /// There is an in-loop task.
    pub has_task: bool,
    /// It begins with the run. The end of one cannot be repeated.
    pub is_whole: bool,
}

/// The key that says that a log does not begin with the run.
const WINDOW: &str = "window";

impl Begin {
    /// That of a log, by a program of this version.
    pub fn new(version: &str, machine: MachineOf, plan: String, has_task: bool) -> Begin {
        let (layout, version) = (LAYOUT.to_owned(), version.to_owned());
        Begin { layout, version, revision: REVISION, plan: Some(plan), machine, has_task, is_whole: true }
    }

    /// As metadata.
    pub fn to_map(&self) -> BTreeMap<String, String> {
        let mut map = BTreeMap::new();
        let mut put = |key: &str, value: String| map.insert(key.to_owned(), value);
        put("layout", self.layout.clone());
        put("version", self.version.clone());
        put("revision", self.revision.to_string());
        if let Some(plan) = &self.plan {
            put("plan", plan.clone());
        }
        put("task", self.has_task.to_string());
        if !self.is_whole {
            put(WINDOW, true.to_string());
        }
        match &self.machine {
            MachineOf::Code => put("machine", "code".into()),
            MachineOf::Configuration { file, text } => {
                put("file", file.clone());
                put("configuration", text.clone());
                put("machine", "configuration".into())
            }
            MachineOf::Demo { drives, period_ns, place } => {
                put("drives", drives.to_string());
                put("period_ns", period_ns.to_string());
                put("place", place.to_string());
                put("machine", "demo".into())
            }
        };
        map
    }

    /// The values of a map; `None`: something is missing.
    pub fn of_map(map: &BTreeMap<String, String>) -> Option<Begin> {
        let text = |key: &str| map.get(key).cloned();
        // For a line on a terminal, whoever wrote the file.
        let name = |key: &str| map.get(key).map(|name| name.escape_debug().to_string());
        let machine = match map.get("machine")?.as_str() {
            "configuration" => MachineOf::Configuration { file: name("file")?, text: text("configuration")? },
            "demo" => MachineOf::Demo {
                drives: map.get("drives")?.parse().ok()?,
                period_ns: map.get("period_ns")?.parse().ok()?,
                place: map.get("place")?.parse().ok()?,
            },
            _ => MachineOf::Code,
        };
        Some(Begin {
            layout: name("layout")?,
            version: name("version")?,
            // Before it was kept, it was the first one.
            revision: map.get("revision").map_or(Some(1), |revision| revision.parse().ok())?,
            plan: text("plan"),
            machine,
            has_task: map.get("task")? == "true",
            is_whole: !map.contains_key(WINDOW),
        })
    }
}

/// The words of a message: the bytes of its only field, little-endian. `None`: it is none.
pub fn words(message: &[u8]) -> Option<Vec<u64>> {
    /// Field 1, of so many bytes as follow.
    const KEY: u8 = 1 << 3 | 2;
    let [KEY, rest @ ..] = message else { return None };
    let (mut rest, mut length) = (rest, 0_usize);
    for shift in (0..usize::BITS).step_by(7) {
        let (byte, behind) = rest.split_first()?;
        rest = behind;
        length |= usize::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            break;
        }
    }
    let (words, odd) = rest.as_chunks();
    (length == rest.len() && odd.is_empty())
        .then(|| words.iter().map(|word| u64::from_le_bytes(*word)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_words_of_a_message_are_whole_or_it_is_none() {
        for count in [1_usize, 15, 16, 3_000] {
            let mut message = vec![10];
            let mut length = 8 * count;
            while length >= 128 {
                message.push(length as u8 | 128);
                length >>= 7;
            }
            message.push(length as u8);
            message.extend((0..count as u64).flat_map(u64::to_le_bytes));
            assert_eq!(words(&message).unwrap(), (0..count as u64).collect::<Vec<_>>());
            let last = message.len() - 1;
            for broken in
                [&message[..last], &message[..1], &message[1..], &[message.clone(), vec![0; 8]].concat()]
            {
                assert_eq!(words(broken), None, "{count} words");
            }
        }
        for broken in [
            &[][..],
            &[10, 7, 1, 2, 3, 4, 5, 6, 7],
            &[255; 20],
            &[10, 255, 255, 255, 255, 255, 255, 255, 255, 255, 255],
        ] {
            assert_eq!(words(broken), None);
        }
    }

    #[test]
    fn a_machine_description_round_trips_through_its_map() {
        let configuration = MachineOf::Configuration { file: "m.toml".into(), text: "[cycle]\n".into() };
        let demo = MachineOf::Demo { drives: 8, period_ns: 1_000_000, place: 2 };
        for machine in [MachineOf::Code, configuration, demo] {
            let begin = Begin::new("1.2.3 (abc)", machine, "a plan".into(), true);
            assert_eq!(Begin::of_map(&begin.to_map()), Some(begin.clone()));
            for key in begin.to_map().keys() {
                let mut map = begin.to_map();
                map.remove(key);
                let without = Begin::of_map(&map);
                match &**key {
                    // Records of before have neither of them.
                    "revision" => assert_eq!(without.unwrap().revision, 1),
                    "plan" => assert_eq!(without.unwrap().plan, None),
                    _ => assert_eq!(without, None, "without {key}"),
                }
            }
            let mut broken = begin.to_map();
            broken.insert("revision".into(), "one".into());
            assert_eq!(Begin::of_map(&broken), None);
        }
    }
}
