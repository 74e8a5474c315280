//! Settings that a drive needs in addition to its cyclic parameters.

use super::mapping::Mapping;
use super::parameter::{Parameter, Width};
use super::plan::{Mapped, UnidriveDrive, Via};
use super::wire::{Registers, RegistersBuffer, Request};
use fieldbeat_core::time::MS;

/// The purpose of a setting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Purpose {
    /// It follows the control word, and preset 1 is its reference (SI-PROFIBUS guide).
    Obey,
    /// It stops by itself without Modbus traffic (assumed).
    Watch,
    /// Menu 0 shows the cyclic parameters (assumed).
    Menu0,
}

/// One parameter and its value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Setting {
    pub parameter: Parameter,
    pub address: u16,
    pub width: Width,
    pub value: i32,
    pub purpose: Purpose,
}

impl Setting {
    /// The drive's value, as read.
    pub(super) fn read(&self, data: Registers<'_>) -> Option<i32> {
        data.raw(self.width, 0).map(u32::cast_signed)
    }

    /// The request that writes `value` to it.
    pub(super) fn write<'a>(&self, value: i32, data: &'a mut RegistersBuffer) -> Request<'a> {
        data.push_raw(self.width, value.cast_unsigned());
        Request::Write { address: self.address, data: data.registers() }
    }
}

/// The settings of `drive`. In this order a drive that runs by its terminals goes on at its speed: the control word
/// counts once it says so, and only then the selectors of the reference change.
pub(super) fn settings(drive: &UnidriveDrive, menu_0: Option<&Mapping>) -> Vec<Setting> {
    let setting = |parameter: Parameter, value, purpose| {
        let width = Mapped::new(parameter).width;
        let address = parameter.address(drive.addressing, width)?;
        Some(Setting { parameter, address, width, value, purpose })
    };
    let mut settings = vec![
        setting(Parameter::CONTROL_WORD_ENABLE, 1, Purpose::Obey),
        setting(Parameter::PRESET_SELECTOR, 0, Purpose::Obey),
        setting(Parameter::REFERENCE_SELECTOR, 0, Purpose::Obey),
    ];
    if let Some(timeout_ns) = drive.watchdog.timeout_ns {
        let ms = i32::try_from(timeout_ns.div_ceil(MS)).unwrap_or(i32::MAX);
        settings.push(setting(drive.time_out(), ms, Purpose::Watch));
    }
    if let (Some(menu_0), Via::Menu0 { first }) = (menu_0, drive.via) {
        for (place, parameter) in menu_0.shown_in_menu_0().iter().enumerate() {
            // The plan contains only parameters that can be shown.
            let Some(value) = parameter.to_setup().map(i32::from) else { continue };
            let number = first.saturating_add(place as u8);
            settings.push(setting(Parameter::new(22, number), value, Purpose::Menu0));
        }
    }
    settings.into_iter().flatten().collect()
}
