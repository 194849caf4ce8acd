//! Whether a rig can give light at all, judged by its sizes, distances and sides before there is any: a mesh in millimetres, a
//! mesh that lies kilometres from its body, one that is turned inside out, a projector or a body that is out of reach because
//! somebody gave centimetres. What is told names the unit that would fit.

use super::Rig;
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::TriangleMesh;
use glam::{DAffine3, DVec3};
use std::fmt;

/// Sizes of bodies before a projector, metres: the longest side.
const SIZES_M: std::ops::RangeInclusive<f64> = 0.002..=20.0;
/// Sizes that a unit must make of a mesh to be named as the right one, and the most usual of them.
const USUAL_SIZES_M: (std::ops::RangeInclusive<f64>, f64) = (0.03..=4.0, 0.3);
/// Distances between a projector and what it lights.
const DISTANCES_M: std::ops::RangeInclusive<f64> = 0.03..=30.0;
/// Distances that a unit must make to be named as the right one, and the most usual of them.
const USUAL_DISTANCES_M: (std::ops::RangeInclusive<f64>, f64) = (0.25..=10.0, 1.2);
/// A mesh lies far from its body's origin beyond so many of its own sizes, and beyond so many metres.
const FAR: (f64, f64) = (10.0, 3.0);
/// Pixels across, below which nothing can be seen on a body.
const LEAST_PX: f64 = 4.0;
/// Points of a body that are looked at.
const POINTS: usize = 64;
/// Instants of a known motion that are looked at, and the time between two, nanoseconds.
const INSTANTS: i64 = 24;
const INSTANT_NS: i64 = 500_000_000;
/// Share of a closed surface's area that its sides may leave open.
const OPEN: f64 = 0.02;
/// Share of a box's volume that a closed surface encloses at least.
const ENCLOSED: f64 = 1e-3;

/// Units with their names in metres.
const UNITS: [(f64, &str); 4] =
    [(1e-3, "millimetres"), (1e-2, "centimetres"), (0.0254, "inches"), (1e3, "kilometres")];

/// How the text of every doubt begins: those of a rig that is built anew take the place of the old ones.
pub(crate) const MARK: &str = "doubtful: ";

/// Something that makes light unlikely.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Doubt {
    /// What it is about: a body's name, or the projector.
    pub about: String,
    /// What was found.
    pub told: String,
    /// What to do.
    pub remedy: String,
}

impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{MARK}{}: {}; {}", self.about, self.told, self.remedy)
    }
}

/// A body as the projector meets it.
struct MetBody {
    name: String,
    /// Points of its surface, in the space of what the tracker reports, metres.
    points: Vec<DVec3>,
    /// Box around all of its vertices there.
    low: DVec3,
    high: DVec3,
}

impl MetBody {
    fn longest(&self) -> f64 {
        (self.high - self.low).max_element()
    }

    /// Distance from the body's origin to the box.
    fn distance_from_origin(&self) -> f64 {
        DVec3::ZERO.clamp(self.low, self.high).length()
    }
}

/// The tracked body `tracked` of a rig; `None` if no light falls on it.
fn shape(rig: &Rig, tracked: usize) -> Option<MetBody> {
    let body = rig.bodies.get(tracked)?;
    let meshes = rig.scene.bodies.iter().filter(|b| b.tracked == Some(tracked as u16) && b.projected);
    let whole: Vec<&TriangleMesh> = meshes.filter(|b| b.is_whole()).map(|b| &b.mesh).collect();
    let count: usize = whole.iter().map(|mesh| mesh.positions.len()).sum();
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let mut points = Vec::new();
    let step = count.div_ceil(POINTS).max(1);
    for (i, p) in whole.iter().flat_map(|mesh| &mesh.positions).enumerate() {
        let p = body.mesh_to_body.transform_point3(p.as_dvec3());
        (low, high) = (low.min(p), high.max(p));
        if i % step == 0 {
            points.push(p);
        }
    }
    (!points.is_empty()).then(|| MetBody { name: body.name.clone(), points, low, high })
}

