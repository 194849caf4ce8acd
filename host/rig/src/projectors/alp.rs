//! `projector.backend.kind = "alp"`: a ViALUX ALP, by the vendor's library that its user has installed.

use super::alp_library;
use super::keys::{DeviceLook, DeviceName, FrameKeys, Medium, Opening, Panel, ProjectorKeys};
use super::kind::ProjectorKind;
use super::light::{LitTime, PlaneTiming, PlaneWeights};
use dpm_alp::{AlpSettings, AlpTransport, ShowMode, Weights};
use dpm_common::keys::read::{contradict, shown, Any, KeyReader, NotEmpty, Within};
use dpm_common::{section, words};
use dpm_device::transport::TransportError;
use dpm_render::pack::Halftone;
use std::path::PathBuf;

section! {
    /// A ViALUX ALP-4 or ALP-5. docs/ALP.md says how it is set up, and what was never tried on hardware.
    pub struct AlpConfig {
        /// The vendor's library, for example "/usr/lib/x86_64-linux-gnu/libalp44.so". The newest one that the system has, if left out.
        library: Option<PathBuf> = None, "", NotEmpty;
        /// Serial number of the device; 0 is the first one that is found.
        device_number: u32 = 0, "", Within(0, 2_147_483_647);
        /// How long the planes of a frame are lit: all equally long, or each as its bit weighs. With "equal" write
        /// `projector.weights` = "equal", or dim the light source from plane to plane.
        plane_times: AlpWeights = AlpWeights::Equal, "", Any;
        /// Slots for which a frame is lit if the host is late with the next one: also the longest time of light after
        /// the host has died.
        slots_per_sequence: u32 = 1, "slots", Within(1, 3);
        /// Frames that may wait in the device's memory; fewer, if it holds fewer.
        frames_in_flight: u32 = 4, "frames", Within(1, 60);
        /// Temperature of any of its sensors above which it goes dark; what the device recommends, if left out.
        max_celsius: Option<f64> = None, "degC", Within(0.0, 150.0);
    }
}

/// The shortest picture of a V-7001, nanoseconds; the device is asked for its own when it is opened.
const SHORTEST_NS: i64 = 44_000;

words! {
    /// How the planes of a frame share its time on an ALP.
    pub enum AlpWeights {
        /// All are lit equally long.
        Equal = "equal",
        /// By their bits, with a constant light source: `projector.planes` = 8 only.
        Binary = "binary",
    }
}

impl AlpWeights {
    /// The weights in the driver's type.
    const fn weights(self) -> Weights {
        match self {
            Self::Equal => Weights::Equal,
            Self::Binary => Weights::Binary,
        }
    }
}

pub(super) static KIND: ProjectorKind = ProjectorKind::of::<AlpConfig>(
    "alp",
    "ALP",
    "a ViALUX ALP-4 or ALP-5, driven by the vendor's library that its user has installed.",
    "docs/ALP.md",
);

impl ProjectorKeys for AlpConfig {
    fn device(&self) -> DeviceName {
        // The serial number that the vendor gave it.
        let named = Some(self.device_number).filter(|n| *n > 0).map(|n| n.to_string());
        DeviceName { named, is_proof: true, ..DeviceName::of(KIND.name) }
    }

    /// An ALP has one picture time for each sequence, so binary weights take a sequence for each plane. What the panel, its
    /// memory and its cable hold is known when it is opened.
    fn check(&self, frames: &FrameKeys, reader: &mut KeyReader) {
        if self.plane_times != AlpWeights::Binary {
            return;
        }
        let weights = ("projector.backend.plane_times", shown(self.plane_times));
        if frames.weights == PlaneWeights::Equal {
            contradict(
                reader,
                &[weights, frames.weights_key()],
                "halftones need planes of equal light",
                "set projector.backend.plane_times = \"equal\", or leave projector.weights out".into(),
            );
            return;
        }
        if frames.planes != 8 {
            contradict(
                reader,
                &[weights, ("projector.planes", shown(frames.planes))],
                "binary weights are for the eight planes of one channel",
                "set projector.planes = 8, or projector.backend.plane_times = \"equal\"".into(),
            );
        } else if self.slots_per_sequence > 1 {
            contradict(
                reader,
                &[("projector.backend.slots_per_sequence", shown(self.slots_per_sequence)), weights],
                "a frame of binary weights is several sequences, which the device does not repeat as one",
                "set projector.backend.slots_per_sequence = 1, or projector.backend.plane_times = \"equal\""
                    .into(),
            );
        }
    }

    fn plane_timing(&self) -> PlaneTiming {
        match self.plane_times {
            AlpWeights::Binary => PlaneTiming::ByWeight,
            AlpWeights::Equal => PlaneTiming::Equal,
        }
    }

    /// A dark picture ends every frame: as long as a plane, or as the shortest.
    fn lit_time(&self, frames: &FrameKeys) -> LitTime {
        let whole = LitTime::all_of(frames.rate);
        let dark_ns = match self.plane_times {
            AlpWeights::Equal => whole.frame_ns / (i64::from(frames.planes) + 1),
            AlpWeights::Binary => SHORTEST_NS.min(whole.frame_ns / 2),
        };
        LitTime { whole_ns: whole.frame_ns - dark_ns, ..whole }
    }

    fn is_lit_fully(&self) -> bool {
        true
    }

    fn look(&self, _: &Panel) -> Result<(), TransportError> {
        let found = alp_library::find(self.library.as_deref());
        found.map(drop).map_err(|why| TransportError::Unsuitable {
            device: KIND.name.into(),
            why: format!("{why}; {}", alp_library::REMEDY),
        })
    }

    fn examine(&self, loads: bool) -> Option<Result<DeviceLook, String>> {
        let look = |(file, doubt): (PathBuf, String)| DeviceLook {
            found: format!("{} is a library for this machine{doubt}", file.display()),
            is_doubtful: !doubt.is_empty(),
            remedy: "`dpm doctor --load-libraries RIG.toml` runs it, and asks the device what it can show"
                .into(),
        };
        (!loads).then(|| alp_library::find(self.library.as_deref()).map(look))
    }

    fn open(&self, opening: &Opening<'_>) -> Result<Option<Medium>, TransportError> {
        let Opening { panel, around, .. } = opening;
        let opened = AlpTransport::open(AlpSettings {
            library: self.library.clone(),
            number: self.device_number as i32,
            raster: panel.raster,
            showing: ShowMode {
                schedule: panel.schedule,
                weights: self.plane_times.weights(),
                rate: panel.rate,
                frames: self.frames_in_flight as usize,
                runs: self.slots_per_sequence,
            },
            max_celsius: self.max_celsius,
            frame_bytes: panel.frame_bytes(),
            clock: around.clock.clone(),
            enter: around.enter.clone(),
            wait: around.wait,
        });
        let transport = opened.map_err(|e| TransportError::Unsuitable {
            device: "projector.backend".into(),
            why: e.to_string(),
        })?;
        let mut warnings: Vec<String> = transport.welcome().map(ToString::to_string).into_iter().collect();
        if self.plane_times == AlpWeights::Equal && Halftone::of(&panel.schedule).is_none() {
            warnings.push(format!(
                "projector.backend.plane_times = \"equal\": the {} planes are lit equally long, so levels are right only if the light source is dimmed from \
                 plane to plane; `projector.weights` = \"equal\" shows grey without that (docs/ALP.md)",
                panel.schedule.len()
            ));
        }
        Ok(Some(Medium { transport: Box::new(transport), warnings }))
    }
}
