//! Two videos into the quality of one beside the other, in just-objectionable differences (JOD): a twin of ColorVideoVDP.
//! \[Mantiuk24\], with the parameters of its public program (pycvvdp 0.5.7, base model 0.5.6).
//!
//! 10 is no difference; a pair that is 1 JOD apart is told apart by three people of four. Frames become colours opponent to one
//! another, these pass temporal filters (three sustained ones and a transient one), and each is cut into bands of spatial
//! frequency. In every band the contrast of both videos is multiplied by the eye's sensitivity, differences are masked by what
//! both have, and all is summed up. A video that is evenly darker is not worse to it: contrast is relative.

use super::MetricError;
use glam::Vec3;

/// Linear Rec. 709 into achromatic, red-green and yellow-violet (DKL of a white of D65), by the cone fundamentals of CIE 2006.
const TO_OPPONENT: [[f32; 3]; 3] = [
    [0.233_201_2, 0.728_830_8, 0.088_995_87],
    [0.127_620_77, -0.087_068_09, -0.036_777_39],
    [-0.214_822_51, -0.626_253_7, 0.851_403_33],
];
/// Channels: achromatic sustained, red-green, yellow-violet, achromatic transient.
const CHANNELS: usize = 4;
/// Spread and power of each channel's temporal filter, over frequencies in Hz.
const TEMPORAL: [[f64; 2]; CHANNELS] =
    [[5.793_36, 1.3314], [14.1255, 1.1196], [6.636_61, 0.947_901], [0.123_14, 0.1898]];
/// Centre of the transient filter, Hz.
const TRANSIENT_HZ: f64 = 5.0;
/// How long the temporal filters are, seconds.
const FILTER_S: f64 = 0.25;
/// Kernel of the pyramid.
const KERNEL: [f32; 5] = [0.05, 0.25, 0.4, 0.25, 0.05];
/// The lowest band of spatial frequencies, cycles a degree; and the frequency that the rest below it counts as.
const LOWEST_BAND: f64 = 0.2;
const REST_BAND: f64 = 0.1;
/// The darkest background, cd/m^2; and the greatest contrast.
const DARKEST: f32 = 0.01;
const MOST_CONTRAST: f32 = 1000.0;
/// Correction of the sensitivity, dB.
const SENSITIVITY_DB: f64 = -0.279_742_330_312_728_9;
const CONTRAST_GAIN: [f32; CHANNELS] = [1.0, 1.45, 1.0, 1.0];
/// Power of differences; powers, weights between channels (binary logarithms) and reach of masking.
const MASK_P: f32 = 2.264_355_2;
const MASK_Q: [f32; CHANNELS] = [1.302_622_7, 2.888_590_8, 3.680_771_4, 3.588_787_3];
const MASK_C: f64 = -0.795_497_119_426_727_3;
const CROSS_MASKING: [[f32; CHANNELS]; CHANNELS] = [
    [-0.189_501_05, -5.962_151, -4.318_346, -1.932_158_7],
    [2.565_559_4, 0.344_067_13, -2.719_646_5, -0.497_042_48],
    [3.811_837_2, -1.005_170_6, -0.519_337_65, -0.565_364_8],
    [-7.054_771_4, -5.527_150_6, -3.510_641_3, -2.088_05],
];
/// Spread of the blur of what masks, pixels; it is as wide as four times that, and smaller pictures are not blurred.
const MASK_BLUR: f64 = 3.0;
const BLUR_TAPS: usize = 13;
/// Decadic logarithm of the greatest difference.
const MOST_DIFFERENCE: f64 = 2.564_245_462_417_602_5;
const CHANNEL_WEIGHT: [f64; CHANNELS] = [1.0, 1.0, 1.0, 0.808_113_455_772_399_9];
const REST_WEIGHT: [f64; CHANNELS] =
    [0.003_633_448_621_258_14, 1.662_772_417_068_481_4, 4.118_745_326_995_85, 25.259_698_867_797_85];
const JOD_SLOPE: f64 = 0.043_956_939_131_021_5;
const JOD_POWER: f64 = 0.930_204_272_270_202_6;
/// Below this difference quality falls in proportion to it.
const SMALL: f64 = 0.1;
/// Added under every power, so that none is steep at 0.
const SOFT: f64 = 1e-5;

