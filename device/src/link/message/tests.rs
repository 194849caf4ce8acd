//! Golden payloads, written by hand from docs/PROTOCOL.md, encoded and decoded, and the refusal of malformed variants.

use super::*;
use crate::planes::Channel;
use proptest::prelude::*;

fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text.bytes().filter(|b| b.is_ascii_hexdigit()).collect();
    digits.chunks(2).map(|d| u8::from_str_radix(std::str::from_utf8(d).unwrap(), 16).unwrap()).collect()
}

fn host(message: HostMessage, kind: MessageType, golden: &str) {
    let mut out = [0xaa; MAX_CONTROL_BYTES];
    let (k, n) = message.write(&mut out);
    assert_eq!((k, &out[..n]), (kind, &hex(golden)[..]));
    assert_eq!(HostMessage::parse(kind, &hex(golden)), Ok(message));
}

fn device(message: DeviceMessage, kind: MessageType, golden: &str) {
    let mut out = [0xaa; MAX_CONTROL_BYTES];
    let (k, n) = message.write(&mut out);
    assert_eq!((k, &out[..n]), (kind, &hex(golden)[..]));
    assert_eq!(DeviceMessage::parse(kind, &hex(golden)), Ok(message));
}

#[test]
fn golden_messages_of_the_host() {
    host(
        HostMessage::Hello(HostHello { version_min: 1, version_max: 3, codecs: 0x0f }),
        MessageType::Hello,
        "0100 0300 0f000000",
    );
    let planes = [(Channel::Red, 7), (Channel::Green, 0), (Channel::White, 3)]
        .map(|(channel, bit)| PlaneSpec { channel, bit });
    host(
        HostMessage::Config(Config {
            raster: Raster::new(1024, 768).unwrap(),
            schedule: PlaneSchedule::new(&planes).unwrap(),
            rate: FrameRate::new(60_000, 1001).unwrap(),
            watchdog_us: 50_000,
            underrun: Underrun::Blank,
            late_slots: 2,
            epoch: DeviceTicks(0x0102_0304_0506_0708),
            limits: LightLimits { mean_permille: 300, window_ms: 10_000, full_white_ms: 70_000 },
        }),
        MessageType::Config,
        "0004 0003 60ea0000 e9030000 50c30000 03 01 02 00 2c01 0000 0807060504030201 10270000 70110100 07 10 33",
    );
    host(HostMessage::Arm(0x11), MessageType::Arm, "11000000");
    host(
        HostMessage::Commit(Commit {
            sent: 0x00ff_fffe,
            kept: 1,
            base_frame: 0x0102,
            frames_sent: 0xffff_ffff,
            dark_from: DeviceTicks(0x1122_3344_5566_7788),
        }),
        MessageType::FrameCommit,
        "feffff00 01000000 02010000 ffffffff 8877665544332211",
    );
    host(HostMessage::Sync(258), MessageType::Sync, "02010000");
    host(
        HostMessage::Echo(Echo {
            host_sent_ns: 0x1122_3344_5566_7788,
            device_received: DeviceTicks(0),
            device_sent: DeviceTicks(0),
        }),
        MessageType::Echo,
        "8877665544332211 0000000000000000 0000000000000000",
    );
    host(HostMessage::Stop, MessageType::Stop, "");
    host(HostMessage::Black, MessageType::Black, "");
    host(HostMessage::Freeze, MessageType::Freeze, "");
    host(HostMessage::Safe, MessageType::Safe, "");
}

/// Planes of equal light: a flag permits what is refused without it, and no mirror may become brighter than white.
#[test]
fn an_led_code_may_repeat_only_where_the_flag_says_so() {
    let equal = [PlaneSpec { channel: Channel::White, bit: 6 }; 3];
    let config = Config {
        raster: Raster::new(8, 8).unwrap(),
        schedule: PlaneSchedule::with_repeats(&equal).unwrap(),
        rate: FrameRate::new(60, 1).unwrap(),
        watchdog_us: 1,
        underrun: Underrun::Repeat,
        late_slots: 0,
        epoch: DeviceTicks(0),
        limits: LightLimits::OFF,
    };
    let mut out = [0; MAX_CONTROL_BYTES];
    let (kind, n) = HostMessage::Config(config).write(&mut out);
    assert_eq!(out[16..20], [3, 0, 0, 1]);
    assert_eq!(HostMessage::parse(kind, &out[..n]), Ok(HostMessage::Config(config)));
    out[19] = 0;
    assert!(HostMessage::parse(kind, &out[..n]).is_err(), "a code twice without the flag");
    (out[19], out[40]) = (1, 0x37);
    assert!(HostMessage::parse(kind, &out[..n]).is_err(), "128 + 64 + 64 of 255");
    assert!(PlaneSchedule::with_repeats(&[equal[0]; 4]).is_none());
    assert!(PlaneSchedule::equal24().has_repeats() && !PlaneSchedule::rgb24().has_repeats());
    assert_eq!(PlaneSchedule::with_repeats(PlaneSchedule::rgb24().planes()), Some(PlaneSchedule::rgb24()));
}

