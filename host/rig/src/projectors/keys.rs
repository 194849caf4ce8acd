//! `[projector.backend]`: a kind with the values of its keys, and what the program asks of it.

use super::compaction::Compaction;
use super::kind::ProjectorKind;
use super::light::{LitTime, PlaneTiming, PlaneWeights};
use super::mock::MockProjectorConfig;
use dpm_common::keys::read::KeyReader;
use dpm_common::keys::rows::{KeyValues, OfKind};
use dpm_common::stopping;
use dpm_device::link::{packet_bytes, COMMIT_BYTES};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{FrameRate, HostClock};
use dpm_device::transport::{Transport, TransportError};
use dpm_handoff::wake::WaitPolicy;
use std::sync::Arc;

/// `[projector.backend]` of a rig file.
pub type ProjectorBackend = OfKind<ProjectorKind>;

/// A connection to a projector outside this process.
pub struct Medium {
    /// The open medium.
    pub transport: Box<dyn Transport>,
    /// Warnings for the operator, for example a kernel limit that leaves room for fewer frames than requested.
    pub warnings: Vec<String>,
}

/// What a projector needs whose firmware runs in this process.
#[derive(Clone)]
pub struct Surroundings {
    /// The clock of the run.
    pub clock: Arc<dyn HostClock>,
    /// Called first in the projector's thread, for its rights.
    pub enter: Arc<dyn Fn() + Send + Sync>,
    /// How that thread waits.
    pub wait: WaitPolicy,
    /// True once the run should end, also while a projector is still being set up.
    pub stop: Arc<dyn Fn() -> bool + Send + Sync>,
}

impl Surroundings {
    /// A thread without special rights that parks. A signal stops it.
    pub fn plain(clock: Arc<dyn HostClock>) -> Self {
        Self { clock, enter: Arc::new(|| ()), wait: WaitPolicy::Park, stop: Arc::new(stopping::is_stopping) }
    }
}

/// What a rig file says of frames, beside the keys of a kind.
#[derive(Clone, Copy, Debug)]
pub struct FrameKeys {
    /// `projector.width` and `projector.height`.
    pub size: [u32; 2],
    /// `projector.frame_rate`.
    pub rate: FrameRate,
    /// `projector.planes`.
    pub planes: u32,
    /// `projector.weights`.
    pub weights: PlaneWeights,
}

impl FrameKeys {
    /// The weights, as a contradiction names them.
    pub fn weights_key(&self) -> (&'static str, String) {
        ("projector.weights", format!("{:?}", self.weights.word()))
    }
}

/// Bytes on the wire of the largest frame of `planes` planes.
pub fn frame_bytes(raster: Raster, planes: usize) -> usize {
    packet_bytes(raster.plane_bytes()) * planes + packet_bytes(COMMIT_BYTES)
}

/// The frames that a projector shows.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Its mirrors.
    pub raster: Raster,
    /// The planes of a frame.
    pub schedule: PlaneSchedule,
    /// Frames per second.
    pub rate: FrameRate,
    /// `projector.response` says that light is in proportion to code values.
    pub is_linear: bool,
    /// `real_time.priority`.
    pub priority: u32,
}

impl Panel {
    /// Bytes on the wire of the largest frame.
    pub fn frame_bytes(&self) -> usize {
        frame_bytes(self.raster, self.schedule.len())
    }
}

/// What a projector is opened with.
pub struct Opening<'a> {
    /// Its frames.
    pub panel: &'a Panel,
    /// The process that it is opened in.
    pub around: &'a Surroundings,
    /// True once something proves that another device is where this one was: it is not opened then.
    pub is_another: Arc<dyn Fn() -> bool + Send + Sync>,
}

/// What names a projector, as far as its keys say it.
#[derive(Clone, Debug)]
pub struct DeviceName {
    /// What all projectors of its kind share in the names of files.
    pub family: String,
    /// What names it among others of its kind; `None` if the rig file accepts any.
    pub named: Option<String>,
    /// It is a display: at the connector that is named here, or at the only one that has a display.
    pub connector: Option<Option<String>>,
    /// Names of its kind prove that two projectors differ.
    pub is_proof: bool,
    /// The name lasts; that of a place on a bus changes with every re-plug.
    pub is_lasting: bool,
    /// There is but one of its kind.
    pub is_single: bool,
}

