//! What a master did that it must not do, counted by kind.

/// Counts that a correct master leaves at 0 on a wire without faults.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Misuse {
    /// A request or a token without Tsyn of silence before it; it is ignored.
    pub too_early: u64,
    /// Bytes while the answer to a request was to come, or on its way.
    pub interrupted: u64,
    /// A source address that is none, or the slave's own; it is ignored.
    pub source: u64,
    /// A function code that is none; it is ignored.
    pub function: u64,
    /// A frame count bit where there must be none, or none where there must be one; it is ignored.
    pub frame_count: u64,
    /// A repeated request that is not the same as the first one; it is answered from memory all the same.
    pub changed_retry: u64,
    /// A request to all that wants an answer; it gets none.
    pub broadcast: u64,
    /// Service access points that there are not.
    pub access_point: u64,
    /// Data of a wrong length for its service, outputs excepted.
    pub length: u64,
    /// Outputs of a wrong length: it leaves Data_Exchange.
    pub output_length: u64,
    /// A service of a master that has not parametrised the slave, or is not due in its state: Chk_Cfg, Set_Prm of
    /// another master, MSAC1 outside Data_Exchange. Not if the slave lost its master by itself.
    pub state: u64,
    /// A Set_Prm with bits or times that are none.
    pub parameters: u64,
    /// A Global_Control with bits that are none, or that the slave does not know.
    pub control: u64,
    /// Reserved bits of the control word that are set.
    pub control_word: u64,
    /// A job in the parameter channel that was replaced before its answer, or is none.
    pub job: u64,
    /// A DRIVECOM job that changed without its handshake bit.
    pub handshake: u64,
    /// An acyclic request while another one of its channel is not answered, or that is malformed.
    pub acyclic: u64,
}

impl Misuse {
    /// All of them.
    pub fn total(&self) -> u64 {
        let Misuse {
            too_early,
            interrupted,
            source,
            function,
            frame_count,
            changed_retry,
            broadcast,
            access_point,
            length,
            output_length,
            state,
            parameters,
            control,
            control_word,
            job,
            handshake,
            acyclic,
        } = *self;
        too_early
            + interrupted
            + source
            + function
            + frame_count
            + changed_retry
            + broadcast
            + access_point
            + length
            + output_length
            + state
            + parameters
            + control
            + control_word
            + job
            + handshake
            + acyclic
    }
}
