//! The preliminary experiment of \[paper\] section 3 with the eye model in the observer's place: one body in four materials, 5 to 30 samples
//! a pixel, standing and moving, each against 1,000 samples.
//!
//! \[paper\] asks whether an eye that follows a body at 947 fps still integrates frames: its author rated the noise of each condition. Here
//! the noise is what two runs of independent samples do not share after 31 frames on every point of that body.

use super::reference::{mean_of, Reference};
use super::report::stamps;
use super::runs::{ErrorOptions, ErrorRunError, EYE_FRAMES, LAST_SLOT};
use crate::median::median_ms;
use crate::sequence::{eye_mean, rmse, Span, Theatre};
use crate::stamp::{Fnv, Stamp};
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_rig::rig::Rig;
use dpm_scene::Material;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::sync::Arc;

/// Samples a pixel of \[paper\] section 3.
pub const SPP: [u32; 5] = [5, 10, 15, 20, 30];

/// The four reflections: names and looks, the diffuse ones first. \[paper\] gives no numbers; these are the scenes' that rebuild it.
pub(crate) fn looks() -> [Material; 4] {
    let of = |name: &str, color: [u8; 3], metallic, roughness| Material {
        name: name.into(),
        base_color: Vec3::from_array(color.map(|c| f32::from(c) / 255.0)),
        metallic,
        roughness,
        ..Material::default()
    };
    [
        of("diffuse", [191, 140, 102], 0.0, 1.0),
        of("glossy", [191, 140, 102], 0.0, 0.25),
        of("rough-metal", [242, 163, 138], 1.0, 0.35),
        of("mirror", [242, 237, 224], 1.0, 0.02),
    ]
}

/// One condition without its samples: a material, standing or moving.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Setting {
    /// Index into [`looks`].
    pub look: usize,
    /// Bodies move as the rig file says.
    pub moving: bool,
}

impl Setting {
    /// All, standing ones first.
    pub fn all() -> Vec<Self> {
        [false, true].into_iter().flat_map(|moving| (0..4).map(move |look| Self { look, moving })).collect()
    }

    /// Name for files and people.
    pub fn name(self) -> String {
        format!("{}-{}", looks()[self.look].name, if self.moving { "moving" } else { "still" })
    }
}

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
        let of = |r: &Figure3Row| {
            let look = looks().iter().position(|l| l.name == r.material).unwrap_or(0);
            Setting { look, moving: r.moving }
        };
        self.rows.first().map_or(Setting { look: 0, moving: false }, of)
    }
}

/// A rig whose first tracked body is made of one of [`looks`].
pub(super) fn dressed(mut rig: Rig, look: usize) -> (Rig, usize) {
    let body = rig.scene.bodies.iter().position(|b| b.tracked == Some(0)).unwrap_or(0);
    let material = rig.scene.materials.len() as u32;
    rig.scene.materials.push(looks()[look].clone());
    if let Some(b) = rig.scene.bodies.get_mut(body) {
        b.mesh.materials.fill(material);
    }
    (rig, body)
}

/// Names all that a setting's result depends on.
pub fn key(stamp: &Stamp, setting: Setting, options: &ErrorOptions, spp: &[u32]) -> String {
    let mut hash = Fnv::default();
    // Writing into a hash cannot fail.
    let _ = write!(hash, "figure 3 {stamp:?}{setting:?}{:?}{spp:?}{}", looks(), options.extent.reference_spp);
    hash.text()
}

