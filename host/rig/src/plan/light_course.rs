//! A projector's keys into the course of its light: when the planes of a code value are lit, and how bright.
//!
//! An even field is taken, as large as a part of it that an eye cannot resolve. Where mirrors show halftones, each plane
//! gives the mean of its block of mirrors. A display that holds code values is taken as steady: what it does within a frame is
//! its own affair, and not known here.

use super::light_centre::Lights;
use crate::config::{PlaneTiming, ProjectorConfig};
use dpm_device::planes::{Channel, PlaneSpec, Raster};
use dpm_render::pack::{halftone, source_bits, Halftone};

/// Light of a constant brightness between two instants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Flash {
    /// Its begin and its end, nanoseconds from the first photon of the first frame on; the end is not before the begin.
    pub span_ns: [f64; 2],
    /// Brightness of red, green and blue, in units of full white: the mean over a period is the code value's share of it, or of the
    /// light of all planes where these do not reach it or exceed it.
    pub light: [f64; 3],
}

/// Light that repeats for ever.
#[derive(Clone, Debug, PartialEq)]
pub struct LightCourse {
    /// Time after which it repeats, nanoseconds; above 0. One frame, or two where halftones differ from frame to frame.
    pub period_ns: f64,
    /// Within one period, in any order; they add up where they overlap.
    pub flashes: Vec<Flash>,
}

/// Mirrors in a row of the field of which the halftone's mean is taken: all the cells that it tells apart.
const SIDE: u32 = 64;
/// Frames in which halftones round a mean by different amounts.
const FRAMES: u32 = 2;

impl LightCourse {
    /// The light of an even field of the code values `code` (red, green, blue); `None` if the projector's video input decides
    /// it.
    pub fn of(projector: &ProjectorConfig, code: [u8; 3]) -> Option<Self> {
        if projector.is_lit_by_video_input() {
            return None;
        }
        let schedule = projector.schedule();
        let lights = Lights::of_projector(projector, &schedule);
        let frame_ns = lights.lit.frame_ns as f64;
        if lights.timing == PlaneTiming::Held {
            let steady =
                Flash { span_ns: [0.0, frame_ns], light: code.map(|value| f64::from(value) / 255.0) };
            return Some(Self { period_ns: frame_ns, flashes: vec![steady] });
        }
        let halftone = Halftone::of(&schedule);
        let frames = halftone.map_or(1, |_| FRAMES);
        let white = f64::from(schedule.limit_weight());
        let mut flashes = Vec::new();
        for frame in 0..frames {
            let of_planes = match halftone {
                Some(halftone) => shares_of_mirrors(halftone, &source_bits(&schedule), frame, code),
                None => Vec::new(),
            };
            for (k, (plane, span)) in lights.spans().enumerate() {
                let share = of_planes.get(k).copied().unwrap_or_else(|| bit_of(plane, code));
                let span_ns = span.map(|ns| ns + f64::from(frame) * frame_ns);
                let weight = f64::from(lights.light_of(plane)) / white;
                let brightness = share * weight * frame_ns / (span[1] - span[0]).max(1.0);
                flashes.push(Flash { span_ns, light: lit_by(plane.channel).map(|lit| lit * brightness) });
            }
        }
        Some(Self { period_ns: f64::from(frames) * frame_ns, flashes })
    }
}

/// 1 for each of red, green and blue that planes of a channel light.
fn lit_by(channel: Channel) -> [f64; 3] {
    match channel {
        Channel::Red => [1.0, 0.0, 0.0],
        Channel::Green => [0.0, 1.0, 0.0],
        Channel::Blue => [0.0, 0.0, 1.0],
        Channel::White => [1.0; 3],
    }
}

/// Whether a mirror of the code values `code` is on in a plane that shows a bit of them.
fn bit_of(plane: PlaneSpec, code: [u8; 3]) -> f64 {
    let value = match plane.channel {
        Channel::Red => code[0],
        Channel::Green | Channel::White => code[1],
        Channel::Blue => code[2],
    };
    f64::from(value >> plane.bit & 1)
}

