//! The bodies that move while the planes of a frame last: where their light can fall, and how they move there.

use super::{Sweep, LEAST_MOTION_PX};
use crate::scene_data::{rows, BodyData};
use crate::tiles::{corners, PixelRect, TileList};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_shaders::structs::{Mover, PlaneGroup, INSTANCE_EMPTY, INSTANCE_PROJECTED, OWNER_STILL};
use glam::{DAffine3, DMat2, DVec2};

/// Most bodies that move: the owner of a pixel is told in eight bits.
const MOST_MOVERS: usize = 255 - OWNER_STILL as usize;
/// Motions are in units of so many a pixel.
const MOTION_UNITS: f64 = 64.0;
/// Slopes are in units of so many to a unit of motion a pixel.
const SLOPE_UNITS: f64 = 4096.0;

/// The movers of one frame. Made once; filling it allocates nothing.
#[derive(Debug)]
pub(crate) struct Movers {
    /// Longest time from the frame's instant to that of a group, as a share of the exposure.
    reach: f64,
    movers: Vec<Mover>,
    /// Per body: 0 if it is left as it was drawn, else the number of its mover, from 1 on.
    numbers: Vec<u32>,
}

impl Movers {
    /// For a scene of `bodies` bodies whose planes are shown in `groups`.
    pub(crate) fn new(bodies: usize, groups: &[PlaneGroup]) -> Self {
        let reach = groups.iter().map(|g| g.instant.unsigned_abs()).max().unwrap_or(0);
        Self {
            reach: f64::from(reach) / 65536.0,
            movers: Vec::with_capacity(bodies.min(MOST_MOVERS)),
            numbers: vec![0; bodies],
        }
    }

    /// Finds the bodies that move, and marks in `tiles` where their light can fall. `poses` are those that the frame is
    /// drawn for; `None`: nothing is known of motion.
    pub(crate) fn find(
        &mut self,
        camera: &ProjectorCamera,
        bodies: &[BodyData],
        poses: &[DAffine3],
        sweep: Option<Sweep<'_>>,
        tiles: &mut TileList,
    ) {
        self.movers.clear();
        self.numbers.fill(0);
        let Some(sweep) = sweep.filter(|_| self.reach > 0.0) else { return };
        for (i, (body, pose)) in bodies.iter().zip(poses).enumerate() {
            let lit = body.flags & INSTANCE_EMPTY == 0 && body.flags & INSTANCE_PROJECTED != 0;
            let (Some(first), Some(last), true) = (sweep.first.get(i), sweep.last.get(i), lit) else {
                continue;
            };
            let Some((mover, area)) = self.mover(camera, tiles, body, [first, pose, last]) else { continue };
            if self.movers.len() < MOST_MOVERS {
                tiles.mark_moving(area);
                self.movers.push(mover);
                self.numbers[i] = self.movers.len() as u32;
            }
        }
    }

    /// The movers that were found.
    pub(crate) fn movers(&self) -> &[Mover] {
        &self.movers
    }

    /// The number of the mover of body `i`, 0 if it is none.
    pub(crate) fn number_of(&self, i: usize) -> u32 {
        self.numbers[i]
    }

    /// How a body moves that is at `poses` at the first photon, at the frame's instant and at the last photon, and the
    /// pixels on which its light can fall. `None` if it moves too little, or is nowhere near the raster.
    fn mover(
        &self,
        camera: &ProjectorCamera,
        tiles: &TileList,
        body: &BodyData,
        poses: [&DAffine3; 3],
    ) -> Option<(Mover, PixelRect)> {
        let [first, pose, last] = poses;
        let mut seen = [(DVec2::ZERO, DVec2::ZERO); 8];
        let mut count = 0;
        for p in corners(body.bounds_min.as_dvec3(), body.bounds_max.as_dvec3()) {
            let (at, half) =
                (pose.transform_point3(p), (last.transform_point3(p) - first.transform_point3(p)) / 2.0);
            let ends = (camera.project(at - half), camera.project(at + half), camera.project(at));
            if let (Some(before), Some(after), Some(now)) = ends {
                seen[count] = (now, after - before);
                count += 1;
            }
        }
        let seen = &seen[..count];
        let farthest = seen.iter().map(|(_, d)| d.length()).fold(0.0, f64::max) * self.reach;
        if farthest < LEAST_MOTION_PX {
            return None;
        }
        // A pixel more for what the corners do not tell and for rounding.
        let margin = farthest + 1.0;
        let area = poses
            .iter()
            .filter_map(|pose| tiles.pixels_of(camera, body, pose, margin))
            .reduce(PixelRect::with)?;
        let (centre, start, slope) = fit(seen);
        let motion = DAffine3 {
            matrix3: last.matrix3 - first.matrix3,
            translation: last.translation - first.translation,
        };
        let whole =
            |v: DVec2, units: f64| [v.x, v.y].map(|c| (c * units).round().clamp(-32767.0, 32767.0) as i32);
        let steep = |c: f64| (c * MOTION_UNITS * SLOPE_UNITS).round().clamp(-131_072.0, 131_072.0) as i32;
        let mover = Mover {
            motion_from_object: rows(&motion),
            lower: area.lower,
            upper: area.upper,
            centre: whole(centre, 1.0),
            start: whole(start, MOTION_UNITS),
            slope: [slope.x_axis.x, slope.y_axis.x, slope.x_axis.y, slope.y_axis.y].map(steep),
        };
        Some((mover, area))
    }
}

/// The affine map that is nearest to motions at places: the whole pixel about which it is told, the motion there, and its
/// derivative.
fn fit(seen: &[(DVec2, DVec2)]) -> (DVec2, DVec2, DMat2) {
    let n = seen.len() as f64;
    let mean = |pick: fn(&(DVec2, DVec2)) -> DVec2| seen.iter().map(pick).sum::<DVec2>() / n;
    let (place, motion) = (mean(|s| s.0), mean(|s| s.1));
    let centre = place.round();
    let outer = |a: DVec2, b: DVec2| DMat2::from_cols(a * b.x, a * b.y);
    let (mut spread, mut common) = (DMat2::ZERO, DMat2::ZERO);
    for (p, d) in seen {
        spread += outer(*p - place, *p - place);
        common += outer(*d - motion, *p - place);
    }
    // Places on a line do not tell a derivative.
    let trace = spread.x_axis.x + spread.y_axis.y;
    let slope =
        if spread.determinant() > 1e-6 * trace * trace { common * spread.inverse() } else { DMat2::ZERO };
    // Pixels are told by their number, and lie half a pixel further.
    (centre, motion + slope * (centre + 0.5 - place), slope)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_affine_motion_is_found_again() {
        let slope = DMat2::from_cols(DVec2::new(0.01, -0.03), DVec2::new(0.02, 0.005));
        let motion = |p: DVec2| DVec2::new(3.0, -1.5) + slope * p;
        let places = [(10.0, 20.0), (50.0, 21.0), (13.0, 80.0), (70.0, 90.0), (30.0, 40.0)];
        let seen = places.map(|(x, y)| DVec2::new(x, y)).map(|p| (p, motion(p)));
        let (centre, start, found) = fit(&seen);
        assert!((found.x_axis - slope.x_axis).length() + (found.y_axis - slope.y_axis).length() < 1e-9);
        assert!((start - motion(centre + 0.5)).length() < 1e-9);
        let (_, start, flat) = fit(&seen[..1]);
        assert_eq!((start, flat), (seen[0].1, DMat2::ZERO));
    }
}