/// Sensitivities by castleCSF: see the file's head.
const SENSITIVITIES: &str = include_str!("contrast_sensitivity.txt");
/// Steps of the table each way, and its ends as decadic logarithms: luminances and spatial frequencies.
const STEPS: usize = 32;
const LUMINANCES: [f64; 2] = [-2.301_029_995_663_981_3, 4.0];
const FREQUENCIES: [f64; 2] = [-1.0, 1.806_179_973_983_887_2];

/// How two videos are shown.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Viewing {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Frames a second.
    pub frame_hz: f64,
    /// Pixels in a degree of the viewer's field.
    pub pixels_per_degree: f64,
    /// Only each so many-th frame is judged; all of them are seen. 1 judges all.
    pub every: usize,
}

/// JOD of `test` beside `reference`: frames of linear Rec. 709 in cd/m^2, row by row. What was before the first frame is taken to
/// have been the first frame.
///
/// # Errors
/// [`MetricError`] where frames are fewer than two, or of other sizes, or the videos are not equally long, or pictures are below
/// 8 x 8 pixels.
pub(crate) fn jod(test: &[Vec<Vec3>], reference: &[Vec<Vec3>], viewing: Viewing) -> Result<f64, MetricError> {
    let Viewing { width, height, .. } = viewing;
    if test.len() < 2 || test.len() != reference.len() {
        return Err(MetricError::Parameter("the number of frames"));
    }
    if width.min(height) < 8 {
        return Err(MetricError::Parameter("the size of a picture"));
    }
    if let Some(other) = test.iter().chain(reference).find(|frame| frame.len() != width * height) {
        return Err(MetricError::PixelCount { width, height, found: other.len() });
    }
    let pyramid = Pyramid::new(viewing);
    let sensitivity = Sensitivity::new(&pyramid.frequencies);
    let filters = temporal_filters(viewing.frame_hz);
    let videos = [test, reference].map(|video| video.iter().map(|frame| opponent(frame)).collect::<Vec<_>>());
    let judged: Vec<f64> = (0..test.len())
        .step_by(viewing.every.max(1))
        .map(|frame| {
            let seen = videos.each_ref().map(|video| filtered(video, &filters, frame));
            pyramid.difference(&seen, &sensitivity)
        })
        .collect();
    let mean = judged.iter().map(|q| soft(*q, 2.0)).sum::<f64>() / judged.len() as f64;
    Ok(quality(soft(mean, 0.5)))
}

/// A power without a steep begin.
fn soft(x: f64, power: f64) -> f64 {
    (x + SOFT).powf(power) - SOFT.powf(power)
}

fn soft32(x: f32, power: f32) -> f32 {
    const SOFT: f32 = self::SOFT as f32;
    (x + SOFT).powf(power) - SOFT.powf(power)
}

/// The norm of some parts, which are not negative.
fn norm(parts: impl Iterator<Item = f64>, power: f64) -> f64 {
    soft(parts.map(|part| soft(part, power)).sum(), 1.0 / power)
}

/// A difference as a quality, JOD.
fn quality(difference: f64) -> f64 {
    if difference <= SMALL {
        10.0 - JOD_SLOPE * SMALL.powf(JOD_POWER - 1.0) * difference
    } else {
        10.0 - JOD_SLOPE * difference.powf(JOD_POWER)
    }
}

/// A frame as three planes of opponent colours.
fn opponent(frame: &[Vec3]) -> [Vec<f32>; 3] {
    const LEAST: f32 = 0.005;
    TO_OPPONENT.map(|row| {
        let row = Vec3::from_array(row);
        frame.iter().map(|colour| row.dot(colour.max(Vec3::splat(LEAST)))).collect()
    })
}

/// The filter of each channel, the oldest frame first: an odd number of taps, alike either way.
fn temporal_filters(frame_hz: f64) -> [Vec<f32>; CHANNELS] {
    let taps = (FILTER_S * frame_hz / 2.0).ceil() as usize * 2 + 1;
    let lines = taps / 2 + 1;
    let hz = |line: usize| frame_hz / 2.0 * line as f64 / (lines - 1).max(1) as f64;
    std::array::from_fn(|channel| {
        let [spread, power] = TEMPORAL[channel];
        let gain = |hz: f64| match channel {
            3 => (-(hz.powf(power) - TRANSIENT_HZ.powf(power)).powi(2) / spread).exp(),
            _ => (-hz.powf(power) / spread).exp(),
        };
        let gains: Vec<f64> = (0..lines).map(|line| gain(hz(line))).collect();
        let at = |tap: usize| {
            let phase = std::f64::consts::TAU * (tap as f64 - (taps / 2) as f64) / taps as f64;
            let waves =
                gains.iter().zip(0..).skip(1).map(|(gain, k)| 2.0 * gain * (phase * f64::from(k)).cos());
            (gains[0] + waves.sum::<f64>()) / taps as f64
        };
        (0..taps).map(|tap| at(tap) as f32).collect()
    })
}

