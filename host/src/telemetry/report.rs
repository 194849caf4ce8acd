//! What a run was like: one JSON object for programs, one short table for people.

use crate::pipeline::ProjectorReport;
use serde::ser::{Serialize, SerializeMap, Serializer};
use std::fmt::Write;
use std::path::PathBuf;

/// Percentiles of a quantity: the smallest value that at least that share of all values does not exceed.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Spread {
    /// Median.
    pub p50: f64,
    /// 99 %.
    pub p99: f64,
    /// 99.9 %.
    pub p999: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    /// Percentiles of `values`, which are reordered; values that are not finite are left out. `None` when none is left.
    pub fn of(values: &mut Vec<f64>) -> Option<Self> {
        values.retain(|v| v.is_finite());
        values.sort_unstable_by(f64::total_cmp);
        let last = values.len().checked_sub(1)?;
        // Nearest rank: the ceil(n q / 1000)-th value, counted from 1, in whole numbers.
        let at = |per_mille: usize| values[(values.len() * per_mille).div_ceil(1000).saturating_sub(1)];
        Some(Self { p50: at(500), p99: at(990), p999: at(999), max: values[last] })
    }

    /// Percentiles of a histogram of nanoseconds, in milliseconds. `None` when it is empty.
    pub fn ms_of_ns(histogram: &hdrhistogram::Histogram<u64>) -> Option<Self> {
        let ms = |ns: u64| ns as f64 / 1e6;
        (!histogram.is_empty()).then(|| Self {
            p50: ms(histogram.value_at_quantile(0.5)),
            p99: ms(histogram.value_at_quantile(0.99)),
            p999: ms(histogram.value_at_quantile(0.999)),
            max: ms(histogram.max()),
        })
    }
}

/// A stage's wall time.
#[derive(Clone, Debug, PartialEq)]
pub struct StageTime {
    /// Name of the stage.
    pub stage: String,
    /// Wall time of one frame in it, milliseconds.
    pub ms: Spread,
}

/// The report of a run, as `--json` prints it and `report.json` keeps it.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Report {
    /// Version of the program.
    pub version: &'static str,
    /// Commit that it was compiled from, see [`crate::commit::get`].
    pub commit: &'static str,
    /// Frames whose light left the projector.
    pub frames_lit: u64,
    /// Frames that were planned and never lit.
    pub frames_dropped: u64,
    /// Frames lit after the slot they were planned for.
    pub frames_late: u64,
    /// Slots in which the former frame was shown again.
    pub frames_repeated: u64,
    /// Frames not sent because their poses would have been older than `safety.predict_ms` and a slot when they were lit.
    pub frames_too_old: u64,
    /// Slots from one planned frame to the next, on average at the end: 1 where the renderer keeps up.
    pub slots_per_frame: f64,
    /// Longest time for which a body was carried on by prediction, milliseconds, at the end.
    pub predict_ms: f64,
    /// Columns and rows traced and projected.
    pub raster: [u32; 2],
    /// Bit planes in a frame.
    pub planes: u32,
    /// Nominal rate, frames a second.
    pub frame_rate_hz: f64,
    /// "real" or "virtual".
    pub pace: &'static str,
    /// Name of the Vulkan device; "none" when nothing was rendered.
    pub gpu: String,
    /// True when that device is the CPU.
    pub software_gpu: bool,
    /// Method that spent the rays.
    pub method: &'static str,
    /// Whether poses were predicted to the time of light.
    pub prediction: bool,
    /// Distance in projector pixels between where the light of a surface point fell and where that point was at that
    /// instant; null without ground truth.
    pub registration_error_px: Option<Spread>,
    /// The same if the newest sample had been used as it was.
    pub registration_error_unpredicted_px: Option<Spread>,
    /// From the tracker's mid-exposure to the frame's first light, milliseconds.
    pub motion_to_light_ms: Option<Spread>,
    /// Wall time of each stage.
    #[serde(serialize_with = "stages_as_map")]
    pub stages_ms: Vec<StageTime>,
    /// Frames lit in a second of wall time.
    pub frames_per_wall_second: f64,
    /// Camera rays and all rays traced, in millions a second of render time; null when nothing was rendered.
    pub mrays_per_s: Option<f64>,
    /// Share of lit channel values that the projector was too weak for, 0 to 1.
    pub clipped: f64,
    /// Pixels that were not a number and became black.
    pub nan_pixels: u64,
    /// Hash of all light; the same for the same seed at virtual pace. Absent where nobody saw the light.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub light_hash: String,
    /// What the link to the projector carried, and what the projector said.
    pub projector: Option<ProjectorReport>,
    /// What the operator should know.
    pub warnings: Vec<String>,
    /// Files written.
    pub files: Vec<PathBuf>,
    /// Wall time of the run after set-up, seconds.
    pub wall_s: f64,
}

fn stages_as_map<S: Serializer>(stages: &[StageTime], serializer: S) -> Result<S::Ok, S::Error> {
    let mut map = serializer.serialize_map(Some(stages.len()))?;
    for stage in stages {
        map.serialize_entry(&stage.stage, &stage.ms)?;
    }
    map.end()
}

