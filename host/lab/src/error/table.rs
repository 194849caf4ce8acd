//! A rig into the whole comparison of the methods: one body in four materials, standing and moving, looked at and looked past.
//!
//! The materials are those of \[paper\] section 3 ([`looks`]). An eye that looks past has the whole picture beyond the paper's outer zone, where
//! its filter is fully in: that is where flicker is judged. What the eye looks at does not change the reference, so both share one.

use super::figure3::{dressed, looks};
use super::plan::Group;
use super::report::{best_other, least_flicker, stamps};
use super::runs::{ErrorOptions, ErrorRunError, ErrorRuns, GroupResult, Measured};
use super::verdict::{equal_time_table, runs_text, table, time_text, verdict};
use crate::stamp::Stamp;
use dpm_render::gpu::Gpu;
use dpm_rig::rig::Rig;
use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::sync::Arc;

/// Samples of \[paper\] table 1 where the eye looks.
pub(crate) const BUDGET: f64 = 18.0;
/// Angle at the eye between the middle of the picture and the gaze that looks past it, degrees.
pub(crate) const ASIDE_DEG: f64 = 27.0;

/// One condition: a material, standing or moving, looked at or past.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TableSetting {
    /// Index into [`looks`].
    pub look: usize,
    /// Bodies move as the rig file says.
    pub moving: bool,
    /// The eye looks past the picture.
    pub aside: bool,
}

impl TableSetting {
    /// All: looked at first, standing before moving.
    pub fn all() -> Vec<Self> {
        let of = |aside, moving| (0..looks().len()).map(move |look| Self { look, moving, aside });
        [(false, false), (false, true), (true, false), (true, true)]
            .into_iter()
            .flat_map(|(aside, moving)| of(aside, moving))
            .collect()
    }

    /// Name for files and people.
    pub fn name(self) -> String {
        let motion = if self.moving { "moving" } else { "still" };
        format!("{}-{motion}{}", looks()[self.look].name, if self.aside { "-aside" } else { "" })
    }

    /// The group of methods that it stands for.
    pub fn group(self) -> Group {
        Group { moving: self.moving, budget: BUDGET }
    }
}

/// A measured setting, as it is kept in its file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TableGroup {
    /// Material.
    pub material: String,
    /// Bodies move.
    pub moving: bool,
    /// The eye looks past the picture.
    pub aside: bool,
    /// The numbers.
    pub result: GroupResult,
}

impl TableGroup {
    /// Its setting.
    pub fn setting(&self) -> TableSetting {
        let look = looks().iter().position(|l| l.name == self.material).unwrap_or(0);
        TableSetting { look, moving: self.moving, aside: self.aside }
    }
}

/// Where an eye at `eye` looks that turns its gaze up by [`ASIDE_DEG`] from `middle`.
fn past(eye: DVec3, middle: DVec3) -> DVec3 {
    let ahead = middle - eye;
    let axis = ahead.cross(DVec3::Y).try_normalize().unwrap_or(DVec3::X);
    eye + DQuat::from_axis_angle(axis, ASIDE_DEG.to_radians()) * ahead
}

/// What measures a setting of `rig`, and the name under which its result is kept.
pub fn runs(rig: Rig, gpu: &Arc<Gpu>, setting: TableSetting, options: &ErrorOptions) -> (ErrorRuns, String) {
    let scene = format!("{} {:?}", Stamp::new(&rig, gpu.summary()).config_hash, looks()[setting.look]);
    let (mut rig, _) = dressed(rig, setting.look);
    if setting.aside {
        let (eye, _) = rig.observer.eye_and_gaze(&[]);
        let middle = DVec3::from_array(rig.config.projector.look_at);
        rig.observer = rig.observer.clone().looking_at(past(eye, middle));
    }
    let runs = ErrorRuns::variant(Arc::new(rig), gpu.clone(), options.clone(), setting.name(), scene);
    let key = runs.key(setting.group());
    (runs, key)
}

