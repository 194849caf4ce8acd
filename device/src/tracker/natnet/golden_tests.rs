//! Compares every NatNet message with bytes written by hand from the layout, in both directions, and with inconsistent
//! bytes.

use super::frame::*;
use super::messages::*;
use super::models::*;
use super::wire::*;
use proptest::prelude::*;

/// Decodes a text of hexadecimal pairs; ignores blanks and line breaks.
fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text.bytes().filter(|b| !b.is_ascii_whitespace()).collect();
    digits.chunks(2).map(|d| u8::from_str_radix(std::str::from_utf8(d).unwrap(), 16).unwrap()).collect()
}

/// Two rigid bodies: number 1 at (1, 2, -1), unrotated, error 0.5, tracked; number 300 at 0, half a turn about x, not tracked.
const BODIES: &str = "
    01000000 0000803f 00000040 000080bf 00000000 00000000 00000000 0000803f 0000003f 0100
    2c010000 00000000 00000000 00000000 0000803f 00000000 00000000 00000000 00000000 0000";

/// Timecode 7, subframe 8, time stamp 1.5 s, ticks 0x1122334455667788, + 1, + 2.
const STAMPS: &str = "
    07000000 08000000 000000000000f83f
    8877665544332211 8977665544332211 8a77665544332211";

fn bodies() -> [RigidBody; 2] {
    [
        RigidBody {
            id: 1,
            position: [1.0, 2.0, -1.0],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
            mean_error: 0.5,
            params: 1,
        },
        RigidBody {
            id: 300,
            position: [0.0; 3],
            rotation_xyzw: [1.0, 0.0, 0.0, 0.0],
            mean_error: 0.0,
            params: 0,
        },
    ]
}

fn info(precision: [u32; 2]) -> FrameInfo {
    FrameInfo {
        number: 0x01020304,
        timecode: [7, 8],
        timestamp_s: 1.5,
        mid_exposure: 0x1122_3344_5566_7788,
        data_received: 0x1122_3344_5566_7789,
        transmit: 0x1122_3344_5566_778a,
        precision,
        params: FrameInfo::MODELS_CHANGED | FrameInfo::LIVE,
    }
}

/// A 3.0 frame with something in every section.
fn full_v3() -> Vec<u8> {
    hex(&format!(
        "04030201
         01000000 4100 01000000 0000803f 0000803f 0000803f
         01000000 00000040 00000040 00000040
         02000000 {BODIES}
         01000000 05000000 01000000 06000000 00000000 00000000 00000000 00000000 00000000 00000000 0000803f 00000000 0100
         01000000 01000200 0000803f 00000000 00000000 0000003f 0200 00000000
         01000000 09000000 02000000 02000000 0000803f 00000040 00000000
         01000000 0a000000 01000000 01000000 0000803f
         {STAMPS} 0600 00000000"
    ))
}

/// A 4.1 frame: sizes after the counts, an asset of one body and one marker, a device section of a layout nobody knows.
fn full_v4_1() -> Vec<u8> {
    hex(&format!(
        "04030201
         01000000 12000000 4100 01000000 0000803f 0000803f 0000803f
         00000000 00000000
         02000000 4c000000 {BODIES}
         00000000 00000000
         01000000 4c000000 0b000000 01000000
           06000000 00000000 00000000 00000000 00000000 00000000 00000000 0000803f 00000000 0100
           01000000 01000200 0000803f 00000000 00000000 0000003f 0200 00000000
         00000000 00000000
         00000000 00000000
         03000000 05000000 dead beef 01
         {STAMPS} 0b000000 0c000000 0600 00000000"
    ))
}

fn decode(payload: &[u8], version: Version) -> Result<(FrameInfo, Vec<RigidBody>), WireError> {
    let mut bodies = Vec::new();
    decode_frame(payload, version, &mut bodies).map(|info| (info, bodies))
}

#[test]
fn frames_of_all_versions_are_read() {
    for minor in [(3, 0), (3, 1), (4, 0)] {
        let (i, b) = decode(&full_v3(), Version::new(minor.0, minor.1)).unwrap();
        assert_eq!((i, b.as_slice()), (info([0, 0]), bodies().as_slice()));
    }
    for minor in [1, 2, 3] {
        let (i, b) = decode(&full_v4_1(), Version::new(4, minor)).unwrap();
        assert_eq!((i, b.as_slice()), (info([11, 12]), bodies().as_slice()));
    }
    assert!(bodies()[0].is_tracked() && !bodies()[1].is_tracked());
}

