//! `dpm calibrate check`: light is sent to points of a body, and the wand's tip tells how far it is from them.

use super::aim::Aim;
use super::body::{carried, index_of, triangles_of};
use super::dialogue::Dialogue;
use super::poses::{held, still, Poses};
use dpm_calibration::body::TriangleTree;
use dpm_calibration::check::{spread, CheckSummary, Fault, MeshPoint, Offset, PointReading, Summary};
use dpm_calibration::file::{CalibrationFile, CheckSection};
use dpm_calibration::trajectory::TimedPose;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::results::Results;
use dpm_rig::rig::Rig;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DVec2, DVec3};
use std::fmt::Write;

/// A body that has moved further than this since its light was placed, metres, gets its light anew.
const MOVED_M: f64 = 5e-4;
/// Light that misses by more than this, pixels, makes one ask whether the tip was in it.
const FAR_PX: f64 = 30.0;

/// A body as the rig would light it.
pub struct Target {
    /// Its name.
    pub name: String,
    /// The rig's projector.
    pub camera: ProjectorCamera,
    /// Where the mesh is in the body.
    pub mesh_to_body: DAffine3,
    /// Points that may be chosen.
    pub candidates: Vec<MeshPoint>,
    /// What hides them.
    pub surface: TriangleTree,
}

impl Target {
    /// The body `named`; without a name the rig's only one.
    ///
    /// # Errors
    /// There is none of this name, or several to choose from.
    pub fn of(rig: &Rig, named: Option<&str>) -> Result<Self, Failure> {
        let bad = |told: String| Failure::new(FailureKind::BadInput, told);
        let names: Vec<&str> = rig.config.scene.bodies.iter().map(|b| b.name.as_str()).collect();
        let name = match (named, &names[..]) {
            (Some(name), _) | (None, &[name]) => name.to_owned(),
            (None, []) => return Err(bad("the rig file has no body (scene.bodies) to check".into())),
            (None, _) => return Err(bad(format!("choose a body by --body: {}", names.join(", ")))),
        };
        let index = index_of(&rig.config, &name)?;
        let triangles = triangles_of(&carried(&rig.config, &rig.scene, &name)?);
        let mesh_to_body = rig.bodies.get(index).map_or(DAffine3::IDENTITY, |b| b.mesh_to_body);
        Ok(Self::new(name, rig.camera, mesh_to_body, triangles))
    }

    fn new(
        name: String,
        camera: ProjectorCamera,
        mesh_to_body: DAffine3,
        triangles: Vec<[DVec3; 3]>,
    ) -> Self {
        let points = |t: &[DVec3; 3]| {
            let normal = (t[1] - t[0]).cross(t[2] - t[0]).normalize_or_zero();
            let middle = (t[0] + t[1] + t[2]) / 3.0;
            // Corners are what a tip can find again.
            [t[0], t[1], t[2], middle].map(|position| MeshPoint { position, normal })
        };
        let candidates = triangles.iter().flat_map(points).collect();
        Self { name, camera, mesh_to_body, candidates, surface: TriangleTree::new(triangles) }
    }
}

/// What a check works with: light, a wand and an operator.
pub trait Bench {
    /// Asks, and waits for a line.
    ///
    /// # Errors
    /// The input ended, or the program is being stopped.
    fn ask(&self, text: &str) -> Result<String, Failure>;
    /// Tells the operator something.
    fn tell(&self, text: &str);
    /// Poses of the wand and of the body in a moment in which nothing should move.
    fn hold(&self) -> Vec<Vec<TimedPose>>;
    /// Lights a pixel and those around it.
    fn light(&self, pixel: [u32; 2]);
}

/// The bench of a real rig.
pub struct RealBench<'a> {
    /// Wand and body.
    pub poses: &'a Poses,
    /// The dot.
    pub aim: &'a Aim,
    /// The operator.
    pub dialogue: &'a Dialogue,
}

impl Bench for RealBench<'_> {
    fn ask(&self, text: &str) -> Result<String, Failure> {
        self.dialogue.ask(text)
    }

    fn tell(&self, text: &str) {
        self.dialogue.tell(text);
    }

    fn hold(&self) -> Vec<Vec<TimedPose>> {
        self.poses.hold()
    }

    fn light(&self, pixel: [u32; 2]) {
        self.aim.show(pixel);
    }
}

/// Where the body is now.
fn place(bench: &impl Bench, target: &Target) -> Result<DAffine3, Failure> {
    loop {
        match still(&target.name, bench.hold().get(1).map_or(&[], Vec::as_slice)) {
            Ok(body) => return Ok(body * target.mesh_to_body),
            Err(why) => drop(bench.ask(&format!("{why}. Press Enter."))?),
        }
    }
}

