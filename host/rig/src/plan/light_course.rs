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
