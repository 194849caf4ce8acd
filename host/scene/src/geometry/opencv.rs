//! Reads OpenCV FileStorage files (YAML 1.0 or XML) as a calibrated projector.
//!
//! `%YAML:1.0` is not valid YAML, and tools misspell and rename the entries. So this is a small tolerant reader of
//! exactly the parts that calibrations use: matrices and numbers by name at any depth. The text itself bounds all
//! sizes: nothing is allocated ahead of the data.

use super::lens::{Lens, LensError};
use super::projector::{ProjectorCamera, ProjectorError};
use dpm_device::planes::Raster;
use glam::{DAffine3, DMat3, DVec3};
use std::collections::BTreeMap;
use thiserror::Error;

/// Largest accepted file, bytes.
pub const MAX_BYTES: usize = 1 << 20;

/// The unit of lengths in a file; the numbers do not reveal it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LengthUnit {
    /// 1 m.
    Metre,
    /// 1e-3 m.
    Millimetre,
}

/// A matrix, rows first.
#[derive(Clone, Debug, PartialEq)]
pub struct Matrix {
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub columns: usize,
    /// `rows * columns` numbers.
    pub data: Vec<f64>,
}

/// The content of a calibration file.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredCalibration {
    /// The projector with its lens.
    pub camera: ProjectorCamera,
    /// Names under which the parts were found, for the operator.
    pub found: Vec<String>,
}

/// Why a file does not yield a calibration.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum StorageError {
    /// Larger than [`MAX_BYTES`].
    #[error("calibration file has {0} bytes, at most {MAX_BYTES} are accepted")]
    TooLarge(usize),
    /// Neither form is recognised.
    #[error(
        "calibration file is neither OpenCV YAML (first line %YAML:1.0) nor OpenCV XML (<opencv_storage>)"
    )]
    UnknownForm,
    /// A matrix is malformed.
    #[error("calibration file: matrix {name:?}: {what}")]
    Matrix {
        /// Its name.
        name: String,
        /// The problem.
        what: String,
    },
    /// A part is missing.
    #[error("calibration file: no {part}; looked for {names}; the file has {has}")]
    Missing {
        /// The missing part.
        part: &'static str,
        /// Names tried.
        names: &'static str,
        /// Names of the matrices found.
        has: String,
    },
    /// A part has unusable numbers.
    #[error("calibration file: {name:?} {what}")]
    Value {
        /// Name of the entry.
        name: String,
        /// The problem.
        what: String,
    },
    /// The intrinsics are refused.
    #[error("calibration file: {0}")]
    Projector(#[from] ProjectorError),
}

const ROTATION: &[&str] = &["R", "rotation", "roration", "R_cp", "cam_proj_rotation"];
const TRANSLATION: &[&str] = &["T", "translation", "t", "T_cp", "cam_proj_translation"];
const INTRINSICS: &[&str] = &["proj_int", "proj_K", "camera_matrix", "cameraMatrix"];
const DISTORTION: &[&str] =
    &["proj_dist", "proj_kc", "distortion_coefficients", "distCoeffs", "distortion_coeffs"];

/// All matrices of a file by name; of equal names the first counts.
pub fn matrices(text: &str) -> Result<BTreeMap<String, Matrix>, StorageError> {
    if text.len() > MAX_BYTES {
        return Err(StorageError::TooLarge(text.len()));
    }
    let text = text.trim_start_matches('\u{feff}').trim_start();
    if text.contains("<opencv_storage") {
        xml(text)
    } else if text.starts_with("%YAML") || text.contains("!!opencv-matrix") {
        yaml(text)
    } else {
        Err(StorageError::UnknownForm)
    }
}

fn build(name: &str, rows: Option<f64>, columns: Option<f64>, data: &str) -> Result<Matrix, StorageError> {
    let error = |what: String| StorageError::Matrix { name: name.into(), what };
    let side = |v: Option<f64>, which: &str| match v {
        Some(v) if (1.0..=1e6).contains(&v) && v.fract() == 0.0 => Ok(v as usize),
        _ => Err(error(format!("{which} is missing or not a whole number from 1 on"))),
    };
    let (rows, columns) = (side(rows, "rows")?, side(columns, "cols")?);
    let mut numbers = Vec::new();
    for word in data.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty()) {
        let value = match word {
            ".Inf" | ".inf" | "-.Inf" | ".Nan" | ".NaN" => f64::NAN,
            _ => word.parse().map_err(|_| error(format!("{word:?} is not a number")))?,
        };
        numbers.push(value);
    }
    if rows.checked_mul(columns) != Some(numbers.len()) {
        return Err(error(format!("{rows} x {columns} but {} numbers", numbers.len())));
    }
    Ok(Matrix { rows, columns, data: numbers })
}

