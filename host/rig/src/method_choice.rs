//! `render.method = "auto"`: the method that a measurement found best for this scene, rig and device, read from its file before a run.
//!
//! `dpm plan RIG.toml --measure` measures and writes the file. Here nothing is measured: a run reads the file once, before its first
//! frame, so two runs of one seed stay the same bit for bit. What the file was measured of is in its name. Where the scene, the rig or the
//! device is another one there is no such file; then method `dpm` is used, and the run says so.

use crate::config::{RenderConfig, RenderMethod};
use crate::rig::Rig;
use crate::standing::state_folder;
use dpm_common::files::write_atomically;
use dpm_common::fnv::Fnv;
use dpm_device::regular_file;
use dpm_render::gpu::Gpu;
use dpm_scene::{Environment, Scene};
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Most bytes of a file: a hundred times what one has.
const MAX_BYTES: u64 = 1 << 18;
/// Folder of the files below that of the orders that stand.
const FOLDER: &str = "methods";
/// Most samples of a pixel, as in the rig file.
const MOST_SAMPLES: u32 = 4096;

/// What a method showed in the time of a frame of method `dpm`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MethodCandidate {
    /// Its name.
    pub method: String,
    /// Samples of a pixel with which its frames took that time.
    pub spp: f64,
    /// Time of its frames by those of `dpm`, drawn in turns.
    pub time_to_dpm: f64,
    /// RMS error of what the eye sees, by the mean radiance.
    pub error: f64,
    /// The same of two runs with seeds of their own.
    pub runs: [f64; 2],
}

/// The method that was chosen, and why.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MethodChoice {
    /// Hash of scene, rig and device, see [`key`].
    pub key: String,
    /// The method.
    pub method: String,
    /// Samples of a pixel: `render.spp`.
    pub spp: u32,
    /// Largest average of samples of a pixel: `render.budget_spp`.
    pub budget_spp: Option<f64>,
    /// Samples of a pixel by the visual angle: `render.paper.zone_spp`.
    pub zone_spp: [u32; 3],
    /// The device and its driver, for people.
    pub device: String,
    /// Commit of the program that measured.
    pub commit: String,
    /// All that were measured, best first.
    pub candidates: Vec<MethodCandidate>,
}

/// Why a file of a choice is not used.
#[derive(Debug, thiserror::Error)]
pub enum ChoiceError {
    /// It cannot be read.
    #[error("{path}: {source}")]
    Unreadable {
        /// The file.
        path: String,
        /// Why.
        source: std::io::Error,
    },
    /// It is none of this program, or of another measurement than its name says.
    #[error("{path}: {why}")]
    Damaged {
        /// The file.
        path: String,
        /// What is wrong.
        why: String,
    },
}

/// The folder of the files; `None` for a user without a home directory.
pub fn folder() -> Option<PathBuf> {
    state_folder().map(|state| state.join(FOLDER))
}

/// Names what a choice depends on: projector, observer, bodies with their motions, tracker, numbers of `[render]` but the seed, the content of the scene
/// with all its files, the raster, and the device as [`device_of`] has it. `rig` has its method as the rig file says.
pub fn key(rig: &Rig, device: &str) -> String {
    let (c, raster, mut hash) = (&rig.config, rig.camera.raster, Fnv::default());
    // Whatever the seed is, the method is one.
    let render = RenderConfig { seed: 0, ..c.render.clone() };
    // Writing into a hash cannot fail.
    let _ = write!(hash, "{:?}{:?}{:?}{render:?}{:?}", c.projector, c.observer, c.scene, c.tracker);
    let _ = write!(hash, "{raster:?}{device}");
    add_scene(&mut hash, &rig.scene);
    hash.text()
}

fn add_floats(hash: &mut Fnv, values: impl Iterator<Item = f32>) {
    values.for_each(|v| hash.add(&v.to_bits().to_le_bytes()));
}

fn add_scene(hash: &mut Fnv, scene: &Scene) {
    for body in &scene.bodies {
        let mesh = &body.mesh;
        // Writing into a hash cannot fail.
        let _ =
            write!(hash, "{}{:?}{}{:?}", body.name, body.tracked, body.projected, body.world_from_body_rest);
        let _ = write!(hash, "{:?}{:?}", body.motion, body.deforms);
        add_floats(hash, mesh.positions.iter().chain(&mesh.normals).flat_map(|v| v.to_array()));
        add_floats(hash, mesh.tangents.iter().flat_map(|v| v.to_array()));
        add_floats(hash, mesh.uvs.iter().flat_map(|v| v.to_array()));
        mesh.triangles.iter().flatten().chain(&mesh.materials).for_each(|i| hash.add(&i.to_le_bytes()));
    }
    let _ = write!(hash, "{:?}{:?}", scene.materials, scene.lights);
    for t in &scene.textures {
        let _ = write!(
            hash,
            "{} {} {} {:?} {:?} {} {:?}",
            t.width, t.height, t.srgb, t.wrap_u, t.wrap_v, t.nearest, t.ends_ns
        );
        t.texels.iter().for_each(|texel| hash.add(texel));
    }
    match &scene.environment {
        Environment::Constant(light) => add_floats(hash, light.to_array().into_iter()),
        Environment::Equirect { width, height, texels, rotation_rad } => {
            let _ = write!(hash, "{width} {height} {rotation_rad}");
            add_floats(hash, texels.iter().flat_map(|v| v.to_array()));
        }
    }
}

