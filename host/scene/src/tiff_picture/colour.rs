//! The numbers of a TIFF's texel into red, green, blue and alpha.

/// Which colour the numbers of a texel are.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Colours {
    /// Grey, 0 is white.
    Darkness,
    /// Grey, 0 is black.
    Grey,
    /// Red, green and blue.
    Rgb,
    /// A place in a list of colours, each 0 to 1.
    Palette(Vec<[f32; 3]>),
    /// Cyan, magenta, yellow and black.
    Inks,
    /// Luminance and two differences.
    Chroma(Chroma),
    /// CIELab by D50; the latter two numbers have a sign, or lie about the middle.
    Lab {
        /// They are stored as numbers with a sign.
        is_signed: bool,
    },
}

impl Colours {
    /// Numbers of a texel that are its colour.
    pub(super) fn samples(&self) -> usize {
        match self {
            Self::Darkness | Self::Grey | Self::Palette(_) => 1,
            Self::Rgb | Self::Chroma(_) | Self::Lab { .. } => 3,
            Self::Inks => 4,
        }
    }

    /// Red, green and blue of a texel's numbers, each 0 to 1 of its range; `code` is the first of them as it is stored.
    pub(super) fn rgb(&self, of: &[f32], code: usize) -> [f32; 3] {
        match self {
            Self::Darkness => [1.0 - of[0]; 3],
            Self::Grey => [of[0]; 3],
            Self::Rgb => [of[0], of[1], of[2]],
            // Where a place lies beyond the list, its last colour stands.
            Self::Palette(list) => list.get(code).or(list.last()).copied().unwrap_or_default(),
            Self::Inks => [0, 1, 2].map(|i| (1.0 - of[i]) * (1.0 - of[3])),
            Self::Chroma(chroma) => chroma.rgb([of[0], of[1], of[2]]),
            Self::Lab { is_signed } => {
                // A signed byte is stored as its two's complement.
                let about_0 = |x: f32| {
                    let code = x * 255.0;
                    match (is_signed, code > 127.5) {
                        (true, true) => code - 256.0,
                        (true, false) => code,
                        (false, _) => code - 128.0,
                    }
                };
                lab_to_srgb([of[0] * 100.0, about_0(of[1]), about_0(of[2])])
            }
        }
    }
}

/// How luminance and chroma are stored.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Chroma {
    /// The parts of red, green and blue in luminance.
    pub luma: [f32; 3],
    /// The stored codes of the least and the greatest luminance, and of no chroma and the greatest, for both.
    pub range: [f32; 6],
}

impl Chroma {
    fn rgb(&self, of: [f32; 3]) -> [f32; 3] {
        let [red, green, blue] = self.luma;
        let part = |i: usize| {
            let (black, white) = (self.range[2 * i], self.range[2 * i + 1]);
            let whole = if i == 0 { 255.0 } else { 127.0 };
            let width = white - black;
            // A range without width is none.
            (of[i] * 255.0 - black) * if width == 0.0 { 1.0 } else { whole / width } / 255.0
        };
        let (y, cb, cr) = (part(0), part(1), part(2));
        let r = y + cr * (2.0 - 2.0 * red);
        let b = y + cb * (2.0 - 2.0 * blue);
        let g = (y - red * r - blue * b) / green;
        [r, g, b].map(|x| x.clamp(0.0, 1.0))
    }
}

/// CIELab by D50 into codes of sRGB, 0 to 1, what lies outside of it cut off.
fn lab_to_srgb([l, a, b]: [f32; 3]) -> [f32; 3] {
    let fy = (l + 16.0) / 116.0;
    let cube =
        |f: f32| if f > 6.0 / 29.0 { f * f * f } else { 3.0 * (6.0f32 / 29.0).powi(2) * (f - 4.0 / 29.0) };
    // The white of D50.
    let [x, y, z] = [0.9642 * cube(fy + a / 500.0), cube(fy), 0.8249 * cube(fy - b / 200.0)];
    // Bradford's adaptation to D65 and the primaries of sRGB in one, after B. Lindbloom.
    let linear = [
        3.133_856 * x - 1.616_867 * y - 0.490_615 * z,
        -0.978_768 * x + 1.916_142 * y + 0.033_454 * z,
        0.071_945 * x - 0.228_991 * y + 1.405_243 * z,
    ];
    linear.map(|light| {
        let light = light.clamp(0.0, 1.0);
        if light <= 0.003_130_8 {
            12.92 * light
        } else {
            1.055 * light.powf(1.0 / 2.4) - 0.055
        }
    })
}
