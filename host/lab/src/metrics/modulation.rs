//! The course of a light into how much it is modulated, by frequency, and what of that is noticed.

use super::sensitivity::{
    flicker_sensitivity, phantom_threshold, stroboscopic_threshold, summed, Field, NOTICED_LATE_S,
};
use dpm_rig::plan::light_course::LightCourse;
use std::f64::consts::TAU;

/// The fastest modulation that counts, Hz: where the measure of the stroboscopic effect ends. \[IEC63158\]
pub(crate) const FASTEST_HZ: f64 = 2000.0;
/// The slowest that makes a phantom array; below it, flicker is seen as such. \[Tan24\]
const SLOWEST_PHANTOM_HZ: f64 = 80.0;
/// The fastest that anybody sees to flicker, Hz: the model's sensitivity is below a thousandth from there on.
const FASTEST_FLICKER_HZ: f64 = 250.0;
/// Luminance of red, green and blue light of Rec. 709.
const LUMINANCE: [f64; 3] = [0.2126, 0.7152, 0.0722];

/// A sine in the course of a light.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Harmonic {
    /// Its frequency.
    pub hz: f64,
    /// Its amplitude over the mean of the light, at most 2.
    pub modulation: f64,
}

/// The sines up to [`FASTEST_HZ`] that the luminance of `course` is made of, the slowest first. Without light there are none.
pub(crate) fn harmonics(course: &LightCourse) -> Vec<Harmonic> {
    let fundamental_hz = 1e9 / course.period_ns;
    let flashes: Vec<_> = (course.flashes.iter())
        .map(|f| {
            (f.span_ns.map(|ns| ns * 1e-9), f.light.iter().zip(LUMINANCE).map(|(l, y)| l * y).sum::<f64>())
        })
        .collect();
    let mean: f64 = flashes.iter().map(|([begin, end], light)| (end - begin) * light).sum();
    if mean <= 0.0 {
        return Vec::new();
    }
    let at = |hz: f64| {
        let w = TAU * hz;
        let (re, im) = flashes.iter().fold((0.0, 0.0), |(re, im), ([begin, end], light)| {
            let ((s0, c0), (s1, c1)) = ((w * begin).sin_cos(), (w * end).sin_cos());
            (re + light * (s1 - s0), im + light * (c1 - c0))
        });
        Harmonic { hz, modulation: 2.0 * re.hypot(im) / (w * mean) }
    };
    (1..).map(|k| f64::from(k) * fundamental_hz).take_while(|hz| *hz <= FASTEST_HZ).map(at).collect()
}

/// The greatest of the harmonics in units of the amplitude that is just seen to flicker in `field`.
pub(crate) fn flicker(harmonics: &[Harmonic], field: Field) -> f64 {
    let seen = |h: &Harmonic| h.modulation * flicker_sensitivity(field, h.hz);
    harmonics.iter().take_while(|h| h.hz <= FASTEST_FLICKER_HZ).map(seen).fold(0.0, f64::max)
}

/// The stroboscopic visibility measure: 1 is just seen where things move by hand in this light. \[IEC63158\]
pub(crate) fn stroboscopic_visibility(harmonics: &[Harmonic]) -> f64 {
    summed(harmonics.iter().map(|h| h.modulation / stroboscopic_threshold(h.hz)))
}

/// Visibility of the phantom array: 1 is just seen by an eye that jumps across the light in the dark.
pub(crate) fn phantom_array(harmonics: &[Harmonic]) -> f64 {
    let fast = harmonics.iter().filter(|h| h.hz >= SLOWEST_PHANTOM_HZ);
    summed(fast.map(|h| h.modulation / phantom_threshold(h.hz)))
}

/// Time between the centres of the first and the last colour of a course, seconds; 0 with fewer than two colours.
pub(crate) fn colours_apart_s(course: &LightCourse) -> f64 {
    let centre = |c: usize| {
        let of = |moment: fn([f64; 2]) -> f64| {
            course
                .flashes
                .iter()
                .map(|f| f.light[c] * (f.span_ns[1] - f.span_ns[0]) * moment(f.span_ns))
                .sum::<f64>()
        };
        let light = of(|_| 1.0);
        (light > 0.0).then(|| of(|[begin, end]| (begin + end) / 2.0) / light)
    };
    let centres = || (0..3).filter_map(centre);
    let (first, last) =
        (centres().fold(f64::INFINITY, f64::min), centres().fold(f64::NEG_INFINITY, f64::max));
    (last - first).max(0.0) * 1e-9
}

