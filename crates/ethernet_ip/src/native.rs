//! The native process data of a MOONS' drive: unscaled and complete, for the application.

use super::plan::{Layout, Version};
use super::wire::assembly::{Inputs, IoCode, Letters, Outputs, command, input_size};
use fieldbeat_core::bus::native::{self, Image, MOST_INPUTS};
use fieldbeat_core::time::Time;
use fieldbeat_core::{parts, word};

/// The longest input assembly, bytes.
const ROOM: usize = input_size(Version::V2);

/// The application's end: [`Axis::native`](fieldbeat_core::axis::Axis::native) with this type. `inputs` are the newest
/// [`NativeInputs`]; `write` queues a [`NativeOutput`], or returns it if the queue is full.
pub type Native = native::Native<NativeInputs, NativeOutput>;

/// The station's end.
pub(super) type NativePort = native::NativePort<NativeOutput>;

/// All that the drive's last accepted packet carried.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NativeInputs {
    /// When it was taken in.
    pub at: Time,
    /// Native mode ran when the packet before it was built: outputs written from now on go out.
    pub running: bool,
    /// The number of outputs of the application that have begun in this and earlier native modes.
    pub begun: u32,
    /// The input assembly; `None` before the first packet.
    pub inputs: Option<Inputs>,
}

/// An output of the application in native mode, in order.
///
/// While the master owns the control word (`NativeOwner::Master`) it is a command: its bit is held until the drive has
/// it, idle follows, and then the next one begins. One with a bit of power (enable, disable, alarm reset) fails native
/// mode. While the application owns it (`NativeOwner::Application`) the outputs are sent as they are, each of them in
/// one packet at least, and stay until the next one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NativeOutput {
    /// The output assembly.
    pub outputs: Outputs,
}

/// A profile of a native move, in the drive's own units.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NativeProfile {
    /// VE: 1/240 rev/s, 1 ... 32000.
    pub velocity: u32,
    /// AC: 1/6 rev/s², 1 ... 32000.
    pub acceleration: u32,
    /// DE: 1/6 rev/s², 1 ... 32000.
    pub deceleration: u32,
    /// DI: motor steps; its sign is the direction.
    pub distance: i32,
}

impl NativeOutput {
    fn new(command: u32) -> NativeOutput {
        NativeOutput { outputs: Outputs { command, ..Outputs::default() } }
    }

    fn moving(command: u32, profile: NativeProfile, first: Option<IoCode>, second: Option<IoCode>) -> Self {
        let code = |io: Option<IoCode>| io.map_or(0, |io| io.code().into());
        let NativeProfile { velocity, acceleration, deceleration, distance } = profile;
        NativeOutput {
            outputs: Outputs {
                command,
                velocity,
                acceleration,
                deceleration,
                distance,
                register_1: code(first),
                register_2: code(second),
                ..Outputs::default()
            },
        }
    }

    /// FS: moves until an input has this condition, then stops within the distance.
    pub fn to_sensor(sensor: IoCode, profile: NativeProfile) -> NativeOutput {
        NativeOutput::moving(command::MOVE_TO_SENSOR, profile, Some(sensor), None)
    }

    /// FD: moves with two sensors: it changes its speed at the first one and stops behind the second one.
    pub fn to_two_sensors(first: IoCode, second: IoCode, profile: NativeProfile) -> NativeOutput {
        NativeOutput::moving(command::MOVE_TO_TWO_SENSORS, profile, Some(first), Some(second))
    }

    /// FY: the same as [`to_sensor`](Self::to_sensor), but no farther than the safety distance (DC).
    pub fn to_sensor_safely(sensor: IoCode, profile: NativeProfile) -> NativeOutput {
        NativeOutput::moving(command::MOVE_TO_SENSOR_SAFELY, profile, Some(sensor), None)
    }

    /// FM: the same as [`to_sensor`](Self::to_sensor), with the input masked for a distance (DC).
    pub fn to_sensor_masked(sensor: IoCode, profile: NativeProfile) -> NativeOutput {
        NativeOutput::moving(command::MOVE_TO_SENSOR_MASKED, profile, Some(sensor), None)
    }

    /// FO: a relative move that sets an output on its way (DC).
    pub fn with_output(output: IoCode, profile: NativeProfile) -> NativeOutput {
        NativeOutput::moving(command::MOVE_WITH_OUTPUT, profile, Some(output), None)
    }

    /// FC: a relative move that changes its speed on its way: DC and VC are set before, by [`host`](Self::host).
    pub fn with_speed_change(profile: NativeProfile) -> NativeOutput {
        NativeOutput::moving(command::MOVE_WITH_SPEED_CHANGE, profile, None, None)
    }

