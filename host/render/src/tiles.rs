//! Poses into the tiles to trace: those that the bounds of a body may touch.

use super::scene_data::{world_bounds, BodyData};
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_shaders::structs::INSTANCE_EMPTY;
use glam::{DAffine3, DVec2, DVec3};
use std::sync::Arc;

/// Side of a tile in pixels (\[paper\] section 2.1).
pub const TILE: u32 = 16;

/// The tiles of one raster, in the order in which they are traced, and which of them are active.
#[derive(Clone, Debug)]
pub(crate) struct TileList {
    tiles_x: u32,
    tiles_y: u32,
    /// All tiles, in an order with large steps. Software Vulkan splits a grid into two halves, which should cost the same.
    order: Vec<u32>,
    active: Vec<bool>,
    previous: Vec<bool>,
    /// Tiles on which the light of a moving body can fall.
    moving: Vec<bool>,
    /// With a lens: bounds of the straight rays of each tile.
    straight: Option<Arc<Vec<Bounds>>>,
    /// So many pixels around a body its tiles count.
    margin: f64,
}

/// A rectangle: lower and upper corner.
type Bounds = (DVec2, DVec2);

/// A rectangle of whole tiles of the raster, in pixels: first column and row, and those after the last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct PixelRect {
    pub lower: [i32; 2],
    pub upper: [i32; 2],
}

impl PixelRect {
    /// The smallest rectangle that holds both.
    pub(crate) fn with(self, other: Self) -> Self {
        let both = |a: [i32; 2], b: [i32; 2], pick: fn(i32, i32) -> i32| [pick(a[0], b[0]), pick(a[1], b[1])];
        Self {
            lower: both(self.lower, other.lower, i32::min),
            upper: both(self.upper, other.upper, i32::max),
        }
    }
}

/// Where the box of a body may be seen.
enum Reach {
    /// It is behind the projector.
    Nowhere,
    /// It is partly behind the projector, so it has no bounds on the raster.
    Everywhere,
    /// Its straight rays lie in these bounds.
    Within(Bounds),
}

impl TileList {
    /// A list for a raster. `lens`: the projector, if its lens bends rays.
    pub(crate) fn new(raster: Raster, lens: Option<&ProjectorCamera>) -> Self {
        // One pixel for rounding.
        Self::around(raster, lens, 1)
    }

    /// The same with so many pixels around bodies.
    fn around(raster: Raster, lens: Option<&ProjectorCamera>, margin: u32) -> Self {
        let (width, height) = (raster.width(), raster.height());
        let (tiles_x, tiles_y) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let n = (tiles_x * tiles_y) as usize;
        let mut step = (n as f64 * 0.618) as usize | 1;
        while gcd(step, n) != 1 {
            step += 2;
        }
        let order = (0..n).map(|i| ((i * step) % n) as u32).collect();
        let straight = lens.filter(|camera| !camera.lens.is_pinhole()).map(|camera| {
            let of =
                |tile: usize| straight_bounds(camera, [tile as u32 % tiles_x, tile as u32 / tiles_x], margin);
            Arc::new((0..n).map(of).collect())
        });
        Self {
            tiles_x,
            tiles_y,
            order,
            active: vec![false; n],
            previous: vec![false; n],
            moving: vec![false; n],
            straight,
            margin: f64::from(margin),
        }
    }

    /// The list of a panel of which fewer pixels are traced. A cell is worked on with the tile of its first pixel, so tiles count that are as far from
    /// a body as a cell reaches: `reach` pixels.
    pub(crate) fn of_panel(raster: Raster, lens: Option<&ProjectorCamera>, reach: u32) -> Self {
        Self::around(raster, lens, 1 + reach)
    }

    /// Number of tiles of the raster.
    pub(crate) fn len(&self) -> usize {
        self.active.len()
    }

    /// Tiles in a row.
    pub(crate) fn tiles_x(&self) -> u32 {
        self.tiles_x
    }

    /// Marks the tiles that may be touched by the bodies with all bits of `flags_mask`. Allocates nothing.
    pub(crate) fn update(
        &mut self,
        camera: &ProjectorCamera,
        bodies: &[BodyData],
        poses: &[DAffine3],
        flags_mask: u32,
    ) {
        std::mem::swap(&mut self.active, &mut self.previous);
        self.active.fill(false);
        self.moving.fill(false);
        for (body, pose) in bodies.iter().zip(poses) {
            if body.flags & INSTANCE_EMPTY == 0 && body.flags & flags_mask == flags_mask {
                self.mark(camera, body, pose);
            }
        }
    }

    /// Marks every tile.
    pub(crate) fn fill(&mut self) {
        std::mem::swap(&mut self.active, &mut self.previous);
        self.active.fill(true);
        self.moving.fill(false);
    }