/// What the channels see at a frame.
fn filtered(video: &[[Vec<f32>; 3]], filters: &[Vec<f32>; CHANNELS], frame: usize) -> [Vec<f32>; CHANNELS] {
    std::array::from_fn(|channel| {
        let (filter, plane) = (&filters[channel], if channel == 3 { 0 } else { channel });
        let mut seen = vec![0.0; video[0][plane].len()];
        // Taps on frames before the first one all see that.
        let before = (filter.len() - 1).saturating_sub(frame);
        let first: f32 = filter[..=before].iter().sum();
        let later = filter[before + 1..].iter().copied();
        let weights = std::iter::once(first).chain(later);
        let frames = &video[(frame + 1).saturating_sub(filter.len())..=frame];
        for (weight, frame) in weights.zip(frames) {
            seen.iter_mut().zip(&frame[plane]).for_each(|(sum, v)| *sum += weight * v);
        }
        seen
    })
}

/// A picture of one channel.
#[derive(Clone, Debug)]
struct JodChannel {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl JodChannel {
    fn filled(width: usize, height: usize, of: impl Fn(usize, usize) -> f32) -> Self {
        let values =
            (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| of(x, y)).collect();
        Self { width, height, values }
    }

    fn at(&self, x: usize, y: usize) -> f32 {
        self.values[y * self.width + x]
    }

    /// Half as large: blurred, and every second row and column. The right border is mended by the parity of the rows, as the
    /// published program does it.
    fn reduced(&self) -> Self {
        let (w, h) = (self.width, self.height);
        let is_odd = h % 2 == 1;
        let tap = |n: usize, at: usize, k: usize| (2 * at + k).checked_sub(2).filter(|i| *i < n);
        // What lies beyond the end is mirrored: one place beyond an even number, two beyond an odd one.
        let beyond = |n: usize, value: &dyn Fn(usize) -> f32| {
            if is_odd {
                value(n - 1) * KERNEL[3] + value(n - 2) * KERNEL[4]
            } else {
                value(n - 1) * KERNEL[4]
            }
        };
        let before = |value: &dyn Fn(usize) -> f32| value(0) * KERNEL[1] + value(1) * KERNEL[0];
        let sum = |n: usize, at: usize, last: usize, value: &dyn Fn(usize) -> f32| {
            let inside: f32 = (0..5).filter_map(|k| Some(KERNEL[k] * value(tap(n, at, k)?))).sum();
            let low = if at == 0 { before(value) } else { 0.0 };
            inside + low + if at == last { beyond(n, value) } else { 0.0 }
        };
        let (half_w, half_h) = (w.div_ceil(2), h.div_ceil(2));
        let rows = Self::filled(w, half_h, |x, y| sum(h, y, half_h - 1, &|i| self.at(x, i)));
        Self::filled(half_w, half_h, |x, y| sum(w, x, half_w - 1, &|i| rows.at(i, y)))
    }

    /// As large as `width` x `height`, of which it is the half.
    fn expanded(&self, width: usize, height: usize) -> Self {
        // Place `i` of the padded course with zeros between: the course's own places are 2, 4, and so on.
        let source = |n: usize, size: usize, i: usize| {
            let last = size + 2 + size % 2;
            match i {
                0 => Some(0),
                i if i == last => Some(n - 1),
                i if i % 2 == 0 && i / 2 <= n && i < size + 2 => Some(i / 2 - 1),
                _ => None,
            }
        };
        let sum = |n: usize, size: usize, at: usize, value: &dyn Fn(usize) -> f32| -> f32 {
            (0..5).filter_map(|k| Some(2.0 * KERNEL[k] * value(source(n, size, at + k)?))).sum()
        };
        let rows = Self::filled(self.width, height, |x, y| sum(self.height, height, y, &|i| self.at(x, i)));
        Self::filled(width, height, |x, y| sum(self.width, width, x, &|i| rows.at(i, y)))
    }