    /// FE: follows the encoder until an input has this condition.
    pub fn follow_encoder(until: IoCode, profile: NativeProfile) -> NativeOutput {
        NativeOutput::moving(command::FOLLOW_ENCODER, profile, Some(until), None)
    }

    /// QX: executes a segment of the Q program, 1 ... 12; `None` for any other number.
    pub fn execute_segment(segment: u8) -> Option<NativeOutput> {
        let mut output = NativeOutput::new(command::EXECUTE_SEGMENT);
        output.outputs.register_1 = segment.into();
        (1..=12).contains(&segment).then_some(output)
    }

    /// GC: commands a current, 0.01 A, -2000 ... 2000; `None` beyond. Step-servos only.
    pub fn current(centiamperes: i32) -> Option<NativeOutput> {
        let mut output = NativeOutput::new(command::CURRENT);
        output.outputs.current = centiamperes;
        (-2_000..=2_000).contains(&centiamperes).then_some(output)
    }

    /// A host command, by its two letters ("SO"), with its registers as the manual lists them; `None` if these are not
    /// two capital letters.
    pub fn host(letters: &str, register_1: u32, register_2: u32) -> Option<NativeOutput> {
        let letters = Letters::new(letters)?;
        let mut output = NativeOutput::new(command::HOST);
        (output.outputs.letters, output.outputs.register_1, output.outputs.register_2) =
            (letters, register_1, register_2);
        Some(output)
    }
}

word! {
    Letters: |letters: Letters| letters.0.into(), |word| Letters(word as u16);
}

parts! {
    NativeOutput { outputs }
    Outputs {
        command, jog_speed, jog_acceleration, jog_deceleration, velocity, acceleration, deceleration, distance, current,
        letters, register_1, register_2
    }
}

/// Publishes an input assembly of this kind.
#[inline(never)] // Inlined, it costs more.
pub(super) fn publish(port: &mut NativePort, at: Time, begun: u32, kind: (Version, Layout), data: &[u8]) {
    let kind = match kind {
        (Version::V1, _) => 1,
        (Version::V2, Layout::Manual) => 2,
        (Version::V2, Layout::Page) => 3,
    };
    let added = u64::from(begun) | kind << KIND;
    match <&[u8; ROOM]>::try_from(data) {
        // The usual one.
        Ok(data) => port.publish_array(at, added, data),
        Err(_) => port.publish(at, added, data),
    }
}

/// The place of the kind behind the number of outputs.
const KIND: u32 = 32;

impl From<Image> for NativeInputs {
    fn from(image: Image) -> NativeInputs {
        let (bytes, length) = image.bytes::<MOST_INPUTS>();
        let inputs = match image.added() >> KIND {
            1 => Inputs::parse(&bytes[..length], Version::V1, Layout::Manual),
            2 => Inputs::parse(&bytes[..length], Version::V2, Layout::Manual),
            3 => Inputs::parse(&bytes[..length], Version::V2, Layout::Page),
            _ => None,
        };
        NativeInputs { at: image.at(), running: image.flag(), begun: image.added() as u32, inputs }
    }
}

const _: () = assert!(ROOM <= MOST_INPUTS, "the longest assembly is published whole");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_application_reads_what_was_published() {
        let (application, mut port): (Native, NativePort) = native::native();
        assert_eq!(application.inputs().inputs, None);
        port.runs(true);
        for (version, length) in [(Version::V1, 30), (Version::V2, 56)] {
            let data: Vec<u8> = (1..=length).collect();
            publish(&mut port, Time(7), 1, (version, Layout::Manual), &data);
            let read = application.inputs();
            assert_eq!((read.at, read.running, read.begun), (Time(7), true, 1));
            assert_eq!(read.inputs, Inputs::parse(&data, version, Layout::Manual), "{version:?}");
        }
    }

    #[test]
    fn named_outputs_have_their_codes_where_the_manual_has_them() {
        let io = |text: &str| text.parse::<IoCode>().unwrap();
        let profile = NativeProfile { velocity: 1200, acceleration: 600, deceleration: 600, distance: -5 };
        let two = NativeOutput::to_two_sensors(io("2L"), io("3R"), profile).outputs;
        assert_eq!((two.command, two.register_1, two.register_2, two.distance), (0x40, 0x4CB2, 0x52B3, -5));
        let host = NativeOutput::host("SO", 0x4CB1, 0).unwrap().outputs;
        assert_eq!((host.command, host.letters.0, host.register_1), (0x4_0000, 0x534F, 0x4CB1));
        assert_eq!(NativeOutput::host("so", 0, 0), None);
        assert!(NativeOutput::execute_segment(12).is_some() && NativeOutput::execute_segment(13).is_none());
        assert_eq!(NativeOutput::current(2_001), None);
        assert_eq!(NativeOutput::current(-5).unwrap().outputs.current, -5);
    }
}
