//! Counters that only EtherNet/IP has.

use fieldbeat_core::own_counters;

own_counters! {
    pub(super) enum Own, OWN {
        Unchanged = "unchanged": "packets with the data of the one before",
        NoPacket = "no_packet": "datagrams that are no class 1 packet",
        WrongLength = "wrong_length": "packets with more or less data than agreed",
        WrongSource = "wrong_source": "packets of its connection from another address",
        WrongConnection = "wrong_connection": "packets of a connection that is not open",
        Leap = "leap": "packets whose number was too far ahead of the last one",
        Early = "early": "packets that came before their connection was known to be open",
        Reopened = "reopened": "connections opened again",
        TimedOut = "timed_out": "connections on which the drive's packets ended",
    }
}
