//! The native process data of a drive: joins the parts in which they come, and takes their numbers out.

use super::messages::NativeValues;
use fieldbeat_core::bus::native::{NativeField, NativeLayout};
use fieldbeat_core::cycle::record::NativeRecord;

/// The description of the parts of one drive.
#[derive(Debug)]
pub struct Parts {
    layout: NativeLayout,
    /// The first part of what is incomplete, and the bytes of it so far.
    begun: Option<(NativeRecord, Vec<u8>)>,
    /// How many parts were dropped, since others of the same are missing.
    dropped: u64,
}

impl Parts {
    /// Of a drive with this layout.
    pub fn new(layout: NativeLayout) -> Parts {
        Parts { layout, begun: None, dropped: 0 }
    }

    /// How many parts were dropped, since others of the same are missing.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Takes a part in. Returns the values once the last one is there; when they were received is left out.
    pub fn enter(&mut self, part: &NativeRecord) -> Option<NativeValues> {
        if part.offset == 0 {
            self.drop_begun();
            self.begun = Some((*part, Vec::with_capacity(part.total.into())));
        }
        // In one cycle there may be two, of inputs that were taken in apart.
        let of = |part: &NativeRecord| (part.index, part.received_ns, part.total, part.inputs);
        let fits = |(first, bytes): &(NativeRecord, Vec<u8>)| {
            of(first) == of(part) && bytes.len() == usize::from(part.offset)
        };
        let Some((_, bytes)) = self.begun.as_mut().filter(|begun| fits(begun)) else {
            self.drop_begun();
            self.dropped += 1;
            return None;
        };
        bytes.extend_from_slice(part.part());
        if bytes.len() < part.total.into() {
            return None;
        }
        let (_, bytes) = self.begun.take()?;
        Some(self.values(&bytes, part.inputs.into()))
    }

    fn drop_begun(&mut self) {
        if let Some((_, bytes)) = self.begun.take() {
            self.dropped += bytes.len().div_ceil(NativeRecord::PART) as u64;
        }
    }

    fn values(&self, bytes: &[u8], inputs: usize) -> NativeValues {
        let (inputs, outputs) = bytes.split_at(inputs.min(bytes.len()));
        let value = |field: &NativeField, bytes| field.value(bytes).map_or(f64::NAN, |value| value as f64);
        let of_inputs = self.layout.inputs.iter().map(|field| value(field, inputs));
        let of_outputs = self.layout.outputs.iter().map(|field| value(field, outputs));
        NativeValues {
            received_at_ns: 0,
            values: of_inputs.chain(of_outputs).collect(),
            inputs: inputs.to_vec(),
            outputs: outputs.to_vec(),
        }
    }
}
