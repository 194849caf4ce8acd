//! How little a person notices of light that changes in time: thresholds of flicker, of the stroboscopic effect and of the
//! phantom array, by frequency.
//!
//! Everything that this program says of eyes rests on the formulas of this file. They describe an average person who fixates
//! (flicker), watches things that move (stroboscopic effect), or moves the eyes (phantom array).

use std::f64::consts::{PI, TAU};

/// The part of the visual field whose light changes, and how bright it is.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Field {
    /// From the point that is looked at to the middle of the part, degrees, from 0 on.
    pub eccentricity_deg: f64,
    /// Radius of the part, degrees; above 0.
    pub radius_deg: f64,
    /// Mean luminance, cd/m^2; the model was fitted from 1 to 1000.
    pub luminance: f64,
}

/// Nodes and weights of Gauss and Legendre's rule for -1 to 1, the positive half of 16 points. \[Abramowitz64 table 25.4\]
const GAUSS: [[f64; 2]; 8] = [
    [0.095_012_509_837_637_44, 0.189_450_610_455_068_5],
    [0.281_603_550_779_258_9, 0.182_603_415_044_923_6],
    [0.458_016_777_657_227_4, 0.169_156_519_395_002_54],
    [0.617_876_244_402_643_7, 0.149_595_988_816_576_73],
    [0.755_404_408_355_003, 0.124_628_971_255_533_87],
    [0.865_631_202_387_831_7, 0.095_158_511_682_492_78],
    [0.944_575_023_073_232_6, 0.062_253_523_938_647_89],
    [0.989_400_934_991_649_9, 0.027_152_459_411_754_095],
];

/// Integral of `f` from 0 to `end`.
fn integral(end: f64, f: impl Fn(f64) -> f64) -> f64 {
    let half = end / 2.0;
    GAUSS.iter().map(|[x, w]| w * (f(half * (1.0 - x)) + f(half * (1.0 + x)))).sum::<f64>() * half
}

/// Magnitude of `(1 + i a)^-m - scale (1 + i b)^-n`.
fn difference_of_low_passes([a, m]: [f64; 2], [b, n]: [f64; 2], scale: f64) -> f64 {
    let part = |x: f64, power: f64| ((1.0 + x * x).powf(-power / 2.0), -power * x.atan());
    let ((ra, pa), (rb, pb)) = (part(a, m), part(b, n));
    (ra * ra + (scale * rb).powi(2) - 2.0 * ra * scale * rb * (pa - pb).cos()).max(0.0).sqrt()
}

/// Sensitivity of a place of the retina: the part of elaTCSF without area. \[Cai24 `TCSF`, `S_ecc` and `S_lum` of its public
/// program\]
fn sensitivity_at(eccentricity_deg: f64, luminance: f64, hz: f64) -> f64 {
    const SHIFT_HZ: f64 = 2.0;
    let luminance = luminance.max(0.01);
    let hz = (hz + SHIFT_HZ) / (1.0 + 0.034_181_1 * eccentricity_deg) - SHIFT_HZ;
    let hz = hz / (0.6678 + 0.222_269 * luminance.log10());
    let tau = TAU * hz * 0.002_920_69;
    let temporal = 154.133 * difference_of_low_passes([tau, 15.0], [tau * 2.125_47, 16.0], 0.721_095);
    let of_eccentricity = 10f64.powf(-0.033_093_3 * eccentricity_deg);
    let of_luminance = 1.768_01 * (1.0 + 1.624_02 / luminance).powf(-0.533_781);
    of_eccentricity * of_luminance * temporal
}

/// Sensitivity to flicker at `hz`, from 0 on: 1 over the amplitude of a sine, as a share of the mean, that is just seen on a
/// disk. elaTCSF sums over the disk with an exponent. \[Cai24 `spatial_summation_disk`\]
pub(crate) fn flicker_sensitivity(field: Field, hz: f64) -> f64 {
    const EXPONENT: f64 = 3.800_22;
    const THRESHOLD_ENERGY: f64 = 6.528_01;
    let Field { eccentricity_deg: e, radius_deg, luminance } = field;
    let at = |r: f64, angle: f64| {
        let place = (r * r + e * e + 2.0 * e * r * angle.cos()).max(0.0).sqrt();
        sensitivity_at(place, luminance, hz).powf(EXPONENT) * r
    };
    // Both halves of the disk are alike.
    let energy = 2.0 * integral(radius_deg, |r| integral(PI, |angle| at(r, angle)));
    (energy / THRESHOLD_ENERGY).powf(1.0 / EXPONENT)
}

