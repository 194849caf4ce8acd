//! Bytes written by hand from the specifications, hostile bytes, and the clock.

use crate::client::{Ears, GazeAt};
use crate::gaze::{decode, NoGaze};
use crate::msgpack::{put_f64, put_map, put_small, put_text, put_vector, ElementDecoder};
use crate::zmtp::{
    put_message, put_subscription, put_words, Event, SocketKind, ZmtpError, ZmtpPeer, MOST_PART, MOST_PARTS,
};
use dpm_device::time::HostTime;
use proptest::prelude::*;

/// Specification 23: signature, version 3.0, mechanism NULL padded to 20 bytes, as-server 0, filler.
const GREETING: [u8; 64] = {
    let mut g = [0; 64];
    g[0] = 0xff;
    g[9] = 0x7f;
    g[10] = 3;
    g[12] = b'N';
    g[13] = b'U';
    g[14] = b'L';
    g[15] = b'L';
    g
};

/// A command frame: flags 4, length, the name with its length, and one property.
fn ready(kind: &str) -> Vec<u8> {
    let body = [b"\x05READY\x0bSocket-Type\0\0\0", &[kind.len() as u8][..], kind.as_bytes()].concat();
    [&[4, body.len() as u8][..], &body].concat()
}

fn told(heard: &Event<'_>) -> String {
    match heard {
        Event::Ready => "ready".into(),
        Event::Topic(on, topic) => format!("topic {on} {topic:?}"),
        Event::Message(m) => format!("{:?}", (0..m.count()).map(|i| m.part(i).to_vec()).collect::<Vec<_>>()),
    }
}

/// What an end hears of `bytes`, pushed in pieces of `piece`, with its error, and what it answers.
fn hear(kind: SocketKind, bytes: &[u8], piece: usize) -> (Vec<String>, Option<ZmtpError>, Vec<u8>) {
    let (mut first, mut out, mut heard) = (Vec::new(), Vec::new(), Vec::new());
    let mut peer = ZmtpPeer::new(kind, &mut first);
    let mut error = None;
    for chunk in bytes.chunks(piece.max(1)) {
        if let Err(e) = peer.push(chunk, &mut out, &mut |h| heard.push(told(&h))) {
            error = Some(e);
            break;
        }
    }
    (heard, error, out)
}

#[test]
fn an_end_begins_with_the_bytes_of_the_specification() {
    for (kind, word) in [(SocketKind::Req, "REQ"), (SocketKind::Sub, "SUB"), (SocketKind::Pub, "PUB")] {
        let mut out = Vec::new();
        ZmtpPeer::new(kind, &mut out);
        assert_eq!(out, [&GREETING[..], &ready(word)].concat());
    }
    // The longest that begins so: flags 4, 25 bytes.
    assert_eq!(&ready("REQ")[..3], [4, 25, 5]);
    let mut out = Vec::new();
    put_words(b"SUB_PORT", &mut out);
    assert_eq!(out, b"\x01\0\0\x08SUB_PORT", "an empty part with more to come, then the words");
    out.clear();
    put_subscription(b"gaze", &mut out);
    assert_eq!(out, b"\0\x05\x01gaze");
    out.clear();
    put_message(&[&[7; 300]], &mut out);
    assert_eq!(out[..9], [2, 0, 0, 0, 0, 0, 0, 1, 44], "a long frame has its length in eight bytes");
}

