//! Fields and keys have the names of the list of signals: no type compares them.

use prost_reflect::DescriptorPool;

use super::super::messages;
use super::super::schema::Table;
use crate::Summary;
use fieldbeat_telemetry::signals::{END, JITTER, KEPT_OF_DRIVE, Kept, OF_AXIS, OF_CYCLE, TIME, WAKE};

/// The fields of a message.
fn fields<T>(of: &Table<T>) -> Vec<String> {
    let pool = DescriptorPool::decode(&*of.descriptor()).unwrap();
    let message = pool.get_message_by_name(&of.full_name()).unwrap();
    message.fields().map(|field| field.name().to_owned()).collect()
}

#[test]
fn fields_of_recordings_and_keys_of_summaries_have_the_names_of_their_signals() {
    let (axis, cycle) = (fields(&messages::axis()), fields(&messages::cycle()));
    // A recording has the link in place of whether it is up.
    for of in OF_AXIS.iter().filter(|of| of.unit("") != TIME && of.name != "online") {
        assert!(axis.contains(&of.name.replace(' ', "_")), "{of:?}");
    }
    for of in OF_CYCLE.iter().filter(|of| ![WAKE.name, JITTER.name, END.name].contains(&of.name)) {
        let unit = if of.unit("") == TIME { "_ns" } else { "" };
        assert!(cycle.contains(&format!("{}{unit}", of.name)), "{of:?}");
    }
    let summary = Summary::from(&fieldbeat_testing::runs::run("x", 10));
    let summary = serde_json::to_value(summary).unwrap();
    let key = |of: Kept| of.file.replace('-', "_") + "_ns";
    for key in [WAKE, JITTER].map(key) {
        assert!(cycle.contains(&key) && summary[&key].is_object(), "{key}");
    }
    for key in KEPT_OF_DRIVE.map(|(of, ..)| key(of)) {
        assert!(axis.contains(&key) && summary["drives"][0][&key].is_object(), "{key}");
    }
}
