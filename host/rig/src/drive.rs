//! What the rig file says of surfaces and of the projector's light, as the renderer's [`Drive`].

use crate::calibrated::measured_response;
use crate::config::{ResponseConfig, RigConfig, TableResponseConfig};
use dpm_calibration_file::{CalibrationFile, LightSection};
use dpm_device::planes::Raster;
use dpm_device::regular_file;
use dpm_render::drive::{Drive, Response};
use dpm_scene::Scene;
use glam::DVec2;
use std::path::Path;
use std::sync::Arc;

mod albedo;

use albedo::albedo_maps;
pub(crate) use albedo::albedo_of;

/// Largest table of a response, bytes.
const MAX_TABLE_BYTES: u64 = 1 << 20;
/// Largest picture of a flat field, of an albedo or on a body, bytes.
pub(crate) const MAX_PICTURE_BYTES: u64 = 256 << 20;
/// Pixels darker than this share of the brightest cannot be compensated.
const LEAST_BRIGHTNESS: f32 = 0.02;

/// A file that describes the projector's light cannot be used.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{key}: {message}")]
pub struct DriveError {
    /// Configuration key.
    pub key: &'static str,
    /// What is wrong.
    pub message: String,
}

/// Surfaces and projector of the rig file at a raster.
///
/// # Errors
/// A file cannot be used; the error names its key.
pub(crate) fn drive(
    config: &RigConfig,
    measured: &CalibrationFile,
    scene: &Scene,
    raster: Raster,
) -> Result<Drive, DriveError> {
    let full_light = config.projector.full_light();
    let shares = measured.light.as_ref().map_or(vec![], |light| light.intensity.clone());
    let gain_with = |albedo: [f64; 3]| -> [f32; 3] {
        let mut intensity = config.projector.max_intensity.0;
        if let [r, g, b] = shares[..] {
            // `max_intensity` is that of a channel on average.
            intensity = [0, 1, 2].map(|c| intensity[c] * 3.0 * [r, g, b][c]);
        }
        // Planes of equal light do not reach full white together.
        let intensity = intensity.map(|full| full * (f64::from(full_light) / 255.0));
        let white = config.render.white;
        std::array::from_fn(|c| {
            // The product of exposure and white is exact where white is 1.
            let wanted = std::f64::consts::PI * (config.render.exposure * white[c]);
            (wanted / (albedo[c] * intensity[c])) as f32
        })
    };
    let differs = config.scene.bodies.iter().any(|b| b.albedo.is_some() || b.albedo_map.is_some());
    let gain_of_body = if differs {
        scene.bodies.iter().map(|b| gain_with(albedo_of(config, b.tracked))).collect()
    } else {
        Vec::new()
    };
    let albedo_maps = albedo_maps(config, scene)?;
    let (response, flat_field) = match &measured.light {
        Some(light) => measured_light(light, raster)?,
        None => {
            let field = config.projector.flat_field.as_deref().map(|f| flat_field(f, raster)).transpose()?;
            (response(&config.projector.response)?, field)
        }
    };
    Ok(Drive {
        gain: gain_with(config.scene.surface_albedo.0),
        gain_of_body,
        albedo_maps,
        ambient: config.scene.ambient.map(|v| v as f32),
        response,
        flat_field,
    })
}

/// One over the relative brightness of each pixel and channel.
type FlatField = Arc<Vec<[f32; 3]>>;

/// Response and flat field as `dpm calibrate light` measured them.
fn measured_light(
    light: &LightSection,
    raster: Raster,
) -> Result<(Option<Response>, Option<FlatField>), DriveError> {
    let wrong = |message: String| DriveError { key: "calibration.file", message };
    let response = Response::new(&measured_response(light)).map_err(|e| wrong(e.to_string()))?;
    let model = light.model().ok_or_else(|| wrong("light.size is no raster".into()))?;
    let [width, height] = light.size.map(f64::from);
    let (columns, rows) = (f64::from(raster.width()), f64::from(raster.height()));
    let mut inverse = Vec::with_capacity(raster.pixel_count());
    for y in 0..raster.height() {
        for x in 0..raster.width() {
            let at = DVec2::new((f64::from(x) + 0.5) / columns * width, (f64::from(y) + 0.5) / rows * height);
            let share = model.flat.at(at);
            if share < f64::from(LEAST_BRIGHTNESS) {
                return Err(wrong(format!(
                    "light.flat_field is {share:.3} at pixel ({x}, {y}); measure again"
                )));
            }
            inverse.push([(1.0 / share) as f32; 3]);
        }
    }
    Ok((Some(response), Some(Arc::new(inverse))))
}

fn response(config: &ResponseConfig) -> Result<Option<Response>, DriveError> {
    let wrong = |message: String| DriveError { key: "projector.response", message };
    Ok(match config {
        ResponseConfig::Linear(_) => None,
        ResponseConfig::Gamma(c) => {
            Some(Response::gamma(c.gamma.0, c.black.0).map_err(|e| wrong(e.to_string()))?)
        }
        ResponseConfig::Srgb(_) => {
            let light = [std::array::from_fn(|code| srgb_light(code as f64 / 255.0)); 3];
            Some(Response::new(&light).map_err(|e| wrong(e.to_string()))?)
        }
        ResponseConfig::Table(TableResponseConfig { file }) => {
            let told = |e: &dyn std::fmt::Display| wrong(format!("{}: {e}", file.display()));
            let text = regular_file::read_text(file, MAX_TABLE_BYTES).map_err(|e| told(&e))?;
            let light = table(&text).map_err(|e| told(&e))?;
            Some(Response::new(&light).map_err(|e| told(&e))?)
        }
    })
}