/// As libzmq 4.3 begins: another signature, version 3.1, and an identity among the properties.
#[test]
fn a_dialogue_is_heard_however_it_is_split() {
    let mut theirs = GREETING;
    (theirs[8], theirs[11]) = (1, 1);
    let body = b"\x05READY\x0bSocket-Type\0\0\0\x03PUB\x08Identity\0\0\0\0";
    let mut bytes = [&theirs[..], &[4, body.len() as u8], body].concat();
    bytes.extend_from_slice(b"\x01\x0bgaze.3d.01.\0\x03abc");
    bytes.extend_from_slice(b"\x04\x09\x04PING\0\x64hi");
    bytes.extend_from_slice(&[2, 0, 0, 0, 0, 0, 0, 0, 2, 8, 9]);
    let expected = [
        "ready".to_owned(),
        format!("{:?}", [b"gaze.3d.01.".to_vec(), b"abc".to_vec()]),
        format!("{:?}", [[8, 9]]),
    ];
    for piece in 1..=bytes.len() {
        let (heard, error, out) = hear(SocketKind::Sub, &bytes, piece);
        assert_eq!((heard.as_slice(), error), (&expected[..], None));
        assert_eq!(out, b"\x04\x07\x04PONGhi");
    }
}

#[test]
fn subscriptions_are_heard_in_both_forms() {
    let bytes = [
        &GREETING[..],
        &ready("SUB"),
        b"\0\x05\x01gaze\0\x05\0gaze\x04\x0e\x09SUBSCRIBEgaze\x04\x0b\x06CANCELgaze",
    ]
    .concat();
    let (heard, error, _) = hear(SocketKind::Pub, &bytes, 1000);
    let gaze = b"gaze";
    let topic = |on| format!("topic {on} {gaze:?}");
    assert_eq!(
        (heard, error),
        (vec!["ready".to_owned(), topic(true), topic(false), topic(true), topic(false)], None)
    );
}

#[test]
fn what_is_no_peer_is_refused_by_name() {
    let refused = |bytes: &[u8]| hear(SocketKind::Sub, bytes, 7).1;
    assert_eq!(refused(b"HTTP/1.1 400 Bad Request"), Some(ZmtpError::NoGreeting));
    let changed = |at: usize, byte: u8| {
        let mut greeting = GREETING;
        greeting[at] = byte;
        greeting
    };
    assert_eq!(refused(&changed(10, 1)), Some(ZmtpError::Version(1)));
    assert_eq!(refused(&changed(12, b'P')), Some(ZmtpError::Mechanism));
    let greeted = |more: &[u8]| refused(&[&GREETING[..], more].concat());
    assert_eq!(greeted(&ready("REP")), Some(ZmtpError::Kind("REP".into())));
    assert_eq!(greeted(b"\x04\x0a\x05ERROR\x03no!"), Some(ZmtpError::Refused("no!".into())));
    assert_eq!(greeted(b"\0\x01x"), Some(ZmtpError::Malformed), "a message before READY");
    let traffic = |more: &[u8]| greeted(&[&ready("PUB"), more].concat());
    assert_eq!(traffic(&[8, 0]), Some(ZmtpError::Malformed));
    assert_eq!(traffic(&[5, 0]), Some(ZmtpError::Malformed), "a command has no further part");
    // Lengths are refused before anything of them has come.
    let long = |length: u64| [&[2][..], &length.to_be_bytes()].concat();
    assert_eq!(traffic(&long(MOST_PART as u64)), None);
    assert_eq!(traffic(&long(MOST_PART as u64 + 1)), Some(ZmtpError::TooLong));
    assert_eq!(traffic(&long(u64::MAX)), Some(ZmtpError::TooLong));
    assert_eq!(traffic(&[1, 0].repeat(MOST_PARTS)), None);
    assert_eq!(traffic(&[1, 0].repeat(MOST_PARTS + 1)), Some(ZmtpError::TooLong));
    let properties = [&[4, 200][..], b"\x05READY\x01a\xff\xff\xff\xff", &[0; 188]].concat();
    assert_eq!(greeted(&properties), Some(ZmtpError::Malformed), "a property longer than its command");
}

