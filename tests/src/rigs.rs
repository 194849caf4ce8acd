//! A small demo rig, run through the whole pipeline.

use dpm_device::planes::Raster;
use dpm_render::gpu::Gpu;
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::pipeline::{self, RunOptions, RunOutcome};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::sync::Arc;

/// The demo rig at `width` x `height`, with the settings `a.b=c` applied.
///
/// # Panics
/// A setting is refused.
pub fn demo_rig(width: u32, height: u32, settings: &[&str]) -> Arc<Rig> {
    let flags = settings.iter().map(|s| (*s).to_owned()).collect();
    let config = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
    let raster = Raster::new(width, height).expect("a small raster");
    Arc::new(Rig::build(&config, Some(raster)).unwrap_or_else(|e| panic!("{e}")))
}

/// Runs it for `frames` frames and keeps the last `keep` of them.
///
/// # Panics
/// The run fails.
pub fn run(gpu: &Arc<Gpu>, rig: &Arc<Rig>, frames: u64, keep: usize) -> (RunOutcome, Arc<RunMonitor>) {
    let monitor = Arc::new(RunMonitor::default());
    let options = RunOptions { frames, keep_frames: keep, ..RunOptions::default() };
    let outcome = pipeline::run(rig.clone(), gpu, options, &monitor).unwrap_or_else(|e| panic!("{e}"));
    (outcome, monitor)
}