    /// Marks tiles as active on which the light of a moving body can fall.
    pub(crate) fn mark_moving(&mut self, area: PixelRect) {
        let tiles = |c: usize| {
            area.lower[c] as usize / TILE as usize..(area.upper[c] as usize).div_ceil(TILE as usize)
        };
        for y in tiles(1) {
            for x in tiles(0) {
                let tile = y * self.tiles_x as usize + x;
                (self.active[tile], self.moving[tile]) = (true, true);
            }
        }
    }

    /// The pixels of the smallest rectangle of whole tiles that holds a body at `pose` and `margin` pixels around it. `None`: it is not on the raster.
    pub(crate) fn pixels_of(
        &self,
        camera: &ProjectorCamera,
        body: &BodyData,
        pose: &DAffine3,
        margin: f64,
    ) -> Option<PixelRect> {
        let raster = [camera.raster.width(), camera.raster.height()].map(|n| n as i32);
        let all = PixelRect { lower: [0; 2], upper: raster };
        let (from, to) = match reach(camera, body, pose) {
            Reach::Nowhere => return None,
            Reach::Everywhere => return Some(all),
            Reach::Within(bounds) => bounds,
        };
        let tiles = match &self.straight {
            // Where a lens compresses the picture, a pixel is more of the straight rays than at its centre.
            Some(straight) => {
                let margin = DVec2::splat(2.0 * margin / camera.fx.min(camera.fy));
                let touched = |(tile, bounds): (usize, &Bounds)| {
                    let at = [tile % self.tiles_x as usize, tile / self.tiles_x as usize].map(|t| t as i32);
                    overlap((from - margin, to + margin), *bounds)
                        .then_some(PixelRect { lower: at, upper: at.map(|t| t + 1) })
                };
                straight.iter().enumerate().filter_map(touched).reduce(PixelRect::with)?
            }
            None => {
                let pixels = (camera.pixel_of_bent(from) - margin, camera.pixel_of_bent(to) + margin);
                let [x, y] = self.tile_ranges(pixels);
                PixelRect { lower: [x.0, y.0], upper: [x.1, y.1] }
            }
        };
        let pixels = |t: i32, c: usize| (t * TILE as i32).min(raster[c]);
        let area = PixelRect {
            lower: [pixels(tiles.lower[0], 0), pixels(tiles.lower[1], 1)],
            upper: [pixels(tiles.upper[0], 0), pixels(tiles.upper[1], 1)],
        };
        (area.lower[0] < area.upper[0] && area.lower[1] < area.upper[1]).then_some(area)
    }

    /// First tile and the one after the last, in x and in y, that hold the pixels between two corners; empty outside of the raster.
    fn tile_ranges(&self, (from, to): Bounds) -> [(i32, i32); 2] {
        let tile = |v: f64, n: u32| (v / f64::from(TILE)).floor().clamp(-1.0, f64::from(n)) as i32;
        let range = |from: f64, to: f64, n: u32| {
            let (first, last) = (tile(from, n).max(0), tile(to, n).min(n as i32 - 1));
            (first, (last + 1).max(first))
        };
        [range(from.x, to.x, self.tiles_x), range(from.y, to.y, self.tiles_y)]
    }

    fn mark(&mut self, camera: &ProjectorCamera, body: &BodyData, pose: &DAffine3) {
        let (from, to) = match reach(camera, body, pose) {
            Reach::Nowhere => return,
            Reach::Everywhere => return self.active.fill(true),
            Reach::Within(bounds) => bounds,
        };
        // Lines are straight before the lens, so there the box lies between its corners. Behind a lens it may bulge.
        if let Some(straight) = &self.straight {
            for (active, bounds) in self.active.iter_mut().zip(straight.iter()) {
                *active |= overlap((from, to), *bounds);
            }
            return;
        }
        let pixels = (camera.pixel_of_bent(from) - self.margin, camera.pixel_of_bent(to) + self.margin);
        let [x, y] = self.tile_ranges(pixels);
        for y in y.0..y.1 {
            for x in x.0..x.1 {
                self.active[y as usize * self.tiles_x as usize + x as usize] = true;
            }
        }
    }

    /// Which tiles are active now, row by row.
    pub(crate) fn active(&self) -> &[bool] {
        &self.active
    }

    /// Writes to `out` the tiles that are active now, those that were active at the last update, which must be cleared, and those that are `wanted`.
    /// Returns their number, and how many of them are tiles of moving bodies, which come first. `wanted` may be empty.
    pub(crate) fn write(&self, wanted: &[bool], out: &mut [u32]) -> (u32, u32) {
        let mut n = 0;
        let mut list = |take: &dyn Fn(usize) -> bool| {
            for &tile in &self.order {
                if take(tile as usize) {
                    out[n as usize] = tile;
                    n += 1;
                }
            }
            n
        };
        let moving = list(&|at| self.moving[at]);
        let all = list(&|at| {
            !self.moving[at] && (self.active[at] || self.previous[at] || wanted.get(at) == Some(&true))
        });
        (all, moving)
    }
}