fn sample(at_s: f64, confidence: f64) -> Vec<u8> {
    let mut out = Vec::new();
    put_map(6, &mut out);
    put_text("base_data", &mut out);
    // An array of a map, which is passed over.
    out.extend_from_slice(b"\x91\x81\xa2id\x00");
    put_text("timestamp", &mut out);
    put_f64(at_s, &mut out);
    put_text("confidence", &mut out);
    put_f64(confidence, &mut out);
    put_text("gaze_point_3d", &mut out);
    put_vector(&[100.0, -50.0, 700.0], &mut out);
    put_text("eye_centers_3d", &mut out);
    put_map(2, &mut out);
    for (eye, x) in [(0, 12.0), (1, -48.0)] {
        put_small(eye, &mut out);
        put_vector(&[x, 20.0, -30.0], &mut out);
    }
    put_text("gaze_normals_3d", &mut out);
    put_map(1, &mut out);
    put_text("0", &mut out);
    put_vector(&[0.1, -0.1, 0.98], &mut out);
    out
}

#[test]
fn a_sample_is_read_in_metres_and_what_is_none_is_named() {
    let gaze = decode(&sample(12.5, 0.75)).expect("a sample");
    assert_eq!((gaze.at_s, gaze.confidence), (12.5, 0.75));
    let near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-12);
    assert!(near(gaze.eye_m, [-0.018, 0.02, -0.03]) && near(gaze.point_m, [0.1, -0.05, 0.7]), "{gaze:?}");
    for wrong in [f64::NAN, f64::INFINITY, 1e10, -1e10] {
        assert_eq!(decode(&sample(wrong, 0.75)), Err(NoGaze::Impossible));
    }
    for wrong in [f64::NAN, -0.1, 1.1] {
        assert_eq!(decode(&sample(1.0, wrong)), Err(NoGaze::Impossible));
    }
    // A fix map of 2D gaze: {"timestamp": 1, "confidence": 1, "norm_pos": [0, 1]}.
    let flat = b"\x83\xa9timestamp\x01\xaaconfidence\x01\xa8norm_pos\x92\x00\x01";
    assert_eq!(decode(flat), Err(NoGaze::Flat));
    assert!(matches!(decode(&flat[..20]), Err(NoGaze::Malformed(_))));
    assert!(matches!(decode(&[flat, &[0][..]].concat()), Err(NoGaze::Malformed(_))), "something follows");
    // One eye whose point lies behind it: only its direction is used.
    let behind = b"\x85\xa9timestamp\x01\xaaconfidence\x01\xadgaze_point_3d\x93\x00\x00\xff\xadeye_center_3d\x93\x00\x00\x00\xaegaze_normal_3d\x93\x00\x00\x01";
    let gaze = decode(behind).expect("a direction");
    assert!(near(gaze.point_m, [0.0, 0.0, 100.0]), "{gaze:?}");
}

/// Specification of msgpack, by hand: every form of a number, and what is passed over.
#[test]
fn every_form_of_msgpack_is_read() {
    let numbers: [(&[u8], f64); 12] = [
        (&[0x07], 7.0),
        (&[0xff], -1.0),
        (&[0xcc, 200], 200.0),
        (&[0xcd, 1, 0], 256.0),
        (&[0xce, 0, 1, 0, 0], 65_536.0),
        (&[0xcf, 0, 0, 0, 1, 0, 0, 0, 0], 4_294_967_296.0),
        (&[0xd0, 0x80], -128.0),
        (&[0xd1, 0xff, 0], -256.0),
        (&[0xd2, 0xff, 0xff, 0, 0], -65_536.0),
        (&[0xd3, 0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0], -4_294_967_296.0),
        (&[0xca, 0x3f, 0x80, 0, 0], 1.0),
        (&[0xcb, 0xbf, 0xf0, 0, 0, 0, 0, 0, 0], -1.0),
    ];
    for (bytes, number) in numbers {
        assert_eq!(ElementDecoder::new(bytes).f64(), Ok(number));
    }
    let passed: [&[u8]; 10] = [
        &[0xc0],
        &[0xa2, b'a', b'b'],
        &[0xd9, 1, b'a'],
        &[0xda, 0, 1, b'a'],
        &[0xc4, 2, 0, 0],
        &[0xc7, 1, 5, 0],
        &[0xd5, 5, 0, 0],
        &[0xdc, 0, 2, 1, 0x91, 2],
        &[0xde, 0, 1, 1, 0x81, 2, 3],
        &[0xdd, 0, 0, 0, 0],
    ];
    for bytes in passed {
        let mut reader = ElementDecoder::new(bytes);
        assert!(reader.skip().is_ok() && reader.is_at_end(), "{bytes:?}");
        assert!(ElementDecoder::new(&bytes[..bytes.len() - 1]).skip().is_err(), "{bytes:?} is cut");
    }
    // Depth and counts that no memory would hold end with the bytes.
    assert!(ElementDecoder::new(&[0x91; 100_000]).skip().is_err());
    assert!(ElementDecoder::new(&[0xdf, 0xff, 0xff, 0xff, 0xff, 0, 0]).skip().is_err());
}

