//! Reads an OpenEXR picture: the first layer with red, green and blue, of half or single precision, with any of the usual
//! compressions. Its alpha is left out.

use super::super::SceneError;
use super::{decode_bounded, Pixels};
use glam::Vec3;
use image::ImageFormat;

/// Reads a picture; its sides are checked before its texels are.
pub(crate) fn read_exr(bytes: &[u8]) -> Result<Pixels, SceneError> {
    // Decoding makes four floats of a texel, and the conversion three more.
    let rgb = decode_bounded(bytes, ImageFormat::OpenExr, 32)?.into_rgb32f();
    let texels = rgb.as_raw().chunks_exact(3).map(Vec3::from_slice).collect();
    Ok((rgb.width(), rgb.height(), texels))
}

#[cfg(test)]
mod tests {
    use super::super::decode_environment;
    use super::*;

    /// An uncompressed file of single precision, written here byte by byte after the format's description, so that it does not
    /// come from the library that reads it.
    fn exr(channels: &[&str], width: u32, rows: &[Vec<Vec<f32>>]) -> Vec<u8> {
        let attribute = |name: &str, kind: &str, value: Vec<u8>| {
            [name.as_bytes(), b"\0", kind.as_bytes(), b"\0", &(value.len() as u32).to_le_bytes(), &value]
                .concat()
        };
        let channel = |name: &&str| {
            let about = [2u32, 0, 1, 1].map(u32::to_le_bytes).concat();
            [name.as_bytes(), b"\0", &about].concat()
        };
        let list = [channels.iter().flat_map(channel).collect(), vec![0]].concat();
        let window = [0, 0, width - 1, rows.len() as u32 - 1].map(u32::to_le_bytes).concat();
        let one = 1.0f32.to_le_bytes().to_vec();
        let mut out = [
            vec![0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0],
            attribute("channels", "chlist", list),
            attribute("compression", "compression", vec![0]),
            attribute("dataWindow", "box2i", window.clone()),
            attribute("displayWindow", "box2i", window),
            attribute("lineOrder", "lineOrder", vec![0]),
            attribute("pixelAspectRatio", "float", one.clone()),
            attribute("screenWindowCenter", "v2f", vec![0; 8]),
            attribute("screenWindowWidth", "float", one),
            vec![0],
        ]
        .concat();
        let row_bytes = 8 + 4 * channels.len() * width as usize;
        let first = out.len() + 8 * rows.len();
        (0..rows.len()).for_each(|y| out.extend(((first + y * row_bytes) as u64).to_le_bytes()));
        for (y, row) in rows.iter().enumerate() {
            out.extend((y as u32).to_le_bytes());
            out.extend(((row_bytes - 8) as u32).to_le_bytes());
            out.extend(row.concat().into_iter().flat_map(f32::to_le_bytes));
        }
        out
    }

    /// Two rows of two texels. Channels stand in the order of the alphabet.
    fn small() -> Vec<u8> {
        let row = |b: [f32; 2], g: [f32; 2], r: [f32; 2]| vec![b.to_vec(), g.to_vec(), r.to_vec()];
        let rows = [row([0.5, 1.0], [2.0, 3.0], [4.0, 70_000.0]), row([0.0, 8.0], [0.0, 9.0], [0.25, 10.0])];
        exr(&["B", "G", "R"], 2, &rows)
    }

    fn refused(bytes: &[u8]) -> String {
        decode_environment(bytes, 0.0, 1.0).unwrap_err().to_string()
    }

    #[test]
    fn golden_bytes_are_read_linear_and_from_the_top() {
        let (width, height, texels) = read_exr(&small()).unwrap();
        let expected =
            [[4.0, 2.0, 0.5], [70_000.0, 3.0, 1.0], [0.25, 0.0, 0.0], [10.0, 9.0, 8.0]].map(Vec3::from_array);
        assert_eq!((width, height, texels.as_slice()), (2, 2, &expected[..]));
        decode_environment(&small(), 0.0, 1.0).unwrap();
    }

    #[test]
    fn compressed_half_floats_and_alpha_are_read() {
        let mut file = std::io::Cursor::new(vec![]);
        let picture =
            image::Rgba32FImage::from_fn(37, 5, |x, y| image::Rgba([x as f32, y as f32, 0.5, 0.25]));
        image::DynamicImage::ImageRgba32F(picture).write_to(&mut file, ImageFormat::OpenExr).unwrap();
        let (width, height, texels) = read_exr(file.get_ref()).unwrap();
        assert_eq!((width, height, texels[37 + 3]), (37, 5, Vec3::new(3.0, 1.0, 0.5)));
    }

    #[test]
    fn hostile_pictures_are_refused_with_reasons() {
        let whole = small();
        for length in 4..whole.len() {
            let told = refused(&whole[..length]);
            assert!(told.contains("cannot be decoded"), "{length}: {told}");
        }
        for place in 0..whole.len() {
            for change in [1, 0x80, 0xff] {
                let mut damaged = whole.clone();
                damaged[place] ^= change;
                // It may still be a picture; it must not end the program.
                let _ = decode_environment(&damaged, 0.0, 1.0);
            }
        }
        // 70,000 columns and rows in the header.
        let mut huge = whole.clone();
        let side = 69_999u32.to_le_bytes();
        for name in ["dataWindow\0box2i\0", "displayWindow\0box2i\0"] {
            let at = huge.windows(name.len()).position(|w| w == name.as_bytes()).unwrap() + name.len() + 12;
            huge[at..at + 8].copy_from_slice(&[side, side].concat());
        }
        assert!(refused(&huge).contains("limit"), "{}", refused(&huge));
        let row = |v: f32| [vec![vec![v], vec![1.0], vec![1.0]]];
        assert!(refused(&exr(&["B", "G", "R"], 1, &row(f32::NAN))).contains("texel 0, 0"));
        assert!(refused(&exr(&["B", "G", "R"], 1, &row(-1.0))).contains("negative"));
        let depth = [vec![vec![1.0]]];
        assert!(refused(&exr(&["Z"], 1, &depth)).contains("cannot be decoded"));
    }
}
