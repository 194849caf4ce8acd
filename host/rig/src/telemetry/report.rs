//! The report of a run: one JSON object for programs, one short table for people.

use super::projector::ProjectorReport;
use super::signed::SignedHistogram;
use crate::failure::{Failure, FailureKind};
use crate::frame::slots::MissCause;
use crate::gaze::GazeReport;
use crate::plan::beat::BeatReport;
use crate::plan::dark::DarkCause;
use crate::tracks::gauges::TrackerReport;
use dpm_render::RayWalk;
use hdrhistogram::Histogram;
use serde::ser::{Serialize, SerializeMap, Serializer};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Percentiles of a quantity: the smallest value that at least that share of all values does not exceed.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Percentiles {
    /// Median.
    pub p50: f64,
    /// 99 %.
    pub p99: f64,
    /// 99.9 %.
    pub p999: f64,
    /// Largest.
    pub max: f64,
}

impl Percentiles {
    /// Percentiles of what a histogram holds, divided by `unit`. `None` if it is empty.
    pub(crate) fn of_histogram(h: &Histogram<u64>, unit: f64) -> Option<Self> {
        (!h.is_empty()).then(|| Self {
            p50: h.value_at_quantile(0.5) as f64 / unit,
            p99: h.value_at_quantile(0.99) as f64 / unit,
            p999: h.value_at_quantile(0.999) as f64 / unit,
            max: h.max() as f64 / unit,
        })
    }

    /// Percentiles of `values`, which are reordered. Values that are not finite are left out. `None` if none remain.
    #[cfg(test)]
    pub(crate) fn of(values: &mut Vec<f64>) -> Option<Self> {
        values.retain(|v| v.is_finite());
        values.sort_unstable_by(f64::total_cmp);
        let last = values.len().checked_sub(1)?;
        // Nearest rank: the ceil(n q / 1000)-th value, counted from 1, in integers.
        let at = |per_mille: usize| values[(values.len() * per_mille).div_ceil(1000).saturating_sub(1)];
        Some(Self { p50: at(500), p99: at(990), p999: at(999), max: values[last] })
    }

    /// Percentiles of a histogram of nanoseconds, in milliseconds. `None` if it is empty.
    #[cfg(test)]
    pub(crate) fn ms_of_ns(histogram: &hdrhistogram::Histogram<u64>) -> Option<Self> {
        let ms = |ns: u64| ns as f64 / 1e6;
        (!histogram.is_empty()).then(|| Self {
            p50: ms(histogram.value_at_quantile(0.5)),
            p99: ms(histogram.value_at_quantile(0.99)),
            p999: ms(histogram.value_at_quantile(0.999)),
            max: ms(histogram.max()),
        })
    }
}

/// The label of a number that is not measured at virtual pace.
pub const MODELLED: &str = "from real_time.stage_costs_us, not measured";

/// Percentiles of a time that may be negative, and whether it is a measurement.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Latency {
    /// Percentiles, milliseconds.
    #[serde(flatten)]
    pub spread: Percentiles,
    /// Smallest, milliseconds.
    pub min: f64,
    /// True at virtual pace, where the costs of the stages are constants of the rig file.
    pub modelled: bool,
    /// Where a modelled number comes from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<&'static str>,
}

impl Latency {
    /// Percentiles of a histogram of nanoseconds; `None` if it is empty.
    pub(crate) fn of(histogram: &SignedHistogram, modelled: bool) -> Option<Self> {
        let ms = |ns: i64| ns as f64 * 1e-6;
        (!histogram.is_empty()).then(|| Self {
            spread: Percentiles {
                p50: ms(histogram.value_at_quantile(0.5)),
                p99: ms(histogram.value_at_quantile(0.99)),
                p999: ms(histogram.value_at_quantile(0.999)),
                max: ms(histogram.max()),
            },
            min: ms(histogram.min()),
            modelled,
            source: modelled.then_some(MODELLED),
        })
    }
}

