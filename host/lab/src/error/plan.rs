//! What is compared with what: methods, ablations, and the settings they are measured in.
//!
//! Three experiments share these settings. The first measures every method on the rig as it is, at several budgets of rays. The table does
//! so at one budget, with the first tracked body in four materials, looked at and looked past. The third is the preliminary experiment of
//! \[paper\] section 3: one method at rising samples, on one body in four materials.

use dpm_device::planes::Raster;
use dpm_render::method::{Method, SamplerKind};
use dpm_rig::config::{EffectsConfig, RenderConfig, RenderMethod};
use dpm_rig::rig::Rig;
use dpm_scene::Material;
use glam::{DQuat, DVec3, Vec3};
use serde::{Deserialize, Serialize};
use std::str::FromStr;
use std::sync::Arc;

/// A method to be measured.
#[derive(Clone, Debug)]
pub struct Contender {
    /// Name in the tables.
    pub name: &'static str,
    /// The method.
    pub method: Method,
}

/// A method as its authors have it: the rig's constants, but none of the rig's switches.
pub(crate) fn method_of(render: &RenderConfig, which: RenderMethod) -> Method {
    switched_method_of(&RenderConfig { effects: EffectsConfig::default(), ..render.clone() }, which)
}

/// A method with the switches that the rig file sets.
pub(crate) fn switched_method_of(render: &RenderConfig, which: RenderMethod) -> Method {
    let mut own = render.clone();
    own.method = which;
    if which == RenderMethod::Miyamoto {
        // Table 1 of the paper sets samples by angle; its predecessor has one count everywhere.
        own.effects.spp_by_angle = own.effects.spp_by_angle.or(Some(false));
    }
    own.to_method()
}

/// What the row of the frame's own samples is called, shown without history or filter: what a history or a filter makes worse than this is
/// better left out.
pub const OWN: &str = "own";

/// The five methods, and what lies under dpm ([`OWN`]); with `ablation`, dpm with each part off in turn too. `paper` comes first: its rays
/// are everybody's budget.
pub fn contenders(render: &RenderConfig, ablation: bool) -> Vec<Contender> {
    let of = |which: RenderMethod| Contender { name: which.word(), method: method_of(render, which) };
    let dpm = method_of(render, RenderMethod::Dpm);
    let mut all = vec![
        of(RenderMethod::Paper),
        of(RenderMethod::Full),
        of(RenderMethod::Sequence),
        of(RenderMethod::Own),
        of(RenderMethod::Miyamoto),
        of(RenderMethod::Dpm),
    ];
    if ablation {
        let but = |name, method| Contender { name, method };
        all.push(but("dpm, even rays", Method { rate_map: false, ..dpm.clone() }));
        all.push(but("dpm, no spatial filter", Method { spatial: false, ..dpm.clone() }));
        let white = Method { sampler: SamplerKind::Independent, ..dpm.clone() };
        all.push(but("dpm, independent samples", white));
        all.push(but("dpm, no history", Method { temporal: false, history_cap: 0.0, ..dpm }));
    }
    all
}

/// `paper` at a budget: its table 1 (18, 18, 2) scaled to `budget` in the middle of the view, never below 1.
pub(crate) fn paper_at(method: &Method, budget: f64) -> Method {
    let mut scaled = method.clone();
    let of = &method.paper.zone_spp;
    let most = of.iter().copied().max().unwrap_or(1).max(1);
    scaled.paper.zone_spp = of.map(|spp| (f64::from(spp) * budget / f64::from(most)).round().max(1.0) as u32);
    scaled
}

/// A method's name as part of a file's.
pub(crate) fn file_word(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect()
}

/// Samples of \[paper\] table 1 where the eye looks.
pub(crate) const BUDGET: f64 = 18.0;
/// Angle at the eye between the middle of the picture and the gaze that looks past it, degrees.
pub(crate) const ASIDE_DEG: f64 = 27.0;

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

/// A part of the projector's raster, which is drawn at the density of the whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Window {
    /// Its left column.
    pub x: u32,
    /// Its upper row.
    pub y: u32,
    /// Columns, at least 16.
    pub width: u32,
    /// Rows, at least 16.
    pub height: u32,
}

