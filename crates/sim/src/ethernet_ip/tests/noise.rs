//! Any bytes at any split, on each socket: no panic, nothing grows, and the drive works on.

use proptest::collection::vec;
use proptest::prelude::*;

use super::*;

/// Frames that are nearly right, so that more than the first check is reached.
fn nearly() -> impl Strategy<Value = Vec<u8>> {
    let message = prop_oneof![
        Just(Forward::default().bytes()),
        Just(Forward::messages().bytes()),
        Just(Forward { ncp: (0x4846, 0x283A), ..Forward::default() }.bytes()),
        Just(Forward::default().close()),
        Just(hex("3C 03 20 64 24 01 30 01 00 01 00 66 00 00 00 00")),
        Just(hex("3C 03 20 64 24 01 30 01 00 02 83 26 00 64 00 00")),
        Just(hex("01 02 20 01 24 01")),
        Just(hex("10 03 20 F5 24 01 30 0D 01 00")),
        vec(any::<u8>(), 0..80),
    ];
    let noise = vec((any::<usize>(), any::<u8>()), 0..4);
    (message, noise, any::<bool>()).prop_map(|(mut message, noise, connected)| {
        for (at, value) in noise {
            let length = message.len().max(1);
            if let Some(byte) = message.get_mut(at % length) {
                *byte = value;
            }
        }
        let mut data = vec![0; 6];
        if connected {
            data.extend(hex("02 00 A1 00 04 00 13 00 01 5A B1 00"));
            data.extend((message.len() as u16 + 2).to_le_bytes());
            data.extend([1, 0]);
        } else {
            data.extend(hex("02 00 00 00 00 00 B2 00"));
            data.extend((message.len() as u16).to_le_bytes());
        }
        data.extend(message);
        frame(if connected { 0x70 } else { 0x6F }, 0x101, &data)
    })
}

fn bytes() -> impl Strategy<Value = Vec<u8>> {
    let packet = (0_u32..4, any::<u16>(), any::<u32>(), vec(any::<i32>(), 16)).prop_map(
        |(sequence, count, header, elements)| {
            let mut elements: Vec<_> = elements.into_iter().enumerate().collect();
            let word = 1 << (elements[0].1 & 31);
            elements[0].1 = word;
            packet(0x5A01_0013, sequence, count, header, &outputs(0, &elements))
        },
    );
    prop_oneof![vec(any::<u8>(), 0..200), nearly(), packet]
}

proptest! {
    #[test]
    fn any_bytes_leave_the_drive_working(
        parcels in vec((0_usize..3, bytes(), any::<prop::sample::Index>(), 0_u64..200), 1..40),
    ) {
        let mut bench = Bench::owned(|settings| settings.motor.encoder = Some(1.0));
        for (socket, bytes, split, ms) in parcels {
            let at = split.index(bytes.len() + 1);
            let from = if socket == PACKETS { MASTER_IO } else { MASTER };
            // A datagram is whole.
            let parts = if socket == 0 { vec![&bytes[..at], &bytes[at..]] } else { vec![&bytes[..]] };
            for part in parts {
                let mut reply = Vec::new();
                bench.sim.receive_at(socket, bench.now, from, part, &mut reply);
                prop_assert!(reply.len() < 20_000);
            }
            if bench.sim.hangs_up(MASTER) {
                bench.sim.disconnected(bench.now, MASTER);
                bench.session = bench.connect(MASTER);
            }
            bench.pass(ms * MS);
            bench.sent.clear();
        }
        bench.sim.disconnected(bench.now, MASTER);
        bench.pass(15 * S);
        prop_assert!(bench.sim.connections().1 <= 6);
        bench.session = bench.connect(MASTER);
        let identity = bench.message(&hex("0E 03 20 01 24 01 30 01"));
        prop_assert_eq!(identity, hex("8E 00 00 00 3C 00"));
        let truth = bench.sim.truth(bench.now);
        prop_assert!(truth.position.is_finite() && truth.velocity.is_finite());
    }
}