/// Bounds of the straight rays of a tile and so many pixels around it, from positions on its edge, because the rays of an area lie between
/// those of its edge.
fn straight_bounds(camera: &ProjectorCamera, tile: [u32; 2], margin: u32) -> Bounds {
    let [x0, y0] = tile.map(|t| f64::from(t * TILE) - f64::from(margin));
    let side = f64::from(TILE + 2 * margin);
    let (mut lower, mut upper) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for i in 0..=TILE + 2 * margin {
        let t = f64::from(i);
        for (x, y) in [(t, 0.0), (t, side), (0.0, t), (side, t)] {
            match camera.straight_of_pixel(DVec2::new(x0 + x, y0 + y)) {
                Some(straight) => {
                    lower = lower.min(straight);
                    upper = upper.max(straight);
                }
                // A tile reaches beyond the raster, where the lens may end. Such a tile is always traced.
                None => return (DVec2::NEG_INFINITY, DVec2::INFINITY),
            }
        }
    }
    (lower, upper)
}

/// Where the box of a body at `pose` may be seen.
fn reach(camera: &ProjectorCamera, body: &BodyData, pose: &DAffine3) -> Reach {
    let (mut from, mut to) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for p in corners(body.bounds_min.as_dvec3(), body.bounds_max.as_dvec3()) {
        let Some(straight) = camera.straight_of_world(pose.transform_point3(p)) else {
            let (lower, upper) = world_bounds(pose, body.bounds_min, body.bounds_max);
            return if behind(camera, lower, upper) { Reach::Nowhere } else { Reach::Everywhere };
        };
        from = from.min(straight);
        to = to.max(straight);
    }
    Reach::Within((from, to))
}

/// Whether two rectangles have a point in common.
fn overlap(a: Bounds, b: Bounds) -> bool {
    a.0.cmple(b.1).all() && a.1.cmpge(b.0).all()
}

/// The whole box is behind the projector.
fn behind(camera: &ProjectorCamera, lower: DVec3, upper: DVec3) -> bool {
    corners(lower, upper).all(|p| camera.to_projector_space(p).z >= 0.0)
}

/// The eight corners of a box.
pub(super) fn corners(lower: DVec3, upper: DVec3) -> impl Iterator<Item = DVec3> {
    (0..8u32).map(move |c| {
        let pick = |bit: u32, low: f64, high: f64| if c >> bit & 1 == 1 { high } else { low };
        DVec3::new(pick(0, lower.x, upper.x), pick(1, lower.y, upper.y), pick(2, lower.z, upper.z))
    })
}

fn gcd(a: usize, b: usize) -> usize {
    if b == 0 {
        a
    } else {
        gcd(b, a % b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_tile_that_a_point_of_the_body_falls_into_is_active() {
        let raster = Raster::new(250, 130).unwrap();
        let camera =
            ProjectorCamera::look_at(raster, DVec3::new(0.0, 0.1, 1.0), DVec3::ZERO, DVec3::Y, 0.6).unwrap();
        let body = BodyData::of_20_cm();
        let pose = DAffine3::from_rotation_y(0.7);
        let mut list = TileList::new(raster, None);
        list.update(&camera, &[body], &[pose], 1);
        let mut tiles = vec![0; list.len()];
        let n = list.write(&[], &mut tiles).0 as usize;
        assert!(n > 4 && n < list.len(), "{n} of {}", list.len());
        for i in 0..1000 {
            let h = |k: u32| f64::from((i * k) % 997) / 997.0 * 0.2 - 0.1;
            let p = camera.project(pose.transform_point3(DVec3::new(h(31), h(57), h(91)))).unwrap();
            if p.x >= 0.0 && p.y >= 0.0 && p.x < 250.0 && p.y < 130.0 {
                let tile = p.y as u32 / TILE * list.tiles_x() + p.x as u32 / TILE;
                assert!(tiles[..n].contains(&tile), "{p}");
            }
        }
        // After the body has left, its tiles are listed once more, to be cleared, and then no more.
        list.update(&camera, &[], &[], 1);
        assert_eq!(list.write(&[], &mut tiles).0 as usize, n);
        list.update(&camera, &[], &[], 1);
        assert_eq!(list.write(&[], &mut tiles), (0, 0));
        let mut wanted = vec![false; list.len()];
        wanted[5] = true;
        assert_eq!((list.write(&wanted, &mut tiles), tiles[0]), ((1, 0), 5));
    }
}
