//! Golden payloads, written by hand from docs/PROTOCOL.md, encoded and decoded, and the refusal of malformed variants.

use super::*;
use crate::link::tracks::{Area, Region};
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
            tracks: false,
            timing: false,
            shifts: false,
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
    let shift = SlotShift { slot: 258, epoch: DeviceTicks(0x0102_0304_0506_0708) };
    host(HostMessage::Shift(shift), MessageType::Shift, "0201000000000000 0807060504030201");
    host(
        HostMessage::Echo(Echo {
            host_sent_ns: 0x1122_3344_5566_7788,
            device_received: DeviceTicks(0),
            device_sent: DeviceTicks(0),
        }),
        MessageType::Echo,
        "8877665544332211 0000000000000000 0000000000000000",
    );
    golden_tracks();
    host(HostMessage::Stop, MessageType::Stop, "");
    host(HostMessage::Black, MessageType::Black, "");
    host(HostMessage::Freeze, MessageType::Freeze, "");
    host(HostMessage::Safe, MessageType::Safe, "");
}

/// Two regions of frame 0x01020304, 11 ms from the tick 0x1122334455667788 on.
fn golden_tracks() {
    let mut tracks = Tracks::new(0x0102_0304, 5, DeviceTicks(0x1122_3344_5566_7788), 11_000);
    tracks.push(Region {
        area: Area { left: 0x0102, top: 0x0304, width: 0x0506, height: 0x0708 },
        clamp: 8,
        gate: 192,
        offset: [-1, 2],
        velocity: [3, -4],
        half_acceleration: [-5, 6],
        drawn: [448, -448],
    });
    tracks.push(Region { area: Area { left: 0, top: 0, width: 1, height: 1 }, ..Region::default() });
    host(
        HostMessage::Tracks(tracks),
        MessageType::Tracks,
        "04030201 05000000 8877665544332211 f82a0000 02 000000
         0201 0403 0605 0807 08 00 c000 ffff 0200 0300 fcff fbff 0600 c001 40fe
         0000 0000 0100 0100 00 00 0000 0000 0000 0000 0000 0000 0000 0000 0000",
    );
    let nothing = "00000000 01000000 0000000000000000 01000000 00 000000";
    host(HostMessage::Tracks(Tracks::new(0, 1, DeviceTicks(0), 1)), MessageType::Tracks, nothing);
    let broken = |at: usize, value: u8| {
        let mut p = hex(nothing);
        p[at] = value;
        HostMessage::parse(MessageType::Tracks, &p)
    };
    let kind = MessageType::Tracks;
    assert_eq!(broken(16, 0), Err(PayloadError::Field { kind, field: "lasts" }));
    assert_eq!(broken(17, 0x4f), Err(PayloadError::Field { kind, field: "lasts" }), "20.2 ms");
    assert_eq!(broken(20, 9), Err(PayloadError::Field { kind, field: "regions" }));
    assert_eq!(broken(20, 1), Err(PayloadError::Length { kind, expected: 52, got: 24 }));
    assert_eq!(DeviceMessage::parse(kind, &hex(nothing)), Err(PayloadError::Direction(kind)));
}

