//! The sections of a calibration file, what may stand in them, and how they become the types of the solvers.

use crate::light::{Channels, FlatField, LightModel, CURVE_POINTS};
use crate::model::{ProjectorModel, LENS};
use crate::LightError;
use dpm_device::planes::Raster;
use dpm_scene::geometry::lens::Lens;
use dpm_scene::geometry::projector::{ProjectorCamera, ProjectorError};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// A number that cannot be.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("{key} {what}")]
pub struct Wrong {
    key: String,
    what: String,
}

impl Wrong {
    pub(super) fn new(key: impl Into<String>, what: impl Into<String>) -> Self {
        Self { key: key.into(), what: what.into() }
    }
}

fn within(key: &str, values: &[f64], low: f64, high: f64) -> Result<(), Wrong> {
    match values.iter().find(|v| !(low..=high).contains(*v)) {
        Some(v) => Err(Wrong::new(key, format!("is {v}, outside {low} to {high}"))),
        None => Ok(()),
    }
}

/// Where numbers come from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// Date and time of the measurement, UTC, RFC 3339.
    pub date: String,
    /// Device that was measured, as it names itself.
    pub device: String,
    /// What was measured: a file of samples or points, or a description.
    pub data: String,
    /// Commit of the program.
    pub commit: String,
    /// How it was solved, one sentence.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub method: String,
}

impl Provenance {
    /// What [`Provenance::method`] says of a part that was moved by hand, until its outlines fitted.
    pub const BY_EYE: &'static str = "nudged by eye";

    /// True for a part that was moved by hand.
    pub fn is_by_eye(&self) -> bool {
        self.method == Self::BY_EYE
    }
}

/// A rigid motion: `to = rotation * from + position`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pose {
    /// Metres.
    pub position: [f64; 3],
    /// Unit quaternion x, y, z, w.
    pub rotation: [f64; 4],
}

impl Pose {
    /// From a rigid motion.
    pub fn new(motion: &DAffine3) -> Self {
        let rotation = DQuat::from_mat3(&motion.matrix3).normalize();
        Self { position: motion.translation.to_array(), rotation: rotation.to_array() }
    }

    /// As a motion.
    pub fn to_affine(self) -> DAffine3 {
        let rotation = DMat3::from_quat(DQuat::from_array(self.rotation).normalize());
        DAffine3::from_mat3_translation(rotation, DVec3::from_array(self.position))
    }

    fn check(&self, key: &str) -> Result<(), Wrong> {
        within(&format!("{key}.position"), &self.position, -1e6, 1e6)?;
        within(&format!("{key}.rotation"), &self.rotation, -1.001, 1.001)?;
        let norm = self.rotation.iter().map(|v| v * v).sum::<f64>().sqrt();
        within(&format!("length of {key}.rotation"), &[norm], 0.999, 1.001)
    }
}

/// Lens and pose of the projector.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProjectorSection {
    /// Columns and rows of the raster that the numbers refer to.
    pub size: [u32; 2],
    /// Focal lengths across and down, pixels.
    pub focal: [f64; 2],
    /// Where the optical axis leaves, pixels from the upper left corner of the raster.
    pub centre: [f64; 2],
    /// Coefficients by OpenCV's definition and in its order: k1, k2, p1, p2, k3 and so on; none for a pinhole.
    #[serde(default)]
    pub lens: Vec<f64>,
    /// World from projector; the projector looks along -Z, +Y is up.
    pub world_from_projector: Pose,
    /// Predicted error of the light over the working volume, 99th percentile, pixels.
    pub predicted_p99_px: f64,
    /// Bias of the tracker that this prediction assumes, metres.
    pub assumed_bias_m: f64,
    /// Root mean square residual of the data, pixels.
    pub residual_px: f64,
    /// Where this comes from.
    pub provenance: Provenance,
}

impl ProjectorSection {
    /// From a solver's result, for a tracker without bias.
    pub fn new(
        raster: Raster,
        model: &ProjectorModel,
        predicted_p99_px: f64,
        residual_px: f64,
        provenance: Provenance,
    ) -> Self {
        Self {
            size: [raster.width(), raster.height()],
            focal: model.focal.to_array(),
            centre: model.centre.to_array(),
            lens: model.lens_numbers().to_vec(),
            world_from_projector: Pose::new(&model.world_from_projector()),
            predicted_p99_px,
            assumed_bias_m: 0.0,
            residual_px,
            provenance,
        }
    }