fn yaml(text: &str) -> Result<BTreeMap<String, Matrix>, StorageError> {
    let mut found = BTreeMap::new();
    let mut rest = text;
    while let Some(at) = rest.find("!!opencv-matrix") {
        let before = &rest[..at];
        let line = before.rsplit('\n').next().unwrap_or("");
        let name = line
            .trim()
            .trim_start_matches('-')
            .trim()
            .trim_end_matches(':')
            .trim()
            .trim_matches('"')
            .to_string();
        let body = &rest[at + "!!opencv-matrix".len()..];
        let end = body.find("!!opencv-matrix").unwrap_or(body.len());
        let block = &body[..end];
        let number =
            |key: &str| block.lines().find_map(|l| l.trim().strip_prefix(key)?.trim().parse::<f64>().ok());
        let error = |what: &str| StorageError::Matrix { name: name.clone(), what: what.into() };
        let data = block.find("data:").ok_or_else(|| error("no data"))?;
        let open = block[data..].find('[').ok_or_else(|| error("data does not start with ["))? + data + 1;
        let close = block[open..].find(']').ok_or_else(|| error("data does not end with ]"))? + open;
        let matrix = build(&name, number("rows:"), number("cols:"), &block[open..close])?;
        found.entry(name).or_insert(matrix);
        rest = &body[close..];
    }
    Ok(found)
}

fn xml(text: &str) -> Result<BTreeMap<String, Matrix>, StorageError> {
    let mut found = BTreeMap::new();
    let mut rest = text;
    while let Some(at) = rest.find("opencv-matrix") {
        let name_start = rest[..at].rfind('<').map_or(0, |i| i + 1);
        let name = rest[name_start..at].split_whitespace().next().unwrap_or("").to_string();
        let error = |what: &str| StorageError::Matrix { name: name.clone(), what: what.into() };
        let body = &rest[at..];
        let end = body.find(&format!("</{name}>")).ok_or_else(|| error("is not closed"))?;
        let block = &body[..end];
        let inner = |tag: &str| {
            let from = block.find(&format!("<{tag}>"))? + tag.len() + 2;
            Some(&block[from..from + block[from..].find(&format!("</{tag}>"))?])
        };
        let number = |tag: &str| inner(tag)?.trim().parse::<f64>().ok();
        let data = inner("data").ok_or_else(|| error("no data"))?;
        let matrix = build(&name, number("rows"), number("cols"), data)?;
        found.entry(name.clone()).or_insert(matrix);
        rest = &body[end..];
    }
    Ok(found)
}

