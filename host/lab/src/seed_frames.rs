//! The two frames of \[paper\]'s headline on this device: its method with 18, 18 and 2 samples, and its predecessor with 14, beside what
//! \[paper\] says of them, what was measured of them on other cards, and what the model expects of cards that nobody measured.
//!
//! \[paper\] had an RTX 4090. A frame there is one in a line of frames, whose distance bounds the rate; a single frame takes longer. So are
//! the figures here.

use crate::bench::{measure, plan_on_gpu, Measured, MethodCost};
use crate::error::costs::{CardCosts, CardFrame};
use crate::error::plan::method_of;
use crate::gpu_model::{modelled, Modelled};
use crate::stamp::Stamp;
use dpm_render::gpu::Gpu;
use dpm_render::RenderError;
use dpm_rig::config::RenderMethod;
use dpm_rig::rig::Rig;
use serde::Serialize;
use std::fmt::Write;
use std::sync::Arc;

/// Samples of a pixel by the visual angle in \[paper\] table 1.
const ZONES: [u32; 3] = [18, 18, 2];
/// Samples of a pixel with which \[paper\] says that its predecessor reaches 1000 frames a second.
const BEFORE: u32 = 14;
/// The raster of \[paper\], by which cards were measured.
const RASTER: [u32; 2] = [1024, 768];

/// The headline: method, its samples as cards name them, and what \[paper\] section 4 says.
const HEADLINE: [(RenderMethod, &str, &str); 2] = [
    (
        RenderMethod::Paper,
        "18/18/2",
        "over 1000 fps on an RTX 4090, samples chosen for that, most of the scene within 30 degrees",
    ),
    (RenderMethod::Miyamoto, "14", "about 14 samples against 18/18/2, at 1000 fps on the same computer"),
];

/// A rig in which the headline is measured.
pub struct SeedScene {
    /// As committed cards name it.
    pub name: &'static str,
    /// With its scene.
    pub rig: Rig,
}

/// What was measured of a frame on a card, or reckoned from what was.
#[derive(Clone, Debug, Serialize)]
pub struct OnCard {
    /// The card.
    pub card: String,
    /// Distance of frames in line as measured there, ms; `None`: this frame was not measured.
    pub measured_ms: Option<f64>,
    /// A frame's passes one after the other by what pixels and rays of the method's demo cost there, ms; `None` if the method was not
    /// measured at all, or the raster is another one.
    pub reckoned_ms: Option<f64>,
}

/// One frame of the headline.
#[derive(Clone, Debug, Serialize)]
pub struct SeedFrame {
    /// Name of the scene.
    pub scene: &'static str,
    /// Samples that are asked for, by the visual angle or in every pixel.
    pub samples: &'static str,
    /// What \[paper\] says.
    pub paper_says: &'static str,
    /// With what it was measured here.
    pub stamp: Stamp,
    /// What it takes here.
    pub here: MethodCost,
    /// Frames a second that follow each other here.
    pub frames_per_s: f64,
    /// On the committed cards.
    pub on_cards: Vec<OnCard>,
    /// On cards that nobody measured; empty on another raster than \[paper\]'s.
    pub modelled_not_measured: Vec<Modelled>,
}

/// Measures both methods in every scene, as their authors have them, with up to so many frames of each. `each` is told about a frame as
/// soon as it is measured.
///
/// # Errors
/// The renderer's.
pub fn seed_frames(
    scenes: Vec<SeedScene>,
    gpu: &Arc<Gpu>,
    frames: u32,
    each: &mut dyn FnMut(&SeedFrame),
) -> Result<Vec<SeedFrame>, RenderError> {
    let mut all = Vec::new();
    for SeedScene { name, mut rig } in scenes {
        rig.config.render.paper.zone_spp = ZONES;
        rig.config.render.spp = BEFORE;
        let on_gpu = plan_on_gpu(&rig, gpu)?;
        for (which, samples, paper_says) in HEADLINE {
            let method = method_of(&rig.config.render, which);
            let here =
                measure(&rig, gpu, frames, Measured { word: which.word(), method, on_gpu: on_gpu.as_ref() })?;
            let stamp = Stamp::new(&rig, gpu.summary());
            let is_papers = stamp.raster == RASTER;
            let frame = SeedFrame {
                scene: name,
                samples,
                paper_says,
                on_cards: CardCosts::all()
                    .iter()
                    .map(|card| on_card(card, name, samples, &here, is_papers))
                    .collect(),
                modelled_not_measured: if is_papers {
                    modelled(std::iter::once(here.counted()))
                } else {
                    Vec::new()
                },
                frames_per_s: 1e3 / here.in_line_ms,
                stamp,
                here,
            };
            each(&frame);
            all.push(frame);
        }
    }
    Ok(all)
}

fn on_card(card: &CardCosts, scene: &str, samples: &str, here: &MethodCost, is_papers: bool) -> OnCard {
    let is_it = |f: &&CardFrame| f.scene == scene && f.method == here.method && f.samples == samples;
    let measured_ms = card.frames().iter().rfind(is_it).and_then(|f| f.in_line_ms);
    let costs = card.of(here.method).filter(|_| is_papers);
    let reckoned_ms = costs.map(|costs| costs.frame_ms(here.lit_pixels, here.rays_per_frame));
    OnCard { card: card.name().to_owned(), measured_ms, reckoned_ms }
}

/// A frame's time and rate.
fn rate(ms: f64) -> String {
    format!("{:.0} frames/s ({ms:.3} ms)", 1e3 / ms)
}

impl SeedFrame {
    /// The frame for people, some lines.
    pub fn told(&self) -> String {
        let h = &self.here;
        let mut text = format!("{}, {} with {} samples\n", self.scene, h.method, self.samples);
        // Writing into a string cannot fail.
        let _ = writeln!(text, "  [paper] says          {}", self.paper_says);
        let gpu = h.gpu_ms.map_or(String::new(), |ms| format!(", passes of one frame {ms:.3} ms"));
        let [width, height] = self.stamp.raster;
        let _ = writeln!(
            text,
            "  here                  {} in line at {width} x {height}{gpu}; {:.2} samples a lit pixel; {:.0} rays walked, {:.0} proven to \
             miss; {}",
            rate(h.in_line_ms),
            h.samples_per_lit_pixel,
            h.walked_rays_per_frame,
            h.rays_per_frame - h.walked_rays_per_frame,
            self.stamp.device
        );
        for c in &self.on_cards {
            let measured = c.measured_ms.map_or("this frame was not measured".to_owned(), |ms| {
                format!("measured: {} in line", rate(ms))
            });
            let reckoned = c.reckoned_ms.map_or(String::new(), |ms| {
                format!("; reckoned from what its demo's pixels and rays cost: {}", rate(ms))
            });
            let _ = writeln!(text, "  {:<21} {measured}{reckoned}", c.card);
        }
        for m in &self.modelled_not_measured {
            let [least, most] = m.frames_per_s;
            let [slow, fast] =
                [m.failed_assumption.frame_ms[1], m.failed_assumption.frame_ms[0]].map(|ms| 1e3 / ms);
            let _ = writeln!(
                text,
                "  {:<21} computed, not measured: {least:.0} to {most:.0} frames/s; by what was assumed before, and failed: {slow:.0} to {fast:.0}",
                m.gpu
            );
        }
        if self.modelled_not_measured.is_empty() {
            text += "  nothing is reckoned or computed for other cards, because the raster is not [paper]'s 1024 x 768\n";
        }
        text
    }
}
