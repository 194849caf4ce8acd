//! Pictures whose values are light as measured, without the curve of sRGB: flat fields.

use crate::environment::{check_piece, check_size, collect, read_pfm};
use crate::limits::of_header;
use crate::SceneError;
use glam::Vec3;
use image::{ImageFormat, ImageReader, Limits};
use std::io::Cursor;

/// A picture of linear values, rows from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct LinearPicture {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Red, green and blue of each texel.
    pub texels: Vec<[f32; 3]>,
}

impl LinearPicture {
    /// The value at a place of the picture, both coordinates 0 to 1 from the upper left corner, interpolated bilinearly
    /// between the centres of texels and constant beyond them.
    pub fn at(&self, place: [f32; 2]) -> [f32; 3] {
        let axis = |t: f32, n: u32| {
            let x = (t * n as f32 - 0.5).clamp(0.0, (n - 1) as f32);
            let low = x as usize;
            (low, (low + 1).min(n as usize - 1), x - low as f32)
        };
        let ((x0, x1, fx), (y0, y1, fy)) = (axis(place[0], self.width), axis(place[1], self.height));
        let texel = |x: usize, y: usize| self.texels[y * self.width as usize + x];
        let mix = |a: [f32; 3], b: [f32; 3], t: f32| std::array::from_fn(|c| a[c] + (b[c] - a[c]) * t);
        mix(mix(texel(x0, y0), texel(x1, y0), fx), mix(texel(x0, y1), texel(x1, y1), fx), fy)
    }
}

/// Reads a PFM, or a PNG of 8 or 16 bits whose values are proportional to light. Full PNG values are 1.
///
/// # Errors
/// Another format, a damaged file, or more than 8192 x 4096 texels.
pub fn load_linear_picture(bytes: &[u8]) -> Result<LinearPicture, SceneError> {
    match bytes {
        [b'P', b'F' | b'f', ..] => {
            let (width, height, texels) = read_pfm(bytes)?;
            Ok(LinearPicture { width, height, texels: texels.iter().map(|t| t.to_array()).collect() })
        }
        [0x89, b'P', b'N', b'G', ..] => read_png(bytes),
        _ => Err(SceneError::unsupported("this image format", "give a .pfm or a linear .png")),
    }
}

fn read_png(bytes: &[u8]) -> Result<LinearPicture, SceneError> {
    let broken = |e: image::ImageError| SceneError::broken("image", e.to_string());
    let reader = || ImageReader::with_format(Cursor::new(bytes), ImageFormat::Png);
    let mut header = reader();
    header.limits(of_header());
    let (width, height) = header.into_dimensions().map_err(broken)?;
    let texels = check_size(width, height)?;
    check_piece(texels, 8, bytes.len())?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(texels as u64 * 8 + (1 << 20));
    let mut reader = reader();
    reader.limits(limits);
    let picture = reader.decode().map_err(broken)?;
    let rgb = picture.into_rgb16();
    let at = |x, y| Vec3::from(rgb.get_pixel(x, y).0.map(|code| f32::from(code) / 65_535.0));
    let ((width, height, texels), _) = collect([width, height], bytes.len(), at);
    Ok(LinearPicture { width, height, texels: texels.iter().map(|t| t.to_array()).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_lie_on_the_centres_of_texels() {
        let texels = vec![[0.0; 3], [1.0; 3], [2.0; 3], [3.0; 3]];
        let picture = LinearPicture { width: 2, height: 2, texels };
        assert_eq!(picture.at([0.25, 0.25]), [0.0; 3]);
        assert_eq!(picture.at([0.75, 0.75]), [3.0; 3]);
        assert_eq!(picture.at([0.5, 0.5]), [1.5; 3]);
        assert_eq!([picture.at([0.0, 0.0]), picture.at([1.0, 0.0])], [[0.0; 3], [1.0; 3]]);
    }

    #[test]
    fn a_png_is_linear_whatever_its_depth() {
        let mut eight = Vec::new();
        let grey = image::GrayImage::from_vec(2, 1, vec![51, 255]).unwrap();
        grey.write_to(&mut Cursor::new(&mut eight), ImageFormat::Png).unwrap();
        let mut sixteen = Vec::new();
        let deep =
            image::ImageBuffer::<image::Luma<u16>, _>::from_vec(2, 1, vec![13_107u16, 65_535]).unwrap();
        image::DynamicImage::ImageLuma16(deep)
            .write_to(&mut Cursor::new(&mut sixteen), ImageFormat::Png)
            .unwrap();
        for bytes in [eight, sixteen] {
            let picture = load_linear_picture(&bytes).unwrap();
            assert!((picture.texels[0][1] - 0.2).abs() < 1e-6 && picture.texels[1] == [1.0; 3]);
            for end in 0..bytes.len() {
                assert!(load_linear_picture(&bytes[..end]).is_err() || end > 40);
            }
        }
        assert!(load_linear_picture(b"GIF89a").is_err() && load_linear_picture(b"").is_err());
    }
}
