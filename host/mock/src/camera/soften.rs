//! The lens of the mock camera spreads the light of each point over its neighbourhood.
//!
//! No light is lost inside the picture, and none is moved to one side: an edge stays where it is.

/// The spread of a lens.
#[derive(Debug)]
pub(super) struct Softness {
    width: usize,
    /// Shares of a pixel's light that go to itself and to its first, second and further neighbours to one side.
    shares: Vec<f32>,
    /// Rows of a picture, spread along the rows.
    rows: Vec<f32>,
}

impl Softness {
    /// A spread with a standard deviation of `sigma` pixels along each axis, of pictures with `width` columns.
    pub(super) fn new(sigma: f64, width: usize) -> Self {
        let reach = if sigma > 0.0 { (3.5 * sigma).ceil() as usize + 1 } else { 0 };
        let shares: Vec<f64> = (0..=reach).map(|k| spread_to(k, sigma * sigma)).collect();
        let all: f64 = shares[0] + 2.0 * shares[1..].iter().sum::<f64>();
        Self { width, shares: shares.iter().map(|share| (share / all) as f32).collect(), rows: Vec::new() }
    }

    /// Fills the columns and rows of `soft` that the light of `extent`, columns and rows, reaches in a sharp picture.
    pub(super) fn soften(&mut self, sharp: &[f32], extent: [[usize; 2]; 2], soft: &mut [f32]) {
        let (width, reach) = (self.width, self.shares.len() - 1);
        let height = sharp.len() / width;
        let wide =
            |[begin, end]: [usize; 2], by: usize, most: usize| begin.saturating_sub(by)..(end + by).min(most);
        let (columns, rows) = (wide(extent[0], reach, width), wide(extent[1], reach, height));
        // Spread along each row, those above and below too, whose light comes here.
        let around = wide(extent[1], 2 * reach, height);
        self.rows.clear();
        for y in around.clone() {
            let row = &sharp[y * width..(y + 1) * width];
            self.rows.extend(columns.clone().map(|x| spread(&self.shares, x, width, |x| row[x])));
        }
        let (count, first) = (columns.len(), around.start);
        for y in rows {
            for (i, x) in columns.clone().enumerate() {
                let light = |y: usize| self.rows[(y - first) * count + i];
                soft[y * width + x] = spread(&self.shares, y, height, light);
            }
        }
    }
}

/// What diffusion over a line of pixels, until its variance is `t`, takes from one to its neighbour number `k`: the Gaussian
/// of pixels, whose width is the one asked for however narrow it is (a modified Bessel function by its series).
fn spread_to(k: usize, t: f64) -> f64 {
    let half = 0.5 * t;
    let mut term = (1..=k).map(|i| half / i as f64).product::<f64>() * libm::exp(-t);
    let mut sum = term;
    for m in 1..400 {
        term *= half * half / (m * (m + k)) as f64;
        sum += term;
    }
    sum
}

/// The light at `at` of a line of `count` places; beyond its ends it is as at its ends.
fn spread(shares: &[f32], at: usize, count: usize, light: impl Fn(usize) -> f32) -> f32 {
    let mut sum = shares[0] * light(at);
    for (k, share) in shares.iter().enumerate().skip(1) {
        sum += share * (light(at.saturating_sub(k)) + light((at + k).min(count - 1)));
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A spot keeps its light and its middle, and becomes as wide as was asked for, wherever it lies.
    #[test]
    fn a_spot_keeps_light_and_middle() {
        let (w, h) = (40, 30);
        for sigma in [0.4, 1.0, 1.7] {
            let mut sharp = vec![0.0f32; w * h];
            sharp[12 * w + 17] = 100.0;
            let mut soft = sharp.clone();
            Softness::new(sigma, w).soften(&sharp, [[17, 18], [12, 13]], &mut soft);
            let moment = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
                let all = soft.iter().enumerate();
                all.map(|(i, l)| f64::from(*l) * f((i % w) as f64 - 17.0, (i / w) as f64 - 12.0)).sum()
            };
            assert!((moment(&|_, _| 1.0) - 100.0).abs() < 1e-3);
            assert!(moment(&|x, _| x).abs() < 1e-3 && moment(&|_, y| y).abs() < 1e-3);
            for variance in [moment(&|x, _| x * x), moment(&|_, y| y * y)] {
                let seen = (variance / 100.0).sqrt();
                assert!((seen / sigma - 1.0).abs() < 0.05, "{seen} of {sigma}");
            }
        }
    }

    /// Without softness nothing changes; with it, what is even stays even up to the rim.
    #[test]
    fn what_is_even_stays_even() {
        let (w, h) = (20, 16);
        let sharp: Vec<f32> = (0..w * h).map(|i| (i % 7) as f32).collect();
        let mut soft = vec![0.0; w * h];
        Softness::new(0.0, w).soften(&sharp, [[0, w], [0, h]], &mut soft);
        assert_eq!(soft, sharp);
        Softness::new(1.3, w).soften(&vec![50.0; w * h], [[0, w], [0, h]], &mut soft);
        assert!(soft.iter().all(|l| (l - 50.0).abs() < 1e-3));
    }
}