    /// Blurred with the mask's spread; itself where it is too small for that. Borders are mirrored.
    fn blurred(&self) -> Self {
        let reach = BLUR_TAPS / 2;
        if self.width <= reach || self.height <= reach {
            return self.clone();
        }
        let taps: [f64; BLUR_TAPS] =
            std::array::from_fn(|k| (-0.5 * ((k as f64 - reach as f64) / MASK_BLUR).powi(2)).exp());
        let whole: f64 = taps.iter().sum();
        let taps = taps.map(|tap| (tap / whole) as f32);
        let mirrored = |n: usize, at: usize, k: usize| {
            let i = (at + k).abs_diff(reach);
            if i < n {
                i
            } else {
                2 * (n - 1) - i
            }
        };
        let sum = |n: usize, at: usize, value: &dyn Fn(usize) -> f32| -> f32 {
            taps.iter().enumerate().map(|(k, tap)| tap * value(mirrored(n, at, k))).sum()
        };
        let rows = Self::filled(self.width, self.height, |x, y| sum(self.height, y, &|i| self.at(x, i)));
        Self::filled(self.width, self.height, |x, y| sum(self.width, x, &|i| rows.at(i, y)))
    }
}

/// Bands of spatial frequency.
struct Pyramid {
    viewing: Viewing,
    /// Of each band, cycles a degree; the last is what is left below the others.
    frequencies: Vec<f64>,
}

impl Pyramid {
    fn new(viewing: Viewing) -> Self {
        let most = viewing.width.min(viewing.height).ilog2() as usize - 1;
        let nyquist = viewing.pixels_per_degree / 2.0;
        let band = |i: usize| if i == 0 { nyquist } else { 0.3228 * 2f64.powi(1 - i as i32) * nyquist };
        let first_too_low = (0..15).find(|i| band(*i) <= LOWEST_BAND).unwrap_or(most);
        let bands = (first_too_low + 1).min(most);
        let frequencies = (0..bands).map(band).chain([REST_BAND]).collect();
        Self { viewing, frequencies }
    }