/// What the projector shows of a body at one place.
#[derive(Clone, Copy, Debug)]
struct BodyView {
    /// Metres to the nearest point.
    distance: f64,
    /// Columns and rows between its outermost points.
    size_px: [f64; 2],
    /// Whether it lies within the raster, or within half a raster around it.
    is_near: bool,
}

fn view(camera: &ProjectorCamera, points: &[DVec3], place: &DAffine3) -> BodyView {
    let (width, height) = (f64::from(camera.raster.width()), f64::from(camera.raster.height()));
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let mut distance = f64::INFINITY;
    for p in points {
        let p = place.transform_point3(*p);
        distance = distance.min(p.distance(camera.position()));
        let Some(at) = camera.project(p) else { continue };
        low = [low[0].min(at.x), low[1].min(at.y)];
        high = [high[0].max(at.x), high[1].max(at.y)];
    }
    let is_near =
        high[0] > -0.5 * width && low[0] < 1.5 * width && high[1] > -0.5 * height && low[1] < 1.5 * height;
    let size_px = [0, 1].map(|i| (high[i] - low[i]).max(0.0));
    BodyView { distance, size_px, is_near }
}

/// The unit that makes a length the most usual one, with its metres; `None` if none makes it usual.
fn fitting(
    length: impl Fn(f64) -> Option<f64>,
    (usual, best): &(std::ops::RangeInclusive<f64>, f64),
) -> Option<(f64, &'static str)> {
    let off = |metres: f64| Some((length(metres).filter(|l| usual.contains(l))? / best).ln().abs());
    let fitting = UNITS.into_iter().filter_map(|(metres, name)| Some((off(metres)?, (metres, name))));
    fitting.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, unit)| unit)
}

fn metres(length: f64) -> String {
    match length {
        l if l >= 1e4 => format!("{:.1} km", 1e-3 * l),
        l if l >= 100.0 => format!("{l:.0} m"),
        l if l >= 0.01 => format!("{l:.2} m"),
        l => format!("{:.2} mm", 1e3 * l),
    }
}

/// Doubts about the sizes and sides of the bodies of a rig, and about its distances where the motions are known.
pub fn doubts(rig: &Rig) -> Vec<Doubt> {
    let mut all: Vec<Doubt> = Vec::new();
    for tracked in 0..rig.bodies.len() {
        all.extend(shape(rig, tracked).iter().flat_map(of_shape));
    }
    all.extend(inside_out(rig));
    let instants = (0..INSTANTS).map(|i| rig.true_poses(i * INSTANT_NS));
    if let Some(places) = instants.collect::<Option<Vec<_>>>() {
        all.extend(of_places(rig, &places));
    }
    all
}

fn of_shape(shape: &MetBody) -> Vec<Doubt> {
    let mut all = Vec::new();
    let about = format!("body \"{}\"", shape.name);
    let size = shape.longest();
    if !SIZES_M.contains(&size) {
        let (told, remedy) = match fitting(|unit| Some(size * unit), &USUAL_SIZES_M) {
            Some((unit, name)) => (
                format!("it is {} long, and no raster covers that: {name}?", metres(size)),
                format!("set scene.scale = {unit} if they are"),
            ),
            None => (format!("it is {} long", metres(size)), "correct its size by scene.scale".into()),
        };
        all.push(Doubt { about: about.clone(), told, remedy });
    }
    let far = shape.distance_from_origin();
    if far > FAR.0 * size && far > FAR.1 {
        all.push(Doubt {
            about,
            told: format!(
                "its mesh lies {} from its body's origin, about which the tracker turns it",
                metres(far)
            ),
            remedy: "move the mesh to its origin where it was made, or set scene.bodies[].mesh_to_body"
                .into(),
        });
    }
    all
}

/// Rays at a body that find out which sides of it the projector sees, the instants at which they are cast, and the most triangles
/// that they are held to.
const RAYS: usize = 64;
const RAY_INSTANTS: usize = 6;
const RAY_TESTS: usize = 20_000_000;
/// Share of rays that a body's fronts stop at least.
const FRONTS: f64 = 0.03;

/// A triangle in the space of its body, and whether its back is lit.
struct Face {
    corners: [DVec3; 3],
    has_back: bool,
}

