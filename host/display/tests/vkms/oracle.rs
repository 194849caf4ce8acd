//! The pixels that a frame's planes must become, written bit by bit from what docs/DISPLAY.md says of each encoding, without
//! the code that writes them in the product.

use dpm_device::planes::{Channel, PlaneSchedule, Raster};
use dpm_display::encoding::Encoding;

/// The pixels of `planes`: rows without padding, XRGB8888 with zeros in the unused bytes.
pub(crate) fn pixels(encoding: Encoding, schedule: &PlaneSchedule, raster: Raster, planes: &[u8]) -> Vec<u8> {
    let (width, height) = (raster.width() as usize, raster.height() as usize);
    let mut out = vec![0; 4 * width * height];
    for (k, spec) in schedule.planes().iter().enumerate() {
        // Where this plane's bit goes: which byte of a pixel (blue, green, red), and which bit of it.
        let (byte, bit) = match encoding {
            // The planes of a colour are the bits of its code value.
            Encoding::Rgb8 => match spec.channel {
                Channel::Blue => (0, spec.bit),
                Channel::Green => (1, spec.bit),
                Channel::Red => (2, spec.bit),
                Channel::White => panic!("no encoding of code values has white planes in the demo"),
            },
            // Plane 0 to 7 are the bits of green, then red, then blue.
            Encoding::Planes24 => ([1, 2, 0][k / 8], (k % 8) as u8),
        };
        let plane = &planes[k * raster.plane_bytes()..][..raster.plane_bytes()];
        for y in 0..height {
            for x in 0..width {
                let lit = plane[y * raster.row_bytes() + x / 8] >> (7 - x % 8) & 1;
                out[4 * (y * width + x) + byte] |= lit << bit;
            }
        }
    }
    out
}
