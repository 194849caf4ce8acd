//! Calibration files of other programs into the projector that they describe, and back.
//!
//! Read are OpenCV's `FileStorage` as XML, YAML and JSON, also compressed by gzip, with the names that calibration programs
//! give to the entries (`names.rs` has the table of dialects), and the profile `sl` of MPCDI, also in its archive. The text
//! itself bounds all sizes: nothing is allocated ahead of the data.

mod archive;
mod devices;
mod entries;
mod export;
mod foreign;
mod json;
mod mpcdi;
mod names;
mod xml;
mod yaml;

#[cfg(test)]
mod dialect_tests;
#[cfg(test)]
mod tests;

pub use entries::{Entries, FileEntry, Matrix};
pub use export::{export, StorageForm};

use dpm_device::planes::Raster;
use dpm_scene::geometry::lens::LensError;
use dpm_scene::geometry::projector::{ProjectorCamera, ProjectorError};
use glam::{DAffine3, DMat3, DVec3};
use thiserror::Error;

/// Largest accepted file, bytes.
pub const MAX_BYTES: usize = 1 << 20;

/// The unit of lengths in a file; the numbers do not reveal it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LengthUnit {
    /// 1 m.
    Metre,
    /// 1e-2 m.
    Centimetre,
    /// 1e-3 m.
    Millimetre,
}

impl LengthUnit {
    /// Its length in metres.
    pub const fn metres(self) -> f64 {
        match self {
            Self::Metre => 1.0,
            Self::Centimetre => 1e-2,
            Self::Millimetre => 1e-3,
        }
    }
}

/// The model that four distortion coefficients belong to; their number does not reveal it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LensKind {
    /// What the file says (`fisheye_model`, `distortion_model`); the model of Brown if it says nothing.
    #[default]
    Auto,
    /// OpenCV's model `fisheye`.
    Fisheye,
}

/// What the reader must be told, because no file says it.
#[derive(Clone, Copy, Debug)]
pub struct ReadOptions<'a> {
    /// The raster of the projector that is wanted. A file for another raster of the same shape is scaled to it.
    pub raster: Raster,
    /// Unit of the file's lengths.
    pub unit: LengthUnit,
    /// Model of the lens.
    pub lens: LensKind,
    /// The region of an MPCDI file, which may hold several projectors.
    pub region: Option<&'a str>,
    /// The device of a file that describes several.
    pub device: Option<&'a str>,
}

/// In what the pose of a file's projector is told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PoseFrame {
    /// In the world of whoever calibrated.
    World,
    /// In the frame of the camera that calibrated it: +X right, +Y down, looking along +Z.
    Camera {
        /// The entry of the file that shows it.
        name: String,
    },
    /// In a world in which this camera of the file stands at the origin, with the axes of [`Self::Camera`]. It may be the
    /// rig's world, and the file does not say so.
    WorldOfCamera {
        /// The camera.
        name: String,
    },
}

/// The content of a calibration file.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredCalibration {
    /// The projector with its lens, at [`ReadOptions::raster`], in [`Self::frame`], metres.
    pub camera: ProjectorCamera,
    /// The frame of its pose.
    pub frame: PoseFrame,
    /// Columns and rows of the raster that the file names, if it names one.
    pub image_size: Option<(u32, u32)>,
    /// Names under which the parts were found, for the operator.
    pub found: Vec<String>,
    /// Paths of the entries, devices and maps that were not used, for the operator.
    pub unread: Vec<String>,
    /// What may be wrong with the file, one sentence each, for the operator.
    pub notes: Vec<String>,
}

impl StoredCalibration {
    /// The projector in the world, if the file's frame is that of a camera with this pose.
    pub fn seen_from(&self, world_from_camera: DAffine3) -> ProjectorCamera {
        ProjectorCamera {
            world_from_projector: world_from_camera * self.camera.world_from_projector,
            ..self.camera
        }
    }
}

