//! The effects of SDOs on a drive: reading and writing its objects, one by one or all subindices at once.

use super::*;
use crate::ethercat::codec::mailbox::abort;
use crate::ethercat::mailbox::Request;
use crate::ethercat::mapping::ENTRIES;

const COUNT: u8 = 0;

impl Drive {
    /// Carries out a request; the read data are the answer.
    pub(super) fn obey_sdo(&mut self, request: &Request) -> Result<Vec<u8>, u32> {
        let object = request.object;
        match (&request.data, request.complete) {
            (Some(data), false) => self.write(object, data).map(|()| Vec::new()),
            (Some(data), true) => self.write_all(object, data).map(|()| Vec::new()),
            (None, complete) => {
                self.refresh();
                if complete { self.read_all(object) } else { self.read(object) }
            }
        }
    }

    pub(super) fn read(&self, object: Object) -> Result<Vec<u8>, u32> {
        match object {
            DEVICE_NAME if self.settings.long_sdos.is_some() => Ok(self.settings.name().as_bytes().to_vec()),
            _ if self.mapping.has(object) => self.mapping.read(object),
            _ => self.objects.read(object),
        }
    }

    /// All subindices from that of `object` on, 0 or 1; the count is followed by a padding byte.
    fn read_all(&self, object: Object) -> Result<Vec<u8>, u32> {
        let subs: Vec<u8> = match self.mapping.has(object) {
            true => (0..=ENTRIES as u8).collect(),
            false => self.objects.subs(object.index).collect(),
        };
        match (&subs[..], object.sub) {
            ([], _) => return Err(abort::NO_OBJECT),
            ([_], 0) => return self.read(object),
            (_, 0 | 1) => {}
            _ => return Err(abort::NOT_COMPLETE),
        }
        let mut all = Vec::new();
        for sub in subs.into_iter().filter(|sub| *sub >= object.sub) {
            all.extend(self.read(Object::new(object.index, sub))?);
            if sub == COUNT {
                all.push(0);
            }
        }
        Ok(all)
    }

    /// Writes all subindices from that of `object` on. A count that can be written is 0 meanwhile.
    fn write_all(&mut self, object: Object, data: &[u8]) -> Result<(), u32> {
        let count = Object::new(object.index, COUNT);
        let (wanted, mut rest) = match (object.sub, data) {
            (0, [wanted, _, rest @ ..]) => (Some(*wanted), rest),
            (1, rest) => (None, rest),
            (0, _) => return Err(abort::LENGTH),
            _ => return Err(abort::NOT_COMPLETE),
        };
        let counted = match wanted.map(|_| self.write(count, &[0])) {
            None | Some(Err(abort::READ_ONLY)) => None,
            Some(written) => written.map(|()| wanted)?,
        };
        for sub in 1_u8.. {
            if rest.is_empty() {
                break;
            }
            let entry = Object::new(object.index, sub);
            let size = if self.mapping.has(entry) { 4 } else { self.objects.size(entry)? };
            let (own, behind) = rest.split_at_checked(size).ok_or(abort::LENGTH)?;
            self.write(entry, own)?;
            rest = behind;
        }
        counted.map_or(Ok(()), |counted| self.write(count, &[counted]))
    }

    /// Writes an entry of a PDO, or its count.
    fn map(&mut self, object: Object, data: &[u8]) -> Result<(), u32> {
        if self.al != AlState::PreOp {
            return Err(abort::STATE);
        }
        let selects = |assignment| {
            let get = |sub| self.objects.get(Object::new(assignment, sub));
            get(0) != 0 && get(1) == i64::from(object.index)
        };
        if [OUTPUT_PDO, INPUT_PDO].into_iter().any(selects) {
            return Err(abort::INCOMPATIBLE);
        }
        let Drive { mapping, objects, .. } = self;
        let is_output = object.index < 0x1800;
        mapping.write(object, data, |mapped| objects.mappable(mapped, is_output))
    }

