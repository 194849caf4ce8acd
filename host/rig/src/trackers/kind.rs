//! The row of a kind of trackers.

use super::keys::TrackerKeys;
use crate::mock::{Motion, SampleSource};
use dpm_common::keys::read::KeyReader;
use dpm_common::keys::rows::{KindWord, Registry, Row, Section};
use dpm_common::keys::source::Entry;
use dpm_device::time::HostClock;
use std::any::Any;
use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;

/// Where poses come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseOrigin {
    /// From bodies that a device sees now, by a clock of its own.
    Measured,
    /// From a file.
    Recorded,
    /// From the motions that the rig file describes, in this process.
    Simulated,
}

/// A name in `tests/corpus` and a function that asserts what holds for any bytes.
pub type Decoder = (&'static str, fn(&[u8]));

/// Reads the keys of a kind from a table of the rig file, whose name comes last.
type ReadKeys = fn(&BTreeMap<String, Entry>, &mut KeyReader, &str) -> Arc<dyn TrackerKeys>;

/// A kind of trackers: a row of the table.
pub struct TrackerKind {
    /// Its word and its keys in the rig file.
    pub word: KindWord,
    /// Where its poses come from.
    pub origin: PoseOrigin,
    /// The page of the manual about it, with a heading: `docs/TRACKERS.md#vrpn`.
    pub page: &'static str,
    /// Its decoders of bytes from outside, for fuzzing.
    pub decoders: &'static [Decoder],
    /// Starts a server of this kind on this machine.
    pub mock: fn(&MockScene) -> io::Result<MockServer>,
    read: ReadKeys,
}

impl TrackerKind {
    /// A kind with the keys of `K`, called `word` in the rig file. `about`: what it is, the end of a sentence.
    pub const fn of<K: TrackerKeys + Section>(
        word: &'static str,
        about: &'static str,
        origin: PoseOrigin,
        page: &'static str,
        decoders: &'static [Decoder],
        mock: fn(&MockScene) -> io::Result<MockServer>,
    ) -> Self {
        Self { word: KindWord::of::<K>(word, about), origin, page, decoders, mock, read: read::<K> }
    }
}

impl Row for TrackerKind {
    type Keys = dyn TrackerKeys;

    fn registry() -> &'static Registry<Self> {
        &super::KINDS
    }

    fn word(&self) -> &KindWord {
        &self.word
    }

    fn is_mock(&self) -> bool {
        self.origin == PoseOrigin::Simulated
    }

    fn read(
        &self,
        table: &BTreeMap<String, Entry>,
        reader: &mut KeyReader,
        section: &str,
    ) -> Arc<dyn TrackerKeys> {
        (self.read)(table, reader, section)
    }
}

fn read<K: TrackerKeys + Section>(
    table: &BTreeMap<String, Entry>,
    reader: &mut KeyReader,
    section: &str,
) -> Arc<dyn TrackerKeys> {
    Arc::new(K::read_keys(table, reader, section))
}

/// What a mock server plays.
pub struct MockScene {
    /// Samples of each body.
    pub source: SampleSource,
    /// The motions that the samples are of.
    pub motions: Vec<Motion>,
    /// Names of the bodies.
    pub names: Vec<String>,
    /// The clock of the samples.
    pub clock: Arc<dyn HostClock>,
}

/// A mock server that runs until it is dropped.
pub struct MockServer {
    /// How a rig file reaches it: keys of `[tracker]` and their values, as TOML.
    pub keys: Vec<(&'static str, String)>,
    /// What runs.
    pub running: Box<dyn Any + Send>,
}
