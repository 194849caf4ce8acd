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
    /// With a lens: bounds of the straight rays of each tile.
    straight: Option<Arc<Vec<Bounds>>>,
}

/// A rectangle: lower and upper corner.
type Bounds = (DVec2, DVec2);

impl TileList {
    /// A list for a raster. `lens`: the projector, if its lens bends rays.
    pub(crate) fn new(raster: Raster, lens: Option<&ProjectorCamera>) -> Self {
        let (width, height) = (raster.width(), raster.height());
        let (tiles_x, tiles_y) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let n = (tiles_x * tiles_y) as usize;
        let mut step = (n as f64 * 0.618) as usize | 1;
        while gcd(step, n) != 1 {
            step += 2;
        }
        let order = (0..n).map(|i| ((i * step) % n) as u32).collect();
        let straight = lens.filter(|camera| !camera.lens.is_pinhole()).map(|camera| {
            let of = |tile: usize| straight_bounds(camera, tile as u32 % tiles_x, tile as u32 / tiles_x);
            Arc::new((0..n).map(of).collect())
        });
        Self { tiles_x, tiles_y, order, active: vec![false; n], previous: vec![false; n], straight }
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
    }

    fn mark(&mut self, camera: &ProjectorCamera, body: &BodyData, pose: &DAffine3) {
        let (lower, upper) = (body.bounds_min.as_dvec3(), body.bounds_max.as_dvec3());
        let (mut from, mut to) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for p in corners(lower, upper) {
            match camera.straight_of_world(pose.transform_point3(p)) {
                Some(straight) => {
                    from = from.min(straight);
                    to = to.max(straight);
                }
                // A box that is partly behind the projector has no bounds on the raster.
                None => {
                    let (world_lower, world_upper) = world_bounds(pose, body.bounds_min, body.bounds_max);
                    if !behind(camera, world_lower, world_upper) {
                        self.active.fill(true);
                    }
                    return;
                }
            }
        }
        // Lines are straight before the lens, so there the box lies between its corners. Behind a lens it may bulge.
        if let Some(straight) = &self.straight {
            for (active, (lower, upper)) in self.active.iter_mut().zip(straight.iter()) {
                *active |= from.cmple(*upper).all() && to.cmpge(*lower).all();
            }
            return;
        }
        let (from, to) = (camera.pixel_of_bent(from), camera.pixel_of_bent(to));
        let clamp = |v: f64, n: u32| (v / f64::from(TILE)).floor().clamp(-1.0, f64::from(n)) as i64;
        // One pixel of margin for rounding.
        let x0 = clamp(from.x - 1.0, self.tiles_x).max(0);
        let x1 = clamp(to.x + 1.0, self.tiles_x).min(i64::from(self.tiles_x) - 1);
        let y0 = clamp(from.y - 1.0, self.tiles_y).max(0);
        let y1 = clamp(to.y + 1.0, self.tiles_y).min(i64::from(self.tiles_y) - 1);
        for y in y0..=y1 {
            for x in x0..=x1 {
                self.active[(y * i64::from(self.tiles_x) + x) as usize] = true;
            }
        }
    }

    /// Which tiles are active now, row by row.
    pub(crate) fn active(&self) -> &[bool] {
        &self.active
    }

    /// Writes to `out` the tiles that are active now, those that were active at the last update, which must be cleared, and those that are `wanted`.
    /// Returns their number. `wanted` may be empty.
    pub(crate) fn write(&self, wanted: &[bool], out: &mut [u32]) -> u32 {
        let mut n = 0;
        for &tile in &self.order {
            let at = tile as usize;
            if self.active[at] || self.previous[at] || wanted.get(at) == Some(&true) {
                out[n] = tile;
                n += 1;
            }
        }
        n as u32
    }
}

/// Bounds of the straight rays of a tile and one pixel around it, from positions on its edge, because the rays of an area lie between
/// those of its edge.
fn straight_bounds(camera: &ProjectorCamera, tile_x: u32, tile_y: u32) -> Bounds {
    let (x0, y0) = (f64::from(tile_x * TILE) - 1.0, f64::from(tile_y * TILE) - 1.0);
    let side = f64::from(TILE + 2);
    let (mut lower, mut upper) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for i in 0..=TILE + 2 {
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
        let n = list.write(&[], &mut tiles) as usize;
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
        assert_eq!(list.write(&[], &mut tiles) as usize, n);
        list.update(&camera, &[], &[], 1);
        assert_eq!(list.write(&[], &mut tiles), 0);
        let mut wanted = vec![false; list.len()];
        wanted[5] = true;
        assert_eq!((list.write(&wanted, &mut tiles), tiles[0]), (1, 5));
    }
}
