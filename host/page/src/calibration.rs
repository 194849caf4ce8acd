//! The calibration of a rig as a guided page: its steps, and the commands that do them.

use crate::site::Site;
use dpm_rig::calibration_steps::Steps;
use std::fmt;
use std::sync::Arc;

/// What the guided page of a calibration shows.
pub trait Guide: Send + Sync + fmt::Debug {
    /// The steps as they are now. It may read files.
    fn steps(&self) -> Steps;

    /// Device files that may be a light sensor.
    fn ports(&self) -> Vec<String>;
}

/// What is told of a calibration.
#[derive(Debug, serde::Serialize)]
pub(crate) struct Told {
    /// A rig runs, so its projector is taken.
    runs: bool,
    #[serde(flatten)]
    steps: Steps,
    /// Device files that may be a light sensor.
    ports: Vec<String>,
}

/// What there is to tell; `None` if reading it failed in a way that nobody foresaw.
pub(crate) async fn told(site: &Arc<Site>) -> Option<Told> {
    let (guide, runs) = (site.guide.clone(), site.run.is_some());
    // The disk may be slow, and an order must not wait for it.
    let read = tokio::task::spawn_blocking(move || Told { runs, steps: guide.steps(), ports: guide.ports() });
    read.await.ok()
}