    /// The difference between what the channels see of both videos at a frame.
    fn difference(&self, seen: &[[Vec<f32>; CHANNELS]; 2], sensitivity: &Sensitivity) -> f64 {
        let (width, height) = (self.viewing.width, self.viewing.height);
        let plane = |values: &Vec<f32>| JodChannel { width, height, values: values.clone() };
        let mut level = seen.each_ref().map(|video| video.each_ref().map(plane));
        let mut by_channel = [0.0; CHANNELS];
        let rest = self.frequencies.len() - 1;
        for band in 0..rest {
            let next = level.each_ref().map(|video| video.each_ref().map(JodChannel::reduced));
            let (w, h) = (level[0][0].width, level[0][0].height);
            let low = next.each_ref().map(|video| video.each_ref().map(|plane| plane.expanded(w, h)));
            let scale = if band == 0 { 1.0 } else { 2.0 };
            let contrast = [0, 1].map(|v| {
                [0, 1, 2, 3].map(|c| {
                    let pairs = level[v][c].values.iter().zip(&low[v][c].values).zip(&low[v][0].values);
                    let over = |((x, low), under): ((&f32, &f32), &f32)| (x - low) / under.max(DARKEST);
                    pairs.map(|each| scale * over(each).min(MOST_CONTRAST)).collect::<Vec<_>>()
                })
            });
            let background: Vec<f32> = low[1][0].values.iter().map(|x| x.max(DARKEST)).collect();
            let told = masked(&contrast, &background, |c, under| sensitivity.at(band, c, under), [w, h]);
            (0..CHANNELS).for_each(|c| by_channel[c] += soft(told[c] * CHANNEL_WEIGHT[c], 4.0));
            level = next;
        }
        // What is left below the bands: over the mean of the picture, and nothing masks it.
        let means = level.each_ref().map(|video| {
            let values = &video[0].values;
            (values.iter().map(|v| f64::from(v.max(DARKEST))).sum::<f64>() / values.len() as f64) as f32
        });
        for (c, sum) in by_channel.iter_mut().enumerate() {
            let gain = sensitivity.at(rest, c, means[1]);
            let pairs = level[0][c].values.iter().zip(&level[1][c].values);
            let over = |x: f32, mean: f32| (x / mean).min(MOST_CONTRAST);
            let told =
                pooled(pairs.map(|(t, r)| f64::from((over(*t, means[0]) - over(*r, means[1])).abs() * gain)));
            *sum += soft(told * CHANNEL_WEIGHT[c] * REST_WEIGHT[c], 4.0);
        }
        norm(by_channel.into_iter().map(|sum| soft(sum, 0.25)), 4.0)
    }
}

/// Differences in a band of `size` pixels, by channel, masked by what both videos have. `sensitivity` is that of a channel over a
/// background.
fn masked(
    contrast: &[[Vec<f32>; CHANNELS]; 2],
    background: &[f32],
    sensitivity: impl Fn(usize, f32) -> f32,
    [width, height]: [usize; 2],
) -> [f64; CHANNELS] {
    let gains: [Vec<f32>; CHANNELS] = std::array::from_fn(|c| {
        background.iter().map(|under| CONTRAST_GAIN[c] * sensitivity(c, *under)).collect()
    });
    let seen = |v: usize, c: usize, i: usize| contrast[v][c][i] * gains[c][i];
    let reach = 10f64.powf(MASK_C) as f32;
    let mutual: [Vec<f32>; CHANNELS] = std::array::from_fn(|c| {
        let least = |i: usize| seen(0, c, i).abs().min(seen(1, c, i).abs());
        let values = (0..background.len()).map(least).collect();
        let blurred = JodChannel { width, height, values }.blurred().values;
        blurred.iter().map(|m| soft32((m * reach).abs(), MASK_Q[c])).collect()
    });
    let weights = CROSS_MASKING.map(|row| row.map(f32::exp2));
    let most = 10f64.powf(MOST_DIFFERENCE) as f32;
    std::array::from_fn(|c| {
        let of = |i: usize| {
            let mask: f32 = (0..CHANNELS).map(|k| mutual[k][i] * weights[k][c]).sum();
            let bare = soft32((seen(0, c, i) - seen(1, c, i)).abs(), MASK_P) / (1.0 + mask);
            f64::from(most * bare / (most + bare))
        };
        pooled((0..background.len()).map(of))
    })
}

/// Root of the mean square of all pixels.
fn pooled(pixels: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = pixels.len() as f64;
    soft(pixels.map(|d| soft(d, 2.0)).sum::<f64>() / n, 0.5)
}

/// The eye's sensitivity in each band and channel, by the luminance of the background.
struct Sensitivity {
    /// By band and channel, decadic logarithms over [`STEPS`] luminances.
    curves: Vec<[[f32; STEPS]; CHANNELS]>,
}

impl Sensitivity {
    fn new(frequencies: &[f64]) -> Self {
        let table: Vec<f64> = (SENSITIVITIES.lines().filter(|line| !line.starts_with('#')))
            .flat_map(|line| line.split(' ').filter_map(|number| number.parse().ok()))
            .collect();
        debug_assert_eq!(table.len(), CHANNELS * STEPS * STEPS);
        let of = |hz: f64| {
            let [low, high] = FREQUENCIES;
            let at = (hz.log10() - low) / (high - low) * (STEPS - 1) as f64;
            let below = (at.floor().max(0.0) as usize).min(STEPS - 2);
            let part = at - below as f64;
            std::array::from_fn(|channel| {
                std::array::from_fn(|luminance| {
                    let row = &table[(channel * STEPS + luminance) * STEPS..][..STEPS];
                    (row[below] + part * (row[below + 1] - row[below])) as f32
                })
            })
        };
        Self { curves: frequencies.iter().map(|hz| of(*hz)).collect() }
    }

