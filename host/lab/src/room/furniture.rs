//! Where a camera stands that shows projector, observer and bodies, and what stands in the room besides the bodies.

use dpm_device::planes::Raster;
use dpm_rig::rig::{affine, Rig};
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec2, DVec3, Vec3};

/// Angle between the camera's line to the bodies and the projector's, degrees: the lit side is seen obliquely.
const ASIDE_DEG: f64 = 58.0;
/// The camera looks down by this angle, degrees.
const ABOVE_DEG: f64 = 20.0;
/// Its horizontal angle of view, degrees.
const FOV_DEG: f64 = 36.0;
/// Instants of a run at which the bodies' reach is measured.
const INSTANTS: i64 = 24;
/// Share of the picture that is filled.
const FILL: f64 = 0.94;

/// Colours of the projector's case and lens, and of the observer's eye.
const CASE: Vec3 = Vec3::new(0.20, 0.24, 0.34);
const LENS: Vec3 = Vec3::new(0.95, 0.95, 0.85);
const EYE: Vec3 = Vec3::new(0.85, 0.62, 0.48);
const IRIS: Vec3 = Vec3::new(0.12, 0.22, 0.30);

/// A sphere.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ball {
    /// World coordinates.
    pub centre: DVec3,
    /// Metres.
    pub radius: f64,
}

/// The box around the bodies that are lit, over all instants of the film.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds {
    lower: DVec3,
    upper: DVec3,
}

impl Bounds {
    /// Around the meshes of `rig` at each of `instants`, nanoseconds. `None`: the scene has no body that light falls on.
    pub(crate) fn around(rig: &Rig, instants: impl Iterator<Item = i64>) -> Option<Self> {
        let (mut lower, mut upper) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let mut poses: Vec<DAffine3> = Vec::new();
        for t_ns in instants {
            let rest = || rig.bodies.iter().map(|body| affine(&body.rest)).collect();
            rig.scene_poses(&rig.true_poses(t_ns).unwrap_or_else(rest), t_ns, &mut poses);
            for (body, pose) in rig.scene.bodies.iter().zip(&poses).filter(|(b, _)| b.projected) {
                // Some thousand points of a mesh show how far it reaches.
                let step = (body.mesh.positions.len() / 2048).max(1);
                for p in body.mesh.positions.iter().step_by(step) {
                    let p = pose.transform_point3(p.as_dvec3());
                    (lower, upper) = (lower.min(p), upper.max(p));
                }
            }
        }
        lower.is_finite().then_some(Self { lower, upper })
    }

    /// Around the bodies of a run of `length_ns`; at rest, where nobody knows where they are, and before the projector where
    /// there are none.
    pub(crate) fn of_run(rig: &Rig, length_ns: i64) -> Self {
        let ray = rig.camera.ray(middle(rig.camera.raster));
        let nothing = Ball { centre: ray.origin + ray.direction, radius: 0.1 };
        let instants = (0..INSTANTS).map(|i| i * length_ns / INSTANTS);
        Self::around(rig, instants).unwrap_or_else(|| Self::of_ball(nothing))
    }

    /// The box around a sphere.
    pub(crate) fn of_ball(ball: Ball) -> Self {
        Self {
            lower: ball.centre - DVec3::splat(ball.radius),
            upper: ball.centre + DVec3::splat(ball.radius),
        }
    }

    /// The sphere through its corners.
    pub(crate) fn ball(&self) -> Ball {
        let radius = ((self.upper - self.lower).length() * 0.5).max(1e-6);
        Ball { centre: (self.lower + self.upper) * 0.5, radius }
    }

    /// Its corners; bit i of a corner's number says which end of axis i.
    pub(crate) fn corners(&self) -> [DVec3; 8] {
        std::array::from_fn(|i| {
            let side = |axis: usize| if i >> axis & 1 == 0 { self.lower[axis] } else { self.upper[axis] };
            DVec3::new(side(0), side(1), side(2))
        })
    }
}