impl std::fmt::Display for Window {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{},{},{}x{}", self.x, self.y, self.width, self.height)
    }
}

impl FromStr for Window {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |part: Option<&str>| part.and_then(|part| part.trim().parse::<u32>().ok());
        let mut parts = text.split([',', 'x', 'X']);
        let all = [(); 4].map(|()| number(parts.next()));
        match (all, parts.next()) {
            ([Some(x), Some(y), Some(width @ 16..), Some(height @ 16..)], None) => {
                Ok(Self { x, y, width, height })
            }
            _ => {
                Err("write X,Y,WxH in pixels of the projector, 16x16 or more, for example 400,300,160x120"
                    .into())
            }
        }
    }
}

impl Window {
    /// The rig whose projector has these mirrors alone.
    ///
    /// # Errors
    /// It reaches beyond the raster.
    pub fn of(self, mut rig: Rig) -> Result<Rig, String> {
        let whole = rig.camera.raster;
        let fits = |begin: u32, size: u32, of: u32| begin.checked_add(size).is_some_and(|end| end <= of);
        let raster = Raster::new(self.width, self.height)
            .filter(|_| fits(self.x, self.width, whole.width()) && fits(self.y, self.height, whole.height()));
        let Some(raster) = raster else {
            return Err(format!(
                "--window {self} reaches beyond the projector's {} x {} pixels",
                whole.width(),
                whole.height()
            ));
        };
        rig.camera.raster = raster;
        rig.camera.cx -= f64::from(self.x);
        rig.camera.cy -= f64::from(self.y);
        if let Some(field) = &rig.drive.flat_field {
            let row =
                |y: u32| &field[((self.y + y) * whole.width() + self.x) as usize..][..self.width as usize];
            rig.drive.flat_field = Some(Arc::new((0..self.height).flat_map(row).copied().collect()));
        }
        Ok(rig)
    }
}

/// One condition of an experiment: bodies, gaze and budget.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Setting {
    /// The first tracked body is made of this one of four materials; `None`: of what its file says.
    pub look: Option<usize>,
    /// Bodies move as the rig file says; else they stand where the last frame has them.
    pub moving: bool,
    /// The eye looks past the picture, so that all of it lies beyond the paper's outer zone, where its filter is fully in.
    pub aside: bool,
    /// Samples of a pixel of `paper` where the eye looks, whose rays all methods get; below 1: that share of the rays that 1 takes.
    pub budget: f64,
}

impl Setting {
    /// The rig as its file has it, looked at.
    pub fn plain(moving: bool, budget: f64) -> Self {
        Self { look: None, moving, aside: false, budget }
    }

    /// The first tracked body in the material of this name.
    pub(super) fn of_material(material: &str, moving: bool, aside: bool) -> Self {
        let look = looks().iter().position(|l| l.name == material).unwrap_or(0);
        Self { look: Some(look), moving, aside, budget: BUDGET }
    }

    /// Name of the material, where the experiment gives one.
    pub(super) fn material(self) -> Option<String> {
        self.look.map(|look| looks()[look].name.clone())
    }

