//! The telegrams of the sheet, byte by byte.

use super::*;

/// Section 6 of the sheet: pyprofibus' telegrams, address 7, master 2. Min Tsdr and bytes are exact at every rate.
#[test]
fn the_telegrams_of_the_sheet_are_answered_as_the_sheet_has_it() {
    let table = [
        ("10 07 02 49 52 16", "10 02 07 00 09 16"),
        ("68 05 05 68 87 82 6D 3C 3E F0 16", "68 0B 0B 68 82 87 08 3E 3C 02 05 00 FF 00 82 13 16"),
        ("68 0F 0F 68 87 82 5D 3D 3E 88 0A 05 0B 00 82 00 80 00 00 85 16", "E5"),
        ("68 07 07 68 87 82 7D 3E 3E F3 F1 E6 16", "E5"),
        ("68 05 05 68 87 82 5D 3B 3E DF 16", "68 07 07 68 82 87 08 3E 3B F3 F1 6E 16"),
        ("68 07 07 68 FF 82 46 3A 3E 00 00 3F 16", ""),
        // Switch-on inhibited, enabled by its hardware, remote; C0061 is answered behind its job.
        (
            "68 0F 0F 68 07 02 7D 10 3D 00 00 00 00 00 00 04 7F 10 00 66 16",
            "68 0F 0F 68 02 07 08 00 00 00 00 00 00 00 00 02 50 00 00 63 16",
        ),
    ];
    for rate in RATES {
        let settings = LenzeSettings { channel: Channel::Pkw, ..LenzeSettings::new(SLAVE) };
        let mut bench = Bench::at(rate, settings);
        for (request, answer) in table {
            // Behind Chk_Cfg it takes a millisecond.
            bench.wait(2 * MS + bench.line.bits_ns(33));
            bench.put(&hex(request));
            let reply = bench.take(3 * MS + bench.line.bits_ns(800) + bench.line.span_ns(40));
            let expected = (!answer.is_empty()).then(|| hex(answer));
            assert_eq!(reply.as_ref().map(|reply| &reply.bytes), expected.as_ref(), "{request} at {rate}");
            if let Some(reply) = reply {
                let error = reply.after.abs_diff(bench.line.bits_ns(11));
                assert!(error <= 1, "{request} at {rate}: {}", reply.after);
            }
        }
        assert_eq!(bench.slave().misuse(), Misuse { control_word: 1, ..Misuse::default() }, "0x047F");
        assert_eq!(bench.slave().dp_state(), (DpState::DataExchange, Some(MASTER)));
        // The same telegrams as SD3, where there are 8 bytes.
        let link = LinkSettings { sd3: true, ..LinkSettings::default() };
        let mut bench = Bench::at(rate, LenzeSettings { link, ..LenzeSettings::new(SLAVE) });
        let answer = bench.ask(&hex(table[1].0));
        assert_eq!(answer, Some(hex("A2 82 87 08 3E 3C 02 05 00 FF 00 82 13 16")));
    }
}
