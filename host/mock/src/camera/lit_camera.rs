//! A camera that sees what a projector beside it shows, and when.

use super::host::PictureMaker;
use super::{Exposure, LitView, MockCamera, MockCameraConfig, MockCameraError};
use crate::projector::Shown;
use dpm_device::planes::Raster;
use dpm_device::time::HostClock;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Slots that are remembered: a camera exposes for some of them.
const MOST_SLOTS: usize = 256;
/// How long after the end of an exposure the slots of it have been told, nanoseconds.
const TOLD_WITHIN_NS: i64 = 40_000_000;

/// A slot of the projector and the light of its raster.
struct Slot {
    from_ns: i64,
    until_ns: i64,
    planes: Arc<[u8]>,
    /// Shares of full light, row after row.
    lit: Arc<[f32]>,
}

/// What the projector has shown.
pub struct ShownLight {
    raster: Raster,
    slots: Mutex<VecDeque<Slot>>,
}

impl ShownLight {
    /// Nothing yet.
    pub fn new(raster: Raster) -> Self {
        Self { raster, slots: Mutex::new(VecDeque::new()) }
    }

    /// Adds a slot.
    pub fn add(&self, shown: &Shown) {
        let mut slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        // A picture that stands is added up once.
        let same = slots.back().filter(|s| s.planes[..] == shown.planes[..]).map(|s| s.lit.clone());
        let slot = Slot {
            from_ns: shown.event.first_photon_at.0,
            until_ns: shown.planes_end_at.0,
            planes: shown.planes[..].into(),
            lit: same.unwrap_or_else(|| self.light_of(shown)),
        };
        slots.push_back(slot);
        if slots.len() > MOST_SLOTS {
            slots.pop_front();
        }
    }

    /// The light of each pixel in the mean of a slot, whatever its colour.
    fn light_of(&self, shown: &Shown) -> Arc<[f32]> {
        let specs = shown.schedule.planes();
        let whole: f32 = specs.iter().map(|s| f32::from(1u16 << s.bit)).sum();
        let mut lit = vec![0.0; self.raster.pixel_count()];
        let width = self.raster.width() as usize;
        for (spec, plane) in specs.iter().zip(shown.planes.chunks_exact(self.raster.plane_bytes())) {
            let share = f32::from(1u16 << spec.bit) / whole;
            for (row, bytes) in lit.chunks_exact_mut(width).zip(plane.chunks_exact(self.raster.row_bytes())) {
                let is_lit = |x: usize| bytes[x / 8] >> (7 - x % 8) & 1 == 1;
                row.iter_mut().enumerate().filter(|(x, _)| is_lit(*x)).for_each(|(_, v)| *v += share);
            }
        }
        lit.into()
    }

    /// The light of each pixel in the mean of a time.
    fn during(&self, from_ns: i64, until_ns: i64) -> Vec<f32> {
        let slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        let mut mean = vec![0.0; self.raster.pixel_count()];
        for slot in slots.iter() {
            let common = slot.until_ns.min(until_ns) - slot.from_ns.max(from_ns);
            if common > 0 {
                let share = common as f32 / (until_ns - from_ns) as f32;
                mean.iter_mut().zip(&*slot.lit).for_each(|(m, l)| *m += share * l);
            }
        }
        mean
    }
}

/// The camera.
pub struct LitCamera {
    /// Rate, exposure and faults; its own picture is not used.
    timing: MockCamera,
    view: LitView,
    light: Arc<ShownLight>,
}

impl LitCamera {
    /// A camera with the rate, exposure and faults of `config` before what `view` shows.
    ///
    /// # Errors
    /// Those of [`MockCamera::new`].
    pub fn new(
        config: MockCameraConfig,
        view: LitView,
        light: Arc<ShownLight>,
    ) -> Result<Self, MockCameraError> {
        let optics = view.stage().camera.clone();
        let config = MockCameraConfig { optics, row_ns: 0, clutter: 0, ..config };
        Ok(Self { timing: MockCamera::new(config, vec![])?, view, light })
    }
}

impl PictureMaker for LitCamera {
    fn config(&self) -> &MockCameraConfig {
        self.timing.config()
    }

    fn exposure(&self, number: u64) -> Option<Exposure> {
        self.timing.exposure(number)
    }

    fn make(&mut self, exposure: &Exposure, clock: &dyn HostClock, pixels: &mut Vec<u8>) {
        let until_ns = exposure.begin_ns + self.config().exposure_ns;
        let left = until_ns + TOLD_WITHIN_NS - clock.now().0;
        std::thread::sleep(Duration::from_nanos(left.clamp(0, 1_000_000_000) as u64));
        *pixels = self.view.picture(&self.light.during(exposure.begin_ns, until_ns), exposure.number);
    }
}