/// Measures a setting. `each` is called before every sequence with its name.
///
/// # Errors
/// The renderer's; nothing lit; the cache cannot be written.
pub fn measure(
    runs: &ErrorRuns,
    setting: TableSetting,
    each: &mut dyn FnMut(&str),
) -> Result<(TableGroup, Measured), ErrorRunError> {
    let measured = runs.measure(setting.group(), each)?;
    let group = TableGroup {
        material: looks()[setting.look].name.clone(),
        moving: setting.moving,
        aside: setting.aside,
        result: measured.result.clone(),
    };
    Ok((group, measured))
}

/// What counts as flicker of a setting: in the periphery where the eye looks past, else everywhere.
fn flicker(group: &TableGroup, row: &super::runs::ErrorRow) -> f64 {
    if group.aside {
        row.flicker_periphery.unwrap_or(row.flicker)
    } else {
        row.flicker
    }
}

/// All rows as a Markdown table with the stamps above, and dpm by the best of the others below.
pub fn markdown(groups: &[TableGroup]) -> String {
    let mut text = stamps(groups.iter().map(|g| &g.result.stamp));
    text += "| material | motion | eye | method | rays/frame | rays / paper | ms a frame (middle half) | single RMSE | perceived RMSE as measured | two runs | less the reference's own | bias | noise | mean | FLIP | flicker | perceived / best other | flicker / least other |\n";
    text += "|---|---|---|---|---:|---:|---|---:|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|\n";
    for g in groups {
        let best = best_other(&g.result).map_or(f64::NAN, |r| r.perceived_rmse);
        let least = least_flicker(&g.result, |r| flicker(g, r));
        for r in &g.result.rows {
            // Writing into a string cannot fail.
            let _ = writeln!(
                text,
                "| {} | {} | {} | {} | {:.0} | {:.3} | {} | {:.4} | {:.5} | {} | {:.5} | {:.5} | {:.5} | {:+.2} % | {:.4} | {:.5} | {:.2} | {:.2} |",
                g.material,
                if g.moving { "moving" } else { "still" },
                if g.aside { "past" } else { "at" },
                r.method,
                r.rays,
                r.rays_to_paper,
                time_text(r),
                r.single_rmse,
                r.perceived_rmse_raw,
                runs_text(r.runs_raw),
                r.perceived_rmse,
                r.bias,
                r.noise,
                100.0 * r.mean_shift,
                r.flip,
                flicker(g, r),
                r.perceived_rmse / best,
                flicker(g, r) / least,
            );
        }
    }
    text.push('\n');
    text += &equal_time_table(groups.iter().map(|g| (g.setting().name(), &g.result)));
    text.push('\n');
    let verdicts: Vec<_> =
        groups.iter().filter_map(|g| verdict(g.setting().name(), &g.result, &|r| flicker(g, r))).collect();
    text += &table(&verdicts);
    text += "\n| group | reference error | probes |\n|---|---:|---:|\n";
    for g in groups {
        let _ = writeln!(
            text,
            "| {} | {:.5} | {} |",
            g.setting().name(),
            g.result.reference_error,
            g.result.probes,
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_have_names_of_their_own() {
        let names: std::collections::BTreeSet<String> =
            TableSetting::all().into_iter().map(TableSetting::name).collect();
        assert_eq!(names.len(), 16);
    }

    #[test]
    fn an_eye_that_looks_past_turns_up_by_the_angle_and_keeps_its_distance() {
        let (eye, middle) = (DVec3::new(0.15, 0.12, 1.0), DVec3::new(0.0, 0.03, -0.05));
        let gaze = past(eye, middle);
        let (to, from) = (gaze - eye, middle - eye);
        assert!((to.angle_between(from).to_degrees() - ASIDE_DEG).abs() < 1e-9);
        assert!((to.length() / from.length() - 1.0).abs() < 1e-12);
        assert!(gaze.y > middle.y);
        // Straight down there is no upward, but a gaze all the same.
        assert!(past(DVec3::Y, DVec3::ZERO).is_finite());
    }
}