    /// Writes an object for the master.
    pub(super) fn write(&mut self, object: Object, data: &[u8]) -> Result<(), u32> {
        if self.mapping.has(object) {
            return self.map(object, data);
        }
        let value = self.objects.written(object, data, self.al)?;
        self.judge(object, value)?;
        let mode = self.objects.get(MODE);
        self.objects.set(object, value);
        match object {
            CYCLE_UNITS | CYCLE_POWER => {
                self.cycle_ns = self.interpolation_ns();
                let quanta = self.cycle_ns.unwrap_or_default() / QUANTUM_NS;
                self.objects.set(CYCLE_TIME, quanta.max(1) as i64);
            }
            CYCLE_TIME => self.cycle_ns = Some(value as u64 * QUANTUM_NS),
            limit if TORQUE_LIMITS.contains(&limit) => self.limit_torque(),
            MODE => self.change_mode(mode as i8),
            CONTROL_WORD if self.al == AlState::Op => self.obey(),
            _ => {}
        }
        Ok(())
    }

    /// Whether an object can have this value now.
    fn judge(&self, object: Object, value: i64) -> Result<(), u32> {
        let mapped = || self.selected(OUTPUT_PDO).is_some_and(|layout| layout.place(object).is_some());
        if self.is_cyclic() && mapped() {
            return Err(abort::MAPPED);
        }
        match (object.index, object.sub) {
            (OUTPUT_PDO | INPUT_PDO, 0) if value == 1 => {
                let assigned = self.objects.get(Object::new(object.index, 1)) != 0;
                if assigned { Ok(()) } else { Err(abort::INCOMPATIBLE) }
            }
            (OUTPUT_PDO | INPUT_PDO, 1) => {
                if self.objects.get(Object::new(object.index, 0)) != 0 {
                    return Err(abort::NOT_ZERO);
                }
                let is_output = object.index == OUTPUT_PDO;
                let mut layouts = self.layouts();
                let exists =
                    layouts.any(|layout| i64::from(layout.index) == value && layout.is_output() == is_output);
                if value == 0 || exists { Ok(()) } else { Err(abort::RANGE) }
            }
            (0x6060, 0) if !has_mode(self.settings.family, value as i8) => Err(abort::RANGE),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_subindices_are_read_and_written_at_once() {
        let mut drive = Drive::new(DriveSettings::new(Family::Akd));
        drive.may_enter(Time(5), AlState::PreOp).unwrap();
        let object = |index| Object::new(index, 0);
        let types = Object::new(0x1C00, 1);
        assert_eq!(drive.read_all(object(0x1C00)), Ok(vec![4, 0, 1, 2, 3, 4]), "as in a capture");
        assert_eq!(drive.read_all(types), Ok(vec![1, 2, 3, 4]));
        assert_eq!(drive.read_all(Object::new(0x1C00, 2)), Err(abort::NOT_COMPLETE));
        assert_eq!(drive.read_all(object(0x5FFF)), Err(abort::NO_OBJECT));
        assert_eq!(drive.read_all(object(0x1000)).unwrap().len(), 4);
        assert_eq!(drive.write_all(object(0x1C12), &[1, 0, 0x02]), Err(abort::LENGTH));
        assert_eq!(drive.write_all(object(0x1C12), &[1]), Err(abort::LENGTH));
        // The count of 60C2 is read only.
        for (index, entries) in [
            (0x1C12, &[1, 0, 0x02, 0x17][..]),
            (0x60C2, &[2, 0, 20, 0xFC]),
            (0x1601, &[2, 0, 32, 1, 0xC1, 0x60, 16, 0, 0x40, 0x60]),
        ] {
            assert_eq!(drive.write_all(object(index), entries), Ok(()), "{index:#06x}");
            assert_eq!(drive.read_all(object(index)).unwrap()[..entries.len()], *entries);
        }
        assert_eq!(drive.interpolation_ns(), Some(2 * MS));
    }
}
