//! A rig and a device into the words under which a measurement can be found again.

use dpm_common::fnv::Fnv;
use dpm_device::regular_file;
use dpm_render::gpu::DeviceSummary;
use dpm_rig::rig::Rig;
use serde::{Deserialize, Serialize};
use std::fmt::Write;
use std::path::Path;

/// What a measurement was made with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stamp {
    /// Vulkan device.
    pub device: String,
    /// Its driver and version.
    pub driver: String,
    /// The device runs on the CPU.
    pub software: bool,
    /// Version of this program.
    pub version: String,
    /// Commit that the program was compiled from, see [`dpm_common::commit::get`].
    #[serde(default)]
    pub commit: String,
    /// Hash of the rig (without what is written and how long it runs) and of the files that it names.
    pub config_hash: String,
    /// Columns and rows traced.
    pub raster: [u32; 2],
    /// Seed of the first run.
    pub seed: u64,
}

impl Stamp {
    /// Stamps measurements of `rig` on `device`.
    pub fn new(rig: &Rig, device: &DeviceSummary) -> Self {
        let raster = rig.camera.raster;
        Self {
            device: device.name.clone(),
            driver: device.driver.clone(),
            software: device.software,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            commit: dpm_common::commit::get().to_owned(),
            config_hash: config_hash(rig),
            raster: [raster.width(), raster.height()],
            seed: rig.config.render.seed,
        }
    }
}

impl Stamp {
    /// A line for people, with an empty one after it.
    pub(crate) fn line(&self) -> String {
        format!(
            "{} ({}), {} x {}, dpm {} of commit {}, configuration {}, seed {}\n\n",
            self.device,
            self.driver,
            self.raster[0],
            self.raster[1],
            self.version,
            self.commit,
            self.config_hash,
            self.seed
        )
    }

    /// The first columns of a table: device, driver, commit, config, seed.
    pub(crate) fn csv(&self) -> String {
        let quoted = |s: &str| format!("\"{}\"", s.replace('"', "'"));
        format!(
            "{},{},{},{},{}",
            quoted(&self.device),
            quoted(&self.driver),
            self.commit,
            self.config_hash,
            self.seed
        )
    }
}

fn config_hash(rig: &Rig) -> String {
    let c = &rig.config;
    let mut hash = Fnv::default();
    // Writing into a hash cannot fail.
    let _ = write!(hash, "{:?}{:?}{:?}{:?}{:?}", c.projector, c.observer, c.scene, c.render, c.tracker);
    let environment = match &c.scene.environment {
        dpm_rig::config::EnvironmentConfig::Image(image) => Some(image.file.as_path()),
        _ => None,
    };
    for file in [c.scene.file.as_deref(), environment].into_iter().flatten() {
        add_file(&mut hash, file);
    }
    hash.text()
}

/// Most bytes of an input file: more than any reader of one takes.
const MAX_INPUT_BYTES: u64 = 2 << 30;

/// The file's bytes. One that cannot be read any more counts as empty: the rig was built from it a moment ago.
fn add_file(hash: &mut Fnv, path: &Path) {
    hash.add(&regular_file::read(path, MAX_INPUT_BYTES).unwrap_or_default());
}
