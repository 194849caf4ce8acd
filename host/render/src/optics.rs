//! The table of what differs from pixel to pixel and never changes: thresholds of the response, flat field, and the straight rays of the lens.

use super::drive::Drive;
use dpm_device::planes::Raster;
use dpm_scene::geometry::lens::LensModel;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_shaders::specialization as ids;
use dpm_shaders::structs::{Frame, LENS_BROWN, LENS_FISHEYE, LENS_NONE, RESPONSE_CODES};
use glam::DVec2;

/// Where each part of the table begins, and which parts there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct OpticsLayout {
    response: bool,
    flat_field: bool,
    lens: u32,
    pixels: u32,
}

impl OpticsLayout {
    /// The parts that a rig needs: `lens` is its projector if that has a lens to be compensated.
    pub(super) fn new(raster: Raster, drive: &Drive, lens: Option<&ProjectorCamera>) -> Self {
        Self {
            response: drive.response.is_some(),
            flat_field: drive.flat_field.is_some(),
            lens: lens.map_or(LENS_NONE, |camera| match camera.lens.model() {
                LensModel::Pinhole => LENS_NONE,
                LensModel::Brown(_) => LENS_BROWN,
                LensModel::Fisheye(_) => LENS_FISHEYE,
            }),
            pixels: raster.pixel_count() as u32,
        }
    }

    fn flat_field_at(&self) -> u32 {
        if self.response {
            3 * RESPONSE_CODES
        } else {
            0
        }
    }

    fn rays_at(&self) -> u32 {
        self.flat_field_at() + if self.flat_field { 3 * self.pixels } else { 0 }
    }

    /// Size of the table.
    pub(super) fn len_bytes(&self) -> usize {
        let rays = if self.lens == LENS_NONE { 0 } else { 2 * self.pixels as usize };
        4 * (self.rays_at() as usize + rays)
    }

    /// The specialization constants that leave out the parts that are not there.
    pub(super) fn constants(&self) -> [(u32, u32); 3] {
        [
            (ids::LENS, self.lens),
            (ids::HAS_RESPONSE, u32::from(self.response)),
            (ids::HAS_FLAT_FIELD, u32::from(self.flat_field)),
        ]
    }

    /// The table. It has one element where there would be none, because a buffer cannot be empty.
    pub(super) fn table(&self, drive: &Drive, lens: Option<&ProjectorCamera>) -> Vec<f32> {
        let mut table = Vec::with_capacity(self.len_bytes() / 4 + 1);
        if let Some(response) = &drive.response {
            (0..3).for_each(|channel| table.extend_from_slice(response.thresholds(channel)));
        }
        if let Some(flat_field) = &drive.flat_field {
            table.extend(flat_field.iter().flatten());
        }
        if let Some(camera) = lens.filter(|_| self.lens != LENS_NONE) {
            table.extend(straight_rays(camera).flat_map(|p| [p.x as f32, p.y as f32]));
        }
        if table.is_empty() {
            table.push(0.0);
        }
        table
    }

    /// Writes what the shaders need to know of the lens and of this table.
    pub(super) fn describe(&self, camera: &ProjectorCamera, frame: &mut Frame) {
        frame.flat_field_at = self.flat_field_at();
        frame.rays_at = self.rays_at();
        frame.lens_limit = camera.lens.limit() as f32;
        let coefficients = match camera.lens.model() {
            LensModel::Pinhole => return,
            LensModel::Brown(c) => c,
            LensModel::Fisheye(k) => std::array::from_fn(|i| k.get(i).copied().unwrap_or(0.0)),
        };
        frame.lens = std::array::from_fn(|row| std::array::from_fn(|i| coefficients[4 * row + i] as f32));
        let tilt = camera.lens.tilt_matrix().transpose();
        frame.lens_tilt = [tilt.x_axis, tilt.y_axis, tilt.z_axis].map(|r| r.as_vec3().extend(0.0).to_array());
    }
}

/// The straight rays of the pixels' centres, row by row.
fn straight_rays(camera: &ProjectorCamera) -> impl Iterator<Item = DVec2> + '_ {
    let (width, height) = (camera.raster.width(), camera.raster.height());
    (0..height).flat_map(move |y| {
        (0..width).map(move |x| {
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            // A projector with a lens was checked to have a ray at every pixel; a ray that cannot hit anything is dark.
            camera.straight_of_pixel(pixel).unwrap_or(DVec2::splat(f64::NAN))
        })
    })
}