#[test]
fn bodies_that_grew_in_a_later_version_are_still_read() {
    // Each body with four more bytes, 84 in all.
    let b: Vec<&str> = BODIES.trim().lines().collect();
    let text = format!(
        "04030201 00000000 00000000 00000000 00000000 02000000 54000000 {} 99999999 {} 99999999
         00000000 00000000 00000000 00000000 00000000 00000000 00000000 00000000 00000000 00000000
         {STAMPS} 00000000 00000000 0000 00000000",
        b[0], b[1]
    );
    assert_eq!(decode(&hex(&text), Version::V4_2).unwrap().1, bodies());
}

#[test]
fn frames_are_written_as_by_hand() {
    let marker = [[1.0f32; 3]];
    let labeled =
        [LabeledMarker { id: 0x0002_0001, position: [1.0, 0.0, 0.0], size: 0.5, params: 2, residual: 0.0 }];
    let content = FrameContent {
        marker_sets: &[("A", &marker)],
        other_markers: &[[2.0; 3]],
        bodies: &bodies(),
        labeled: &labeled,
    };
    let mut out = Vec::new();
    encode_frame(&mut out, Version::V3_0, &info([0, 0]), &content).unwrap();
    let expected = hex(&format!(
        "0700 d200 04030201
         01000000 4100 01000000 0000803f 0000803f 0000803f
         01000000 00000040 00000040 00000040
         02000000 {BODIES}
         00000000
         01000000 01000200 0000803f 00000000 00000000 0000003f 0200 00000000
         00000000 00000000
         {STAMPS} 0600 00000000"
    ));
    assert_eq!(out, expected);
    encode_frame(&mut out, Version::V4_2, &info([11, 12]), &content).unwrap();
    let expected = hex(&format!(
        "0700 fe00 04030201
         01000000 12000000 4100 01000000 0000803f 0000803f 0000803f
         01000000 0c000000 00000040 00000040 00000040
         02000000 4c000000 {BODIES}
         00000000 00000000
         00000000 00000000
         01000000 1a000000 01000200 0000803f 00000000 00000000 0000003f 0200 00000000
         00000000 00000000 00000000 00000000
         {STAMPS} 0b000000 0c000000 0600 00000000"
    ));
    assert_eq!(out, expected);
}

#[test]
fn the_real_crashes_are_errors() {
    // USC libmotioncapture issue 6: the count of unidentified markers read as -1,097,420,973 (bytes 53 AF 96 BE).
    let negative = hex("01000000 00000000 53af96be 0000803f 00000000 00000000");
    assert_eq!(
        decode(&negative, Version::V3_0).unwrap_err(),
        WireError::Count { what: "other markers", at: 8, count: -1_097_420_973, left: 12 }
    );
    // The same library, issue 18: 4.1 added four bytes of size to each section, which a 4.0 parser takes for content, and the
    // other way round.
    assert!(decode(&full_v4_1(), Version::V4_0).is_err());
    assert!(decode(&full_v3(), Version::V4_1).is_err());
    // A count whose product with the item size would wrap to a small number.
    let wrapping = hex("01000000 00000000 00000000 ffffff7f");
    assert!(matches!(decode(&wrapping, Version::V3_0), Err(WireError::Count { count: i32::MAX, .. })));
    // A name that never ends.
    let mut endless = hex("01000000 01000000");
    endless.resize(2000, b'x');
    assert!(matches!(decode(&endless, Version::V3_0), Err(WireError::Text { at: 8, .. })));
    // Section sizes that do not fit the bodies.
    for size in ["4b000000", "00000000", "4d000000"] {
        let text = format!("04030201 00000000 00000000 00000000 00000000 02000000 {size} {BODIES} 00000000");
        assert!(matches!(decode(&hex(&text), Version::V4_1), Err(WireError::SectionSize { .. })), "{size}");
    }
}

