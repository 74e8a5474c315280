//! Telegrams of LinUDP in words.

use fieldbeat_keys::telegram::{Carrier, Front, Telegrams, Way, Words};

use crate::motion::CommandInfo;
use crate::plan::{COUNTS_PER_MM, DRIVE_PORT};
use crate::wire::{MotionBlock, Request, Response, RtcBlock, RtcCommand};

/// Those of this protocol.
pub const TELEGRAMS: &[Telegrams] =
    &[Telegrams { carrier: Carrier::Datagrams(DRIVE_PORT), front: Front::whole, words }];

fn words(bytes: &[u8], way: Way) -> Option<Words> {
    match way {
        Way::ToDrive => Request::parse(bytes).ok().map(|request| requested(&request)),
        Way::FromDrive => Response::parse(bytes).ok().map(|response| answered(&response)),
        Way::Unknown => None,
    }
}

fn requested(request: &Request) -> Words {
    let mut words = Words::new(format_args!("request of blocks {:03x}h", request.response_def.0));
    if let Some(control) = request.control {
        words.field(format_args!("control word {:04x}h", control.0));
    }
    if let Some(motion) = &request.motion {
        motion_command(motion, &mut words);
    }
    if let Some(config) = &request.config {
        real_time_config(config, &mut words);
        words.field(format_args!("{:?}", RtcCommand(config.code)));
    }
    words
}

fn motion_command(motion: &MotionBlock, words: &mut Words) {
    let (id, count) = (motion.header >> 4, motion.header & 0xF);
    let Some(info) = CommandInfo::of(id) else {
        words.field(format_args!("motion command {id:03x}h count {count}"));
        return words.bytes(&motion.parameters);
    };
    words.field(format_args!("motion command {} count {count}", info.name));
    for (field, value) in info.fields.iter().zip(info.values(&motion.parameters)) {
        words.then(" ", format_args!("{}={} {}", field.name, field.kind.user(value), field.kind.unit()));
        words.text.truncate(words.text.trim_end().len());
    }
}

fn real_time_config(config: &RtcBlock, words: &mut Words) {
    let [first, second, third] = config.words;
    let count = config.count();
    words.field(format_args!("real-time config count {count}: {first:04x} {second:04x} {third:04x}"));
}

fn answered(response: &Response) -> Words {
    let mut words = Words::new(format_args!("reply with blocks {:03x}h", response.response_def.0));
    if let Some(status) = response.status {
        words.field(format_args!("status word {:04x}h", status.0));
    }
    if let Some(state) = response.state {
        let name = state.main().name().unwrap_or("unknown state");
        words.field(format_args!("{name} ({:02x}h.{:02x}h)", state.main().0, state.sub()));
    }
    for (name, position) in [("actual", response.actual), ("demand", response.demand)] {
        if let Some(position) = position {
            words.field(format_args!("{name} {} mm", f64::from(position) / COUNTS_PER_MM));
        }
    }
    if let Some(current) = response.current {
        words.field(format_args!("current {} A", f64::from(current) / 1000.0));
    }
    for warning in response.warn.into_iter().flat_map(|warn| warn.names()) {
        words.field(format_args!("warning: {warning}"));
    }
    if let Some(error) = response.error.filter(|error| error.0 != 0) {
        words.field(format_args!("error {:04x}h: {}", error.0, error.name().unwrap_or("unknown")));
    }
    if let Some([a, b, c, d]) = response.monitor {
        words.field(format_args!("monitoring channels {a} {b} {c} {d}"));
    }
    if let Some(config) = &response.config {
        real_time_config(config, &mut words);
        words.field(format_args!("{:?}", config.status()));
    }
    words
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::{ControlWord, ResponseDef};

    #[test]
    fn a_telegram_is_read_by_its_way() {
        let motion = MotionBlock { header: 0x0103, parameters: [0; 30] };
        let request = Request {
            response_def: ResponseDef::CYCLIC,
            control: Some(ControlWord::ON),
            motion: Some(motion),
            ..Request::default()
        };
        let mut bytes = [0; 64];
        let size = request.emit(&mut bytes);
        let text = words(&bytes[..size], Way::ToDrive).unwrap().text;
        assert!(text.starts_with("request of blocks 07fh, control word 003fh, motion command "), "{text}");
        assert!(text.contains(" count 3 ") && text.contains("mm/s"), "{text}");
        // Eight bytes of definitions, and 18 of blocks.
        let mut reply = vec![0, 0, 0, 0, 0x7F, 0, 0, 0, 0x37, 0x44, 3, 8];
        reply.extend(123_456_i32.to_le_bytes());
        reply.extend((-5_i32).to_le_bytes());
        reply.extend([0x0C, 0xFE, 0x10, 0, 0x0B, 0]);
        let text = words(&reply, Way::FromDrive).unwrap().text;
        assert_eq!(
            text,
            "reply with blocks 07fh, status word 4437h, operation enabled (08h.03h), actual 12.3456 mm, demand \
             -0.0005 mm, current -0.5 A, warning: position lag, error 000bh: position lag"
        );
        assert_eq!(words(&reply[..9], Way::FromDrive), None);
        assert_eq!(words(&reply, Way::Unknown), None);
    }
}
