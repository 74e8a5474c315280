//! How people write parameters of a LinMot drive and their values, the calls made from them, and their lists.

use std::time::Duration;

use super::service::{ServiceError, Services};
use super::upid::{RtcCall, Type, Upid, UpidInfo, Usage, Variant, address, call};
use super::wire::{Refusal, RtcCommand};
use fieldbeat_core::axis::acyclic::{
    Call, Counts, ListError, Listed, Listing, Notation, NotationError, Place, Values, Wanted, go_on, shown,
};

const FORM: &str =
    "0x20A8, 20A8h or a name, with .rom, .both, .min, .max or .default for another value than that in RAM";

/// Time limit for reading a value, or writing one to RAM.
const RAM_LIMIT: Duration = Duration::from_secs(1);
/// Time limit for writing one to flash: the drive may stall meanwhile (sheet, 5.6), for how long is not known. As
/// long as stopping its software.
const FLASH_LIMIT: Duration = Duration::from_secs(20);

/// Addresses and values of LinMot drives.
#[derive(Clone, Copy, Debug, Default)]
pub struct Upids;

impl Upids {
    fn known(text: &str) -> Option<&'static UpidInfo> {
        address(text)?.0.known()
    }
}

impl Notation for Upids {
    fn protocol(&self) -> &'static str {
        super::PROTOCOL
    }

    fn place(&self, text: &str) -> Result<Place, NotationError> {
        let (upid, variant) = address(text).ok_or(NotationError::Address { form: FORM })?;
        let known = upid.known();
        let of = known.map_or(Type::U32, |known| known.kind).integer();
        let counts = Counts {
            // One that is not known may be of either sign: the bits are the same.
            range: known.map_or((i32::MIN.into(), u32::MAX.into()), |_| of.range()),
            quantity: known.map(|known| known.quantity).filter(|quantity| !quantity.unit.is_empty()),
            ..Counts::all(of)
        };
        // A value written to both reads the same from either.
        let read = variant.read().unwrap_or(RtcCommand::READ_RAM);
        let instead = "the UPID itself, .rom or .both";
        let write = variant.write().ok_or(NotationError::ReadOnly { instead });
        Ok(Place {
            read: Ok(call(read, upid.0, 0)),
            write: write.map(|command| call(command, upid.0, 0)),
            values: Values::Counts(counts),
        })
    }

    /// The drive checks the value.
    fn write(&self, address: &str, value: u64) -> Result<Call, NotationError> {
        let call = RtcCall::of(&self.place(address)?.write?);
        let value = u32::try_from(value).map_err(|_| NotationError::Value {
            value: value.to_string(),
            form: "a number of 32 bits".to_owned(),
        })?;
        Ok(RtcCall { value, ..call }.into())
    }

    fn value(&self, address: &str, text: &str) -> Result<u64, NotationError> {
        let values = self.place(address)?.values;
        // Cut to 32 bits, as a signed value is sent.
        Ok(u64::from(values.number(values.raw(text)?) as u32))
    }

    fn show(&self, text: &str, raw: u64) -> String {
        let raw = raw as u32;
        match Upids::known(text) {
            Some(UpidInfo { kind: Type::Text, .. }) => {
                let letters = raw.to_le_bytes().map(char::from);
                let letters: String = letters.into_iter().filter(char::is_ascii_graphic).collect();
                format!("\"{letters}\" (0x{raw:X})")
            }
            Some(known) => {
                let means = (!known.quantity.unit.is_empty())
                    .then(|| format!("{} {}", known.value(raw), known.quantity.unit));
                shown(means, known.kind.number(raw), raw.into())
            }
            None => shown(None, raw.into(), raw.into()),
        }
    }

    fn reason(&self, status: u32) -> String {
        // The channel refuses with a status byte.
        Refusal::of(status as u8).to_string()
    }

    fn limit(&self, call: &Call) -> Duration {
        match RtcCall::of(call).command {
            RtcCommand::WRITE_ROM | RtcCommand::WRITE_BOTH => FLASH_LIMIT,
            _ => RAM_LIMIT,
        }
    }

    fn read_back(&self, text: &str) -> Vec<String> {
        match address(text) {
            Some((upid, Variant::Both)) => vec![upid.to_string(), format!("{upid}.rom")],
            _ => vec![text.to_owned()],
        }
    }

    fn is_same(&self, text: &str, written: u64, read: u64) -> bool {
        let (written, read) = (written as u32, read as u32);
        // A drive keeps as much of a value as the parameter has room for, with or without its sign above.
        let kinds = match Upids::known(text) {
            Some(known) => &[known.kind][..],
            None => &[Type::U32, Type::S16, Type::S8][..],
        };
        let values = |kind: &Type| (kind.strict_number(written), kind.strict_number(read));
        kinds.iter().any(|kind| matches!(values(kind), (Some(written), Some(read)) if written == read))
    }

    fn list(&self, wanted: &Wanted<'_>) -> Result<Listing, ListError> {
        if let Some(menu) = wanted.part {
            return Err(wanted.refused(&format!("has no menus; leave {menu} out")));
        }
        let from = wanted.from.unwrap_or("0x0000");
        let Some(first) = Upid::parse(from) else {
            return Err(ListError::Wanted(format!("--from {from}: not a UPID; write 0x1450, or a name")));
        };
        let (is_modified, values) = (wanted.modified, wanted.values);
        Ok(Listing::Read(Box::new(move |access, watch| {
            let services = Services::over(access.drive, access.carrier)?;
            if is_modified {
                // With their value in flash, which is not the default.
                let items = services.modified_upids(first, watch)?;
                return Ok(items.into_iter().map(|(upid, raw)| listed(upid, None, Some(raw))).collect());
            }
            let items = services.upids(first, watch)?;
            let mut rows = Vec::with_capacity(items.len());
            for (done, item) in items.iter().enumerate() {
                let mut row = listed(item.upid, Some(item.usage), None);
                if values && item.usage.has(Usage::RAM_READ) {
                    go_on(access, watch, done, items.len())?;
                    row.raw = Some(access.read(&row.address)?);
                }
                rows.push(row);
            }
            Ok(rows)
        })))
    }
}

