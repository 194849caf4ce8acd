//! Converts `[render]` of the rig file to the renderer's method.

use super::{PaperConfig, RenderConfig, RenderMethod};
use dpm_render::method::{Method, PaperConstants, SamplerKind, HISTORY_CAP};

impl RenderMethod {
    /// All that a frame can be drawn by, in the order of the reports.
    pub const DRAWN: [Self; 6] =
        [Self::Full, Self::Sequence, Self::Own, Self::Miyamoto, Self::Paper, Self::Dpm];

    /// Whether its frames take any number of samples, which a budget may change from frame to frame: `dpm` and what is made of it.
    pub fn takes_a_budget(self) -> bool {
        matches!(self, Self::Dpm | Self::Own | Self::Auto)
    }
}

impl RenderConfig {
    /// The method that the rig file asks for, with all its switches resolved. "auto" that nobody has decided is `dpm`.
    pub fn to_method(&self) -> Method {
        let effects = self.effects_on();
        let dpm = self.method.takes_a_budget();
        let sampler = match (effects.blue_noise, self.method) {
            (false, _) => SamplerKind::Independent,
            (true, _) if dpm => SamplerKind::Continued,
            (true, RenderMethod::Sequence) => SamplerKind::PixelSequence,
            (true, _) => SamplerKind::BlueNoise,
        };
        Method {
            dpm,
            rate_map: effects.rate_map,
            checkerboard: effects.checkerboard && !dpm,
            sampler,
            temporal: effects.temporal_filter,
            spatial: effects.spatial_filter,
            spp_by_angle: effects.spp_by_angle && !dpm,
            budget_spp: self.spp as f32,
            history_cap: if effects.temporal_filter { HISTORY_CAP } else { 0.0 },
            paper: self.paper.to_constants(),
        }
    }
}

impl PaperConfig {
    /// The constants in the renderer's type.
    fn to_constants(&self) -> PaperConstants {
        PaperConstants {
            t: self.t,
            l: self.l,
            phi_h_deg: self.phi_h_deg,
            phi_q_deg: self.phi_q_deg,
            temporal_alpha: self.temporal_alpha,
            zone_spp: self.zone_spp,
            filter_from_deg: self.filter_from_deg,
            filter_to_deg: self.filter_to_deg,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rig_files_defaults_are_the_published_constants() {
        assert_eq!(PaperConfig::default().to_constants(), PaperConstants::default());
    }
}
