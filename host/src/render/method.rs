//! How a frame spends its rays: a method of the rig file with its switches, as the renderer needs it.

use crate::config::{PaperConfig, RenderConfig, RenderMethod};
use dpm_shaders::structs as gpu;

/// Where random numbers come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum SamplerKind {
    /// Independent for every path.
    Independent = 0,
    /// One point set a frame, shifted at every pixel by blue noise.
    BlueNoise = 1,
    /// One low-discrepancy sequence a surface point, continued over frames; its place is kept in the history.
    Continued = 2,
    /// One low-discrepancy sequence a pixel, continued over frames; needs no history.
    PixelSequence = 3,
}

/// A method with all switches resolved.
#[derive(Clone, Debug, PartialEq)]
pub struct Method {
    /// This program's own method (history counts samples, demodulated) instead of the paper's.
    pub dpm: bool,
    /// Rays by importance (dpm) or shading rates per tile (paper).
    pub rate_map: bool,
    /// Half of the coarse pixels a frame (not dpm).
    pub checkerboard: bool,
    /// Random numbers.
    pub sampler: SamplerKind,
    /// Former frames are blended in.
    pub temporal: bool,
    /// The picture is filtered in space.
    pub spatial: bool,
    /// Samples by visual angle (not dpm).
    pub spp_by_angle: bool,
    /// Samples per lit pixel and frame that dpm may spend; also the count where no other rule applies.
    pub budget_spp: f32,
    /// Frames' worth of samples that dpm's history may weigh.
    pub history_cap: f32,
    /// The paper's constants.
    pub paper: PaperConfig,
}

/// Frames' worth of samples in dpm's history: long enough that the eye's own 31 frames are not the limit; what it lags behind when the
/// light changes is measured and made up for.
pub const HISTORY_CAP: f32 = 96.0;

impl Method {
    /// The paper's predecessor \[Nomoto20\]: every pixel, independent samples, nothing kept.
    pub fn full(spp: u32) -> Self {
        Self {
            dpm: false,
            rate_map: false,
            checkerboard: false,
            sampler: SamplerKind::Independent,
            temporal: false,
            spatial: false,
            spp_by_angle: false,
            budget_spp: spp as f32,
            history_cap: 0.0,
            paper: PaperConfig::default(),
        }
    }

    /// What the rig file asks for.
    pub fn from_config(config: &RenderConfig) -> Self {
        let effects = config.effects_on();
        let dpm = config.method == RenderMethod::Dpm;
        let sampler = match (effects.blue_noise, config.method) {
            (false, _) => SamplerKind::Independent,
            (true, RenderMethod::Dpm) => SamplerKind::Continued,
            (true, RenderMethod::Sequence) => SamplerKind::PixelSequence,
            (true, _) => SamplerKind::BlueNoise,
        };
        Self {
            dpm,
            rate_map: effects.rate_map,
            checkerboard: effects.checkerboard && !dpm,
            sampler,
            temporal: effects.temporal_filter,
            spatial: effects.spatial_filter,
            spp_by_angle: effects.spp_by_angle && !dpm,
            budget_spp: config.spp as f32,
            history_cap: if effects.temporal_filter { HISTORY_CAP } else { 0.0 },
            paper: config.paper.clone(),
        }
    }

    /// A history is kept: for blending, because not every pixel is traced in every frame, or for the spatial pass, which reads what the
    /// history shows.
    pub fn needs_history(&self) -> bool {
        self.dpm || self.temporal || self.rate_map || self.checkerboard || self.spatial
    }

    /// The pass `rate_map` is recorded.
    pub fn needs_rates(&self) -> bool {
        self.rate_map && !self.dpm
    }

    /// Motion, size, angle and albedo of every pixel are written: for the history, for the filters, or to choose samples.
    pub fn needs_guides(&self) -> bool {
        self.needs_history() || self.needs_spatial() || self.spp_by_angle
    }

    /// The pass `spatial` is recorded.
    pub fn needs_spatial(&self) -> bool {
        self.dpm || self.spatial
    }

    /// `FRAME_*` bits.
    pub fn flags(&self) -> u32 {
        let bit = |on: bool, flag: u32| if on { flag } else { 0 };
        bit(self.needs_rates(), gpu::FRAME_RATE_MAP)
            | bit(self.checkerboard, gpu::FRAME_CHECKERBOARD)
            | bit(self.spp_by_angle, gpu::FRAME_SPP_BY_ANGLE)
            | bit(self.temporal, gpu::FRAME_TEMPORAL)
            | bit(self.dpm, gpu::FRAME_DPM)
            | bit(self.dpm && self.rate_map, gpu::FRAME_ALLOCATE)
    }
}
