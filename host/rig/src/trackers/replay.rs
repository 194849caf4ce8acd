//! `tracker.kind = "replay"`: a recording by `dpm record`.

use super::keys::{SourceError, TrackerKeys, TrackerPlace};
use super::kind::{MockScene, MockServer, PoseOrigin, TrackerKind};
use super::transform::TrackerTransformConfig;
use crate::mock::MockTracker;
use dpm_common::keys::read::{Any, NotEmpty, Within};
use dpm_common::section;
use dpm_device::link::crc32c;
use dpm_device::tracker::record::{Recorder, Recording, Replay, SAMPLE_BYTES};
use dpm_device::tracker::{BodyKey, Tracker};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

section! {
    /// A recording.
    pub struct ReplayConfig {
        /// The recording.
        file: PathBuf = PathBuf::new(), "", NotEmpty;
        /// From the tracker's coordinates to the world's.
        transform: TrackerTransformConfig = TrackerTransformConfig::default(), "", Any;
        /// Time by which a sample is older than its time stamp says. `dpm calibrate latency` measures it. Negative if
        /// stamps are too old.
        latency_us: i64 = 0, "us", Within(-200_000, 200_000);
    }
}

pub(super) static KIND: TrackerKind = TrackerKind::of::<ReplayConfig>(
    "replay",
    "a recording made by this program.",
    PoseOrigin::Recorded,
    "docs/TRACKERS.md#recordings",
    &[("recording", any_recording)],
    mock,
);

impl TrackerKeys for ReplayConfig {
    fn rate_hz(&self) -> Option<u32> {
        None
    }

    fn frame(&self) -> Option<(&TrackerTransformConfig, i64)> {
        Some((&self.transform, self.latency_us))
    }

    fn place(&self) -> String {
        format!("the recording {}", self.file.display())
    }

    fn remedy(&self) -> &'static str {
        "does tracker.file hold these bodies, by name or id, from its beginning on?"
    }

    fn placed(&self, place: &mut dyn FnMut(&mut PathBuf, &str)) -> Option<Arc<dyn TrackerKeys>> {
        let mut keys = self.clone();
        place(&mut keys.file, "tracker.file");
        Some(Arc::new(keys))
    }

    fn open(&self, place: TrackerPlace) -> Result<Box<dyn Tracker>, SourceError> {
        let replay = Replay::open(&self.file, &place.bodies, place.start);
        Ok(Box::new(replay.map_err(|e| SourceError::of_key("tracker.file", e))?))
    }
}

/// Seconds of the recording that stands for a server.
const MOCK_S: i64 = 3;

/// A file that is removed with this value.
struct TemporaryFile(PathBuf);

impl Drop for TemporaryFile {
    fn drop(&mut self) {
        // It lies in a folder for such files; nobody is left to hear of an error.
        let _ = std::fs::remove_file(&self.0);
    }
}

fn mock(scene: &MockScene) -> io::Result<MockServer> {
    let file = std::env::temp_dir().join(format!("dpm-mock-{}.dpmt", std::process::id()));
    let tracker = MockTracker::new(scene.source.config().clone(), scene.motions.clone());
    let bodies: Vec<BodyKey> =
        scene.names.iter().map(|name| BodyKey { name: name.clone(), id: None }).collect();
    let recorder =
        Recorder::create(tracker.map_err(io::Error::other)?, &file, &bodies, scene.source.config().start);
    let mut recorder = recorder.map_err(io::Error::other)?;
    let removed = TemporaryFile(file);
    let end = scene.source.config().start.plus_ns(MOCK_S * 1_000_000_000);
    recorder.poll(end, &mut |_| ()).map_err(io::Error::other)?;
    recorder.finish().map_err(io::Error::other)?;
    let keys = vec![("file", format!("{:?}", removed.0.display().to_string()))];
    Ok(MockServer { keys, running: Box::new(removed) })
}

/// A recording, unchanged and with its frames' checksums corrected. It has no more samples than its bytes can contain, and a
/// truncated file gives the beginning of what the whole file gives.
fn any_recording(bytes: &[u8]) {
    let read = |bytes: &[u8]| Recording::read_from(&mut &bytes[..], bytes.len() as u64, Path::new("seed"));
    let mut framed = b"dpm-track-0001\r\n".to_vec();
    let mut rest = bytes;
    while let Some((&[low, high], after)) = rest.split_first_chunk::<2>() {
        let (payload, after) = after.split_at(usize::from(u16::from_le_bytes([low, high])).min(after.len()));
        let from = framed.len();
        framed.extend((payload.len() as u32).to_le_bytes());
        framed.extend(payload);
        let crc = crc32c(&framed[from..]);
        framed.extend(crc.to_le_bytes());
        rest = after;
    }
    for bytes in [bytes, &framed] {
        let Ok(whole) = read(bytes) else { continue };
        assert!(whole.samples.len() * SAMPLE_BYTES + whole.torn_bytes as usize <= bytes.len());
        if let Ok(part) = read(&bytes[..bytes.len() * 2 / 3]) {
            // Compared as text, because numbers in a file may be NaN.
            let text = |r: &Recording, n: usize| format!("{:?}{:?}", r.bodies, &r.samples[..n]);
            assert_eq!(text(&part, part.samples.len()), text(&whole, part.samples.len()));
        }
    }
}