fn listed(upid: Upid, usage: Option<Usage>, raw: Option<u32>) -> Listed {
    Listed {
        address: upid.to_string(),
        name: upid.known().map(|known| known.name),
        usage: usage.map(|usage| usage.to_string()),
        raw: raw.map(u64::from),
    }
}

impl From<ServiceError> for ListError {
    fn from(error: ServiceError) -> ListError {
        ListError::Failed(error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_keep_their_sign_and_their_range() {
        for (address, text, raw) in [
            ("home-position", "-5", 0xFFFF_FFFB),
            ("home-position", "0xFFFFFFFB", 0xFFFF_FFFB),
            ("monitor-source-1", "0x1E0F", 0x1E0F),
            ("cam-enabled", "true", 1),
            ("0x3000", "4294967295", 0xFFFF_FFFF),
            ("0x3000", "-1", 0xFFFF_FFFF),
        ] {
            assert_eq!(Upids.value(address, text), Ok(raw), "{address} {text}");
        }
        for (address, wrong_range) in [
            ("monitor-source-1", &["65536", "-1", "0x11E0F"][..]),
            ("0x3000", &["4294967296", "0x100000000"]),
        ] {
            for text in wrong_range {
                let wrong = Upids.value(address, text);
                assert!(matches!(wrong, Err(NotationError::Range { .. })), "{address} {text}: {wrong:?}");
            }
        }
        for text in ["1.5", "", "0x+5", "0x-5", "12mm", "99999999999999999999"] {
            for address in ["home-position", "0x3000"] {
                let wrong = Upids.value(address, text);
                assert!(matches!(wrong, Err(NotationError::Value { .. })), "{address} {text}: {wrong:?}");
            }
        }
        for (address, text, raw) in [
            ("home-position", "-0.0005", 0xFFFF_FFFB),
            ("home-position", "-0.0005 mm", 0xFFFF_FFFB),
            ("predefined-velocity", "250", 250_000),
            ("predefined-velocity", "0x3D090", 250_000),
            ("cam-enabled", "true", 1),
            ("0x3000", "-1", 0xFFFF_FFFF),
        ] {
            assert_eq!(Upids.in_unit(address, text), Ok(raw), "{address} {text}");
        }
        for (address, text, part) in [
            ("home-position", "5 rev", "write a value in mm"),
            ("home-position", "0.00001", "up to 4 decimals"),
            ("home-position", "300000", "214748.3647 mm"),
            ("0x3000", "5 mm", "a whole number"),
        ] {
            let wrong = Upids.in_unit(address, text).unwrap_err().to_string();
            assert!(wrong.contains(part), "{wrong}");
        }
        assert_eq!(Upids.show("home-position", 0xFFFF_FFFB), "-0.0005 mm (raw -5, 0xFFFFFFFB)");
        assert_eq!(Upids.show("0x20A8", 0x1E0F), "7695 (0x1E0F)");
        assert_eq!(Upids.show("article-number", 0x4C45_4946), "\"FIEL\" (0x4C454946)");
        assert_eq!(Upids.number("core-temperature", 0xFFFE), -2);
        for (raw, celsius) in [(0, -50.0), (51, 0.0), (82, 30.39), (255, 200.0), (0x7_0052, 30.39)] {
            assert_eq!(Upid(0x1BF3).known().map(|known| known.value(raw)), Some(celsius), "{raw}");
        }
        assert_eq!(Upids.show("motor-temperature", 82), "30.39 C (raw 82, 0x52)");
        assert!(Upids.reason(0xC0).contains("no such UPID"));
    }

    #[test]
    fn written_addresses_parse_back_in_both_memories_and_every_size() {
        assert_eq!(Upids.read_back("monitor-source-1.both"), ["0x20A8", "0x20A8.rom"]);
        assert_eq!(Upids.read_back("monitor-source-1.rom"), ["monitor-source-1.rom"]);
        for (address, written, read, same) in [
            // Of a type that nobody knows here: what a parameter of 16 or 8 bits makes of it.
            ("0x3100", 0xFFFF_FFFF, 0xFFFF_FFFF, true),
            ("0x3100", 0xFFFF_FFFF, 0xFFFF, true),
            ("0x3100", 0xFFFF_FFFF, 0xFF, true),
            ("0x3100", 0xFFFF_FFFE, 0xFFFF, false),
            ("0x3100", 0xFFFF, 0xFFFF_FFFF, true),
            ("0x3100", 0x12345, 0x2345, false),
            ("0x3100", 0x1_0000, 0, false),
            ("0x3100", 5, 5, true),
            ("0x3100", 5, 6, false),
            ("home-position", 0xFFFF_FFFF, 0xFFFF, false),
            ("monitor-source-1", 0x1E0F, 0x1E0F, true),
            ("core-temperature", 0xFFFF_FFFE, 0xFFFE, true),
        ] {
            assert_eq!(Upids.is_same(address, written, read), same, "{address} {written:X}h {read:X}h");
        }
    }
}
