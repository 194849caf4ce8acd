//! Combines finished frames and light into a report. It runs on its own thread beside the frame path, so it may
//! allocate.

use crate::config::{Pace, RenderScale};
use crate::frame::job::{Fate, FrameNote};
use crate::frame::slots::OrderedDark;
use crate::frame::{FrameTimeline, Stage, STAGES};
use crate::light::dark_bodies::DarkBodies;
use crate::light::eye_counts::EyeCounts;
use crate::light::live_view::bodies_of;
use crate::light::measures::{histogram, RegistrationMeasures};
use crate::light::notes::NoteReceiver;
use crate::light::placement::Placement;
use crate::light::record::FrameRecord;
use crate::light::recorder::{LightNote, LightReceiver};
use crate::plan::light_centre::light_centre_ns;
use crate::plan::scale::scale_of_run;
use crate::rig::Rig;
use crate::telemetry::flight::FlightRecorder;
use crate::telemetry::interval::Interval;
use crate::telemetry::live::{LiveBody, LiveFrame};
use crate::telemetry::miss_log::MissLog;
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::profile::{missed_by_cause, ordered_dark, Profiler};
use crate::telemetry::report::{Latency, Percentiles, Report, StageTime, TracedScale};
use crate::telemetry::signed::SignedHistogram;
use crate::telemetry::slots::{SlotCounts, SlotLedger};
use crate::telemetry::trace::TracedFrame;
use dpm_common::realtime::standstill::SeenStandstills;
use dpm_device::light::LightKind;
use dpm_device::link::frame_newer;
use dpm_device::time::HostTime;
use dpm_render::PASSES;
use hdrhistogram::Histogram;
use std::collections::VecDeque;
use std::sync::Arc;

/// Sent frames that may wait for their light. Beyond this number the oldest count as never lit, once no unread light
/// is left.
const MAX_PENDING: usize = 256;

/// The inputs of the collector.
pub(crate) struct Inbox {
    /// Frames that the link has finished with.
    pub notes: NoteReceiver,
    /// What the projector did in each slot.
    pub lights: LightReceiver,
}

/// Counts and distributions of a run.
pub(crate) struct Collector {
    pub(super) rig: Arc<Rig>,
    /// Light of a frame that the link has not yet reported as sent.
    held: Option<LightNote>,
    registration: RegistrationMeasures,
    placement: Placement,
    pending: VecDeque<FrameRecord>,
    /// The last lit frames, oldest first.
    pub recent: VecDeque<FrameRecord>,
    keep: usize,
    verify: bool,
    /// Frames are prepared, so their light does not depend on what the tracker sees.
    prepared: bool,
    /// Something is lit that is not tracked.
    has_still_light: bool,
    dark_bodies: DarkBodies,
    eyes: EyeCounts,
    lit: u64,
    /// Lit frames in which every body was dark.
    dark: u64,
    dropped: u64,
    /// Frames that were not lit because no new picture was wanted.
    withheld: u64,
    /// Frames of which this learnt nothing, at the end of the run.
    unrecorded: u64,
    /// First and last number of frames whose notes are missing, oldest first.
    gaps: VecDeque<(u32, u32)>,
    late: u64,
    repeated: u64,
    too_old: u64,
    /// What happened in each slot.
    pub slots: SlotLedger,
    /// Lit frames with parts of another frame (checked for prepared frames only).
    pub torn: u64,
    /// Frames lit after a newer one, or twice.
    pub reordered: u64,
    last_lit: Option<u32>,
    /// The newest frame that the link has finished with, low 32 bits.
    newest: Option<u32>,
    /// Slots in which the previous frame was repeated. They wait until a later slot is known to be planned.
    repeats: VecDeque<u64>,
    /// The last planned slot among the frames that the link has finished with.
    last_planned: Option<u64>,
    /// Lit frames whose light differed from what was rendered.
    pub light_mismatches: u64,
    /// Intervals of every lit frame.
    pub profiler: Profiler,
    /// The last lit frames for a trace, oldest first.
    pub traced: VecDeque<TracedFrame>,
    trace_frames: usize,
    /// `None` unless the rig file asks for it.
    pub(super) flights: Option<FlightRecorder>,
    pub(super) misses: MissLog,
    standstills: Option<Arc<SeenStandstills>>,
    /// What the operator should know about the files of the flight recorder.
    flights_told: Option<String>,
    /// True beginning of a slot, as observed by the mock in this process, minus the host's estimate.
    clock_error: SignedHistogram,
    stages: Vec<Histogram<u64>>,
    passes: Vec<Histogram<u64>>,
    pub(super) rays: u64,
    pub(super) walked_rays: u64,
    pub(super) samples: u64,
    gpu_ns: u64,
    /// Sum of the shares of the raster that drawn frames traced, the least of them, and the number of these frames.
    shares: (f64, f64, u64),
    lit_values: u64,
    clipped_values: u64,
    nan_values: u64,
    invalid_samples: u64,
    /// The newest finished frame.
    pub(super) newest_live: (LiveFrame, Vec<LiveBody>),
}

