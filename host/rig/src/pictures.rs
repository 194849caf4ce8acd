//! Converts frames of light into what an eye saw. The eye follows each body and integrates light over a window of
//! time.
//!
//! Every pixel of the picture shows a surface point at the last instant. That point is carried back through the
//! window with the true motion of its body, and the light that fell on it is averaged over all frames. The picture
//! therefore contains the motion blur of a following eye, lag, and misregistration.

use crate::light::recorder::LightFrame;
use crate::light::FrameRecord;
use crate::pipeline::renderer_settings;
use crate::plan::light_centre::{light_centre_at, true_poses_at_centre};
use crate::rig::Rig;
use crate::telemetry::live::SeenLight;
use dpm_device::planes::Raster;
use dpm_device::projector::light_of_planes;
use dpm_render::drive::Drive;
use dpm_render::gpu::{Gpu, GpuError};
use dpm_render::method::Method;
use dpm_render::{FrameInputs, RenderError, Renderer, RendererSettings, Scale};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_shaders::structs::NO_HIT;
use glam::{DAffine3, DVec2, DVec3, Vec3};
use std::sync::Arc;

/// The two pictures of a run: linear values, row by row, at the projector's raster.
pub struct Pictures {
    /// Drive from 0 to 1 that fell on the surface seen by each projector pixel. Where no pose is known, it is the
    /// mean light of each raster pixel.
    pub light: Vec<Vec3>,
    /// Radiance that the observer saw, in scene units, through a camera at the eye; or why it is missing.
    pub viewer: Result<Vec<Vec3>, &'static str>,
}

/// Frames of light with the poses of the scene's bodies at the centre of each frame's light.
struct LightWindow<'a> {
    frames: Vec<(&'a LightFrame, Vec<DAffine3>)>,
    /// The centre of the last frame's light.
    at_ns: i64,
    /// Poses of the tracked bodies at the centre of the last frame's light; empty without any frame.
    tracked: Vec<DAffine3>,
}

/// The frames of `light` whose poses are known. With the mock tracker they are the true poses. With a real tracker
/// they are the poses that each frame was drawn for: measured, then predicted.
fn window<'a>(rig: &Rig, light: &'a [LightFrame], records: &[FrameRecord]) -> LightWindow<'a> {
    let drawn_for = |f: &LightFrame| {
        let record = records.iter().find(|r| r.id.0 as u32 == f.frame)?;
        Some(record.tracked_poses.clone())
    };
    let poses = |f: &LightFrame| true_poses_at_centre(rig, f.first_photon_at).or_else(|| drawn_for(f));
    let mut window = LightWindow { frames: Vec::new(), at_ns: 0, tracked: Vec::new() };
    for frame in light {
        let Some(tracked) = poses(frame) else { continue };
        let mut all = Vec::new();
        window.at_ns = light_centre_at(rig, frame.first_photon_at).0;
        rig.scene_poses(&tracked, window.at_ns, &mut all);
        window.frames.push((frame, all));
        window.tracked = tracked;
    }
    window
}

/// The light of a slot of a rig whose tracker is the mock, where it fell.
pub struct FallenLight {
    /// The light.
    pub light: LightFrame,
    /// world-from-mesh of every body of the scene at the centre of the light.
    pub poses: Vec<DAffine3>,
    /// The centre of the light, nanoseconds on the host's clock.
    pub centre_ns: i64,
}

impl FallenLight {
    /// The light of the planes `seen`. `None`: the projector was dark, or the true poses are not known.
    pub fn of(rig: &Rig, seen: &SeenLight) -> Option<Self> {
        let raster = rig.camera.raster;
        let tracked = true_poses_at_centre(rig, seen.first_photon_at).filter(|_| !seen.planes.is_empty())?;
        let centre_ns = light_centre_at(rig, seen.first_photon_at).0;
        let mut codes = vec![[0; 3]; raster.pixel_count()];
        light_of_planes(raster, &rig.schedule, &seen.planes, &mut codes);
        let mut poses = Vec::new();
        rig.scene_poses(&tracked, centre_ns, &mut poses);
        let (frame, first_photon_at) = (seen.frame.unwrap_or(0), seen.first_photon_at);
        let light = LightFrame { frame, first_photon_at, codes, is_moved: seen.is_moved };
        Some(Self { light, poses, centre_ns })
    }

