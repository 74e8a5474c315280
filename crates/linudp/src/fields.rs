//! The values in the telegrams of a LinUDP drive, as a recording shows them. Which of them a telegram has is in its own
//! definitions.

use super::wire::{REQUEST_MAX, RESPONSE_MAX, Request, Response, RtcBlock};
use fieldbeat_core::bus::native::{NativeField, NativeLayout};

/// Motion commands have so many parameters of 32 bits at most.
const MOTION_PARAMETERS: usize = 7;

/// The values of all telegrams.
pub(super) fn layout() -> NativeLayout {
    let mut inputs = vec![
        input("status_word", |reply| Some(reply.status?.0.into())),
        input("state_var", |reply| Some(reply.state?.0.into())),
        input("actual_position", |reply| Some(reply.actual?.into())),
        input("demand_position", |reply| Some(reply.demand?.into())),
        input("current", |reply| Some(reply.current?.into())),
        input("warn_word", |reply| Some(reply.warn?.0.into())),
        input("error_code", |reply| Some(reply.error?.0.into())),
    ];
    for channel in 0..4 {
        let name = format!("monitoring_channel_{}", channel + 1);
        inputs.push(input(name, move |reply| Some(reply.monitor?.get(channel).copied()?.into())));
    }
    let mut outputs = vec![
        output("control_word", |request| Some(request.control?.0.into())),
        output("motion_header", |request| Some(request.motion?.header.into())),
    ];
    for place in 0..MOTION_PARAMETERS {
        outputs.push(output(format!("motion_parameter_{}", place + 1), move |request| {
            let motion = request.motion?;
            let (parameters, _) = motion.parameters.as_chunks();
            Some(i32::from_le_bytes(*parameters.get(place)?).into())
        }));
    }
    for (name, value) in CONFIG {
        inputs.push(input(name, move |reply| Some(value(&reply.config?))));
        outputs.push(output(name, move |request| Some(value(&request.config?))));
    }
    NativeLayout { inputs, outputs, most: RESPONSE_MAX.next_multiple_of(8) + REQUEST_MAX }
}

type OfConfig = (&'static str, fn(&RtcBlock) -> i64);

/// The values of a block of the real-time-config channel.
const CONFIG: [OfConfig; 5] = [
    ("config_count", |block| block.count().into()),
    // The command; in a reply the parameter status.
    ("config_code", |block| block.code.into()),
    ("config_word_1", |block| block.words[0].into()),
    ("config_word_2", |block| block.words[1].into()),
    ("config_word_3", |block| block.words[2].into()),
];

fn input(
    name: impl Into<String>,
    value: impl Fn(&Response) -> Option<i64> + Send + Sync + 'static,
) -> NativeField {
    NativeField::new(name, move |telegram| value(&Response::parse(telegram).ok()?))
}

fn output(
    name: impl Into<String>,
    value: impl Fn(&Request) -> Option<i64> + Send + Sync + 'static,
) -> NativeField {
    NativeField::new(name, move |telegram| value(&Request::parse(telegram).ok()?))
}
