//! A rig and a method into what an eye that follows the bodies sees, frame by frame: the common ground of all comparisons.
//!
//! No tracker, link or quantisation: true poses in, shown radiance out. The probes are the surface points that the projector lights at the
//! last frame; each is carried back through the sequence with its body, so motion blur of a following eye, lag and smear are all in.

use super::median::{median, quartiles, steady_mean};
use dpm_common::clock::Stopwatch;
use dpm_device::planes::Raster;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::{FrameCost, FrameSlot, RenderError, Renderer, RendererSettings, Scale, Surface};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_rig::still::tracked_poses;
pub use dpm_rig::still::{draw, poses_at, submit, BodyPlaces, FRAME_WAIT_NS};
use dpm_shaders::structs::NO_HIT;
use glam::{DAffine3, DVec2, DVec3, Vec3};
use std::sync::Arc;

/// A surface point that is lit at the end of the sequence.
#[derive(Clone, Copy, Debug)]
pub struct Probe {
    /// Body of the scene.
    pub body: usize,
    /// Point in the body's space.
    pub point: DVec3,
    /// Pixel at the last frame.
    pub pixel: u32,
    /// Visual angle from the gaze at the last frame, degrees.
    pub angle: f32,
}

/// When and how long.
#[derive(Clone, Copy, Debug)]
pub struct Span {
    /// Slot of the last frame; the motions' time 0 is slot 0.
    pub last_slot: u64,
    /// Frames drawn before those that are kept, for histories to settle.
    pub warm_up: u32,
    /// Frames kept.
    pub kept: u32,
}

/// What the eye saw of one method.
pub struct Seen {
    /// Per kept frame, per probe: radiance; NaN where the probe was not lit.
    pub frames: Vec<Vec<Vec3>>,
    /// Closest-hit and shadow rays of the kept frames, primary rays included.
    pub rays: u64,
    /// Those of them that were walked through the scene; the others were proven to meet nothing.
    pub walked_rays: u64,
    /// Samples of the kept frames.
    pub samples: u64,
    /// Cost of every kept frame.
    pub costs: Vec<FrameCost>,
}

/// What a frame of a method takes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameTime {
    /// On the GPU, all passes, ms; 0 without time stamps.
    pub gpu_ms: f64,
    /// From recording to the end of waiting, ms.
    pub wall_ms: f64,
    /// Between these lies the middle half of the frames, ms: on the GPU, or until the end of waiting where there are no time stamps.
    pub middle_half_ms: [f64; 2],
}

impl FrameTime {
    /// The time that methods are compared by, ms: the GPU's, or until the end of waiting where the device has no time stamps.
    pub(crate) fn ms(&self) -> f64 {
        if self.gpu_ms > 0.0 {
            self.gpu_ms
        } else {
            self.wall_ms
        }
    }
}

/// Frames of [`Theatre::race`] before those that count: histories fill, the driver settles.
const RACE_WARM_UP: u32 = 8;
/// Those that count.
const RACE_FRAMES: u32 = 32;

/// Draws sequences of one rig.
pub struct Theatre {
    rig: Arc<Rig>,
    gpu: Arc<Gpu>,
    span: Span,
    probes: Vec<Probe>,
    frozen: bool,
}

impl Theatre {
    /// Finds the probes of the span's last frame.
    ///
    /// # Errors
    /// The renderer's.
    pub fn new(rig: Arc<Rig>, gpu: Arc<Gpu>, span: Span) -> Result<Self, RenderError> {
        Self::build(rig, gpu, span, false)
    }

    /// The same with all bodies standing where the span's last frame has them: the probes are those of [`Theatre::new`].
    ///
    /// # Errors
    /// The renderer's.
    pub fn frozen(rig: Arc<Rig>, gpu: Arc<Gpu>, span: Span) -> Result<Self, RenderError> {
        Self::build(rig, gpu, span, true)
    }

    fn build(rig: Arc<Rig>, gpu: Arc<Gpu>, span: Span, frozen: bool) -> Result<Self, RenderError> {
        let settings = RendererSettings {
            method: Method { temporal: true, ..Method::full(1) },
            scale: Scale::WHOLE,
            plane_groups: Vec::new(),
            ..renderer_settings(&rig)
        };
        let mut renderer = Renderer::new(&gpu, &rig.scene, settings)?;
        let mut slot = renderer.create_slot(true)?;
        let poses = poses_at(&rig, span.last_slot);
        draw(&rig, &mut renderer, &mut slot, &poses, 0, 1.0)?;
        let (surfaces, guides) = (slot.surfaces().unwrap_or_default(), slot.guides().unwrap_or_default());
        let width = rig.camera.raster.width();
        let probes = surfaces
            .iter()
            .zip(guides)
            .enumerate()
            .filter(|(_, (s, _))| s.is_lit())
            .map(|(i, (s, g))| {
                let body = (s.id >> 24) as usize;
                let at = DVec2::new(f64::from(i as u32 % width) + 0.5, f64::from(i as u32 / width) + 0.5);
                let ray = rig.camera.ray(at);
                let world = ray.origin + ray.direction * f64::from(s.distance);
                Probe {
                    body,
                    point: poses[body].inverse().transform_point3(world),
                    pixel: i as u32,
                    angle: g.sight.angle,
                }
            })
            .collect();
        Ok(Self { rig, gpu, span, probes, frozen })
    }

