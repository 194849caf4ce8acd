//! A Vulkan device into the stability cases that need one: the shaders that run in the rig, on whichever device is here.

use super::{
    gpu_chain, gpu_disocclusion, gpu_filter, gpu_histories_in_motion, gpu_history, gpu_paper, gpu_relight,
    gpu_samplers, gpu_tracer, gpu_traversal, lobes, Case,
};
use dpm_render::gpu::{Gpu, GpuOptions};
use std::sync::Arc;

/// The device, or why there is none.
pub(crate) type Device = Result<Arc<Gpu>, String>;

/// The first usable device, software included; with `DPM_VALIDATION` set, under the validation layer.
pub fn open() -> Device {
    let options =
        GpuOptions { validation: std::env::var_os("DPM_VALIDATION").is_some(), ..GpuOptions::default() };
    Gpu::open(&options).map_err(|e| e.to_string())
}

/// A case that needs a device: name, input, oracle, unit, bound and measure, as [`Case::new`] takes them.
pub(crate) struct GpuCase(
    pub &'static str,
    pub &'static str,
    pub &'static str,
    pub &'static str,
    pub f64,
    pub fn(&Arc<Gpu>, u64) -> f64,
);

impl GpuCase {
    /// The case on a device; without one it says what is missing.
    fn on(&self, device: &Device) -> Case {
        let &Self(name, input, oracle, unit, bound, measure) = self;
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
}

/// All cases on the device.
pub fn cases(device: &Device) -> Vec<Case> {
    let all = [
        gpu_tracer::CASES,
        lobes::GPU_CASES,
        gpu_traversal::CASES,
        gpu_history::CASES,
        gpu_filter::CASES,
        gpu_relight::CASES,
        gpu_paper::CASES,
        gpu_disocclusion::CASES,
        gpu_histories_in_motion::CASES,
        gpu_samplers::CASES,
        gpu_chain::CASES,
    ];
    all.into_iter().flatten().map(|case| case.on(device)).collect()
}