impl Default for Report {
    /// A run that did nothing.
    fn default() -> Self {
        Self {
            version: env!("CARGO_PKG_VERSION"),
            commit: crate::commit::get(),
            frames_lit: 0,
            frames_dropped: 0,
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
            method: "full",
            prediction: false,
            registration_error_px: None,
            registration_error_unpredicted_px: None,
            motion_to_light_ms: None,
            stages_ms: Vec::new(),
            frames_per_wall_second: 0.0,
            mrays_per_s: None,
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

    /// The report as a table of at most 100 columns.
    pub fn to_table(&self) -> String {
        let mut rows: Vec<(String, String)> = Vec::new();
        let mut row = |name: &str, text: String| rows.push((name.to_string(), text));
        row(
            "frames",
            format!(
                "{} lit, {} dropped, {} late, {} repeated",
                self.frames_lit, self.frames_dropped, self.frames_late, self.frames_repeated
            ),
        );
        row(
            "raster",
            format!(
                "{} x {}, {} planes, {:.3} frames/s ({} pace)",
                self.raster[0], self.raster[1], self.planes, self.frame_rate_hz, self.pace
            ),
        );
        let software = if self.software_gpu { " (software)" } else { "" };
        row("GPU", format!("{}{software}", self.gpu));
        row("method", self.method.to_string());
        if let Some(error) = self.registration_error_px {
            let how = if self.prediction { "predicted" } else { "prediction off" };
            row("registration error", format!("{} px ({how})", percentiles(error)));
        }
        if let Some(error) = self.registration_error_unpredicted_px {
            row("  without prediction", format!("{} px", percentiles(error)));
        }
        if let Some(latency) = self.motion_to_light_ms {
            row("motion to light", format!("{} ms", percentiles(latency)));
        }
        for stage in &self.stages_ms {
            row(
                &format!("  {}", stage.stage),
                format!("p50 {:.3}  p99 {:.3} ms", stage.ms.p50, stage.ms.p99),
            );
        }
        row("wall time", format!("{:.2} s, {:.1} frames/s", self.wall_s, self.frames_per_wall_second));
        if let Some(p) = &self.projector {
            let [raw, coded, kept] = p.planes;
            row("projector", format!("{}, {:.1} MB sent", p.name, p.sent_mb));
            if coded + kept > 0 {
                row("  planes", format!("{raw} raw, {coded} coded, {kept} unchanged and not sent"));
            }
            if let Some(d) = p.device {
                let dropped = format!(
                    "{} incomplete, {} too late, {} superseded, {} refused",
                    d.incomplete, d.too_late, d.superseded, d.refused
                );
                row(
                    "  its report",
                    format!(
                        "{} lit, {} repeated, {} blank slots; dropped {dropped}",
                        d.lit, d.repeated, d.blank
                    ),
                );
            }
            if p.sessions > 1 || p.rearmed > 0 {
                row(
                    "  came back",
                    format!(
                        "{} times, armed again {} times after a fault",
                        p.sessions.saturating_sub(1),
                        p.rearmed
                    ),
                );
            }
        }
        if let Some(rays) = self.mrays_per_s {
            row("rays", format!("{rays:.2} million/s"));
        }
        if self.clipped > 0.0 {
            let advice = "raise projector.max_intensity or lower render.exposure";
            row("clipped", format!("{:.2} % of the light: {advice}", 100.0 * self.clipped));
        }
        if self.nan_pixels > 0 {
            row("not a number", format!("{} pixels became black", self.nan_pixels));
        }
        if !self.light_hash.is_empty() {
            row("hash of the light", self.light_hash.clone());
        }
        let width = rows.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
        let mut out = String::new();
        for (name, text) in &rows {
            // Writing into a string cannot fail.
            let _ = writeln!(out, "{name:width$}  {text}");
        }
        for warning in &self.warnings {
            let _ = writeln!(out, "warning: {warning}");
        }
        for file in &self.files {
            let _ = writeln!(out, "see {}", file.display());
        }
        out
    }
}

fn percentiles(s: Spread) -> String {
    format!("p50 {:.3}  p99 {:.3}  p99.9 {:.3}  max {:.3}", s.p50, s.p99, s.p999, s.max)
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
        let spread = Spread::of(&mut values).unwrap();
        assert_eq!(spread, Spread { p50: 500.0, p99: 990.0, p999: 999.0, max: 1000.0 });
        let mut one = vec![f64::NAN, 7.0, f64::INFINITY];
        assert_eq!(Spread::of(&mut one), Some(Spread { p50: 7.0, p99: 7.0, p999: 7.0, max: 7.0 }));
        let mut two = vec![2.0, 1.0];
        assert_eq!(Spread::of(&mut two), Some(Spread { p50: 1.0, p99: 2.0, p999: 2.0, max: 2.0 }));
        assert_eq!(Spread::of(&mut vec![f64::NAN]), None);
    }

    #[test]
    fn histograms_of_ns_become_ms() {
        let mut h = hdrhistogram::Histogram::<u64>::new(3).unwrap();
        assert_eq!(Spread::ms_of_ns(&h), None);
        for i in 1..=1000u64 {
            h.record(i * 1_000_000).unwrap();
        }
        let spread = Spread::ms_of_ns(&h).unwrap();
        for (got, want) in
            [(spread.p50, 500.0), (spread.p99, 990.0), (spread.p999, 999.0), (spread.max, 1000.0)]
        {
            assert!((got / want - 1.0).abs() < 2e-3, "{got} {want}");
        }
    }

    #[test]
    fn json_has_the_agreed_keys_in_the_order_of_the_stages() {
        let spread = Spread { p50: 1.0, p99: 2.0, p999: 3.0, max: f64::NAN };
        let stage = |name: &str| StageTime { stage: name.into(), ms: spread };
        let report = Report {
            registration_error_px: Some(spread),
            motion_to_light_ms: Some(spread),
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
        let at = |s: &str| text.find(s).unwrap();
        assert!(at("\"track\"") < at("\"plan\"") && at("\"plan\"") < at("\"render\""));
        assert!(report.to_table().contains("320 x 240"));
    }
}
