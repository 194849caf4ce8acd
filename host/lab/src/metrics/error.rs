//! Two pictures into numbers of their difference, weighted where the eye looks.

use super::{LinearImage, MetricError};

/// Keeps dark pixels from ruling [`PictureError::rel_mse`].
const REL_MSE_EPSILON: f64 = 0.01;

/// How a picture differs from its reference. All are means over pixels and channels with the given weights.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PictureError {
    /// Root of the mean squared difference, in the pictures' unit.
    pub rmse: f64,
    /// Mean of `(t - r)^2 / (r^2 + 0.01)` \[Rousselle11\].
    pub rel_mse: f64,
    /// `10 log10(peak^2 / mse)`; infinite for equal pictures.
    pub psnr_db: f64,
    /// Mean of `t - r`: what no amount of averaging takes away.
    pub bias: f64,
    /// Greatest absolute difference of any pixel with a weight.
    pub max: f64,
    /// Pixels left out because a value in one of the two was not finite.
    pub not_finite: usize,
}

/// Compares `test` with `reference`. `weights`: one a pixel, 0 and 1 to choose pixels; `None` is one
/// everywhere. `peak`: what counts as white for [`PictureError::psnr_db`].
///
/// # Errors
/// Sizes that differ; weights as described at [`MetricError::Weights`], also when every pixel that has one is not finite.
pub(crate) fn compare(
    test: &LinearImage,
    reference: &LinearImage,
    weights: Option<&[f32]>,
    peak: f64,
) -> Result<PictureError, MetricError> {
    test.check_same_size(reference)?;
    let usable = |w: &f32| w.is_finite() && *w >= 0.0;
    if weights.is_some_and(|w| w.len() != test.pixels().len() || !w.iter().all(usable)) {
        return Err(MetricError::Weights);
    }
    let (mut squared, mut relative, mut signed, mut total) = (0.0, 0.0, 0.0, 0.0);
    let (mut max, mut not_finite) = (0.0f64, 0);
    for (i, (t, r)) in test.pixels().iter().zip(reference.pixels()).enumerate() {
        let weight = weights.map_or(1.0, |w| f64::from(w[i]));
        if weight == 0.0 {
            continue;
        }
        if !(t.is_finite() && r.is_finite()) {
            not_finite += 1;
            continue;
        }
        for (t, r) in t.to_array().into_iter().zip(r.to_array()) {
            let (t, r) = (f64::from(t), f64::from(r));
            let d = t - r;
            squared += weight * d * d;
            relative += weight * d * d / (r * r + REL_MSE_EPSILON);
            signed += weight * d;
            max = max.max(d.abs());
        }
        total += 3.0 * weight;
    }
    if total == 0.0 {
        return Err(MetricError::Weights);
    }
    let mse = squared / total;
    Ok(PictureError {
        rmse: mse.sqrt(),
        rel_mse: relative / total,
        psnr_db: 10.0 * (peak * peak / mse).log10(),
        bias: signed / total,
        max,
        not_finite,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn picture(pixels: &[Vec3]) -> LinearImage<'_> {
        LinearImage::new(pixels.len(), 1, pixels).unwrap()
    }

    #[test]
    fn a_constant_offset_gives_the_closed_forms() {
        let (r, t) = ([Vec3::splat(0.5); 8], [Vec3::splat(0.6); 8]);
        let e = compare(&picture(&t), &picture(&r), None, 1.0).unwrap();
        assert!((e.rmse - 0.1).abs() < 1e-7 && (e.bias - 0.1).abs() < 1e-7 && (e.max - 0.1).abs() < 1e-7);
        assert!((e.rel_mse - 0.01 / 0.26).abs() < 1e-7);
        assert!((e.psnr_db - 20.0).abs() < 1e-5);
        let same = compare(&picture(&r), &picture(&r), None, 1.0).unwrap();
        assert_eq!((same.rmse, same.rel_mse, same.psnr_db), (0.0, 0.0, f64::INFINITY));
    }

    #[test]
    fn opposite_errors_cancel_in_the_bias_only() {
        let (r, t) = ([Vec3::ONE; 2], [Vec3::splat(1.5), Vec3::splat(0.5)]);
        let e = compare(&picture(&t), &picture(&r), None, 1.0).unwrap();
        assert!(e.bias.abs() < 1e-12 && (e.rmse - 0.5).abs() < 1e-12);
    }

    #[test]
    fn weights_choose_and_are_checked() {
        let (r, t) = ([Vec3::ZERO; 3], [Vec3::ONE, Vec3::splat(2.0), Vec3::splat(f32::NAN)]);
        let only = |w: &[f32]| compare(&picture(&t), &picture(&r), Some(w), 1.0);
        assert_eq!(only(&[0.0, 1.0, 0.0]).unwrap().rmse, 2.0);
        let both = only(&[3.0, 1.0, 1.0]).unwrap();
        assert!((both.rmse.powi(2) - 7.0 / 4.0).abs() < 1e-12 && both.not_finite == 1);
        for bad in [&[0.0, 0.0, 0.0][..], &[1.0, -1.0, 0.0], &[1.0, f32::NAN, 0.0], &[1.0], &[0.0, 0.0, 1.0]]
        {
            assert_eq!(only(bad), Err(MetricError::Weights), "{bad:?}");
        }
        assert!(matches!(
            compare(&picture(&t), &picture(&r[..2]), None, 1.0),
            Err(MetricError::SizesDiffer(..))
        ));
        assert!(
            LinearImage::new(2, 2, &r).is_err()
                && LinearImage::new(0, 5, &[]).is_err()
                && LinearImage::new(usize::MAX, 2, &r).is_err()
        );
    }
}
