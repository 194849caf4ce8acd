//! Opens the medium of `[projector.backend]`, and derives the link's settings from the rig file.

use crate::config::{Pace, ProjectorBackend, ResponseConfig, RigConfig};
use crate::engine::connect::ConnectError;
use crate::projectors::{Opening, Panel, SlotClock};
use crate::standing::Identity;
use dpm_device::link::{Codec, Epoch, LinkError, LinkSettings, Underrun};
use dpm_device::planes::Raster;
use dpm_device::time::DeviceTicks;
use std::sync::Arc;

pub use crate::projectors::{frame_bytes, Medium, Surroundings};

/// Time from the handshake to slot 0.
const EPOCH_NS: u64 = 5_000_000;

/// Whatever opens the medium of a rig's projector: [`open`], or a test that puts a made-up device in its place.
pub type OpenMedium =
    dyn Fn(&RigConfig, Raster, &Surroundings) -> Result<Option<Medium>, ConnectError> + Sync;

/// What the rig file says of the frames of a projector with `raster`.
pub fn panel(config: &RigConfig, raster: Raster) -> Panel {
    Panel {
        raster,
        schedule: config.projector.schedule(),
        rate: config.projector.frame_rate,
        is_linear: matches!(config.projector.response, ResponseConfig::Linear(_)),
        priority: config.real_time.priority,
    }
}

/// Opens the medium of a projector on the bit-plane link. `None` for one that has none.
///
/// # Errors
/// The device was not found; there is no permission (the message names the rule or group that grants it); or another
/// program uses it.
pub fn open(
    config: &RigConfig,
    raster: Raster,
    surroundings: &Surroundings,
) -> Result<Option<Medium>, ConnectError> {
    // The locks and the standing orders of this run are those of the device that it has found.
    let (first, backend) = (Identity::of(&config.projector.backend), config.projector.backend.clone());
    let is_another = Arc::new(move || first.is_certainly_not(&Identity::of(&backend)));
    let panel = panel(config, raster);
    let opening = Opening { panel: &panel, around: surroundings, is_another };
    config.projector.backend.open(&opening).map_err(|e| match (surroundings.stop)() {
        true => ConnectError::Stopped,
        false => ConnectError::from(LinkError::Transport(e)),
    })
}

/// Looks whether the projector of a rig file is there and may be used. It takes milliseconds, and nothing is opened, lit
/// or loaded; [`open`] may still find more. A projector that shows loaded frames is opened first by its own run.
///
/// # Errors
/// What is missing, in the words of [`open`] where that finds it too.
pub fn look(config: &RigConfig) -> Result<(), ConnectError> {
    let panel = panel(config, config.projector.raster());
    config.projector.backend.look(&panel).map_err(|e| ConnectError::from(LinkError::Transport(e)))
}

/// Codecs that the rig file allows on its link, as bits of [`Codec::mask`].
pub(crate) fn codecs(backend: &ProjectorBackend) -> u32 {
    backend.compaction().map_or(Codec::Raw.mask(), |compaction| compaction.codecs())
}

/// Number of flashes per second that the host permits; `None` if the limiter is off.
pub(crate) fn flash_limit(config: &RigConfig) -> Option<u8> {
    match config.safety.flashes_per_second {
        0 => None,
        n => Some(n.min(255) as u8),
    }
}

/// The link settings for the rig's projector.
pub fn link_settings(config: &RigConfig, raster: Raster) -> LinkSettings {
    LinkSettings {
        raster,
        schedule: config.projector.schedule(),
        rate: config.projector.frame_rate,
        watchdog_us: config.watchdog_us(),
        underrun: Underrun::Repeat,
        // At real pace a late frame is better than none. At virtual pace no frame is late.
        late_slots: if config.real_time.pace == Pace::Virtual { 0 } else { 255 },
        // The slots of a display are its vertical blanks, which its clock counts from 0.
        epoch: match config.projector.backend.kind().slots {
            SlotClock::Blanks => Epoch::At(DeviceTicks(0)),
            SlotClock::Firmware => Epoch::AfterHello(EPOCH_NS),
        },
        codecs: codecs(&config.projector.backend),
        flash_limit: flash_limit(config),
        limits: config.safety.limits.limits(&config.projector),
    }
}
