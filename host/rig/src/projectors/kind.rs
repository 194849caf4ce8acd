//! The row of a kind of projectors.

use super::keys::ProjectorKeys;
use dpm_common::keys::read::KeyReader;
use dpm_common::keys::rows::{KindWord, Registry, Row, Section};
use dpm_common::keys::source::Entry;
use std::any::Any;
use std::collections::BTreeMap;
use std::sync::Arc;

/// On which road frames come to the light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameRoad {
    /// Into the mock of this process.
    Mock,
    /// Over the bit-plane link, each in its time.
    Fed,
    /// Loaded before their time into a device that then shows them by itself. It has no watchdog, nothing counts its light,
    /// and nobody knows when it is loaded where a head will be. A program of its own drives it.
    Loaded,
}

/// Whose clock the slots follow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SlotClock {
    /// That of the projector's firmware, from the handshake on, at the rate of the rig file.
    Firmware,
    /// Vertical blanks, counted from 0, at the rate of a mode.
    Blanks,
}

/// Reads the keys of a kind from a table of the rig file, whose name comes last.
type ReadKeys = fn(&BTreeMap<String, Entry>, &mut KeyReader, &str) -> Arc<dyn ProjectorKeys>;

/// A kind of projectors: a row of the table.
pub struct ProjectorKind {
    /// Its word and its keys in the rig file.
    pub word: KindWord,
    /// What it is called in messages, and in the names of files where the keys say no more.
    pub name: &'static str,
    /// The road of its frames.
    pub road: FrameRoad,
    /// Its own run: an [`OwnRun`](crate::own_run::OwnRun), which this folder does not name, because whole rigs run in it.
    pub own_run: Option<&'static (dyn Any + Send + Sync)>,
    /// Its slots.
    pub slots: SlotClock,
    /// A picture on a video cable reaches it, so another kind of which this is true may be the same projector.
    pub is_video: bool,
    /// The USB device that it is by itself: vendor, product, and what it is called.
    pub usb: Option<(u16, u16, &'static str)>,
    /// The page of the manual about it, with a heading: `docs/ALP.md#...`.
    pub page: &'static str,
    read: ReadKeys,
}

impl ProjectorKind {
    /// A kind on the bit-plane link with the keys of `K`, called `word` in the rig file and `name` in messages. `about`: what
    /// it is, the end of a sentence.
    pub const fn of<K: ProjectorKeys + Section>(
        word: &'static str,
        name: &'static str,
        about: &'static str,
        page: &'static str,
    ) -> Self {
        Self {
            word: KindWord::of::<K>(word, about),
            name,
            road: FrameRoad::Fed,
            own_run: None,
            slots: SlotClock::Firmware,
            is_video: false,
            usb: None,
            page,
            read: read::<K>,
        }
    }

    /// The same on another road.
    pub const fn on(self, road: FrameRoad) -> Self {
        Self { road, ..self }
    }

    /// The same with frames that are loaded before their time, by the [`OwnRun`](crate::own_run::OwnRun) `own_run`.
    pub const fn loaded(self, own_run: &'static (dyn Any + Send + Sync)) -> Self {
        Self { road: FrameRoad::Loaded, own_run: Some(own_run), ..self }
    }

    /// The same on a video cable; with `slots` that follow its blanks or not.
    pub const fn by_video(self, slots: SlotClock) -> Self {
        Self { is_video: true, slots, ..self }
    }

    /// The same as a USB device with these numbers, called `name`.
    pub const fn by_usb(self, vendor: u16, product: u16, name: &'static str) -> Self {
        Self { usb: Some((vendor, product, name)), ..self }
    }

    /// True if its frames are loaded before their time.
    pub fn is_loaded(&self) -> bool {
        self.road == FrameRoad::Loaded
    }
}

impl Row for ProjectorKind {
    type Keys = dyn ProjectorKeys;

    fn registry() -> &'static Registry<Self> {
        &super::KINDS
    }

    fn word(&self) -> &KindWord {
        &self.word
    }

    fn is_mock(&self) -> bool {
        self.road == FrameRoad::Mock
    }

    fn read(
        &self,
        table: &BTreeMap<String, Entry>,
        reader: &mut KeyReader,
        section: &str,
    ) -> Arc<dyn ProjectorKeys> {
        (self.read)(table, reader, section)
    }
}

fn read<K: ProjectorKeys + Section>(
    table: &BTreeMap<String, Entry>,
    reader: &mut KeyReader,
    section: &str,
) -> Arc<dyn ProjectorKeys> {
    Arc::new(K::read_keys(table, reader, section))
}
