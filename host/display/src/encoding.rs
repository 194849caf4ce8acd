//! The planes of a frame into the pixels of a display, bit for bit.

use dpm_device::planes::{Channel, PlaneSchedule, Raster};
use dpm_device::projector::gather_bits;

/// What the bits of a pixel mean to the display.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// Code values: a projector or monitor that shows grey by itself.
    Rgb8,
    /// The planes themselves: the k-th plane of a frame is the k-th bit in the order in which a DLPC900 shows the bits of a
    /// pixel: green 0 to 7, red 0 to 7, blue 0 to 7.
    Planes24,
}

/// Most planes that a pixel can carry.
pub const MOST_PLANES: usize = 24;

/// Where each plane of a frame goes in a pixel.
#[derive(Clone, Copy, Debug)]
pub struct PixelMap {
    places: [(Channel, u8); MOST_PLANES],
    planes: usize,
}

impl PixelMap {
    /// The map for frames of `schedule`. `None` if `encoding` cannot carry them: code values need distinct planes of one
    /// bit each, and a pixel has 24 bits.
    pub fn new(encoding: Encoding, schedule: &PlaneSchedule) -> Option<Self> {
        let planes = schedule.len();
        let fits = match encoding {
            Encoding::Rgb8 => !schedule.has_repeats() && planes <= MOST_PLANES,
            Encoding::Planes24 => planes == MOST_PLANES,
        };
        if !fits {
            return None;
        }
        let mut places = [(Channel::Red, 0); MOST_PLANES];
        for (k, (place, spec)) in places.iter_mut().zip(schedule.planes()).enumerate() {
            *place = match encoding {
                Encoding::Rgb8 => (spec.channel, spec.bit),
                Encoding::Planes24 => ([Channel::Green, Channel::Red, Channel::Blue][k / 8], (k % 8) as u8),
            };
        }
        Some(Self { places, planes })
    }

    /// Writes the pixels of a frame to `pixels`, rows of `pitch` bytes, four bytes a pixel: blue, green, red and an unused
    /// one (DRM's XRGB8888). Bytes outside the picture stay as they are. It allocates nothing.
    ///
    /// # Panics
    /// When `planes` or `pixels` is shorter than the raster demands.
    pub fn write(&self, raster: Raster, planes: &[u8], pixels: &mut [u8], pitch: usize) {
        let has_white = self.places[..self.planes].iter().any(|(channel, _)| *channel == Channel::White);
        gather_bits(raster, &self.places[..self.planes], planes, |y, x, run| {
            let at = y * pitch + 4 * x;
            let out = &mut pixels[at..at + 4 * run.pixels];
            let [red, green, blue, white] = run.channels;
            // Loops of a fixed length over whole words, which the compiler turns into vector code.
            let mut words = [0u32; 64];
            for i in 0..64 {
                // Planes of white light add to all three.
                let white = if has_white { white[i] } else { 0 };
                let [red, green, blue] =
                    [red[i], green[i], blue[i]].map(|code| u32::from(code.saturating_add(white)));
                words[i] = blue | green << 8 | red << 16;
            }
            for (out, word) in out.chunks_exact_mut(4).zip(words) {
                out.copy_from_slice(&word.to_le_bytes());
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::projector::light_of_planes;
    use dpm_device::rng::Draws;
    use proptest::prelude::*;

    fn any_planes(raster: Raster, planes: usize, seed: u64) -> Vec<u8> {
        let draws = Draws::new(seed);
        (0..raster.plane_bytes() * planes).map(|i| draws.bits(i as u64) as u8).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        /// Code values arrive as the projector of the link would show them, and nothing beside the picture is touched.
        #[test]
        fn code_values_are_the_light_of_the_planes(w in 1u32..140, h in 1u32..5, seed in any::<u64>(), mono in any::<bool>()) {
            let raster = Raster::new(w, h).unwrap();
            let schedule = if mono { PlaneSchedule::mono8() } else { PlaneSchedule::rgb24() };
            let planes = any_planes(raster, schedule.len(), seed);
            let mut light = vec![[0; 3]; raster.pixel_count()];
            light_of_planes(raster, &schedule, &planes, &mut light);
            let pitch = 4 * w as usize + 12;
            let mut pixels = vec![0xee; pitch * h as usize];
            PixelMap::new(Encoding::Rgb8, &schedule).unwrap().write(raster, &planes, &mut pixels, pitch);
            for (y, row) in pixels.chunks_exact(pitch).enumerate() {
                for x in 0..w as usize {
                    let [red, green, blue] = light[y * w as usize + x];
                    prop_assert_eq!(&row[4 * x..4 * x + 4], &[blue, green, red, 0]);
                }
                prop_assert!(row[4 * w as usize..].iter().all(|b| *b == 0xee));
            }
        }

        /// Each plane is one bit of the pixels, in the order of time.
        #[test]
        fn planes_are_bits_in_the_order_of_time(w in 1u32..140, h in 1u32..4, seed in any::<u64>()) {
            let raster = Raster::new(w, h).unwrap();
            let schedule = PlaneSchedule::rgb24();
            let planes = any_planes(raster, 24, seed);
            let pitch = 4 * w as usize;
            let mut pixels = vec![0; pitch * h as usize];
            PixelMap::new(Encoding::Planes24, &schedule).unwrap().write(raster, &planes, &mut pixels, pitch);
            for k in 0..24 {
                for y in 0..h as usize {
                    for x in 0..w as usize {
                        let lit = planes[k * raster.plane_bytes() + y * raster.row_bytes() + x / 8] >> (7 - x % 8) & 1;
                        let pixel = &pixels[y * pitch + 4 * x..][..4];
                        // In memory: blue, green, red.
                        let byte = [pixel[1], pixel[2], pixel[0]][k / 8];
                        prop_assert_eq!(byte >> (k % 8) & 1, lit);
                    }
                }
            }
        }
    }

    #[test]
    fn what_a_pixel_cannot_carry_is_refused() {
        assert!(PixelMap::new(Encoding::Planes24, &PlaneSchedule::mono8()).is_none());
        assert!(PixelMap::new(Encoding::Planes24, &PlaneSchedule::equal24()).is_some());
        assert!(PixelMap::new(Encoding::Rgb8, &PlaneSchedule::equal24()).is_none());
    }
}