impl std::ops::Deref for Latency {
    type Target = Percentiles;

    fn deref(&self) -> &Percentiles {
        &self.spread
    }
}

/// Frames in which a body was dark although the projector lit the frame, by cause.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct DarkBody {
    /// Its name in the rig file.
    pub body: String,
    /// Frames in which the tracker had never reported it.
    pub never_seen: u64,
    /// Frames in which its newest sample was already too old when the poses were taken.
    pub silent: u64,
    /// Frames whose light fell later after the newest sample than `safety.predict_ms` allows.
    pub beyond_horizon: u64,
    /// Frames in which the tracker had lost a head that is guarded.
    pub head_lost: u64,
}

impl DarkBody {
    /// The frames of one cause.
    pub fn of(&self, cause: DarkCause) -> u64 {
        match cause {
            DarkCause::NeverSeen => self.never_seen,
            DarkCause::Silent => self.silent,
            DarkCause::BeyondHorizon => self.beyond_horizon,
            DarkCause::HeadLost => self.head_lost,
        }
    }

    /// The frames of all causes.
    pub(crate) fn total(&self) -> u64 {
        DarkCause::ALL.iter().map(|cause| self.of(*cause)).sum()
    }
}

/// A crew of stages that was replaced while the run went on.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Recovery {
    /// Why.
    pub cause: String,
    /// From the last light on a body before to the first after, seconds; `None` if none followed before another crew was replaced, or the run
    /// ended.
    pub dark_s: Option<f64>,
}

/// What the eye guard did to the light of a run.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct EyesReport {
    /// Names of the heads that were guarded.
    pub heads: Vec<String>,
    /// Lit frames of which mirrors were cut.
    pub frames_cut: u64,
    /// These mirrors in all: each is dark in every plane of its frame.
    pub mirrors_cut: u64,
    /// Most mirrors that were cut of a frame, while no head was lost.
    pub most_mirrors: u32,
    /// Radius of the largest sphere about a head, metres, while none was lost.
    pub greatest_radius_m: f64,
    /// Frames that were dark as a whole because a head was lost.
    pub frames_dark: u64,
    /// For each head: how often all light went off because it was lost.
    pub losses: Vec<u64>,
}

/// A stage's wall time.
#[derive(Clone, Debug, PartialEq)]
pub struct StageTime {
    /// Name of the stage.
    pub stage: String,
    /// Wall time of one frame in it, milliseconds.
    pub ms: Percentiles,
}

