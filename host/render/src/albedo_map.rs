//! The albedo of a real surface over the texture coordinates of its mesh, in the operations of the shader `compensate.comp`.

/// Albedo of each channel over texture coordinates. (0, 0) is the upper left corner of the picture and (1, 1) the lower right one, as in glTF;
/// beyond them the picture repeats.
#[derive(Clone, Debug, PartialEq)]
pub struct AlbedoMap {
    width: u32,
    height: u32,
    texels: Vec<[f32; 3]>,
}

/// Largest magnitude of a coordinate in texels, so that it fits an integer.
const FARTHEST: f32 = 1.0e6;

impl AlbedoMap {
    /// Least albedo of a texel. The compensation divides by the albedo, and full drive could not brighten a darker surface anyway.
    pub const LEAST: f32 = 0.01;

    /// A map of `texels`, row by row from the top. `None` if their number is not `width * height`, if there are none, or if one is not
    /// [`AlbedoMap::LEAST`] to 1.
    pub fn new(width: u32, height: u32, texels: Vec<[f32; 3]>) -> Option<Self> {
        let count = (width as usize).checked_mul(height as usize)?;
        let fits = |v: &f32| (Self::LEAST..=1.0).contains(v);
        (count > 0 && texels.len() == count && texels.iter().flatten().all(fits)).then_some(Self {
            width,
            height,
            texels,
        })
    }

    /// Columns.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// All texels, row by row from the top.
    pub fn texels(&self) -> &[[f32; 3]] {
        &self.texels
    }

    /// Albedo at finite texture coordinates, interpolated between the centres of texels.
    pub fn at(&self, uv: [f32; 2]) -> [f32; 3] {
        let axis = |t: f32, size: u32| {
            let x = (t * size as f32 - 0.5).clamp(-FARTHEST, FARTHEST);
            let low = x.floor();
            let texel = |i: i32| i.rem_euclid(size as i32) as usize;
            (texel(low as i32), texel(low as i32 + 1), x - low)
        };
        let ((x0, x1, fx), (y0, y1, fy)) = (axis(uv[0], self.width), axis(uv[1], self.height));
        let texel = |x: usize, y: usize| self.texels[y * self.width as usize + x];
        let mix = |a: [f32; 3], b: [f32; 3], t: f32| std::array::from_fn(|c| a[c] + (b[c] - a[c]) * t);
        mix(mix(texel(x0, y0), texel(x1, y0), fx), mix(texel(x0, y1), texel(x1, y1), fx), fy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texels_lie_at_their_centres_and_repeat() {
        let map = AlbedoMap::new(2, 2, vec![[0.2; 3], [0.4; 3], [0.6; 3], [0.8; 3]]).unwrap();
        for (u, v, albedo) in [
            (0.25, 0.25, 0.2),
            (0.75, 0.25, 0.4),
            (0.25, 0.75, 0.6),
            (0.75, 0.75, 0.8),
            (0.5, 0.25, 0.3),
            // Over the left edge comes the right one.
            (0.0, 0.25, 0.3),
            (-0.25, 0.25, 0.4),
            (3.25, -1.25, 0.6),
        ] {
            let is = map.at([u, v])[1];
            assert!((is - albedo).abs() < 1e-6, "({u}, {v}): {is}, not {albedo}");
        }
        // However far away, the value is one of the picture.
        assert!((0.2..=0.8).contains(&map.at([1e30, -1e30])[0]));
    }

    #[test]
    fn texels_that_cannot_be_compensated_make_no_map() {
        assert!(AlbedoMap::new(1, 1, vec![[AlbedoMap::LEAST, 0.5, 1.0]]).is_some());
        for bad in [0.009, 1.001, f32::NAN, f32::INFINITY, -0.5] {
            assert_eq!(AlbedoMap::new(1, 1, vec![[0.5, bad, 0.5]]), None, "{bad}");
        }
        assert_eq!(AlbedoMap::new(2, 1, vec![[0.5; 3]]), None);
        assert_eq!(AlbedoMap::new(0, 1, vec![]), None);
    }
}
