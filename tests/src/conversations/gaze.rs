//! An eye tracker: each end of its connection against any bytes, and what is made of any answers and messages.

use dpm_device::time::HostTime;
use dpm_pupil::client::{Ears, GazeAt};
use dpm_pupil::zmtp::{Event, SocketKind, ZmtpPeer, MOST_MESSAGE, MOST_PARTS};

const MS: i64 = 1_000_000;
const KINDS: [(SocketKind, &[u8]); 4] = [
    (SocketKind::Sub, b"PUB"),
    (SocketKind::Pub, b"SUB"),
    (SocketKind::Req, b"REP"),
    (SocketKind::Rep, b"REQ"),
];

/// What an end has heard, whether it has refused the rest, and what it has answered.
type Told = (Vec<Vec<u8>>, Option<String>, Vec<u8>);

fn hear(kind: SocketKind, bytes: &[u8], piece: usize) -> Told {
    let (mut told, mut out) = (Vec::new(), Vec::new());
    let mut peer = ZmtpPeer::new(kind, &mut Vec::new());
    for chunk in bytes.chunks(piece) {
        let result = peer.push(chunk, &mut out, &mut |event| {
            told.push(match event {
                Event::Ready => b"ready".to_vec(),
                Event::Topic(on, topic) => [&[u8::from(on)], topic].concat(),
                Event::Message(message) => {
                    assert!((1..=MOST_PARTS).contains(&message.count()));
                    let parts: Vec<&[u8]> = (0..message.count()).map(|i| message.part(i)).collect();
                    let whole = parts.concat();
                    assert!(whole.len() <= MOST_MESSAGE && message.part(message.count()).is_empty());
                    whole
                }
            });
        });
        if let Err(e) = result {
            return (told, Some(e.to_string()), out);
        }
    }
    (told, None, out)
}

/// One end of ZMTP: what it hears and answers does not depend on how the bytes are split. The first byte names the end, and
/// whether the other one has already greeted it.
pub fn pupil_stream(bytes: &[u8]) {
    let Some((&head, rest)) = bytes.split_first() else { return };
    let (kind, other) = KINDS[usize::from(head & 3)];
    let mut all = Vec::new();
    if head & 4 != 0 {
        let mut greeting = [0; 64];
        (greeting[0], greeting[9], greeting[10]) = (0xff, 0x7f, 3);
        greeting[12..16].copy_from_slice(b"NULL");
        all.extend_from_slice(&greeting);
        all.extend_from_slice(b"\x04\x19\x05READY\x0bSocket-Type\0\0\0\x03");
        all.extend_from_slice(other);
    }
    all.extend_from_slice(rest);
    let whole = hear(kind, &all, all.len().max(1));
    assert_eq!(whole, hear(kind, &all, 1 + usize::from(head >> 3)));
    // A PONG is shorter than its PING by the time to live, and has at most 23 bytes.
    assert!(whole.2.len() <= all.len());
}

/// What is made of Pupil's answers and messages. A step is a byte that says which, milliseconds that pass, a length, and as many
/// bytes.
pub fn pupil_gaze(bytes: &[u8]) {
    let (mut ears, mut now, mut used) = (Ears::new(0.6), HostTime(10_000 * MS), 0);
    let (mut last, mut steps) = (None::<GazeAt>, 0);
    let mut rest = bytes;
    while let [what, ms, length, more @ ..] = rest {
        let (step, after) = more.split_at(usize::from(*length).min(more.len()));
        rest = after;
        let asked = now;
        now = now.plus_ns(i64::from(*ms) * MS);
        if what % 2 == 0 {
            ears.on_clock(&String::from_utf8_lossy(step), asked, now);
        } else {
            let topic: &[u8] = if what & 2 == 0 { b"gaze.3d.01." } else { b"pupil.0.3d" };
            if ears.counts().clock_steps > std::mem::replace(&mut steps, ears.counts().clock_steps) {
                // A clock that was set may have been set back.
                last = None;
            }
            ears.on_message(topic, step, now, &mut |gaze| {
                used += 1;
                assert!(last.is_none_or(|last| last.at < gaze.at), "{last:?} before {gaze:?}");
                assert!(gaze.received_at == now && (0.6..=1.0).contains(&gaze.confidence), "{gaze:?}");
                let age_ns = now.ns_since(gaze.at);
                assert!((-55 * MS..=1_000 * MS).contains(&age_ns), "{age_ns} ns: {gaze:?}");
                let far = (0..3).map(|i| (gaze.point_m[i] - gaze.eye_m[i]).powi(2)).sum::<f64>().sqrt();
                assert!((0.0499..100.1).contains(&far), "{gaze:?}");
                last = Some(*gaze);
            });
        }
    }
    let counts = ears.counts();
    let fates = counts.used + counts.unsure + counts.flat + counts.refused + counts.ill_timed;
    assert_eq!((counts.messages, counts.used), (fates, used));
}
