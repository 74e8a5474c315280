//! Values that are not written as their fields are: states by their names, counters by their keys.

use serde::{Serialize, Serializer};

use crate::bus::ProtocolCounters;
use crate::drive::at_end::{Condition, StopRequest};

impl Serialize for Condition {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl Serialize for StopRequest {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl Serialize for ProtocolCounters {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(counter, count)| (counter.key, count)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::OwnCounter;
    use crate::bus::counters::OWN_COUNTERS;

    #[test]
    fn own_counters_above_zero_are_printed_and_all_are_in_the_object() {
        let own = ["exceptions", "opened", "closed"].map(|key| OwnCounter { key, what: key });
        let mut counters = [0; OWN_COUNTERS];
        (counters[0], counters[2]) = (3, u64::MAX);
        let shown = ProtocolCounters::of(&own, counters);
        assert_eq!(shown.to_string(), format!("exceptions: 3; closed: {}", u64::MAX));
        let json = format!(r#"{{"exceptions":3,"opened":0,"closed":{}}}"#, u64::MAX);
        assert_eq!(serde_json::to_string(&shown).unwrap(), json);
        let none = ProtocolCounters::of(&[], counters);
        assert_eq!((none.are_any(), serde_json::to_string(&none).unwrap()), (false, "{}".to_owned()));
    }
}