/// Light of a code value of sRGB, both as shares of the greatest (IEC 61966-2-1).
fn srgb_light(code: f64) -> f64 {
    if code <= 0.04045 {
        code / 12.92
    } else {
        ((code + 0.055) / 1.055).powf(2.4)
    }
}

/// Light of each channel and code value from 256 lines of one or three numbers.
fn table(text: &str) -> Result<[[f64; 256]; 3], String> {
    let mut light = [[0.0; 256]; 3];
    let lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.trim().starts_with('#'));
    let mut code = 0;
    for (number, line) in lines {
        let words: Vec<&str> = line.split([',', ' ', '\t', ';']).filter(|w| !w.is_empty()).collect();
        let values: Vec<f64> = words.iter().filter_map(|w| w.parse().ok()).collect();
        let row = match values[..] {
            [all] if words.len() == 1 => [all; 3],
            [r, g, b] if words.len() == 3 => [r, g, b],
            _ => return Err(format!("line {}: {line:?} is not one number or three", number + 1)),
        };
        if code == 256 {
            return Err(format!("line {}: there are more than 256 lines of numbers", number + 1));
        }
        (0..3).for_each(|c| light[c][code] = row[c]);
        code += 1;
    }
    if code < 256 {
        return Err(format!(
            "has {code} lines of numbers; 256 are needed, one for each code value from 0 on"
        ));
    }
    Ok(light)
}

/// One over the relative brightness of each pixel and channel, from a linear picture of a white field of any size.
fn flat_field(path: &Path, raster: Raster) -> Result<FlatField, DriveError> {
    let wrong = |message: String| DriveError {
        key: "projector.flat_field",
        message: format!("{}: {message}", path.display()),
    };
    let bytes = regular_file::read(path, MAX_PICTURE_BYTES).map_err(|e| wrong(e.to_string()))?;
    let picture = dpm_scene::load_linear_picture(&bytes).map_err(|e| wrong(e.to_string()))?;
    let mut brightest = [0.0f32; 3];
    for texel in &picture.texels {
        for c in 0..3 {
            if !texel[c].is_finite() || texel[c] < 0.0 {
                return Err(wrong(format!("holds {}, which is no brightness", texel[c])));
            }
            brightest[c] = brightest[c].max(texel[c]);
        }
    }
    if brightest.contains(&0.0) {
        return Err(wrong("is black in one channel; take a picture of a white field".into()));
    }
    let (width, height) = (raster.width(), raster.height());
    let mut inverse = Vec::with_capacity(raster.pixel_count());
    for y in 0..height {
        for x in 0..width {
            let at = [(x as f32 + 0.5) / width as f32, (y as f32 + 0.5) / height as f32];
            let even: [f32; 3] = std::array::from_fn(|c| picture.at(at)[c] / brightest[c]);
            if even.iter().any(|v| *v < LEAST_BRIGHTNESS) {
                return Err(wrong(format!(
                    "pixel ({x}, {y}) has less than {:.0} % of the brightest pixel's light, which cannot be \
                     compensated; was the whole field lit?",
                    100.0 * LEAST_BRIGHTNESS
                )));
            }
            inverse.push(even.map(|v| 1.0 / v));
        }
    }
    Ok(Arc::new(inverse))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The standard's two branches meet, and mid grey gives a fifth of the light.
    #[test]
    fn srgb_is_the_standards_curve() {
        assert_eq!((srgb_light(0.0), srgb_light(1.0)), (0.0, 1.0));
        assert!((srgb_light(0.04045) - srgb_light(0.040_450_1)).abs() < 1e-6);
        assert!((srgb_light(0.5) - 0.214_041_14).abs() < 1e-8);
        let config = ResponseConfig::Srgb(crate::config::SrgbResponseConfig {});
        assert!(response(&config).unwrap().is_some());
    }

    #[test]
    fn tables_have_a_line_for_each_code_value() {
        let one: String = (0..256).map(|i| format!("{i}\n")).collect();
        assert_eq!(table(&format!("# light\n\n{one}")).unwrap()[2][255], 255.0);
        let three: String = (0..256).map(|i| format!("{i}, {}\t{}\n", 2 * i, 3 * i)).collect();
        assert_eq!(table(&three).unwrap().map(|c| c[10]), [10.0, 20.0, 30.0]);
        assert!(table("1\n2\n").unwrap_err().contains("has 2 lines"));
        assert!(table(&format!("{one}256")).unwrap_err().contains("more than 256"));
        assert!(table("1 2\n").unwrap_err().starts_with("line 1"));
        assert!(table("1 2 x 3\n").unwrap_err().starts_with("line 1"));
    }
}