/// The report of a run, as printed by `--json` and stored in `report.json`.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Report {
    /// Version of the program.
    pub version: &'static str,
    /// The commit that it was compiled from, see [`dpm_common::commit::get`].
    pub commit: &'static str,
    /// Slots in which a frame of their own was wanted, from the first planned frame to the last.
    pub slots: u64,
    /// Of these, slots without one, whatever the cause.
    pub missed_slots: u64,
    /// `missed_slots` as a share of `slots`, 0 to 1.
    pub missed_share: f64,
    /// Missed slots whose frame was in flight while the machine itself stood still.
    pub excused_by_standstill: u64,
    /// Missed slots by cause.
    pub missed_by_cause: BTreeMap<String, u64>,
    /// Slots in which no new picture was wanted, by reason. They are not among `slots`.
    pub ordered_dark: BTreeMap<String, u64>,
    /// Seconds in each state of the light by its name (docs/PAGE.md): lit, partly_lit, dark_by_order, dark, stalled,
    /// never_armed; by the projector's own reports.
    pub light_s: BTreeMap<String, f64>,
    /// Frames whose light left the projector, with light on at least one body. Prepared frames always have light.
    pub frames_lit: u64,
    /// Frames that the projector lit in which every body was dark.
    pub frames_dark: u64,
    /// Bodies that were dark in some of these frames, by cause.
    pub dark_by_body: Vec<DarkBody>,
    /// What the eye guard did; absent where no head is guarded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub eyes: Option<EyesReport>,
    /// The run was stopped before it was complete.
    pub stopped: bool,
    /// Crews of stages that hung or lost the GPU and were replaced, the first 256.
    pub recoveries: Vec<Recovery>,
    /// For how long a thread that frames need was ready to run and got no core because the machine was busy, seconds.
    pub starved_s: f64,
    /// Frames that were planned but never lit.
    pub frames_dropped: u64,
    /// Frames that were not lit because no new picture was wanted.
    pub frames_withheld: u64,
    /// Frames of which the collector learnt nothing, because it had no time: lit or not, they are in no other count.
    pub frames_unrecorded: u64,
    /// Frames lit after the slot that they were planned for.
    pub frames_late: u64,
    /// Slots in which the previous frame was shown again.
    pub frames_repeated: u64,
    /// Frames not sent because their poses would have been older than `safety.predict_ms` plus one slot when lit.
    pub frames_too_old: u64,
    /// What became of the tracker's samples; null for a rig without a tracker that counts them.
    pub tracker: Option<TrackerReport>,
    /// Where a device saw the observer look; absent where none measures it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gaze: Option<GazeReport>,
    /// How the slots and the tracker went together; null while the tracker's rhythm is not known, and at virtual pace.
    pub beat: Option<BeatReport>,
    /// Average number of slots from one planned frame to the next, at the end: 1 if the renderer keeps up.
    pub slots_per_frame: f64,
    /// The longest time for which prediction may extend a body's track, at the end, milliseconds.
    pub predict_ms: f64,
    /// Columns and rows traced and projected.
    pub raster: [u32; 2],
    /// Bit planes in a frame.
    pub planes: u32,
    /// Nominal rate, frames per second.
    pub frame_rate_hz: f64,
    /// "real" or "virtual".
    pub pace: &'static str,
    /// Name of the Vulkan device; "none" if nothing was rendered.
    pub gpu: String,
    /// True if that device is the CPU.
    pub software_gpu: bool,
    /// Who found what rays met, and why; null if nothing was rendered.
    pub ray_walk: Option<RayWalk>,
    /// The method that allocated the rays.
    pub method: &'static str,
    /// Whether poses were predicted to the time of light.
    pub prediction: bool,
    /// How method "auto" was decided, one sentence; absent where the rig file names the method.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub method_choice: Option<String>,
    /// What was used of the calibration file, one sentence; absent without such a file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<String>,
    /// Distance in projector pixels between where the light of a surface point was drawn and where that point was at that
    /// instant; null without ground truth. Tracks are not in it: see `followed_light`.
    pub registration_error_px: Option<Percentiles>,
    /// The same with the newest sample in place of the prediction.
    pub registration_error_unpredicted_px: Option<Percentiles>,
    /// The same for frames that were lit in their own slot, so that lateness does not contribute.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub registration_error_in_time_px: Option<Percentiles>,
    /// Distance from a surface point to the mean of the light that it should have had, plane by plane, each with its
    /// intensity and at its own instant: what an eye sees that follows the point. Of every 16th frame; null without
    /// ground truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub followed_offset_px: Option<Percentiles>,
    /// Root mean square distance of that light from its mean: by how much the planes' motion smears it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub followed_smear_px: Option<Percentiles>,
    /// What that light is: "as lit", or "before tracks" if the projector moved it by tracks and only it knows by how much.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub followed_light: Option<&'static str>,
    /// True beginning of a slot minus the host's estimate, as observed by the mock in this process at real pace.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clock_error_ms: Option<Latency>,
    /// How wide a pixel of the projector is at the bodies' rest positions, on average, millimetres; by it pixels become
    /// millimetres. Null without a tracked body before the projector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pixel_mm: Option<f64>,
    /// The instant of the light at which registration was measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub registration_error_at: Option<&'static str>,
    /// From the tracker's mid-exposure to the frame's first photon, milliseconds.
    pub motion_to_first_photon_ms: Option<Latency>,
    /// From the tracker's mid-exposure to the centre of the frame's light, milliseconds.
    pub motion_to_light_centre_ms: Option<Latency>,
    /// From the tracker's mid-exposure to the frame's last photon, milliseconds.
    pub motion_to_last_photon_ms: Option<Latency>,
    /// The same as `motion_to_first_photon_ms`, under its former name.
    pub motion_to_light_ms: Option<Latency>,
    /// From the instant when a frame was due to its first photon, milliseconds; negative if it was lit before it was
    /// due.
    pub lateness_ms: Option<Latency>,
    /// Wall time of each stage.
    #[serde(serialize_with = "stages_as_map")]
    pub stages_ms: Vec<StageTime>,
    /// Frames lit per second of wall time.
    pub frames_per_wall_second: f64,
    /// All rays, in millions per second of render time, with those that were proven to meet nothing and were not
    /// walked; null if nothing was rendered.
    pub mrays_per_s: Option<f64>,
    /// Those of them that were walked through the scene.
    pub walked_mrays_per_s: Option<f64>,
    /// Share of the raster's columns and rows that was traced (`render.scale`); absent if that was all of it, or nothing was rendered.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<TracedScale>,
    /// Share of lit channel values that exceeded the projector's power, 0 to 1.
    pub clipped: f64,
    /// Pixels that were not a number and were made black.
    pub nan_pixels: u64,
    /// Hash of all light; the same for the same seed at virtual pace. Absent if nobody observed the light.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub light_hash: String,
    /// What the link to the projector carried, and what the projector reported.
    pub projector: Option<ProjectorReport>,
    /// Warnings for the operator.
    pub warnings: Vec<String>,
    /// Files written.
    pub files: Vec<PathBuf>,
    /// Wall time of the run after set-up, seconds.
    pub wall_s: f64,
}

