//! What a rig needs outside this program and what can be seen missing at a glance, before scene and shaders take their
//! minute. A run ends by the first of it, and `dpm doctor` asks about all of it. Nothing is opened, lit or loaded.

use crate::config::RigConfig;
use crate::failure::{Failure, FailureKind};
use crate::pipeline::projector;
use crate::plan::scale::scale_of;
use dpm_render::gpu::{Gpu, GpuOptions};
use dpm_render::least_memory_bytes;

/// Something that a rig needs.
pub struct RigNeed {
    /// Its name.
    pub name: &'static str,
    look: fn(&RigConfig) -> Result<(), Failure>,
}

impl RigNeed {
    /// Looks whether the rig of `config` has it; milliseconds.
    ///
    /// # Errors
    /// It is missing, or this user may not use it. What is not seen at a glance is no error.
    pub fn look(&self, config: &RigConfig) -> Result<(), Failure> {
        (self.look)(config)
    }
}

/// The projector.
pub const PROJECTOR: RigNeed = RigNeed {
    name: "projector",
    look: |config| projector::look(config).map_err(|e| Failure::new(FailureKind::Device, e)),
};

/// The GPU.
pub const GPU: RigNeed = RigNeed {
    name: "GPU",
    look: |config| Gpu::look(&gpu_options(config)).map_err(|e| Failure::new(FailureKind::NoGpu, e)),
};

/// All parts; first what a person plugs in.
pub const PARTS: [RigNeed; 2] = [PROJECTOR, GPU];

/// Looks at all parts.
///
/// # Errors
/// The first that is missing.
pub fn look(config: &RigConfig) -> Result<(), Failure> {
    PARTS.iter().try_for_each(|part| part.look(config))
}

/// Frames that are in flight at least.
const FEWEST_SLOTS: usize = 2;

/// Which GPU the rig file asks for.
pub(crate) fn gpu_options(config: &RigConfig) -> GpuOptions {
    GpuOptions {
        validation: std::env::var_os("DPM_VALIDATION").is_some(),
        device: config.render.gpu.clone(),
        memory_bytes: least_memory_bytes(
            config.projector.raster(),
            scale_of(&config.render),
            &config.render.to_method(),
            FEWEST_SLOTS,
        ),
        ..GpuOptions::default()
    }
}
