//! `dpm calibrate projector` by hand: crosses are shown one after another, the tip of the wand is held into each.

use super::aim::Aim;
use super::dialogue::Dialogue;
use super::lines::Lines;
use super::poses::{held, Poses};
use dpm_calibration::file::ProjectorSection;
use dpm_calibration::projector::{Options, ProjectorFit, Session, Sight, Volume};
use dpm_device::planes::Raster;
use dpm_device::regular_file;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::results::Results;
use glam::{DVec2, DVec3};
use std::path::Path;

/// The working volume reaches this far beyond the points on every side, as a share of their extent.
const BEYOND: f64 = 0.1;

/// Points that were aimed at, in a file that outlives an interruption: metres in the world, pixels.
pub type Points = Lines<5>;

fn sights(points: &Points) -> Vec<Sight> {
    let sight =
        |[x, y, z, column, row]: &[f64; 5]| Sight::at_rest(DVec3::new(*x, *y, *z), DVec2::new(*column, *row));
    points.lines().iter().map(sight).collect()
}

/// A session with the points so far, over a volume around them.
fn session(raster: Raster, options: Options, sights: &[Sight]) -> Session {
    let everywhere = Volume { low: DVec3::splat(-0.3), high: DVec3::splat(0.3) };
    let mut volume = Volume::around(sights.iter().map(|s| s.world)).unwrap_or(everywhere);
    let margin = (volume.high - volume.low) * BEYOND;
    (volume.low, volume.high) = (volume.low - margin, volume.high + margin);
    let mut session = Session::new(raster, options, volume);
    sights.iter().for_each(|s| session.add(*s));
    session
}

/// Asks for points until the operator is content, and solves.
///
/// # Errors
/// The input ends, or nothing was solved.
pub fn aim_by_hand(
    (raster, options): (Raster, Options),
    tip: DVec3,
    points: &mut Points,
    (poses, aim): (&Poses, &Aim),
    dialogue: &Dialogue,
) -> Result<ProjectorFit, Failure> {
    dialogue.tell(
        "Hold the tip of the wand into the middle of each cross and press Enter. Use at least 12 points, near and far: their\n\
         distances from the projector should differ by a quarter or more. u: take the last point back; d: done.",
    );
    if !points.lines().is_empty() {
        let (n, path) = (points.lines().len(), points.path().display());
        dialogue.tell(&format!("Going on with {n} points of {path}; delete that file to begin anew."));
    }
    loop {
        let session = session(raster, options, &sights(points));
        let next = session.next_point();
        let pixel = pixel_of(raster, next.pixel);
        aim.show(pixel);
        let near = next
            .world
            .map_or(String::new(), |w| format!(", about at ({:.2}, {:.2}, {:.2}) m", w.x, w.y, w.z));
        let [x, y] = pixel;
        let question = format!("point {}: cross at pixel ({x}, {y}){near}:", points.lines().len() + 1);
        match dialogue.ask(&question)?.as_str() {
            "u" | "U" => points.pop()?,
            "d" | "D" => match session.solve() {
                Ok(solved) => {
                    aim.hide();
                    return Ok(solved);
                }
                Err(why) => dialogue.tell(&format!("not yet: {why}")),
            },
            "" => match held(tip, &poses.hold().swap_remove(0)) {
                Ok(place) => {
                    let centre = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    points.push([place.x, place.y, place.z, centre.x, centre.y])?;
                    dialogue.tell(&self::session(raster, options, &sights(points)).advice());
                }
                Err(why) => dialogue.tell(&why),
            },
            _ => dialogue.tell("press Enter, or u or d"),
        }
    }
}

/// The whole pixel of a suggestion, inside the raster.
fn pixel_of(raster: Raster, at: DVec2) -> [u32; 2] {
    let inside = |v: f64, n: u32| (v.max(0.0) as u32).min(n - 1);
    [inside(at.x, raster.width()), inside(at.y, raster.height())]
}

/// What the operator is told of a solution.
pub fn told_of(solved: &ProjectorFit) -> String {
    let (p, at) = (&solved.predicted, solved.predicted.worst);
    let used = solved.inliers.iter().filter(|i| **i).count();
    let mut told = format!(
        "predicted error {:.2} px (99th percentile over the volume of the points); least certain at ({:.2}, {:.2}, {:.2}) m;\n\
         residual {:.2} px rms of {used} of {} points",
        p.p99_px,
        at.x,
        at.y,
        at.z,
        solved.rms_px,
        solved.inliers.len()
    );
    for (i, _) in solved.inliers.iter().enumerate().filter(|(_, used)| !**used) {
        told += &format!("\npoint {} does not fit the others and was left out", i + 1);
    }
    solved.notes.iter().for_each(|note| told += &format!("\n{note}"));
    told
}

