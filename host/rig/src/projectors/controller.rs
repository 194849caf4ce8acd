//! A controller at the other end of a display's cable: it cuts each frame of the video signal into patterns, and shows them
//! while the next frame arrives. Its crate adds it ([`add`]); the display asks it through [`Controller`].

use super::keys::{FrameKeys, Panel, Surroundings};
use super::light::LitTime;
use dpm_common::keys::read::{ConfigValue, KeyDoc, KeyReader};
use dpm_common::keys::rows::KeyValues;
use dpm_common::keys::source::{Entry, SourceNode};
use dpm_device::planes::Parts;
use dpm_device::transport::TransportError;
use dpm_display::transport::Opener;
use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

/// The keys of a controller, and what a display asks of it. `parts`: how each channel shows its code value, by the encoding of
/// the display.
pub trait Controller: KeyValues {
    /// Refuses values that do not fit the frames.
    fn check(&self, parts: Parts, frames: &FrameKeys, reader: &mut KeyReader);

    /// Which part of a frame its patterns take.
    fn lit_time(&self, parts: Parts, frames: &FrameKeys) -> LitTime;

    /// Words of a command of this program that ends the light of a killed run.
    fn guardian(&self) -> Vec<String>;

    /// Looks whether it is there and may be used, within milliseconds. Nothing is set up or lit.
    ///
    /// # Errors
    /// What is missing.
    fn look(&self) -> Result<(), TransportError>;

    /// The opener of the display `opener` with this controller behind it.
    ///
    /// # Errors
    /// A key makes no sense; the check of the rig file has refused it.
    fn feed(
        &self,
        opener: Opener,
        parts: Parts,
        panel: &Panel,
        around: &Surroundings,
    ) -> Result<Opener, TransportError>;

    /// What an operator must know of it.
    fn warning(&self) -> &'static str;
}

/// Reads the keys of a controller from a table of the rig file, whose name comes last.
type ReadKeys = fn(&BTreeMap<String, Entry>, &mut KeyReader, &str) -> Arc<dyn Controller>;

/// The row of a controller.
pub struct ControllerKind {
    /// Names of its keys.
    pub keys: &'static [&'static str],
    /// Adds its keys to the manual, as keys of the given section.
    pub document: fn(&str, &mut Vec<KeyDoc>),
    /// Reads its keys.
    pub read: ReadKeys,
}

/// The one that this program has. There is one: the rig file names it by the name of its table.
static KIND: OnceLock<&'static ControllerKind> = OnceLock::new();

/// Adds the controller of another crate. Call it before a rig file is read.
pub fn add(kind: &'static ControllerKind) {
    KIND.get_or_init(|| kind);
}

/// The controller behind a display, if there is one.
#[derive(Clone, Debug, Default)]
pub struct Behind(Option<Arc<dyn Controller>>);

impl Behind {
    /// The controller.
    pub fn get(&self) -> Option<&dyn Controller> {
        self.0.as_deref()
    }

    /// Its keys, if they are `K`.
    pub fn keys<K: 'static>(&self) -> Option<&K> {
        self.0.as_ref()?.as_any().downcast_ref()
    }
}

impl PartialEq for Behind {
    fn eq(&self, other: &Self) -> bool {
        match (&self.0, &other.0) {
            (Some(one), Some(other)) => one.is_same(other.as_any()),
            (one, other) => one.is_none() && other.is_none(),
        }
    }
}

impl ConfigValue for Behind {
    fn kind() -> String {
        "a table".into()
    }

    fn read(node: &SourceNode, reader: &mut KeyReader, key: &str) -> Option<Self> {
        let Some(kind) = KIND.get() else {
            reader.refuse(&node.origin, key, "needs what this program was built without", "");
            return None;
        };
        let table = reader.table(node, key)?;
        reader.unknown_keys(table, key, kind.keys);
        Some(Self(Some((kind.read)(table, reader, key))))
    }

    fn show(&self) -> String {
        "{}".into()
    }

    fn docs(key: &str, out: &mut Vec<KeyDoc>) {
        if let Some(kind) = KIND.get() {
            (kind.document)(key, out);
        }
    }
}