/// A tip that was held, with the place of the mesh meanwhile.
fn tip_and_mesh(bench: &impl Bench, target: &Target, tip: DVec3) -> Result<(DVec3, DAffine3), String> {
    let poses = bench.hold();
    let of = |i: usize| poses.get(i).map_or(&[][..], Vec::as_slice);
    Ok((held(tip, of(0))?, still(&target.name, of(1))? * target.mesh_to_body))
}

/// Measures up to `count` points.
///
/// # Errors
/// No point of the body can be lit (exit code 2), or the input ended.
pub fn measure(
    bench: &impl Bench,
    target: &Target,
    tip: DVec3,
    count: usize,
) -> Result<Vec<Offset>, Failure> {
    bench.tell(
        "Put the body where it is lit and keep it still. At each point hold the tip of the wand into the middle of the dot\n\
         and press Enter; then touch the point of the body itself, where the dot should be. s: leave out a point, or the\n\
         touch of a point that you cannot find on the body; d: done.",
    );
    let mesh = place(bench, target)?;
    let points = spread(&target.candidates, &target.surface, &target.camera, &mesh, count);
    if points.is_empty() {
        let told = format!(
            "no point of \"{}\" faces the projector on its raster by this rig; put it into the light, or measure the \
             projector and the body again",
            target.name
        );
        return Err(Failure::new(FailureKind::BadInput, told));
    }
    let mut offsets = Vec::new();
    for (i, point) in points.iter().enumerate() {
        match measure_point(bench, target, tip, (i, points.len()), point)? {
            PointAnswer::Measured(offset) => {
                bench.tell(&told_of_point(&offset));
                offsets.push(offset);
            }
            PointAnswer::Skipped => {}
            PointAnswer::Done => break,
        }
    }
    Ok(offsets)
}

enum PointAnswer {
    Measured(Offset),
    Skipped,
    Done,
}

fn measure_point(
    bench: &impl Bench,
    target: &Target,
    tip: DVec3,
    (i, count): (usize, usize),
    point: &MeshPoint,
) -> Result<PointAnswer, Failure> {
    let [x, y, z] = point.position.to_array();
    let mut mesh = place(bench, target)?;
    let mut in_light: Option<(DVec3, DVec2)> = None;
    loop {
        let at = mesh.transform_point3(point.position);
        let normal = mesh.transform_vector3(point.normal);
        let Some(pixel) = target.camera.project(at).and_then(|p| whole(&target.camera, p)) else {
            bench.tell("the body has moved out of the light; this point is left out");
            return Ok(PointAnswer::Skipped);
        };
        bench.light(pixel);
        let question = match in_light {
            None => format!(
                "point {} of {count}, at ({x:.4}, {y:.4}, {z:.4}) m of the mesh: tip into the dot:",
                i + 1
            ),
            Some(_) => "now touch this point of the body:".to_owned(),
        };
        let touched = match (bench.ask(&question)?.as_str(), in_light) {
            ("d" | "D", _) => return Ok(PointAnswer::Done),
            ("s" | "S", None) => return Ok(PointAnswer::Skipped),
            ("s" | "S", Some(_)) => None,
            ("", _) => match tip_and_mesh(bench, target, tip) {
                Ok((place, now)) if now.transform_point3(point.position).distance(at) <= MOVED_M => {
                    Some(place)
                }
                Ok((_, now)) => {
                    let moved = now.transform_point3(point.position).distance(at);
                    bench.tell(&format!("the body moved by {:.1} mm; its light moves along", 1e3 * moved));
                    (mesh, in_light) = (now, None);
                    continue;
                }
                Err(why) => {
                    bench.tell(&why);
                    continue;
                }
            },
            _ => {
                bench.tell("press Enter, or s or d");
                continue;
            }
        };
        let centre = DVec2::new(f64::from(pixel[0]), f64::from(pixel[1])) + 0.5;
        match (in_light, touched) {
            (None, Some(place)) => in_light = Some((place, centre)),
            (None, None) => {}
            (Some((in_light, lit)), touched) => {
                let reading = PointReading { point: at, normal, lit, in_light, touched };
                return Ok(
                    Offset::of(&target.camera, &reading).map_or(PointAnswer::Skipped, PointAnswer::Measured)
                );
            }
        }
    }
}

/// The pixel around a position on the raster.
fn whole(camera: &ProjectorCamera, at: DVec2) -> Option<[u32; 2]> {
    let (width, height) = (camera.raster.width(), camera.raster.height());
    let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < f64::from(width) && at.y < f64::from(height);
    inside.then_some([at.x as u32, at.y as u32])
}

