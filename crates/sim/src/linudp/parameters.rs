//! The parameters' values: in flash (ROM), in memory (RAM), and those in use by the software.
//!
//! Knows the rules of access, no wire block, and nothing of a parameter's effect.
//!
//! | memory | written by | takes effect |
//! |---|---|---|
//! | ROM | write ROM, write both, defaults | becomes RAM at the next restart of the drive |
//! | RAM, live parameter | write RAM, write both, motion command 002x | at once |
//! | RAM, other parameter | write RAM, write both | when the software is started next (36h); a restart of the drive loses it |
//!
//! The manuals state the first two. The third is chosen: RAM of a parameter that is not live can be written, and
//! then it has to take effect at some time.

use super::codec::channel::{Refusal, command, usage};
use super::settings::LinMotSettings;
use super::upids::{self, PARAMETERS, Parameter};
use fieldbeat_core::time::US;

/// The values of one parameter.
#[derive(Clone, Copy, Debug)]
struct Value {
    rom: i64,
    ram: i64,
    /// The value in use by the software.
    used: i64,
}

/// The values of all parameters, in the order of [`PARAMETERS`].
#[derive(Debug)]
pub(super) struct Parameters {
    values: Box<[Value]>,
    /// Values narrower than 32 bits carry their sign in the bits above.
    extend: bool,
}

impl Parameters {
    /// As commissioned: the defaults, and in ROM the values of the plan.
    pub(super) fn new(plan: &LinMotSettings) -> Parameters {
        let values = PARAMETERS.iter().map(|p| Value { rom: p.default, ram: p.default, used: p.default });
        let mut parameters = Parameters { values: values.collect(), extend: plan.extend_sign };
        for (upid, value) in [
            (upids::HOME_POSITION, plan.home_position.into()),
            (upids::SLIDER_HOME_POSITION, plan.home_position.into()),
            (upids::MINIMUM_POSITION, plan.range.0.into()),
            (upids::MAXIMUM_POSITION, plan.range.1.into()),
            (upids::STREAM_PERIOD, i64::try_from(plan.stream_period_ns / US).unwrap_or(i64::MAX)),
        ] {
            if let Some((parameter, values)) = parameters.entry(upid) {
                values.rom = value.clamp(parameter.low, parameter.high);
            }
        }
        parameters.load();
        parameters
    }

    /// The drive restarts: RAM is loaded from ROM.
    pub(super) fn load(&mut self) {
        for (value, parameter) in self.values.iter_mut().zip(PARAMETERS) {
            value.ram = value.rom;
            if !parameter.has(usage::ROM_READ) {
                value.ram = parameter.default;
            }
        }
        self.start();
    }

    /// The software starts: it uses the values in RAM.
    pub(super) fn start(&mut self) {
        for value in &mut self.values {
            value.used = value.ram;
        }
    }

    fn entry(&mut self, upid: u16) -> Option<(&'static Parameter, &mut Value)> {
        let index = upids::find(upid)?;
        Some((&PARAMETERS[index], self.values.get_mut(index)?))
    }

    /// The value in use. 0 for an unknown UPID.
    pub(super) fn used(&self, upid: u16) -> i64 {
        upids::find(upid).map_or(0, |index| self.values[index].used)
    }

    /// The value in RAM of the parameter at this index.
    pub(super) fn ram(&self, index: usize) -> i64 {
        self.values[index].ram
    }

    /// The value in ROM.
    pub(super) fn rom(&self, upid: u16) -> Result<u32, Refusal> {
        let index = allowed(upid, usage::ROM_READ)?;
        Ok(self.wire(index, self.values[index].rom))
    }

    /// The limit that a command reads, or the default, which a variable does not have.
    pub(super) fn bound(&self, upid: u16, read: u8) -> Result<u32, Refusal> {
        let has = if read == command::READ_DEFAULT { usage::ROM_READ } else { 0 };
        let index = allowed(upid, has)?;
        let Parameter { low, high, default, .. } = PARAMETERS[index];
        Ok(self.wire(
            index,
            match read {
                command::READ_MINIMUM => low,
                command::READ_MAXIMUM => high,
                _ => default,
            },
        ))
    }

    /// A value of the parameter at this index, in wire form.
    pub(super) fn wire(&self, index: usize, value: i64) -> u32 {
        PARAMETERS[index].kind.to_wire(value, self.extend)
    }

    /// Writes RAM.
    pub(super) fn write_ram(&mut self, upid: u16, raw: u32) -> Result<(), Refusal> {
        let value = check(upid, raw, usage::RAM_WRITE)?;
        if let Some((parameter, values)) = self.entry(upid) {
            values.ram = value;
            if parameter.has(usage::LIVE) {
                values.used = value;
            }
        }
        Ok(())
    }

    /// Writes ROM.
    pub(super) fn write_rom(&mut self, upid: u16, raw: u32) -> Result<(), Refusal> {
        let value = check(upid, raw, usage::ROM_WRITE)?;
        if let Some((_, values)) = self.entry(upid) {
            values.rom = value;
        }
        Ok(())
    }

    /// ROM of one part of the software to its defaults.
    pub(super) fn restore(&mut self, part: u16) {
        for (value, parameter) in self.values.iter_mut().zip(PARAMETERS) {
            if parameter.upid >> 12 == part {
                value.rom = parameter.default;
            }
        }
    }

    /// The first parameter from `upid` on, with its ROM value; if `modified`, the first one whose ROM differs from its
    /// default.
    pub(super) fn next(&self, upid: u16, modified: bool) -> Option<(&'static Parameter, u32)> {
        let index = (upids::from(upid)..PARAMETERS.len()).find(|index| {
            let parameter = &PARAMETERS[*index];
            !modified || parameter.has(usage::ROM_READ) && self.values[*index].rom != parameter.default
        })?;
        Some((&PARAMETERS[index], self.wire(index, self.values[index].rom)))
    }

    /// The indices of the parameters that the monitoring channels report.
    pub(super) fn monitored(&self) -> [Option<usize>; 4] {
        [0, 1, 2, 3].map(|channel| {
            let source = self.used(upids::MONITOR_SOURCE + channel);
            u16::try_from(source).ok().and_then(upids::find)
        })
    }
}

/// The index of `upid`, if it can be used like this.
pub(super) fn allowed(upid: u16, usage: u16) -> Result<usize, Refusal> {
    let index = upids::find(upid).ok_or(Refusal::NoSuchUpid)?;
    if PARAMETERS[index].has(usage) { Ok(index) } else { Err(Refusal::AddressUsage) }
}

/// The number to be written, if it is allowed. Usage first, then type, then range.
pub(super) fn check(upid: u16, raw: u32, usage: u16) -> Result<i64, Refusal> {
    let parameter = &PARAMETERS[allowed(upid, usage)?];
    let value = parameter.kind.from_wire(raw).ok_or(Refusal::WrongType)?;
    // A channel can report an existing parameter, or nothing.
    let is_source = (upids::MONITOR_SOURCE..upids::MONITOR_SOURCE + 4).contains(&upid);
    let shown =
        !is_source || value == 0 || u16::try_from(value).is_ok_and(|upid| upids::find(upid).is_some());
    if (parameter.low..=parameter.high).contains(&value) && shown {
        Ok(value)
    } else {
        Err(Refusal::OutOfRange)
    }
}