/// Reads a calibration. `R` and `T` take points of the calibration's world (often the camera) into the projector's
/// space: `x_proj = R x + T`, looking along +Z with y down, as in OpenCV.
pub fn read(text: &str, raster: Raster, unit: LengthUnit) -> Result<StoredCalibration, StorageError> {
    let all = matrices(text)?;
    let mut found = Vec::new();
    let mut pick = |part: &'static str, names: &[&str], shown: &'static str| {
        let hit = names.iter().find_map(|n| all.get_key_value(*n));
        let (name, matrix) = hit.ok_or_else(|| StorageError::Missing {
            part,
            names: shown,
            has: if all.is_empty() {
                "no matrix".into()
            } else {
                all.keys().cloned().collect::<Vec<_>>().join(", ")
            },
        })?;
        if let Some(i) = matrix.data.iter().position(|v| !v.is_finite()) {
            return Err(StorageError::Value {
                name: name.clone(),
                what: format!("number {i} is not finite"),
            });
        }
        found.push(format!("{part}: {name}"));
        Ok((name.clone(), matrix))
    };
    let (k_name, k) = pick("intrinsics", INTRINSICS, "proj_int, proj_K, camera_matrix")?;
    let (r_name, r) = pick("rotation", ROTATION, "R, rotation, roration")?;
    let (t_name, t) = pick("translation", TRANSLATION, "T, translation")?;
    let distortion = match pick("distortion", DISTORTION, "proj_dist, proj_kc, distortion_coefficients") {
        Ok(found) => Some(found),
        Err(StorageError::Missing { .. }) => None,
        Err(other) => return Err(other),
    };
    let value = |name: &str, what: String| StorageError::Value { name: name.into(), what };

    if (k.rows, k.columns) != (3, 3) {
        return Err(value(&k_name, format!("is {} x {}, not 3 x 3", k.rows, k.columns)));
    }
    let (fx, skew, cx, fy, cy) = (k.data[0], k.data[1], k.data[2], k.data[4], k.data[5]);
    if (k.data[8] - 1.0).abs() > 1e-6 || k.data[3] != 0.0 || k.data[6] != 0.0 || k.data[7] != 0.0 {
        return Err(value(
            &k_name,
            "is not an upper triangular intrinsic matrix with 1 in its corner".into(),
        ));
    }
    if skew.abs() > 1e-3 * fx.abs() {
        return Err(value(&k_name, format!("has skew {skew}: calibrate without it")));
    }
    let rotation = match (r.rows, r.columns) {
        (3, 3) => DMat3::from_cols_slice(&r.data).transpose(),
        (3, 1) | (1, 3) => DMat3::from_quat(dpm_common::so3::so3_exp(DVec3::from_slice(&r.data))),
        (rows, columns) => {
            return Err(value(&r_name, format!("is {rows} x {columns}, not 3 x 3 or a rotation vector")))
        }
    };
    let off = (rotation.transpose() * rotation - DMat3::IDENTITY).to_cols_array();
    if off.iter().any(|v| v.abs() > 1e-3) || rotation.determinant() < 0.0 {
        return Err(value(&r_name, "is not a rotation (columns must be orthonormal, determinant +1)".into()));
    }
    // Text has few digits, so make the matrix a rotation again.
    let x = rotation.x_axis.normalize();
    let y = (rotation.y_axis - x * x.dot(rotation.y_axis)).normalize();
    let rotation = DMat3::from_cols(x, y, x.cross(y));
    if t.data.len() != 3 {
        return Err(value(&t_name, format!("has {} numbers, not 3", t.data.len())));
    }
    let metres = match unit {
        LengthUnit::Metre => 1.0,
        LengthUnit::Millimetre => 1e-3,
    };
    let translation = DVec3::from_slice(&t.data) * metres;
    let lens = match distortion {
        None => Lens::default(),
        Some((name, d)) => Lens::opencv(&d.data).map_err(|e| match e {
            LensError::Count(n) => value(&name, format!("has {n} numbers; 4, 5, 8, 12 or 14 are known")),
            other => value(&name, format!("is not a lens: {other}")),
        })?,
    };
    // x_proj = R x + T in +Z, y down; ours looks along -Z, y up.
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let pose =
        DAffine3::from_mat3_translation(rotation.transpose() * flip, -(rotation.transpose() * translation));
    // OpenCV puts pixel centres at whole numbers, this project at halves.
    let camera = ProjectorCamera::new(raster, pose, fx, fy, cx + 0.5, cy + 0.5)?.with_lens(lens)?;
    Ok(StoredCalibration { camera, found })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec2;

    const YAML: &str = "%YAML:1.0\n---\nproj_K: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1.2e+03, 0., 511.5,\n       0., 1.1e+03, 383.5, 0., 0., 1. ]\nproj_kc: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [ -0.1, 0.01, 0., 0., 0. ]\nroration: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 0., -1., 0., 1., 0., 0., 0., 0., 1. ]\nT: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ 100., 200., 300. ]\nerror: 0.4\n";

    fn raster() -> Raster {
        Raster::new(1024, 768).unwrap()
    }

    #[test]
    fn yaml_gives_the_projection_of_its_matrices() {
        let c = read(YAML, raster(), LengthUnit::Millimetre).unwrap();
        // x_proj = R x + T by hand: (0.5, 0.2, 2) -> (-0.2, 0.5, 2) + (0.1, 0.2, 0.3) = (-0.1, 0.7, 2.3).
        let pixel = c.camera.project(DVec3::new(0.5, 0.2, 2.0)).unwrap();
        let (x, y) = (-0.1 / 2.3, 0.7 / 2.3);
        let r2: f64 = x * x + y * y;
        let radial = 1.0 - 0.1 * r2 + 0.01 * r2 * r2;
        let want = DVec2::new(1200.0 * x * radial + 512.0, 1100.0 * y * radial + 384.0);
        assert!((pixel - want).length() < 1e-9, "{pixel} {want}");
        let lens = Lens::opencv(&[-0.1, 0.01, 0.0, 0.0, 0.0]).unwrap();
        assert_eq!(c.camera.lens.model(), lens.model());
        assert!(c.found.contains(&"rotation: roration".to_string()), "{:?}", c.found);
        // In metres the projector is a thousand times farther away.
        let m = read(YAML, raster(), LengthUnit::Metre).unwrap();
        assert!((m.camera.position() - c.camera.position() * 1000.0).length() < 1e-9);
    }

    #[test]
    fn xml_reads_the_same() {
        let matrix = |name: &str, r: usize, c: usize, data: &str| {
            format!("<{name} type_id=\"opencv-matrix\">\n <rows>{r}</rows>\n <cols>{c}</cols>\n <dt>d</dt>\n <data>\n {data}</data></{name}>\n")
        };
        let text = format!(
            "<?xml version=\"1.0\"?>\n<opencv_storage>\n{}{}{}{}</opencv_storage>\n",
            matrix("camera_matrix", 3, 3, "1200. 0. 511.5 0. 1100.\n 383.5 0. 0. 1."),
            matrix("distortion_coefficients", 5, 1, "-0.1 0.01 0. 0. 0."),
            matrix("rotation", 3, 1, "0. 0. 1.5707963267948966"),
            matrix("translation", 1, 3, "100. 200. 300."),
        );
        let (a, b) = (
            read(&text, raster(), LengthUnit::Millimetre).unwrap(),
            read(YAML, raster(), LengthUnit::Millimetre).unwrap(),
        );
        let p = DVec3::new(0.5, 0.2, 2.0);
        assert!((a.camera.project(p).unwrap() - b.camera.project(p).unwrap()).length() < 1e-9);
        assert_eq!(a.camera.lens, b.camera.lens);
    }

    #[test]
    fn faults_are_named() {
        let fault = |text: &str| read(text, raster(), LengthUnit::Metre).unwrap_err().to_string();
        assert!(fault("hello").contains("neither"));
        assert!(
            fault("%YAML:1.0\n---\n").contains("no intrinsics")
                && fault("%YAML:1.0\n---\n").contains("no matrix")
        );
        assert!(fault(&YAML.replace("roration", "rot")).contains("no rotation"));
        assert!(fault(&YAML.replace("   rows: 3\n   cols: 1", "   rows: 9\n   cols: 1"))
            .contains("9 x 1 but 3 numbers"));
        assert!(fault(&YAML.replace("   rows: 3\n   cols: 1", "   rows: 3000000000\n   cols: 1"))
            .contains("rows is missing"));
        assert!(fault(&YAML.replace("0., -1., 0., 1.", "0., -2., 0., 1.")).contains("not a rotation"));
        assert!(fault(&YAML.replace("0., -1., 0., 1.", "0., 1., 0., 1.")).contains("not a rotation"));
        assert!(fault(&YAML.replace("1.2e+03", "-1.2e+03")).contains("focal"));
        assert!(fault(&YAML.replace("1.2e+03", "abc")).contains("\"abc\" is not a number"));
        assert!(fault(&YAML.replace("1.2e+03", ".Nan")).contains("not finite"));
        assert!(fault(&YAML.replace("-0.1, 0.01", ".Inf, 0.01")).contains("proj_kc"));
        assert!(fault(&YAML.replace("200., 300. ]", "200., 300.")).contains("does not end"));
        assert!(fault(&YAML.replace("cols: 5", "cols: 3").replace("-0.1, 0.01, 0., 0., 0.", "0., 0., 0."))
            .contains("has 3 numbers"));
        assert!(fault(&"x".repeat(MAX_BYTES + 1)).contains("at most"));
    }

    #[test]
    fn cut_off_files_never_panic() {
        for end in 0..YAML.len() {
            let _ = read(&YAML[..end], raster(), LengthUnit::Metre);
            let _ = read(&YAML[end..], raster(), LengthUnit::Metre);
        }
    }
}