    /// The probes, in raster order.
    pub fn probes(&self) -> &[Probe] {
        &self.probes
    }

    /// The raster.
    pub fn raster(&self) -> Raster {
        self.rig.camera.raster
    }

    /// Draws the sequence with `method` at `spp` (fractions allowed) and `seed`. `each` is called after every frame.
    ///
    /// # Errors
    /// The renderer's.
    pub fn play(
        &self,
        method: &Method,
        spp: f32,
        seed: u32,
        each: &mut dyn FnMut(u32, &FrameSlot),
    ) -> Result<Seen, RenderError> {
        self.play_at(renderer_settings(&self.rig).scale, method, spp, seed, each)
    }

    /// The same with every pixel traced, whatever the rig's scale: what others are judged by.
    ///
    /// # Errors
    /// The renderer's.
    pub(crate) fn play_whole(&self, method: &Method, spp: f32, seed: u32) -> Result<Seen, RenderError> {
        self.play_at(Scale::WHOLE, method, spp, seed, &mut |_, _| ())
    }

    fn play_at(
        &self,
        scale: Scale,
        method: &Method,
        spp: f32,
        seed: u32,
        each: &mut dyn FnMut(u32, &FrameSlot),
    ) -> Result<Seen, RenderError> {
        let rig = &self.rig;
        let settings = RendererSettings {
            scale,
            method: method.clone(),
            seed,
            plane_groups: Vec::new(),
            ..renderer_settings(rig)
        };
        let mut renderer = Renderer::new(&self.gpu, &rig.scene, settings)?;
        let mut slot = renderer.create_slot(true)?;
        let mut seen = Seen { frames: Vec::new(), rays: 0, walked_rays: 0, samples: 0, costs: Vec::new() };
        let total = self.span.warm_up + self.span.kept;
        for k in 0..total {
            let poses = self.poses(k, total);
            let cost = draw(rig, &mut renderer, &mut slot, &poses, k, spp)?;
            each(k, &slot);
            if k >= self.span.warm_up {
                let c = cost.counters();
                seen.rays += u64::from(c.rays);
                seen.walked_rays += u64::from(c.walked_rays());
                seen.samples += u64::from(c.samples);
                seen.costs.push(cost);
                seen.frames.push(self.look(
                    &poses,
                    slot.radiance().unwrap_or(&[]),
                    &slot.surfaces().unwrap_or_default(),
                ));
            }
        }
        Ok(seen)
    }

    /// The same with so many frames before those that are kept.
    pub(crate) fn with_warm_up(&self, warm_up: u32) -> Self {
        let (rig, gpu, probes) = (self.rig.clone(), self.gpu.clone(), self.probes.clone());
        Self { rig, gpu, span: Span { warm_up, ..self.span }, probes, frozen: self.frozen }
    }

    /// Poses of frame `k` of `total`, the last of which is that of the span.
    fn poses(&self, k: u32, total: u32) -> BodyPlaces {
        let before = if self.frozen { 0 } else { u64::from(total - 1 - k) };
        poses_at(&self.rig, self.span.last_slot.saturating_sub(before))
    }

    /// What a frame of each of several methods takes at the end of the span. They are drawn in turns, so that all meet the same
    /// disturbances of the machine: their ratios hold where the times themselves do not.
    ///
    /// # Errors
    /// The renderer's.
    pub(crate) fn race(&self, runners: &[(Method, f32)], seed: u32) -> Result<Vec<FrameTime>, RenderError> {
        let rig = &self.rig;
        let mut all = Vec::new();
        for (method, spp) in runners {
            let settings = RendererSettings { method: method.clone(), seed, ..renderer_settings(rig) };
            let renderer = Renderer::new(&self.gpu, &rig.scene, settings)?;
            let slot = renderer.create_slot(false)?;
            all.push((renderer, slot, *spp, Vec::new(), Vec::new()));
        }
        let total = RACE_WARM_UP + RACE_FRAMES;
        for k in 0..total {
            let poses = self.poses(k, total);
            for (renderer, slot, spp, gpu, wall) in &mut all {
                let watch = Stopwatch::start();
                let cost = draw(rig, renderer, slot, &poses, k, *spp)?;
                if k >= RACE_WARM_UP {
                    wall.push(watch.elapsed_ns() as f64 * 1e-6);
                    gpu.push(cost.pass_ns.iter().sum::<u64>() as f64 * 1e-6);
                }
            }
        }
        let time = |(_, _, _, gpu, wall): &(_, _, _, Vec<f64>, Vec<f64>)| FrameTime {
            gpu_ms: steady_mean(gpu),
            wall_ms: steady_mean(wall),
            middle_half_ms: quartiles(
                if gpu.iter().any(|ms| *ms > 0.0) { gpu } else { wall }.iter().copied(),
            ),
        };
        Ok(all.iter().map(time).collect())
    }