/// The share of the raster's columns and rows that frames traced, above 0 and at most 1.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct TracedScale {
    /// Its mean over the frames.
    pub mean: f64,
    /// The least of any frame.
    pub least: f64,
}

fn stages_as_map<S: Serializer>(stages: &[StageTime], serializer: S) -> Result<S::Ok, S::Error> {
    let mut map = serializer.serialize_map(Some(stages.len()))?;
    for stage in stages {
        map.serialize_entry(&stage.stage, &stage.ms)?;
    }
    map.end()
}

impl Default for Report {
    /// The report of a run that did nothing.
    fn default() -> Self {
        Self {
            version: env!("CARGO_PKG_VERSION"),
            commit: dpm_common::commit::get(),
            slots: 0,
            missed_slots: 0,
            missed_share: 0.0,
            excused_by_standstill: 0,
            missed_by_cause: BTreeMap::new(),
            ordered_dark: BTreeMap::new(),
            light_s: BTreeMap::new(),
            frames_lit: 0,
            frames_dark: 0,
            dark_by_body: Vec::new(),
            eyes: None,
            stopped: false,
            recoveries: Vec::new(),
            starved_s: 0.0,
            frames_dropped: 0,
            frames_withheld: 0,
            frames_unrecorded: 0,
            tracker: None,
            gaze: None,
            beat: None,
            frames_late: 0,
            frames_repeated: 0,
            frames_too_old: 0,
            slots_per_frame: 1.0,
            predict_ms: 0.0,
            raster: [0, 0],
            planes: 0,
            frame_rate_hz: 0.0,
            pace: "virtual",
            gpu: "none".into(),
            software_gpu: false,
            ray_walk: None,
            method: "full",
            prediction: false,
            method_choice: None,
            calibration: None,
            registration_error_px: None,
            registration_error_unpredicted_px: None,
            registration_error_in_time_px: None,
            followed_offset_px: None,
            followed_smear_px: None,
            followed_light: None,
            clock_error_ms: None,
            pixel_mm: None,
            registration_error_at: None,
            motion_to_first_photon_ms: None,
            motion_to_light_centre_ms: None,
            motion_to_last_photon_ms: None,
            motion_to_light_ms: None,
            lateness_ms: None,
            stages_ms: Vec::new(),
            frames_per_wall_second: 0.0,
            mrays_per_s: None,
            walked_mrays_per_s: None,
            scale: None,
            clipped: 0.0,
            nan_pixels: 0,
            light_hash: String::new(),
            projector: None,
            warnings: Vec::new(),
            files: Vec::new(),
            wall_s: 0.0,
        }
    }
}

