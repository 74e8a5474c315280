//! The records of cycles as columns of signals, one sample a cycle.

use super::signals::{Values, count};
use fieldbeat_core::cycle::record::Record;
use fieldbeat_core::time::S;
use fieldbeat_record::blackbox::file::Axis;

/// The samples of some cycles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Block {
    /// The instants of their slots on the grid, s of CLOCK_MONOTONIC.
    pub times: Vec<f64>,
    /// The cycles.
    pub cycles: Vec<f64>,
    /// The values of each signal, by its number.
    pub columns: Vec<Vec<f64>>,
}

/// Puts them together.
#[derive(Debug)]
pub struct Assembler {
    values: Values,
    /// The cycle that the values belong to.
    index: u64,
    block: Block,
}

impl Assembler {
    /// For these axes.
    pub fn new(axes: &[Axis]) -> Assembler {
        let block = Block { columns: vec![Vec::new(); count(axes.len())], ..Block::default() };
        Assembler { values: Values::new(axes), index: 0, block }
    }

    /// Takes in records. Those of drives come before that of their cycle; one whose cycle got lost is left out.
    pub fn enter(&mut self, record: &Record) {
        if self.index != record.index() {
            self.values.clear();
            self.index = record.index();
        }
        self.values.enter(record);
        if let Record::Cycle(cycle) = record {
            self.block.times.push(cycle.grid.0 as f64 / S as f64);
            self.block.cycles.push(cycle.index as f64);
            for (column, value) in self.block.columns.iter_mut().zip(self.values.all()) {
                column.push(*value);
            }
        }
    }

    /// The samples since the last call, if there are any.
    pub fn take(&mut self) -> Option<Block> {
        let columns = self.block.columns.len();
        (!self.block.times.is_empty()).then(|| {
            let empty = Block { columns: vec![Vec::new(); columns], ..Block::default() };
            std::mem::replace(&mut self.block, empty)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::axis::Link;
    use fieldbeat_core::cycle::record::{CycleRecord, DriveRecord};
    use fieldbeat_core::time::Time;

    #[test]
    fn a_cycle_is_one_sample_though_its_records_come_in_two_batches() {
        let drive = |index, position| {
            Record::Drive(DriveRecord { index, position, link: Link::Online, ..DriveRecord::default() })
        };
        let cycle =
            |index| Record::Cycle(CycleRecord { index, grid: Time(index * S), ..CycleRecord::default() });
        let mut assembler = Assembler::new(&[Axis::default()]);
        let mut entered = |records: &[Record]| {
            records.iter().for_each(|record| assembler.enter(record));
            assembler.take()
        };
        assert_eq!(entered(&[drive(1, 5.0)]), None);
        let block = entered(&[cycle(1), drive(2, 6.0), cycle(2), drive(3, 7.0)]).unwrap();
        assert_eq!((&block.times[..], &block.cycles[..]), (&[1.0, 2.0][..], &[1.0, 2.0][..]));
        let position = count(0) + 1;
        assert_eq!(block.columns[position], [5.0, 6.0]);
        // The record of cycle 3 got lost, and with it what its drive reported.
        let block = entered(&[cycle(4)]).unwrap();
        assert!(block.columns[position][0].is_nan());
    }
}
