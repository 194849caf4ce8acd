//! A recording equals its samples, to the bit; after a crash it is readable up to the tear; no file content does harm.

use super::*;
use proptest::prelude::*;
use std::time::Instant;

/// A tracker that delivers `n` samples of each of two bodies in one poll, counting up.
struct Counting(u32);

impl Tracker for Counting {
    fn poll(&mut self, now: HostTime, sink: &mut dyn FnMut(&TrackerSample)) -> Result<usize, TrackerError> {
        self.0 += 1;
        for body in 0..2 {
            sink(&sample(self.0, body, now));
        }
        Ok(2)
    }
    fn name(&self) -> &str {
        "counting"
    }
}

fn sample(k: u32, body: u16, now: HostTime) -> TrackerSample {
    let x = f64::from(k).sqrt() * 1e-3;
    TrackerSample {
        body: BodyIndex(body),
        pose: Pose { position_m: [x, -x / 3.0, f64::from(body)], rotation_xyzw: [0.6, 0.0, 0.0, 0.8] },
        tracked: !k.is_multiple_of(7),
        mean_error_m: 1.25e-4,
        covariance: None,
        sequence: (u32::MAX - 3).wrapping_add(k),
        captured_at: now.plus_ns(-1_234_567),
        received_at: now,
    }
}

fn keys(names: &[&str]) -> Vec<BodyKey> {
    names.iter().map(|n| BodyKey { name: (*n).to_owned(), id: None }).collect()
}

/// A separate path for each test, removed at the end.
struct Place(PathBuf);

impl Place {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("dpm-{}-{name}.track", std::process::id()));
        let _ = std::fs::remove_file(&path);
        Self(path)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

fn record(place: &Place, polls: u32) -> Vec<TrackerSample> {
    let mut recorder = Recorder::create(Counting(0), &place.0, &keys(&["a", "b"]), HostTime(1000)).unwrap();
    let mut seen = Vec::new();
    for k in 1..=i64::from(polls) {
        recorder.poll(HostTime(k * 2_000_000), &mut |s| seen.push(*s)).unwrap();
    }
    assert_eq!(recorder.finish().unwrap(), u64::from(polls) * 2);
    seen
}

#[test]
fn what_is_read_is_what_was_seen() {
    let place = Place::new("exact");
    let seen = record(&place, 2000);
    let recording = Recording::read(&place.0).unwrap();
    assert_eq!(recording.samples, seen);
    assert_eq!((recording.start, recording.torn_bytes), (HostTime(1000), 0));
    assert_eq!(recording.bodies, ["a", "b"]);
    // An existing recording is not overwritten.
    assert!(Recorder::create(Counting(0), &place.0, &keys(&["a"]), HostTime(0)).is_err());
    assert_eq!(Recording::read(&place.0).unwrap().samples.len(), seen.len());
}

#[test]
fn the_file_byte_for_byte() {
    let place = Place::new("bytes");
    record(&place, 1);
    let bytes = std::fs::read(&place.0).unwrap();
    let mut expected = b"dpm-track-0001\r\n".to_vec();
    // Header frame: 14 bytes; start 1000; two names.
    let head = [14, 0, 0, 0, 0xe8, 3, 0, 0, 0, 0, 0, 0, 2, 0, 1, b'a', 1, b'b'];
    expected.extend(head);
    expected.extend(crc32c(&head).to_le_bytes());
    assert_eq!(bytes[..expected.len()], expected);
    // One frame of two samples of 92 bytes.
    let frame = &bytes[expected.len()..];
    assert_eq!(frame.len(), 4 + 2 * SAMPLE_BYTES + 4);
    assert_eq!(frame[..4], [184, 0, 0, 0]);
    // Body 0, tracked, sequence 2^32 - 3 + ... , captured 765,433 ns, received 2,000,000 ns.
    assert_eq!(frame[4..12], [0, 0, 1, 0, 0xfd, 0xff, 0xff, 0xff]);
    assert_eq!(frame[12..20], 765_433i64.to_le_bytes());
    assert_eq!(frame[20..28], 2_000_000i64.to_le_bytes());
    assert_eq!(frame[28..32], 1.25e-4f32.to_le_bytes());
    assert_eq!(frame[40..48], 1e-3f64.to_le_bytes());
}