/// The camera that looks along `-back` and shows all points of `shown`, which fill the raster; `around` is one of them.
fn fitted(
    raster: Raster,
    fov_deg: f64,
    back: DVec3,
    around: DVec3,
    shown: &[DVec3],
) -> Option<ProjectorCamera> {
    let farthest = shown.iter().map(|p| p.distance(around)).fold(1e-6, f64::max);
    let (mut look_at, mut distance) = (around, 3.0 * farthest);
    let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
    let across = DVec3::Y.cross(back).try_normalize().unwrap_or(DVec3::X);
    let upward = back.cross(across);
    let mut found = None;
    for _ in 0..60 {
        let position = look_at + back * distance;
        let camera =
            ProjectorCamera::look_at(raster, position, look_at, upward, fov_deg.to_radians()).ok()?;
        let Some((lower, upper)) = reach(&camera, shown) else {
            distance *= 1.5;
            continue;
        };
        // To the middle of what is seen, and as near as all of it allows.
        let apart = ((lower + upper) - size) * 0.5 / camera.fx * distance;
        look_at += across * apart.x - upward * apart.y;
        distance *= (((upper - lower) / size).max_element() / FILL).clamp(0.5, 2.0).sqrt();
        found = Some(camera);
    }
    found
}

/// The smallest rectangle of pixels with all of `shown`; `None` if one of them is behind the camera.
fn reach(camera: &ProjectorCamera, shown: &[DVec3]) -> Option<(DVec2, DVec2)> {
    let seen: Option<Vec<DVec2>> = shown.iter().map(|p| camera.project(*p)).collect();
    Some(seen?.iter().fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(l, u), p| (l.min(*p), u.max(*p))))
}

/// A camera at the observer's eye that shows the bodies.
pub(crate) fn observer_camera(bodies: Bounds, eye: DVec3, raster: Raster) -> Option<ProjectorCamera> {
    let ball = bodies.ball();
    let size = DVec2::new(f64::from(raster.width()), f64::from(raster.height()));
    let mut look_at = ball.centre;
    let mut fov = 2.0 * (ball.radius / (eye - ball.centre).length().max(1.05 * ball.radius)).asin();
    let mut found = None;
    for _ in 0..40 {
        let camera = ProjectorCamera::look_at(raster, eye, look_at, DVec3::Y, fov.clamp(0.01, 2.8)).ok()?;
        // Where the bodies reach around the eye, all that the camera can show is shown.
        let Some((lower, upper)) = reach(&camera, &bodies.corners()) else { return found.or(Some(camera)) };
        let away = (look_at - eye).length();
        let ray = camera.ray((lower + upper) * 0.5);
        look_at = eye + ray.direction * away;
        let filled = ((upper - lower) / size).max_element() / FILL;
        fov = 2.0 * ((0.5 * fov).tan() * filled.clamp(0.5, 2.0)).atan();
        found = Some(camera);
    }
    found
}

fn middle(raster: Raster) -> DVec2 {
    DVec2::new(f64::from(raster.width()), f64::from(raster.height())) * 0.5
}

/// A direction across `axis`, or +Z where that is upright.
fn level(axis: DVec3) -> DVec3 {
    DVec3::new(axis.x, 0.0, axis.z).try_normalize().unwrap_or(DVec3::Z)
}

/// A camera that shows the bodies, the projector and the observer's eye.
pub(crate) fn camera(rig: &Rig, bodies: Bounds, eye: DVec3, raster: Raster) -> Option<ProjectorCamera> {
    let (projector, ball) = (rig.camera.position(), bodies.ball());
    let axis = level(projector - ball.centre);
    let right = DVec3::Y.cross(axis);
    // The observer stands behind the projector's light, as the camera sees it.
    let side = if right.dot(eye - ball.centre) > 0.0 { -right } else { right };
    let (aside, above) = (ASIDE_DEG.to_radians(), ABOVE_DEG.to_radians());
    let back = (axis * aside.cos() + side * aside.sin()) * above.cos() + DVec3::Y * above.sin();
    let scale = reach_of(rig, ball);
    let head = Bounds::of_ball(Ball { centre: eye, radius: 0.06 * scale });
    let shown = [bodies.corners(), case_corners(rig, ball), head.corners()].concat();
    fitted(raster, FOV_DEG, back, ball.centre.lerp(projector, 0.4), &shown)
}

/// How far the projector stands from the bodies, or what fills a room where it stands among them.
fn reach_of(rig: &Rig, bodies: Ball) -> f64 {
    (rig.camera.position() - bodies.centre).length().max(bodies.radius)
}

