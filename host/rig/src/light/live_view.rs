//! The collector's figures for those who look at the run while it goes on.

use super::collector::Collector;
use crate::frame::job::FrameNote;
use crate::rig::Rig;
use crate::telemetry::flight::FlightRecorder;
use crate::telemetry::histogram_steps::Steps;
use crate::telemetry::interval::Interval;
use crate::telemetry::live::{Live, LiveBody, LiveFrame, LiveInterval, LiveSnapshot};
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::report::Report;

/// Every tracked body before the first frame.
pub(super) fn bodies_of(rig: &Rig) -> Vec<LiveBody> {
    let unseen = |name: &String| LiveBody { name: name.clone(), seen: false, dark: None, at_m: [0.0; 3] };
    rig.bodies.iter().map(|body| unseen(&body.name)).collect()
}

impl Collector {
    /// Remembers what a finished frame was drawn for; its poses only if somebody looks.
    pub(super) fn look_at(&mut self, note: &FrameNote, live: &Live) {
        let plan = &note.plan;
        if live.is_looked_at() {
            live.drew(plan.id.0 as u32, &plan.tracked_poses, &plan.dark, plan.gaze);
        }
        let (frame, bodies) = &mut self.newest_live;
        *frame = LiveFrame {
            id: plan.id.0,
            sample_age_ns: plan.oldest_captured_at().map(|at| plan.due_at.ns_since(at)),
            budget_spp: plan.budget_milli as f64 / 1e3,
            parameters: plan.parameters,
            predict_ns: plan.predict_ns,
            due_at: plan.due_at,
        };
        let states = plan.seen.iter().zip(&plan.dark).zip(&plan.tracked_poses);
        for (body, ((seen, dark), pose)) in bodies.iter_mut().zip(states) {
            (body.seen, body.dark) = (*seen, *dark);
            body.at_m = pose.translation.to_array();
        }
    }

    /// Publishes the figures. It takes about two milliseconds of the collector's thread.
    pub(super) fn tell_live(&self, monitor: &RunMonitor, is_final: bool) {
        let rig = &self.rig;
        let mut report = Report {
            raster: [rig.camera.raster.width(), rig.camera.raster.height()],
            planes: rig.schedule.len() as u32,
            frame_rate_hz: rig.rate().hz(),
            pace: rig.config.real_time.pace.word(),
            method: rig.config.render.method.word(),
            prediction: rig.config.prediction.on,
            projector: Some(monitor.carried()),
            predict_ms: self.newest_live.0.predict_ns as f64 * 1e-6,
            light_s: monitor.light_times_s(),
            stopped: monitor.stop_requested(),
            ..Report::default()
        };
        self.fill(&mut report);
        let intervals = Interval::ALL.into_iter().map(|interval| LiveInterval {
            name: interval.name(),
            modelled: self.profiler.is_modelled(interval),
            steps: Steps::of(self.profiler.histogram(interval)),
        });
        monitor.live().tell(LiveSnapshot {
            report,
            is_final,
            bodies: self.newest_live.1.clone(),
            intervals: intervals.collect(),
            frame: self.newest_live.0,
            planned: monitor.counts().frames_planned,
            rays: self.rays,
            walked_rays: self.walked_rays,
            samples: self.samples,
            misses: self.misses.newest(),
            flights: self.flights.as_ref().map(FlightRecorder::flights),
        });
    }
}
