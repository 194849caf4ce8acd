//! What the page shows, as JSON.

use crate::shared::RunView;
use dpm_rig::control::rig_name;
use dpm_rig::gaze::GazeReport;
use dpm_rig::plan::dark::DarkCause;
use dpm_rig::telemetry::histogram_steps::UPPER_NS;
use dpm_rig::telemetry::light_state::LightState;
use dpm_rig::telemetry::live::LiveSnapshot;
use dpm_rig::telemetry::monitor::{RunCounts, RunMonitor};
use dpm_rig::telemetry::projector::ProjectorReport;
use dpm_rig::tracks::gauges::TrackerReport;
use serde_json::{json, Value};
use std::sync::Arc;

/// What changes from one moment to the next.
#[derive(Clone, Debug, serde::Serialize)]
pub(crate) struct Now {
    /// The process.
    pub pid: u32,
    /// Seconds since the page began.
    pub up_s: f64,
    pub light: LightNow,
    /// The order that stands and is kept over restarts.
    pub standing: Option<&'static str>,
    /// On what light depends, and whether it is permitted.
    pub interlock: Option<(String, bool)>,
    /// What the tracker says of bodies that it has not seen.
    pub tracker: Option<String>,
    /// The run is asked to end.
    pub is_stopping: bool,
    pub counts: RunCounts,
    /// Viewers of this page.
    pub viewers: usize,
}

/// The state of the light.
#[derive(Clone, Debug, serde::Serialize)]
pub(crate) struct LightNow {
    /// One of the six words of [`LightState::WORDS`], and the same as programs write it.
    pub word: &'static str,
    pub state: String,
    /// Why, and what to do; the bodies without light with their reasons. Empty where the word says everything.
    pub told: String,
    /// Mirrors were lit in the last second.
    pub is_lit: bool,
}

impl LightNow {
    fn of(monitor: &RunMonitor) -> Self {
        let state = monitor.light();
        let word = state.word();
        Self { word, state: LightState::name_of(word), told: monitor.light_told(), is_lit: state.is_lit() }
    }
}

/// The state at one moment.
pub(crate) struct RigState {
    pub now: Now,
    /// Per tracked body: its name, and why it has no light.
    pub bodies: Vec<(String, Option<DarkCause>)>,
    /// The collector's figures; `None` before the first ones.
    pub figures: Option<Arc<LiveSnapshot>>,
    /// What the link has carried.
    pub carried: ProjectorReport,
    /// What became of the tracker's samples; `None` before the first ones.
    pub tracker: Option<TrackerReport>,
    /// Where a device sees the observer look; `None` where none measures it.
    pub gaze: Option<GazeReport>,
    /// The bodies that show another program's pictures, and how many of them have come.
    pub pictures: Vec<(String, u64)>,
    setup: Value,
}

/// The state as it is sent.
#[derive(serde::Serialize)]
pub(crate) struct StateJson<'a> {
    pub now: &'a Now,
    pub figures: Value,
}

impl RigState {
    pub(crate) fn of(shared: &RunView) -> Self {
        let monitor = &shared.monitor;
        let now = Now {
            pid: std::process::id(),
            up_s: (shared.began.elapsed().as_secs_f64() * 1e3).round() / 1e3,
            light: LightNow::of(monitor),
            standing: shared.orders.kept().map(|order| order.word()),
            interlock: monitor.interlock().map(|i| (i.what().to_owned(), i.is_closed())),
            tracker: monitor.tracker().map(str::to_owned),
            is_stopping: monitor.stop_requested(),
            counts: monitor.counts(),
            viewers: shared.viewers(),
        };
        let figures = monitor.live().snapshot();
        let pictures = monitor.live().rig().map_or(Vec::new(), |rig| {
            rig.live_pictures().map(|(body, _, pictures)| (body.to_owned(), pictures.count())).collect()
        });
        let (tracker, gaze) = (monitor.sample_counts(), monitor.gaze().report());
        let bodies = monitor.bodies().into_iter().map(|(name, dark)| (name.to_owned(), dark)).collect();
        Self {
            now,
            bodies,
            figures,
            carried: monitor.carried(),
            tracker,
            gaze,
            pictures,
            setup: setup(shared),
        }
    }

    pub(crate) fn to_json(&self) -> StateJson<'_> {
        let mut figures = self.figures.as_ref().map_or(json!({}), |f| self.told_of(f));
        figures["setup"] = self.setup.clone();
        figures["link"] = json!(self.carried);
        figures["tracker"] = json!(self.tracker);
        figures["gaze"] = json!(self.gaze);
        StateJson { now: &self.now, figures }
    }

    fn told_of(&self, f: &LiveSnapshot) -> Value {
        let report = &f.report;
        let bodies: Vec<Value> = f
            .bodies
            .iter()
            .zip(&report.dark_by_body)
            .zip(&self.bodies)
            .map(|((body, dark), (_, why))| {
                let (cause, told) = match why {
                    Some(cause) => (Some(cause.name()), Some(cause.told().to_owned())),
                    None if self.now.light.is_lit => (None, None),
                    None => (Some("no_light"), Some(format!("the light is {}", self.now.light.word))),
                };
                json!({
                    "name": body.name,
                    "seen": body.seen,
                    "dark": cause,
                    "told": told,
                    "at_m": body.at_m,
                    "dark_frames": dark,
                })
            })
            .collect();
        let intervals: Vec<Value> = f
            .intervals
            .iter()
            .map(|i| {
                json!({
                    "name": i.name,
                    "modelled": i.modelled,
                    "count": i.steps.count,
                    "up_to": i.steps.up_to.as_slice(),
                })
            })
            .collect();
        let misses: Vec<Value> = f
            .misses
            .iter()
            .map(|m| {
                let ago_ns = f.frame.due_at.ns_since(m.begin).max(0);
                json!({ "slot": m.slot, "count": m.count, "cause": m.cause, "ago_s": ago_ns as f64 / 1e9 })
            })
            .collect();
        json!({
            "report": report,
            "is_final": f.is_final,
            "bodies": bodies,
            "intervals": intervals,
            "frame": {
                "id": f.frame.id,
                "parameters": f.frame.parameters,
                "sample_age_ms": f.frame.sample_age_ns.map(|ns| ns as f64 / 1e6),
                "budget_spp": f.frame.budget_spp,
                "predict_ms": f.frame.predict_ns as f64 / 1e6,
            },
            "misses": misses,
            "flights": f.flights,
            "rays": f.rays,
            "walked_rays": f.walked_rays,
            "samples": f.samples,
        })
    }
}

/// What stays the same for the whole run.
fn setup(shared: &RunView) -> Value {
    let mut all = json!({
        "rig": rig_name(),
        "version": env!("CARGO_PKG_VERSION"),
        "commit": dpm_common::commit::get(),
        "bounds_ms": UPPER_NS.map(|ns| ns as f64 / 1e6).as_slice(),
    });
    if let Some(rig) = shared.monitor.live().rig() {
        let config = &rig.config;
        all["projector"] = json!(config.projector.backend.word());
        all["tracker"] = json!(config.tracker.word());
        all["spp"] = json!(config.render.spp);
        all["frames"] = json!(config.run.frames);
        all["seconds"] = json!(config.run.seconds);
    }
    all
}