/// Half of the sides of the projector's case, metres, in a room of this reach.
fn case_of(reach: f64) -> DVec3 {
    DVec3::new(0.055, 0.035, 0.075) * reach
}

/// The corners of the projector's case, whose front is at the lens.
fn case_corners(rig: &Rig, bodies: Ball) -> [DVec3; 8] {
    let half = case_of(reach_of(rig, bodies));
    let case = Bounds { lower: DVec3::Z * half.z - half, upper: DVec3::Z * half.z + half };
    case.corners().map(|corner| rig.camera.world_from_projector.transform_point3(corner))
}

/// A thing of the room that a ray meets: how far, its normal, and what colour it has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Furniture {
    /// Metres along the ray.
    pub distance: f64,
    /// Reflectance, 0 to 1.
    pub albedo: Vec3,
    /// World.
    pub normal: DVec3,
}

/// The projector's case, the observer's head and the floor.
pub(crate) struct Room {
    projector_from_world: DAffine3,
    /// Half of the case's sides, metres; its front is at the lens.
    case: DVec3,
    head: Ball,
    floor: f64,
    /// Lines of the floor are so far apart, metres.
    grid: f64,
    bodies: Ball,
}

impl Room {
    pub(crate) fn new(rig: &Rig, bodies: Ball, eye: DVec3) -> Self {
        let reach = reach_of(rig, bodies);
        let case = case_of(reach);
        // Ten lines or so across the bodies, at a distance that a ruler has.
        let wanted = bodies.radius * 0.35;
        let decade = 10f64.powf(wanted.log10().floor());
        let grid = [1.0, 2.0, 5.0].map(|m| m * decade).into_iter().rfind(|g| *g <= wanted).unwrap_or(decade);
        Self {
            projector_from_world: rig.camera.world_from_projector.inverse(),
            case,
            head: Ball { centre: eye, radius: 0.045 * reach },
            floor: bodies.centre.y - 1.05 * bodies.radius,
            grid,
            bodies,
        }
    }

    /// Where the observer's head is now.
    pub(crate) fn see_from(&mut self, eye: DVec3) {
        self.head.centre = eye;
    }

    /// The nearest thing on the ray from `origin`; `gaze` is where the observer looks.
    pub(crate) fn meet(&self, origin: DVec3, direction: DVec3, gaze: DVec3) -> Option<Furniture> {
        let things =
            [self.case(origin, direction), self.head(origin, direction, gaze), self.floor(origin, direction)];
        things.into_iter().flatten().min_by(|a, b| a.distance.total_cmp(&b.distance))
    }

    fn case(&self, origin: DVec3, direction: DVec3) -> Option<Furniture> {
        // In the projector's space light leaves against its third axis.
        let (o, d) = (
            self.projector_from_world.transform_point3(origin) - DVec3::Z * self.case.z,
            self.projector_from_world.transform_vector3(direction),
        );
        let (a, b) = ((-self.case - o) / d, (self.case - o) / d);
        let (near, far) = (a.min(b), a.max(b));
        let (enter, leave) = (near.max_element(), far.min_element());
        if !(enter > 0.0 && enter <= leave) {
            return None;
        }
        let at = (o + d * enter) / self.case;
        let face = if at.x.abs() >= at.y.abs().max(at.z.abs()) {
            DVec3::X * at.x.signum()
        } else if at.y.abs() >= at.z.abs() {
            DVec3::Y * at.y.signum()
        } else {
            DVec3::Z * at.z.signum()
        };
        let is_lens = face.z < -0.5 && DVec2::new(at.x * self.case.x / self.case.y, at.y).length() < 0.6;
        let normal = self.projector_from_world.inverse().transform_vector3(face);
        Some(Furniture { distance: enter, albedo: if is_lens { LENS } else { CASE }, normal })
    }

    fn head(&self, origin: DVec3, direction: DVec3, gaze: DVec3) -> Option<Furniture> {
        let to = origin - self.head.centre;
        let half = to.dot(direction);
        let under = half * half - (to.length_squared() - self.head.radius * self.head.radius);
        let distance = -half - under.max(0.0).sqrt();
        if under < 0.0 || distance <= 0.0 {
            return None;
        }
        let normal = (origin + direction * distance - self.head.centre) / self.head.radius;
        let ahead = (gaze - self.head.centre).try_normalize().unwrap_or(DVec3::NEG_Z);
        // White of the eye, iris, pupil.
        let albedo = match normal.dot(ahead) {
            c if c > 0.93 => Vec3::splat(0.02),
            c if c > 0.78 => IRIS,
            _ => EYE,
        };
        Some(Furniture { distance, albedo, normal })
    }