/// Number of frames in a trace, the last ones of a run: half a minute at 947 fps, about 60 MB. Viewers cannot handle
/// much more.
const MAX_TRACED: usize = 30_000;

/// What is kept of a frame until its light is seen.
fn record_of(job: &FrameNote) -> FrameRecord {
    FrameRecord {
        id: job.plan.id,
        slot: job.plan.slot,
        timeline: job.timeline,
        drawn_for: job.plan.centre_at,
        tracked_poses: job.plan.tracked_poses.clone(),
        swept_poses: job.plan.swept_poses.clone(),
        sampled_poses: job.plan.sampled_poses.clone(),
        dark: job.plan.dark.clone(),
        cut_mirrors: job.cut_mirrors,
        guard_radius_m: job.plan.eyes.spheres.iter().fold(0.0, |most, s| s.radius_m.max(most)),
        head_lost: job.plan.eyes.lost,
        eye: job.plan.eye,
        gaze: job.plan.gaze,
        parameters: job.plan.parameters,
        code_hash: job.code_hash,
        pass_ns: job.cost.unwrap_or_default().pass_ns,
    }
}

impl Collector {
    /// Keeps the last `keep` lit frames. `verify`: compares hashes of code values and light.
    pub(crate) fn new(rig: Arc<Rig>, keep: usize, verify: bool) -> Self {
        let measured = rig.config.real_time.pace == Pace::Real;
        // A tenth of a run of known length, but enough frames for a 99th percentile.
        let frames = rig.config.run.frames.max(rig.config.slots_to_run());
        let batch_frames = (frames / 10).clamp(100, 10_000);
        let is_mock_tracker = rig.config.tracker.is_mock();
        let is_mock_projector = rig.config.projector.backend.is_mock();
        let profiler =
            Profiler::new(rig.rate(), measured, batch_frames).with_mocks(is_mock_tracker, is_mock_projector);
        let lead_ns = i64::from(rig.config.real_time.stage_costs_us.total()) * 1000;
        let newest_live = (LiveFrame::default(), bodies_of(&rig));
        let trace_frames = if rig.config.output.trace { MAX_TRACED } else { 0 };
        let registration = RegistrationMeasures::new(rig.clone());
        Self {
            placement: Placement::new(rig.bodies.len()),
            dark_bodies: DarkBodies::new(rig.bodies.len()),
            eyes: EyeCounts::new(&rig),
            has_still_light: rig.scene.bodies.iter().any(|b| b.tracked.is_none() && b.projected),
            slots: SlotLedger::new(rig.rate(), lead_ns),
            rig,
            held: None,
            registration,
            pending: VecDeque::new(),
            recent: VecDeque::new(),
            keep,
            verify,
            prepared: false,
            lit: 0,
            dark: 0,
            dropped: 0,
            withheld: 0,
            unrecorded: 0,
            gaps: VecDeque::new(),
            late: 0,
            repeated: 0,
            too_old: 0,
            torn: 0,
            reordered: 0,
            last_lit: None,
            newest: None,
            repeats: VecDeque::new(),
            last_planned: None,
            light_mismatches: 0,
            profiler,
            traced: VecDeque::new(),
            trace_frames,
            flights: None,
            misses: MissLog::new(),
            standstills: None,
            flights_told: None,
            clock_error: SignedHistogram::new(1_000_000_000),
            stages: STAGES.iter().map(|_| histogram()).collect(),
            passes: PASSES.iter().map(|_| histogram()).collect(),
            rays: 0,
            walked_rays: 0,
            samples: 0,
            gpu_ns: 0,
            shares: (0.0, f64::INFINITY, 0),
            lit_values: 0,
            clipped_values: 0,
            nan_values: 0,
            invalid_samples: 0,
            newest_live,
        }
    }

