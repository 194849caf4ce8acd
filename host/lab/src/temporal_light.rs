//! A projector's keys into what a person notices of the course of its light: how much it is modulated, whether it flickers,
//! what moves seem to stand still in it, and how far its colours part. Every figure is in units of what is just noticed, so
//! 1 is the threshold.

use crate::metrics::modulation::{
    colour_break_up, colours_apart_s, flicker, harmonics, phantom_array, stroboscopic_visibility,
};
use crate::metrics::sensitivity::flicker_sensitivity;
use dpm_rig::config::{ProjectorConfig, RigConfig};
use dpm_rig::plan::light_course::LightCourse;
use serde::Serialize;

pub use crate::metrics::modulation::Harmonic;
pub use crate::metrics::sensitivity::Field;

/// Where flicker is judged: what is looked at, and a large part of what is looked past, both as bright as white paper in a lit
/// room.
pub const JUDGED: [Field; 2] = [
    Field { eccentricity_deg: 0.0, radius_deg: 5.0, luminance: 100.0 },
    Field { eccentricity_deg: 20.0, radius_deg: 10.0, luminance: 100.0 },
];
/// Eccentricities, radii and luminances of the table of flicker, as in [`Field`].
const TABLE: [[f64; 3]; 3] = [[0.0, 10.0, 20.0], [1.0, 5.0, 10.0], [20.0, 100.0, 300.0]];
/// The darkest grey that is judged: an eighth of full light. Darker ones are modulated more, and seen less.
const DARKEST: u8 = 32;
/// Every so many greys are judged where each takes a halftone of its own; and where planes show the low bits of a grey as they
/// are, an odd number, so that all of these are met.
const STEP_OF_HALFTONES: [usize; 2] = [16, 7];

/// What is noticed of the light of a grey, each in units of its threshold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Noticed {
    /// Flicker, in the worse of the two fields of [`JUDGED`].
    pub flicker: f64,
    /// Stroboscopic visibility measure.
    pub stroboscopic: f64,
    /// Phantom array.
    pub phantom_array: f64,
    /// Colours that part.
    pub colour_break_up: f64,
}

impl Noticed {
    /// Names and figures.
    pub fn figures(&self) -> [(&'static str, f64); 4] {
        [
            ("flicker", self.flicker),
            ("stroboscopic effect", self.stroboscopic),
            ("phantom array", self.phantom_array),
            ("colour break-up", self.colour_break_up),
        ]
    }

    /// The greater of each.
    fn max(self, other: Self) -> Self {
        Self {
            flicker: self.flicker.max(other.flicker),
            stroboscopic: self.stroboscopic.max(other.stroboscopic),
            phantom_array: self.phantom_array.max(other.phantom_array),
            colour_break_up: self.colour_break_up.max(other.colour_break_up),
        }
    }
}

/// Flicker in one part of the visual field.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FlickerSeen {
    /// Which part.
    #[serde(flatten)]
    pub field: Field,
    /// The worst grey, in units of the threshold there.
    pub flicker: f64,
}

/// The course of a projector's light.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TemporalLight {
    /// Modulation of white by frequency, up to 2 kHz; without those that are below a thousandth.
    pub white: Vec<Harmonic>,
    /// Modulation at the frame rate over the greys of at least an eighth: mean, 90th percentile, worst. None if that is beyond
    /// 2 kHz.
    pub at_frame_rate: Option<[f64; 3]>,
    /// What is noticed of the worst grey, figure by figure.
    pub worst: Noticed,
    /// Time between the first and the last colour of white, milliseconds.
    pub colours_apart_ms: f64,
    /// Flicker by eccentricity, area and luminance.
    pub fields: Vec<FlickerSeen>,
}

