//! Cuts the mirrors whose light would come near a tracked head out of the planes of a frame.
//!
//! Mirrors are looked at in tiles of 8 x 8, each of which is a byte of eight rows in every plane. A tile is cut if the cone
//! around all its rays meets the cone around a head, both with their tips in the projector. So every mirror whose ray
//! meets the sphere is dark, lens and all, and no mirror is that lies more than a tile's breadth beside it.

use crate::plan::eyes::{EyeGuard, GuardedEyes};
use crate::rig::Rig;
use dpm_device::planes::Raster;
use dpm_render::pack::BitPlaneFrame;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DVec2, DVec3};
use std::ops::Range;

/// Columns and rows of a tile.
pub(crate) const TILE: usize = 8;
/// Cosines of single precision are compared with this much room.
const ROUNDING: f32 = 1e-6;
/// The rays of a tile's border are taken at its corners and half way between. Between them a lens bends the border by
/// less than this share of the tile.
const BENT: f64 = 1.02;

/// Tiles next to each other in a row of tiles.
#[derive(Clone, Debug, PartialEq, Eq)]
struct TileRun {
    row: usize,
    columns: Range<usize>,
}

/// The rays of a projector by tiles, row after row. All memory is allocated at the start.
#[derive(Clone, Debug)]
pub struct EyeMask {
    raster: Raster,
    /// Axis of the cone around the rays of each tile, in the space of the projector, one coordinate after the other.
    axes: [Vec<f32>; 3],
    /// Cosine and sine of its half angle.
    angles: [Vec<f32>; 2],
    /// Tracks may move light to the next tile.
    is_moved: bool,
    /// The tiles of the frame that are cut.
    is_cut: Vec<bool>,
    runs: Vec<TileRun>,
}

impl EyeMask {
    /// That of `rig`; `None` if no head is guarded.
    pub(crate) fn of_rig(rig: &Rig) -> Option<Self> {
        (!rig.heads.is_empty()).then(|| Self::new(&rig.camera, rig.wants_tracks()))
    }

    /// For the lens and the raster of `camera`, wherever it stands. If light `is_moved` by tracks, which is to the next tile
    /// at most, the tiles around those with a ray that is forbidden are cut too.
    pub fn new(camera: &ProjectorCamera, is_moved: bool) -> Self {
        let raster = camera.raster;
        let [columns, rows] = tiles_of(raster);
        let mut this = Self {
            raster,
            axes: [(); 3].map(|()| Vec::with_capacity(columns * rows)),
            angles: [(); 2].map(|()| Vec::with_capacity(columns * rows)),
            is_moved,
            is_cut: vec![false; columns * rows],
            runs: Vec::with_capacity(rows * columns.div_ceil(2)),
        };
        for tile in 0..columns * rows {
            let (axis, angle) = cone(camera, [tile % columns, tile / columns]);
            for (all, of) in this.axes.iter_mut().zip(axis.as_vec3().to_array()) {
                all.push(of);
            }
            for (all, of) in this.angles.iter_mut().zip([angle.cos(), angle.sin()]) {
                all.push(of as f32);
            }
        }
        this
    }

    /// Makes the mirrors dark of all planes of `frame`, which `camera` shows, that `eyes` forbid. Returns how many these
    /// are.
    ///
    /// # Panics
    /// When the frame has another raster.
    pub fn cut(&mut self, eyes: &GuardedEyes, camera: &ProjectorCamera, frame: &mut BitPlaneFrame) -> u32 {
        let plane_bytes = self.raster.plane_bytes();
        assert_eq!(frame.len_bytes(), plane_bytes * frame.schedule().len(), "planes of another raster");
        if eyes.lost.is_some() {
            self.is_cut.fill(true);
            frame.bytes_mut().fill(0);
            return self.raster.pixel_count() as u32;
        }
        self.is_cut.fill(false);
        for sphere in &eyes.spheres {
            self.mark(sphere, camera);
        }
        if self.is_moved {
            self.spread();
        }
        self.find_runs();
        if self.runs.is_empty() {
            return 0;
        }
        let (row_bytes, height) = (self.raster.row_bytes(), self.raster.height() as usize);
        for plane in frame.bytes_mut().chunks_exact_mut(plane_bytes) {
            for TileRun { row, columns } in &self.runs {
                let rows = row * TILE..((row + 1) * TILE).min(height);
                for row in plane[rows.start * row_bytes..rows.end * row_bytes].chunks_exact_mut(row_bytes) {
                    row[columns.clone()].fill(0);
                }
            }
        }
        self.mirrors()
    }