impl DeviceName {
    /// A projector of `family` that nothing else names.
    pub fn of(family: impl Into<String>) -> Self {
        let family = family.into();
        Self { family, named: None, connector: None, is_proof: false, is_lasting: true, is_single: false }
    }
}

/// How a host is connected to the link of a projector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cable {
    /// By memory.
    InProcess,
    /// By USB.
    Usb,
    /// By a serial line.
    Serial {
        /// Bytes per second.
        bytes_per_s: u32,
    },
}

/// What was seen of a device without its link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeviceLook {
    /// What it is and how it stands.
    pub found: String,
    /// Something speaks against it.
    pub is_doubtful: bool,
    /// What to do, or how to see more.
    pub remedy: String,
}

/// The keys of a kind of projectors. A [`section!`](dpm_common::section) implements the rest of it. What has a default is
/// that of a bit-plane projector that shows planes of equal length one after the other for the whole frame.
pub trait ProjectorKeys: KeyValues {
    /// What names the device.
    fn device(&self) -> DeviceName;

    /// The serial port that it opens.
    fn port(&self) -> Option<&str> {
        None
    }

    /// Refuses values that make no sense with each other or with those of frames.
    fn check(&self, _frames: &FrameKeys, _reader: &mut KeyReader) {}

    /// How the light of a frame is shared out over its exposure.
    fn plane_timing(&self) -> PlaneTiming {
        PlaneTiming::Equal
    }

    /// Which part of a frame its planes take.
    fn lit_time(&self, frames: &FrameKeys) -> LitTime {
        LitTime::all_of(frames.rate)
    }

    /// A video input, and not this program, decides what is lit.
    fn is_lit_by_video_input(&self) -> bool {
        false
    }

    /// The planes of a frame, if these keys decide them.
    fn schedule(&self) -> Option<PlaneSchedule> {
        None
    }

    /// The light source is not dimmed from plane to plane, so white is full where all planes are on.
    fn is_lit_fully(&self) -> bool {
        false
    }

    /// From the start of a slot on the projector's clock to the middle of the light of its frame, as far as its kind delays
    /// it, nanoseconds. `frame_ns`: time of a frame.
    fn light_delay_ns(&self, _frame_ns: i64) -> i64 {
        0
    }

    /// How planes may be compacted on the way; `None`: they are not, because nothing is saved.
    fn compaction(&self) -> Option<Compaction> {
        None
    }

    /// The cable.
    fn cable(&self) -> Cable {
        Cable::InProcess
    }

    /// There is room for tracks beside planes.
    fn carries_tracks(&self) -> bool {
        false
    }

    /// The keys of the mock; `None` for every other kind.
    fn as_mock(&self) -> Option<&MockProjectorConfig> {
        None
    }

    /// Words of a command of this program that ends the light of a killed run, for a device that cannot do so by itself.
    fn guardian(&self) -> Option<Vec<String>> {
        None
    }

    /// Looks whether the projector is there and may be used. It takes milliseconds, and nothing is opened, lit or loaded.
    ///
    /// # Errors
    /// What is missing.
    fn look(&self, _panel: &Panel) -> Result<(), TransportError> {
        Ok(())
    }

    /// What can be seen of the device where its link is not asked; `None` if its link is the way to ask it. `loads`: code
    /// that the rig file names may run.
    ///
    /// # Errors
    /// It does not answer.
    fn examine(&self, _loads: bool) -> Option<Result<DeviceLook, String>> {
        None
    }

    /// Opens the medium of its link; `None` for a projector without one.
    ///
    /// # Errors
    /// The device was not found; there is no permission (the message names the rule or group that grants it); or another
    /// program uses it.
    fn open(&self, _opening: &Opening<'_>) -> Result<Option<Medium>, TransportError> {
        Ok(None)
    }
}