impl TemporalLight {
    /// The light of `projector`; `None` if another program decides it.
    pub fn of(projector: &ProjectorConfig) -> Option<Self> {
        let [of_parts, of_split] = STEP_OF_HALFTONES;
        let step = projector.schedule().parts().map_or(1, |p| if p.low > 0 { of_split } else { of_parts });
        let greys: Vec<LightCourse> = (DARKEST..=u8::MAX)
            .rev()
            .step_by(step)
            .map(|grey| LightCourse::of(projector, [grey; 3]))
            .collect::<Option<_>>()?;
        let spectra: Vec<Vec<Harmonic>> = greys.iter().map(harmonics).collect();
        // The thresholds are those of the frequencies, which all greys share.
        let lines = spectra.iter().fold(Vec::new(), |most: Vec<Harmonic>, one| {
            let at = |k: usize| most.get(k).map_or(0.0, |h| h.modulation);
            one.iter()
                .enumerate()
                .map(|(k, h)| Harmonic { modulation: h.modulation.max(at(k)), ..*h })
                .collect()
        });
        let white = greys.first()?;
        let worst = spectra.iter().zip(&greys).fold(None, |worst: Option<Noticed>, (spectrum, course)| {
            let one = Noticed {
                flicker: 0.0,
                stroboscopic: stroboscopic_visibility(spectrum),
                phantom_array: phantom_array(spectrum),
                colour_break_up: colour_break_up(course),
            };
            Some(worst.map_or(one, |worst| worst.max(one)))
        })?;
        let [eccentricities, radii, luminances] = TABLE;
        let fields = eccentricities.into_iter().flat_map(|eccentricity_deg| {
            radii.into_iter().flat_map(move |radius_deg| {
                luminances.map(|luminance| Field { eccentricity_deg, radius_deg, luminance })
            })
        });
        let fields = fields.map(|field| FlickerSeen { field, flicker: flicker(&lines, field) }).collect();
        Some(Self {
            white: spectra[0].iter().copied().filter(|h| h.modulation >= 1e-3).collect(),
            at_frame_rate: at_frame_rate(&spectra, projector.frame_rate.hz()),
            worst: Noticed {
                flicker: JUDGED.map(|f| flicker(&lines, f)).into_iter().fold(0.0, f64::max),
                ..worst
            },
            colours_apart_ms: 1e3 * colours_apart_s(white),
            fields,
        })
    }

    /// The modulation of white, and what is noticed of the worst grey, in words.
    pub fn told(&self) -> String {
        let mut strongest = self.white.clone();
        strongest.sort_by(|a, b| b.modulation.total_cmp(&a.modulation));
        let lines: Vec<String> = strongest
            .iter()
            .take(2)
            .map(|h| format!("{:.2} of its mean at {:.0} Hz", h.modulation, h.hz))
            .collect();
        let white = match lines.is_empty() {
            true => "white is steady".to_owned(),
            false => format!("white is modulated by {}", lines.join(" and ")),
        };
        let figures = self.worst.figures().map(|(name, figure)| format!("{name} {figure:.2}"));
        format!("{white}; in units of what is just noticed, the worst grey has {}", figures.join(", "))
    }

    /// What is above its threshold, with its figure.
    pub fn noticed(&self) -> Vec<(&'static str, f64)> {
        self.worst.figures().into_iter().filter(|(_, figure)| *figure > 1.0).collect()
    }
}

/// Mean, 90th percentile and maximum of the modulation at `hz`.
fn at_frame_rate(spectra: &[Vec<Harmonic>], hz: f64) -> Option<[f64; 3]> {
    let of = |spectrum: &Vec<Harmonic>| {
        spectrum.iter().find(|h| (h.hz / hz - 1.0).abs() < 1e-3).map(|h| h.modulation)
    };
    let mut all: Vec<f64> = spectra.iter().filter_map(of).collect();
    all.sort_by(f64::total_cmp);
    let last = all.last()?;
    Some([all.iter().sum::<f64>() / all.len() as f64, all[all.len() * 9 / 10], *last])
}

/// Keys of the rig file that were changed, as `--set` takes them, and the light then.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Mend {
    /// The keys.
    pub keys: Vec<String>,
    /// The light with them.
    pub light: TemporalLight,
}

