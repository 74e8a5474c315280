//! The effects of SDOs on a drive: reading and writing its objects, one by one or all subindices at once.

use super::*;
use crate::ethercat::mailbox::Request;
use crate::ethercat::objects::abort;
use fieldbeat_ethercat::wire::sdo::AbortCode;

const COUNT: u8 = 0;

impl Drive {
    /// Carries out a request; the read data are the answer.
    pub(super) fn obey_sdo(&mut self, request: &Request) -> Result<Vec<u8>, AbortCode> {
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

    fn read(&self, object: Object) -> Result<Vec<u8>, AbortCode> {
        match object {
            DEVICE_NAME if self.settings.long_sdos.is_some() => Ok(self.settings.name.as_bytes().to_vec()),
            _ if self.mapping.has(object) => self.mapping.read(object),
            _ => self.objects.read(object),
        }
    }

    /// All subindices from that of `object` on, 0 or 1; the count is followed by a padding byte.
    fn read_all(&self, object: Object) -> Result<Vec<u8>, AbortCode> {
        let subs: Vec<u8> = match self.mapping.has(object) {
            true => (0..=self.mapping.subs()).collect(),
            false => self.objects.subs(object.index).collect(),
        };
        match (&subs[..], object.sub) {
            ([], _) => return Err(AbortCode::NO_OBJECT),
            ([_], 0) => return self.read(object),
            (_, 0 | 1) => {}
            _ => return Err(AbortCode::NOT_COMPLETE),
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
    fn write_all(&mut self, object: Object, data: &[u8]) -> Result<(), AbortCode> {
        let count = Object::new(object.index, COUNT);
        let (wanted, mut rest) = match (object.sub, data) {
            (0, [wanted, _, rest @ ..]) => (Some(*wanted), rest),
            (1, rest) => (None, rest),
            (0, _) => return Err(AbortCode::LENGTH),
            _ => return Err(AbortCode::NOT_COMPLETE),
        };
        let counted = match wanted.map(|_| self.write(count, &[0])) {
            None | Some(Err(AbortCode::READ_ONLY)) => None,
            Some(written) => written.map(|()| wanted)?,
        };
        for sub in 1_u8.. {
            if rest.is_empty() {
                break;
            }
            let entry = Object::new(object.index, sub);
            let size = if self.mapping.has(entry) { 4 } else { self.objects.size(entry)? };
            let (own, behind) = rest.split_at_checked(size).ok_or(AbortCode::LENGTH)?;
            self.write(entry, own)?;
            rest = behind;
        }
        counted.map_or(Ok(()), |counted| self.write(count, &[counted]))
    }

    /// Writes an entry of a PDO, or its count.
    fn map(&mut self, object: Object, data: &[u8]) -> Result<(), AbortCode> {
        if self.al != AlState::PreOp {
            return Err(AbortCode::STATE);
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
    fn write(&mut self, object: Object, data: &[u8]) -> Result<(), AbortCode> {
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
            MODE => self.change_mode(Mode(mode as i8)),
            CONTROL_WORD if self.al == AlState::Op => self.obey(),
            _ => {}
        }
        Ok(())
    }

    /// Whether an object can have this value now.
    fn judge(&self, object: Object, value: i64) -> Result<(), AbortCode> {
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
                    layouts.any(|layout| i64::from(layout.pdo) == value && layout.is_output() == is_output);
                if value == 0 || exists { Ok(()) } else { Err(AbortCode::RANGE) }
            }
            (0x6060, 0) if !self.has_mode(Mode(value as i8)) => Err(AbortCode::RANGE),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fieldbeat_core::time::S;

    fn drive(family: Family) -> Drive {
        let mut drive = Drive::new(DriveSettings::new(family));
        drive.advance(Time(S));
        drive.may_enter(Time(S), AlState::PreOp).unwrap();
        drive
    }

    fn write(drive: &mut Drive, index: u16, sub: u8, data: &[u8]) -> Result<(), AbortCode> {
        drive.write(Object::new(index, sub), data)
    }

    /// Maps position setpoint and control word, and selects that.
    fn map(drive: &mut Drive) -> Result<(), AbortCode> {
        write(drive, 0x1C12, 0, &[0])?;
        write(drive, 0x1600, 0, &[0])?;
        write(drive, 0x1600, 1, &[16, 0, 0x40, 0x60])?;
        write(drive, 0x1600, 2, &[32, 1, 0xC1, 0x60])?;
        write(drive, 0x1600, 0, &[2])?;
        write(drive, 0x1C12, 1, &[0x00, 0x16])?;
        write(drive, 0x1C12, 0, &[1])
    }

    #[test]
    fn the_master_maps_its_own_pdo_and_the_drive_obeys_it() {
        let mut drive = drive(Family::S700);
        assert_eq!(write(&mut drive, 0x1C12, 0, &[0]), Ok(()));
        assert_eq!(write(&mut drive, 0x1C12, 1, &[0x00, 0x16]), Err(AbortCode::RANGE), "it is empty");
        assert_eq!(write(&mut drive, 0x1600, 1, &[16, 0, 0x41, 0x60]), Err(abort::NOT_MAPPABLE), "read only");
        map(&mut drive).unwrap();
        assert_eq!(drive.sizes(), (6, 8));
        assert_eq!(write(&mut drive, 0x1600, 0, &[0]), Err(abort::INCOMPATIBLE), "it is selected");
        assert_eq!(drive.read(Object::new(0x1600, 2)), Ok(vec![32, 1, 0xC1, 0x60]));
        drive.may_enter(Time(S), AlState::SafeOp).unwrap();
        assert_eq!(write(&mut drive, 0x1A00, 0, &[0]), Err(AbortCode::STATE));
        assert_eq!(write(&mut drive, 0x60C1, 1, &[0; 4]), Err(abort::MAPPED));
        let mut now = Time(S);
        for _ in 0..200 {
            now = now + MS;
            drive.process(now, &[], &mut [0; 8]);
        }
        drive.may_enter(now, AlState::Op).unwrap();
        for word in [6, 7] {
            now = now + MS;
            drive.process(now, &[word, 0, 0, 0, 0, 0], &mut [0; 8]);
        }
        assert_eq!(drive.axis_state(), State::SwitchedOn, "the control word stands first");
        drive.restart(now);
        assert_eq!((drive.sizes(), drive.read(Object::new(0x1600, 0))), ((6, 8), Ok(vec![0])));
    }

    #[test]
    fn all_subindices_are_read_and_written_at_once() {
        let mut drive = drive(Family::Akd);
        assert_eq!(drive.read_all(Object::new(0x1C00, 0)), Ok(vec![4, 0, 1, 2, 3, 4]), "as in a capture");
        assert_eq!(drive.read_all(Object::new(0x1C00, 1)), Ok(vec![1, 2, 3, 4]));
        assert_eq!(drive.read_all(Object::new(0x1C00, 2)), Err(AbortCode::NOT_COMPLETE));
        assert_eq!(drive.read_all(Object::new(0x5FFF, 0)), Err(AbortCode::NO_OBJECT));
        assert_eq!(drive.read_all(Object::new(0x1000, 0)).unwrap().len(), 4);
        assert_eq!(drive.write_all(Object::new(0x1C12, 0), &[1, 0, 0x02, 0x17]), Ok(()));
        assert_eq!(drive.read_all(Object::new(0x1C12, 0)), Ok(vec![1, 0, 0x02, 0x17]));
        assert_eq!(drive.write_all(Object::new(0x1C12, 0), &[1, 0, 0x02]), Err(AbortCode::LENGTH));
        assert_eq!(drive.write_all(Object::new(0x1C12, 0), &[1]), Err(AbortCode::LENGTH));
        assert_eq!(
            drive.write_all(Object::new(0x60C2, 0), &[2, 0, 20, 0xFC]),
            Ok(()),
            "its count is read only"
        );
        assert_eq!(drive.interpolation_ns(), Some(2 * MS));
        let entries = [2, 0, 32, 1, 0xC1, 0x60, 16, 0, 0x40, 0x60];
        assert_eq!(drive.write_all(Object::new(0x1601, 0), &entries), Ok(()));
        assert_eq!(drive.read_all(Object::new(0x1601, 0)).unwrap()[..10], entries);
    }

    #[test]
    fn a_long_name_is_read_by_its_mailbox_whole() {
        let mut drive = drive(Family::Akd);
        let mut reply = Vec::new();
        let request = [10, 0, 0, 0, 0, 0x13, 0, 0x20, 0x40, 0x08, 0x10, 0, 0, 0, 0, 0];
        assert!(drive.mailbox(&request, &mut reply));
        assert_eq!(reply[..16], [50, 0, 0, 0, 0, 0x13, 0, 0x30, 0x41, 0x08, 0x10, 0, 40, 0, 0, 0]);
        assert_eq!(&reply[16..], drive.settings.name.as_bytes());
        let mut short = self::drive(Family::S700);
        assert!(short.mailbox(&request, &mut reply));
        assert_eq!(reply[8..], [0x43, 0x08, 0x10, 0, b'S', b'7', b'0', b'0']);
    }

    #[test]
    fn what_nobody_asked_for_comes_in_its_pauses_and_holds_up_no_answer() {
        let settings = DriveSettings { unrequested_ns: Some(10 * MS), ..DriveSettings::new(Family::Akd) };
        let mut drive = Drive::new(settings);
        let mut reply = Vec::new();
        drive.advance(Time(S));
        assert!(!drive.message(&mut reply), "not in INIT");
        drive.may_enter(Time(S), AlState::PreOp).unwrap();
        assert!(drive.message(&mut reply) && reply[5] == 2);
        assert!(!drive.message(&mut reply));
        drive.advance(Time(S + 10 * MS));
        let request = [10, 0, 0, 0, 0, 0x13, 0, 0x20, 0x40, 0, 0x10, 0, 0, 0, 0, 0];
        assert!(drive.mailbox(&request, &mut reply) && reply[8] == 0x43, "the answer first");
        assert!(drive.message(&mut reply) && reply[5] == 2);
    }
}