#[test]
fn a_torn_tail_is_left_out_wherever_it_tears() {
    let place = Place::new("torn");
    let mut recorder = Recorder::create(Counting(0), &place.0, &keys(&["a", "b"]), HostTime(0)).unwrap();
    // Several frames: the writer gets time between polls.
    for k in 1..=5i64 {
        recorder.poll(HostTime(k * 2_000_000), &mut |_| {}).unwrap();
        std::thread::sleep(Duration::from_millis(30));
    }
    recorder.finish().unwrap();
    let whole = Recording::read(&place.0).unwrap();
    let bytes = std::fs::read(&place.0).unwrap();
    let mut last = 0;
    for cut in 0..bytes.len() {
        std::fs::write(&place.0, &bytes[..cut]).unwrap();
        match Recording::read(&place.0) {
            Ok(part) => {
                assert!(whole.samples.starts_with(&part.samples));
                assert!(part.samples.len() >= last, "a longer file never reads shorter");
                last = part.samples.len();
                assert!(part.torn_bytes as usize <= 8 + 5 * 2 * SAMPLE_BYTES);
            }
            Err(RecordError::NotARecording { .. }) => assert!(cut < 38),
            Err(e) => panic!("{e}"),
        }
    }
    assert!(last >= 8, "frames before the torn one are all there");
}

#[test]
fn at_most_100_ms_are_lost_when_the_process_dies() {
    // A single standstill of the machine of 100 ms proves nothing; three in a row would.
    let worst = (0..3).map(lost_in_a_crash).find(|lost| *lost < Duration::from_millis(100));
    assert!(worst.is_some());
}

fn lost_in_a_crash(attempt: u32) -> Duration {
    let place = Place::new(&format!("crash{attempt}"));
    let mut recorder = Recorder::create(Counting(0), &place.0, &keys(&["a", "b"]), HostTime(0)).unwrap();
    let begin = Instant::now();
    let mut sent = Vec::new();
    while begin.elapsed() < Duration::from_millis(400) {
        sent.push(begin.elapsed());
        recorder.poll(HostTime(begin.elapsed().as_nanos() as i64), &mut |_| {}).unwrap();
        std::thread::sleep(Duration::from_millis(2));
    }
    // The file now holds what a killed process would leave: the recorder is neither finished nor dropped.
    let end = begin.elapsed();
    let left = Recording::read(&place.0).unwrap().samples.len() / 2;
    assert!(left > 0);
    sent.get(left).map_or(Duration::ZERO, |first_lost| end - *first_lost)
}

#[test]
fn replay_keeps_order_pace_and_spacing() {
    let place = Place::new("replay");
    let seen = record(&place, 500);
    // The rig numbers the bodies the other way and starts at another time.
    let shift = 77_000_000_000 - 1000;
    let mut replay = Replay::open(&place.0, &keys(&["b", "a"]), HostTime(77_000_000_000)).unwrap();
    let mut got = Vec::new();
    for now in (0..1_100_000_000i64).step_by(1_056_000) {
        let now = HostTime(now + 77_000_000_000);
        let from = got.len();
        let n = replay.poll(now, &mut |s: &TrackerSample| got.push(*s)).unwrap();
        assert_eq!(n, got.len() - from);
        assert!(got[from..].iter().all(|s| s.received_at <= now));
    }
    assert!(replay.is_over() && replay.counters().is_conserved());
    assert_eq!(got.len(), seen.len());
    for (a, b) in got.iter().zip(&seen) {
        assert_eq!(a.body.0, 1 - b.body.0);
        assert_eq!(a.captured_at.0, b.captured_at.0 + shift);
        assert_eq!((a.sequence, a.tracked), (b.sequence, b.tracked));
    }
    let error = Replay::open(&place.0, &keys(&["c"]), HostTime(0)).err().unwrap().to_string();
    assert!(error.contains("\"c\"") && error.contains("[\"a\", \"b\"]"), "{error}");
}

#[test]
fn other_files_are_refused_by_name() {
    let place = Place::new("other");
    assert!(matches!(Recording::read(&place.0), Err(RecordError::Io { .. })));
    for bytes in [&b""[..], b"PK\x03\x04", b"dpm-track-0002\r\n", b"dpm-track-0001\r\n\xff\xff\xff\xff"] {
        std::fs::write(&place.0, bytes).unwrap();
        let error = Recording::read(&place.0).unwrap_err();
        assert!(matches!(error, RecordError::NotARecording { .. }));
        assert!(error.to_string().contains("other.track"));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    /// Damage anywhere: an error or a prefix of the truth, never a panic, never a sample that was not recorded.
    #[test]
    fn damaged_files_are_survived(at in any::<proptest::sample::Index>(), flip in 1u8.., tail in proptest::collection::vec(any::<u8>(), 0..50)) {
        let now = HostTime(5);
        let mut bytes = header(&keys(&["a"]), now);
        let truth: Vec<TrackerSample> = (0..6).map(|k| sample(k, 0, now)).collect();
        for pair in truth.chunks(2) {
            let mut payload = Vec::new();
            pair.iter().for_each(|s| put_sample(&mut payload, s));
            put_frame(&mut bytes, &payload);
        }
        bytes.extend(&tail);
        let at = at.index(bytes.len());
        bytes[at] ^= flip;
        let place = Place::new("damaged");
        std::fs::write(&place.0, &bytes).unwrap();
        if let Ok(read) = Recording::read(&place.0) {
            prop_assert!(truth.starts_with(&read.samples));
        }
    }
}