/// Puts a solution into the results.
pub fn keep(results: &mut Results, config: &RigConfig, solved: &ProjectorFit, bias_m: f64) {
    let raster = config.projector.raster();
    let data = format!("{} points aimed at by hand", solved.inliers.len());
    let provenance = results.provenance(config, "", data, "least squares over lens and pose");
    let (p99, rms) = (solved.predicted.p99_px, solved.rms_px);
    let section = ProjectorSection::new(raster, &solved.model, p99, rms, provenance);
    results.file.projector = Some(section.assuming(&solved.predicted, bias_m));
}

/// Largest file of points that is read.
const MAX_POINTS_BYTES: u64 = 1 << 20;

/// Solves a file of points that others measured: `x y z column row` a line, metres and pixels.
///
/// # Errors
/// The file cannot be read, or its points do not make a projector.
pub fn solve_file(path: &Path, raster: Raster, options: Options) -> Result<ProjectorFit, Failure> {
    let bad = |e: String| Failure::new(FailureKind::BadInput, format!("{}: {e}", path.display()));
    let text = regular_file::read_text(path, MAX_POINTS_BYTES).map_err(|e| bad(e.to_string()))?;
    let sights = read_points(&text).map_err(bad)?;
    session(raster, options, &sights).solve().map_err(|e| Failure::new(FailureKind::BadInput, e))
}

/// The points of a text. Headings and comments (`#`) are passed over; blanks, commas and semicolons separate.
fn read_points(text: &str) -> Result<Vec<Sight>, String> {
    let mut points: Vec<[f64; 5]> = Vec::new();
    let text = text.trim_start_matches('\u{feff}');
    for (number, line) in text.lines().enumerate() {
        let line = line.split(['#', '%']).next().unwrap_or("").trim();
        let separators = |c: char| c.is_whitespace() || matches!(c, ',' | ';');
        let words: Vec<&str> = line.split(separators).filter(|w| !w.is_empty()).collect();
        // A heading names the columns before any number.
        let is_heading = points.is_empty() && words.iter().all(|w| w.parse::<f64>().is_err());
        if words.is_empty() || is_heading {
            continue;
        }
        let numbers: Option<Vec<f64>> = words.iter().map(|w| w.parse().ok()).collect();
        let numbers = numbers.and_then(|n| <[f64; 5]>::try_from(n).ok());
        let finite = numbers.filter(|n| n.iter().all(|v| v.is_finite()));
        points.push(finite.ok_or_else(|| {
            format!("line {} is not 5 numbers: x y z in metres, column and row in pixels", number + 1)
        })?);
    }
    let is_within_one = |p: &[f64; 5]| p[3].abs() <= 1.5 && p[4].abs() <= 1.5;
    if points.len() > 3 && points.iter().all(is_within_one) {
        return Err("all pixels lie within 1 of the corner: normalised coordinates? Give columns and rows in pixels, from the \
                    raster's upper left corner"
            .into());
    }
    let sight =
        |[x, y, z, column, row]: &[f64; 5]| Sight::at_rest(DVec3::new(*x, *y, *z), DVec2::new(*column, *row));
    Ok(points.iter().map(sight).collect())
}

#[cfg(test)]
mod tests {
    use super::read_points;

    #[test]
    fn points_are_read_with_headings_and_refused_when_they_are_normalised() {
        let body = "2.3, 0, -1.1, 100.5, 20\n\n2.3;0.9;-1.1;500;24 # held twice\n2 0 -1\t7 8\n1 1 1 9 9\n";
        let read = read_points(&format!("x,y,z,u,v\n# by hand\n{body}")).unwrap();
        assert_eq!((read.len(), read[0].pixel.x, read[1].world.y), (4, 100.5, 0.9));
        assert!(read_points("x y z\n1 2 3 4\n").unwrap_err().contains("line 2 is not 5 numbers"));
        assert!(read_points("1 2 3 4 5\nx y z u v\n").is_err());
        let told = read_points(include_str!("../../../tests/assets/cases/c13-points-normalised.txt"));
        assert!(told.unwrap_err().contains("normalised coordinates?"));
    }
}
