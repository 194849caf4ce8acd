//! The bodies that move while the planes of a frame last: where their light can fall, and how they move there.

use super::gather::has_whole_codes;
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
    /// Bodies are drawn for instants that spread over a pixel of their motion, because planes show single bits of code values.
    /// Whole code values are interpolated, and the patterns of halftones belong to mirrors.
    spreads: bool,
    movers: Vec<Mover>,
    /// Per body: 0 if it is left as it was drawn, else the number of its mover, from 1 on.
    numbers: Vec<u32>,
    /// world-from-body of every body as it is drawn.
    poses: Vec<DAffine3>,
}

impl Movers {
    /// For a scene of `bodies` bodies whose planes are shown in `groups`; `are_codes`: the words of pixels are code values.
    pub(crate) fn new(bodies: usize, groups: &[PlaneGroup], are_codes: bool) -> Self {
        let reach = groups.iter().map(|g| g.instant.unsigned_abs()).max().unwrap_or(0);
        Self {
            reach: f64::from(reach) / 65536.0,
            spreads: are_codes && groups.iter().any(|group| !has_whole_codes(group.mask)),
            movers: Vec::with_capacity(bodies.min(MOST_MOVERS)),
            numbers: vec![0; bodies],
            poses: Vec::with_capacity(bodies),
        }
    }

    /// Finds the bodies that move, and marks in `tiles` where their light can fall. `poses` are those at the frame's instant,
    /// and `drawn` is the number of frames before it. Without a sweep nothing is known of motion.
    pub(crate) fn find(
        &mut self,
        camera: &ProjectorCamera,
        bodies: &[BodyData],
        poses: &[DAffine3],
        sweep: Option<Sweep<'_>>,
        drawn: u32,
        tiles: &mut TileList,
    ) {
        self.movers.clear();
        self.poses.clear();
        self.poses.extend_from_slice(poses);
        self.numbers.fill(0);
        let Some(sweep) = sweep.filter(|_| self.reach > 0.0) else { return };
        for (i, (body, pose)) in bodies.iter().zip(poses).enumerate() {
            let lit = body.flags & INSTANCE_EMPTY == 0 && body.flags & INSTANCE_PROJECTED != 0;
            let (Some(first), Some(last), true) = (sweep.first.get(i), sweep.last.get(i), lit) else {
                continue;
            };
            let Some((mover, area)) = self.mover(camera, tiles, body, [first, pose, last], drawn) else {
                continue;
            };
            if self.movers.len() < MOST_MOVERS {
                let share = f64::from(mover.instant) / 65536.0;
                self.poses[i].matrix3 += (last.matrix3 - first.matrix3) * share;
                self.poses[i].translation += (last.translation - first.translation) * share;
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

    /// world-from-body of every body as it is drawn.
    pub(crate) fn poses(&self) -> &[DAffine3] {
        &self.poses
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
        drawn: u32,
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
        let fastest = seen.iter().map(|(_, d)| d.length()).fold(0.0, f64::max);
        if fastest * self.reach < LEAST_MOTION_PX {
            return None;
        }
        let Spread { share, in_turn } = if self.spreads { Spread::over_a_pixel(seen) } else { Spread::NONE };
        let farthest = fastest * (self.reach + share / 2.0);
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
            instant: (share * turn_of(drawn) * 65536.0).round() as i32,
            in_turn,
        };
        Some((mover, area))
    }
}

/// Over which instants the pictures of a body spread from frame to frame.
///
/// A picture has one sample a pixel. If every frame were drawn for the centre of its light, a plane that is lit at another
/// instant would always find its places at the same fraction of a pixel: hard edges would be off by that fraction, or blurred
/// by taking the pixels around in turn. Instants that spread over one pixel of motion spread the fractions evenly. The nearest
/// pixel is then right on average for every plane, and half of the blur is gone ("subtractive dither").
struct Spread {
    /// Longest time between two of the instants, as a share of the exposure.
    share: f64,
    /// For columns and rows: 1 if the fractions of places do not spread over a pixel, so that frames take pixels in turn.
    in_turn: [u32; 2],
}

impl Spread {
    /// Every frame is drawn for the centre of its light.
    const NONE: Self = Self { share: 0.0, in_turn: [1; 2] };

    /// For a body that moves so at places. The planes of one that moves by less than a pixel during the exposure lie near
    /// together, and its instants would have to spread beyond the exposure.
    fn over_a_pixel(seen: &[(DVec2, DVec2)]) -> Self {
        let most = seen.iter().map(|(_, d)| d.abs().max_element()).fold(0.0, f64::max);
        if most < 1.0 {
            return Self::NONE;
        }
        let share = 1.0 / most;
        let is_pixel = |c: usize| seen.iter().all(|(_, d)| d[c].abs() * share >= LEAST_SPREAD_PX);
        Self { share, in_turn: [0, 1].map(|c| u32::from(!is_pixel(c))) }
    }
}

/// Fractions of places count as spread over a pixel from here on.
const LEAST_SPREAD_PX: f64 = 0.85;

/// The share of the spread of instants at which a frame lies, -1/2 to 1/2: multiples of the root of 3, which fill it evenly and
/// follow none of the turns in which pixels are taken.
fn turn_of(drawn: u32) -> f64 {
    f64::from(drawn.wrapping_mul(0xBB67_AE85)) / 4_294_967_296.0 - 0.5
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

    /// Whatever the fraction of a pixel at which a plane looks up its places, the nearest pixels of 31 frames, which an eye
    /// collects, lie around them evenly.
    #[test]
    fn pictures_of_a_body_spread_over_a_pixel() {
        let seen = [2.0, -1.9, 2.0].map(|x| (DVec2::ZERO, DVec2::new(x, 0.7)));
        let Spread { share, in_turn } = Spread::over_a_pixel(&seen);
        assert_eq!((share, in_turn), (0.5, [0, 1]), "rows are not crossed by a whole pixel");
        for (begin, fraction) in [(0, 0.1), (0, 0.5), (5000, 0.3), (u32::MAX - 9, 0.9)] {
            let off = |k: u32| {
                let place = fraction + 2.0 * share * turn_of(k.wrapping_add(begin));
                place.round() - place
            };
            let [mean, square] = [1, 2].map(|n| (0..31).map(|k| off(k).powi(n)).sum::<f64>() / 31.0);
            assert!(mean.abs() < 0.05, "{fraction}: nearest pixels are off by {mean} on average");
            assert!((square - 1.0 / 12.0).abs() < 0.02, "{fraction}: {square}");
        }
    }

    /// A body whose parts move differently takes pixels in turn, and one that moves little is drawn for the frame's instant.
    #[test]
    fn pixels_are_taken_in_turn_where_pictures_do_not_spread() {
        let turning = [2.0, 0.9].map(|x| (DVec2::ZERO, DVec2::new(x, 0.0)));
        assert_eq!(Spread::over_a_pixel(&turning).in_turn, [1, 1]);
        let slow = [(DVec2::ZERO, DVec2::new(0.99, 0.0))];
        let Spread { share, in_turn } = Spread::over_a_pixel(&slow);
        assert_eq!((share, in_turn), (0.0, [1, 1]));
    }

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