fn faces(rig: &Rig, tracked: usize) -> Vec<Face> {
    let Some(body) = rig.bodies.get(tracked) else { return vec![] };
    let meshes = rig.scene.bodies.iter().filter(|b| b.tracked == Some(tracked as u16) && b.projected);
    let of_mesh = |mesh: &TriangleMesh| {
        let at = |i: u32| body.mesh_to_body.transform_point3(mesh.positions[i as usize].as_dvec3());
        let look = |m: &u32| rig.scene.materials.get(*m as usize);
        let has_back = |m: &u32| look(m).is_none_or(|m| m.double_sided || m.transmission > 0.0);
        let both = mesh.triangles.iter().zip(&mesh.materials);
        both.map(|(t, m)| Face { corners: t.map(at), has_back: has_back(m) }).collect::<Vec<_>>()
    };
    meshes.filter(|b| b.is_whole()).flat_map(|b| of_mesh(&b.mesh)).collect()
}

/// Whether the first surface that rays from the projector to the body meet is a back that stays dark, for nearly all rays at all of the
/// places: for open surfaces, whose volume says nothing.
fn shows_only_backs(faces: &[Face], projector: DVec3, places: &[&DAffine3]) -> bool {
    if faces.iter().all(|face| face.has_back) {
        return false;
    }
    let rays = RAYS.min(RAY_TESTS / faces.len().max(1)).max(8);
    let step = faces.len().div_ceil(rays).max(1);
    let only_backs = |place: &DAffine3| {
        let from = place.inverse().transform_point3(projector);
        let mut fronts = 0;
        let mut cast = 0;
        for target in faces.iter().step_by(step) {
            cast += 1;
            let [a, b, c] = target.corners;
            fronts += usize::from(stops_at_front(faces, from, (a + b + c) / 3.0 - from));
            if fronts as f64 > FRONTS * rays as f64 {
                return false;
            }
        }
        fronts as f64 <= FRONTS * f64::from(cast)
    };
    let some = places.len().div_ceil(RAY_INSTANTS).max(1);
    places.iter().step_by(some).all(|place| only_backs(place))
}

/// Whether the nearest face that a ray meets can be lit from its origin.
fn stops_at_front(faces: &[Face], from: DVec3, towards: DVec3) -> bool {
    let mut nearest = (f64::INFINITY, false);
    for face in faces {
        let [a, b, c] = face.corners;
        let (ab, ac) = (b - a, c - a);
        let normal = ab.cross(ac);
        let facing = -towards.dot(normal);
        if facing == 0.0 {
            continue;
        }
        let away = from - a;
        let t = away.dot(normal) / facing;
        let across = away.cross(towards);
        let (u, v) = (ac.dot(across) / facing, -ab.dot(across) / facing);
        // Wide by rounding, so that a ray to a corner's neighbour is not lost in a seam.
        if t > 0.0 && t < nearest.0 && u >= -1e-9 && v >= -1e-9 && u + v <= 1.0 + 1e-9 {
            nearest = (t, face.has_back || facing > 0.0);
        }
    }
    nearest.1
}

/// Bodies whose surfaces are closed, have one side, and show their backs.
fn inside_out(rig: &Rig) -> Vec<Doubt> {
    // A room that does not move is seen from its inside.
    let is_out = |body: &&dpm_scene::Body| {
        body.projected && body.tracked.is_some() && body.is_whole() && turned(rig, &body.mesh)
    };
    let told = |body: &dpm_scene::Body| Doubt {
        about: format!("body \"{}\"", body.name),
        told:
            "its mesh is turned inside out and single-sided: all light falls on its back, and it stays black"
                .into(),
        remedy: "flip its faces where it was made, or make its material double-sided".into(),
    };
    rig.scene.bodies.iter().filter(is_out).map(told).collect()
}