#[test]
fn golden_messages_of_the_device() {
    device(
        DeviceMessage::Hello(DeviceHello {
            version: 1,
            firmware: 0x0203,
            codecs: 1,
            raster: Raster::new(320, 240).unwrap(),
            max_planes: 24,
            frame_buffers: 4,
            tick_hz: 1_000_000_000,
            min_plane_ns: 44_000,
            serial: 0x1122_3344_5566_7788,
            now: DeviceTicks(9),
        }),
        MessageType::Hello,
        "0100 0302 01000000 4001 f000 18 04 0000 00ca9a3b e0ab0000 8877665544332211 0900000000000000",
    );
    device(
        DeviceMessage::Status(Status {
            state: DeviceState::Faulted,
            lit: true,
            last_plane: 23,
            buffers_free: 2,
            faults: faults::WATCHDOG | faults::LAMP,
            frame_limit: 4,
            frames_accounted: 3,
            last_whole_frame: 0x0a0b_0c0d,
            last_lit_frame: 0x0a0b_0c0c,
            last_lit_at: DeviceTicks(0x0101_0101_0101_0101),
            now: DeviceTicks(0x0202_0202_0202_0202),
            slots: 1,
            frames_seen: 2,
            frames_lit: 3,
            slots_repeated: 4,
            slots_blank: 5,
            frames_incomplete: 6,
            frames_late: 7,
            frames_superseded: 8,
            frames_refused: 9,
            packets: 10,
            header_errors: 11,
            payload_errors: 12,
            packets_ignored: 13,
            bytes_skipped: 14,
        }),
        MessageType::Status,
        "06 01 17 02 05000000 04000000 03000000 0d0c0b0a 0c0c0b0a 0101010101010101 0202020202020202
         01000000 02000000 03000000 04000000 05000000 06000000 07000000 08000000 09000000 0a000000 0b000000
         0c000000 0d000000 0e000000",
    );
    device(
        DeviceMessage::Echo(Echo {
            host_sent_ns: 1,
            device_received: DeviceTicks(2),
            device_sent: DeviceTicks(3),
        }),
        MessageType::Echo,
        "0100000000000000 0200000000000000 0300000000000000",
    );
    device(
        DeviceMessage::Fault(Fault {
            latched: 1,
            code: FaultCode::Config,
            detail: ConfigRefusal::Rate as u16,
            at: DeviceTicks(0x99),
        }),
        MessageType::Fault,
        "01000000 0200 0300 9900000000000000",
    );
}

#[test]
fn wrong_fields_are_named() {
    let good = hex("0004 0003 60ea0000 e9030000 50c30000 03 01 02 00 2c01 0000 0807060504030201 10270000 70110100 07 10 33");
    let broken = |at: usize, value: u8| {
        let mut p = good.clone();
        p[at] = value;
        HostMessage::parse(MessageType::Config, &p)
    };
    let field = |field| Err(PayloadError::Field { kind: MessageType::Config, field });
    assert_eq!(broken(16, 0), field("planes"));
    assert_eq!(broken(16, 33), field("planes"));
    assert_eq!(broken(16, 4), Err(PayloadError::Length { kind: MessageType::Config, expected: 44, got: 43 }));
    assert_eq!(broken(17, 2), field("underrun"));
    assert_eq!(broken(40, 0x08), field("led codes"));
    assert_eq!(broken(41, 0x07), field("led codes"), "a plane stands twice");
    // 300 + 0x400 thousandths, a window of less than half a second, full white for less than that.
    assert_eq!(broken(21, 5), field("limits"));
    assert_eq!(broken(33, 0), field("limits"));
    let mut zero = good.clone();
    zero[..2].fill(0);
    assert_eq!(HostMessage::parse(MessageType::Config, &zero), field("raster"));
    let mut rate = good.clone();
    rate[4..8].fill(0);
    assert_eq!(HostMessage::parse(MessageType::Config, &rate), field("frame rate"));
    let mut watchdog = good;
    watchdog[12..16].copy_from_slice(&(MAX_WATCHDOG_US + 1).to_le_bytes());
    assert_eq!(HostMessage::parse(MessageType::Config, &watchdog), field("watchdog"));
}

proptest! {
    /// Any bytes under any type: a value or an error, and a value written again gives the same bytes up to reserved fields.
    #[test]
    fn any_payload_is_survived(code in 0u8..16, p in prop::collection::vec(any::<u8>(), 0..100)) {
        let Some(kind) = MessageType::from_code(code) else { return Ok(()) };
        let mut out = [0; MAX_CONTROL_BYTES];
        if let Ok(m) = HostMessage::parse(kind, &p) {
            let (k, n) = m.write(&mut out);
            prop_assert_eq!((k, n), (kind, p.len()));
            prop_assert_eq!(HostMessage::parse(kind, &out[..n]), Ok(m));
        }
        if let Ok(m) = DeviceMessage::parse(kind, &p) {
            let (k, n) = m.write(&mut out);
            prop_assert_eq!((k, n), (kind, p.len()));
            prop_assert_eq!(DeviceMessage::parse(kind, &out[..n]), Ok(m));
        }
    }
}
