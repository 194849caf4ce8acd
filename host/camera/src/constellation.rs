//! Which spot is which marker: a constellation of markers in a picture of bright spots.
//!
//! Near the expected pose each marker takes the spot that lies nearest to where it should be. Without an expectation, each
//! choice of three spots for three markers gives two poses by scaled orthography (\[Alter94\]), which the solver refines, and
//! the pose that explains most spots wins. Two poses that are equally good are refused.

use crate::blobs::SpotSighting;
use crate::pose::{Observation, PoseFit, Problem, Velocity};
use crate::sightings::{Expectation, Sightings};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DMat3, DVec2, DVec3};

/// Markers that must be seen.
pub(crate) const LEAST: usize = 4;
/// Markers that must be seen where nothing is expected: so many spots do not lie right by chance. A body that has fewer shows
/// all.
const LEAST_TO_BEGIN: usize = 5;
/// Spots that are tried where nothing is expected; the brightest.
const MOST_SPOTS: usize = 10;
/// Triples of markers that are tried.
const MOST_TRIPLES: usize = 4;
/// How far from its expected place a marker may be seen, pixels, at first and in the end.
const NEAR_PX: f64 = 25.0;
const CLOSE_PX: f64 = 1.5;

/// What was seen, and poses to start from; `None` if no spots are certainly those of the markers.
pub(crate) fn find(
    markers: &[DVec3],
    cameras: &[ProjectorCamera],
    sightings: &[Sightings<'_>],
    expected: Option<&Expectation>,
) -> Option<(Vec<Observation>, Vec<DAffine3>)> {
    let search = Search {
        markers,
        cameras,
        sightings,
        velocity: expected.map_or(Velocity::default(), |e| e.velocity),
    };
    if let Some(expected) = expected {
        let near = search.settle(&expected.pose, NEAR_PX, LEAST);
        if let Some((fit, observations)) = near {
            return Some((observations, vec![fit.to_affine()]));
        }
    }
    let (fit, observations) = search.everywhere()?;
    Some((observations, vec![fit.to_affine()]))
}

struct Search<'a> {
    markers: &'a [DVec3],
    cameras: &'a [ProjectorCamera],
    sightings: &'a [Sightings<'a>],
    velocity: Velocity,
}

impl Search<'_> {
    /// The spots that lie within `near` pixels of where a body at `pose` shows its markers, each of one marker only.
    fn matches(&self, pose: &DAffine3, near: f64) -> Vec<Observation> {
        let mut found = Vec::new();
        for (camera, (view, seen)) in self.cameras.iter().zip(self.sightings).enumerate() {
            let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
            for (m, marker) in self.markers.iter().enumerate() {
                let Some(pixel) = view.project(pose.transform_point3(*marker)) else { continue };
                let apart = |s: &SpotSighting| (s.centre - pixel).length();
                pairs.extend(
                    seen.spots.iter().enumerate().map(|(s, spot)| (apart(spot), m, s)).filter(|p| p.0 < near),
                );
            }
            pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
            let (mut used_markers, mut used_spots) = (0u64, 0u64);
            for (_, m, s) in pairs {
                if used_markers >> m & 1 == 0 && used_spots >> s & 1 == 0 {
                    used_markers |= 1 << m;
                    used_spots |= 1 << s;
                    let spot = &seen.spots[s];
                    found.push(Observation {
                        body: self.markers[m],
                        pixel: spot.centre,
                        sigma_px: spot.sigma_px,
                        camera,
                        late_s: (spot.centre.y - seen.row) * seen.row_s,
                    });
                }
            }
        }
        found
    }

    /// From a rough pose to one that explains at least `least` spots to within [`CLOSE_PX`].
    fn settle(&self, pose: &DAffine3, near: f64, least: usize) -> Option<(PoseFit, Vec<Observation>)> {
        let mut pose = *pose;
        let mut near = near;
        for _ in 0..6 {
            let observations = self.matches(&pose, near);
            if observations.len() < least {
                return None;
            }
            let fit = Problem::new(self.cameras, &observations, self.velocity).refine(&pose)?;
            pose = fit.to_affine();
            if near <= CLOSE_PX {
                let explained = 2.0 * fit.cost <= 25.0 + 6.0 * observations.len() as f64;
                return (explained && fit.outliers == 0).then_some((fit, observations));
            }
            near = (near * 0.3).max(CLOSE_PX);
        }
        None
    }

    /// The pose that explains most spots of all that three spots suggest; `None` if another one explains as many.
    fn everywhere(&self) -> Option<(PoseFit, Vec<Observation>)> {
        let least = LEAST_TO_BEGIN.min(self.markers.len());
        let mut best: Vec<(PoseFit, Vec<Observation>)> = Vec::new();
        for (camera, (view, seen)) in self.cameras.iter().zip(self.sightings).enumerate() {
            let spots = &seen.spots[..seen.spots.len().min(MOST_SPOTS)];
            let straight: Vec<Option<DVec2>> =
                spots.iter().map(|s| view.straight_of_pixel(s.centre)).collect();
            for markers in self.triples() {
                for choice in ordered_triples(spots.len()) {
                    let [Some(a), Some(b), Some(c)] = choice.map(|i| straight[i]) else { continue };
                    for start in
                        poses_of_triple(&markers.map(|m| self.markers[m]), &[a, b, c]).into_iter().flatten()
                    {
                        let start = view.world_from_projector * start;
                        let Some(found) = self.try_triple(camera, &markers, choice, &start, least) else {
                            continue;
                        };
                        let known = best.iter().any(|(fit, _)| {
                            let by = fit.to(&found.0);
                            by.iter().all(|d| d.abs() < 1e-3)
                        });
                        if !known {
                            best.push(found);
                        }
                    }
                }
            }
        }
        best.sort_by(|a, b| b.1.len().cmp(&a.1.len()).then(a.0.cost.total_cmp(&b.0.cost)));
        let rival = best.get(1).filter(|r| r.1.len() == best[0].1.len() && r.0.cost < best[0].0.cost + 8.0);
        if rival.is_some() {
            return None;
        }
        best.into_iter().next()
    }

    /// Refines a start on its three spots, then on all that fit.
    fn try_triple(
        &self,
        camera: usize,
        markers: &[usize; 3],
        spots: [usize; 3],
        start: &DAffine3,
        least: usize,
    ) -> Option<(PoseFit, Vec<Observation>)> {
        let seen = &self.sightings[camera];
        let observations: [Observation; 3] = std::array::from_fn(|i| {
            let spot = &seen.spots[spots[i]];
            let late_s = (spot.centre.y - seen.row) * seen.row_s;
            // Residuals beyond the knee of the loss would slow the solver down: far off at first.
            Observation { body: self.markers[markers[i]], pixel: spot.centre, sigma_px: 50.0, camera, late_s }
        });
        let fit = Problem::new(self.cameras, &observations, self.velocity).refine(start)?;
        if fit.cost > 0.01 {
            return None;
        }
        let pose = fit.to_affine();
        // Most wrong choices end here, without another step of the solver.
        (self.matches(&pose, 6.0).len() >= least).then(|| self.settle(&pose, 6.0, least)).flatten()
    }

    /// Triples of markers that span the largest triangles.
    fn triples(&self) -> Vec<[usize; 3]> {
        let n = self.markers.len();
        let all = (0..n).flat_map(|a| (a + 1..n).flat_map(move |b| (b + 1..n).map(move |c| [a, b, c])));
        let area = |t: &[usize; 3]| {
            let [a, b, c] = t.map(|i| self.markers[i]);
            (b - a).cross(c - a).length()
        };
        let mut all: Vec<[usize; 3]> = all.collect();
        all.sort_by(|a, b| area(b).total_cmp(&area(a)));
        // Not those of one marker only, which may be hidden.
        let mut chosen: Vec<[usize; 3]> = Vec::new();
        for t in all {
            let fresh = |c: &[usize; 3]| t.iter().filter(|m| c.contains(m)).count() < 3;
            if chosen.len() < MOST_TRIPLES && chosen.iter().all(fresh) {
                chosen.push(t);
            }
        }
        chosen
    }
}

