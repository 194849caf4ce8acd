//! `[projector.backend.dlpc900]`: a DLPC900 at the other end of a display's cable.

use crate::feed;
use crate::keys::{check_panel, guardian_of, Dlpc900Panel, VideoInput, NO_WATCHDOG, WORD};
use dpm_common::keys::read::{contradict, refuse, shown, Any, KeyReader, NotEmpty, Within};
use dpm_common::keys::rows::Section;
use dpm_common::section;
use dpm_device::planes::{Parts, PlaneSchedule};
use dpm_device::time::FrameRate;
use dpm_device::transport::TransportError;
use dpm_display::transport::Opener;
use dpm_dlpc900::usb::{self, UsbPlace};
use dpm_dlpc900::video::{dark_us, exposure_us, BadExposure, VideoBits, VideoPatterns};
use dpm_rig::projectors::controller::{Controller, ControllerKind};
use dpm_rig::projectors::{FrameKeys, LitTime, Panel, Surroundings};
use std::sync::Arc;

section! {
    /// A TI DLPC900 whose video input the display feeds: every frame is cut into patterns, which are shown one after the other
    /// while the next frame arrives. `encoding` says into which; the planes and their weights follow from it, so leave
    /// `projector.weights` out.
    pub struct BehindConfig {
        /// The panel at the controller; it must have the projector's width and height.
        panel: Dlpc900Panel = Dlpc900Panel::Dlp6500, "", Any;
        /// Its video input.
        input: VideoInput = VideoInput::Hdmi, "", Any;
        /// The controller, as BUS:ADDRESS in `lsusb`; needed if several are plugged in.
        device: Option<String> = None, "", NotEmpty;
        /// Exposure of each pattern; the rest of its time is dark. If left out, nine tenths of that time: 620 of at
        /// most 684 for 24 patterns at 60 frames/s.
        exposure_us: Option<u32> = None, "us", Within(24, 40_000);
    }
}

/// Its row behind displays.
pub static KIND: ControllerKind = ControllerKind {
    keys: BehindConfig::KEYS,
    document: BehindConfig::document,
    read: |table, reader, key| Arc::new(BehindConfig::read_keys(table, reader, key)),
};

/// How the controller cuts a pixel of these parts into patterns.
const fn bits_of(parts: Parts) -> VideoBits {
    VideoBits::new(parts.depth).expect("each encoding's bits fill a pixel")
}

impl BehindConfig {
    /// How long each pattern is lit, microseconds.
    ///
    /// # Errors
    /// The patterns do not fit into a frame.
    pub fn exposure_us(&self, parts: Parts, rate: FrameRate) -> Result<u32, BadExposure> {
        exposure_us(bits_of(parts), self.panel.dmd(), rate, self.exposure_us)
    }

    /// The patterns of a frame.
    ///
    /// # Errors
    /// As for [`Self::exposure_us`].
    pub fn video_patterns(
        &self,
        parts: Parts,
        rate: FrameRate,
        schedule: &PlaneSchedule,
    ) -> Result<VideoPatterns, BadExposure> {
        let (dmd, receiver) = (self.panel.dmd(), self.input.receiver());
        let of = |us| VideoPatterns::of_rig(dmd, receiver, rate, schedule, bits_of(parts), us);
        self.exposure_us(parts, rate).map(of)
    }

    /// Where the controller is plugged in, if the rig file says it.
    fn place(&self) -> Result<Option<UsbPlace>, TransportError> {
        let place = self.device.as_deref().map(str::parse::<UsbPlace>).transpose();
        place.map_err(|e| refused("device", e.to_string()))
    }
}

/// A key of the controller, refused.
fn refused(key: &str, why: String) -> TransportError {
    TransportError::Unsuitable { device: format!("projector.backend.{WORD}.{key}"), why }
}

impl Controller for BehindConfig {
    fn check(&self, parts: Parts, frames: &FrameKeys, reader: &mut KeyReader) {
        check_panel(frames, "display", "projector.backend.dlpc900.panel", self.panel, reader);
        if let Err(why) = self.exposure_us(parts, frames.rate) {
            refuse(
                reader,
                &["projector.backend.dlpc900.exposure_us", "projector.frame_rate"],
                why.to_string(),
                "leave `projector.backend.dlpc900.exposure_us` out, or lower `projector.frame_rate`".into(),
            );
        }
        if frames.rate.num() > 120 * frames.rate.den() {
            contradict(
                reader,
                &[("projector.frame_rate", shown(frames.rate))],
                "a DLPC900 receives at most 120 video frames/s",
                "choose a mode with a lower rate".into(),
            );
        }
    }

    fn lit_time(&self, parts: Parts, frames: &FrameKeys) -> LitTime {
        let Ok(exposure_us) = self.exposure_us(parts, frames.rate) else {
            return LitTime::all_of(frames.rate);
        };
        let patterns = bits_of(parts).patterns();
        let dark_us = dark_us(bits_of(parts), frames.rate, exposure_us);
        LitTime {
            whole_ns: i64::from((exposure_us + dark_us) * patterns) * 1000,
            dark_ns: i64::from(dark_us) * 1000,
            ..LitTime::all_of(frames.rate)
        }
    }

    fn guardian(&self) -> Vec<String> {
        guardian_of(self.device.as_deref())
    }

    fn look(&self) -> Result<(), TransportError> {
        let place = self.place()?;
        usb::look(place)
            .map_err(|e| TransportError::Unsuitable { device: usb::describe(place), why: e.to_string() })
    }

    fn feed(
        &self,
        opener: Opener,
        parts: Parts,
        panel: &Panel,
        around: &Surroundings,
    ) -> Result<Opener, TransportError> {
        let place = self.place()?;
        let video = self.video_patterns(parts, panel.rate, &panel.schedule);
        let video = video.map_err(|e| refused("exposure_us", e.to_string()))?;
        Ok(feed::behind(opener, Arc::new(move || usb::open(place)), video, around.stop.clone()))
    }

    fn warning(&self) -> &'static str {
        NO_WATCHDOG
    }
}
