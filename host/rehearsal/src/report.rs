//! The report of a rehearsal, for programs and for people.

use super::stage::{LightFall, RehearsalCase, RehearsalStage};
use super::{RehearsalExtent, NOTICED_S};
use dpm_rig::config::RigConfig;
use serde::Serialize;
use std::fmt::Write;

/// Percentiles of a distribution.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct RehearsedPercentiles {
    pub p50: f64,
    pub p95: f64,
    pub p99: f64,
}

impl RehearsedPercentiles {
    /// Of `values` in any order; all 0 without any.
    pub(super) fn of(values: &[f64]) -> Self {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let at = |q: f64| {
            let rank = (sorted.len() as f64 * q).ceil() as usize;
            sorted.get(rank.clamp(1, sorted.len().max(1)) - 1).copied().unwrap_or(0.0)
        };
        Self { p50: at(0.5), p95: at(0.95), p99: at(0.99) }
    }
}

/// A row: runs of a rig, or of one with another part.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CaseReport {
    /// What is other in it.
    pub name: String,
    /// Registration, millimetres across the light.
    pub mm: RehearsedPercentiles,
    /// The same, pixels of the projector.
    pub px: RehearsedPercentiles,
    /// From motion to the centre of its light, milliseconds.
    pub motion_to_light_ms: RehearsedPercentiles,
    /// The 99th percentile of registration by the closed form, millimetres.
    pub predicted_p99_mm: f64,
    /// Share of the bodies in frames that stayed dark.
    pub dark_share: f64,
    /// Registration if bodies were drawn where they were measured, without prediction, millimetres.
    pub unpredicted_mm: RehearsedPercentiles,
}

impl CaseReport {
    pub(super) fn new(name: &str, predicted_p99_mm: f64, fallen: &LightFall) -> Self {
        Self {
            name: name.to_owned(),
            mm: RehearsedPercentiles::of(&fallen.mm),
            px: RehearsedPercentiles::of(&fallen.px),
            motion_to_light_ms: RehearsedPercentiles::of(&fallen.late_ms),
            predicted_p99_mm,
            dark_share: fallen.dark as f64 / fallen.bodies.max(1) as f64,
            unpredicted_mm: RehearsedPercentiles::of(&fallen.held_mm),
        }
    }
}

/// A short run in painted pictures, beside the same one by drawn corners.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PicturesReport {
    /// Pictures that were painted and looked at.
    pub pictures: u64,
    /// Registration in them, millimetres.
    pub painted_mm: RehearsedPercentiles,
    /// The same by drawn corners, millimetres.
    pub drawn_mm: RehearsedPercentiles,
}

/// What a rig can be expected to do.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RehearsalReport {
    /// Kind of tracker, and its samples a second.
    pub tracker: (String, u32),
    /// Kind of projector, and its frames a second.
    pub projector: (String, f64),
    /// The motion's word, its speed, m/s, and its acceleration, m/s2.
    pub motion: (String, f64, f64),
    /// Width of a pixel at the bodies, millimetres.
    pub pixel_mm: f64,
    /// Truths of each row, and seconds of each run.
    pub extent: (u64, f64),
    /// What people notice at this speed begins here, millimetres.
    pub noticed_mm: f64,
    /// How far a body moves while the light of a frame lasts, millimetres: edges are that soft.
    pub soft_mm: f64,
    /// The rig as it is.
    pub rig: CaseReport,
    /// The check in pictures; `None` without a camera.
    pub pictures: Option<PicturesReport>,
    /// The rig without one of the things that may be at fault.
    pub without: Vec<CaseReport>,
    /// The rig with a better part.
    pub better: Vec<CaseReport>,
}

impl RehearsalReport {
    pub(super) fn new(
        config: &RigConfig,
        own: &RehearsalCase,
        extent: RehearsalExtent,
        stage: &RehearsalStage,
        rig: CaseReport,
    ) -> Self {
        let rehearsal = &config.rehearsal;
        let rate = config.projector.frame_rate.hz();
        let lit = config.projector.lit_time();
        Self {
            tracker: (config.tracker.word().to_owned(), own.rate_hz),
            projector: (config.projector.backend.word().to_owned(), rate),
            motion: (rehearsal.motion.word().to_owned(), rehearsal.speed_m_s, rehearsal.acceleration_m_s2),
            pixel_mm: 1e3 * stage.distance / stage.projector.fx,
            extent: (extent.seeds, extent.seconds),
            noticed_mm: 1e3 * NOTICED_S * rehearsal.speed_m_s,
            soft_mm: rehearsal.speed_m_s * lit.whole_ns as f64 * 1e-6,
            rig,
            pictures: None,
            without: Vec::new(),
            better: Vec::new(),
        }
    }

