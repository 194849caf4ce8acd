//! The rig's figures in the text format of Prometheus, version 0.0.4.
//!
//! Counters are those of the report of a run, and are taken from one snapshot, so they agree with each other.

use crate::state::RigState;
use dpm_rig::control::rig_name;
use dpm_rig::gaze::GazeReport;
use dpm_rig::order::Order;
use dpm_rig::plan::dark::DarkCause;
use dpm_rig::telemetry::histogram_steps::UPPER_NS;
use dpm_rig::telemetry::light_state::LightState;
use dpm_rig::telemetry::live::LiveSnapshot;
use dpm_rig::telemetry::projector::{DeviceCounts, ProjectorReport};
use dpm_rig::tracks::gauges::TrackerReport;
use std::fmt::Write;

/// A metric: its name, its type, and what it is.
pub type Family = (&'static str, &'static str, &'static str);

macro_rules! families {
    ($($constant:ident = $name:literal, $kind:literal, $help:literal;)*) => {
        $(const $constant: Family = ($name, $kind, $help);)*
        /// Every metric, in the order in which they are told.
        pub const FAMILIES: &[Family] = &[$($constant),*];
    };
}

families! {
    INFO = "dpm_info", "gauge", "1; the labels name the program, the rig and its parts";
    UP_SECONDS = "dpm_up_seconds", "gauge", "Seconds since the page began";
    LIGHT_STATE = "dpm_light_state", "gauge", "1 for the state of the light, 0 for the others: lit, partly_lit, dark_by_order, dark, stalled, never_armed";
    STANDING = "dpm_order_standing", "gauge", "1 for the order that stands and is kept over restarts, 0 for the others";
    INTERLOCK = "dpm_interlock_closed", "gauge", "1 while the interlock permits light; absent without an interlock";
    PLANNED = "dpm_frames_planned_total", "counter", "Frames planned";
    FRAMES = "dpm_frames_total", "counter", "Frames whose fate is known: lit, dark on every body, dropped, not wanted, or not recorded";
    LATE = "dpm_frames_late_total", "counter", "Frames lit after the slot that they were planned for";
    REPEATED = "dpm_frames_repeated_total", "counter", "Slots in which the previous frame was shown again";
    TOO_OLD = "dpm_frames_too_old_total", "counter", "Frames not sent because their poses would have been too old";
    SLOTS = "dpm_slots_total", "counter", "Slots in which a frame of their own was wanted";
    MISSED = "dpm_slots_missed_total", "counter", "Of these, slots without one, by cause";
    ORDERED = "dpm_slots_ordered_dark_total", "counter", "Slots in which no new picture was wanted, by reason";
    BODY_LIT = "dpm_body_lit", "gauge", "1 while light falls on the body";
    BODY_DARK = "dpm_body_dark_frames_total", "counter", "Lit frames in which the body was dark, by cause";
    EYES = "dpm_eye_guard_frames_total", "counter", "Frames that the eye guard cut, and frames that it made dark because a head was lost";
    EYE_MIRRORS = "dpm_eye_guard_mirrors_total", "counter", "Mirrors that it cut, of all frames together";
    HEAD_LOST = "dpm_eye_guard_lost_total", "counter", "How often all light went off because the head was lost";
    INTERVAL = "dpm_interval_seconds", "histogram", "Time between two stamps of a frame (docs/LATENCY.md); negative times count in the lowest bucket";
    SAMPLE_AGE = "dpm_sample_age_seconds", "gauge", "Age of the oldest sample among the lit bodies when the newest frame was due";
    PREDICT = "dpm_prediction_seconds", "gauge", "The longest time for which prediction may extend a track";
    BUDGET = "dpm_samples_per_pixel", "gauge", "Average samples per pixel that the newest frame was given";
    SAMPLES = "dpm_samples_total", "counter", "Samples taken";
    RAYS = "dpm_rays_total", "counter", "Rays, with those that were proven to meet nothing";
    WALKED_RAYS = "dpm_walked_rays_total", "counter", "Rays that were walked through the scene";
    REGISTRATION = "dpm_registration_error_pixels", "gauge", "Distance of light from its place in projector pixels; only with a mock tracker";
    PICTURES = "dpm_live_pictures_total", "counter", "Pictures of another program that the body was given (scene.bodies[].texture)";
    TRACKER = "dpm_tracker_samples_total", "counter", "Samples of the tracker by what became of them; lost ones never came";
    GAZE = "dpm_gaze_samples_total", "counter", "Samples of the device that measures the observer's gaze, by what became of them";
    GAZE_AGE = "dpm_gaze_age_seconds", "gauge", "Age of the newest gaze that was used; absent before the first";
    GAZE_RATE = "dpm_gaze_samples_per_second", "gauge", "Samples of gaze that were used in the last second";
    GAZE_FRAMES = "dpm_gaze_frames_total", "counter", "Frames by where their gaze was from: measured, or the axis of the glasses";
    GAZE_RECONNECTS = "dpm_gaze_reconnects_total", "counter", "Connections to the device after the first";
    SESSIONS = "dpm_link_sessions_total", "counter", "Sessions opened with the projector";
    REARMED = "dpm_link_rearmed_total", "counter", "Times that light came back after the watchdog or damaged packets";
    SENT = "dpm_link_sent_bytes_total", "counter", "Bytes handed to the medium";
    PLANES = "dpm_link_planes_total", "counter", "Planes by how they were sent: raw, coded, or not because nothing had changed";
    NOT_SENT = "dpm_link_not_sent_total", "counter", "Frames not sent, by reason";
    DEVICE = "dpm_device_total", "counter", "What a projector outside this process has counted: frames, slots and packets";
    CELSIUS = "dpm_device_celsius", "gauge", "Temperature of the projector's hottest sensor; absent where the device tells none";
    VIEWERS = "dpm_page_viewers", "gauge", "Viewers of the live page";
}

/// The text: every metric with its help and type.
pub(crate) fn text(state: &RigState) -> String {
    let mut out = Out { text: String::with_capacity(16 << 10), family: "" };
    rig(&mut out, state);
    match &state.figures {
        Some(figures) => run(&mut out, state, figures),
        None => counted(&mut out, state),
    }
    out.family(PICTURES);
    for (body, count) in &state.pictures {
        out.value(&[("body", body)], *count as f64);
    }
    tracker(&mut out, state.tracker.as_ref());
    gaze(&mut out, state.gaze.as_ref());
    link(&mut out, &state.carried);
    out.family(CELSIUS);
    if let Some(celsius) = state.carried.celsius {
        out.value(&[], celsius);
    }
    out.family(VIEWERS).value(&[], state.now.viewers as f64);
    out.text
}

fn rig(out: &mut Out, state: &RigState) {
    let now = &state.now;
    let report = state.figures.as_ref().map(|f| &f.report);
    let labels = [
        ("version", env!("CARGO_PKG_VERSION")),
        ("commit", dpm_common::commit::get()),
        ("rig", rig_name()),
        ("method", report.map_or("", |r| r.method)),
        ("pace", report.map_or("", |r| r.pace)),
        ("medium", &state.carried.name),
    ];
    out.family(INFO).value(&labels, 1.0);
    out.family(UP_SECONDS).value(&[], now.up_s);
    out.family(LIGHT_STATE);
    for word in LightState::WORDS {
        out.value(&[("state", &LightState::name_of(word))], f64::from(word == now.light.word));
    }
    out.family(STANDING);
    for (order, word) in Order::ALL.iter().filter(|(order, _)| *order != Order::Arm) {
        out.value(&[("order", word)], f64::from(now.standing == Some(order.word())));
    }
    out.family(INTERLOCK);
    if let Some((_, is_closed)) = &now.interlock {
        out.value(&[], f64::from(*is_closed));
    }
}

fn tracker(out: &mut Out, told: Option<&TrackerReport>) {
    out.family(TRACKER);
    let Some(t) = told else { return };
    for (fate, n) in [
        ("used", t.used),
        ("lost", t.lost),
        ("reordered", t.reordered),
        ("doubled", t.doubled),
        ("unlabelled", t.unlabelled),
        ("impossible", t.impossible),
        ("contradictory", t.contradictory),
    ] {
        out.value(&[("fate", fate)], n as f64);
    }
}

fn gaze(out: &mut Out, told: Option<&GazeReport>) {
    out.family(GAZE);
    for (fate, n) in told.iter().flat_map(|g| {
        ["used", "unsure", "refused", "ill_timed"].into_iter().zip([g.used, g.unsure, g.refused, g.ill_timed])
    }) {
        out.value(&[("fate", fate)], n as f64);
    }
    out.family(GAZE_AGE);
    if let Some(age_ms) = told.and_then(|g| g.age_ms) {
        out.value(&[], age_ms * 1e-3);
    }
    out.family(GAZE_RATE);
    told.iter().for_each(|g| out.value(&[], g.rate_hz));
    out.family(GAZE_FRAMES);
    for (by, n) in told.iter().flat_map(|g| [("measured", g.frames_measured), ("axis", g.frames_without)]) {
        out.value(&[("by", by)], n as f64);
    }
    out.family(GAZE_RECONNECTS);
    told.iter().for_each(|g| out.value(&[], g.reconnects as f64));
}

/// What is known of a run without a collector, or before its first figures.
fn counted(out: &mut Out, state: &RigState) {
    let c = &state.now.counts;
    out.family(PLANNED).value(&[], c.frames_planned as f64);
    frames(out, [c.frames_lit, c.frames_dark, c.frames_dropped, c.frames_withheld, c.frames_unrecorded]);
    out.family(LATE).value(&[], c.frames_late as f64);
    out.family(SLOTS).value(&[], c.slots as f64);
}

fn frames(out: &mut Out, counts: [u64; 5]) {
    out.family(FRAMES);
    for (fate, n) in ["lit", "dark", "dropped", "withheld", "unrecorded"].into_iter().zip(counts) {
        out.value(&[("fate", fate)], n as f64);
    }
}

fn run(out: &mut Out, state: &RigState, figures: &LiveSnapshot) {
    let r = &figures.report;
    out.family(PLANNED).value(&[], figures.planned as f64);
    frames(out, [r.frames_lit, r.frames_dark, r.frames_dropped, r.frames_withheld, r.frames_unrecorded]);
    out.family(LATE).value(&[], r.frames_late as f64);
    out.family(REPEATED).value(&[], r.frames_repeated as f64);
    out.family(TOO_OLD).value(&[], r.frames_too_old as f64);
    out.family(SLOTS).value(&[], r.slots as f64);
    for (family, label, counts) in
        [(MISSED, "cause", &r.missed_by_cause), (ORDERED, "reason", &r.ordered_dark)]
    {
        out.family(family);
        for (name, n) in counts {
            out.value(&[(label, name)], *n as f64);
        }
    }
    out.family(BODY_LIT);
    for (body, dark) in &state.bodies {
        out.value(&[("body", body)], f64::from(state.now.light.is_lit && dark.is_none()));
    }
    out.family(BODY_DARK);
    for d in &r.dark_by_body {
        for cause in DarkCause::ALL {
            out.value(&[("body", &d.body), ("cause", cause.name())], d.of(cause) as f64);
        }
    }
    out.family(EYES);
    if let Some(eyes) = &r.eyes {
        for (what, n) in [("cut", eyes.frames_cut), ("dark", eyes.frames_dark)] {
            out.value(&[("what", what)], n as f64);
        }
    }
    out.family(EYE_MIRRORS);
    if let Some(eyes) = &r.eyes {
        out.value(&[], eyes.mirrors_cut as f64);
    }
    out.family(HEAD_LOST);
    for (head, n) in r.eyes.iter().flat_map(|eyes| eyes.heads.iter().zip(&eyes.losses)) {
        out.value(&[("head", head)], *n as f64);
    }
    intervals(out, figures);
    let seconds = |ns: i64| ns as f64 * 1e-9;
    out.family(SAMPLE_AGE);
    if let Some(age_ns) = figures.frame.sample_age_ns {
        out.value(&[], seconds(age_ns));
    }
    out.family(PREDICT).value(&[], seconds(figures.frame.predict_ns));
    out.family(BUDGET).value(&[], figures.frame.budget_spp);
    out.family(SAMPLES).value(&[], figures.samples as f64);
    out.family(RAYS).value(&[], figures.rays as f64);
    out.family(WALKED_RAYS).value(&[], figures.walked_rays as f64);
    out.family(REGISTRATION);
    if let Some(spread) = r.registration_error_px {
        for (quantile, px) in
            [("0.5", spread.p50), ("0.99", spread.p99), ("0.999", spread.p999), ("1", spread.max)]
        {
            out.value(&[("quantile", quantile)], px);
        }
    }
}

fn intervals(out: &mut Out, figures: &LiveSnapshot) {
    out.family(INTERVAL);
    for interval in &figures.intervals {
        let label = ("interval", interval.name);
        for (upper, up_to) in UPPER_NS.iter().zip(interval.steps.up_to) {
            let le = (*upper as f64 / 1e9).to_string();
            out.line("_bucket", &[label, ("le", &le)], up_to as f64);
        }
        let count = interval.steps.count as f64;
        out.line("_bucket", &[label, ("le", "+Inf")], count);
        out.line("_sum", &[label], interval.steps.sum_ns * 1e-9);
        out.line("_count", &[label], count);
    }
}

fn link(out: &mut Out, c: &ProjectorReport) {
    out.family(SESSIONS).value(&[], c.sessions as f64);
    out.family(REARMED).value(&[], c.rearmed as f64);
    out.family(SENT).value(&[], (c.sent_mb * 1e6).round());
    out.family(PLANES);
    for (form, n) in ["raw", "coded", "kept"].into_iter().zip(c.planes) {
        out.value(&[("form", form)], n as f64);
    }
    out.family(NOT_SENT);
    let reasons =
        ["link_not_up", "no_buffer", "medium_busy", "medium_lost", "limit_on_flashes", "limits_on_light"];
    for (reason, n) in reasons.into_iter().zip(c.not_sent) {
        out.value(&[("reason", reason)], n as f64);
    }
    out.family(DEVICE);
    let Some(d) = c.device else { return };
    let DeviceCounts { lit, lit_unseen, repeated, blank, incomplete, .. } = d;
    let DeviceCounts { too_late, superseded, refused, damaged_packets, .. } = d;
    for (what, n) in [
        ("lit", lit),
        ("lit_unseen", lit_unseen),
        ("repeated", repeated),
        ("blank", blank),
        ("incomplete", incomplete),
        ("too_late", too_late),
        ("superseded", superseded),
        ("refused", refused),
        ("damaged_packets", damaged_packets),
    ] {
        out.value(&[("what", what)], n as f64);
    }
}

/// Text in the making. Values belong to the family that was begun last.
struct Out {
    text: String,
    family: &'static str,
}

impl Out {
    fn family(&mut self, (name, kind, help): Family) -> &mut Self {
        let _ = writeln!(self.text, "# HELP {name} {help}\n# TYPE {name} {kind}");
        self.family = name;
        self
    }

    fn value(&mut self, labels: &[(&str, &str)], value: f64) {
        self.line("", labels, value);
    }

    /// A value of the family's part `suffix`.
    fn line(&mut self, suffix: &str, labels: &[(&str, &str)], value: f64) {
        self.text += self.family;
        self.text += suffix;
        for (k, (label, text)) in labels.iter().enumerate() {
            let _ = write!(self.text, "{}{label}=\"{}\"", if k == 0 { "{" } else { "," }, escaped(text));
        }
        if !labels.is_empty() {
            self.text.push('}');
        }
        let _ = writeln!(self.text, " {value}");
    }
}

/// A label's value as the format wants it.
fn escaped(text: &str) -> String {
    text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_measured_gaze_has_its_figures_and_another_none() {
        let told = |report: Option<&GazeReport>| {
            let mut out = Out { text: String::new(), family: "" };
            gaze(&mut out, report);
            out.text.lines().filter(|line| !line.starts_with('#')).map(str::to_owned).collect::<Vec<_>>()
        };
        assert_eq!(told(None), [""; 0]);
        let report = GazeReport {
            used: 7,
            unsure: 2,
            ill_timed: 1,
            age_ms: Some(12.5),
            rate_hz: 120.0,
            frames_measured: 30,
            frames_without: 4,
            reconnects: 3,
            ..GazeReport::default()
        };
        let expected = [
            "dpm_gaze_samples_total{fate=\"used\"} 7",
            "dpm_gaze_samples_total{fate=\"unsure\"} 2",
            "dpm_gaze_samples_total{fate=\"refused\"} 0",
            "dpm_gaze_samples_total{fate=\"ill_timed\"} 1",
            "dpm_gaze_age_seconds 0.0125",
            "dpm_gaze_samples_per_second 120",
            "dpm_gaze_frames_total{by=\"measured\"} 30",
            "dpm_gaze_frames_total{by=\"axis\"} 4",
            "dpm_gaze_reconnects_total 3",
        ];
        assert_eq!(told(Some(&report)), expected);
    }
}
