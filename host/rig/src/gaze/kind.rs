//! The row of a kind of gaze, its keys, and what a device that measures it does.

use dpm_common::keys::read::KeyReader;
use dpm_common::keys::rows::{KeyValues, KindWord, OfKind, Registry, Row, Section};
use dpm_common::keys::source::{Entry, Value};
use dpm_device::time::{HostClock, HostTime};
use glam::DVec3;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Where the eye looks.
#[derive(Clone, Debug, PartialEq)]
pub enum GazeAim {
    /// At a point of the world, metres.
    Point(DVec3),
    /// At the origin of a tracked body of this name, which the key names.
    Body(&'static str, String),
    /// Along -Z of the body that carries the eye.
    Ahead,
    /// Where a device sees it look, and along -Z while the device does not.
    Measured,
}

/// Gaze at an instant of the host's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GazeSample {
    /// When the eyes were seen.
    pub at: HostTime,
    /// When it came.
    pub received_at: HostTime,
    /// What they look at: metres, in the frame of the body that carries the eye.
    pub point_m: DVec3,
}

/// What has come of a device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GazeCounts {
    /// Samples that came.
    pub samples: u64,
    /// Of these: used.
    pub used: u64,
    /// Of these: of too little confidence.
    pub unsure: u64,
    /// Of these: not understood, or without a direction in space.
    pub refused: u64,
    /// Of these: of an instant that is not known or cannot be.
    pub ill_timed: u64,
    /// Connections on which gaze could be heard.
    pub sessions: u64,
    /// How often the device's clock was set anew.
    pub clock_steps: u64,
    /// Bound on the error of the instants now, nanoseconds; 0 while it is not known.
    pub clock_bound_ns: u64,
}

/// What speaks against the gaze, and what to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GazeDoubt {
    /// What was found.
    pub found: String,
    /// What to do.
    pub remedy: &'static str,
}

/// A device that sees where the eyes look. It connects while it is polled, and again after every loss.
pub trait GazeSource: Send {
    /// Works for about `limit`. Samples go to `sink` in the order of their instants.
    fn poll(&mut self, limit: Duration, sink: &mut dyn FnMut(&GazeSample));

    /// What has come so far.
    fn counts(&self) -> GazeCounts;

    /// What speaks against it now; `None` if nothing does, or if it is too early to say.
    fn doubt(&self) -> Option<GazeDoubt>;
}

/// The keys of a kind of gaze. A [`section!`](dpm_common::section) implements the rest of it.
pub trait GazeKeys: KeyValues {
    /// Where the eye looks.
    fn aim(&self) -> GazeAim;

    /// The keys with their values, as they would be written.
    fn written(&self) -> Vec<(&'static str, Value)>;

    /// Refuses values that make no sense.
    fn check(&self, _reader: &mut KeyReader) {}

    /// The device; `None` for a kind without one. `examines`: more is asked of it than a run needs, to find what is missing.
    fn open(&self, _clock: Arc<dyn HostClock>, _examines: bool) -> Option<Box<dyn GazeSource>> {
        None
    }
}

/// Reads the keys of a kind from a table of the rig file, whose name comes last.
type ReadKeys = fn(&BTreeMap<String, Entry>, &mut KeyReader, &str) -> Arc<dyn GazeKeys>;

/// A kind of gaze: a row of the table.
pub struct GazeKind {
    word: KindWord,
    read: ReadKeys,
}

impl GazeKind {
    /// A kind with the keys of `K`, called `word` in the rig file. `about`: what it is, the end of a sentence.
    pub const fn of<K: GazeKeys + Section>(word: &'static str, about: &'static str) -> Self {
        Self {
            word: KindWord::of::<K>(word, about),
            read: |table, reader, section| Arc::new(K::read_keys(table, reader, section)),
        }
    }
}

impl Row for GazeKind {
    type Keys = dyn GazeKeys;

    fn registry() -> &'static Registry<Self> {
        &super::KINDS
    }

    fn word(&self) -> &KindWord {
        &self.word
    }

    fn is_mock(&self) -> bool {
        false
    }

    fn read(
        &self,
        table: &BTreeMap<String, Entry>,
        reader: &mut KeyReader,
        section: &str,
    ) -> Arc<dyn GazeKeys> {
        (self.read)(table, reader, section)
    }
}

/// `observer.gaze` of a rig file.
pub type GazeConfig = OfKind<GazeKind>;