    /// States whether frames are prepared, and gives access to the machine's standstills. Call it before the first
    /// frame.
    pub(crate) fn about(mut self, prepared: bool, standstills: Option<Arc<SeenStandstills>>) -> Self {
        self.prepared = prepared;
        if let Some(seen) = &standstills {
            self.slots.excuse_by(seen.clone());
        }
        self.standstills = standstills;
        self.slots.keep_misses();
        let output = &self.rig.config.output;
        if output.flight_recorder {
            match FlightRecorder::new(self.rig.rate().slot_len_ns(0), &output.dir) {
                Ok(recorder) => self.flights = Some(recorder),
                Err(e) => self.flights_told = Some(format!("output.flight_recorder: not started: {e}")),
            }
        }
        self
    }

    /// The run is over and everything is known. Returns what happened in every slot.
    pub(crate) fn finish(&mut self, monitor: &RunMonitor) -> SlotCounts {
        // Frames that were sent but never lit count as dropped.
        while !self.pending.is_empty() {
            self.drop_oldest(monitor);
        }
        self.slots.read_orders(monitor.dark());
        let counts = self.slots.finish();
        self.record_misses(monitor);
        if let Some(flights) = self.flights.take() {
            self.flights_told = flights.finish(self.standstills.as_deref());
        }
        monitor.set_slots(counts.wanted(), counts.missed_total());
        self.unrecorded = monitor.counts().frames_unrecorded;
        self.tell_live(monitor, true);
        counts
    }

    /// Passes the misses that were found to those who look at them.
    fn record_misses(&mut self, monitor: &RunMonitor) {
        while let Some((slot, begin, cause)) = self.slots.next_miss() {
            self.misses.add(slot, begin, cause);
            if let Some(flights) = &mut self.flights {
                flights.missed(slot, begin, cause);
            }
        }
        if let Some(flights) = &mut self.flights {
            flights.look(monitor, self.standstills.as_deref());
        }
    }

