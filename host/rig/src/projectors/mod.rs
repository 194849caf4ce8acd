//! Kinds of projectors. Each is a row of one table ([`kinds`]): the object that reads its keys, looks for it, opens it, and
//! answers what the rest of the program asks about it. Nothing outside this folder names a kind, but for programs that
//! drive one by other means than the bit-plane link.
//!
//! A kind is a file here, or in another crate that calls [`add`], with a [`ProjectorKind`]. A suite over all rows is in
//! `tests/tests/laws/projector_kinds.rs`.

#[cfg(feature = "alp")]
mod alp;
#[cfg(feature = "alp")]
pub mod alp_library;
mod compaction;
#[cfg(feature = "display")]
pub mod controller;
#[cfg(feature = "display")]
pub mod display;
mod keys;
mod kind;
mod light;
mod mock;
mod serial;
mod usb;
#[cfg(feature = "display")]
mod window;

pub use compaction::Compaction;
pub use keys::{
    frame_bytes, Cable, DeviceLook, DeviceName, FrameKeys, Medium, Opening, Panel, ProjectorBackend,
    ProjectorKeys, Surroundings,
};
pub use kind::{FrameRoad, ProjectorKind, SlotClock};
pub use light::{LitTime, PlaneTiming, PlaneWeights};
pub use mock::MockProjectorConfig;

use dpm_common::keys::rows::{Registry, Row};

/// One row a kind, in the order of the manual. The first plays a rig file that names none, and `--simulate`.
static KINDS: Registry<ProjectorKind> = Registry::new(&[
    &mock::KIND,
    &usb::KIND,
    &serial::KIND,
    #[cfg(feature = "alp")]
    &alp::KIND,
    #[cfg(feature = "display")]
    &display::KIND,
    #[cfg(feature = "display")]
    &window::KIND,
]);

/// All kinds.
pub fn kinds() -> Vec<&'static ProjectorKind> {
    KINDS.all()
}

/// Adds a kind of another crate. Call it before a rig file is read.
pub fn add(kind: &'static ProjectorKind) {
    KINDS.add(kind);
}

/// The kind `word` with the defaults of its keys.
pub fn backend(word: &str) -> Option<ProjectorBackend> {
    kinds().into_iter().find(|kind| kind.word().word == word).map(ProjectorBackend::plain)
}
