//! What the projector shows while a light sensor is moved: the code of planes, or pictures and their inverse.

use dpm_calibration::sensor::{Code, InverseCode, PLANES};
use dpm_device::planes::PlaneSchedule;
use dpm_rig::pack::source::{Canvas, PatternSource};

/// Shows the sensor's code. Only the bit of identity differs from frame to frame, so there are two pictures; they are drawn
/// before there is light, since drawing takes longer than a frame.
pub(super) struct CodeSource {
    code: Code,
    pictures: [Box<[u8]>; 2],
}

impl CodeSource {
    pub(super) fn new(code: Code) -> Self {
        let pictures = [false, true].map(|identity| {
            // Any frame with this bit of identity.
            let frame = (0..64).find(|f| code.identity(*f) == identity).unwrap_or(0);
            planes_of(&code, frame)
        });
        Self { code, pictures }
    }
}

/// The planes of a frame, one after the other.
fn planes_of(code: &Code, frame: u64) -> Box<[u8]> {
    let raster = code.raster();
    let (row_bytes, plane_bytes) = (raster.row_bytes(), raster.plane_bytes());
    let mut bytes = vec![0; PLANES * plane_bytes];
    for (plane, bytes) in bytes.chunks_exact_mut(plane_bytes).enumerate() {
        for (y, row) in (0..).zip(bytes.chunks_exact_mut(row_bytes)) {
            for x in (0..raster.width()).filter(|x| code.lit(frame, plane, *x, y)) {
                row[x as usize / 8] |= 0x80 >> (x % 8);
            }
        }
    }
    bytes.into()
}

impl PatternSource for CodeSource {
    fn picture(&self, _: u64, slot: u64) -> u64 {
        u64::from(self.code.identity(slot))
    }

    fn schedule(&self) -> Option<PlaneSchedule> {
        Some(PlaneSchedule::equal24())
    }

    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>) {
        let planes = canvas.planes().bytes_mut();
        for (to, from) in planes.iter_mut().zip(&self.pictures[(picture & 1) as usize]) {
            *to = *from;
        }
    }
}

/// Shows pictures and their inverse. All planes of a frame are the same, so a pixel is black or full white.
pub(super) struct InverseSource {
    code: InverseCode,
    /// By number of stripes: the row of each half of the raster, for columns; or the first byte of each row, for rows.
    rows: Vec<Vec<Box<[u8]>>>,
}

impl InverseSource {
    pub(super) fn new(code: InverseCode) -> Self {
        let raster = code.raster();
        // Columns differ in two halves at most, so a row of each suffices; rows are drawn one by one.
        let rows = |index: usize| -> Vec<Box<[u8]>> {
            let stripe = code.stripe(index);
            let count = if stripe.axis == 0 { 2 } else { raster.height() };
            let at = |row: u32| if stripe.axis == 0 { row * (raster.height() - 1) } else { row };
            let bytes = |y: u32| {
                let mut row = vec![0; raster.row_bytes()];
                for x in (0..raster.width()).filter(|x| stripe.lit(*x, y)) {
                    row[x as usize / 8] |= 0x80 >> (x % 8);
                }
                row.into()
            };
            (0..count).map(|row| bytes(at(row))).collect()
        };
        Self { rows: (0..code.pairs()).map(rows).collect(), code }
    }
}

impl PatternSource for InverseSource {
    fn picture(&self, _: u64, slot: u64) -> u64 {
        2 * self.code.index(slot / 2) as u64 + u64::from(self.code.is_inverse(slot))
    }

    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>) {
        let raster = self.code.raster();
        let index = (picture / 2) as usize % self.code.pairs();
        let (rows, is_inverse) = (&self.rows[index], picture % 2 == 1);
        let height = raster.height() as usize;
        let is_row = self.code.stripe(index).axis == 1;
        // Bits beyond the last pixel stay dark.
        let padding = 0xff << (raster.row_bytes() * 8 - raster.width() as usize);
        let planes = canvas.planes().bytes_mut();
        for plane in planes.chunks_exact_mut(raster.plane_bytes()) {
            for (y, to) in plane.chunks_exact_mut(raster.row_bytes()).enumerate() {
                let from = if is_row { y } else { usize::from(y >= height / 2) };
                for (to, from) in to.iter_mut().zip(&rows[from]) {
                    *to = if is_inverse { !from } else { *from };
                }
                if let Some(last) = to.last_mut() {
                    *last &= padding as u8;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::Raster;
    use dpm_render::pack::{BitPlaneFrame, Kernel};
    use dpm_rig::pack::source::PatternPainter;
    use std::sync::Arc;

    #[test]
    fn the_planes_are_those_of_the_code() {
        let raster = Raster::new(100, 60).unwrap();
        let code = Code::new(raster).unwrap();
        let source = Arc::new(CodeSource::new(code.clone()));
        let mut planes = BitPlaneFrame::new(raster, PlaneSchedule::equal24());
        let mut painter = PatternPainter::new(source.clone(), raster);
        for slot in [0, 1, 2, 3, 5, 8] {
            painter.draw(Kernel::Scalar, source.picture(7, slot), &mut planes);
            for plane in 0..PLANES {
                for (x, y) in [(0, 0), (99, 59), (31, 7), (64, 33), (50, 50)] {
                    let byte = planes.plane(plane)[y as usize * raster.row_bytes() + x as usize / 8];
                    let lit = byte >> (7 - x % 8) & 1 == 1;
                    assert_eq!(
                        lit,
                        code.lit(slot, plane, x, y),
                        "slot {slot}, plane {plane}, pixel {x}, {y}"
                    );
                }
            }
        }
    }

    #[test]
    fn frames_and_their_inverse_are_those_of_the_code() {
        for (width, height) in [(100, 60), (64, 96), (61, 37)] {
            let raster = Raster::new(width, height).unwrap();
            let code = InverseCode::new(raster);
            let source = Arc::new(InverseSource::new(code.clone()));
            let mut planes = BitPlaneFrame::new(raster, PlaneSchedule::rgb24());
            let mut painter = PatternPainter::new(source.clone(), raster);
            for slot in (0..4 * code.pairs() as u64).chain([1000, 1001, 70_003]) {
                painter.draw(Kernel::Scalar, source.picture(7, slot), &mut planes);
                for plane in [0, 13, 23] {
                    for (i, byte) in planes.plane(plane).iter().enumerate() {
                        let (y, x) = ((i / raster.row_bytes()) as u32, (i % raster.row_bytes()) as u32);
                        for bit in 0..8 {
                            let x = 8 * x + bit;
                            let should = x < width && code.lit(slot, x, y);
                            assert_eq!(byte >> (7 - bit) & 1 == 1, should, "slot {slot}, pixel {x}, {y}");
                        }
                    }
                }
            }
        }
    }
}