impl Report {
    /// The report as one JSON object with indentation.
    pub fn to_json(&self) -> String {
        to_json(self)
    }
}

impl Report {
    /// Refuses a run that lit nothing, or whose frames made the projector latch a fault.
    ///
    /// # Errors
    /// A failed check that says why.
    pub fn check_lit(&self) -> Result<(), Failure> {
        let told = self.nothing_lit().or_else(|| self.exceeded());
        told.map_or(Ok(()), |told| Err(Failure::new(FailureKind::CheckFailed, told)))
    }

    /// What frames of this run made the projector latch, and what to do; `None` if nothing.
    pub(super) fn exceeded(&self) -> Option<String> {
        let slots = self.missed_by_cause.get(MissCause::Fault.name()).copied().filter(|slots| *slots > 0)?;
        Some(format!(
            "frames of this run made the projector latch a limit on flashes or on light, and {slots} slots were dark until \
             a person acknowledged it, or the run ended; the notes name the fault. Light that flickers because the link \
             does not carry the frame rate does that: `dpm link-test` measures it"
        ))
    }

    /// Why the run lit nothing, with the largest cause first, and what to do. `None` if it lit something, if it was
    /// stopped before it planned a frame, or if no picture was wanted throughout.
    pub(crate) fn nothing_lit(&self) -> Option<String> {
        let planned = self.frames_dark + self.frames_dropped;
        let ordered: u64 = self.ordered_dark.values().sum();
        if self.frames_lit + self.frames_unrecorded > 0 || self.slots == 0 && ordered > 0 {
            return None;
        }
        if planned == 0 {
            let excused = self.stopped || self.frames_withheld > 0;
            return (!excused).then(|| {
                "no frame was planned before the run was over: the machine stood still or a stage hung; \
                 see the notes above, and run longer (--seconds) or with fewer programs beside it"
                    .to_owned()
            });
        }
        let mut causes: Vec<(u64, String)> = Vec::new();
        for body in &self.dark_by_body {
            for cause in DarkCause::ALL.into_iter().filter(|c| body.of(*c) > 0) {
                causes.push((
                    body.of(cause),
                    format!("{:?} was dark in {} frames: {}", body.body, body.of(cause), cause.told()),
                ));
            }
        }
        if self.frames_dropped > 0 {
            let (cause, n) = self
                .missed_by_cause
                .iter()
                .max_by_key(|(_, n)| **n)
                .map_or(("link", 0), |(cause, n)| (cause.as_str(), *n));
            let most = if n > 0 { format!(", most for the cause \"{cause}\"") } else { String::new() };
            causes.push((
                self.frames_dropped,
                format!("{} frames were made and never lit{most}", self.frames_dropped),
            ));
        }
        causes.sort_by_key(|(frames, _)| std::cmp::Reverse(*frames));
        let told: Vec<String> = causes.into_iter().map(|(_, told)| told).collect();
        Some(format!("no light fell on any body: {}", told.join("; ")))
    }
}