/// Whether a mesh is closed, encloses a negative volume, and has one side.
fn turned(rig: &Rig, mesh: &TriangleMesh) -> bool {
    let materials = &rig.scene.materials;
    let is_single =
        |m: &u32| materials.get(*m as usize).is_some_and(|m| !m.double_sided && m.transmission == 0.0);
    if mesh.triangles.is_empty() || !mesh.materials.iter().all(is_single) {
        return false;
    }
    let at = |i: u32| mesh.positions[i as usize].as_dvec3();
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for p in &mesh.positions {
        (low, high) = (low.min(p.as_dvec3()), high.max(p.as_dvec3()));
    }
    let middle = 0.5 * (low + high);
    let (mut open, mut area, mut volume) = (DVec3::ZERO, 0.0, 0.0);
    for &[a, b, c] in &mesh.triangles {
        let [a, b, c] = [a, b, c].map(|i| at(i) - middle);
        let normal = 0.5 * (b - a).cross(c - a);
        open += normal;
        area += normal.length();
        volume += a.dot(b.cross(c)) / 6.0;
    }
    let sides = high - low;
    let whole = sides.x * sides.y * sides.z;
    open.length() < OPEN * area && volume < -ENCLOSED * whole
}

/// Doubts about where the tracked bodies are: `places` has for each instant the world-from-body pose of each. A body that is
/// within reach at one of them is within reach.
pub fn of_places(rig: &Rig, places: &[Vec<DAffine3>]) -> Vec<Doubt> {
    let camera = &rig.camera;
    let scale = f64::from(rig.config.projector.width) / f64::from(camera.raster.width());
    let mut all: Vec<Doubt> = Vec::new();
    for tracked in 0..rig.bodies.len() {
        // A mesh of a doubtful size or place says nothing of where its body is.
        let Some(shape) = shape(rig, tracked).filter(|shape| of_shape(shape).is_empty()) else { continue };
        let of_body: Vec<&DAffine3> = places.iter().filter_map(|at| at.get(tracked)).collect();
        let seen: Vec<(BodyView, &DAffine3)> =
            of_body.iter().map(|place| (view(camera, &shape.points, place), *place)).collect();
        // The instant at which it is best within reach.
        let best = seen.iter().max_by(|a, b| {
            let key = |v: &BodyView| (v.is_near, v.size_px[0] * v.size_px[1]);
            key(&a.0).partial_cmp(&key(&b.0)).unwrap_or(std::cmp::Ordering::Equal)
        });
        let Some((best, place)) = best else { continue };
        let is_turned = |b: &dpm_scene::Body| b.tracked == Some(tracked as u16) && turned(rig, &b.mesh);
        if !rig.scene.bodies.iter().any(is_turned)
            && shows_only_backs(&faces(rig, tracked), camera.position(), &of_body)
        {
            all.push(Doubt {
                about: format!("body \"{}\"", shape.name),
                told: "the projector sees only backs of its single-sided surface, which stay black".into(),
                remedy: "flip its faces where it was made, make its material double-sided, or turn the body"
                    .into(),
            });
        }
        let far = !DISTANCES_M.contains(&best.distance);
        let across = scale * best.size_px[0].max(best.size_px[1]);
        if best.is_near && !far && across >= LEAST_PX {
            continue;
        }
        all.push(of_place(rig, &shape, place, (best, across)));
    }
    // The projector's place is one, whichever body shows it.
    let mut is_first = true;
    all.retain(|doubt| doubt.about != "projector" || std::mem::take(&mut is_first));
    all
}

/// The doubt about a body that is not within the projector's reach, or that is `across` pixels wide there.
fn of_place(rig: &Rig, shape: &MetBody, place: &DAffine3, (best, across): (&BodyView, f64)) -> Doubt {
    let about = format!("body \"{}\"", shape.name);
    match (projector_unit(rig, shape, place, best.distance), tracker_unit(rig, shape, place)) {
        (Some((unit, name)), _) => Doubt {
            about: "projector".into(),
            told: format!(
                "it stands {} from the bodies, {} times too far: {name}?",
                metres(best.distance),
                (1.0 / unit).round()
            ),
            remedy: match rig.config.projector.calibration {
                Some(_) => "correct projector.calibration_unit".into(),
                None => "give projector.position in metres".into(),
            },
        },
        (None, Some((_, name))) => Doubt {
            about,
            told: format!("{}, out of the projector's reach: {name}?", at_place(place)),
            remedy: "set the tracking software to metres".into(),
        },
        (None, None) if !best.is_near => Doubt {
            about,
            told: format!("{}, out of the projector's reach", at_place(place)),
            remedy: "check the tracker's axes, units and handedness, and the projector's pose".into(),
        },
        (None, None) => Doubt {
            about,
            told: format!("the projector covers it with {across:.1} pixels from {}", metres(best.distance)),
            remedy: "check the projector's pose and the size of the mesh (scene.scale)".into(),
        },
    }
}