    /// Reads the frames that the link has finished with, and their light, as far as both have arrived. Calls `alive`
    /// for every note, because a long backlog takes seconds on a busy machine. True when both inputs have ended.
    pub(crate) fn look(&mut self, inbox: &mut Inbox, monitor: &RunMonitor, alive: &mut dyn FnMut()) -> bool {
        // Checked before reading: what arrived before the end must be read first.
        let no_more_notes = inbox.notes.is_finished();
        let over = no_more_notes && inbox.lights.notes.is_finished();
        self.slots.read_orders(monitor.dark());
        loop {
            let light = self.held.take().or_else(|| inbox.lights.notes.try_pop());
            // Read after the light: all frames before that light have been reported by then.
            self.take_finished(&mut inbox.notes, monitor, alive);
            // The frame was lit, but the link's thread has not reported it as sent yet.
            let unknown = |f: u32| self.newest.is_none_or(|n| frame_newer(f, n));
            // Or its slot is later than the slots of frames that are still to be read.
            let ahead =
                |slot: u64| !inbox.notes.is_empty() && self.last_planned.is_none_or(|last| last < slot);
            match light {
                Some(note)
                    if !ahead(note.event.slot)
                        && (no_more_notes || !note.event.frame.is_some_and(unknown)) =>
                {
                    while let Some(moves) = inbox.lights.moves_before(note.event.slot) {
                        self.registration.moved(&moves);
                    }
                    self.light(&note, monitor);
                }
                light => {
                    self.held = light;
                    if self.pending.len() < MAX_PENDING || inbox.notes.is_empty() {
                        break;
                    }
                    // More frames are waiting than may wait, and there is no light for the oldest.
                    self.drop_oldest(monitor);
                }
            }
        }
        self.slots.settle();
        self.record_misses(monitor);
        let slots = self.slots.counts();
        monitor.set_slots(slots.wanted(), slots.missed_total());
        if monitor.live().wants_snapshot() {
            self.tell_live(monitor, false);
        }
        over
    }

    /// Reads finished frames until no more may wait for their light. Light is checked before more frames are read,
    /// however long this thread stood still.
    fn take_finished(&mut self, notes: &mut NoteReceiver, monitor: &RunMonitor, alive: &mut dyn FnMut()) {
        while self.pending.len() < MAX_PENDING {
            let Some(note) = notes.try_pop() else { break };
            alive();
            self.finished(&note, monitor);
            notes.give_back(note);
        }
    }

    fn drop_oldest(&mut self, monitor: &RunMonitor) {
        if let Some(record) = self.pending.pop_front() {
            self.count_unlit(&record.timeline, monitor);
        }
    }

    /// Counts a frame that will never be lit: it was not wanted, or it was dropped. Frames in flight at the end of
    /// the run count as dropped.
    fn count_unlit(&mut self, timeline: &FrameTimeline, monitor: &RunMonitor) {
        match self.slots.ordered_dark(timeline.due_at) {
            None | Some(OrderedDark::Stop | OrderedDark::Exceeded) => {
                self.dropped += 1;
                monitor.count_dropped();
            }
            Some(_) => {
                self.withheld += 1;
                monitor.count_withheld();
            }
        }
    }

    /// The light of a frame left the projector.
    fn count_lit(&mut self, record: &FrameRecord, at: HostTime, late: bool, monitor: &RunMonitor) {
        let is_dark = self.is_dark(record);
        self.lit += u64::from(!is_dark);
        self.dark += u64::from(is_dark);
        self.late += u64::from(late);
        monitor.count_lit(is_dark, late);
        if let Some(told) = self.eyes.lit(record, at) {
            monitor.note(told);
        }
        if !self.prepared {
            let bodies = &self.rig.bodies;
            self.dark_bodies.lit(&record.dark, at, |body, told| {
                monitor.note(format!("{:?} {told}", bodies[body].name));
            });
        }
    }

    /// True if the frame was lit but its light fell nowhere.
    fn is_dark(&self, record: &FrameRecord) -> bool {
        if record.head_lost.is_some() {
            return true;
        }
        let nothing_tracked = record.dark.is_empty() || record.dark.iter().any(Option::is_none);
        !self.prepared && !self.has_still_light && !nothing_tracked
    }