/// For each plane the share of mirrors that are on, where all have the code values `code`.
fn shares_of_mirrors(how: Halftone, bits: &[u8], frame: u32, code: [u8; 3]) -> Vec<f64> {
    let raster = Raster::new(SIDE, SIDE).expect("not empty");
    let [r, g, b] = code.map(u32::from);
    let codes = vec![b << 16 | g << 8 | r; raster.pixel_count()];
    let mut words = vec![0; codes.len()];
    halftone(how, raster, frame, &codes, &mut words);
    let on = |bit: &u8| words.iter().filter(|word| *word >> bit & 1 == 1).count();
    bits.iter().map(|bit| on(bit) as f64 / words.len() as f64).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};

    fn projector(keys: &[&str]) -> ProjectorConfig {
        let flags = keys.iter().chain(&["real_time.pace=real"]).map(|key| (*key).to_owned()).collect();
        let overrides = Overrides { variables: vec![], flags };
        RigConfig::demo(&overrides).unwrap_or_else(|e| panic!("{keys:?}: {e}")).projector
    }

    /// Mean light of each channel over a period.
    fn mean(course: &LightCourse) -> [f64; 3] {
        let of =
            |c: usize| course.flashes.iter().map(|f| f.light[c] * (f.span_ns[1] - f.span_ns[0])).sum::<f64>();
        [0, 1, 2].map(|c| of(c) / course.period_ns)
    }

    const CONTROLLER: [&str; 6] = [
        "projector.width=1920",
        "projector.height=1080",
        "projector.frame_rate=60",
        "projector.backend.kind=display",
        "projector.backend.dlpc900.panel=dlp6500",
        "projector.backend.encoding=rgb4x2",
    ];

    /// Whatever a frame is made of, its mean light is that of the code value: as a share of full white, or of the light of
    /// all planes where these do not reach it.
    #[test]
    fn the_mean_light_is_the_code_value() {
        let equal = ["projector.weights=equal"];
        let split = ["projector.weights=split"];
        let alp = [
            "projector.frame_rate=80",
            "projector.planes=8",
            "projector.backend.kind=alp",
            "projector.backend.plane_times=binary",
        ];
        let loaded =
            [&CONTROLLER[..3], &["projector.backend.kind=dlpc900", "projector.backend.panel=dlp6500"]]
                .concat();
        let window = ["projector.frame_rate=60", "projector.backend.kind=window"];
        for keys in [&[][..], &equal, &split, &alp, &loaded, &window, &CONTROLLER] {
            let projector = projector(keys);
            let is_white = projector.schedule().planes().iter().all(|p| p.channel == Channel::White);
            let full = f64::from(projector.full_light()) / 255.0;
            for code in [[255, 255, 255], [200, 128, 33], [1, 77, 254]] {
                let course = LightCourse::of(&projector, code).unwrap();
                for (c, mean) in mean(&course).into_iter().enumerate() {
                    let wanted = f64::from(code[if is_white { 1 } else { c }]) / 255.0 * full;
                    assert!(
                        (mean - wanted).abs() < 2e-3,
                        "{keys:?}, {code:?}, channel {c}: {mean} of {wanted}"
                    );
                }
                let within = |f: &Flash| f.span_ns[0] >= 0.0 && f.span_ns[1] <= course.period_ns + 1.0;
                assert!(course.flashes.iter().all(within), "{keys:?}");
            }
        }
    }

    /// The planes of a default frame share it equally, and the highest bit of white is half of its light.
    #[test]
    fn planes_share_the_frame_and_halve_their_light() {
        let course = LightCourse::of(&projector(&[]), [255; 3]).unwrap();
        let frame_ns = 1e9 / 947.0;
        assert_eq!(course.flashes.len(), 24);
        for (k, flash) in course.flashes.iter().enumerate() {
            assert!((flash.span_ns[0] - k as f64 * frame_ns / 24.0).abs() < 1.0, "{k}");
            assert!((flash.span_ns[1] - flash.span_ns[0] - frame_ns / 24.0).abs() < 1.0, "{k}");
            let bit = [4, 6, 7, 5, 3, 2, 1, 0][k / 3];
            let brightness = 24.0 * f64::from(1 << bit) / 255.0;
            assert!((flash.light[k % 3] - brightness).abs() < 1e-6 * brightness, "{k}: {:?}", flash.light);
        }
    }

    /// Behind a controller the gaps are where its table has them.
    #[test]
    fn patterns_are_lit_as_the_table_of_the_controller_says() {
        let projector = projector(&CONTROLLER);
        let course = LightCourse::of(&projector, [255; 3]).unwrap();
        // Six patterns of 2480 us; what is left but for 250 us is dark after each of them.
        let pitch_ns = ((16_666 - 250) / 6 * 1000) as f64;
        for flash in &course.flashes {
            let pattern = (flash.span_ns[0] / pitch_ns).round();
            let [begin, end] = flash.span_ns.map(|ns| ns - pattern * pitch_ns);
            let (begin, end) = match pattern >= 6.0 {
                true => (begin - 16_666_666.0 + 6.0 * pitch_ns, end - 16_666_666.0 + 6.0 * pitch_ns),
                false => (begin, end),
            };
            assert!(begin.abs() < 2.0 && (end - 2_480_000.0).abs() < 2.0, "{pattern}: {begin} to {end}");
        }
    }
}
