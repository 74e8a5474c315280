//! The values in the assemblies of a MOONS' drive, as a recording shows them, in its own integers.

use super::plan::{Layout, MoonsDrive, Version};
use super::wire::assembly::{Inputs, OUTPUT_SIZE, input_size};
use fieldbeat_core::bus::native::{NativeField, NativeLayout};

type Input = (&'static str, fn(&Inputs) -> Option<i64>);

/// Those of all input assemblies.
const INPUTS: [Input; 14] = [
    ("status", |inputs| Some(inputs.status.into())),
    ("alarm", |inputs| Some(inputs.alarm.into())),
    ("voltage", |inputs| Some(inputs.voltage.into())),
    ("current", |inputs| Some(inputs.current.into())),
    ("temperature", |inputs| Some(inputs.temperature.into())),
    ("encoder", |inputs| Some(inputs.encoder.into())),
    ("absolute_position", |inputs| Some(inputs.absolute.into())),
    ("position_error", |inputs| Some(inputs.position_error?.into())),
    ("velocity", |inputs| Some(inputs.velocity.into())),
    ("extended_inputs", |inputs| Some(inputs.extended_inputs.into())),
    ("main_inputs", |inputs| Some(inputs.main_inputs.into())),
    ("outputs", |inputs| Some(inputs.outputs?.into())),
    ("analog_1", |inputs| Some(inputs.analog?[0].into())),
    ("analog_2", |inputs| Some(inputs.analog?[1].into())),
];

/// The elements of the output assembly, in their order, and whether each is signed.
const OUTPUTS: [(&str, bool); 12] = [
    ("command", false),
    ("jog_speed", true),
    ("jog_acceleration", false),
    ("jog_deceleration", false),
    ("velocity", false),
    ("acceleration", false),
    ("deceleration", false),
    ("distance", true),
    ("current", true),
    ("letters", false),
    ("register_1", false),
    ("register_2", false),
];

/// The values of `drive`.
pub(super) fn layout(drive: &MoonsDrive) -> NativeLayout {
    let layout = drive.layout;
    let input =
        |(name, value): Input| NativeField::new(name, move |assembly| value(&inputs(assembly, layout)?));
    let output = |(place, (name, signed)): (usize, (&str, bool))| {
        NativeField::new(name, move |assembly| {
            let element = u32::from_le_bytes(*assembly.as_chunks().0.get(place)?);
            Some(if signed { (element as i32).into() } else { element.into() })
        })
    };
    NativeLayout {
        inputs: INPUTS.into_iter().map(input).collect(),
        outputs: OUTPUTS.into_iter().enumerate().map(output).collect(),
        most: input_size(Version::V2) + OUTPUT_SIZE,
    }
}

/// The size shows which assembly it is.
fn inputs(assembly: &[u8], layout: Layout) -> Option<Inputs> {
    [Version::V1, Version::V2].into_iter().find_map(|version| Inputs::parse(assembly, version, layout))
}
