//! Curves: read, written, saved. They live in RAM until they are saved; a single one cannot be deleted.

use super::{Progress, Saved, ServiceError, Services, USUAL, Watcher, after, quiet};
use crate::curve::Curve;
use crate::motion::Kind;
use crate::upid::call;
use crate::wire::{Refusal, RtcCommand};

/// The steps of writing a curve.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CurvePut {
    /// The drive has none of this number: it is added.
    Add,
    /// The drive has one of the same size: it is overwritten in place.
    Modify,
    /// The drive has one of another size. It can only delete all curves at once: the others are read first, and
    /// written again.
    Rebuild,
}

/// A curve as the drive holds it, valid or not.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Raw {
    info: Vec<u8>,
    data: Vec<u8>,
}

impl Raw {
    fn sizes(&self) -> (usize, usize) {
        (self.info.len(), self.data.len())
    }

    fn pieces(&self) -> usize {
        self.info.len().div_ceil(4) + self.data.len().div_ceil(4)
    }
}

/// Start, info and data of a block transfer.
type Steps = [RtcCommand; 3];

const ADD: Steps = [RtcCommand::ADD_CURVE, RtcCommand::ADD_CURVE_INFO, RtcCommand::ADD_CURVE_DATA];
const MODIFY: Steps =
    [RtcCommand::MODIFY_CURVE, RtcCommand::MODIFY_CURVE_INFO, RtcCommand::MODIFY_CURVE_DATA];

/// The remedy when RAM could not be restored.
const REMEDY: &str =
    "restart the drive, it comes up with the curves that its flash holds; what was not saved is lost";

