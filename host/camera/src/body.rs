//! What a camera sees into the poses of bodies that carry tags or markers.

use crate::constellation;
use crate::planar::poses_of_square;
use crate::pose::{Observation, PoseFit, Problem, Velocity};
use crate::sightings::{Expectation, Sightings};
use dpm_common::so3::so3_between;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec3};

/// A tag on a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TagPlace {
    /// Its number.
    pub id: u16,
    /// Length of a side of its black border, metres.
    pub side: f64,
    /// From the tag to the body. The tag's origin is its middle, with x to the right and y up as printed, and z towards who
    /// reads it.
    pub body_from_tag: DAffine3,
}

impl TagPlace {
    /// The corners of the border in the body: upper left, upper right, lower right, lower left as printed.
    pub fn corners(&self) -> [DVec3; 4] {
        let h = 0.5 * self.side;
        [(-h, h), (h, h), (h, -h), (-h, -h)]
            .map(|(x, y)| self.body_from_tag.transform_point3(DVec3::new(x, y, 0.0)))
    }
}

/// What of a body a camera can see.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Markings {
    /// Its tags, each with a number of its own.
    pub tags: Vec<TagPlace>,
    /// The middles of its bright markers, in the body, metres; none or at least 4.
    pub markers: Vec<DVec3>,
}

/// A body in the cameras' space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyPose {
    /// Its pose. The covariance reaches to the other pose that may be the true one.
    pub fit: PoseFit,
    /// The odds that another pose is the true one, 0 to 0.5.
    pub doubt: f64,
    /// How far the other pose is turned from this one, rad; 0 without another.
    pub apart: f64,
    /// Points that were used.
    pub points: usize,
}

impl BodyPose {
    /// Whether the pose may be used: no pose that is as good is turned away from it by more than a filter bears.
    pub fn is_certain(&self) -> bool {
        self.doubt < MOST_DOUBT || self.apart < SMALL_TURN
    }
}

/// A pose is doubtful if another one has more than these odds.
const MOST_DOUBT: f64 = 0.02;
/// Two poses that are turned by less, rad, are one pose of which the covariance says how uncertain it is.
const SMALL_TURN: f64 = 0.35;
/// Two results that differ by less are one.
const SAME_TURN: f64 = 1e-3;
const SAME_PLACE: f64 = 1e-5;
/// Tags from which the solver starts; the largest ones.
const MOST_STARTS: usize = 3;
/// Root mean square residual beyond which no pose explains what was seen, pixels. A rolling shutter of unknown motion stays below.
const MOST_OFF_PX: f64 = 6.0;

impl Markings {
    /// The pose of the body, from what the cameras saw at one instant; `None` if they saw too little of it, or what no
    /// single pose explains. `sightings`: one a camera.
    pub fn locate(
        &self,
        cameras: &[ProjectorCamera],
        sightings: &[Sightings<'_>],
        expected: Option<&Expectation>,
    ) -> Option<BodyPose> {
        let (observations, starts) = self.tag_observations(cameras, sightings);
        let velocity = expected.map_or(Velocity::default(), |e| e.velocity);
        if observations.len() >= 4 {
            let problem = Problem::new(cameras, &observations, velocity);
            return choose(&problem, &starts, expected);
        }
        if self.markers.len() >= constellation::LEAST {
            let (observations, starts) = constellation::find(&self.markers, cameras, sightings, expected)?;
            let problem = Problem::new(cameras, &observations, velocity);
            return choose(&problem, &starts, expected);
        }
        None
    }

    /// The corners of the tags that were seen, and poses from which to start, those of the largest tags first.
    fn tag_observations(
        &self,
        cameras: &[ProjectorCamera],
        sightings: &[Sightings<'_>],
    ) -> (Vec<Observation>, Vec<DAffine3>) {
        let (mut observations, mut starts) = (Vec::new(), Vec::new());
        for (camera, seen) in sightings.iter().enumerate() {
            for tag in seen.tags {
                let Some(place) = self.tags.iter().find(|t| t.id == tag.id) else { continue };
                let points = place.corners().into_iter().zip(tag.corners).zip(tag.sigma_px);
                observations.extend(points.map(|((body, pixel), sigma_px)| Observation {
                    body,
                    pixel,
                    sigma_px,
                    camera,
                    late_s: (pixel.y - seen.row) * seen.row_s,
                }));
                let size = (tag.corners[2] - tag.corners[0]).perp_dot(tag.corners[3] - tag.corners[1]).abs();
                if let Some(poses) =
                    cameras.get(camera).and_then(|c| poses_of_square(c, &tag.corners, place.side))
                {
                    starts.push((size, poses.map(|p| p * place.body_from_tag.inverse())));
                }
            }
        }
        starts.sort_by(|a, b| b.0.total_cmp(&a.0));
        (observations, starts.into_iter().take(MOST_STARTS).flat_map(|s| s.1).collect())
    }
}

/// The best pose that the solver reaches from the starts, and what speaks for the next best.
fn choose(problem: &Problem<'_>, starts: &[DAffine3], expected: Option<&Expectation>) -> Option<BodyPose> {
    let mut found: Vec<(PoseFit, f64)> = Vec::new();
    for start in expected.map(|e| e.pose).iter().chain(starts) {
        let Some(fit) = problem.refine(start) else { continue };
        let known = found.iter().any(|(other, _)| {
            so3_between(other.rotation, fit.rotation).length() < SAME_TURN
                && (other.position - fit.position).length() < SAME_PLACE * (1.0 + fit.position.length())
        });
        if !known {
            found.push((fit, fit.cost + expected.map_or(0.0, |e| e.against(&fit))));
        }
    }
    found.sort_by(|a, b| a.1.total_cmp(&b.1));
    let (mut fit, cost) = *found.first()?;
    if problem.deviation_px(&fit) > MOST_OFF_PX {
        return None;
    }
    let (mut doubt, mut apart) = (0.0f64, 0.0f64);
    for (other, worse) in &found[1..] {
        let odds = 1.0 / (1.0 + (worse - cost).exp());
        let by = fit.to(other);
        fit.widen(&by, odds);
        let turn = DVec3::from_slice(&by[3..]).length();
        if odds > doubt {
            (doubt, apart) = (odds, turn);
        }
    }
    Some(BodyPose { fit, doubt, apart, points: problem.observations.len() })
}
