//! The entries of a file of OpenCV's `FileStorage` into a projector, by the names that calibration programs use.

use super::entries::{Entries, Matrix};
use super::{pose, rotation, Frame, Intrinsics, LensKind, ReadOptions, StorageError, StoredCalibration};
use crate::geometry::lens::Lens;
use crate::geometry::projector::ProjectorCamera;
use dpm_device::planes::Raster;
use glam::{DMat3, DVec3};

/// Intrinsics that are certainly a projector's.
const PROJECTOR: &[&str] = &["proj_int", "proj_K"];
const INTRINSICS: &[&str] =
    &["proj_int", "proj_K", "camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "mtx"];
const PROJECTOR_DISTORTION: &[&str] = &["proj_dist", "proj_kc"];
const DISTORTION: &[&str] = &[
    "distortion_coefficients",
    "distCoeffs",
    "distortion_coeffs",
    "Distortion_Coefficients",
    "dist_coeffs",
    "D",
    "dist",
];
const ROTATION: &[&str] = &[
    "R",
    "rotation",
    "roration",
    "R_cp",
    "cam_proj_rotation",
    "rotationVector",
    "rotationMatrix",
    "rvec",
    "rotation_matrix",
    "rotation_vector",
];
const TRANSLATION: &[&str] = &[
    "T",
    "translation",
    "t",
    "T_cp",
    "cam_proj_translation",
    "translationVector",
    "tvec",
    "translation_vector",
];
/// Poses by these names take a camera's frame to the projector's (procam-calibration writes `roration`).
const FROM_CAMERA: &[&str] = &["roration", "R_cp", "cam_proj_rotation", "T_cp", "cam_proj_translation"];
/// If a file has one of these beside a projector's intrinsics, then its pose leads from this camera to the projector.
const CAMERA: &[&str] = &["cam_int", "cam_K", "cam_dist", "cam_kc"];
/// Poses of many views, of which none is the projector's.
const VIEWS: &[&str] = &["extrinsic_parameters", "Extrinsic_Parameters", "rvecs", "tvecs"];
/// Columns and rows of the raster.
const SIZES: &[(&str, &str)] = &[
    ("image_width", "image_height"),
    ("imageSize_width", "imageSize_height"),
    ("image_Width", "image_Height"),
];
const PROJECTOR_SIZES: &[(&str, &str)] = &[("proj_width", "proj_height")];
/// Matrices that say nothing more of the projector: other forms of what was read, the camera's own part, and what a
/// calibration was computed from.
const BYPRODUCTS: &[&str] = &[
    "img_shape",
    "E",
    "F",
    "rotationMatrix",
    "rotationAxis",
    "euler",
    "per_view_reprojection_errors",
    "Per_View_Reprojection_Errors",
    "image_points",
    "Image_points",
    "grid_points",
    "projection_matrix",
];

/// The part of a file that is looked for, its names, and those that an error shows.
struct Part {
    name: &'static str,
    names: &'static [&'static str],
    shown: &'static str,
}

/// A part that was found: its name in the file, and its numbers.
type Picked<'a> = (&'a str, &'a Matrix);

fn pick<'a>(all: &'a Entries, part: &Part, found: &mut Vec<String>) -> Result<Picked<'a>, StorageError> {
    let hit = part.names.iter().find_map(|n| Some((*n, all.matrix(n)?)));
    let Some((name, matrix)) = hit else {
        let of_pose = matches!(part.name, "rotation" | "translation");
        if let Some(views) = VIEWS.iter().find(|v| of_pose && all.names.contains(**v)) {
            let what = "holds the poses of a board in many views, and not the projector's in the world; add rvec and tvec, \
                        which take points of the world to the projector, for example from solvePnP";
            return Err(StorageError::value(views, what));
        }
        let has: Vec<&str> = all.matrices.keys().map(String::as_str).collect();
        let has = if has.is_empty() { "no matrix".into() } else { has.join(", ") };
        return Err(StorageError::Missing { part: part.name, names: part.shown, has });
    };
    if let Some(i) = matrix.data.iter().position(|v| !v.is_finite()) {
        return Err(StorageError::value(name, format!("number {i} is not finite")));
    }
    found.push(format!("{}: {name}", part.name));
    Ok((name, matrix))
}