/// Pupil's clock stands 1.7e9 s ahead and runs 100 ppm fast: instants are found again within the shortest round trip,
/// and what no instant can be is not used.
#[test]
fn instants_are_mapped_by_the_shortest_round_trips() {
    let mut ears = Ears::new(0.6);
    let pupil = |host_ns: i64| 1.7e9 + host_ns as f64 * 1e-9 * 1.0001;
    let mut heard: Vec<GazeAt> = Vec::new();
    ears.on_message(b"gaze.3d.01.", &sample(pupil(0), 1.0), HostTime(0), &mut |g| heard.push(*g));
    assert!(heard.is_empty() && ears.counts().ill_timed == 1, "no clock yet");
    for k in 0..40i64 {
        let asked = k * 250_000_000;
        // Nine of ten answers come late, and only on the way back.
        let back = if k % 10 == 3 { 200_000 } else { 30_000_000 };
        let answer = format!("{}", pupil(asked + 200_000));
        assert!(ears.on_clock(&answer, HostTime(asked), HostTime(asked + 200_000 + back)));
    }
    assert!(!ears.on_clock("Unknown command.", HostTime(0), HostTime(1)));
    assert!(
        !ears.on_clock("1e300", HostTime(0), HostTime(1)) && !ears.on_clock("NaN", HostTime(0), HostTime(1))
    );
    let now = HostTime(9_800_000_000);
    let seen = |age_ns: i64| sample(pupil(now.0 - age_ns), 1.0);
    let mut hear = |payload: &[u8]| {
        let before = heard.len();
        ears.on_message(b"gaze.3d.01.", payload, now, &mut |g| heard.push(*g));
        (heard.len() > before, ears.counts().ill_timed)
    };
    assert_eq!(hear(&seen(2_000_000_000)), (false, 2), "too old");
    assert_eq!(hear(&seen(20_000_000)), (true, 2));
    assert_eq!(hear(&seen(30_000_000)), (false, 3), "before the one that came last");
    assert_eq!(hear(&seen(-50_000_000)), (false, 4), "in the future");
    assert_eq!(hear(&sample(pupil(now.0), 0.59)), (false, 4));
    let late_ns = heard[0].at.0 - (now.0 - 20_000_000);
    assert!(late_ns.abs() < 300_000, "{late_ns} ns");
    assert_eq!((ears.counts().unsure, ears.counts().used, ears.counts().messages), (1, 1, 6));
}

proptest! {
    /// Any bytes: no panic, no more than is bounded, and the same however they are split.
    #[test]
    fn any_bytes_are_heard_alike_in_any_pieces(more in prop::collection::vec(any::<u8>(), 0..300), piece in 1usize..40) {
        let bytes = [&GREETING[..], &ready("PUB"), &more].concat();
        let (whole, cut) = (hear(SocketKind::Sub, &bytes, 1000), hear(SocketKind::Sub, &bytes, piece));
        prop_assert_eq!(&whole.0, &cut.0);
        prop_assert_eq!(&whole.1, &cut.1);
    }
}
