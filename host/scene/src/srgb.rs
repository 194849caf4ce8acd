//! The curve of sRGB (IEC 61966-2-1), both ways, for components 0 to 1.

/// Linear light of a display's value.
pub fn to_linear(value: f32) -> f32 {
    if value <= 0.04045 {
        value / 12.92
    } else {
        ((value + 0.055) / 1.055).powf(2.4)
    }
}

/// A display's value for linear light.
pub fn from_linear(light: f32) -> f32 {
    if light <= 0.003_130_8 {
        12.92 * light
    } else {
        1.055 * light.powf(1.0 / 2.4) - 0.055
    }
}