    /// Drive from 0 to 1 that fell on the point `in_mesh` of a body, if nothing was in between.
    pub fn on(&self, rig: &Rig, body: usize, in_mesh: DVec3) -> Vec3 {
        self.at(rig, self.poses[body].transform_point3(in_mesh))
    }

    /// Drive from 0 to 1 in the projector's ray through the point `world`.
    pub fn at(&self, rig: &Rig, world: DVec3) -> Vec3 {
        rig.camera.project(world).map_or(Vec3::ZERO, |pixel| self.through(rig, pixel))
    }

    /// Drive from 0 to 1 in the projector's ray through `pixel` of its raster, between pixel centres if need be.
    pub fn through(&self, rig: &Rig, pixel: DVec2) -> Vec3 {
        sample(&rig.drive, &self.light, rig.camera.raster, pixel)
    }
}

/// Mean of the frames for each pixel, 0 to 1.
fn mean(light: &[LightFrame]) -> Vec<Vec3> {
    let mut sum = vec![Vec3::ZERO; light.first().map_or(0, |f| f.codes.len())];
    for frame in light {
        for (s, c) in sum.iter_mut().zip(&frame.codes) {
            *s += Vec3::from(c.map(f32::from));
        }
    }
    sum.iter().map(|s| *s / (255.0 * light.len().max(1) as f32)).collect()
}

/// Makes both pictures from the last frames of light. There must be at least one frame. `records` says what each
/// frame was drawn for.
///
/// # Errors
/// The GPU failed.
pub fn pictures(
    rig: &Rig,
    gpu: &Arc<Gpu>,
    light: &[LightFrame],
    records: &[FrameRecord],
) -> Result<Pictures, RenderError> {
    let window = window(rig, light, records);
    // Tracks move light to where the bodies are by then. The poses that frames were drawn for are not that.
    let is_apart = light.iter().any(|f| f.is_moved) && rig.true_poses(0).is_none();
    if window.frames.is_empty() || is_apart {
        let why = if is_apart {
            "tracks moved the light, and where the bodies were then is known with a mock tracker only"
        } else {
            "the poses of the bodies are not known"
        };
        return Ok(Pictures { light: mean(light), viewer: Err(why) });
    }
    let now = &window.frames[window.frames.len() - 1].1;
    let (eye, _) = rig.observer.eye_and_gaze(&window.tracked);
    // The pictures need only the surfaces, so the simplest method is enough.
    let settings = |lens| RendererSettings {
        method: Method::full(1),
        scale: Scale::WHOLE,
        lens,
        plane_groups: Vec::new(),
        ..renderer_settings(rig)
    };
    let mut renderer = Renderer::new(gpu, &rig.scene, settings(renderer_settings(rig).lens))?;
    let light = integrate(rig, &mut renderer, &rig.camera, eye, now, &window, |_, drive| drive)?;
    let Some(viewer_camera) = viewer_camera(rig, eye, now) else {
        return Ok(Pictures {
            light,
            viewer: Err("a camera at the observer's eye cannot be aimed at the bodies"),
        });
    };
    let projector = rig.camera.position();
    let intensity = Vec3::from_array(rig.config.projector.intensity_at_255().map(|v| v as f32));
    // The viewer's camera has no lens.
    if !rig.camera.lens.is_pinhole() {
        renderer = Renderer::new(gpu, &rig.scene, settings(None))?;
    }
    let ambient = Vec3::from_array(rig.config.scene.ambient.map(|v| v as f32));
    let viewer = integrate(rig, &mut renderer, &viewer_camera, projector, now, &window, |seen, drive| {
        // Radiance of a Lambertian surface in the projector's light.
        let to_projector = projector - seen.position;
        let d2 = to_projector.length_squared();
        let cos = seen.normal.dot(to_projector).abs() / d2.sqrt();
        let albedo = rig.albedo_at(seen.body, seen.uv);
        ambient + drive * albedo * intensity * (cos / (std::f64::consts::PI * d2)) as f32
    })?;
    Ok(Pictures { light, viewer: Ok(viewer) })
}

