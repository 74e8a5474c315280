//! The process data words of a drive, as a recording shows them, numbered as in its configuration.

use super::native::NATIVE_WORDS;
use super::plan::LenzeDrive;
use fieldbeat_core::bus::native::{NativeField, NativeLayout};

/// The words of `drive`. Set point, actual value and what is shown as signed are signed.
pub(super) fn layout(drive: &LenzeDrive) -> NativeLayout {
    let Some((outputs, inputs)) = drive.lengths() else { return NativeLayout::default() };
    let words = |bytes: usize| (bytes.saturating_sub(drive.process_at()) / 2).min(NATIVE_WORDS);
    let signed = |n: usize| {
        let shown = drive.show.iter().flatten();
        n == usize::from(drive.scale.actual)
            || shown.into_iter().any(|shown| usize::from(shown.word) == n && shown.signed)
    };
    NativeLayout {
        inputs: (0..words(inputs)).map(|n| word(n, signed(n))).collect(),
        outputs: (0..words(outputs)).map(|n| word(n, n == usize::from(drive.scale.set_point))).collect(),
        most: 2 * (words(inputs) + words(outputs)),
    }
}

fn word(n: usize, signed: bool) -> NativeField {
    NativeField::new(format!("word_{n}"), move |process| {
        let word = u16::from_be_bytes(*process.as_chunks().0.get(n)?);
        Some(if signed { (word as i16).into() } else { word.into() })
    })
}
