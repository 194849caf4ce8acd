//! A Vulkan device into the stability cases that need one: the shaders that run in the rig, on whichever device is here.

use super::{gpu_chain, gpu_disocclusion, gpu_history, gpu_samplers, gpu_tracer, gpu_traversal, Case};
use crate::gpu::{Gpu, GpuOptions};
use std::sync::Arc;

/// The device, or why there is none.
pub type Device = Result<Arc<Gpu>, String>;

/// The first usable device, software included; with `DPM_VALIDATION` set, under the validation layer.
pub fn open() -> Device {
    let options = GpuOptions { validation: std::env::var_os("DPM_VALIDATION").is_some(), device: None };
    Gpu::open(&options).map_err(|e| e.to_string())
}

/// All cases on the device; without one they say what is missing.
pub fn cases(device: &Device) -> Vec<Case> {
    let mut all = gpu_tracer::cases(device);
    all.extend(gpu_traversal::cases(device));
    all.extend(gpu_history::cases(device));
    all.extend(gpu_disocclusion::cases(device));
    all.extend(gpu_samplers::cases(device));
    all.extend(gpu_chain::cases(device));
    all
}

/// A case on the device from its parts, in the order of [`Case::new`].
pub(super) fn on(
    device: &Device,
    name: &'static str,
    input: &'static str,
    oracle: &'static str,
    unit: &'static str,
    bound: f64,
    measure: fn(&Arc<Gpu>, u64) -> f64,
) -> Case {
    match device {
        Ok(gpu) => {
            let gpu = gpu.clone();
            Case::new(name, input, oracle, unit, bound, move |seed| measure(&gpu, seed))
        }
        Err(why) => {
            let missing = Some(format!("no Vulkan device: {why}"));
            Case { missing, ..Case::new(name, input, oracle, unit, bound, |_| f64::NAN) }
        }
    }
}