/// Measures a setting at all samples. `each` is called before every sequence with its name.
///
/// # Errors
/// The renderer's; nothing of the body is lit; the cache cannot be written.
pub fn measure(
    rig: Rig,
    gpu: &Arc<Gpu>,
    setting: Setting,
    options: &ErrorOptions,
    spp: &[u32],
    each: &mut dyn FnMut(&str),
) -> Result<Figure3Group, ErrorRunError> {
    let stamp = Stamp::new(&rig, gpu.summary());
    let (rig, body) = dressed(rig, setting.look);
    let seed = rig.config.render.seed as u32;
    let span = Span { last_slot: LAST_SLOT, warm_up: 0, kept: EYE_FRAMES as u32 };
    let make = if setting.moving { Theatre::new } else { Theatre::frozen };
    let theatre = make(Arc::new(rig), gpu.clone(), span)?;
    let on_body = |i: usize| theatre.probes()[i].body == body;
    let probes = (0..theatre.probes().len()).filter(|&i| on_body(i)).count();
    if probes == 0 {
        return Err(ErrorRunError::NothingLit);
    }
    let what = format!(
        "figure 3 {}{:?}{:?}{}{}",
        stamp.config_hash,
        stamp.raster,
        looks()[setting.look],
        setting.moving,
        span.last_slot
    );
    let reference = Reference::new(&theatre, options.extent.reference_spp, &what, &options.cache, each)?;
    let seen: Vec<Vec3> =
        (0..theatre.probes().len()).filter(|&i| on_body(i)).map(|i| reference.eye[i]).collect();
    let mean = mean_of(&seen).max(f64::MIN_POSITIVE);
    let mut rows = Vec::new();
    for &spp in spp {
        let method = Method::full(spp);
        let mut play = |seed: u32| {
            each(&format!("{spp} spp"));
            theatre.play(&method, spp as f32, seed, &mut |_, _| ())
        };
        let runs = [play(seed)?, play(seed.wrapping_add(1_000_003))?];
        let eyes = [0, 1].map(|i: usize| eye_mean(&runs[i].frames, EYE_FRAMES));
        let single = |i: usize| runs[i].frames.last().map_or(0.0, |f| rmse(f, &reference.last, on_body));
        rows.push(Figure3Row {
            material: looks()[setting.look].name.clone(),
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
        key: key(&stamp, setting, options, spp),
        stamp,
        probes,
        reference_error: 0.5 * halves / mean,
        rows,
    })
}

/// What the two findings of \[paper\] section 3 are here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Findings {
    /// Conditions measured both standing and moving.
    pub pairs: usize,
    /// Those in which the moving one is no worse, within 5 %.
    pub moving_no_worse: usize,
    /// Mean ratio of moving to standing noise.
    pub moving_to_still: f64,
    /// At the fewest samples: mean noise of the materials with a diffuse part by that of those without.
    pub diffuse_to_specular: f64,
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
        of.iter().sum::<f64>() / of.len() as f64
    };
    Findings {
        pairs: pairs.len(),
        moving_no_worse: pairs.iter().filter(|&&p| p <= 1.05).count(),
        moving_to_still: pairs.iter().sum::<f64>() / pairs.len() as f64,
        diffuse_to_specular: at_fewest(true) / at_fewest(false),
    }
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
    let _ = writeln!(
        text,
        "\nMoving is no worse than standing (within 5 %) in {} of {} conditions; on average it has {:.2} of the error. At the fewest samples the \
         materials with a diffuse part have {:.2} times the error of those without.",
        f.moving_no_worse, f.pairs, f.moving_to_still, f.diffuse_to_specular
    );
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
        assert!((f.moving_to_still - (0.5 + 0.5 + 2.0 + 1.0) / 4.0).abs() < 1e-12);
        assert!((f.diffuse_to_specular - 0.3 / 0.15).abs() < 1e-12);
        assert!(markdown(&groups).contains("in 3 of 4 conditions"));
        assert_eq!(csv(&groups).lines().count(), 9);
        assert!(csv(&groups)
            .lines()
            .nth(1)
            .is_some_and(|l| l.starts_with("\"a 'device'\",\"d\",c,h,1,diffuse,still,5,")));
    }

    #[test]
    fn settings_have_names_of_their_own() {
        let names: std::collections::BTreeSet<String> =
            Setting::all().into_iter().map(Setting::name).collect();
        assert_eq!(names.len(), 8);
    }
}
