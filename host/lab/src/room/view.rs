//! A camera into the surface points that its pixels show.

use dpm_render::drive::Drive;
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::{FrameInputs, FrameSlot, RenderError, Renderer, RendererSettings, Scale};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_shaders::structs::NO_HIT;
use glam::{DAffine3, DVec2, DVec3};
use std::sync::Arc;

/// How long to wait for a picture, nanoseconds.
const WAIT_NS: u64 = 60_000_000_000;

/// A surface point that a pixel shows.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SeenPoint {
    /// Body of the scene.
    pub body: usize,
    /// World coordinates.
    pub position: DVec3,
    /// Coordinates of its mesh.
    pub in_mesh: DVec3,
    /// Shading normal, world.
    pub normal: DVec3,
    /// Texture coordinates.
    pub uv: [f32; 2],
    /// From the camera, metres.
    pub distance: f64,
    /// Another surface is between it and the place asked for.
    pub is_hidden: bool,
}

/// A camera of the film with its renderer.
pub(crate) struct FilmCamera {
    /// The camera.
    pub camera: ProjectorCamera,
    renderer: Renderer,
    slot: FrameSlot,
}

impl FilmCamera {
    /// For a camera that stands still or moves; its raster and lens stay.
    ///
    /// # Errors
    /// The renderer's.
    pub(crate) fn new(rig: &Rig, gpu: &Arc<Gpu>, camera: ProjectorCamera) -> Result<Self, RenderError> {
        // Only the surfaces are asked for, so the simplest method is enough.
        let settings = RendererSettings {
            raster: camera.raster,
            scale: Scale::WHOLE,
            method: Method::full(1),
            drive: Drive::even(1.0),
            lens: (!camera.lens.is_pinhole()).then_some(camera),
            halftone: None,
            plane_groups: Vec::new(),
            ..renderer_settings(rig)
        };
        let renderer = Renderer::new(gpu, &rig.scene, settings)?;
        let slot = renderer.create_slot(true)?;
        Ok(Self { camera, renderer, slot })
    }

    /// What every pixel shows of bodies at `poses`, row by row, and whether it is hidden from `place`.
    ///
    /// # Errors
    /// The renderer's.
    pub(crate) fn points(
        &mut self,
        poses: &[DAffine3],
        animated_at_ns: i64,
        place: DVec3,
    ) -> Result<Vec<Option<SeenPoint>>, RenderError> {
        let inputs = FrameInputs { animated_at_ns, ..FrameInputs::new(&self.camera, (place, place), poses) };
        self.renderer.submit(&mut self.slot, &inputs)?;
        self.slot.wait(WAIT_NS)?;
        let surfaces = self.slot.surfaces().unwrap_or_default();
        let width = self.camera.raster.width();
        let point = |(i, surface): (usize, &dpm_render::Surface)| {
            let body = (surface.id != NO_HIT).then_some((surface.id >> 24) as usize)?;
            let pixel = DVec2::new(f64::from(i as u32 % width) + 0.5, f64::from(i as u32 / width) + 0.5);
            let ray = self.camera.ray(pixel);
            let distance = f64::from(surface.distance.abs());
            let position = ray.origin + ray.direction * distance;
            let normal = self.renderer.shading_normal(surface).as_dvec3();
            Some(SeenPoint {
                body,
                position,
                in_mesh: poses[body].inverse().transform_point3(position),
                normal: poses[body].transform_vector3(normal).normalize_or_zero(),
                uv: self.renderer.texture_coordinates(surface),
                distance,
                is_hidden: surface.distance <= 0.0,
            })
        };
        Ok(surfaces.iter().enumerate().map(point).collect())
    }
}
