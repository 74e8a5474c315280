//! The native process data of a LinUDP drive: unscaled and complete, for the application.

use super::motion::MotionCommand;
use super::wire::{ControlWord, RESPONSE_MAX, Response, RtcBlock};
use fieldbeat_core::bus::native::{self, Image, MOST_INPUTS};
use fieldbeat_core::packed::{Bytes, Part};
use fieldbeat_core::time::Time;
use fieldbeat_core::{parts, word};

/// The application's end: [`Axis::native`](fieldbeat_core::axis::Axis::native) with this type. `inputs` are the newest
/// [`NativeInputs`]; `write` queues a [`NativeOutput`], or returns it if the queue is full.
pub type Native = native::Native<NativeInputs, NativeOutput>;

/// The station's end.
pub(super) type NativePort = native::NativePort<NativeOutput>;

/// Everything that the drive's last accepted reply carried.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NativeInputs {
    /// When it was taken in.
    pub at: Time,
    /// Native mode ran when the request of this reply was built: outputs written from now on go out.
    pub running: bool,
    /// The telegram. Blocks that were not requested are `None`; with [`ReplyTag::Definition`](super::plan::ReplyTag)
    /// error code, warn word and monitoring channels come in turn.
    pub response: Response,
}

/// An output of the application in native mode: at most one per exchange, in order. Each one goes out: if an
/// exchange is passed over or the system refuses to send it, the output goes with the next one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NativeOutput {
    /// The control word, from here on; used only with `NativeOwner::Application`.
    pub control: Option<ControlWord>,
    /// A motion command. It is sent with the next count and repeated until its echo comes, with another count if
    /// the echo does not come; after 4 counts native mode fails. The next output with a motion waits until then,
    /// and so do later ones. Outside of operation a drive echoes nothing: there the next motion replaces it. The
    /// command that resets the firmware (00Fx) fails native mode: with these counts the drive would restart again
    /// and again.
    pub motion: Option<MotionCommand>,
    /// A real-time-config block, count included, sent in one exchange only.
    pub config: Option<RtcBlock>,
}

impl From<Image> for NativeInputs {
    fn from(image: Image) -> NativeInputs {
        let (bytes, length) = image.bytes::<MOST_INPUTS>();
        // Only accepted telegrams are published, so this fails before the first reply only.
        let response = Response::parse(&bytes[..length]).unwrap_or_default();
        NativeInputs { at: image.at(), running: image.flag(), response }
    }
}

word! {
    ControlWord: |control: ControlWord| control.0.into(), |word| ControlWord(word as u16);
}

parts! {
    NativeOutput { control, motion, config }
    RtcBlock { tag, code, words }
}

impl Part for MotionCommand {
    const WORDS: usize = 1 + Bytes::<30>::WORDS;

    fn put(&self, words: &mut [u64]) {
        self.id.put(words);
        Bytes(self.parameters).put(&mut words[1..]);
    }

    fn take(words: &[u64]) -> MotionCommand {
        let Bytes(parameters) = Bytes::take(&words[1..]);
        MotionCommand { id: u16::take(words), parameters }
    }
}

const _: () = assert!(RESPONSE_MAX <= MOST_INPUTS, "the longest telegram is published whole");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_received_bytes_are_readable_as_native_inputs() {
        let mut random = fastrand::Rng::with_seed(7);
        let (native, mut port): (Native, NativePort) = native::native();
        assert_eq!(native.inputs(), NativeInputs::default());
        for definition in 0..0x200_u32 {
            let mut bytes = [0; 64];
            random.fill(&mut bytes);
            bytes[..4].copy_from_slice(&(definition >> 6 & 7).to_le_bytes());
            bytes[4..8].copy_from_slice(&definition.to_le_bytes());
            let response = Response::parse(&bytes).unwrap();
            let running = definition & 1 != 0;
            port.runs(running);
            port.publish(Time(5), 0, &bytes[..response.size()]);
            assert_eq!(native.inputs(), NativeInputs { at: Time(5), running, response });
        }
    }
}