    fn at(&self, band: usize, channel: usize, background: f32) -> f32 {
        let [low, high] = LUMINANCES;
        let at = (f64::from(background).log10() - low) / (high - low) * (STEPS - 1) as f64;
        let at = at.clamp(0.0, (STEPS - 1) as f64);
        let below = at as usize;
        let curve = &self.curves[band][channel];
        let (a, b) = (curve[below], curve[(below + 1).min(STEPS - 1)]);
        let exponent = f64::from(a + (b - a) * (at - below as f64) as f32) + SENSITIVITY_DB / 20.0;
        10f64.powf(exponent) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hash(x: u32) -> u32 {
        let x = (x ^ x >> 16).wrapping_mul(0x21f0_aaad);
        let x = (x ^ x >> 15).wrapping_mul(0x735a_2d97);
        x ^ x >> 15
    }

    fn unit(at: [u32; 4]) -> f64 {
        let last = at.into_iter().fold(0u32, |v, k| hash(v.wrapping_mul(31).wrapping_add(k + 1)));
        f64::from(last) / 4_294_967_296.0
    }

    /// A wave that moves behind a bar that moves, cd/m^2.
    fn truth(x: usize, y: usize, f: i64, c: usize) -> f64 {
        let wave = (0.37 * x as f64 + 0.11 * c as f64).sin() * (0.23 * y as f64 - 0.05 * f as f64).cos();
        let bar = if (x as i64 - f.div_euclid(4)).rem_euclid(16) < 5 { 15.0 } else { 0.0 };
        40.0 + 20.0 * wave + bar
    }

    fn video(
        width: usize,
        height: usize,
        frames: usize,
        of: &dyn Fn(usize, usize, usize, usize) -> f64,
    ) -> Vec<Vec<Vec3>> {
        let pixel =
            |f: usize, i: usize| Vec3::from_array([0, 1, 2].map(|c| of(i % width, i / width, f, c) as f32));
        (0..frames).map(|f| (0..width * height).map(|i| pixel(f, i)).collect()).collect()
    }

    fn judged(kind: &str, viewing: Viewing, frames: usize) -> f64 {
        let Viewing { width, height, .. } = viewing;
        let at = |x, y, f: usize, c| truth(x, y, f as i64, c);
        let draw =
            |x: usize, y: usize, f: usize, c: usize| unit([x as u32, y as u32, f as u32, c as u32]) - 0.5;
        let test = |x: usize, y: usize, f: usize, c: usize| match kind {
            "noise" => at(x, y, f, c) * (1.0 + 0.4 * draw(x, y, f, c)),
            "still noise" => at(x, y, f, c) * (1.0 + 0.4 * draw(x, y, 0, c)),
            "dark" => 0.83 * at(x, y, f, c),
            "flicker" => at(x, y, f, c) * (1.0 + 0.1 * (std::f64::consts::TAU * f as f64 / 8.0).sin()),
            "colour" => at(x, y, f, c) * if c == 0 { 1.1 } else { 0.95 },
            "late" => truth(x, y, f as i64 - 8, c),
            _ => at(x, y, f, c),
        };
        let (test, truth) = (video(width, height, frames, &test), video(width, height, frames, &at));
        jod(&test, &truth, viewing).unwrap()
    }

    /// What the published program says of the same videos (pycvvdp 0.5.7 on PyTorch 2.15, a display of 1000 cd/m^2 and linear
    /// values): noise in time and in place, less light, flicker, other colours and a picture that is late, of even and odd sizes.
    #[test]
    fn quality_is_that_of_the_published_program() {
        for (kind, width, height, frames, frame_hz, pixels_per_degree, published) in [
            ("noise", 48, 40, 12, 60.0, 20.0, 8.147_276),
            ("still noise", 48, 40, 12, 60.0, 20.0, 7.414_098),
            ("dark", 48, 40, 12, 60.0, 20.0, 10.0),
            ("flicker", 48, 40, 24, 60.0, 20.0, 7.168_786),
            ("colour", 47, 41, 12, 60.0, 20.0, 9.561_963),
            ("late", 64, 33, 12, 60.0, 40.0, 3.971_739),
            ("noise", 48, 40, 60, 947.0, 30.0, 8.951_955),
            ("dark", 31, 64, 8, 120.0, 5.0, 10.0),
        ] {
            let own = judged(kind, Viewing { width, height, frame_hz, pixels_per_degree, every: 1 }, frames);
            println!("{kind} at {frame_hz} Hz: {own:.4} JOD, published {published:.4}");
            assert!((own - published).abs() < 0.02, "{kind}: {own} JOD, published {published}");
        }
    }

    /// The same video is no worse; and it is enough to judge some frames where all are seen.
    #[test]
    fn no_difference_is_ten_and_some_frames_tell_for_all() {
        let viewing = Viewing { width: 24, height: 20, frame_hz: 947.0, pixels_per_degree: 20.0, every: 1 };
        assert!((judged("same", viewing, 4) - 10.0).abs() < 1e-6);
        let all = judged("still noise", viewing, 64);
        let some = judged("still noise", Viewing { every: 8, ..viewing }, 64);
        assert!(all < 9.9 && (all - some).abs() < 0.03, "{all} and {some}");
    }

    #[test]
    fn videos_that_cannot_be_compared_are_refused() {
        let viewing = Viewing { width: 8, height: 8, frame_hz: 60.0, pixels_per_degree: 20.0, every: 1 };
        let frame = vec![Vec3::ONE; 64];
        let two = vec![frame.clone(); 2];
        assert!(jod(&two[..1], &two[..1], viewing).is_err() && jod(&two, &two[..1], viewing).is_err());
        assert!(jod(&two, &two, Viewing { width: 4, ..viewing }).is_err());
        assert!(jod(&two, &[frame, vec![]], viewing).is_err());
        assert!(jod(&two, &two, viewing).is_ok());
    }
}