impl Services<'_> {
    /// The numbers of all curves that the drive has.
    pub fn curves(&self) -> Result<Vec<u16>, ServiceError> {
        let mut ids = Vec::new();
        let (first, last) = Kind::CurveId.range();
        for id in first as u16..=last as u16 {
            if self.curve_sizes(id)?.is_some() {
                ids.push(id);
            }
        }
        Ok(ids)
    }

    /// Curve `id`; `None` if the drive has none of that number.
    pub fn curve(&self, id: u16, watch: Watcher<'_>) -> Result<Option<Curve>, ServiceError> {
        let Some(raw) = self.raw_curve(id, watch)? else { return Ok(None) };
        let content = |why| self.content(format!("curve {id}"), why);
        let curve = Curve::decode(&raw.info, &raw.data).map_err(|error| content(error.to_string()))?;
        match curve.id == id {
            true => Ok(Some(curve)),
            false => Err(content(format!("it says that it is curve {}: put it there again", curve.id))),
        }
    }

    /// How [`put_curve`](Self::put_curve) would write it.
    pub fn plan_curve(&self, curve: &Curve) -> Result<CurvePut, ServiceError> {
        let new = self.encoded(curve)?;
        self.way(curve.id, &new)
    }

    /// Writes a curve to the drive's RAM and reads it back. If it is cancelled or fails, the previous content is
    /// written again, and read back too. A drive that is running this very curve may jerk.
    pub fn put_curve(&self, curve: &Curve, watch: Watcher<'_>) -> Result<(), ServiceError> {
        let (id, new) = (curve.id, self.encoded(curve)?);
        let way = self.way(id, &new)?;
        if way == CurvePut::Rebuild {
            return self.rebuild(id, Some(&new), watch);
        }
        let old = self.raw_curve(id, &mut quiet)?;
        let written = self.put_raw(way, id, &new, watch);
        written.map_err(|failed| after(failed, self.restore_curve(id, old.as_ref()), REMEDY))
    }

    /// Writes a curve that way and reads it back.
    fn put_raw(&self, way: CurvePut, id: u16, new: &Raw, watch: Watcher<'_>) -> Result<(), ServiceError> {
        let steps = match way {
            CurvePut::Add => ADD,
            CurvePut::Modify => MODIFY,
            CurvePut::Rebuild => return self.rebuild(id, Some(new), watch),
        };
        self.write_raw(steps, id, new, watch)?;
        self.verify(id, new, watch)
    }

    /// Restores the previous curve at `id`, whatever is there now: a part of another curve, or the content of the
    /// flash if the drive has restarted.
    fn restore_curve(&self, id: u16, old: Option<&Raw>) -> Result<(), ServiceError> {
        match old {
            Some(old) => self.put_raw(self.way(id, old)?, id, old, &mut quiet),
            None if self.curve_sizes(id)?.is_some() => self.rebuild(id, None, &mut quiet),
            None => Ok(()),
        }
    }

    /// How to get from what the drive has at `id` to `new`.
    fn way(&self, id: u16, new: &Raw) -> Result<CurvePut, ServiceError> {
        Ok(match self.curve_sizes(id)? {
            None => CurvePut::Add,
            Some(sizes) if sizes == new.sizes() => CurvePut::Modify,
            Some(_) => CurvePut::Rebuild,
        })
    }

    /// Deletes all curves in RAM.
    pub fn delete_curves(&self) -> Result<(), ServiceError> {
        self.command(call(RtcCommand::DELETE_CURVES, 0, 0), USUAL).map(drop)
    }

    /// Saves all curves to flash, with the software stopped meanwhile. It may take minutes in which the drive is
    /// silent; it has to be homed again then.
    pub fn save_curves(&self) -> Result<Saved, ServiceError> {
        self.save(RtcCommand::SAVE_CURVES)
    }

    fn encoded(&self, curve: &Curve) -> Result<Raw, ServiceError> {
        let what = || format!("curve {}", curve.id);
        let (info, data) = curve.encode().map_err(|error| self.content(what(), error.to_string()))?;
        if data.len() > usize::from(u16::MAX) {
            let most = usize::from(u16::MAX) / 4;
            return Err(self.content(what(), format!("a transfer has room for {most} setpoints")));
        }
        Ok(Raw { info: info.to_vec(), data })
    }

    /// Bytes of info block and data.
    fn curve_sizes(&self, id: u16) -> Result<Option<(usize, usize)>, ServiceError> {
        match self.command(call(RtcCommand::GET_CURVE, id, 0), USUAL) {
            Ok(answer) => Ok(Some([0, 16].map(|bit| usize::from((answer.value >> bit) as u16)).into())),
            Err(error) if error.refusal() == Some(Refusal::CurveDefinition) => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn raw_curve(&self, id: u16, watch: Watcher<'_>) -> Result<Option<Raw>, ServiceError> {
        let Some((info, data)) = self.curve_sizes(id)? else { return Ok(None) };
        let (before, of) = (info.div_ceil(4), info.div_ceil(4) + data.div_ceil(4));
        let mut report =
            |done| self.go_on(watch, Progress { what: "read", done, of }, || format!("reading curve {id}"));
        let info = self.take_block(RtcCommand::GET_CURVE_INFO, id, info, &mut report)?;
        let data = self.take_block(RtcCommand::GET_CURVE_DATA, id, data, |done| report(before + done))?;
        Ok(Some(Raw { info, data }))
    }

    fn write_raw(&self, steps: Steps, id: u16, raw: &Raw, watch: Watcher<'_>) -> Result<(), ServiceError> {
        let [start, info, data] = steps;
        let (before, of) = (raw.info.len().div_ceil(4), raw.pieces());
        let mut report =
            |done| self.go_on(watch, Progress { what: "write", done, of }, || format!("writing curve {id}"));
        // Both fit: an info block has 70 bytes, and the data was checked.
        let sizes = raw.info.len() as u32 | (raw.data.len() as u32) << 16;
        self.command(call(start, id, sizes), USUAL)?;
        self.send_block(info, id, &raw.info, &mut report)?;
        self.send_block(data, id, &raw.data, |done| report(before + done))
    }

    fn verify(&self, id: u16, written: &Raw, watch: Watcher<'_>) -> Result<(), ServiceError> {
        match self.raw_curve(id, watch)? {
            Some(raw) if raw == *written => Ok(()),
            _ => Err(self.not_as_written(format!("curve {id}"))),
        }
    }

    /// Deletes all curves and writes them again, that of `id` as `new`, or without it: the present one is then only
    /// a part of a curve.
    fn rebuild(&self, id: u16, new: Option<&Raw>, watch: Watcher<'_>) -> Result<(), ServiceError> {
        let mut old = Vec::new();
        for known in self.curves()?.into_iter().filter(|known| new.is_some() || *known != id) {
            let raw = self.raw_curve(known, watch)?;
            old.extend(raw.map(|raw| (known, raw)));
        }
        let mut all = old.clone();
        all.retain(|(known, _)| *known != id);
        all.extend(new.map(|new| (id, new.clone())));
        let replaced = self.replace_all(&all, watch);
        replaced.map_err(|failed| after(failed, self.replace_all(&old, &mut quiet), REMEDY))
    }

    fn replace_all(&self, curves: &[(u16, Raw)], watch: Watcher<'_>) -> Result<(), ServiceError> {
        self.delete_curves()?;
        let (mut before, of) = (0, curves.iter().map(|(_, raw)| raw.pieces()).sum());
        for (id, raw) in curves {
            let report =
                &mut |progress: Progress| watch(Progress { what: "write", done: before + progress.done, of });
            self.write_raw(ADD, *id, raw, report)?;
            before += raw.pieces();
        }
        for (id, raw) in curves {
            self.verify(*id, raw, watch)?;
        }
        Ok(())
    }
}