    fn finished(&mut self, job: &FrameNote, monitor: &RunMonitor) {
        let id = job.plan.id.0 as u32;
        if job.is_after_gap {
            self.gaps.push_back((self.newest.map_or(0, |newest| newest.wrapping_add(1)), id.wrapping_sub(1)));
            if self.gaps.len() > MAX_PENDING {
                self.gaps.pop_front();
            }
        }
        self.newest = Some(id);
        self.look_at(job, monitor.live());
        if let Some(flights) = &mut self.flights {
            flights.frame(job);
        }
        self.add_costs(job);
        self.placement.observe(
            &self.rig.camera,
            &job.plan.sampled_poses,
            &job.plan.seen,
            self.registration.points(),
            job.timeline.due_at,
        );
        let names = self.rig.bodies.iter().map(|b| b.name.as_str());
        self.placement.news(names, |told| monitor.note(told));
        let sent = job.is_sent();
        let refused = !sent && !matches!(job.fate, Fate::Overtaken | Fate::Stopped);
        self.slots.planned(job.plan.slot, &job.timeline, refused, job.held_up_by);
        self.last_planned = self.last_planned.max(Some(job.plan.slot));
        while self.repeats.front().is_some_and(|&slot| slot < job.plan.slot) {
            self.repeats.pop_front();
            self.repeated += 1;
        }
        if sent {
            self.pending.push_back(record_of(job));
        } else {
            self.too_old += u64::from(job.fate == Fate::TooOld);
            self.count_unlit(&job.timeline, monitor);
        }
    }

    /// Adds the rays, samples and times of a frame.
    fn add_costs(&mut self, job: &FrameNote) {
        let cost = job.cost.unwrap_or_default();
        let c = cost.counters();
        self.rays += u64::from(c.rays);
        self.walked_rays += u64::from(c.walked_rays());
        self.samples += u64::from(c.samples);
        self.gpu_ns += cost.pass_ns.iter().sum::<u64>();
        if job.cost.is_some() {
            let scale = scale_of_run(&self.rig);
            let shares = scale.shares();
            let share = shares[job.plan.rung.min(shares.len() - 1)];
            let (sum, least, frames) = self.shares;
            self.shares = (sum + share, least.min(share), frames + 1);
        }
        self.lit_values += 3 * u64::from(c.lit_pixels);
        self.clipped_values += u64::from(c.clipped_values);
        self.nan_values += u64::from(c.nan_values);
        self.invalid_samples += u64::from(c.invalid_samples);
        for (histogram, &ns) in self.passes.iter_mut().zip(&cost.pass_ns) {
            // 0 is not a measurement: the frame skipped the pass, or the device has no time stamps.
            if ns > 0 {
                histogram.saturating_record(ns);
            }
        }
        for stage in [Stage::Plan, Stage::Render, Stage::Pack, Stage::Link] {
            // 0: the frame was left out before this stage, or there is no such stage (prepared frames are not
            // rendered).
            let ns = job.timeline.wall_ns[stage as usize];
            if ns > 0 {
                self.stages[stage as usize].saturating_record(ns);
            }
        }
    }

    /// True for a frame whose note is missing.
    fn is_unrecorded(&self, frame: u32) -> bool {
        let within = |(first, last): &(u32, u32)| !frame_newer(*first, frame) && !frame_newer(frame, *last);
        self.newest.is_none_or(|newest| frame_newer(frame, newest)) || self.gaps.iter().any(within)
    }

    fn light(&mut self, note: &LightNote, monitor: &RunMonitor) {
        if note.wall_ns > 0 {
            self.stages[Stage::Light as usize].saturating_record(note.wall_ns);
        }
        let (slot, begin) = (note.event.slot, note.event.first_photon_at);
        self.slots.read_orders(monitor.dark());
        match note.event.kind {
            LightKind::Repeated => {
                self.slots.nothing_new(slot, begin, 0);
                if self.last_planned.is_some_and(|last| slot < last) {
                    self.repeated += 1;
                } else if self.repeats.len() < MAX_PENDING {
                    // After the last frame the projector repeats it until it is ordered to stop. That is not a fault.
                    self.repeats.push_back(slot);
                }
            }
            LightKind::Blank => self.slots.nothing_new(slot, begin, 0),
            LightKind::Lit => self.lit(note, monitor),
        }
    }