    /// How bodies move, in a word.
    pub(super) fn motion(self) -> &'static str {
        if self.moving {
            "moving"
        } else {
            "still"
        }
    }

    /// Name for files and people.
    pub fn name(self) -> String {
        let (motion, aside) = (self.motion(), if self.aside { "-aside" } else { "" });
        match self.material() {
            Some(material) => format!("{material}-{motion}{aside}"),
            None => format!("{motion}-{}{aside}", self.budget),
        }
    }

    /// A rig in this setting, and the body that is looked at.
    pub(super) fn apply(self, mut rig: Rig) -> (Rig, usize) {
        let body = rig.scene.bodies.iter().position(|b| b.tracked == Some(0)).unwrap_or(0);
        if let Some(look) = self.look {
            let material = rig.scene.materials.len() as u32;
            rig.scene.materials.push(looks()[look].clone());
            if let Some(b) = rig.scene.bodies.get_mut(body) {
                b.mesh.materials.fill(material);
            }
        }
        if self.aside {
            let (eye, _) = rig.observer.eye_and_gaze(&[]);
            let middle = DVec3::from_array(rig.config.projector.look_at);
            rig.observer = rig.observer.clone().looking_at(past(eye, middle));
        }
        (rig, body)
    }

    /// Settings of all methods at several budgets, in the order of their numbers: standing ones first.
    pub fn at_budgets(budgets: &[f64]) -> Vec<Self> {
        let of = |moving| budgets.iter().map(move |&budget| Self::plain(moving, budget));
        of(false).chain(of(true)).collect()
    }

    /// Settings of the table: looked at first, standing before moving.
    pub fn of_table() -> Vec<Self> {
        [false, true].into_iter().flat_map(Self::in_all_materials).collect()
    }

    /// Settings of figure 3: standing ones first.
    pub fn of_figure3() -> Vec<Self> {
        Self::in_all_materials(false).collect()
    }

    fn in_all_materials(aside: bool) -> impl Iterator<Item = Self> {
        let of = move |moving| (0..looks().len()).map(move |look| (look, moving));
        let all = of(false).chain(of(true));
        all.map(move |(look, moving)| Self { look: Some(look), moving, aside, budget: BUDGET })
    }
}

/// Where an eye at `eye` looks that turns its gaze up by [`ASIDE_DEG`] from `middle`.
fn past(eye: DVec3, middle: DVec3) -> DVec3 {
    let ahead = middle - eye;
    let axis = ahead.cross(DVec3::Y).try_normalize().unwrap_or(DVec3::X);
    eye + DQuat::from_axis_angle(axis, ASIDE_DEG.to_radians()) * ahead
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_zones_scale_together_and_never_vanish() {
        let paper = method_of(&RenderConfig::default(), RenderMethod::Paper);
        assert_eq!(paper_at(&paper, 18.0).paper.zone_spp, [18, 18, 2]);
        assert_eq!(paper_at(&paper, 9.0).paper.zone_spp, [9, 9, 1]);
        assert_eq!(paper_at(&paper, 2.0).paper.zone_spp, [2, 2, 1]);
        assert_eq!(paper_at(&paper, 36.0).paper.zone_spp, [36, 36, 4]);
    }

    #[test]
    fn every_ablation_differs_from_dpm_and_from_the_others() {
        let all = contenders(&RenderConfig::default(), true);
        for (i, a) in all.iter().enumerate() {
            for b in &all[..i] {
                assert!(a.name != b.name && a.method != b.method, "{} and {}", a.name, b.name);
            }
        }
    }
    #[test]
    fn settings_have_names_of_their_own() {
        for (all, count) in
            [(Setting::at_budgets(&[0.25, 18.0]), 4), (Setting::of_table(), 16), (Setting::of_figure3(), 8)]
        {
            let names: std::collections::BTreeSet<String> = all.into_iter().map(Setting::name).collect();
            assert_eq!(names.len(), count);
        }
    }

    /// A pixel of a window sees what that pixel of the whole raster sees.
    #[test]
    fn a_window_is_a_part_of_the_raster() {
        use dpm_rig::config::{Overrides, RigConfig};
        use glam::DVec2;
        let config = RigConfig::demo(&Overrides::default()).unwrap();
        let whole = Rig::build(&config, None).unwrap();
        let window: Window = "400,300,160x120".parse().unwrap();
        assert_eq!(window.to_string(), "400,300,160x120");
        let part = window.of(Rig::build(&config, None).unwrap()).unwrap();
        assert_eq!((part.camera.raster.width(), part.camera.raster.height()), (160, 120));
        for at in [DVec2::new(0.5, 0.5), DVec2::new(80.0, 119.5)] {
            let (a, b) = (part.camera.ray(at), whole.camera.ray(at + DVec2::new(400.0, 300.0)));
            assert!(a.direction.distance(b.direction) < 1e-12 && a.origin == b.origin);
        }
        for text in ["1,2", "1,2,8x40", "a,2,20x20", "1,2,20x20x3", "-1,0,20x20"] {
            assert!(text.parse::<Window>().is_err(), "{text}");
        }
        let beyond: Window = "1000,0,100x100".parse().unwrap();
        assert!(beyond.of(whole).err().unwrap().contains("1024 x 768"));
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
