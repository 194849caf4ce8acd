//! The table of what differs from pixel to pixel or over a surface and never changes: thresholds of the response, flat field, the straight rays of
//! the lens, and albedo maps. Behind them stands the blur of a moving eye, by its speed.

use super::albedo_map::AlbedoMap;
use super::drive::Drive;
use super::rate_table::rate_table;
use super::settings::RendererSettings;
use dpm_scene::geometry::lens::LensModel;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_shaders::specialization as ids;
use dpm_shaders::structs::{
    Frame, LENS_BROWN, LENS_FISHEYE, LENS_NONE, NO_ALBEDO_MAP, RATE_TABLE_OCTAVE, RATE_TABLE_OCTAVES,
    RESPONSE_CODES,
};
use glam::DVec2;

/// Where each part of the table begins, and which parts there are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct OpticsLayout {
    response: bool,
    flat_field: bool,
    lens: u32,
    pixels: u32,
    /// Of each body of the scene that has an albedo map or comes before one that has: the map's numbers; 0: it has none.
    maps: Vec<u32>,
    rates: bool,
}

impl OpticsLayout {
    /// The parts that a rig needs.
    pub(super) fn new(settings: &RendererSettings) -> Self {
        let (drive, lens) = (&settings.drive, settings.lens.as_ref());
        Self {
            response: drive.response.is_some(),
            flat_field: drive.flat_field.is_some(),
            lens: lens.map_or(LENS_NONE, |camera| match camera.lens.model() {
                LensModel::Pinhole => LENS_NONE,
                LensModel::Brown(_) => LENS_BROWN,
                LensModel::Fisheye(_) => LENS_FISHEYE,
            }),
            pixels: settings.raster.pixel_count() as u32,
            maps: drive.albedo_maps.iter().map(|m| m.as_ref().map_or(0, |m| numbers_of(m))).collect(),
            // Shading rates are decided by methods with a history only.
            rates: settings.method.needs_history(),
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

    fn maps_at(&self) -> u32 {
        self.rays_at() + if self.lens == LENS_NONE { 0 } else { 2 * self.pixels }
    }

    /// Where the albedo map of a body of the scene begins; `NO_ALBEDO_MAP` if it has none.
    pub(super) fn albedo_map_at(&self, body: usize) -> u32 {
        match self.maps.get(body) {
            None | Some(0) => NO_ALBEDO_MAP,
            Some(_) => self.maps_at() + self.maps[..body].iter().sum::<u32>(),
        }
    }

    fn rate_table_at(&self) -> u32 {
        self.maps_at() + self.maps.iter().sum::<u32>()
    }

    /// Elements of the table.
    pub(super) fn len(&self) -> u32 {
        (self.len_bytes() / 4).max(1) as u32
    }

    /// Size of the table.
    pub(super) fn len_bytes(&self) -> usize {
        let rates = if self.rates { 2 * (RATE_TABLE_OCTAVE * RATE_TABLE_OCTAVES) as usize } else { 0 };
        4 * (self.rate_table_at() as usize + rates)
    }

    /// The specialization constants that leave out the parts that are not there.
    pub(super) fn constants(&self) -> [(u32, u32); 4] {
        [
            (ids::LENS, self.lens),
            (ids::HAS_RESPONSE, u32::from(self.response)),
            (ids::HAS_FLAT_FIELD, u32::from(self.flat_field)),
            (ids::HAS_ALBEDO_MAPS, u32::from(self.maps.iter().any(|&n| n > 0))),
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
        for map in drive.albedo_maps.iter().flatten() {
            // Both sides are exact in f32.
            table.extend([map.width() as f32, map.height() as f32]);
            table.extend(map.texels().iter().flatten());
        }
        if self.rates {
            table.extend(rate_table().iter().flatten());
        }
        if table.is_empty() {
            table.push(0.0);
        }
        table
    }

    /// Writes what the shaders need to know of the lens and of this table, which begins at the element `first`.
    pub(super) fn describe(&self, camera: &ProjectorCamera, first: u32, frame: &mut Frame) {
        frame.flat_field_at = first + self.flat_field_at();
        frame.rays_at = first + self.rays_at();
        frame.rate_table_at = first + self.rate_table_at();
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

/// How many numbers of the table an albedo map takes: its sides, and three for each texel.
fn numbers_of(map: &AlbedoMap) -> u32 {
    2 + 3 * map.texels().len() as u32
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