fn intrinsics((name, k): Picked) -> Result<Intrinsics, StorageError> {
    if (k.rows, k.columns) != (3, 3) {
        return Err(StorageError::value(name, format!("is {} x {}, not 3 x 3", k.rows, k.columns)));
    }
    let (fx, skew, cx, fy, cy) = (k.data[0], k.data[1], k.data[2], k.data[4], k.data[5]);
    if (k.data[8] - 1.0).abs() > 1e-6 || k.data[3] != 0.0 || k.data[6] != 0.0 || k.data[7] != 0.0 {
        let what = "is not an upper triangular intrinsic matrix with 1 in its corner";
        return Err(StorageError::value(name, what));
    }
    if skew.abs() > 1e-3 * fx.abs() {
        return Err(StorageError::value(name, format!("has skew {skew}: calibrate without it")));
    }
    // OpenCV puts pixel centres at whole numbers, this project at halves.
    Ok(Intrinsics { fx, fy, cx: cx + 0.5, cy: cy + 0.5 })
}

fn rotation_of((name, r): Picked) -> Result<DMat3, StorageError> {
    let matrix = match (r.rows, r.columns) {
        (3, 3) => DMat3::from_cols_slice(&r.data).transpose(),
        (3, 1) | (1, 3) => DMat3::from_quat(dpm_common::so3::so3_exp(DVec3::from_slice(&r.data))),
        (rows, columns) => {
            let what = format!("is {rows} x {columns}, not 3 x 3 or a rotation vector");
            return Err(StorageError::value(name, what));
        }
    };
    let what = "is not a rotation (columns must be orthonormal, determinant +1)";
    rotation(matrix).ok_or_else(|| StorageError::value(name, what))
}

/// Whether the file says that its lens is a fisheye's; `None` if it says nothing.
fn says_fisheye(all: &Entries) -> Result<Option<(&'static str, bool)>, StorageError> {
    if let Some(flag) = all.numbers.get("fisheye_model") {
        return Ok(Some(("fisheye_model", *flag != 0.0)));
    }
    if let Some(word) = all.texts.get("fisheye_model") {
        return Ok(Some(("fisheye_model", word.eq_ignore_ascii_case("true"))));
    }
    let Some(model) = all.texts.get("distortion_model") else { return Ok(None) };
    match model.to_ascii_lowercase().as_str() {
        "fisheye" | "equidistant" => Ok(Some(("distortion_model", true))),
        "plumb_bob" | "rational_polynomial" | "radtan" | "brown" | "opencv" | "none" | "" => {
            Ok(Some(("distortion_model", false)))
        }
        _ => Err(StorageError::value(
            "distortion_model",
            format!("is {model:?}; known are plumb_bob, rational_polynomial, fisheye and equidistant"),
        )),
    }
}

fn lens(all: &Entries, distortion: Option<Picked>, kind: LensKind) -> Result<Lens, StorageError> {
    let fisheye = match (kind, says_fisheye(all)?) {
        (LensKind::Fisheye, Some((name, false))) => {
            let what =
                "says that the lens is no fisheye, but the rig file says calibration_lens = \"fisheye\"";
            return Err(StorageError::value(name, what));
        }
        (LensKind::Fisheye, _) => true,
        (LensKind::Auto, said) => said.is_some_and(|(_, fisheye)| fisheye),
    };
    let Some((name, d)) = distortion.filter(|(_, d)| !d.data.is_empty()) else {
        // An equidistant lens without coefficients still bends; OpenCV writes its four zeros.
        return match fisheye {
            false => Ok(Lens::default()),
            true => Lens::fisheye([0.0; 4]).map_err(|e| StorageError::lens("fisheye_model", e)),
        };
    };
    if !fisheye {
        return Lens::opencv(&d.data).map_err(|e| StorageError::lens(name, e));
    }
    match d.data.as_slice().try_into() {
        Ok(k) => Lens::fisheye(k).map_err(|e| StorageError::lens(name, e)),
        Err(_) => {
            let what = format!("has {} numbers, but a fisheye lens has 4", d.data.len());
            Err(StorageError::value(name, what))
        }
    }
}

