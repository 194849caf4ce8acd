//! The preliminary experiment of \[paper\] section 3 with the eye model in the observer's place: one body in four materials, 5 to 30 samples
//! a pixel, standing and moving, each against 1,000 samples.
//!
//! \[paper\] asks whether an eye that follows a body at 947 fps still integrates frames: its author rated the noise of each condition. Here
//! the noise is what two runs of independent samples do not share after 31 frames on every point of that body.

use super::plan::Setting;
use super::reference::mean_of;
use super::report::stamps;
use super::runs::{key_of, ErrorOptions, ErrorRunError, ErrorRuns, EYE_FRAMES};
use crate::median::median_ms;
use crate::sequence::{eye_mean, rmse};
use crate::stamp::Stamp;
use dpm_render::method::Method;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;

/// Samples a pixel of \[paper\] section 3.
pub const SPP: [u32; 5] = [5, 10, 15, 20, 30];

/// One condition of the experiment.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Figure3Row {
    /// Material of the body that is looked at.
    pub material: String,
    /// Moving or standing.
    pub moving: bool,
    /// Samples a pixel and frame.
    pub spp: u32,
    /// RMSE of what the eye sees on that body by its mean radiance.
    pub perceived: f64,
    /// The part of it that two runs do not share.
    pub noise: f64,
    /// RMSE of the last frame alone by the mean radiance.
    pub single: f64,
    /// GPU time of a frame, median, ms; 0 without time stamps.
    pub gpu_ms: f64,
}

/// All samples of one setting.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Figure3Group {
    /// With what.
    pub stamp: Stamp,
    /// Hash of all that the result depends on.
    pub key: String,
    /// Probes on the body.
    pub probes: usize,
    /// Error of the reference by the mean radiance.
    pub reference_error: f64,
    /// By rising samples.
    pub rows: Vec<Figure3Row>,
}

impl Figure3Group {
    /// Its setting.
    pub fn setting(&self) -> Setting {
        let (material, moving) = self.rows.first().map_or(("", false), |r| (&r.material, r.moving));
        Setting::of_material(material, moving, false)
    }
}

/// Measures a setting at all samples of [`SPP`]. `each` is called before every sequence with its name.
///
/// # Errors
/// The renderer's; nothing of the body is lit; the cache cannot be written.
pub fn measure(runs: &ErrorRuns, each: &mut dyn FnMut(&str)) -> Result<Figure3Group, ErrorRunError> {
    let setting = runs.setting;
    let seed = runs.stamp.seed as u32;
    let theatre = runs.theatre(0, EYE_FRAMES as u32)?;
    let on_body = |i: usize| theatre.probes()[i].body == runs.body;
    let probes: Vec<usize> = (0..theatre.probes().len()).filter(|&i| on_body(i)).collect();
    if probes.is_empty() {
        return Err(ErrorRunError::NothingLit);
    }
    let reference = runs.reference(each)?;
    let seen: Vec<Vec3> = probes.iter().map(|&i| reference.eye[i]).collect();
    let mean = mean_of(&seen).max(f64::MIN_POSITIVE);
    let mut rows = Vec::new();
    for spp in SPP {
        let method = Method::full(spp);
        let mut play = |seed: u32| {
            each(&format!("{spp} spp"));
            theatre.play(&method, spp as f32, seed, &mut |_, _| ())
        };
        let runs = [play(seed)?, play(seed.wrapping_add(1_000_003))?];
        let eyes = [0, 1].map(|i: usize| eye_mean(&runs[i].frames, EYE_FRAMES));
        let single = |i: usize| runs[i].frames.last().map_or(0.0, |f| rmse(f, &reference.last, on_body));
        rows.push(Figure3Row {
            material: setting.material().unwrap_or_default(),
            moving: setting.moving,
            spp,
            perceived: reference.perceived(&eyes, &on_body).1 / mean,
            noise: rmse(&eyes[0], &eyes[1], on_body) / std::f64::consts::SQRT_2 / mean,
            single: (0.5 * (single(0).powi(2) + single(1).powi(2))).sqrt() / mean,
            gpu_ms: median_ms(runs.iter().flat_map(|r| &r.costs).map(|c| c.pass_ns.iter().sum())),
        });
    }
    let halves = rmse(&reference.halves[0], &reference.halves[1], on_body);
    Ok(Figure3Group {
        key: key(&runs.stamp, setting, &runs.options),
        stamp: runs.stamp.clone(),
        probes: probes.len(),
        reference_error: 0.5 * halves / mean,
        rows,
    })
}

/// Names all that a setting's result depends on.
pub fn key(stamp: &Stamp, setting: Setting, options: &ErrorOptions) -> String {
    key_of(stamp, setting, options, &format!("figure 3 {SPP:?}"))
}

/// What the two findings of \[paper\] section 3 are here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Findings {
    /// Conditions measured both standing and moving.
    pub pairs: usize,
    /// Those in which the moving one is no worse, within 5 %.
    pub moving_no_worse: usize,
    /// Mean ratio of moving to standing noise; `None` without a pair.
    pub moving_to_still: Option<f64>,
    /// At the fewest samples: mean noise of the materials with a diffuse part by that of those without; `None` unless both were measured.
    pub diffuse_to_specular: Option<f64>,
}

