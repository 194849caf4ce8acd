//! A projector into a calibration file of OpenCV's `FileStorage`.

use dpm_scene::geometry::lens::LensModel;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DMat3, DQuat, DVec3};
use std::fmt::Write;
use std::path::Path;

/// A form of OpenCV's `FileStorage`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StorageForm {
    /// XML.
    Xml,
    /// YAML, as OpenCV writes it.
    Yaml,
    /// JSON.
    Json,
}

impl StorageForm {
    /// The form that OpenCV itself chooses for a file of this name: by the extensions xml, yml, yaml and json.
    pub fn of(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "xml" => Some(Self::Xml),
            "yml" | "yaml" => Some(Self::Yaml),
            "json" => Some(Self::Json),
            _ => None,
        }
    }
}

/// What is written under a name.
enum StoredValue {
    Whole(u32),
    Matrix { rows: usize, columns: usize, data: Vec<f64> },
}

impl StoredValue {
    fn column(data: Vec<f64>) -> Self {
        Self::Matrix { rows: data.len(), columns: 1, data }
    }
}

/// A calibration file that OpenCV and [`super::read`] can read: the raster, the intrinsics, the lens, and the rotation
/// vector and translation in metres from the world to OpenCV's camera axes.
///
/// Numbers are written with all their digits. OpenCV puts pixel centres at whole numbers, so the principal point is half
/// a pixel less than in [`ProjectorCamera`].
pub fn export(camera: &ProjectorCamera, form: StorageForm) -> String {
    let values = values(camera);
    let mut out = String::new();
    for (i, (name, value)) in values.iter().enumerate() {
        let comma = if i + 1 < values.len() { "," } else { "" };
        // Writing to a string cannot fail.
        let _ = match (form, value) {
            (StorageForm::Xml, StoredValue::Whole(n)) => writeln!(out, "<{name}>{n}</{name}>"),
            (StorageForm::Yaml, StoredValue::Whole(n)) => writeln!(out, "{name}: {n}"),
            (StorageForm::Json, StoredValue::Whole(n)) => writeln!(out, "    \"{name}\": {n}{comma}"),
            (StorageForm::Xml, StoredValue::Matrix { rows, columns, data }) => writeln!(
                out,
                "<{name} type_id=\"opencv-matrix\">\n  <rows>{rows}</rows>\n  <cols>{columns}</cols>\n  <dt>d</dt>\n  \
                 <data>\n    {}</data></{name}>",
                lines(data, " ", 4)
            ),
            (StorageForm::Yaml, StoredValue::Matrix { rows, columns, data }) => writeln!(
                out,
                "{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {} ]",
                lines(data, ", ", 7)
            ),
            (StorageForm::Json, StoredValue::Matrix { rows, columns, data }) => writeln!(
                out,
                "    \"{name}\": {{\n        \"type_id\": \"opencv-matrix\",\n        \"rows\": {rows},\n        \
                 \"cols\": {columns},\n        \"dt\": \"d\",\n        \"data\": [ {} ]\n    }}{comma}",
                lines(data, ", ", 12)
            ),
        };
    }
    match form {
        StorageForm::Xml => format!("<?xml version=\"1.0\"?>\n<opencv_storage>\n{out}</opencv_storage>\n"),
        StorageForm::Yaml => format!("%YAML:1.0\n---\n{out}"),
        StorageForm::Json => format!("{{\n{out}}}\n"),
    }
}

/// The numbers of a matrix, three a line. OpenCV's YAML demands that a line begins farther right than its key.
fn lines(data: &[f64], between: &str, indent: usize) -> String {
    let mut out = String::new();
    for (i, value) in data.iter().enumerate() {
        if i > 0 {
            out.push_str(between);
            if i % 3 == 0 {
                out.truncate(out.trim_end().len());
                let _ = write!(out, "\n{:indent$}", "");
            }
        }
        let _ = write!(out, "{value:?}");
    }
    out
}

fn values(camera: &ProjectorCamera) -> Vec<(&'static str, StoredValue)> {
    let k = vec![camera.fx, 0.0, camera.cx - 0.5, 0.0, camera.fy, camera.cy - 0.5, 0.0, 0.0, 1.0];
    let mut values = vec![
        ("image_width", StoredValue::Whole(camera.raster.width())),
        ("image_height", StoredValue::Whole(camera.raster.height())),
        ("camera_matrix", StoredValue::Matrix { rows: 3, columns: 3, data: k }),
    ];
    match camera.lens.model() {
        LensModel::Pinhole => {}
        LensModel::Brown(c) => {
            let used = c.iter().rposition(|v| *v != 0.0).map_or(0, |i| i + 1);
            let count = [4, 5, 8, 12, 14].into_iter().find(|n| *n >= used).unwrap_or(14);
            values.push(("distortion_coefficients", StoredValue::column(c[..count].to_vec())));
        }
        LensModel::Fisheye(k) => {
            values.push(("distortion_coefficients", StoredValue::column(k.to_vec())));
            values.push(("fisheye_model", StoredValue::Whole(1)));
        }
    }
    let pose = camera.world_from_projector;
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let turned = flip * pose.matrix3.transpose();
    let vector = dpm_common::so3::so3_log(DQuat::from_mat3(&turned).normalize());
    values.push(("rvec", StoredValue::column(vector.to_array().into())));
    values.push(("tvec", StoredValue::column((-(turned * pose.translation)).to_array().into())));
    values
}