    /// Pixels of the raster in a degree of the observer's view, where neighbouring pixels of one body lie: the median. `None` without any.
    pub(crate) fn pixels_per_degree(&self) -> Option<f64> {
        let poses = poses_at(&self.rig, self.span.last_slot);
        let tracked: Vec<DAffine3> = tracked_poses(&self.rig, &poses);
        let (eye, _) = self.rig.observer.eye_and_gaze(&tracked);
        let toward = |p: &Probe| poses[p.body].transform_point3(p.point) - eye;
        let neighbours =
            self.probes.windows(2).filter(|p| p[0].body == p[1].body && p[0].pixel + 1 == p[1].pixel);
        let degrees: Vec<f64> = neighbours
            .map(|p| toward(&p[0]).angle_between(toward(&p[1])).to_degrees())
            .filter(|d| *d > 0.0)
            .collect();
        (!degrees.is_empty()).then(|| 1.0 / median(degrees))
    }

    /// Median way of the probes over the raster in the last frame, pixels.
    pub(crate) fn speed_px(&self) -> f64 {
        let last = self.span.last_slot;
        let [before, now] = [last.saturating_sub(1), last].map(|slot| poses_at(&self.rig, slot));
        let at =
            |poses: &BodyPlaces, p: &Probe| self.rig.camera.project(poses[p.body].transform_point3(p.point));
        let moved = self.probes.iter().filter_map(|p| Some(at(&now, p)?.distance(at(&before, p)?)));
        let moved: Vec<f64> = moved.collect();
        if moved.is_empty() {
            return 0.0;
        }
        median(moved)
    }

    /// Shown radiance at every probe, bilinear over the pixels of its own body.
    fn look(&self, poses: &[DAffine3], shown: &[[f32; 4]], surfaces: &[Surface]) -> Vec<Vec3> {
        let camera = &self.rig.camera;
        let (width, height) = (i64::from(camera.raster.width()), i64::from(camera.raster.height()));
        self.probes
            .iter()
            .map(|probe| {
                let Some(at) = camera.project(poses[probe.body].transform_point3(probe.point)) else {
                    return Vec3::NAN;
                };
                let base = (at - 0.5).floor();
                let f = (at - 0.5 - base).as_vec2();
                let (mut sum, mut total) = (Vec3::ZERO, 0.0);
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    let (x, y) = (base.x as i64 + dx, base.y as i64 + dy);
                    if x < 0 || y < 0 || x >= width || y >= height {
                        continue;
                    }
                    let i = (y * width + x) as usize;
                    let s = &surfaces[i];
                    if s.id == NO_HIT || s.distance <= 0.0 || (s.id >> 24) as usize != probe.body {
                        continue;
                    }
                    let w = (if dx == 1 { f.x } else { 1.0 - f.x }) * (if dy == 1 { f.y } else { 1.0 - f.y });
                    sum += w * Vec3::new(shown[i][0], shown[i][1], shown[i][2]);
                    total += w;
                }
                if total > 0.25 {
                    sum / total
                } else {
                    Vec3::NAN
                }
            })
            .collect()
    }
}

/// Mean over the last `window` frames at every probe, frames without light left out: what an eye of that integration time saw.
pub fn eye_mean(frames: &[Vec<Vec3>], window: usize) -> Vec<Vec3> {
    let last = &frames[frames.len().saturating_sub(window)..];
    let n = last.first().map_or(0, Vec::len);
    (0..n)
        .map(|i| {
            let (mut sum, mut count) = (Vec3::ZERO, 0.0f32);
            for frame in last {
                if frame[i].is_finite() {
                    sum += frame[i];
                    count += 1.0;
                }
            }
            if count > 0.0 {
                sum / count
            } else {
                Vec3::NAN
            }
        })
        .collect()
}

/// Root mean square difference over channels and probes for which `keep` holds; probes that either side lacks are left out.
pub fn rmse(a: &[Vec3], b: &[Vec3], keep: impl Fn(usize) -> bool) -> f64 {
    let (mut sum, mut n) = (0.0f64, 0u64);
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        if keep(i) && a.is_finite() && b.is_finite() {
            sum += (*a - *b).as_dvec3().length_squared();
            n += 3;
        }
    }
    if n > 0 {
        (sum / n as f64).sqrt()
    } else {
        0.0
    }
}