    /// A slot showed a frame for the first time.
    fn lit(&mut self, note: &LightNote, monitor: &RunMonitor) {
        let (slot, begin) = (note.event.slot, note.event.first_photon_at);
        let Some(frame) = note.event.frame else { return };
        self.torn += u64::from(note.torn);
        self.reordered += u64::from(self.last_lit.is_some_and(|last| !frame_newer(frame, last)));
        self.last_lit = Some(frame);
        let Some(at) = self.pending.iter().position(|r| r.id.0 as u32 == frame) else {
            if self.is_unrecorded(frame) {
                // It is in no other count, but its slot showed a frame.
                return self.slots.own(slot, begin, note.unseen);
            }
            // The frame was counted as dropped long ago, so this slot does not count as its own.
            self.slots.nothing_new(slot, begin, note.unseen);
            return;
        };
        // Earlier frames were lit without a report of their own, or were overtaken and will never be lit.
        for k in 0..at {
            if k >= note.unseen as usize {
                self.drop_oldest(monitor);
            } else if let Some(unseen) = self.pending.pop_front() {
                self.count_lit(&unseen, unseen.timeline.due_at, false, monitor);
            }
        }
        let Some(mut record) = self.pending.pop_front() else { return };
        let last_photon_at = note.event.last_photon_at;
        let exposure_ns = last_photon_at.ns_since(begin);
        let centre_at = begin.plus_ns(light_centre_ns(&self.rig, exposure_ns));
        record.timeline.lit_at = Some(begin);
        record.timeline.centre_at = Some(centre_at);
        record.timeline.last_photon_at = Some(last_photon_at);
        let late = slot > record.slot;
        if late {
            self.slots.nothing_new(slot, begin, note.unseen);
        } else {
            self.slots.own(slot, begin, note.unseen);
        }
        if let Some(flights) = &mut self.flights {
            flights.lit(record.id, begin, last_photon_at);
        }
        self.count_lit(&record, begin, late, monitor);
        if self.verify && note.hash != record.code_hash {
            self.light_mismatches += 1;
        }
        self.registration.lit(&record, late, self.prepared);
        self.measure_clock(note, &record);
        // If no light fell on any body, there is no interval from motion to light.
        let is_dark = self.is_dark(&record);
        let stamps = if is_dark { record.timeline.without_sample() } else { record.timeline };
        self.profiler.lit(&stamps, slot, late);
        self.keep(record, slot, last_photon_at);
    }

    /// Keeps what the trace and the report show of single frames.
    fn keep(&mut self, record: FrameRecord, slot: u64, last_photon_at: HostTime) {
        if self.trace_frames > 0 {
            if self.traced.len() >= self.trace_frames {
                self.traced.pop_front();
            }
            self.traced.push_back(TracedFrame {
                id: record.id,
                slot,
                timeline: record.timeline,
                last_photon_at,
                pass_ns: record.pass_ns,
            });
        }
        if self.keep > 0 {
            if self.recent.len() >= self.keep {
                self.recent.pop_front();
            }
            self.recent.push_back(record);
        }
    }

    /// Measures when the slot of this light truly began, compared with the host's estimate. Only the mock in this
    /// process can tell. For another projector the time of light comes from the host's own map of its clock, so the
    /// comparison would be meaningless.
    fn measure_clock(&mut self, note: &LightNote, record: &FrameRecord) {
        let knows = self.rig.config.projector.backend.is_mock();
        if knows && self.rig.config.real_time.pace == Pace::Real {
            let rate = self.rig.rate();
            let slots_ns = rate.slot_start_ns(note.event.slot) - rate.slot_start_ns(record.slot);
            let due_at = record.timeline.due_at.plus_ns(slots_ns);
            self.clock_error.record(note.event.first_photon_at.ns_since(due_at));
        }
    }