fn told_of_point(offset: &Offset) -> String {
    let light = offset.light;
    let mut told = format!(
        "light is off by {:.2} px ({:+.2} right, {:+.2} down), {:.2} mm on the surface",
        light.length(),
        light.x,
        light.y,
        1e3 * offset.light_m
    );
    match offset.body_m {
        Some(m) => {
            let parts = (offset.projector.length(), 1e3 * m.length());
            let _ = write!(
                told,
                "; the projector's part is {:.2} px, the body is off by {:.2} mm",
                parts.0, parts.1
            );
        }
        None => told += "; the projector's part alone",
    }
    if offset.projector.length() > FAR_PX {
        told += "\nthe tip was far from where this light should fall: was it in the dot? If not, end by d and check again";
    }
    told
}

/// What the operator is told of all points, and whether the largest error is within `limit_px`.
///
/// # Errors
/// No point was measured (exit code 2).
pub fn judge(
    offsets: &[Offset],
    file: &CalibrationFile,
    body: &str,
    limit_px: f64,
) -> Result<(String, bool), Failure> {
    let checked = CheckSummary::of(offsets).ok_or_else(|| {
        Failure::new(FailureKind::BadInput, "no point was measured, so nothing was checked")
    })?;
    let mut told = String::from("point     light px   right    down      mm   projector px   body px\n");
    for (i, o) in offsets.iter().enumerate() {
        let of_body = o.body.map_or("-".into(), |b| format!("{:.2}", b.length()));
        let _ = writeln!(
            told,
            "{:5}  {:11.2} {:+7.2} {:+7.2} {:7.2} {:14.2} {of_body:>9}",
            i + 1,
            o.light.length(),
            o.light.x,
            o.light.y,
            1e3 * o.light_m,
            o.projector.length()
        );
    }
    let of = |s: &Summary| {
        format!(
            "p50 {:.2} px, largest {:.2} px; mean offset {:.2} px ({:+.2}, {:+.2}), scatter {:.2} px",
            s.p50_px,
            s.largest_px,
            s.mean.length(),
            s.mean.x,
            s.mean.y,
            s.scatter_px
        )
    };
    let _ = writeln!(told, "light:     {}", of(&checked.light));
    let _ = writeln!(told, "projector: {}", of(&checked.projector));
    match &checked.body {
        Some(b) => drop(writeln!(told, "body:      {}", of(b))),
        None => told += "body:      not known, since no point of it was touched\n",
    }
    told += &predicted(file, body);
    let fault = checked.fault(limit_px);
    told += &match fault {
        None => format!("\nno error is larger than {limit_px} px"),
        Some((fault, part)) => verdict(fault, &part, body, limit_px),
    };
    Ok((told, fault.is_none()))
}

/// Puts what a check of `body` found into the results; nothing if no point was measured.
pub fn keep(results: &mut Results, config: &RigConfig, body: &str, offsets: &[Offset], limit_px: f64) {
    let Some(light) = CheckSummary::of(offsets).map(|checked| checked.light) else { return };
    let data = format!("{} points of \"{body}\"", light.count);
    let section = CheckSection {
        points: light.count as u32,
        p50_px: light.p50_px,
        largest_px: light.largest_px,
        limit_px,
        provenance: results.provenance(config, "", data, "the wand's tip in the light and on the body"),
    };
    results.file.checks.insert(body.to_owned(), section);
}

/// The errors that the calibration file predicts.
fn predicted(file: &CalibrationFile, body: &str) -> String {
    let projector = file.projector.as_ref().map_or("the projector was not calibrated".into(), |p| {
        let bias = 1e3 * p.assumed_bias_m;
        format!(
            "light within {:.2} px (99th percentile, for a tracker bias of {bias:.2} mm)",
            p.predicted_p99_px
        )
    });
    let body = match file.bodies.get(body).map(|b| b.residual_m) {
        None => format!("\"{body}\" was not calibrated"),
        Some(None) => format!("\"{body}\" was moved by eye, so no residual is known"),
        Some(Some(residual_m)) => format!("\"{body}\" with a residual of {:.2} mm", 1e3 * residual_m),
    };
    format!("predicted by the calibration file: {projector}; {body}")
}

/// What to do about an error.
fn verdict(fault: Fault, part: &Summary, body: &str, limit_px: f64) -> String {
    let (what, command, nudge) = match fault {
        Fault::Projector => ("the projector", "projector".to_owned(), "--projector".to_owned()),
        Fault::Body => {
            ("the mesh in the body", format!("body --body \"{body}\""), format!("--body \"{body}\""))
        }
    };
    let how = if part.is_shift() {
        format!("{what} is shifted: the mean offset is larger than the scatter")
    } else {
        format!("most of it comes from {what}, and it is no plain shift")
    };
    format!(
        "\nlight is off by more than {limit_px} px; {how}. Repeat `dpm calibrate {command}`, or correct it by eye with \
         `dpm calibrate nudge {nudge}`"
    )
}

#[cfg(test)]
mod tests;
