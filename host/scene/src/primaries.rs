//! Colours by the primaries that a picture names into those of sRGB, in which this program traces.

use glam::{DMat3, DVec2, DVec3, Vec3};

/// Chromaticities of three primaries and of white.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Primaries {
    /// Red, green and blue.
    pub rgb: [DVec2; 3],
    /// White.
    pub white: DVec2,
}

/// Chromaticities that differ less are the same: files give three digits.
const SAME: f64 = 2e-3;

/// CIE XYZ of a chromaticity at luminance 1.
fn xyz(c: DVec2) -> DVec3 {
    DVec3::new(c.x / c.y, 1.0, (1.0 - c.x - c.y) / c.y)
}

/// Responses of the cones by Bradford.
const CONES: DMat3 =
    DMat3::from_cols_array(&[0.8951, -0.7502, 0.0389, 0.2664, 1.7135, -0.0685, -0.1614, 0.0367, 1.0296]);

impl Primaries {
    /// Those of sRGB and Rec. 709.
    pub(crate) const SRGB: Self = Self {
        rgb: [DVec2::new(0.64, 0.33), DVec2::new(0.30, 0.60), DVec2::new(0.15, 0.06)],
        white: DVec2::new(0.3127, 0.3290),
    };
    /// CIE XYZ itself, with white of equal energy.
    pub(crate) const XYZ: Self = Self {
        rgb: [DVec2::new(1.0, 0.0), DVec2::new(0.0, 1.0), DVec2::new(0.0, 0.0)],
        white: DVec2::new(1.0 / 3.0, 1.0 / 3.0),
    };

    /// Whether these are sRGB's, to the digits that files give.
    pub(crate) fn is_srgb(&self) -> bool {
        let all = |p: &Self| [p.rgb[0], p.rgb[1], p.rgb[2], p.white];
        all(self).iter().zip(all(&Self::SRGB)).all(|(a, b)| (*a - b).abs().max_element() < SAME)
    }

    /// XYZ from the colours of these primaries; `None` if they span no space of colours.
    fn to_xyz(self) -> Option<DMat3> {
        if self == Self::XYZ {
            return Some(DMat3::IDENTITY);
        }
        let finite = self.rgb.iter().chain([&self.white]).all(|c| c.is_finite() && c.y.abs() > 1e-6);
        let columns = DMat3::from_cols(xyz(self.rgb[0]), xyz(self.rgb[1]), xyz(self.rgb[2]));
        if !finite || columns.determinant().abs() < 1e-6 {
            return None;
        }
        let shares = columns.inverse() * xyz(self.white);
        Some(columns * DMat3::from_diagonal(shares)).filter(|m| m.determinant().abs() > 1e-9)
    }

    /// What each of these colours adds to luminance; those of sRGB if they span no space of colours.
    #[cfg(feature = "exr")]
    pub(crate) fn luminance(&self) -> Vec3 {
        let weights = self.to_xyz().unwrap_or(DMat3::from_diagonal(DVec3::ONE)).row(1).as_vec3();
        if weights.min_element() > 1e-3 {
            weights
        } else {
            Vec3::new(0.2126, 0.7152, 0.0722)
        }
    }

    /// Linear sRGB from the colours of these primaries, with white staying white; `None` if they span no space of colours.
    pub(crate) fn to_srgb(self) -> Option<DMat3> {
        let (from, to) = (self.to_xyz()?, Self::SRGB.to_xyz()?);
        let cones = |white: DVec2| CONES * xyz(white);
        let adapt =
            CONES.inverse() * DMat3::from_diagonal(cones(Self::SRGB.white) / cones(self.white)) * CONES;
        let all = to.inverse() * adapt * from;
        all.is_finite().then_some(all)
    }

    /// Converts texels to linear sRGB; what is told of it. `None`: they are of sRGB already.
    pub(crate) fn convert(self, texels: &mut [Vec3]) -> Option<String> {
        if self.is_srgb() {
            return None;
        }
        let all = [self.rgb[0], self.rgb[1], self.rgb[2], self.white];
        let names = all.map(|c| format!("({:.4}, {:.4})", c.x, c.y)).join(" ");
        let Some(matrix) = self.to_srgb() else {
            return Some(format!("its primaries {names} span no space of colours: it is taken for sRGB"));
        };
        // A texel with a number that is none keeps it, and is counted as such.
        for texel in texels.iter_mut().filter(|t| t.is_finite()) {
            *texel = (matrix * texel.as_dvec3()).as_vec3();
        }
        Some(format!("its colours are converted from the primaries {names} to those of sRGB"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn white_stays_white_and_known_matrices_come_out() {
        let ap0 = Primaries {
            rgb: [DVec2::new(0.7347, 0.2653), DVec2::new(0.0, 1.0), DVec2::new(0.0001, -0.0770)],
            white: DVec2::new(0.32168, 0.33767),
        };
        let matrix = ap0.to_srgb().unwrap();
        assert!((matrix * DVec3::ONE - DVec3::ONE).abs().max_element() < 1e-3);
        // The matrix from ACES2065-1 to linear sRGB that the Academy's documents give, rows by rows.
        let known = [[2.5216, -1.1341, -0.3875], [-0.2764, 1.3727, -0.0963], [-0.0154, -0.1529, 1.1684]];
        for (row, wanted) in known.iter().enumerate() {
            let got = matrix.row(row).to_array();
            assert!(got.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 3e-3), "{got:?} {wanted:?}");
        }
        assert!(Primaries::SRGB.convert(&mut []).is_none());
        assert!((Primaries::XYZ.to_srgb().unwrap() * DVec3::ONE - DVec3::ONE).abs().max_element() < 1e-3);
        let line = Primaries { rgb: [DVec2::new(0.3, 0.3); 3], ..Primaries::SRGB };
        assert!(line.convert(&mut []).unwrap().contains("no space of colours"));
    }
}