/// The same in units of the delay that is noticed of a moving surface.
pub(crate) fn colour_break_up(course: &LightCourse) -> f64 {
    colours_apart_s(course) / NOTICED_LATE_S
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::plan::light_course::Flash;
    use std::f64::consts::PI;

    fn course(period_ns: f64, flashes: &[([f64; 2], [f64; 3])]) -> LightCourse {
        let flashes = flashes.iter().map(|&(span_ns, light)| Flash { span_ns, light }).collect();
        LightCourse { period_ns, flashes }
    }

    /// Light that is on for a share of the period: the amplitude of harmonic k is 2 |sin(pi k d)| / (pi k d); 4 / pi and a third
    /// of it for a square.
    #[test]
    fn pulses_and_squares_have_their_spectra() {
        for (period_ns, duty, delay) in [(1e7, 0.5, 0.0), (1e7, 0.1, 0.7), (1_055_966.0, 1.0 / 24.0, 0.3)] {
            let begin = delay * period_ns;
            let all = harmonics(&course(period_ns, &[([begin, begin + duty * period_ns], [1.0; 3])]));
            assert_eq!(all.len(), (2e-6 * period_ns) as usize);
            for (k, h) in (1..).zip(&all) {
                let x = PI * f64::from(k) * duty;
                assert!((h.modulation - 2.0 * x.sin().abs() / x).abs() < 1e-9, "{duty}, harmonic {k}");
                assert!((h.hz - f64::from(k) * 1e9 / period_ns).abs() < 1e-6);
            }
        }
        let square = harmonics(&course(1e7, &[([0.0, 5e6], [1.0; 3])]));
        assert!((square[0].modulation - 4.0 / PI).abs() < 1e-12 && square[1].modulation < 1e-12);
        assert!((square[2].modulation - 4.0 / PI / 3.0).abs() < 1e-12);
    }

    /// A pulse without length has the amplitude 2 at every frequency.
    #[test]
    fn a_single_short_pulse_is_modulated_by_twice_its_mean() {
        let all = harmonics(&course(1e7, &[([2e6, 2e6 + 1.0], [0.5; 3])]));
        assert!(all.iter().all(|h| (h.modulation - 2.0).abs() < 1e-6));
    }

    /// A sine of depth m, in steps: m at its frequency but for the width of a step, and nothing elsewhere.
    #[test]
    fn a_sine_is_one_harmonic() {
        let (steps, depth, period_ns) = (1000, 0.4, 3.75e7);
        let step_ns = period_ns / f64::from(steps);
        let flashes: Vec<_> = (0..steps)
            .map(|k| {
                let (begin, phase) =
                    (f64::from(k) * step_ns, TAU * 3.0 * (f64::from(k) + 0.5) / f64::from(steps));
                ([begin, begin + step_ns], [1.0 + depth * phase.sin(); 3])
            })
            .collect();
        let all = harmonics(&course(period_ns, &flashes));
        for (k, h) in (1..).zip(&all) {
            let wanted = if k == 3 { depth } else { 0.0 };
            assert!((h.modulation - wanted).abs() < 1e-4, "harmonic {k}: {h:?}");
        }
        // One sine alone: the measures are its amplitude over the threshold, and flicker times the sensitivity.
        let field = Field { eccentricity_deg: 0.0, radius_deg: 5.0, luminance: 100.0 };
        assert!((stroboscopic_visibility(&all) - depth / stroboscopic_threshold(80.0)).abs() < 1e-3);
        assert!((phantom_array(&all) - depth / phantom_threshold(80.0)).abs() < 1e-3);
        assert!((flicker(&all, field) - depth * flicker_sensitivity(field, 80.0)).abs() < 1e-3);
    }

    /// Colours that follow one another: modulated by their luminances, and as far apart as their middles.
    #[test]
    fn colours_in_turn_part_and_flicker_by_their_luminance() {
        let third = 1e9 / 180.0;
        let colour = |k: usize| {
            let begin = k as f64 * third;
            ([begin, begin + third], std::array::from_fn(|c| f64::from(u8::from(c == k))))
        };
        let turn = course(3.0 * third, &[colour(0), colour(1), colour(2)]);
        assert!((colours_apart_s(&turn) - 2e-9 * third).abs() < 1e-12);
        assert!((colour_break_up(&turn) - 2.0 / 180.0 / 3.87e-3).abs() < 1e-9);
        let [r, g, b] = LUMINANCE;
        // Three equal lengths: the vector sum of the luminances, 120 degrees apart.
        let vector = (r * r + g * g + b * b - r * g - g * b - b * r).sqrt();
        let wanted = 2.0 * (PI / 3.0).sin() / (PI / 3.0) * vector;
        assert!((harmonics(&turn)[0].modulation - wanted).abs() < 1e-9);
        assert_eq!(colours_apart_s(&course(1e6, &[([0.0, 1e6], [0.0, 1.0, 0.0])])), 0.0);
        assert!(harmonics(&course(1e6, &[])).is_empty());
    }
}