/// Amplitude over mean of a sine of `hz` above 0 at which the stroboscopic effect is just seen. \[IEC63158\]
pub(crate) fn stroboscopic_threshold(hz: f64) -> f64 {
    1.0 / (1.0 + (-0.005_18 * (hz - 306.6)).exp()) + 20.0 * (-hz / 10.0).exp()
}

/// Amplitude over mean of a sine of `hz` above 0 at which an eye that moves across a small light in the dark just sees a
/// phantom array.
///
/// No standard has this curve, and the coefficients of the measure PAVM \[Tan24\] are not public. It is drawn through what was
/// measured, as a parabola of the logarithms on either side of its least: 0.072 at 600 Hz, which is the middle of 0.04 to 0.13
/// for 22 people \[Phantom25\], 0.1 at 120 Hz, and the whole modulation at 1.98 kHz \[Roberts12\].
pub(crate) fn phantom_threshold(hz: f64) -> f64 {
    const LEAST: [f64; 2] = [600.0, 0.072];
    let [anchor_hz, anchor] = if hz < LEAST[0] { [120.0, 0.1] } else { [1980.0, 1.0] };
    let steepness = (anchor / LEAST[1]).ln() / (anchor_hz / LEAST[0]).ln().powi(2);
    LEAST[1] * (steepness * (hz / LEAST[0]).ln().powi(2)).exp()
}

/// Light that falls this many seconds off, times the speed of the surface, is noticed to be at the wrong place: so late a
/// projection onto moving faces was told from one in time. \[Misalignment23\]
pub(crate) const NOTICED_LATE_S: f64 = 3.87e-3;

/// Sum of parts that are each given in units of their threshold, as the measure of the stroboscopic effect takes it. \[IEC63158\]
pub(crate) fn summed(parts: impl Iterator<Item = f64>) -> f64 {
    parts.map(|part| part.powf(3.7)).sum::<f64>().powf(1.0 / 3.7)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the public program of elaTCSF (`elaTCSF.py` of gfxdisp/elaTCSF, commit 3d5b74f8, SciPy 1.17) prints for eccentricity,
    /// luminance, radius and frequency.
    #[test]
    fn flicker_is_that_of_the_published_program() {
        for (e, luminance, radius_deg, hz, published) in [
            (10.0, 3.0, 20.0, 10.0, 398.124_854_199_506_73),
            (0.0, 100.0, 5.0, 60.0, 5.433_343_163_705_804),
            (20.0, 100.0, 10.0, 60.0, 18.305_393_820_162_006),
            (20.0, 100.0, 10.0, 120.0, 0.362_393_126_958_766_24),
            (0.0, 20.0, 0.235, 10.0, 97.068_241_948_525_33),
            (20.0, 300.0, 1.0, 30.0, 32.666_300_174_026_31),
            (35.0, 1.0, 10.0, 4.0, 20.500_134_013_344_15),
            (0.0, 1000.0, 15.0, 80.0, 10.466_386_515_438_948),
            (10.0, 100.0, 3.0, 1.0, 54.508_661_865_699_7),
        ] {
            let own = flicker_sensitivity(Field { eccentricity_deg: e, radius_deg, luminance }, hz);
            assert!((own / published - 1.0).abs() < 1e-3, "{e} deg, {luminance} cd/m2, {hz} Hz: {own}");
        }
    }

    /// The curve of the stroboscopic effect at frequencies where its terms are known: at 306.6 Hz the first is a half.
    #[test]
    fn thresholds_have_the_values_of_their_sources() {
        assert!((stroboscopic_threshold(306.6) - 0.5).abs() < 1e-9);
        assert!((stroboscopic_threshold(2000.0) - 1.0).abs() < 2e-4);
        for (hz, threshold) in [(600.0, 0.072), (120.0, 0.1), (1980.0, 1.0)] {
            assert!((phantom_threshold(hz) / threshold - 1.0).abs() < 1e-9, "{hz} Hz");
        }
        assert!((80..2000).all(|hz| phantom_threshold(f64::from(hz)) >= 0.072));
    }

    /// One part alone is itself; equal parts grow by the exponent's root of their number.
    #[test]
    fn parts_are_summed_by_their_exponent() {
        assert!((summed([0.7].into_iter()) - 0.7).abs() < 1e-12);
        assert!((summed([1.0; 2].into_iter()) - 2f64.powf(1.0 / 3.7)).abs() < 1e-12);
        assert_eq!(summed(std::iter::empty()), 0.0);
    }
}
