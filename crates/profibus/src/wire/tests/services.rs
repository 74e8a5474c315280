//! The services of DP-V0.

use super::super::dp::{
    Configuration, Diagnosis, DiagnosisStatus, GlobalControl, SetPrm, Watchdog, dpv1, station_status,
};
use super::super::fc::FunctionCode;
use super::super::sap::{Service, global_control};
use super::*;

#[test]
fn pyprofibus_telegrams_of_a_start_up_and_of_data_exchange() {
    // In the order of the sheet: the frame count bit toggles over all services.
    let head = |service: Service, fcb, fcv| service.head(SLAVE, MASTER, fcb, fcv);
    golden("68 05 05 68 87 82 6D 3C 3E F0 16", head(Service::SlaveDiag, true, false), &[]);
    let parameters = SetPrm {
        status: station_status::LOCK,
        watchdog: Some(Watchdog { factors: [10, 5] }),
        min_tsdr: 11,
        ident: 0x0082,
        groups: 0,
        user: &[dpv1::ENABLE, 0, 0],
    };
    let prm = head(Service::SetPrm, false, true);
    let text = "68 0F 0F 68 87 82 5D 3D 3E 88 0A 05 0B 00 82 00 80 00 00 85 16";
    assert_eq!(emitted(|out| prm.emit_with(out, |du| parameters.put(du))), hex(text));
    assert_eq!(frame(&hex(text)).head, prm);
    golden("68 07 07 68 87 82 7D 3E 3E F3 F1 E6 16", head(Service::ChkCfg, true, true), &[0xF3, 0xF1]);
    golden("68 05 05 68 87 82 5D 3B 3E DF 16", head(Service::GetCfg, false, true), &[]);
    golden(
        "68 0F 0F 68 07 02 7D 10 3D 00 00 00 00 00 00 04 7F 10 00 66 16",
        head(Service::DataExchange, true, true),
        &hex("10 3D 00 00 00 00 00 00 04 7F 10 00"),
    );
    // The replies in Data_Exchange.
    for (text, fc) in [
        ("68 0F 0F 68 02 07 08 20 3D 00 00 00 06 8F B0 02 37 10 00 FC 16", 0x08),
        ("68 0F 0F 68 02 07 0A 20 3D 00 00 00 06 8F B0 02 37 10 00 FE 16", 0x0A),
    ] {
        let head = Head { da: MASTER, sa: SLAVE, dsap: None, ssap: None, fc: FunctionCode(fc) };
        golden(text, head, &hex("20 3D 00 00 00 06 8F B0 02 37 10 00"));
    }
    assert_eq!(Next::parse(&[0xE5]), Next::Telegram { telegram: Telegram::Acknowledge, size: 1 });
    for (text, command, groups) in [
        ("68 07 07 68 FF 82 46 3A 3E 00 00 3F 16", GlobalControl::OPERATE, 0),
        ("68 07 07 68 FF 82 46 3A 3E 02 00 41 16", GlobalControl::CLEAR, 0),
        ("68 07 07 68 FF 82 46 3A 3E 20 01 60 16", GlobalControl::SYNC, 1),
    ] {
        golden(text, global_control(MASTER), &GlobalControl { command, groups }.data());
    }
}

#[test]
fn a_diagnosis_is_that_of_pyprofibus_and_of_manual_2130() {
    let data = hex("02 05 00 FF 00 82");
    let diagnosis = Diagnosis::parse(&data).expect("six bytes");
    assert_eq!((diagnosis.master, diagnosis.ident, diagnosis.extended), (None, 0x0082, &[][..]));
    let names: Vec<_> = diagnosis.status.names().collect();
    assert_eq!(names, ["not ready", "parametrisation requested", "slave"]);
    assert!(diagnosis.status.has(DiagnosisStatus::NOT_READY | DiagnosisStatus::PRM_REQ));
    assert!(!diagnosis.status.has_any(DiagnosisStatus::PRM_FAULT | DiagnosisStatus::CFG_FAULT));
    assert!((0..6).all(|size| Diagnosis::parse(&data[..size]).is_none()));
    // Manual 2130: a fault in the extended diagnosis.
    let fault = |extended: &str| {
        let data = [hex("08 0C 00 02 00 82"), hex(extended)].concat();
        Diagnosis::parse(&data).expect("six bytes").fault()
    };
    assert_eq!(fault("03 23 10"), Some(0x2310));
    assert_eq!(fault("03 00 00"), Some(0));
    assert_eq!(fault(""), None);
    // Behind modules, a channel and a revision; an alarm of DP-V1 before it is not it.
    assert_eq!(fault("42 01 81 42 21 C5 03 75 00"), Some(0x7500));
    assert_eq!(fault("05 81 00 00 00 03 23 10"), Some(0x2310));
    // Cut, or without a size.
    assert_eq!((fault("03 23"), fault("00 03 23 10")), (None, None));
}