/// What could mend a light, the cheapest first.
const MENDS: [&[&str]; 14] = [
    &["projector.weights=\"equal\""],
    &["projector.backend.plane_times=\"equal\"", "projector.weights=\"equal\""],
    &["projector.backend.encoding=\"binary24\""],
    &["projector.backend.encoding=\"mono1x24\""],
    &["projector.planes=8"],
    &["projector.frame_rate=\"80\""],
    &["projector.frame_rate=\"100\""],
    &["projector.frame_rate=\"120\""],
    &["projector.frame_rate=\"240\""],
    &["projector.frame_rate=\"480\""],
    &["projector.frame_rate=\"947\""],
    &[
        "projector.frame_rate=\"240\"",
        "projector.backend.plane_times=\"equal\"",
        "projector.weights=\"equal\"",
    ],
    &["projector.frame_rate=\"240\"", "projector.weights=\"equal\""],
    &["projector.frame_rate=\"947\"", "projector.weights=\"equal\""],
];

impl Mend {
    /// What to write into the rig file, and what it brings.
    pub fn told(&self) -> String {
        let keys: Vec<String> = self.keys.iter().map(|key| key.replacen('=', " = ", 1)).collect();
        let left: Vec<String> =
            self.light.noticed().iter().map(|(name, figure)| format!("{name} {figure:.2}")).collect();
        let left = if left.is_empty() {
            "all below 1".to_owned()
        } else {
            format!("what is left: {}", left.join(", "))
        };
        format!("{} mends it ({left}); docs/EYES.md says what that costs", keys.join(" with "))
    }
}

/// What to do where no key of the rig file helps.
pub const NO_MEND: &str = "no key of this rig file mends it; docs/EYES.md says why, and what is seen";

/// The first change of keys that brings all below the threshold, else one that does so for flicker if `light` flickers; `None`
/// if nothing is noticed, or no key does. `read` reads the rig file with other keys, and refuses what it refuses.
pub fn mend(light: &TemporalLight, read: impl Fn(&[&str]) -> Option<RigConfig>) -> Option<Mend> {
    if light.noticed().is_empty() {
        return None;
    }
    let tried = || {
        MENDS.iter().filter_map(|keys| {
            let light = TemporalLight::of(&read(keys)?.projector)?;
            Some(Mend { keys: keys.iter().map(|key| (*key).to_owned()).collect(), light })
        })
    };
    let all = tried().find(|mend| mend.light.noticed().is_empty());
    let flickers = light.worst.flicker > 1.0;
    all.or_else(|| tried().find(|mend| flickers && mend.light.worst.flicker <= 1.0))
}

/// Sensitivity to flicker in a field; for those who compare it with other programs.
pub fn sensitivity(field: Field, hz: f64) -> f64 {
    flicker_sensitivity(field, hz)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::config::Overrides;

    /// Mean and 90th percentile of the modulation at 947 frames/s over greys, and the light of white.
    fn of(weights: &str) -> ([f64; 2], f64) {
        let flags = vec![format!("projector.weights={weights:?}"), "real_time.pace=\"real\"".to_owned()];
        let rig = RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
        let [mean, p90, _] = TemporalLight::of(&rig.projector).unwrap().at_frame_rate.unwrap();
        let white = LightCourse::of(&rig.projector, [u8::MAX; 3]).unwrap();
        let light = white.flashes.iter().map(|f| f.light[1] * (f.span_ns[1] - f.span_ns[0])).sum::<f64>();
        let peak = white.flashes.iter().map(|f| f.light[1]).fold(0.0, f64::max);
        ([mean, p90], light / white.period_ns / peak)
    }

    /// Three planes of the highest bit leave half of the modulation of one, and twice the light at the same peak.
    #[test]
    fn a_split_highest_bit_modulates_less_and_lights_more() {
        let [(split, white), (binary, of_binary)] = ["split", "binary"].map(of);
        println!(
            "split {split:.3?}, binary {binary:.3?}: white {:.3} times at the same peak",
            white / of_binary
        );
        assert!(split[0] <= 0.85 && split[1] <= 1.65, "{split:?}");
        assert!(binary[0] > 1.4 && binary[1] > split[1], "{binary:?}");
        assert!(white >= 1.9 * of_binary, "{white} {of_binary}");
    }
}
