//! From radiance to code values: what the surfaces reflect and what the projector can give.

use crate::albedo_map::AlbedoMap;
use dpm_shaders::structs::RESPONSE_CODES;
use std::sync::Arc;

/// Code values of a channel.
const CODES: usize = RESPONSE_CODES as usize;

/// How radiance becomes drive, and drive becomes code values. Fixed for a rig.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Drive {
    /// `pi * exposure * white / (albedo * max_intensity)` of each channel.
    pub gain: [f32; 3],
    /// The same for each body of the scene, where its surface differs. Bodies beyond the end have `gain`.
    pub gain_of_body: Vec<[f32; 3]>,
    /// Albedo over the texture coordinates of each body of the scene, where a body has a map; its gain is then that of albedo 1. Bodies beyond the
    /// end have none.
    pub albedo_maps: Vec<Option<Arc<AlbedoMap>>>,
    /// Radiance that the surfaces show without the projector.
    pub ambient: [f32; 3],
    /// How much light a code value gives; `None`: in proportion.
    pub response: Option<Response>,
    /// One over the relative brightness of each pixel and channel, row by row; `None`: 1 everywhere.
    pub flat_field: Option<Arc<Vec<[f32; 3]>>>,
}

impl Drive {
    /// The same gain in all channels, on every body.
    pub fn even(gain: f32) -> Self {
        Self { gain: [gain; 3], ..Self::default() }
    }

    /// The light that a pixel gives at its code values, as shares of the brightest pixel's full light. `pixel` counts row by row.
    pub fn light_of(&self, codes: [u8; 3], pixel: usize) -> [f32; 3] {
        std::array::from_fn(|c| {
            let share = match &self.response {
                Some(response) => response.light[c][usize::from(codes[c])],
                None => f32::from(codes[c]) / 255.0,
            };
            match &self.flat_field {
                Some(inverse) => share / inverse[pixel][c],
                None => share,
            }
        })
    }

    /// The gain of a body of the scene.
    pub(crate) fn gain_of(&self, body: usize) -> [f32; 3] {
        self.gain_of_body.get(body).copied().unwrap_or(self.gain)
    }
}

/// For each channel the drives from which on each code value is nearest. The shader `compensate.comp` searches them.
#[derive(Clone, Debug, PartialEq)]
pub struct Response {
    thresholds: [[f32; CODES]; 3],
    /// Light of each code value, as a share of that of code 255.
    light: [[f32; CODES]; 3],
}

/// Why a measured response cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum ResponseError {
    /// A value is NaN or infinite, or the curve falls.
    #[error("the light of channel {channel} at code {code} is {light}, which is not a number or less than at the code before; measure again")]
    Falls {
        /// 0 red, 1 green, 2 blue.
        channel: usize,
        /// Code value.
        code: usize,
        /// Its light.
        light: f64,
    },
    /// Full drive is not brighter than none.
    #[error("channel {channel} gives no more light at code 255 than at code 0; measure again")]
    Dark {
        /// 0 red, 1 green, 2 blue.
        channel: usize,
    },
}

impl Response {
    /// From the light that each code value of each channel gives, in any unit. Light is divided by that of code 255; light at code 0 is the
    /// black level, which stays in the picture, so the codes count from there.
    ///
    /// # Errors
    /// The curve falls somewhere or has no light.
    pub fn new(light: &[[f64; CODES]; 3]) -> Result<Self, ResponseError> {
        let mut thresholds = [[0.0; CODES]; 3];
        let mut shares = [[0.0; CODES]; 3];
        for (channel, (curve, out)) in light.iter().zip(&mut thresholds).enumerate() {
            let falls = |code: usize| code > 0 && curve[code] < curve[code - 1];
            if let Some(code) = (0..CODES).find(|&code| !curve[code].is_finite() || falls(code)) {
                return Err(ResponseError::Falls { channel, code, light: curve[code] });
            }
            let full = curve[CODES - 1];
            if full <= curve[0] || full <= 0.0 {
                return Err(ResponseError::Dark { channel });
            }
            shares[channel] = curve.map(|l| (l / full) as f32);
            for code in 1..CODES {
                out[code] = (0.5 * (curve[code - 1] + curve[code]) / full) as f32;
            }
        }
        Ok(Self { thresholds, light: shares })
    }

    /// Light is the code value to the power `gamma`, above a black level (a share of full light, 0 up to 1).
    ///
    /// # Errors
    /// A gamma or a level that gives no growing curve.
    pub fn gamma(gamma: [f64; 3], black: [f64; 3]) -> Result<Self, ResponseError> {
        let curve = |c: usize| {
            std::array::from_fn(|code| {
                black[c] + (1.0 - black[c]) * (code as f64 / (CODES - 1) as f64).powf(gamma[c])
            })
        };
        Self::new(&std::array::from_fn(curve))
    }

    /// The thresholds of a channel; the first is not used.
    pub fn thresholds(&self, channel: usize) -> &[f32; CODES] {
        &self.thresholds[channel]
    }

    /// The code value whose light is nearest to a drive, in the shader's operations. NaN gives 0.
    pub fn code_of(&self, channel: usize, drive: f32) -> u8 {
        let thresholds = &self.thresholds[channel];
        let (mut code, mut step) = (0, CODES / 2);
        while step > 0 {
            if drive >= thresholds[code + step] {
                code += step;
            }
            step /= 2;
        }
        code as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_code_of_a_drive_is_the_one_with_the_nearest_light() {
        let response = Response::gamma([2.2, 1.0, 1.8], [0.002, 0.0, 0.01]).unwrap();
        let light = |c: usize, code: f64| {
            [0.002, 0.0, 0.01][c] + [0.998, 1.0, 0.99][c] * (code / 255.0).powf([2.2, 1.0, 1.8][c])
        };
        for c in 0..3 {
            for i in 0..5000 {
                let drive = f64::from(i) / 4500.0;
                let code = response.code_of(c, drive as f32);
                let off = (light(c, f64::from(code)) - drive).abs();
                let best =
                    (0..256).map(|k| (light(c, f64::from(k)) - drive).abs()).fold(f64::INFINITY, f64::min);
                assert!(off <= best + 1e-6, "channel {c}, drive {drive}: code {code}");
            }
            assert_eq!([response.code_of(c, f32::NAN), response.code_of(c, -1.0)], [0, 0]);
            assert_eq!([response.code_of(c, 1.0), response.code_of(c, f32::INFINITY)], [255, 255]);
        }
    }

    #[test]
    fn a_linear_response_is_the_plain_quantiser() {
        let response = Response::gamma([1.0; 3], [0.0; 3]).unwrap();
        for i in 0..=10_000 {
            let drive = i as f32 / 10_000.0;
            let plain = (drive * 255.0 + 0.5) as u8;
            assert!(
                response.code_of(0, drive).abs_diff(plain) <= u8::from((drive * 255.0).fract() - 0.5 < 1e-3)
            );
        }
    }

    #[test]
    fn curves_that_fall_or_give_no_light_are_refused() {
        let mut light = [[0.0; CODES]; 3];
        for (code, l) in light[1].iter_mut().enumerate() {
            *l = code as f64;
        }
        assert_eq!(Response::new(&light), Err(ResponseError::Dark { channel: 0 }));
        light[0] = light[1];
        light[2] = light[1];
        light[2][7] = 5.0;
        assert_eq!(Response::new(&light), Err(ResponseError::Falls { channel: 2, code: 7, light: 5.0 }));
        light[2][7] = f64::NAN;
        assert!(matches!(Response::new(&light), Err(ResponseError::Falls { channel: 2, code: 7, .. })));
    }
}