#[test]
fn every_truncation_and_every_extra_byte_is_an_error() {
    for (payload, version) in [(full_v3(), Version::V3_0), (full_v4_1(), Version::V4_2)] {
        for cut in 0..payload.len() {
            assert!(decode(&payload[..cut], version).is_err(), "{version} cut at {cut}");
        }
        let mut longer = payload;
        longer.push(0);
        assert!(decode(&longer, version).is_err());
    }
    assert_eq!(decode(&full_v3(), Version::new(2, 9)).unwrap_err(), WireError::Version(Version::new(2, 9)));
    assert_eq!(split(&hex("0700 0400 0102")), Err(WireError::Length { announced: 4, actual: 2 }));
    assert_eq!(split(&hex("0700 0100 0102")), Err(WireError::Length { announced: 1, actual: 2 }));
    assert!(split(&hex("0700 00")).is_err());
}

#[test]
fn server_information() {
    let mut payload = b"Motive".to_vec();
    // Motive leaves old bytes after the zero.
    payload.extend_from_slice(b"\0stale");
    payload.resize(256, 0);
    payload.extend(hex("03010002 04020000 809698 0000000000 e705 01 efff2a63"));
    let server = ServerInfo::decode(&payload).unwrap();
    assert_eq!(server.name, "Motive");
    assert_eq!(server.app_version, [3, 1, 0, 2]);
    assert_eq!(server.version(), Version::V4_2);
    assert_eq!(server.clock_hz, 10_000_000);
    assert_eq!(server.data_port, 1511);
    assert_eq!(server.multicast, Some([239, 255, 42, 99]));
    let mut out = Vec::new();
    server.encode(&mut out);
    assert_eq!(out.len(), 4 + SERVER_INFO_BYTES);
    assert_eq!(out[..4], hex("0100 1701"));
    assert_eq!(out[4 + 256..], payload[256..]);
    assert_eq!(out[4..4 + 7], *b"Motive\0");
    assert!(out[11..260].iter().all(|b| *b == 0));
    assert_eq!(ServerInfo::decode(&out[4..]).unwrap(), server);
    // A 2.9 server sends less, and is refused by its version rather than for its length.
    let mut old = payload[..264].to_vec();
    old[260..264].copy_from_slice(&[2, 9, 0, 0]);
    assert_eq!(ServerInfo::decode(&old), Err(WireError::Version(Version::new(2, 9))));
    assert!(ServerInfo::decode(&payload[..270]).is_err());
}

#[test]
fn connecting_in_the_four_ways_of_the_wild() {
    let mut out = Vec::new();
    Connect { name: "dpm".into(), bitstream: Some(Version::V4_1) }.encode(&mut out);
    assert_eq!(out.len(), 274);
    assert_eq!(out[..8], hex("0000 0e01 64706d00"));
    assert_eq!(out[4 + 256..], hex("01000000 04020000 00 04010000 00"));
    assert_eq!(Connect::decode(&out[4..]).bitstream, Some(Version::V4_1));
    assert_eq!(Connect::decode(&out[4..]).name, "dpm");
    assert_eq!(Connect::decode(&out[4..4 + 264]).bitstream, None);
    assert_eq!(Connect::decode(b"Ping\0"), Connect::default());
    assert_eq!(Connect::decode(b""), Connect::default());
}

#[test]
fn small_messages() {
    let mut out = Vec::new();
    encode_empty(&mut out, id::REQUEST_MODEL_DEF);
    assert_eq!(out, hex("0400 0000"));
    encode_empty(&mut out, id::KEEP_ALIVE);
    assert_eq!(out, hex("0a00 0000"));
    encode_request(&mut out, "Bitstream,4.1");
    assert_eq!(out, hex("0200 0e00 42697473747265616d2c342e31 00"));
    assert_eq!(request_text(&out[4..]), Some("Bitstream,4.1"));
    encode_echo_request(&mut out, 0x0102_0304_0506_0708);
    assert_eq!(out, hex("0c00 0800 0807060504030201"));
    assert_eq!(decode_echo_request(&out[4..]), Ok(0x0102_0304_0506_0708));
    encode_echo_response(&mut out, 0x0102_0304_0506_0708, 9);
    assert_eq!(out, hex("0d00 1000 0807060504030201 0900000000000000"));
    assert_eq!(decode_echo_response(&out[4..]), Ok((0x0102_0304_0506_0708, 9)));
    assert!(decode_echo_response(&out[4..19]).is_err());
}