#[test]
fn each_bit_of_a_diagnosis_is_where_the_sheet_says() {
    use DiagnosisStatus as D;
    // Bytes, bits from, and four of the sheet; 0 is one without a meaning.
    for (byte, from, bits) in [
        (0, 0, [D::NON_EXISTENT, D::NOT_READY, D::CFG_FAULT, D::EXT_DIAG]),
        (0, 4, [D::NOT_SUPPORTED, D::INVALID_REPLY, D::PRM_FAULT, D::MASTER_LOCK]),
        (1, 0, [D::PRM_REQ, D::STAT_DIAG, D::ALWAYS, D::WD_ON]),
        (1, 4, [D::FREEZE, D::SYNC, 0, D::DEACTIVATED]),
        (2, 4, [0, 0, 0, D::OVERFLOW]),
    ] {
        for (bit, expected) in (from..).zip(bits).filter(|(_, expected)| *expected != 0) {
            let mut data = [0; 6];
            data[byte] = 1 << bit;
            let status = Diagnosis::parse(&data).expect("six bytes").status;
            assert_eq!((status, status.names().count()), (D(expected), 1), "byte {byte}, bit {bit}");
        }
    }
}

#[test]
fn the_watchdog_of_a_slave_is_as_short_as_it_can_be() {
    for units in (0..1000).chain((1000..70_000).step_by(37)) {
        match Watchdog::at_least(units) {
            // Every time up to 255 can be met, and above that some; the factors are no zeros.
            Some(watchdog) => {
                assert!(
                    watchdog.units() >= units.max(1) && watchdog.factors.iter().all(|factor| *factor > 0)
                );
                assert!(units > 255 || watchdog.units() == units.max(1));
                // No more than what one factor alone is rounded up to.
                let largest = units.div_ceil(255).max(1);
                assert!(watchdog.units() <= units.max(1).div_ceil(largest) * largest, "{units}");
            }
            None => assert!(units > 255 * 255),
        }
    }
    assert_eq!(Watchdog::at_least(255 * 255).map(|watchdog| watchdog.factors), Some([255, 255]));
    let put = |watchdog| {
        let mut out = [0xEE; 7];
        let mut writer = super::super::Writer::new(&mut out);
        let status = station_status::LOCK | station_status::WATCHDOG;
        SetPrm { status, watchdog, min_tsdr: 0, ident: 0x1234, groups: 3, user: &[] }.put(&mut writer);
        assert_eq!(writer.finish(), Some(7));
        out
    };
    assert_eq!(put(None), [0x80, 0, 0, 0, 0x12, 0x34, 3], "off, whatever the status says");
    assert_eq!(put(Some(Watchdog { factors: [2, 3] })), [0x88, 2, 3, 0, 0x12, 0x34, 3]);
}

#[test]
fn identifier_bytes_of_the_sheet() {
    for (bytes, sizes) in [
        // Inputs and outputs of 4 words, and of 2.
        (&[0xF3][..], Some((8, 8))),
        (&[0xF3, 0xF1], Some((12, 12))),
        (&[0x10], Some((1, 0))),
        (&[0x21], Some((0, 2))),
        (&[0x5F], Some((32, 0))),
        (&[0x00], Some((0, 0))),
        // Special formats: outputs of 4 words, inputs of 3 bytes, both with two bytes of the manufacturer.
        (&[0x80, 0xC3], Some((0, 8))),
        (&[0x40, 0x02], Some((3, 0))),
        (&[0xC2, 0x41, 0x80, 0xAA, 0xBB, 0x10], Some((2, 4))),
        (&[0x4F, 0x00], Some((1, 0))),
        // Cut.
        (&[0x10, 0xC2, 0x41], None),
        (&[0x10, 0xC2, 0x41, 0x80, 0xAA], None),
    ] {
        assert_eq!(Configuration(bytes).sizes(), sizes, "{bytes:02X?}");
    }
}