/// Why a file does not yield a calibration.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum StorageError {
    /// Larger than [`MAX_BYTES`].
    #[error("calibration file has {0} bytes, at most {MAX_BYTES} are accepted")]
    TooLarge(usize),
    /// No form is recognised.
    #[error(
        "calibration file is neither YAML of OpenCV, ROS or kalibr nor OpenCV XML (<opencv_storage>), JSON or MPCDI (<MPCDI>); \
         save the matrix K, the coefficients dist, rvec and tvec as JSON"
    )]
    UnknownForm,
    /// A known form that is not read.
    #[error("calibration file: {0}")]
    Refused(String),
    /// The text breaks the rules of its form.
    #[error("calibration file: {form}, line {line}: {what}")]
    Syntax {
        /// Name of the form.
        form: &'static str,
        /// Line, from 1 on.
        line: usize,
        /// The problem.
        what: String,
    },
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
    /// The file is for a raster of another shape.
    #[error(
        "calibration file: it is for {} x {} pixels, which cannot be scaled to {} x {}: the shapes differ. Calibrate at the \
         projector's own resolution",
        file.0, file.1, rig.0, rig.1
    )]
    ImageSize {
        /// Columns and rows that the file names.
        file: (u32, u32),
        /// Columns and rows that are wanted.
        rig: (u32, u32),
    },
    /// The intrinsics are refused.
    #[error("calibration file: {0}")]
    Projector(#[from] ProjectorError),
}

impl StorageError {
    fn matrix(name: &str, what: impl Into<String>) -> Self {
        Self::Matrix { name: name.into(), what: what.into() }
    }

    fn value(name: &str, what: impl Into<String>) -> Self {
        Self::Value { name: name.into(), what: what.into() }
    }

    fn lens(name: &str, error: LensError) -> Self {
        Self::value(
            name,
            match error {
                LensError::Count(n) => format!("has {n} numbers; 4, 5, 8, 12 or 14 are known"),
                other => format!("is not a lens: {other}"),
            },
        )
    }
}

/// Every entry of a file of OpenCV's `FileStorage`, by name.
///
/// # Errors
/// The file is of another form, or malformed.
pub fn entries(text: &str) -> Result<Entries, StorageError> {
    if text.len() > MAX_BYTES {
        return Err(StorageError::TooLarge(text.len()));
    }
    let text = text.trim_start_matches('\u{feff}').trim_start();
    if text.contains("<opencv_storage") {
        xml::Document::parse(text)?.entries()
    } else if text.starts_with(['{', '[']) || text.starts_with("//") {
        json::entries(text)
    } else if text.starts_with("%YAML") || text.contains("!!opencv-matrix") || has_names(text) {
        yaml::entries(text)
    } else {
        Err(StorageError::UnknownForm)
    }
}

/// Whether a text without a mark of its form has a line that names something known, as YAML does.
fn has_names(text: &str) -> bool {
    let is_known = |line: &str| {
        let (key, _) = line.trim_start().trim_start_matches("- ").split_once(':')?;
        names::meaning(key.trim().trim_matches('"'))
    };
    text.lines().take(10_000).any(|line| is_known(line).is_some() || line.trim_start().starts_with("rows:"))
}

/// Reads a calibration file of any known form.
///
/// # Errors
/// The form is unknown or refused, a part is missing or has unusable numbers, the raster has another shape, or the lens
/// cannot be inverted over it. Every error says what to do or what was expected.
pub fn read(bytes: &[u8], options: &ReadOptions) -> Result<StoredCalibration, StorageError> {
    read_for(bytes, options, Purpose::Place)
}

/// Reads the lens of a camera that stands alone: its place is told elsewhere, and a pose in the file is not looked at. The
/// camera stands at the origin, looks along -Z and has +Y up.
///
/// # Errors
/// As [`read`], but a file without a pose is as good as one with it.
pub fn read_lens(bytes: &[u8], options: &ReadOptions) -> Result<StoredCalibration, StorageError> {
    let mut stored = read_for(bytes, options, Purpose::Lens)?;
    (stored.camera.world_from_projector, stored.frame) = (DAffine3::IDENTITY, PoseFrame::World);
    Ok(stored)
}

/// What a file is read for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Purpose {
    /// Lens and place.
    Place,
    /// The lens.
    Lens,
}