/// A device that follows tracks says so where a device before tracks has zeros; CONFIG asks for it by a bit that a device
/// before tracks does not look at, and only then STATUS is longer.
#[test]
fn tracks_are_offered_asked_for_and_counted_beside_what_older_ends_know() {
    let offering =
        hex("0200 0302 01000000 4001 f000 18 04 01 10 00ca9a3b e0ab0000 8877665544332211 0900000000000000");
    let Ok(DeviceMessage::Hello(hello)) = DeviceMessage::parse(MessageType::Hello, &offering) else {
        panic!()
    };
    assert_eq!(hello.greatest_shift, Some(16));
    let mut out = [0; MAX_CONTROL_BYTES];
    let (_, n) = DeviceMessage::Hello(hello).write(&mut out);
    assert_eq!(&out[..n], &offering[..]);

    let asks = hex(
        "0004 0003 60ea0000 e9030000 50c30000 01 01 02 02 2c01 0000 0807060504030201 10270000 70110100 07",
    );
    let Ok(HostMessage::Config(config)) = HostMessage::parse(MessageType::Config, &asks) else { panic!() };
    assert!(config.tracks && !config.schedule.has_repeats());
    let (_, n) = HostMessage::Config(config).write(&mut out);
    assert_eq!(&out[..n], &asks[..]);

    let long = [&[0u8; 96][..], &hex("01000000 02000000 03000000 04000000 05000000 06000000")].concat();
    let Ok(DeviceMessage::Status(status)) = DeviceMessage::parse(MessageType::Status, &long) else {
        panic!()
    };
    let counts = TrackCounts {
        taken: 1,
        refused: 2,
        planes_moved: 3,
        planes_clamped: 4,
        planes_stale: 5,
        greatest_age: 6,
    };
    assert_eq!(status.tracks, Some(counts));
    let (_, n) = DeviceMessage::Status(status).write(&mut out);
    assert_eq!(&out[..n], &long[..]);
    let refused = DeviceMessage::parse(MessageType::Status, &long[..119]);
    assert_eq!(refused, Err(PayloadError::Length { kind: MessageType::Status, expected: 96, got: 119 }));
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
        tracks: false,
        timing: false,
        shifts: false,
    };
    let mut out = [0; MAX_CONTROL_BYTES];
    let (kind, n) = HostMessage::Config(config).write(&mut out);
    assert_eq!(out[16..20], [3, 0, 0, 1]);
    assert_eq!(HostMessage::parse(kind, &out[..n]), Ok(HostMessage::Config(config)));
    out[19] = 0;
    assert!(HostMessage::parse(kind, &out[..n]).is_err(), "a code twice without the flag");
    (out[19], out[40]) = (1, 0x37);
    assert!(HostMessage::parse(kind, &out[..n]).is_err(), "128 + 64 + 64 of 255");
    // Planes that share the full light: the flag permits any sum, and is a part of the schedule.
    out[19] = 5;
    let Ok(HostMessage::Config(shared)) = HostMessage::parse(kind, &out[..n]) else { panic!() };
    assert!(shared.schedule.fills() && shared.schedule.white_weight() == 256);
    let mut again = [0; MAX_CONTROL_BYTES];
    assert_eq!(HostMessage::Config(shared).write(&mut again), (kind, n));
    assert_eq!(again[..n], out[..n]);
    out[19] = 4;
    assert!(HostMessage::parse(kind, &out[..n]).is_err(), "a code twice without its flag");
    // Planes that exceed full light: only by their own flag, beside the one for codes that repeat.
    out[19] = 33;
    let Ok(HostMessage::Config(more)) = HostMessage::parse(kind, &out[..n]) else { panic!() };
    assert!(more.schedule.exceeds() && !more.schedule.fills() && more.schedule.full_light() == 256);
    assert_eq!(HostMessage::Config(more).write(&mut again), (kind, n));
    assert_eq!(again[..n], out[..n]);
    for (flags, why) in [(32, "a code twice without its flag"), (37, "both meanings"), (65, "no meaning")] {
        out[19] = flags;
        assert!(HostMessage::parse(kind, &out[..n]).is_err(), "{why}");
    }
    (out[19], out[40]) = (33, 0x36);
    assert!(HostMessage::parse(kind, &out[..n]).is_err(), "64 + 64 + 64 exceed nothing");
    out[40] = 0x37;
    out[19] = 17;
    assert!(HostMessage::parse(kind, &out[..n]).is_err(), "shifts without the report that confirms them");
    out[19] = 29;
    assert!(HostMessage::parse(kind, &out[..n]).is_ok());
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
            greatest_shift: None,
            measures_timing: false,
            shifts_slots: false,
            exceeds: true,
            tick_hz: 1_000_000_000,
            min_plane_ns: 44_000,
            serial: 0x1122_3344_5566_7788,
            now: DeviceTicks(9),
        }),
        MessageType::Hello,
        "0100 0302 01000000 4001 f000 18 04 08 00 00ca9a3b e0ab0000 8877665544332211 0900000000000000",
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
            tracks: None,
            timing: None,
        }),
        MessageType::Status,
        "06 01 17 02 05000000 04000000 03000000 0d0c0b0a 0c0c0b0a 0101010101010101 0202020202020202
         01000000 02000000 03000000 04000000 05000000 06000000 07000000 08000000 09000000 0a000000 0b000000
         0c000000 0d000000 0e000000",
    );
    let timing =
        FrameTiming { frame: 0x0a0b_0c0d, slack_ns: -2, transfer_ns: 0x0102_0304, epoch: 0x0506_0708 };
    let tracks = TrackCounts {
        taken: 1,
        refused: 2,
        planes_moved: 3,
        planes_clamped: 4,
        planes_stale: 5,
        greatest_age: 6,
    };
    let moved = "01000000 02000000 03000000 04000000 05000000 06000000";
    let timed = "0d0c0b0a feffffff 04030201 08070605";
    for (tracks, timing, more) in [
        (Some(tracks), None, moved.to_owned()),
        (None, Some(timing), timed.to_owned()),
        (Some(tracks), Some(timing), format!("{moved} {timed}")),
    ] {
        let status = Status { tracks, timing, ..Status::default() };
        let nothing = "00 00 00 00".repeat(24);
        device(DeviceMessage::Status(status), MessageType::Status, &format!("{nothing} {more}"));
    }
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
    fn any_payload_is_survived(code in 0u8..16, p in prop::collection::vec(any::<u8>(), 0..260)) {
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
