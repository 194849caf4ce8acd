//! A projector and an eye into an image of wanted radiance, with the variance of every pixel's mean.

use super::{Reference, Sampler, SurfacePoint};
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DVec2, DVec3};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Mutex;

/// How to render.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderSettings {
    /// Samples per pixel, at least 1 (0 is taken as 1).
    pub spp: u32,
    /// Closest hits per path, the primary one included; at least 1.
    pub depth: u32,
    /// Same seed, same image, whatever the number of threads.
    pub seed: u64,
    /// False: all samples through the pixel's centre. True: through even random points of the pixel.
    pub jitter: bool,
    /// Threads; 0: as many as the machine has.
    pub threads: usize,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self { spp: 16, depth: 3, seed: 1, jitter: false, threads: 0 }
    }
}

/// A rendered image, rows top to bottom.
#[derive(Clone, Debug, PartialEq)]
pub struct ReferenceImage {
    /// Its size.
    pub raster: Raster,
    /// Mean radiance per pixel and channel; 0 where unlit.
    pub mean: Vec<[f64; 3]>,
    /// Estimated variance of that mean (0 with one sample).
    pub variance: Vec<[f64; 3]>,
    /// The projector can light the pixel's point and the eye can see it; with jitter: any of its points.
    pub lit: Vec<bool>,
    /// Samples that were NaN or infinite and left out.
    pub dropped_samples: u64,
}

impl ReferenceImage {
    /// Mean over all lit pixels per channel; 0 when none is.
    pub(crate) fn mean_lit(&self) -> [f64; 3] {
        let n = self.lit.iter().filter(|l| **l).count().max(1) as f64;
        let mut sum = [0.0; 3];
        for (pixel, _) in self.mean.iter().zip(&self.lit).filter(|(_, lit)| **lit) {
            (0..3).for_each(|c| sum[c] += pixel[c] / n);
        }
        sum
    }
}

/// Where the outgoing light is wanted.
#[derive(Clone, Copy)]
enum LightTarget {
    /// At an eye, if it sees the point.
    Eye(DVec3),
    /// Back along the ray.
    Camera,
}

#[derive(Clone, Copy, Default)]
struct Pixel {
    mean: DVec3,
    variance: DVec3,
    lit: bool,
    dropped: u64,
}

impl Reference<'_> {
    /// True when light from `projector` at a point that it sees can reach `eye`: both are on one side, and nothing real is between.
    pub(crate) fn lit(&self, point: &SurfacePoint, projector: DVec3, eye: DVec3) -> bool {
        let (p, e) = (projector - point.position, eye - point.position);
        let (cos_p, cos_e) = (point.geometric.dot(p), point.geometric.dot(e));
        if cos_p * cos_e <= 0.0 || !e.is_finite() {
            return false;
        }
        self.visible(super::offset(point.position, point.geometric, e, point.scale), eye, true)
    }

    /// The rig's image: rays from the projector, radiance toward the eye.
    pub(crate) fn render(
        &self,
        camera: &ProjectorCamera,
        eye: DVec3,
        settings: &RenderSettings,
    ) -> ReferenceImage {
        self.render_view(camera, LightTarget::Eye(eye), settings)
    }

    /// An ordinary camera's image: radiance back along each ray, every body visible, the sky behind them. All pixels are lit.
    pub(crate) fn render_camera(
        &self,
        camera: &ProjectorCamera,
        settings: &RenderSettings,
    ) -> ReferenceImage {
        self.render_view(camera, LightTarget::Camera, settings)
    }

    fn render_view(
        &self,
        camera: &ProjectorCamera,
        view: LightTarget,
        settings: &RenderSettings,
    ) -> ReferenceImage {
        let raster = camera.raster;
        let (width, height) = (raster.width() as usize, raster.height() as usize);
        let mut pixels = vec![Pixel::default(); raster.pixel_count()];
        let threads = match settings.threads {
            0 => std::thread::available_parallelism().map_or(1, |n| n.get()),
            n => n,
        };
        // Threads take rows as they get free; each row is its own piece of memory, so the lock is held for the hand-out alone.
        let next = AtomicUsize::new(0);
        let rows: Vec<Mutex<&mut [Pixel]>> = pixels.chunks_mut(width).map(Mutex::new).collect();
        std::thread::scope(|scope| {
            let work = || loop {
                let y = next.fetch_add(1, Ordering::Relaxed);
                let Some(row) = rows.get(y) else { break };
                let mut row = row.lock().unwrap_or_else(|e| e.into_inner());
                for (x, pixel) in row.iter_mut().enumerate() {
                    *pixel = self.pixel(camera, view, settings, x, y);
                }
            };
            for _ in 1..threads.min(height) {
                // Where the system gives no more threads, those that there are take all rows.
                let _ = std::thread::Builder::new().spawn_scoped(scope, work);
            }
            work();
        });
        drop(rows);
        ReferenceImage {
            raster,
            mean: pixels.iter().map(|p| p.mean.to_array()).collect(),
            variance: pixels.iter().map(|p| p.variance.to_array()).collect(),
            lit: pixels.iter().map(|p| p.lit).collect(),
            dropped_samples: pixels.iter().map(|p| p.dropped).sum(),
        }
    }

    fn pixel(
        &self,
        camera: &ProjectorCamera,
        view: LightTarget,
        settings: &RenderSettings,
        x: usize,
        y: usize,
    ) -> Pixel {
        let index = y as u64 * u64::from(camera.raster.width()) + x as u64;
        let mut sampler = Sampler::new(settings.seed, index);
        let corner = DVec2::new(x as f64, y as f64);
        let centre = self.primary(camera, view, corner + 0.5);
        let mut result = Pixel::default();
        let mut m2 = DVec3::ZERO;
        let mut n = 0.0;
        for _ in 0..settings.spp.max(1) {
            let primary = if settings.jitter {
                self.primary(camera, view, corner + DVec2::from_array(sampler.uniform2()))
            } else {
                centre
            };
            let value = match primary {
                Primary::Unlit => DVec3::ZERO,
                Primary::Sky(radiance) => radiance,
                Primary::Surface(point, v) => self.radiance(&point, v, settings.depth.max(1), &mut sampler),
            };
            result.lit |= !matches!(primary, Primary::Unlit);
            if !value.is_finite() {
                result.dropped += 1;
                continue;
            }
            // [Welford62]: no cancellation, however bright the pixel.
            n += 1.0;
            let delta = value - result.mean;
            result.mean += delta / n;
            m2 += delta * (value - result.mean);
        }
        if n > 1.0 {
            result.variance = m2 / (n * (n - 1.0));
        }
        result
    }

    fn primary(&self, camera: &ProjectorCamera, view: LightTarget, pixel: DVec2) -> Primary {
        let ray = camera.ray(pixel);
        let real_only = matches!(view, LightTarget::Eye(_));
        let hit = self.trace(ray.origin, ray.direction, f64::INFINITY, real_only);
        match (hit, view) {
            (Some(point), LightTarget::Eye(eye)) if self.lit(&point, camera.position(), eye) => {
                let v = (eye - point.position).normalize();
                Primary::Surface(point, v)
            }
            (Some(point), LightTarget::Camera) => Primary::Surface(point, -ray.direction),
            (None, LightTarget::Camera) => Primary::Sky(self.lights.sky_radiance(ray.direction)),
            _ => Primary::Unlit,
        }
    }
}

/// What a sample starts from. Lives on the stack one at a time: its size does not matter.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Copy)]
enum Primary {
    Unlit,
    Sky(DVec3),
    Surface(SurfacePoint, DVec3),
}