fn at_place(place: &DAffine3) -> String {
    let p = place.translation;
    format!("it is at ({:.3}, {:.3}, {:.3}) m", p.x, p.y, p.z)
}

/// The unit in which the projector's place would make sense, if it is too far away.
fn projector_unit(
    rig: &Rig,
    shape: &MetBody,
    place: &DAffine3,
    distance: f64,
) -> Option<(f64, &'static str)> {
    if distance < *DISTANCES_M.end() || place.translation.length() > *USUAL_DISTANCES_M.0.end() {
        return None;
    }
    let distance_by = |unit: f64| {
        let mut camera = rig.camera;
        camera.world_from_projector.translation *= unit;
        let view = view(&camera, &shape.points, place);
        (view.is_near && unit < 1.0).then_some(view.distance)
    };
    fitting(distance_by, &USUAL_DISTANCES_M)
}

/// The unit in which a body's place would be within reach.
fn tracker_unit(rig: &Rig, shape: &MetBody, place: &DAffine3) -> Option<(f64, &'static str)> {
    if place.translation.length() < 10.0 {
        return None;
    }
    let distance_by = |unit: f64| {
        let mut place = *place;
        place.translation *= unit;
        let view = view(&rig.camera, &shape.points, &place);
        (view.is_near && unit < 1.0).then_some(view.distance)
    };
    fitting(distance_by, &USUAL_DISTANCES_M)
}

/// How the raster covers each body at the given places, one part of a sentence each.
pub fn coverage(rig: &Rig, places: &[DAffine3]) -> Vec<String> {
    let scale = f64::from(rig.config.projector.width) / f64::from(rig.camera.raster.width());
    let told = |(tracked, place): (usize, &DAffine3)| {
        let shape = shape(rig, tracked)?;
        let view = view(&rig.camera, &shape.points, place);
        let [columns, rows] = view.size_px.map(|px| px * scale);
        Some(format!("\"{}\" {columns:.0} x {rows:.0} pixels at {}", shape.name, metres(view.distance)))
    };
    places.iter().enumerate().take(rig.bodies.len()).filter_map(told).collect()
}

/// Watches for two bodies that change places from one sample to the next, as markers that are too alike make them.
#[derive(Clone, Debug, Default)]
pub struct Exchanges {
    last: Vec<Option<DVec3>>,
    /// Where each body was before its last jump.
    before: Vec<Option<DVec3>>,
    /// The pairs that did, and how often.
    pub pairs: Vec<([usize; 2], u32)>,
}

/// A step between two samples that is a jump, metres, and how near a body must then be to where another was.
const JUMP_M: f64 = 0.1;
const SAME_M: f64 = 0.03;