    /// The sentence that a newcomer asks for, and tables of at most 100 columns.
    pub fn to_table(&self) -> String {
        let mut out = String::new();
        // Writing into a string cannot fail.
        let _ = writeln!(out, "{}\n", self.sentence());
        let (tracker, projector) = (&self.tracker, &self.projector);
        let _ = writeln!(
            out,
            "tracker {} at {} Hz, projector {} at {:.0} frames/s, a pixel is {:.2} mm at the bodies",
            tracker.0, tracker.1, projector.0, projector.1, self.pixel_mm
        );
        let _ = writeln!(
            out,
            "motion {:?}, {} m/s, {} m/s2; {} drawn truths of {} s each; the light of a frame moves {:.1} mm",
            self.motion.0, self.motion.1, self.motion.2, self.extent.0, self.extent.1, self.soft_mm
        );
        let _ = writeln!(
            out,
            "\n{:<44} {:>6} {:>6} {:>6}  {:>6} {:>6} {:>6}  {:>7} {:>6}",
            "registration", "p50", "p95", "p99 mm", "p50", "p95", "p99 px", "late ms", "model"
        );
        row(&mut out, &self.rig.name, &self.rig);
        let held = &self.rig.unpredicted_mm;
        let _ = writeln!(
            out,
            "{:<44} {:>6.2} {:>6.2} {:>6.2}",
            "  if nothing were predicted", held.p50, held.p95, held.p99
        );
        self.picture_rows(&mut out);
        for (title, rows) in [("without", &self.without), ("what a better part would win", &self.better)] {
            if !rows.is_empty() {
                let _ = writeln!(out, "{title}");
            }
            rows.iter().for_each(|case| row(&mut out, &format!("  {}", case.name), case));
        }
        if self.rig.dark_share > 0.0 {
            let _ = writeln!(
                out,
                "\n{:.1} % of the bodies stayed dark: the tracker lost them",
                100.0 * self.rig.dark_share
            );
        }
        out
    }

    fn picture_rows(&self, out: &mut String) {
        let Some(p) = &self.pictures else { return };
        let told = format!("  a short run in {} painted pictures", p.pictures);
        let _ = writeln!(
            out,
            "{told:<44} {:>6.2} {:>6.2} {:>6.2}",
            p.painted_mm.p50, p.painted_mm.p95, p.painted_mm.p99
        );
        let _ = writeln!(
            out,
            "{:<44} {:>6.2} {:>6.2} {:>6.2}",
            "  the same by drawn corners", p.drawn_mm.p50, p.drawn_mm.p95, p.drawn_mm.p99
        );
    }

    /// How many times worse painted pictures are than drawn corners of the same run, at least 1: what the rows of drawn corners
    /// leave out.
    pub fn worse_by_pictures(&self) -> f64 {
        self.pictures.map_or(1.0, |p| p.painted_mm.p99 / p.drawn_mm.p99).max(1.0)
    }

    fn sentence(&self) -> String {
        let [mm, px] = [self.rig.mm.p99, self.rig.px.p99].map(|p99| p99 * self.worse_by_pictures());
        let verdict = if mm <= self.noticed_mm { "nobody would notice that" } else { "people notice that" };
        format!(
            "99 of 100 points would lie within {:.2} mm, {:.1} px of their light, {:.1} ms behind the motion. At {} m/s {verdict}: \
             the threshold is {:.2} mm.",
            mm,
            px,
            self.rig.motion_to_light_ms.p50,
            self.motion.1,
            self.noticed_mm
        )
    }
}

fn row(out: &mut String, name: &str, case: &CaseReport) {
    // Writing into a string cannot fail.
    let _ = writeln!(
        out,
        "{name:<44} {:>6.2} {:>6.2} {:>6.2}  {:>6.2} {:>6.2} {:>6.2}  {:>7.1} {:>6.2}",
        case.mm.p50,
        case.mm.p95,
        case.mm.p99,
        case.px.p50,
        case.px.p95,
        case.px.p99,
        case.motion_to_light_ms.p50,
        case.predicted_p99_mm
    );
}