/// Any report as one indented JSON object; numbers that are not finite become null.
pub fn to_json<T: Serialize>(value: &T) -> String {
    serde_json::to_string_pretty(value).expect("reports hold only strings, numbers and lists")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_nearest_rank() {
        let mut values: Vec<f64> = (1..=1000).rev().map(f64::from).collect();
        let spread = Percentiles::of(&mut values).unwrap();
        assert_eq!(spread, Percentiles { p50: 500.0, p99: 990.0, p999: 999.0, max: 1000.0 });
        let mut one = vec![f64::NAN, 7.0, f64::INFINITY];
        assert_eq!(Percentiles::of(&mut one), Some(Percentiles { p50: 7.0, p99: 7.0, p999: 7.0, max: 7.0 }));
        let mut two = vec![2.0, 1.0];
        assert_eq!(Percentiles::of(&mut two), Some(Percentiles { p50: 1.0, p99: 2.0, p999: 2.0, max: 2.0 }));
        assert_eq!(Percentiles::of(&mut vec![f64::NAN]), None);
    }

    #[test]
    fn histograms_of_ns_become_ms() {
        let mut h = hdrhistogram::Histogram::<u64>::new(3).unwrap();
        assert_eq!(Percentiles::ms_of_ns(&h), None);
        for i in 1..=1000u64 {
            h.record(i * 1_000_000).unwrap();
        }
        let spread = Percentiles::ms_of_ns(&h).unwrap();
        for (got, want) in
            [(spread.p50, 500.0), (spread.p99, 990.0), (spread.p999, 999.0), (spread.max, 1000.0)]
        {
            assert!((got / want - 1.0).abs() < 2e-3, "{got} {want}");
        }
    }

    #[test]
    fn json_has_the_agreed_keys_in_the_order_of_the_stages() {
        let spread = Percentiles { p50: 1.0, p99: 2.0, p999: 3.0, max: f64::NAN };
        let latency = Latency { spread, min: -0.5, modelled: true, source: Some(MODELLED) };
        let stage = |name: &str| StageTime { stage: name.into(), ms: spread };
        let report = Report {
            registration_error_px: Some(spread),
            motion_to_light_ms: Some(latency),
            motion_to_first_photon_ms: Some(latency),
            stages_ms: vec![stage("track"), stage("plan"), stage("render")],
            raster: [320, 240],
            ..Report::default()
        };
        let text = report.to_json();
        let json: serde_json::Value = serde_json::from_str(&text).unwrap();
        for key in "frames_lit frames_dropped frames_late raster frame_rate_hz pace gpu wall_s".split(' ') {
            assert!(!json[key].is_null(), "{key} in {text}");
        }
        for key in ["p50", "p99"] {
            assert!(json["registration_error_px"][key].is_f64());
            assert!(json["stages_ms"]["plan"][key].is_f64());
        }
        assert!(json["motion_to_light_ms"]["p999"].is_f64());
        assert!(json["motion_to_light_ms"]["max"].is_null(), "NaN must not break the JSON");
        assert_eq!(json["motion_to_first_photon_ms"]["min"], -0.5);
        // Found in use (second look at latency, section 1): 5.2 ms of constants looked like a measurement.
        assert_eq!(json["motion_to_first_photon_ms"]["modelled"], true);
        assert_eq!(json["motion_to_first_photon_ms"]["source"], MODELLED);
        let table = report.to_table();
        assert!(table.contains("ms (modelled)") && table.contains(MODELLED), "{table}");
        let told = Report {
            frames_lit: 9,
            pixel_mm: Some(0.5),
            pace: "real",
            motion_to_light_centre_ms: Some(latency),
            ..report.clone()
        };
        let sentence = "It worked: 100.0 % of the slots had a frame of their own; the light followed the motion by 1.0 ms by the \
                        model of the stages; 99 of 100 points lay within 1.0 mm, 2.0 px of their places.";
        assert_eq!(told.to_table().lines().next(), Some(sentence));
        let missed = Report { missed_share: 0.2, ..told };
        assert!(missed.to_table().starts_with("It worked in part: 20 %"));
        let at = |s: &str| text.find(s).unwrap();
        assert!(at("\"track\"") < at("\"plan\"") && at("\"plan\"") < at("\"render\""));
        assert!(report.to_table().contains("320 x 240"));
    }

    /// The first figure of the table is every slot without a frame of its own. The part due to the machine comes
    /// second. Slots that the operator ordered to be dark are in neither.
    #[test]
    fn the_headline_is_the_raw_share() {
        let report = Report {
            slots: 22_728,
            missed_slots: 84,
            missed_share: 84.0 / 22_728.0,
            excused_by_standstill: 68,
            missed_by_cause: [("link".into(), 16), ("standstill".into(), 68), ("plan".into(), 0)].into(),
            ordered_dark: [("black".into(), 1421), ("safe".into(), 0)].into(),
            pace: "real",
            ..Report::default()
        };
        let table = report.to_table();
        let lines: Vec<&str> = table.lines().collect();
        assert_eq!(lines[0], "It did not work: nothing was lit.", "{table}");
        assert!(
            lines[2].ends_with("84 of 22728 (0.370 %); 68 of them while the machine itself stood still"),
            "{table}"
        );
        assert!(table.contains("1421 more slots, neither missed nor lit"), "{table}");
        assert!(lines.iter().all(|l| !l.starts_with("  plan") && !l.contains("safe")), "{table}");
        let json = report.to_json();
        let at = |key: &str| json.find(key).unwrap_or_else(|| panic!("{key}"));
        assert!(at("\"slots\"") < at("\"missed_slots\"") && at("\"missed_slots\"") < at("\"missed_share\""));
        assert!(at("\"missed_share\"") < at("\"excused_by_standstill\""));
    }

    /// Found in use, R6 and C2: a rig that was black all the time reported that its frames were lit, and ended with
    /// exit code 0.
    #[test]
    fn a_run_that_lit_nothing_says_why_with_the_largest_cause_first() {
        let dark = |body: &str, never_seen, silent, beyond_horizon| DarkBody {
            body: body.into(),
            never_seen,
            silent,
            beyond_horizon,
            head_lost: 0,
        };
        let report = Report {
            frames_dark: 1195,
            dark_by_body: vec![dark("venus", 3, 0, 0), dark("bunny", 0, 2, 1193)],
            ..Report::default()
        };
        let told = report.nothing_lit().unwrap();
        let (first, rest) = told.split_once("; ").unwrap();
        assert!(first.contains("\"bunny\" was dark in 1193 frames"), "{told}");
        assert!(told.contains("raise safety.predict_ms"), "{told}");
        assert!(rest.contains("\"venus\""), "{told}");
        assert!(report.to_table().contains("1195 dark on every body"));
        let dropped = Report {
            frames_dropped: 9,
            missed_by_cause: [("link".into(), 8), ("plan".into(), 1)].into(),
            ..Report::default()
        };
        assert!(dropped
            .nothing_lit()
            .unwrap()
            .contains("9 frames were made and never lit, most for the cause \"link\""));
        // One lit frame is enough. It is also no failure if the dark was ordered, or no frames were requested.
        assert_eq!(Report { frames_lit: 1, ..report }.nothing_lit(), None);
        assert_eq!(Report { frames_withheld: 500, ..Report::default() }.nothing_lit(), None);
        let ordered_dark: BTreeMap<String, u64> = [("safe".into(), 300)].into();
        assert_eq!(Report { frames_dropped: 4, ordered_dark, ..Report::default() }.nothing_lit(), None);
        assert_eq!(Report { stopped: true, ..Report::default() }.nothing_lit(), None);
        // Light before it excuses no limit that the frames themselves exceeded.
        let missed_by_cause: BTreeMap<String, u64> = [("fault".into(), 300)].into();
        let exceeded = Report { frames_lit: 900, missed_by_cause, ..Report::default() };
        assert!(exceeded.check_lit().unwrap_err().to_string().contains("300 slots were dark"));
        assert!(Report { frames_lit: 900, ..Report::default() }.check_lit().is_ok());
        // If the machine stood still for the whole run, nothing was lit either.
        assert!(Report::default().nothing_lit().unwrap().starts_with("no frame was planned"));
    }
}