    /// True if the last call of [`EyeMask::cut`] made mirror `mirror` dark, counted row after row.
    pub fn is_cut(&self, mirror: usize) -> bool {
        let width = self.raster.width() as usize;
        let (x, y) = (mirror % width, mirror / width);
        self.is_cut.get(y / TILE * self.raster.row_bytes() + x / TILE).copied().unwrap_or(true)
    }

    /// Marks the tiles with a ray that meets `sphere`.
    fn mark(&mut self, sphere: &EyeGuard, camera: &ProjectorCamera) {
        let to = camera.to_projector_space(sphere.centre);
        let distance_m = to.length();
        // Where a head is not known, it is everywhere. So it is if its radius is no number: no tile is clear then.
        if distance_m <= sphere.radius_m || !distance_m.is_finite() {
            self.is_cut.fill(true);
            return;
        }
        let [x, y, z] = (to / distance_m).as_vec3().to_array();
        let sine = sphere.radius_m / distance_m;
        let (cosine, sine) = ((1.0 - sine * sine).sqrt() as f32, sine as f32);
        let [xs, ys, zs] = &self.axes;
        let [cosines, sines] = &self.angles;
        let tiles = self.is_cut.iter_mut().zip(xs).zip(ys).zip(zs).zip(cosines).zip(sines);
        for (((((cut, tx), ty), tz), tile_cosine), tile_sine) in tiles {
            // The angle between the axes is at most the sum of the half angles: false for a tile that is no cone.
            let is_clear = tx * x + ty * y + tz * z < cosine * tile_cosine - sine * tile_sine - ROUNDING;
            *cut |= !is_clear;
        }
    }

    /// Marks the tiles around those that are marked.
    fn spread(&mut self) {
        let columns = self.raster.row_bytes();
        let rows = self.is_cut.len() / columns;
        let lines = (0..rows).map(|row| (row * columns, 1, columns));
        for (first, step, count) in lines.chain((0..columns).map(|column| (column, columns, rows))) {
            let mut before = false;
            for i in 0..count {
                let at = first + i * step;
                let (here, after) = (self.is_cut[at], i + 1 < count && self.is_cut[at + step]);
                self.is_cut[at] = before || here || after;
                before = here;
            }
        }
    }

    /// Collects the marked tiles.
    fn find_runs(&mut self) {
        self.runs.clear();
        for (row, tiles) in self.is_cut.chunks_exact(self.raster.row_bytes()).enumerate() {
            let mut first = 0;
            for same in tiles.chunk_by(|a, b| a == b) {
                let columns = first..first + same.len();
                first = columns.end;
                if same[0] {
                    self.runs.push(TileRun { row, columns });
                }
            }
        }
    }

    /// Mirrors in the runs.
    fn mirrors(&self) -> u32 {
        let (width, height) = (self.raster.width() as usize, self.raster.height() as usize);
        let of = |run: &TileRun| {
            let columns = (run.columns.end * TILE).min(width) - run.columns.start * TILE;
            columns * (((run.row + 1) * TILE).min(height) - run.row * TILE)
        };
        self.runs.iter().map(of).sum::<usize>() as u32
    }
}

/// Tiles in a row, and rows of tiles.
fn tiles_of(raster: Raster) -> [usize; 2] {
    [raster.row_bytes(), (raster.height() as usize).div_ceil(TILE)]
}

/// The cone around the rays of all mirrors of a tile, up to their edges: its axis in the space of the projector, and its
/// half angle. NaN where the lens has no rays.
fn cone(camera: &ProjectorCamera, tile: [usize; 2]) -> (DVec3, f64) {
    let raster = [camera.raster.width(), camera.raster.height()];
    let span = |i: usize| {
        let end = ((tile[i] + 1) * TILE).min(raster[i] as usize);
        [(tile[i] * TILE) as f64, end as f64]
    };
    let [[left, right], [top, bottom]] = [span(0), span(1)];
    let middle = DVec2::new(left + right, top + bottom) * 0.5;
    let ray = |x: f64, y: f64| {
        let straight = camera.straight_of_pixel(DVec2::new(x, y)).unwrap_or(DVec2::NAN);
        DVec3::new(straight.x, -straight.y, -1.0).normalize()
    };
    let axis = ray(middle.x, middle.y);
    let border = [left, middle.x, right].into_iter().flat_map(|x| [top, middle.y, bottom].map(|y| ray(x, y)));
    // `max` would pass over what is no number.
    let widest = border.map(|ray| ray.angle_between(axis)).reduce(|a, b| if a >= b { a } else { b });
    let angle = widest.unwrap_or(f64::NAN) * BENT;
    (axis, angle.min(std::f64::consts::FRAC_PI_2))
}

#[cfg(test)]
mod tests;