    /// Writes the measurements of the run into a report.
    pub(crate) fn fill(&self, report: &mut Report) {
        let slots = self.slots.counts();
        report.slots = slots.wanted();
        report.missed_slots = slots.missed_total();
        report.missed_share = slots.missed_share();
        report.excused_by_standstill = slots.excused();
        report.missed_by_cause = missed_by_cause(&slots);
        report.ordered_dark = ordered_dark(&slots);
        report.frames_lit = self.lit;
        report.frames_dark = self.dark;
        report.dark_by_body = self.dark_bodies.report(self.rig.bodies.iter().map(|b| b.name.as_str()));
        report.eyes = self.eyes.report();
        report.frames_withheld = self.withheld;
        report.frames_unrecorded = self.unrecorded;
        report.frames_dropped = self.dropped;
        report.frames_late = self.late;
        report.frames_repeated = self.repeated;
        report.frames_too_old = self.too_old;
        self.registration.fill(report);
        report.clock_error_ms = Latency::of(&self.clock_error, false);
        let latency = |interval| Latency::of(self.profiler.histogram(interval), !self.profiler.is_measured());
        report.motion_to_first_photon_ms = latency(Interval::MotionToFirstPhoton);
        report.motion_to_light_centre_ms = latency(Interval::MotionToCentre);
        report.motion_to_last_photon_ms = latency(Interval::MotionToLastPhoton);
        report.motion_to_light_ms = report.motion_to_first_photon_ms;
        report.lateness_ms = latency(Interval::Lateness);
        let stages = STAGES.iter().map(|s| (*s).to_owned()).zip(&self.stages);
        let passes = PASSES.iter().map(|p| format!("gpu {p}")).zip(&self.passes);
        report.stages_ms = stages
            .chain(passes)
            .filter_map(|(stage, h)| Percentiles::of_histogram(h, 1e6).map(|ms| StageTime { stage, ms }))
            .collect();
        let rate = |rays: u64| (self.gpu_ns > 0).then(|| rays as f64 / self.gpu_ns as f64 * 1e3);
        (report.mrays_per_s, report.walked_mrays_per_s) = (rate(self.rays), rate(self.walked_rays));
        let (sum, least, frames) = self.shares;
        let is_whole = self.rig.config.render.scale == RenderScale::Share(1.0);
        report.scale = (frames > 0 && !is_whole).then(|| TracedScale { mean: sum / frames as f64, least });
        report.clipped =
            if self.lit_values > 0 { self.clipped_values as f64 / self.lit_values as f64 } else { 0.0 };
        report.nan_pixels = self.nan_values;
        if self.invalid_samples > 0 {
            report.warnings.push(format!(
                "{} samples of {} were not finite and were left out",
                self.invalid_samples, self.samples
            ));
        }
        report.warnings.extend(self.flights_told.clone());
        let names: Vec<String> = self.rig.bodies.iter().map(|b| b.name.clone()).collect();
        report.warnings.extend(self.placement.warnings(&names));
        if self.light_mismatches > 0 {
            report
                .warnings
                .push(format!("{} frames of light differ from what was rendered", self.light_mismatches));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use crate::light::notes::note_channel;
    use crate::light::recorder::light_channel;
    use crate::plan::frame::FrameId;
    use dpm_device::light::LightEvent;
    use dpm_device::link::SendOutcome;
    use dpm_device::planes::Raster;
    use dpm_device::time::DeviceTicks;

    const SLOT_NS: i64 = 1_000_000;
    /// As many notes as wait at most.
    const READ: u64 = 256;

    /// Frames lit, dropped and missed, slots with a repeated frame, and frames that are not recorded, when all frames
    /// were sent, `lit` says which of them were lit, and the collector finds them `READ` at a time.
    fn counted(frames: u64, lit: impl Fn(u64) -> bool) -> [u64; 5] {
        collected(frames, lit, READ, &mut || ())
    }

    /// The same for a collector that reads after every `read_every` frames. Calls `alive` for every sign of life.
    fn collected(
        frames: u64,
        lit: impl Fn(u64) -> bool,
        read_every: u64,
        alive: &mut dyn FnMut(),
    ) -> [u64; 5] {
        let config = RigConfig::demo(&Overrides::default()).unwrap_or_else(|e| panic!("{e}"));
        let rig = Arc::new(Rig::build(&config, Raster::new(16, 16)).unwrap_or_else(|e| panic!("{e}")));
        assert!(frames <= 8192, "more than there is room for");
        let monitor = Arc::new(RunMonitor::default());
        let (mut link, notes) = note_channel(&rig, &monitor);
        let (mut lights_in, lights) = light_channel();
        let mut collector = Collector::new(rig.clone(), 0, false);
        let mut inbox = Inbox { notes, lights };
        for k in 0..frames {
            let begin = HostTime(k as i64 * SLOT_NS);
            let (kind, frame) =
                if lit(k) { (LightKind::Lit, Some(k as u32)) } else { (LightKind::Repeated, None) };
            let event = LightEvent {
                slot: k,
                kind,
                frame,
                lit_at: DeviceTicks(k),
                first_photon_at: begin,
                last_photon_at: begin.plus_ns(SLOT_NS),
            };
            let note = LightNote { event, hash: 0, torn: false, wall_ns: 0, unseen: 0 };
            assert!(lights_in.notes.push(note).is_ok());
            let mut note = Box::new(FrameNote::new(&rig));
            (note.plan.id, note.plan.slot, note.fate) = (FrameId(k), k, Fate::Offered(SendOutcome::Sent));
            note.timeline.due_at = begin;
            let poses = rig.true_poses(begin.0).expect("the mock tells");
            (note.plan.tracked_poses, note.plan.sampled_poses) = (poses.clone(), poses);
            note.plan.dark = vec![None; rig.bodies.len()];
            link.exchange(note);
            if (k + 1) % read_every == 0 {
                collector.look(&mut inbox, &monitor, alive);
            }
        }
        drop((link, lights_in));
        while !collector.look(&mut inbox, &monitor, alive) {}
        let missed = collector.finish(&monitor).missed_total();
        [collector.lit, collector.dropped, missed, collector.repeated, collector.unrecorded]
    }

    /// Found by reading: of frames that were finished while the collector had no core, those beyond 256 counted as
    /// dropped although their light had been reported, and repeats that were reported behind the last frame did not
    /// count. The counts of a run at virtual pace therefore depended on the machine.
    #[test]
    fn a_collector_that_stood_still_counts_what_it_would_have_counted() {
        let many = 3 * MAX_PENDING as u64 + 7;
        assert_eq!(counted(many, |_| true), [many, 0, 0, 0, 0]);
        // The picture in the last slot may be shown until the projector is ordered to stop.
        assert_eq!(counted(many, |_| false), [0, many, many, many - 1, 0]);
        let (odd, even) = (many / 2, many - many / 2);
        assert_eq!(counted(many, |k| k % 2 == 1), [odd, even, even, even - 1, 0]);
        // Only late light, behind more frames than may wait.
        let late = many - MAX_PENDING as u64 - 10;
        assert_eq!(counted(many, |k| k >= late), [many - late, late, late, late, 0]);
    }

    /// What a starved collector does not learn of is counted as that: as no frame that was lit, dropped or missed.
    #[test]
    fn frames_without_a_note_are_counted_by_that_name() {
        let (frames, unread) = (2000, 744);
        let counts = collected(frames, |_| true, 1000, &mut || ());
        assert_eq!(counts, [frames - 2 * unread, 0, 0, 0, 2 * unread]);
    }

    /// Found in use: on a busy machine a backlog of thousands of notes takes seconds, in which the collector is
    /// alive.
    #[test]
    fn every_note_of_a_backlog_is_a_sign_of_life() {
        let mut signs = 0;
        assert_eq!(collected(5_000, |_| true, READ, &mut || signs += 1)[0], 5_000);
        assert!(signs >= 5_000, "{signs}");
    }
}