fn read_for(
    bytes: &[u8],
    options: &ReadOptions,
    purpose: Purpose,
) -> Result<StoredCalibration, StorageError> {
    if bytes.len() > MAX_BYTES {
        return Err(StorageError::TooLarge(bytes.len()));
    }
    if bytes.starts_with(b"PK\x03\x04") {
        return mpcdi::read(&archive::mpcdi(bytes)?, options);
    }
    if bytes.starts_with(&[0x1f, 0x8b]) {
        return read_for(archive::unpacked(bytes)?.as_slice(), options, purpose);
    }
    if let Some((_, told)) = REFUSED.iter().find(|(start, _)| bytes.starts_with(start)) {
        return Err(StorageError::Refused((*told).into()));
    }
    let text = std::str::from_utf8(bytes)
        .map_err(|_| StorageError::Refused("it is not a text file (UTF-8)".into()))?;
    if text.contains("<MPCDI") {
        return mpcdi::read(text, options);
    }
    if let Some(refused) = foreign::refused_text(text) {
        return Err(refused);
    }
    let mut all = entries(text)?;
    foreign::join_chain(&mut all)?;
    devices::read(&all, options, purpose).map_err(|e| foreign::explained(e, &all))
}

/// First bytes of forms that are not read, with what to give instead.
const REFUSED: &[(&[u8], &str)] = &[
    (
        b"vwf",
        "it is a warp file of VIOSO (.vwf), which holds the picture's warp and not the projector's lens and place; export \
         MPCDI with the profile sl, or OpenCV XML, YAML or JSON",
    ),
    (
        b"\x93NUMPY",
        "it is one array of numpy (.npy); save mtx, dist, rvec and tvec as JSON: json.dump({\"K\": mtx.tolist(), ...}, file)",
    ),
    (b"\x80\x02", PICKLE),
    (b"\x80\x03", PICKLE),
    (b"\x80\x04", PICKLE),
    (b"\x80\x05", PICKLE),
    (
        b"MATLAB",
        "it is a .mat file of MATLAB; save the intrinsic matrix (transposed if it has the principal point in its last row), the \
         distortion, the rotation and the translation as JSON with the names K, dist, R and T",
    ),
    (
        b"\x89HDF",
        "it is an HDF5 file, perhaps a .mat of MATLAB 7.3; save K, dist, R and T of the projector as JSON",
    ),
];
const PICKLE: &str =
    "it is a pickle of Python, which only a program may read; save mtx, dist, rvec and tvec as JSON: \
                      json.dump({\"K\": mtx.tolist(), ...}, file)";

/// Intrinsics in this project's pixels: the raster's corner is at (0, 0), and pixel centres are at halves.
struct Intrinsics {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
}

impl Intrinsics {
    /// The same intrinsics for `raster`, when they were told for a raster of `size`.
    fn at(self, size: Option<(u32, u32)>, raster: Raster) -> Result<Self, StorageError> {
        let rig = (raster.width(), raster.height());
        let Some(file) = size.filter(|size| *size != rig) else { return Ok(self) };
        let [x, y] = [(rig.0, file.0), (rig.1, file.1)].map(|(to, from)| f64::from(to) / f64::from(from));
        // Sides are whole numbers: 1366 x 768 and 1920 x 1080 are of one shape.
        if (x / y - 1.0).abs() > 0.001 {
            return Err(StorageError::ImageSize { file, rig });
        }
        Ok(Self { fx: self.fx * x, fy: self.fy * y, cx: self.cx * x, cy: self.cy * y })
    }
}

/// The pose of a projector from the pose of its axes as OpenCV has them: x_proj = R x + t, looking along +Z, y down.
/// Ours looks along -Z with y up.
fn pose(rotation: DMat3, translation: DVec3) -> DAffine3 {
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    DAffine3::from_mat3_translation(rotation.transpose() * flip, -(rotation.transpose() * translation))
}

/// Makes a matrix a rotation again, since text has few digits; `None` if it is far from one.
fn rotation(matrix: DMat3) -> Option<DMat3> {
    let off = (matrix.transpose() * matrix - DMat3::IDENTITY).to_cols_array();
    // NaN compares false, so it counts as far.
    if !off.iter().all(|v| v.abs() <= 1e-3) || matrix.determinant() < 0.0 {
        return None;
    }
    let x = matrix.x_axis.normalize();
    let y = (matrix.y_axis - x * x.dot(matrix.y_axis)).normalize();
    Some(DMat3::from_cols(x, y, x.cross(y)))
}