    /// The same for a tracker whose reports are off by `bias_m`, root mean square along one axis.
    pub fn assuming(mut self, predicted: &LightError, bias_m: f64) -> Self {
        let camera = self.world_from_projector.to_affine();
        let distance = camera.translation.distance(predicted.worst).max(1e-6);
        self.predicted_p99_px = predicted.with_bias(bias_m, self.focal[0].max(self.focal[1]) / distance);
        self.assumed_bias_m = bias_m;
        self
    }

    /// As a camera of the scene, at the raster it was measured with.
    ///
    /// # Errors
    /// A lens that cannot be inverted over the raster, and numbers that make no projector.
    pub fn camera(&self) -> Result<ProjectorCamera, ProjectorError> {
        let raster = Raster::new(self.size[0], self.size[1]).ok_or(ProjectorError::NotFinite("size"))?;
        let ([fx, fy], [cx, cy]) = (self.focal, self.centre);
        ProjectorCamera::new(raster, self.world_from_projector.to_affine(), fx, fy, cx, cy)?
            .with_lens(Lens::opencv(&self.lens)?)
    }

    /// As the solvers vary it, to begin from: `None` for a lens of more than twelve coefficients.
    pub fn model(&self) -> Option<ProjectorModel> {
        let mut lens = [0.0; LENS];
        lens.get_mut(..self.lens.len())?.copy_from_slice(&self.lens);
        Some(ProjectorModel::from_camera(&self.camera().ok()?, lens, DVec3::ZERO))
    }

    pub(super) fn check(&self) -> Result<(), Wrong> {
        if Raster::new(self.size[0], self.size[1]).is_none() {
            return Err(Wrong::new("projector.size", format!("is {:?}, which is no raster", self.size)));
        }
        within("projector.focal", &self.focal, 1e-3, 1e9)?;
        within("projector.centre", &self.centre, -1e6, 1e6)?;
        within("projector.lens", &self.lens, -1e6, 1e6)?;
        self.world_from_projector.check("projector.world_from_projector")?;
        within("projector.predicted_p99_px", &[self.predicted_p99_px], 0.0, 1e6)?;
        within("projector.assumed_bias_m", &[self.assumed_bias_m], 0.0, 1.0)?;
        within("projector.residual_px", &[self.residual_px], 0.0, 1e6)?;
        self.camera().map(|_| ()).map_err(|e| Wrong::new("projector", format!("is none: {e}")))
    }
}

/// The wand.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WandSection {
    /// Its tip in its body's frame, metres.
    pub tip: [f64; 3],
    /// Standard deviation of the tip, root of the sum over the axes, metres.
    pub tip_sigma_m: f64,
    /// Where this comes from.
    pub provenance: Provenance,
}

impl WandSection {
    pub(super) fn check(&self) -> Result<(), Wrong> {
        within("wand.tip", &self.tip, -10.0, 10.0)?;
        within("wand.tip_sigma_m", &[self.tip_sigma_m], 0.0, 1.0)
    }
}

/// A body.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BodySection {
    /// Body's frame from the mesh's.
    pub mesh_to_body: Pose,
    /// Root mean square residual, metres; absent where nothing was measured, because it was moved by eye.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub residual_m: Option<f64>,
    /// Where this comes from.
    pub provenance: Provenance,
}

impl BodySection {
    pub(super) fn check(&self, name: &str) -> Result<(), Wrong> {
        self.mesh_to_body.check(&format!("bodies.{name}.mesh_to_body"))?;
        within(&format!("bodies.{name}.residual_m"), self.residual_m.as_slice(), 0.0, 1.0)
    }
}

/// What `dpm calibrate check` found on a body.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CheckSection {
    /// Points that were measured.
    pub points: u32,
    /// Median error of the light, pixels.
    pub p50_px: f64,
    /// Largest error of the light, pixels.
    pub largest_px: f64,
    /// The largest error that was accepted, pixels.
    pub limit_px: f64,
    /// Where this comes from.
    pub provenance: Provenance,
}

impl CheckSection {
    /// True if no error was larger than the limit.
    pub fn is_within(&self) -> bool {
        self.largest_px <= self.limit_px
    }

