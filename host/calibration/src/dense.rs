//! Small dense matrices: singular values by one-sided Jacobi rotations, and symmetric positive definite systems by Cholesky.
//!
//! One-sided Jacobi (\[Hestenes58\]) works on the matrix itself and not on its square, so it finds singular values down
//! to the rounding error of the largest one. This is needed to distinguish a degenerate calibration from a poor one.

/// Columns of a matrix, all of one length.
pub(crate) type Columns = Vec<Vec<f64>>;

/// Singular values, descending, and the right singular vector of each.
pub(crate) struct Svd {
    /// Not negative, descending.
    pub values: Vec<f64>,
    /// `vectors[i]` belongs to `values[i]`.
    pub vectors: Vec<Vec<f64>>,
}

/// Decomposes a matrix of any shape with finite entries.
pub(crate) fn svd(mut columns: Columns) -> Svd {
    let n = columns.len();
    let mut v: Columns = (0..n).map(|i| (0..n).map(|j| f64::from(u8::from(i == j))).collect()).collect();
    for _ in 0..60 {
        let mut rotated = false;
        for p in 0..n {
            for q in p + 1..n {
                let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
                let (a, b, c) = (
                    dot(&columns[p], &columns[p]),
                    dot(&columns[q], &columns[q]),
                    dot(&columns[p], &columns[q]),
                );
                if c == 0.0 || c.abs() <= f64::EPSILON * (a * b).sqrt() {
                    continue;
                }
                rotated = true;
                let zeta = (b - a) / (2.0 * c);
                let t = zeta.signum() / (zeta.abs() + zeta.hypot(1.0));
                let cos = 1.0 / t.hypot(1.0);
                let sin = cos * t;
                for m in [&mut columns, &mut v] {
                    for i in 0..m[p].len() {
                        let (x, y) = (m[p][i], m[q][i]);
                        m[p][i] = cos * x - sin * y;
                        m[q][i] = sin * x + cos * y;
                    }
                }
            }
        }
        if !rotated {
            break;
        }
    }
    let length = |c: &Vec<f64>| c.iter().map(|x| x * x).sum::<f64>().sqrt();
    let mut order: Vec<(f64, Vec<f64>)> = columns.iter().map(length).zip(v).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0));
    let (values, vectors) = order.into_iter().unzip();
    Svd { values, vectors }
}

/// Solves `A x = b` for a symmetric positive definite matrix in rows; `None` if it is not positive definite.
pub fn solve_spd(a: &[Vec<f64>], b: &[f64]) -> Option<Vec<f64>> {
    let l = cholesky(a)?;
    let n = b.len();
    let mut x = b.to_vec();
    for i in 0..n {
        let sum: f64 = (0..i).map(|k| l[i][k] * x[k]).sum();
        x[i] = (x[i] - sum) / l[i][i];
    }
    for i in (0..n).rev() {
        let sum: f64 = (i + 1..n).map(|k| l[k][i] * x[k]).sum();
        x[i] = (x[i] - sum) / l[i][i];
    }
    x.iter().all(|v| v.is_finite()).then_some(x)
}

/// Diagonal of the inverse of a symmetric positive definite matrix; `None` if it is not positive definite.
pub(crate) fn inverse_diagonal(a: &[Vec<f64>]) -> Option<Vec<f64>> {
    let n = a.len();
    (0..n)
        .map(|i| {
            let unit: Vec<f64> = (0..n).map(|j| f64::from(u8::from(i == j))).collect();
            solve_spd(a, &unit).map(|x| x[i])
        })
        .collect()
}

/// Inverse of a symmetric positive definite matrix in rows; `None` if it is not positive definite.
pub fn inverse_spd(a: &[Vec<f64>]) -> Option<Vec<Vec<f64>>> {
    let n = a.len();
    (0..n)
        .map(|i| {
            let unit: Vec<f64> = (0..n).map(|j| f64::from(u8::from(i == j))).collect();
            solve_spd(a, &unit)
        })
        .collect()
}

/// The lower triangle L with `L L^T = A`, in rows; `None` if `A` is not positive definite.
pub(crate) fn cholesky(a: &[Vec<f64>]) -> Option<Vec<Vec<f64>>> {
    let n = a.len();
    let mut l = vec![vec![0.0; n]; n];
    for i in 0..n {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
            let rest = a[i][j] - sum;
            if i == j {
                if rest.is_nan() || rest <= 0.0 {
                    return None;
                }
                l[i][i] = rest.sqrt();
            } else {
                l[i][j] = rest / l[j][j];
            }
        }
    }
    Some(l)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hilbert_matrix_to_full_precision() {
        // Singular values of the 5 x 5 Hilbert matrix from 1.567 down to 3.3e-6; its determinant is 1 / 266716800000.
        let columns: Columns = (0..5).map(|i| (0..5).map(|j| 1.0 / f64::from(i + j + 1)).collect()).collect();
        let s = svd(columns.clone());
        assert!((s.values[0] - 1.567050691098231).abs() < 1e-14);
        assert!((s.values[4] / 3.287928772171863e-6 - 1.0).abs() < 1e-9);
        let product: f64 = s.values.iter().product();
        assert!((product * 266_716_800_000.0 - 1.0).abs() < 1e-9);
        for (value, vector) in s.values.iter().zip(&s.vectors) {
            let image: Vec<f64> = (0..5).map(|r| (0..5).map(|c| columns[c][r] * vector[c]).sum()).collect();
            let length = image.iter().map(|x| x * x).sum::<f64>().sqrt();
            assert!((length - value).abs() < 1e-15 * s.values[0] * 10.0);
        }
    }

    #[test]
    fn rank_deficiency_shows_as_zero() {
        let s = svd(vec![vec![1.0, 2.0, 3.0], vec![2.0, 4.0, 6.0], vec![0.0, 1e-9, 0.0]]);
        assert!(s.values[2] < 1e-15 && s.values[1] > 1e-10);
        assert_eq!(svd(vec![vec![0.0; 4]; 2]).values, [0.0, 0.0]);
    }

    #[test]
    fn cholesky_solves_and_refuses() {
        let a = vec![vec![4.0, 2.0, 0.0], vec![2.0, 5.0, 1.0], vec![0.0, 1.0, 3.0]];
        let x = solve_spd(&a, &[8.0, 15.0, 11.0]).unwrap();
        for (got, want) in x.iter().zip([1.0, 2.0, 3.0]) {
            assert!((got - want).abs() < 1e-14);
        }
        let d = inverse_diagonal(&a).unwrap();
        // Cofactors over the determinant 44: 14, 12, 16.
        for (got, want) in d.iter().zip([14.0, 12.0, 16.0]) {
            assert!((got * 44.0 - want).abs() < 1e-12);
        }
        assert!(solve_spd(&[vec![1.0, 2.0], vec![2.0, 1.0]], &[1.0, 1.0]).is_none());
        assert!(solve_spd(&[vec![f64::NAN]], &[1.0]).is_none());
    }
}
