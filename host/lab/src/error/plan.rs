//! What is compared with what: methods, ablations, and the groups of equal rays they are measured in.

use dpm_render::method::{Method, SamplerKind};
use dpm_rig::config::{EffectsConfig, RenderConfig, RenderMethod};

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

/// The five methods; with `ablation`, dpm with each part off in turn too. `paper` comes first: its rays are everybody's budget.
pub fn contenders(render: &RenderConfig, ablation: bool) -> Vec<Contender> {
    let of = |which: RenderMethod| Contender { name: which.word(), method: method_of(render, which) };
    let dpm = method_of(render, RenderMethod::Dpm);
    let mut all = vec![
        of(RenderMethod::Paper),
        of(RenderMethod::Full),
        of(RenderMethod::Sequence),
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

/// One group: all methods at the rays that `paper` takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Group {
    /// Bodies move as the rig file says; else they stand where the last frame has them.
    pub moving: bool,
    /// Samples of a pixel of `paper` where the eye looks; below 1: that share of the rays that 1 takes.
    pub budget: f64,
}

impl Group {
    /// Name for files and people.
    pub fn name(&self) -> String {
        format!("{}-{}", if self.moving { "moving" } else { "still" }, self.budget)
    }
}

/// All groups in the order of their numbers: standing ones first.
pub fn groups(budgets: &[f64]) -> Vec<Group> {
    let of = |moving| budgets.iter().map(move |&budget| Group { moving, budget });
    of(false).chain(of(true)).collect()
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
}