#[test]
fn model_definitions_of_all_versions() {
    let head = "48617265 00 11000000 ffffffff 00000000 00000000 00000000";
    let markers = "01000000 0000803f 00000040 000080bf 00000000";
    let marker_set = "48617265 00 01000000 4d61726b657230303100";
    let name = "4d61726b657230303100";
    let body = |version: Version| {
        let mut text = head.to_owned();
        if version >= Version::V4_2 {
            text.push_str("00000000 00000000 00000000 0000803f");
        }
        text.push_str(markers);
        if version >= Version::V4_0 {
            text.push_str(name);
        }
        text
    };
    let expected = [BodyModel { name: "Hare".into(), id: 17 }];
    for version in [Version::V3_0, Version::V4_0, Version::V4_1, Version::V4_2] {
        let body = body(version);
        let sized = |text: &str| {
            let n = hex(text).len() as u32;
            if version.has_section_sizes() {
                n.to_le_bytes().iter().map(|b| format!("{b:02x}")).collect::<String>() + text
            } else {
                text.to_owned()
            }
        };
        let plain = format!("02000000 00000000 {} 01000000 {}", sized(marker_set), sized(&body));
        let mut out = Vec::new();
        let definition = BodyDefinition { name: "Hare", id: 17, markers: &[[1.0, 2.0, -1.0]] };
        encode_models(&mut out, version, &[definition]).unwrap();
        assert_eq!(out[4..], hex(&plain), "{version}");
        assert_eq!(decode_models(&hex(&plain), version).unwrap(), expected, "{version}");
        // With a skeleton of one bone, a force plate, a device and a camera in front.
        let plate = format!("01000000 5300 {} 01000000 466700", "00".repeat(4 * 163));
        let others = [
            ("02000000", format!("536b00 07000000 01000000 {body}")),
            ("03000000", plate),
            ("04000000", "02000000 4400 5300 00000000 00000000 01000000 6300".into()),
            ("05000000", format!("4300 {}", "00".repeat(28))),
        ];
        let mut text = "05000000".to_owned();
        for (kind, content) in &others {
            text.push_str(kind);
            text.push_str(&sized(content));
        }
        text.push_str("01000000");
        text.push_str(&sized(&body));
        assert_eq!(decode_models(&hex(&text), version).unwrap(), expected, "{version} with others");
        let bytes = hex(&text);
        for cut in 0..bytes.len() {
            assert!(decode_models(&bytes[..cut], version).is_err(), "{version} cut at {cut}");
        }
    }
    // Unknown definitions: skipped by size where there is one, the end of the list otherwise.
    let unknown = |size: &str| hex(&format!("01000000 63000000 {size} aabb"));
    assert_eq!(decode_models(&unknown("02000000"), Version::V4_1), Ok(vec![]));
    assert_eq!(decode_models(&unknown(""), Version::V4_0).map(|m| m.len()).unwrap_or(0), 0);
    assert!(decode_models(&hex("ffffffff"), Version::V4_1).is_err());
    assert!(decode_models(&hex("00000010 00000000"), Version::V4_1).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    /// No bytes panic any decoder, and no decoder stores more than the bytes can hold.
    #[test]
    fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..600), major in 0u8..6, minor in 0u8..4) {
        let version = Version::new(major, minor);
        let mut bodies = Vec::new();
        let _ = decode_frame(&bytes, version, &mut bodies);
        prop_assert!(bodies.len() * RigidBody::BYTES <= bytes.len());
        if let Ok(models) = decode_models(&bytes, version) {
            prop_assert!(models.len() <= bytes.len());
        }
        let _ = ServerInfo::decode(&bytes);
        let _ = Connect::decode(&bytes);
        let _ = request_text(&bytes);
        let _ = split(&bytes);
    }

    /// Valid frames with a few bytes changed: an error or a frame, never more bodies than bytes.
    #[test]
    fn mutated_frames_are_survived(
        new in any::<bool>(),
        changes in proptest::collection::vec((any::<proptest::sample::Index>(), any::<u8>()), 1..8),
    ) {
        let (mut payload, version) = if new { (full_v4_1(), Version::V4_1) } else { (full_v3(), Version::V3_0) };
        for (at, value) in changes {
            let at = at.index(payload.len());
            payload[at] = value;
        }
        let mut bodies = Vec::new();
        if decode_frame(&payload, version, &mut bodies).is_err() {
            prop_assert!(bodies.is_empty());
        }
        prop_assert!(bodies.len() * RigidBody::BYTES <= payload.len());
    }
}