    pub(super) fn check(&self, name: &str) -> Result<(), Wrong> {
        let errors = [self.p50_px, self.largest_px];
        within(&format!("errors of checks.{name}"), &errors, 0.0, 1e9)?;
        within(&format!("checks.{name}.limit_px"), &[self.limit_px], 0.0, 1e6)
    }
}

/// Delays. Only the sum of the tracker's and the projector's can be measured by light.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LatencySection {
    /// A pose with stamp s shows where bodies were when light fell at s less this, microseconds.
    pub latency_us: f64,
    /// Standard deviation, microseconds.
    pub sigma_us: f64,
    /// Where this comes from.
    pub provenance: Provenance,
}

impl LatencySection {
    pub(super) fn check(&self) -> Result<(), Wrong> {
        within("latency.latency_us", &[self.latency_us], -2e5, 2e5)?;
        within("latency.sigma_us", &[self.sigma_us], 0.0, 1e6)
    }
}

/// Response, brightness and flat field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightSection {
    /// Columns and rows of the raster that the flat field refers to.
    pub size: [u32; 2],
    /// The rig file's `projector.weights` with which it was measured; older files do not name them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weights: Option<String>,
    /// For each channel, light over that at full code, at codes in equal steps from 0 to full: 0 first, 1 last.
    pub curves: Vec<Vec<f64>>,
    /// Light of each channel at full code over that of all; they add up to 1.
    pub intensity: Vec<f64>,
    /// Light at code 0 over full white.
    pub black: f64,
    /// Ambient light over full white where it was measured.
    pub ambient: f64,
    /// Brightness over the raster: of 1, x, y, x^2, x y, y^2, with x and y from -1 to 1; the first is 1.
    pub flat_field: [f64; 6],
    /// Three standard deviations of a level over full white.
    pub uncertainty: f64,
    /// Where this comes from.
    pub provenance: Provenance,
}

impl LightSection {
    /// From a solver's result.
    pub fn new(light: &LightModel, provenance: Provenance) -> Self {
        let (channels, flat) = (&light.channels, &light.flat);
        Self {
            size: [flat.raster.width(), flat.raster.height()],
            weights: None,
            curves: channels.curves.clone(),
            intensity: channels.intensity.clone(),
            black: channels.black,
            ambient: channels.ambient,
            flat_field: flat.terms,
            uncertainty: 3.0 * channels.sigma.hypot(flat.sigma),
            provenance,
        }
    }

    /// As the solvers have it.
    pub fn model(&self) -> Option<LightModel> {
        let channels = Channels {
            curves: self.curves.clone(),
            intensity: self.intensity.clone(),
            black: self.black,
            ambient: self.ambient,
            sigma: self.uncertainty / 3.0,
        };
        let raster = Raster::new(self.size[0], self.size[1])?;
        let flat = FlatField { terms: self.flat_field, ..FlatField::even(raster) };
        Some(LightModel { channels, flat })
    }

    pub(super) fn check(&self) -> Result<(), Wrong> {
        if Raster::new(self.size[0], self.size[1]).is_none() {
            return Err(Wrong::new("light.size", format!("is {:?}, which is no raster", self.size)));
        }
        if self.curves.len() != self.intensity.len() || !(1..=8).contains(&self.curves.len()) {
            return Err(Wrong::new("light.curves", "and light.intensity need one entry for each channel"));
        }
        for (i, curve) in self.curves.iter().enumerate() {
            let key = format!("light.curves[{i}]");
            within(&key, curve, 0.0, 1.0)?;
            let ends = [curve.first(), curve.last()] == [Some(&0.0), Some(&1.0)];
            let rises = curve.windows(2).all(|w| w[0] <= w[1]);
            if !(ends && rises && (2..=32 * CURVE_POINTS).contains(&curve.len())) {
                return Err(Wrong::new(key, "must rise from 0 to 1 and never fall"));
            }
        }
        within("light.intensity", &self.intensity, 0.0, 1.0)?;
        within("sum of light.intensity", &[self.intensity.iter().sum()], 0.999, 1.001)?;
        within("light.black", &[self.black], 0.0, 0.9)?;
        within("light.ambient", &[self.ambient], -1.0, 1e3)?;
        within("light.uncertainty", &[self.uncertainty], 0.0, 1.0)?;
        within("light.flat_field", &self.flat_field, -10.0, 10.0)
    }
}
