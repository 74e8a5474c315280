//! Counters that only LinUDP has.

use fieldbeat_core::own_counters;

own_counters! {
    pub enum Own, OWN {
        Behind = "behind": "replies in a later cycle than their request, within reply_within",
    }
}