fn image_size(all: &Entries, names: &[(&'static str, &str)]) -> Result<Option<(u32, u32)>, StorageError> {
    let pair = names.iter().find_map(|(w, h)| Some((*w, *all.numbers.get(*w)?, *all.numbers.get(*h)?)));
    let list = || {
        let size = all.matrix("imageSize").filter(|m| m.data.len() == 2)?;
        Some(("imageSize", size.data[0], size.data[1]))
    };
    let Some((name, width, height)) = pair.or_else(list) else { return Ok(None) };
    let side = |v: f64| {
        let known = (1.0..=f64::from(Raster::MAX_SIDE)).contains(&v) && v.fract() == 0.0;
        let what = || format!("is {width} x {height}, which is no size of a raster");
        known.then_some(v as u32).ok_or_else(|| StorageError::value(name, what()))
    };
    Ok(Some((side(width)?, side(height)?)))
}

/// Whose frame the pose is told in.
fn frame(all: &Entries, of_projector: bool, names: [&str; 2]) -> Frame {
    let by_name = names.into_iter().find(|n| FROM_CAMERA.contains(n));
    let by_camera = || CAMERA.iter().copied().find(|n| of_projector && all.names.contains(*n));
    by_name.or_else(by_camera).map_or(Frame::World, |name| Frame::Camera { name: name.into() })
}

/// Reads a calibration. Rotation and translation take points of the calibration's world, or of its camera, into the
/// projector's space: `x_proj = R x + T`, looking along +Z with y down, as in OpenCV.
pub(super) fn read(all: &Entries, options: &ReadOptions) -> Result<StoredCalibration, StorageError> {
    let mut found = Vec::new();
    let shown = "proj_int, proj_K, camera_matrix, cameraMatrix";
    let k = pick(all, &Part { name: "intrinsics", names: INTRINSICS, shown }, &mut found)?;
    let shown = "R, rotation, roration, rotationVector, rvec";
    let r = pick(all, &Part { name: "rotation", names: ROTATION, shown }, &mut found)?;
    let shown = "T, translation, translationVector, tvec";
    let t = pick(all, &Part { name: "translation", names: TRANSLATION, shown }, &mut found)?;
    let of_projector = PROJECTOR.contains(&k.0);
    let names = if of_projector { PROJECTOR_DISTORTION } else { DISTORTION };
    let d = match pick(all, &Part { name: "distortion", names, shown: "" }, &mut found) {
        Ok(d) => Some(d),
        Err(StorageError::Missing { .. }) => None,
        Err(other) => return Err(other),
    };
    let size = image_size(all, if of_projector { PROJECTOR_SIZES } else { SIZES })?;
    let k_at = intrinsics(k)?.at(size, options.raster)?;
    let turned = rotation_of(r)?;
    if t.1.data.len() != 3 {
        return Err(StorageError::value(t.0, format!("has {} numbers, not 3", t.1.data.len())));
    }
    let pose = pose(turned, DVec3::from_slice(&t.1.data) * options.unit.metres());
    let lens = lens(all, d, options.lens)?;
    let camera =
        ProjectorCamera::new(options.raster, pose, k_at.fx, k_at.fy, k_at.cx, k_at.cy)?.with_lens(lens)?;
    let read = [Some(k.0), Some(r.0), Some(t.0), d.map(|d| d.0)];
    let known = [CAMERA, BYPRODUCTS, VIEWS];
    let unread = all.matrices.keys().filter(|name| {
        let name = name.as_str();
        !read.contains(&Some(name)) && !known.iter().any(|list| list.contains(&name))
    });
    Ok(StoredCalibration {
        camera,
        frame: frame(all, of_projector, [r.0, t.0]),
        image_size: size,
        found,
        unread: unread.cloned().collect(),
    })
}