/// All choices of three of `n` things in each order.
fn ordered_triples(n: usize) -> impl Iterator<Item = [usize; 3]> {
    (0..n)
        .flat_map(move |a| (0..n).flat_map(move |b| (0..n).map(move |c| [a, b, c])))
        .filter(|[a, b, c]| a != b && b != c && a != c)
}

/// The two poses in camera space from which three points are seen in these straight directions, if all of them are about as
/// far away (\[Alter94\]).
fn poses_of_triple(points: &[DVec3; 3], seen: &[DVec2; 3]) -> [Option<DAffine3>; 2] {
    let square = |v: DVec3| v.length_squared();
    let (r01, r02, r12) =
        (square(points[1] - points[0]), square(points[2] - points[0]), square(points[2] - points[1]));
    let flat = |i: usize, j: usize| (seen[i] - seen[j]).length_squared();
    let (d01, d02, d12) = (flat(1, 0), flat(2, 0), flat(2, 1));
    let sixteen_areas = |a: f64, b: f64, c: f64| 2.0 * (a * b + b * c + c * a) - a * a - b * b - c * c;
    let (a, c) = (sixteen_areas(r01, r02, r12), sixteen_areas(d01, d02, d12));
    let b = d01 * (r02 + r12 - r01) + d02 * (r01 + r12 - r02) + d12 * (r01 + r02 - r12);
    if a <= 0.0 {
        return [None, None];
    }
    let s2 = (b + (b * b - a * c).max(0.0).sqrt()) / a;
    let s = s2.sqrt();
    let (h1, h2) = ((s2 * r01 - d01).max(0.0).sqrt(), (s2 * r02 - d02).max(0.0).sqrt());
    let sign = if d01 + d02 - d12 <= s2 * (r01 + r02 - r12) { 1.0 } else { -1.0 };
    [1.0, -1.0].map(|side| {
        let depth = [0.0, side * h1, side * sign * h2].map(|h| (1.0 + h) / s);
        let there: [DVec3; 3] = std::array::from_fn(|i| DVec3::new(seen[i].x, -seen[i].y, -1.0) * depth[i]);
        let (from, to) = (frame(points)?, frame(&there)?);
        let rotation = to * from.transpose();
        let middle = |p: &[DVec3; 3]| (p[0] + p[1] + p[2]) / 3.0;
        Some(DAffine3::from_mat3_translation(rotation, middle(&there) - rotation * middle(points)))
    })
}

/// Axes along a triangle.
fn frame(p: &[DVec3; 3]) -> Option<DMat3> {
    let x = (p[1] - p[0]).try_normalize()?;
    let z = x.cross(p[2] - p[0]).try_normalize()?;
    Some(DMat3::from_cols(x, z.cross(x), z))
}
