//! Process data: the selected PDOs, and their contents.

use super::*;

impl Drive {
    /// Bytes of its outputs and inputs by the selected PDOs: SyncManagers 2 and 3 have to have them.
    pub fn sizes(&self) -> (usize, usize) {
        let size = |assignment| self.selected(assignment).map_or(0, Pdo::size);
        (size(OUTPUT_PDO), size(INPUT_PDO))
    }

    /// The PDO that is selected.
    pub(super) fn selected(&self, assignment: u16) -> Option<&Pdo> {
        let count = self.objects.get(Object::new(assignment, 0));
        let pdo = self.objects.get(Object::new(assignment, 1));
        let is_it = |own: &&Pdo| i64::from(own.index) == pdo && own.is_output() == (assignment == OUTPUT_PDO);
        self.layouts().find(is_it).filter(|_| count == 1)
    }

    /// The PDOs that can be selected.
    pub(super) fn layouts(&self) -> impl Iterator<Item = &Pdo> {
        self.settings.layouts.iter().chain(self.mapping.pdos())
    }

    /// Outputs of a cycle.
    pub(super) fn take(&mut self, now: Time, outputs: &[u8]) {
        let mut values = std::mem::take(&mut self.values);
        values.clear();
        if let Some(layout) = self.selected(OUTPUT_PDO).filter(|layout| outputs.len() >= layout.size()) {
            values.extend(layout.places().map(|(object, place)| {
                let data = outputs.get(place).unwrap_or_default();
                (object, data.iter().rev().fold(0_i64, |raw, byte| raw << 8 | i64::from(*byte)))
            }));
        }
        let mode = self.objects.get(MODE);
        values.iter().for_each(|(object, value)| self.objects.set(*object, *value));
        if self.objects.get(MODE) != mode {
            self.change_mode(mode as i8);
        }
        if values.iter().any(|(object, _)| *object == CONTROL_WORD) {
            self.obey();
        }
        if values.iter().any(|(object, _)| TORQUE_LIMITS.contains(object)) {
            self.limit_torque();
        }
        if !values.is_empty() {
            self.follow(now);
        }
        self.values = values;
    }

    /// Inputs of a cycle.
    pub(super) fn give(&self, inputs: &mut [u8]) {
        let Some(layout) = self.selected(INPUT_PDO).filter(|layout| inputs.len() >= layout.size()) else {
            return;
        };
        for (object, place) in layout.places() {
            let raw = self.objects.get(object).to_le_bytes();
            inputs[place].iter_mut().zip(raw).for_each(|(input, byte)| *input = byte);
        }
    }
}