impl MethodChoice {
    /// The file of a key in a folder.
    pub fn path(folder: &Path, key: &str) -> PathBuf {
        folder.join(format!("method-{key}.json"))
    }

    /// Reads the choice for a key; `None` if there is none.
    ///
    /// # Errors
    /// A file that cannot be read, or holds anything else than a choice for this key.
    pub fn read(folder: &Path, key: &str) -> Result<Option<Self>, ChoiceError> {
        let path = Self::path(folder, key);
        let name = path.display().to_string();
        let text = match regular_file::read_text(&path, MAX_BYTES) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(ChoiceError::Unreadable { path: name, source }),
        };
        let damaged = |why: String| ChoiceError::Damaged { path: name.clone(), why };
        let choice: Self = serde_json::from_str(&text).map_err(|e| damaged(e.to_string()))?;
        match choice.why_unusable(key) {
            Some(why) => Err(damaged(why)),
            None => Ok(Some(choice)),
        }
    }

    fn why_unusable(&self, key: &str) -> Option<String> {
        let in_range = |spp: u32| (1..=MOST_SAMPLES).contains(&spp);
        if self.key != key {
            return Some(format!("it is of {}, and not of {key}", self.key));
        }
        if self.render_method().is_none() {
            return Some(format!("{:?} is no method", self.method));
        }
        let samples = in_range(self.spp) && self.zone_spp.into_iter().all(in_range);
        let budget = self.budget_spp.is_none_or(|b| (0.125..=f64::from(MOST_SAMPLES)).contains(&b));
        (!samples || !budget).then(|| format!("samples must be 1 to {MOST_SAMPLES}"))
    }

    fn render_method(&self) -> Option<RenderMethod> {
        RenderMethod::DRAWN.into_iter().find(|m| m.word() == self.method)
    }

    /// Writes the file.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn write(&self, folder: &Path) -> std::io::Result<PathBuf> {
        let path = Self::path(folder, &self.key);
        let text = serde_json::to_string_pretty(self)?;
        write_atomically(&path, |out| std::io::Write::write_all(out, text.as_bytes()))?;
        Ok(path)
    }

    /// Makes it the method of `rig`.
    pub fn apply(&self, rig: &mut Rig) {
        let render = &mut rig.config.render;
        render.method = self.render_method().unwrap_or(RenderMethod::Dpm);
        (render.spp, render.budget_spp, render.paper.zone_spp) = (self.spp, self.budget_spp, self.zone_spp);
    }

    /// The choice with its reason, one sentence.
    pub fn told(&self) -> String {
        let each: Vec<String> = self
            .candidates
            .iter()
            .map(|c| {
                let [a, b] = c.runs.map(|r| 100.0 * r);
                let (low, high) = (a.min(b), a.max(b));
                format!(
                    "{} {:.2} % ({low:.2} to {high:.2}) with {:.1} samples",
                    c.method,
                    100.0 * c.error,
                    c.spp
                )
            })
            .collect();
        format!(
            "{} by measurement on {}; error of what the eye sees by the mean light, in the time of a frame of dpm: {}",
            self.method,
            self.device,
            each.join(", ")
        )
    }
}

/// A device with its driver.
pub fn device_of(gpu: &Gpu) -> String {
    let device = gpu.summary();
    format!("{} ({})", device.name, device.driver)
}

/// Decides method "auto" of `rig` by its file, and keeps in the rig how; a rig with another method stays as it is.
pub fn decide(rig: &mut Rig, gpu: &Gpu) {
    decide_by(rig, &device_of(gpu), folder().as_deref());
}

/// The same by the files of a folder.
fn decide_by(rig: &mut Rig, device: &str, folder: Option<&Path>) {
    if rig.config.render.method != RenderMethod::Auto {
        return;
    }
    let read = folder.map_or(Ok(None), |folder| MethodChoice::read(folder, &key(rig, device)));
    let told = match read {
        Ok(Some(choice)) => {
            choice.apply(rig);
            choice.told()
        }
        other => {
            rig.config.render.method = RenderMethod::Dpm;
            let why = other
                .err()
                .map_or("nothing was measured for this scene, rig and device".into(), |e| e.to_string());
            format!("dpm without a measurement: {why}; `dpm plan RIG.toml --measure` measures")
        }
    };
    rig.method_choice = Some(told);
}

#[cfg(test)]
mod tests;