impl Exchanges {
    /// Takes the newest place of a body.
    pub fn observe(&mut self, body: usize, at: DVec3) {
        if self.last.len() <= body {
            self.last.resize(body + 1, None);
            self.before.resize(body + 1, None);
        }
        let was = self.last[body].replace(at);
        let Some(was) = was else { return };
        if was.distance(at) < JUMP_M {
            return;
        }
        self.before[body] = Some(was);
        let is_swap = |other: usize| {
            let (Some(there), Some(then)) = (self.last[other], self.before[other]) else { return false };
            other != body && there.distance(was) < SAME_M && then.distance(at) < SAME_M
        };
        let Some(other) = (0..self.last.len()).find(|other| is_swap(*other)) else { return };
        (self.before[body], self.before[other]) = (None, None);
        let pair = [body.min(other), body.max(other)];
        match self.pairs.iter_mut().find(|(known, _)| *known == pair) {
            Some((_, count)) => *count += 1,
            None => self.pairs.push((pair, 1)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use dpm_device::planes::Raster;
    use std::path::{Path, PathBuf};

    fn demo(flags: &[String]) -> Rig {
        let overrides = Overrides { variables: vec![], flags: flags.to_vec() };
        let config = RigConfig::demo(&overrides).unwrap_or_else(|e| panic!("{e}"));
        Rig::build(&config, None).unwrap_or_else(|e| panic!("{e}"))
    }

    fn case(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/cases").join(name)
    }

    fn told(rig: &Rig) -> String {
        doubts(rig).iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
    }

    /// No false alarm on the rigs that are shipped.
    #[test]
    fn the_rigs_of_the_repository_are_plausible() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../rigs");
        let mut count = 0;
        for entry in std::fs::read_dir(folder).unwrap().flatten() {
            let path = entry.path();
            if path.extension().is_none_or(|e| e != "toml") {
                continue;
            }
            let Ok(config) = RigConfig::load(&path, &Overrides::default()) else { continue };
            let Ok(rig) = Rig::build(&config, None) else { continue };
            assert_eq!(told(&rig), "", "{}", path.display());
            count += 1;
        }
        assert!(count > 3, "{count} rigs");
    }

    /// 200 sane rigs, drawn: sizes of 5 cm to 2 m, projectors at 0.5 to 8 m that look at the body from any side.
    #[test]
    fn sane_rigs_give_no_alarm_and_the_same_rigs_in_other_units_do() {
        let rig = demo(&[]);
        let mut state = 0x9e37_79b9_7f4a_7c15u64;
        let mut drawn = move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let Some(own) = shape(&rig, 0) else { panic!("the demo has a body") };
        for i in 0..200 {
            let size = 0.05 * 40f64.powf(drawn());
            let distance = (1.5 * size).max(0.5 * 16f64.powf(drawn()));
            let scale = size / own.longest();
            let points: Vec<DVec3> = own.points.iter().map(|p| *p * scale).collect();
            let scaled = MetBody {
                name: "thing".into(),
                points: points.clone(),
                low: own.low * scale,
                high: own.high * scale,
            };
            assert_eq!(of_shape(&scaled), [], "{i}: {size}");
            let turn = std::f64::consts::TAU * drawn();
            let centre = DVec3::new(drawn() - 0.5, drawn(), drawn() - 0.5);
            let from = centre + distance * DVec3::new(turn.cos(), 0.3, turn.sin());
            let raster = Raster::new(1024, 768).unwrap();
            let camera =
                ProjectorCamera::look_at(raster, from, centre, DVec3::Y, 0.5 + 0.5 * drawn()).unwrap();
            let seen = view(&camera, &points, &DAffine3::from_translation(centre));
            assert!(seen.is_near && DISTANCES_M.contains(&seen.distance), "{i}: {seen:?}");
            assert!(seen.size_px[0].max(seen.size_px[1]) >= LEAST_PX, "{i}: {seen:?}");
            // In millimetres it is told, with the unit; small things in millimetres may be large ones in centimetres.
            let large = MetBody { low: scaled.low * 1000.0, high: scaled.high * 1000.0, ..scaled };
            let word = if size > 0.12 { "millimetres?" } else { "metres?" };
            assert!(of_shape(&large).iter().any(|d| d.told.contains(word)), "{i}: {size}");
        }
    }

    /// A shell that is open at one side, a sheet, and what hides its own inside.
    #[test]
    fn only_backs_are_told_of_open_surfaces() {
        let sphere = |keep: &dyn Fn(DVec3) -> bool, flip: bool| {
            let at = |i: usize, k: usize| {
                let (a, b) =
                    (std::f64::consts::PI * i as f64 / 12.0, std::f64::consts::TAU * k as f64 / 24.0);
                0.2 * DVec3::new(a.sin() * b.cos(), a.cos(), -a.sin() * b.sin())
            };
            let quads = (0..12).flat_map(|i| (0..24).map(move |k| (i, k)));
            let halves = quads.flat_map(|(i, k)| {
                let [a, b, c, d] = [at(i, k), at(i + 1, k), at(i + 1, k + 1), at(i, k + 1)];
                [[a, b, c], [a, c, d]]
            });
            let is_kept = |t: &[DVec3; 3]| keep((t[0] + t[1] + t[2]) / 3.0);
            let faces = halves
                .filter(is_kept)
                .map(|[a, b, c]| Face { corners: if flip { [a, c, b] } else { [a, b, c] }, has_back: false });
            faces.collect::<Vec<_>>()
        };
        let projector = DVec3::new(0.0, 0.0, 2.0);
        let here = DAffine3::IDENTITY;
        let around = DAffine3::from_rotation_y(std::f64::consts::PI);
        let open_below = |p: DVec3| p.y > -0.15;
        assert!(!shows_only_backs(&sphere(&open_below, false), projector, &[&here]));
        assert!(shows_only_backs(&sphere(&open_below, true), projector, &[&here, &around]));
        // A bowl whose inside is meant: its fronts are seen from one side alone.
        let bowl = sphere(&|p| p.z < 0.0, true);
        assert!(!shows_only_backs(&bowl, projector, &[&here]));
        assert!(!shows_only_backs(&bowl, projector, &[&around, &here]), "in time");
        assert!(shows_only_backs(&bowl, projector, &[&around]));
        let two_sided: Vec<Face> = bowl.into_iter().map(|face| Face { has_back: true, ..face }).collect();
        assert!(!shows_only_backs(&two_sided, projector, &[&around]));
    }

    #[test]
    fn wrong_units_offsets_and_sides_are_told_with_what_would_fit() {
        let key = |key: &str, file: PathBuf| format!("{key}={:?}", file.display().to_string());
        let scene = |name: &str| {
            told(&demo(&[
                key("scene.file", case(name)),
                "scene.bodies=[{name=\"hare\", node=\"thing\"}]".into(),
            ]))
        };
        let calibration = |name: &str| {
            let raster =
                ["projector.width=1024", "projector.height=768", "projector.calibration_unit=\"metre\""];
            let mut flags: Vec<String> = raster.iter().map(|f| (*f).to_owned()).collect();
            flags.push(key("projector.calibration", case(name)));
            told(&demo(&flags))
        };
        let far = calibration("c07-lengths-in-cm.yml");
        assert!(far.contains("115 m from the bodies, 100 times too far: centimetres?"), "{far}");
        assert_eq!(calibration("c08-pose-4x4.yml"), "");
        let offset = scene("a03-offset-8km.glb");
        assert!(offset.contains("10.4 km from its body's origin"), "{offset}");
        let large = scene("a04-180m-body.glb");
        assert!(large.contains("180 m long") && large.contains("scene.scale = 0.001"), "{large}");
        let turned = scene("a19-inside-out.glb");
        assert!(turned.contains("inside out and single-sided"), "{turned}");
        let rig = demo(&[]);
        let place = |p: [f64; 3]| vec![vec![DAffine3::from_translation(DVec3::from(p)); 2]];
        let told = of_places(&rig, &place([121.0, 100.0, 0.0]));
        assert!(told.len() == 2 && told[0].told.contains("millimetres?"), "{told:?}");
        assert_eq!(of_places(&rig, &place([0.05, 0.1, 0.0])), []);
        assert!(of_places(&rig, &place([0.0, 0.1, 5.0]))[0].told.contains("reach"));
        assert!(coverage(&rig, &place([0.05, 0.1, 0.0])[0])[0].contains("pixels at"));
    }

    #[test]
    fn bodies_that_change_places_are_told_from_bodies_that_move() {
        let (left, right) = (DVec3::new(-0.2, 0.1, 0.0), DVec3::new(0.2, 0.1, 0.0));
        let mut exchanges = Exchanges::default();
        for i in 0..100 {
            let moved = DVec3::X * 1e-3 * f64::from(i);
            exchanges.observe(0, left + moved);
            exchanges.observe(1, right - moved);
        }
        assert!(exchanges.pairs.is_empty());
        // A jump alone is none.
        exchanges.observe(0, DVec3::Y);
        exchanges.observe(0, left);
        exchanges.observe(1, right);
        for _ in 0..3 {
            exchanges.observe(0, right);
            exchanges.observe(1, left);
            exchanges.observe(0, left);
            exchanges.observe(1, right);
        }
        assert_eq!(exchanges.pairs, [([0, 1], 6)]);
    }
}
