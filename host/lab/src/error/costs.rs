//! What a frame of a method costs on cards that were measured: `dpm bench --report` of each, in `host/lab/cards/`.
//!
//! A frame's time is taken as so much for each lit pixel, which is all passes but `trace`, and so much for each ray, which is
//! `trace`. Both are of the full raster, which fills a card; so methods are compared as they would be there, whatever
//! raster they are drawn on here.

use serde::Deserialize;

/// Reports of cards, as `dpm bench --report FILE` writes them.
const REPORTS: [&str; 2] = [include_str!("../../cards/h100.json"), include_str!("../../cards/h200.json")];

/// The pass whose time goes with the rays.
const BY_RAYS: &str = "trace";

/// A card with the costs of the methods that were measured on it.
#[derive(Clone, Debug, Deserialize)]
pub struct CardCosts {
    stamp: CardStamp,
    #[serde(default)]
    methods: Vec<MethodReport>,
    #[serde(default)]
    frames: Vec<CardFrame>,
}

/// A frame that was measured on a card at 1024 x 768 and depth 3, as a row of docs/lab/H100.md has it.
#[derive(Clone, Debug, Deserialize)]
pub struct CardFrame {
    /// "demo", or "bunny-venus" with the diffuse bodies.
    pub scene: String,
    /// The method.
    pub method: String,
    /// Samples that were asked for.
    pub samples: String,
    /// Rays that surely meet nothing were not walked.
    pub horizons: bool,
    /// The pass `trace`, ms.
    pub trace_ms: f64,
    /// Distance of frames in line, ms.
    pub in_line_ms: Option<f64>,
    /// Rays of `trace`, and paths: of that frame where they were noted, else of the same frame on software Vulkan. The model is held to
    /// frames that have them.
    pub path_rays: Option<f64>,
    /// See `path_rays`.
    pub paths: Option<f64>,
    /// Share of `path_rays` that horizons proved to miss, of the same frame on software Vulkan by the shaders of a GPU; 0 without horizons.
    pub proven_share: Option<f64>,
}

#[derive(Clone, Debug, Deserialize)]
struct CardStamp {
    device: String,
}

#[derive(Clone, Debug, Deserialize)]
struct MethodReport {
    method: String,
    rays_per_frame: f64,
    lit_pixels: f64,
    passes: Vec<PassReport>,
}

#[derive(Clone, Debug, Deserialize)]
struct PassReport {
    pass: String,
    ms: f64,
}

/// What a frame of a method costs, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MethodCosts {
    /// Of each lit pixel.
    pub pixel_ms: f64,
    /// Of each ray.
    pub ray_ms: f64,
}

impl MethodCosts {
    /// A frame of so many lit pixels and rays, milliseconds.
    pub fn frame_ms(self, lit_pixels: f64, rays: f64) -> f64 {
        self.pixel_ms * lit_pixels + self.ray_ms * rays
    }

    /// Rays that a frame of so many lit pixels may take to last `ms`; 0 if its pixels alone last as long.
    pub fn rays_in(self, ms: f64, lit_pixels: f64) -> f64 {
        ((ms - self.pixel_ms * lit_pixels) / self.ray_ms).max(0.0)
    }
}

impl CardCosts {
    /// A report.
    ///
    /// # Errors
    /// It is none, or has a method without rays or pixels.
    pub fn read(report: &str) -> Result<Self, String> {
        let card: Self = serde_json::from_str(report).map_err(|e| e.to_string())?;
        let is_sound = |m: &MethodReport| m.rays_per_frame > 0.0 && m.lit_pixels > 0.0;
        match card.methods.iter().find(|m| !is_sound(m)) {
            None if card.methods.is_empty() && card.frames.is_empty() => Err("it has no methods".into()),
            Some(m) => Err(format!("{} has no rays or no lit pixels", m.method)),
            None => Ok(card),
        }
    }

    /// The committed ones.
    pub fn all() -> Vec<Self> {
        REPORTS.iter().filter_map(|report| Self::read(report).ok()).collect()
    }

    /// The card.
    pub fn name(&self) -> &str {
        &self.stamp.device
    }

    /// Frames that were measured one by one.
    pub fn frames(&self) -> &[CardFrame] {
        &self.frames
    }

    /// Those of a method; `None` if it was not measured, or by no pass.
    pub fn of(&self, method: &str) -> Option<MethodCosts> {
        let m = self.methods.iter().find(|m| m.method == method)?;
        let sum = |is_by_rays: bool| -> f64 {
            m.passes.iter().filter(|p| (p.pass == BY_RAYS) == is_by_rays).map(|p| p.ms).sum()
        };
        let costs = MethodCosts { pixel_ms: sum(false) / m.lit_pixels, ray_ms: sum(true) / m.rays_per_frame };
        (costs.pixel_ms > 0.0 && costs.ray_ms > 0.0).then_some(costs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every committed report is read, has all methods that are compared, and gives back the times that it holds.
    #[test]
    fn committed_reports_have_the_costs_of_the_methods() {
        assert_eq!(CardCosts::all().len(), REPORTS.len());
        // Of the H200 single frames were measured, and no method by all its passes.
        for card in CardCosts::all().into_iter().filter(|card| !card.methods.is_empty()) {
            assert_eq!(card.name(), "NVIDIA H100");
            for method in ["full", "sequence", "miyamoto", "paper", "dpm"] {
                let (costs, report) =
                    (card.of(method).unwrap(), card.methods.iter().find(|m| m.method == method).unwrap());
                let ms: f64 = report.passes.iter().map(|p| p.ms).sum();
                assert!((costs.frame_ms(report.lit_pixels, report.rays_per_frame) - ms).abs() < 1e-9);
                assert!((costs.rays_in(ms, report.lit_pixels) / report.rays_per_frame - 1.0).abs() < 1e-9);
                assert_eq!(costs.rays_in(0.0, report.lit_pixels), 0.0);
            }
            assert_eq!(card.of("fast"), None);
        }
        assert!(CardCosts::read("{}").is_err());
        let empty = r#"{"stamp":{"device":"x"},"methods":[{"method":"full","rays_per_frame":0,"lit_pixels":1,"passes":[]}]}"#;
        assert!(CardCosts::read(empty).unwrap_err().contains("full"));
    }
}
