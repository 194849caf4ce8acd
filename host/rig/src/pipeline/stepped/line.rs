//! The link's part: sends the frames of the current crew, then ends the light.

use super::crew::SteppedCrew;
use super::{is_lit, Machine, RunPart, SentFrame, Takes, NEVER};
use crate::engine::error::PipelineError;
use crate::engine::facts::Facts;
use crate::engine::link::{LinkStage, Offer};
use crate::engine::pace::Real;
use crate::engine::pulse::Pulse;
use crate::frame::job::{Fate, FrameJob};
use crate::light::notes::NoteSender;
use crate::pipeline::threads::STEP_NS;
use dpm_device::time::HostTime;
use dpm_device::transport::Transport;
use std::collections::VecDeque;
use std::sync::atomic::Ordering;

enum Doing {
    /// It waits for a frame, at most until `at`.
    Waits {
        at: HostTime,
    },
    /// It is busy with a frame before it offers it.
    Busy {
        at: HostTime,
        job: FrameJob,
    },
    /// It has offered the frame, and offers it again.
    Offers {
        at: HostTime,
        job: FrameJob,
    },
    /// It ends the light. `last`: when the last frame was sent.
    Ends {
        at: HostTime,
        last: HostTime,
    },
    /// It never returns.
    Hangs,
    Over,
}

/// See the module's documentation.
pub(super) struct SteppedLink {
    pub(super) stage: LinkStage<Real>,
    pub(super) pulse: Pulse,
    jobs: VecDeque<FrameJob>,
    /// `None` when no note will come any more.
    notes: Option<NoteSender>,
    doing: Doing,
    /// Per body: lit in the frame that is being sent.
    lit: Vec<bool>,
}

impl SteppedLink {
    pub(super) fn new(stage: LinkStage<Real>, notes: NoteSender, now: HostTime) -> Self {
        Self {
            stage,
            pulse: Pulse::new("link"),
            jobs: VecDeque::new(),
            notes: Some(notes),
            doing: Doing::Waits { at: now },
            lit: Vec::new(),
        }
    }

    pub(super) fn due(&self) -> HostTime {
        match &self.doing {
            Doing::Waits { at }
            | Doing::Busy { at, .. }
            | Doing::Offers { at, .. }
            | Doing::Ends { at, .. } => *at,
            Doing::Hangs | Doing::Over => NEVER,
        }
    }

    /// The projector is dark, and no note will come any more.
    pub(super) fn is_over(&self) -> bool {
        matches!(self.doing, Doing::Over)
    }

    /// A packed frame arrives.
    pub(super) fn take_in(&mut self, job: FrameJob, now: HostTime) {
        self.jobs.push_back(job);
        if let Doing::Waits { at } = &mut self.doing {
            *at = now.min(*at);
        }
    }

    /// The crew was abandoned: its frames are dropped.
    pub(super) fn abandoned(&mut self) {
        self.jobs.clear();
    }

    pub(super) fn advance<M: Machine>(
        &mut self,
        now: HostTime,
        facts: &Facts,
        machine: &mut M,
        medium: &mut dyn Transport,
        crew: Option<&mut SteppedCrew>,
    ) {
        match std::mem::replace(&mut self.doing, Doing::Over) {
            Doing::Waits { .. } => self.turn(now, facts, machine, medium, crew),
            Doing::Busy { job, .. } | Doing::Offers { job, .. } => {
                self.offer(now, job, machine, medium, crew);
            }
            Doing::Ends { last, .. } => self.end(now, last, medium, crew),
            other @ (Doing::Hangs | Doing::Over) => self.doing = other,
        }
    }

    /// Looks what there is to do.
    fn turn<M: Machine>(
        &mut self,
        now: HostTime,
        facts: &Facts,
        machine: &mut M,
        medium: &mut dyn Transport,
        crew: Option<&mut SteppedCrew>,
    ) {
        let is_finished = self.jobs.is_empty() && crew.as_ref().is_none_or(|crew| crew.is_finished());
        if facts.monitor.stop_requested() || is_finished && facts.is_complete.load(Ordering::Acquire) {
            return self.end(now, now, medium, crew);
        }
        self.pulse.beat(now, self.stage.expected_ns(STEP_NS));
        let frame = self.jobs.front().map_or(0, |job| job.note.plan.id.0);
        match machine.takes(RunPart::Link, frame, now) {
            Takes::Ns(ns) => match self.jobs.pop_front() {
                Some(job) => self.doing = Doing::Busy { at: now.plus_ns(ns), job },
                None => {
                    self.stage.poll(now, medium);
                    let rest_ns = self.stage.rest_ns(now);
                    self.doing = Doing::Waits { at: now.plus_ns(rest_ns + ns) };
                }
            },
            Takes::Forever => self.doing = Doing::Hangs,
            Takes::Panics => {
                facts.fail(PipelineError::Panicked("link"));
                self.end(now, now, medium, crew);
            }
        }
    }

    fn offer<M: Machine>(
        &mut self,
        now: HostTime,
        mut job: FrameJob,
        machine: &mut M,
        medium: &mut dyn Transport,
        crew: Option<&mut SteppedCrew>,
    ) {
        self.pulse.beat(now, self.stage.expected_ns(STEP_NS));
        let FrameJob { note, memory } = &mut job;
        let planes = memory.planes.bytes();
        if let Offer::Again(at) = self.stage.offer(now, note, planes, self.jobs.is_empty(), medium) {
            self.doing = Doing::Offers { at, job };
            return;
        }
        if note.is_sent() {
            let plan = &note.plan;
            self.lit.clear();
            self.lit.extend(plan.dark.iter().map(is_lit));
            machine.sent(&SentFrame {
                frame: plan.id.0 as u32,
                sent_at: now,
                due_at: plan.due_at,
                target_at: plan.target_at,
                dark_from: plan.dark_from,
                captured_at: plan.oldest_captured_at(),
                predict_ns: plan.predict_ns,
                poses: &plan.tracked_poses,
                centre_at: plan.centre_at,
                swept: plan.swept_poses.each_ref().map(Vec::as_slice),
                swept_at: plan.swept_at,
                lit: &self.lit,
                planes,
            });
        }
        self.stage.taken(note, now);
        self.settle(job, now, crew);
        self.doing = Doing::Waits { at: now };
    }

    fn settle(&mut self, mut job: FrameJob, now: HostTime, crew: Option<&mut SteppedCrew>) {
        if let Some(notes) = &mut self.notes {
            job.note = notes.exchange(job.note);
        }
        if let Some(crew) = crew {
            crew.returned(job, now);
        }
    }

    /// Ends the light, and then counts the frames that are still in flight.
    fn end(
        &mut self,
        now: HostTime,
        last: HostTime,
        medium: &mut dyn Transport,
        crew: Option<&mut SteppedCrew>,
    ) {
        self.pulse.beat(now, STEP_NS);
        if let Some(at) = self.stage.end(now, last, medium) {
            self.doing = Doing::Ends { at, last };
            return;
        }
        let mut left: Vec<_> = self.jobs.drain(..).collect();
        left.extend(crew.into_iter().flat_map(SteppedCrew::take_under_way));
        for mut job in left {
            job.note.fate = Fate::Stopped;
            self.settle(job, now, None);
        }
        self.pulse.end();
        self.notes = None;
        self.doing = Doing::Over;
    }
}
