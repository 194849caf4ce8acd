//! The messages byte for byte, and what damaged ones do.

use super::*;
use crate::cobs::Deframer;
use proptest::prelude::*;

fn packet(message: &SensorMessage<'_>) -> Vec<u8> {
    let mut bytes = [0; MAX_FRAME];
    let n = message.encode(&mut bytes).expect("room");
    let mut packets = Vec::new();
    Deframer::new([0; MAX_PACKET]).push(&bytes[..n], &mut |p| packets.push(p.to_vec()));
    assert_eq!(packets.len(), 1);
    packets.remove(0)
}

fn sealed(mut bytes: Vec<u8>) -> Vec<u8> {
    bytes.extend(crc32c(&bytes).to_le_bytes());
    bytes
}

const HEAD: BlockHead = BlockHead {
    sequence: 0x0403_0201,
    first: 0x1817_1615_1413_1211,
    period: 0x000a_8000,
    lost: 7,
    gain: 2,
    cut_below: false,
    cut_above: true,
};

const HELLO: SensorHello = SensorHello {
    version: 1,
    bits: LevelBits::Twelve,
    running: true,
    ticks_per_second: 1_000_000,
    samples_per_second: 100_000,
    floor: 8,
    ceiling: 4080,
    serial: 0x0807_0605_0403_0201,
    name: *b"wand\0\0\0\0\0\0\0\0\0\0\0\0",
    gains_milli: [1000, 10_000, 0, 0, 0, 0, 0, 0],
    gain: 1,
};

#[test]
fn messages_byte_for_byte() {
    let head = [
        [1, 12, 3, 0].as_slice(),
        &[1, 2, 3, 4, 0x11, 0x12, 0x13, 0x14, 0x15, 0x16, 0x17, 0x18],
        &[0, 0x80, 0x0a, 0, 7, 0, 0, 0, 2, 2, 0, 0],
    ]
    .concat();
    let twelve = [&head[..], &[0xbc, 0x3a, 0x12, 0xff, 0x0f]].concat();
    let levels = [0xabc, 0x123, 0xfff];
    let samples = SensorMessage::Samples(HEAD, Levels::Values(LevelBits::Twelve, &levels));
    assert_eq!(packet(&samples), sealed(twelve));
    let mut sixteen = [&head[..], &[0xbc, 0x0a, 0x23, 0x01, 0xff, 0x0f]].concat();
    sixteen[1] = 16;
    let samples = SensorMessage::Samples(HEAD, Levels::Values(LevelBits::Sixteen, &levels));
    assert_eq!(packet(&samples), sealed(sixteen));
    let mut hello = vec![2, 1, 12, 1, 0x40, 0x42, 0x0f, 0, 0xa0, 0x86, 1, 0, 8, 0, 0xf0, 0x0f];
    hello.extend([1, 2, 3, 4, 5, 6, 7, 8]);
    hello.extend(*b"wand");
    hello.extend([0; 12]);
    hello.extend([0xe8, 3, 0, 0, 0x10, 0x27, 0, 0]);
    hello.extend([0; 24]);
    hello.extend([1, 0, 0, 0]);
    assert_eq!(packet(&SensorMessage::Hello(HELLO)), sealed(hello));
    let configure = SensorMessage::Configure { gain: 1, block: 128, samples_per_second: 200_000 };
    assert_eq!(packet(&configure), sealed(vec![0x15, 1, 128, 0, 0x40, 0x0d, 3, 0]));
    assert_eq!(packet(&SensorMessage::Refused(Refusal::Rate)), sealed(vec![3, 2, 0, 0]));
    assert_eq!(packet(&SensorMessage::Start), sealed(vec![0x13]));
    assert_eq!(HELLO.name_text(), "wand");
}

#[test]
fn the_time_of_a_sample_is_exact_for_any_block() {
    // 10.5 ticks a sample.
    assert_eq!(HEAD.ticks_of(0), (HEAD.first, 0));
    assert_eq!(HEAD.ticks_of(3), (HEAD.first + 31, PERIOD_ONE / 2));
    let slow = BlockHead { first: u64::MAX, period: u32::MAX, ..HEAD };
    let after = 255u64 * u64::from(u32::MAX);
    assert_eq!(slow.ticks_of(255), (after / 65_536 - 1, (after % 65_536) as u32));
}

#[test]
fn every_flipped_bit_is_noticed_and_no_field_goes_out_of_range() {
    let levels: Vec<u16> = (0..256).map(|i| i * 15).collect();
    let good = packet(&SensorMessage::Samples(HEAD, Levels::Values(LevelBits::Twelve, &levels)));
    for bit in 0..good.len() * 8 {
        let mut bad = good.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        assert_eq!(SensorMessage::decode(&bad), Err(SensorError::Crc));
    }
    let body = &good[..good.len() - 4];
    // Bits, count, period: what no sensor may send.
    for (at, byte) in [(1, 13), (2, 255), (3, 2), (3, 0)] {
        let mut bad = body.to_vec();
        bad[at] = byte;
        assert!(
            matches!(SensorMessage::decode(&sealed(bad)), Err(SensorError::Unknown { kind: 1, .. })),
            "{at}"
        );
    }
    let mut still = body.to_vec();
    still[16..20].fill(0);
    assert!(SensorMessage::decode(&sealed(still)).is_err());
    assert_eq!(SensorMessage::decode(&[1, 2, 3, 4]), Err(SensorError::Short(4)));
    let too_many = vec![0; MAX_SAMPLES + 1];
    for levels in [&too_many[..], &[]] {
        let block = SensorMessage::Samples(HEAD, Levels::Values(LevelBits::Sixteen, levels));
        assert_eq!(block.encode(&mut [0; 2048]), None);
    }
    assert_eq!(SensorMessage::Start.encode(&mut [0; 5]), None, "too little room");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn levels_come_back(levels in proptest::collection::vec(any::<u16>(), 1..=MAX_SAMPLES), wide in any::<bool>()) {
        let bits = if wide { LevelBits::Sixteen } else { LevelBits::Twelve };
        let bytes = packet(&SensorMessage::Samples(HEAD, Levels::Values(bits, &levels)));
        let Ok(SensorMessage::Samples(head, back)) = SensorMessage::decode(&bytes) else { panic!() };
        prop_assert_eq!(head, HEAD);
        let wanted: Vec<u16> = levels.iter().map(|l| (*l).min(bits.highest())).collect();
        prop_assert_eq!(back.iter().collect::<Vec<_>>(), wanted);
    }

    #[test]
    fn any_packet_is_survived(mut bytes in proptest::collection::vec(any::<u8>(), 0..700), seal in any::<bool>()) {
        if seal {
            bytes = sealed(bytes);
        }
        if let Ok(SensorMessage::Samples(head, levels)) = SensorMessage::decode(&bytes) {
            prop_assert!(levels.iter().all(|l| l <= levels.bits().highest()));
            let _ = head.ticks_of(levels.len() - 1);
        }
    }
}
