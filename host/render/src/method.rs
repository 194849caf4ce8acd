//! How a frame spends its rays: a method of the rig file with its switches, in the form that the renderer needs.

use dpm_shaders::{specialization as ids, structs as gpu};

/// Where random numbers come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum SamplerKind {
    /// They are independent for every path.
    Independent = gpu::SAMPLER_INDEPENDENT,
    /// Each frame has one point set, shifted at every pixel by blue noise.
    BlueNoise = gpu::SAMPLER_BLUE_NOISE,
    /// Each surface point has one low-discrepancy sequence, continued over frames. The history keeps the place in it.
    Continued = gpu::SAMPLER_CONTINUED,
    /// Each pixel has one low-discrepancy sequence, continued over frames. It needs no history.
    PixelSequence = gpu::SAMPLER_PIXEL_SEQUENCE,
}

/// The constants of the paper's method \[paper\]. Angles are at the eye, from the gaze.
#[derive(Clone, Debug, PartialEq)]
pub struct PaperConstants {
    /// Sensitivity threshold of equation 2.
    pub t: f64,
    /// Background luminance of equation 2, scene units.
    pub l: f64,
    /// The full rate is kept up to this angle, degrees (equation 4). Also the inner bound of table 1.
    pub phi_h_deg: f64,
    /// The quarter rate begins at this angle, degrees (equation 4). Also the outer bound of table 1.
    pub phi_q_deg: f64,
    /// Table 1: weight of the new frame inside `phi_h_deg`, between the two, and outside `phi_q_deg`. Above 0, at most 1.
    pub temporal_alpha: [f64; 3],
    /// Table 1: samples of a pixel in the same three zones.
    pub zone_spp: [u32; 3],
    /// The spatial filter is blended in from this angle on, degrees.
    pub filter_from_deg: f64,
    /// From this angle on, degrees, only the filtered picture is shown.
    pub filter_to_deg: f64,
}

impl Default for PaperConstants {
    /// The published numbers.
    fn default() -> Self {
        Self {
            t: 0.0762,
            l: 0.363,
            phi_h_deg: 15.0,
            phi_q_deg: 30.0,
            temporal_alpha: [0.2, 0.1, 0.05],
            zone_spp: [18, 18, 2],
            filter_from_deg: 15.0,
            filter_to_deg: 18.0,
        }
    }
}

/// A method with all switches resolved.
#[derive(Clone, Debug, PartialEq)]
pub struct Method {
    /// This program's own method instead of the paper's. Its history counts samples, and is stored without the albedo.
    pub dpm: bool,
    /// Rays go by importance (dpm), or by shading rates per tile (paper).
    pub rate_map: bool,
    /// Half of the coarse pixels are traced in a frame (not dpm).
    pub checkerboard: bool,
    /// Where random numbers come from.
    pub sampler: SamplerKind,
    /// Earlier frames are blended in.
    pub temporal: bool,
    /// The picture is filtered in space.
    pub spatial: bool,
    /// The number of samples depends on the visual angle (not dpm).
    pub spp_by_angle: bool,
    /// Samples that dpm may spend on average in a lit pixel and frame. Also the number of samples where no other rule applies.
    pub budget_spp: f32,
    /// Most frames' worth of samples in dpm's history.
    pub history_cap: f32,
    /// The paper's constants.
    pub paper: PaperConstants,
}

/// Most frames' worth of samples in dpm's history. It is long enough that the eye's own 31 frames are not the limit. The lag that it causes when
/// the light changes is measured and corrected.
pub const HISTORY_CAP: f32 = 96.0;

impl Method {
    /// The paper's predecessor \[Nomoto20\]: every pixel is traced with independent samples, and nothing is kept.
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
            paper: PaperConstants::default(),
        }
    }

    /// Whether a history is kept: to blend frames, because not every pixel is traced in every frame, or for the pass `spatial`, which reads the
    /// history's picture.
    pub fn needs_history(&self) -> bool {
        self.dpm || self.temporal || self.rate_map || self.checkerboard || self.spatial
    }

    /// Whether the pass `rate_map` is recorded.
    pub fn needs_rates(&self) -> bool {
        self.rate_map && !self.dpm
    }

    /// Whether motion, size, angle and albedo of every pixel are written: for the history, for the filters, or to choose samples.
    pub(crate) fn needs_guides(&self) -> bool {
        self.needs_history() || self.needs_spatial() || self.spp_by_angle
    }

    /// Whether the pass `spatial` is recorded.
    pub fn needs_spatial(&self) -> bool {
        self.dpm || self.spatial
    }

    /// Most samples of a pixel that a frame may ask for: what the method was made for, and never fewer than a workgroup of the pass `trace` has
    /// room for.
    pub fn most_spp(&self) -> u32 {
        let of_zones = if self.spp_by_angle { self.paper.zone_spp.into_iter().max().unwrap_or(0) } else { 0 };
        (self.budget_spp.ceil() as u32).max(of_zones).max(gpu::TRACE_PIXEL_SAMPLES)
    }

    /// Specialization constants that the method decides, each as id and value.
    pub(crate) fn constants(&self) -> [(u32, u32); 5] {
        [
            (ids::MANY_SAMPLES, u32::from(self.most_spp() > gpu::TRACE_PIXEL_SAMPLES)),
            (ids::SAMPLER, self.sampler as u32),
            (ids::HAS_GUIDES, u32::from(self.needs_guides())),
            (ids::HAS_DEMODULATION, u32::from(self.dpm)),
            (ids::HAS_FILTER, u32::from(self.spatial)),
        ]
    }

    /// `FRAME_*` bits.
    pub(crate) fn flags(&self) -> u32 {
        let bit = |on: bool, flag: u32| if on { flag } else { 0 };
        bit(self.needs_rates(), gpu::FRAME_RATE_MAP)
            | bit(self.checkerboard, gpu::FRAME_CHECKERBOARD)
            | bit(self.spp_by_angle, gpu::FRAME_SPP_BY_ANGLE)
            | bit(self.temporal, gpu::FRAME_TEMPORAL)
            | bit(self.dpm, gpu::FRAME_DPM)
            | bit(self.dpm && self.rate_map, gpu::FRAME_ALLOCATE)
    }
}