/// Reads the findings off the rows.
pub(crate) fn findings(groups: &[Figure3Group]) -> Findings {
    let rows = || groups.iter().flat_map(|g| &g.rows);
    let pairs: Vec<f64> = rows()
        .filter(|r| r.moving)
        .filter_map(|m| {
            let still = rows().find(|s| !s.moving && s.spp == m.spp && s.material == m.material)?;
            Some(m.perceived / still.perceived)
        })
        .collect();
    let fewest = rows().map(|r| r.spp).min().unwrap_or(0);
    let at_fewest = |diffuse: bool| {
        let of: Vec<f64> = rows()
            .filter(|r| r.spp == fewest && (["diffuse", "glossy"].contains(&r.material.as_str())) == diffuse)
            .map(|r| r.perceived)
            .collect();
        mean(&of)
    };
    Findings {
        pairs: pairs.len(),
        moving_no_worse: pairs.iter().filter(|&&p| p <= 1.05).count(),
        moving_to_still: mean(&pairs),
        diffuse_to_specular: at_fewest(true)
            .zip(at_fewest(false))
            .map(|(diffuse, specular)| diffuse / specular),
    }
}

/// The mean of `values`; `None` without any.
fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// A table of all conditions, and the findings beside those of \[paper\].
pub fn markdown(groups: &[Figure3Group]) -> String {
    let mut text = stamps(groups.iter().map(|g| &g.stamp));
    text += "| material | motion | spp | perceived RMSE / mean | noise / mean | single RMSE / mean | GPU ms |\n|---|---|---:|---:|---:|---:|---:|\n";
    for r in groups.iter().flat_map(|g| &g.rows) {
        // Writing into a string cannot fail.
        let _ = writeln!(
            text,
            "| {} | {} | {} | {:.4} | {:.4} | {:.4} | {:.2} |",
            r.material,
            if r.moving { "moving" } else { "still" },
            r.spp,
            r.perceived,
            r.noise,
            r.single,
            r.gpu_ms
        );
    }
    let f = findings(groups);
    // One group alone has no findings.
    if let Some(ratio) = f.moving_to_still {
        let _ = writeln!(
            text,
            "\nMoving is no worse than standing (within 5 %) in {} of {} conditions; on average it has {ratio:.2} of the error.",
            f.moving_no_worse, f.pairs
        );
    }
    if let Some(ratio) = f.diffuse_to_specular {
        let _ = writeln!(
            text,
            "\nAt the fewest samples the materials with a diffuse part have {ratio:.2} times the error of those without."
        );
    }
    text
}

/// All rows as CSV with a head line.
pub fn csv(groups: &[Figure3Group]) -> String {
    let mut text = String::from(
        "device,driver,commit,config,seed,material,motion,spp,perceived,noise,single,gpu_ms,reference_error\n",
    );
    for g in groups {
        for r in &g.rows {
            let motion = if r.moving { "moving" } else { "still" };
            // Writing into a string cannot fail.
            let _ = writeln!(
                text,
                "{},{},{motion},{},{:.6e},{:.6e},{:.6e},{:.6},{:.6e}",
                g.stamp.csv(),
                r.material,
                r.spp,
                r.perceived,
                r.noise,
                r.single,
                r.gpu_ms,
                g.reference_error
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::plan::looks;
    use super::*;

    fn group(look: usize, moving: bool, perceived: [f64; 2]) -> Figure3Group {
        let stamp = Stamp {
            device: "a \"device\"".into(),
            driver: "d".into(),
            software: true,
            version: "1".into(),
            commit: "c".into(),
            config_hash: "h".into(),
            raster: [4, 3],
            seed: 1,
        };
        let rows = [(5, perceived[0]), (30, perceived[1])].map(|(spp, perceived)| Figure3Row {
            material: looks()[look].name.clone(),
            moving,
            spp,
            perceived,
            noise: perceived,
            single: 1.0,
            gpu_ms: 1.0,
        });
        Figure3Group { stamp, key: String::new(), probes: 1, reference_error: 0.0, rows: rows.to_vec() }
    }

    #[test]
    fn findings_are_ratios_of_like_conditions() {
        let groups = [
            group(0, false, [0.4, 0.2]),
            group(3, false, [0.1, 0.05]),
            group(0, true, [0.2, 0.1]),
            group(3, true, [0.2, 0.05]),
        ];
        let f = findings(&groups);
        assert_eq!((f.pairs, f.moving_no_worse), (4, 3));
        assert!((f.moving_to_still.unwrap() - (0.5 + 0.5 + 2.0 + 1.0) / 4.0).abs() < 1e-12);
        assert!((f.diffuse_to_specular.unwrap() - 0.3 / 0.15).abs() < 1e-12);
        assert!(markdown(&groups).contains("in 3 of 4 conditions"));
        // `--index` shows one group, of which nothing can be found.
        for one in &groups {
            let told = markdown(std::slice::from_ref(one));
            assert!(
                told.lines().count() > 2 && !told.contains("NaN") && !told.contains("times the error"),
                "{told}"
            );
        }
        assert_eq!(csv(&groups).lines().count(), 9);
        assert!(csv(&groups)
            .lines()
            .nth(1)
            .is_some_and(|l| l.starts_with("\"a 'device'\",\"d\",c,h,1,diffuse,still,5,")));
    }
}
