//! Counters that only Modbus has.

use fieldbeat_core::own_counters;

own_counters! {
    pub enum Own, OWN {
        Exceptions = "exceptions": "requests refused by an exception",
        WrongUnit = "wrong_unit": "replies with a wrong unit id",
        WrongFunction = "wrong_function": "replies with a wrong function",
        WrongLength = "wrong_length": "replies with a wrong length",
        Garbage = "garbage": "receptions that are not Modbus, each ends its connection",
        CutOff = "cut_off": "connections that ended within a reply",
        Closed = "closed": "connections that ended between replies",
        GivenUp = "given_up": "connections given up by the master",
        Reopened = "reopened": "connections opened again",
        Pieces = "pieces": "requests that the wire took in pieces",
        WrittenShort = "written_short": "blocks that the drive wrote in part only",
        NotTaken = "not_taken": "written values that read back as another one",
        SecondReplies = "second_replies": "second replies to requests of a handshake",
        NoReadWrite = "no_fc23": "changes from FC23 to FC16 and FC3, since the drive does not answer FC23",
    }
}