    fn floor(&self, origin: DVec3, direction: DVec3) -> Option<Furniture> {
        let distance = (self.floor - origin.y) / direction.y;
        if !(distance > 0.0 && distance.is_finite()) {
            return None;
        }
        let at = origin + direction * distance;
        let from_bodies = DVec2::new(at.x - self.bodies.centre.x, at.z - self.bodies.centre.z).length();
        let near = (-0.5 * (from_bodies / (3.0 * self.bodies.radius)).powi(2)).exp();
        // A pixel is about so wide on the floor.
        let pixel = 1.5e-3 * distance / direction.y.abs().max(0.05);
        let line = |x: f64| {
            let off = (x / self.grid - (x / self.grid).round()).abs() * self.grid;
            (1.0 - off / pixel).clamp(0.0, 1.0)
        };
        let on_line = line(at.x).max(line(at.z)) * (pixel * 6.0 < self.grid) as u8 as f64;
        let albedo = Vec3::splat((near * (0.10 + 0.16 * on_line)) as f32);
        Some(Furniture { distance, albedo, normal: DVec3::Y })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::config::{Overrides, RigConfig};

    /// The demo's rig on a raster without a GPU.
    fn demo() -> Rig {
        Rig::build(&RigConfig::demo(&Overrides::default()).unwrap(), Raster::new(64, 48)).unwrap()
    }

    #[test]
    fn the_room_shows_bodies_projector_and_observer_wherever_they_stand() {
        let rig = demo();
        let raster = Raster::new(400, 300).unwrap();
        let bodies = Bounds::around(&rig, (0..4).map(|i| i * 100_000_000)).unwrap();
        for eye in [DVec3::new(0.25, 0.35, 1.0), DVec3::new(-1.0, 1.5, 0.2), DVec3::new(0.0, 0.1, 3.0)] {
            let camera = camera(&rig, bodies, eye, raster).unwrap();
            let case = case_corners(&rig, bodies.ball());
            for shown in [bodies.ball().centre, rig.camera.position(), eye].into_iter().chain(case) {
                let at = camera.project(shown).unwrap();
                assert!(
                    at.x > 0.0 && at.y > 0.0 && at.x < 400.0 && at.y < 300.0,
                    "{shown} at {at}, seen from {}",
                    camera.position()
                );
            }
        }
    }

    #[test]
    fn the_observers_picture_is_filled_by_the_bodies() {
        let rig = demo();
        let raster = Raster::new(240, 168).unwrap();
        let bodies = Bounds::around(&rig, (0..4).map(|i| i * 100_000_000)).unwrap();
        for eye in [DVec3::new(0.25, 0.35, 1.0), DVec3::new(-2.0, 0.5, 1.0)] {
            let camera = observer_camera(bodies, eye, raster).unwrap();
            let (lower, upper) = reach(&camera, &bodies.corners()).unwrap();
            let filled = ((upper - lower) / DVec2::new(240.0, 168.0)).max_element();
            assert!((filled - FILL).abs() < 0.02 && lower.min_element() > 0.0, "{filled} {lower} {upper}");
        }
    }

    #[test]
    fn a_ray_at_the_lens_meets_the_case_and_one_at_the_eye_the_head() {
        let rig = demo();
        let bodies = Bounds::around(&rig, std::iter::once(0)).unwrap().ball();
        let eye = DVec3::new(0.6, 0.35, 1.0);
        let room = Room::new(&rig, bodies, eye);
        for (target, radius) in [(rig.camera.position(), 0.0), (eye, room.head.radius)] {
            let direction = (target - bodies.centre).normalize();
            let met = room.meet(bodies.centre, direction, bodies.centre).unwrap();
            let expected = (target - bodies.centre).length() - radius;
            assert!((met.distance - expected).abs() < 1e-6, "{} {expected}", met.distance);
        }
    }
}