/// A camera at the eye whose frame encloses what the projector lights.
fn viewer_camera(rig: &Rig, eye: DVec3, poses: &[DAffine3]) -> Option<ProjectorCamera> {
    let (mut lower, mut upper) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for (body, pose) in rig.scene.bodies.iter().zip(poses).filter(|(b, _)| b.projected) {
        for p in &body.mesh.positions {
            let p = pose.transform_point3(p.as_dvec3());
            lower = lower.min(p);
            upper = upper.max(p);
        }
    }
    if !lower.is_finite() {
        return None;
    }
    let centre = (lower + upper) * 0.5;
    let radius = ((upper - lower).length() * 0.5).max(1e-9);
    let distance = (centre - eye).length().max(radius * 1.05);
    let raster = rig.camera.raster;
    let aspect = f64::from(raster.width()) / f64::from(raster.height());
    let vertical = 2.0 * (radius / distance).asin();
    let horizontal = 2.0 * ((0.5 * vertical).tan() * aspect.max(1.0)).atan();
    ProjectorCamera::look_at(raster, eye, centre, DVec3::Y, horizontal.clamp(0.01, 3.0)).ok()
}

/// The surface point that a picture pixel shows at the last instant.
struct PicturePoint {
    /// Body of the scene.
    body: usize,
    position: DVec3,
    normal: DVec3,
    /// Texture coordinates.
    uv: [f32; 2],
}

fn integrate(
    rig: &Rig,
    renderer: &mut Renderer,
    camera: &ProjectorCamera,
    other: DVec3,
    poses: &[DAffine3],
    window: &LightWindow<'_>,
    shade: impl Fn(&PicturePoint, Vec3) -> Vec3,
) -> Result<Vec<Vec3>, GpuError> {
    let mut slot = renderer.create_slot(true)?;
    let inputs =
        FrameInputs { animated_at_ns: window.at_ns, ..FrameInputs::new(camera, (other, other), poses) };
    renderer.submit(&mut slot, &inputs)?;
    slot.wait(60_000_000_000)?;
    let surfaces = slot.surfaces().unwrap_or_default();
    let width = camera.raster.width();
    let mut out = vec![Vec3::ZERO; surfaces.len()];
    for (i, surface) in surfaces.iter().enumerate() {
        if surface.id == NO_HIT || surface.distance <= 0.0 {
            continue;
        }
        let body = (surface.id >> 24) as usize;
        let pixel = DVec2::new(f64::from(i as u32 % width) + 0.5, f64::from(i as u32 / width) + 0.5);
        let ray = camera.ray(pixel);
        let position = ray.origin + ray.direction * f64::from(surface.distance);
        let in_body = poses[body].inverse().transform_point3(position);
        let normal =
            poses[body].transform_vector3(renderer.shading_normal(surface).as_dvec3()).normalize_or_zero();
        let seen = PicturePoint { body, position, normal, uv: renderer.texture_coordinates(surface) };
        let mut sum = Vec3::ZERO;
        for (frame, all) in &window.frames {
            if let Some(p) = rig.camera.project(all[body].transform_point3(in_body)) {
                sum += sample(&rig.drive, frame, rig.camera.raster, p);
            }
        }
        out[i] = shade(&seen, sum / window.frames.len() as f32);
    }
    Ok(out)
}

/// Light at a position on the raster, interpolated bilinearly between pixel centres, 0 to 1.
fn sample(drive: &Drive, frame: &LightFrame, raster: Raster, at: DVec2) -> Vec3 {
    let (width, height) = (raster.width(), raster.height());
    let (x, y) = (at.x - 0.5, at.y - 0.5);
    let (x0, y0) = (x.floor(), y.floor());
    let (fx, fy) = ((x - x0) as f32, (y - y0) as f32);
    let texel = |x: f64, y: f64| {
        if x < 0.0 || y < 0.0 || x >= f64::from(width) || y >= f64::from(height) {
            return Vec3::ZERO;
        }
        let pixel = y as usize * width as usize + x as usize;
        Vec3::from_array(drive.light_of(frame.codes[pixel], pixel))
    };
    let top = texel(x0, y0).lerp(texel(x0 + 1.0, y0), fx);
    let bottom = texel(x0, y0 + 1.0).lerp(texel(x0 + 1.0, y0 + 1.0), fx);
    top.lerp(bottom, fy)
}

/// Linear values as 8-bit sRGB.
pub fn to_srgb(linear: &[Vec3], scale: f32) -> Vec<u8> {
    let encode = |v: f32| {
        let s = dpm_scene::srgb::from_linear((v * scale).clamp(0.0, 1.0));
        (s * 255.0 + 0.5) as u8
    };
    linear.iter().flat_map(|v| [encode(v.x), encode(v.y), encode(v.z)]).collect()
}
