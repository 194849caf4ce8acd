//! One picture of the film: the room, the observer's view, and what is on the mirrors.

use super::stages::FilmStage;
use super::SLOWED;
use crate::paint::Canvas;
use crate::room::furniture::{observer_camera, Bounds};
use crate::room::raster;
use crate::room::view::FilmCamera;
use crate::room::{exposure_of, lit, shown, RoomLight, RoomPicture};
use dpm_device::planes::Channel;
use dpm_render::gpu::Gpu;
use dpm_render::RenderError;
use dpm_rig::pictures::{to_srgb, FallenLight};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::live::SeenLight;
use glam::Vec3;
use std::sync::Arc;

/// Columns and rows of the room, of the observer's view, and of the mirrors.
const ROOM: [u32; 2] = [400, 300];
const OBSERVER: [u32; 2] = [240, 168];
const MIRRORS: [u32; 2] = [168, 126];
/// Between two parts, pixels.
const GAP: usize = 2;

const INK: [u8; 3] = [236, 236, 236];
const FAINT: [u8; 3] = [150, 150, 150];
const FRAME: [u8; 3] = [56, 58, 64];
const MARKED: [u8; 3] = [250, 190, 60];

/// Draws the pictures of a film.
pub(super) struct Studio {
    rig: Arc<Rig>,
    room: RoomPicture,
    observer: FilmCamera,
    /// From radiance to brightness; known when light has been seen.
    exposure: Option<f32>,
    planes: SlowPlanes,
}

/// The planes of one frame, one after the other, a picture each.
#[derive(Default)]
struct SlowPlanes {
    planes: Vec<u8>,
    next: usize,
}

impl Studio {
    /// Sets up the cameras of `rig`.
    ///
    /// # Errors
    /// The renderer's.
    pub(super) fn new(rig: &Arc<Rig>, gpu: &Arc<Gpu>) -> Result<Self, RenderError> {
        let length_ns = rig.rate().slot_len_ns(0) * rig.config.run.frames as i64;
        let bounds = Bounds::of_run(rig, length_ns);
        let room = RoomPicture::new(rig, gpu, bounds, raster(ROOM))?;
        let camera = observer_camera(bounds, room.eye(), raster(OBSERVER)).unwrap_or(*room.camera());
        let observer = FilmCamera::new(rig, gpu, camera.at_raster(raster(OBSERVER)))?;
        Ok(Self { rig: rig.clone(), room, observer, exposure: None, planes: SlowPlanes::default() })
    }

    /// The picture at `share` of the film, of the light of `window`, the last of whose slots is that of `seen`.
    ///
    /// # Errors
    /// The renderer's.
    pub(super) fn picture(
        &mut self,
        share: f64,
        window: &[FallenLight],
        seen: &SeenLight,
    ) -> Result<Canvas, RenderError> {
        let stage = FilmStage::at(share);
        let Some(last) = window.last() else { return Ok(Canvas::new(1, 1)) };
        if let Some(camera) = observer_camera(self.room.bounds(), self.room.eye(), raster(OBSERVER)) {
            self.observer.camera = camera;
        }
        let points = self.observer.points(&last.poses, last.centre_ns, self.rig.camera.position())?;
        let lit = lit(&self.rig, &points, window);
        let exposure = *self.exposure.get_or_insert_with(|| exposure_of(&lit));
        let light = RoomLight { room: stage.room, projector: stage.projector, exposure };
        let mut canvas = blank();
        let right = ROOM[0] as usize + GAP;
        put(&mut canvas, [0, 0], ROOM, &to_srgb(&self.room.draw(window, light)?, 1.0));
        put(&mut canvas, [right, 0], OBSERVER, &to_srgb(&shown(&self.rig, &points, &lit, light), 1.0));
        self.room.label(&mut canvas);
        canvas.write([8, 10], 3, stage.caption, INK);
        canvas.write([8, ROOM[1] as usize - 18], 2, &format!("{SLOWED} TIMES SLOWER"), FAINT);
        canvas.write([right + 6, 6], 2, "WHAT THE OBSERVER SEES", INK);
        self.mirrors(&mut canvas, window, seen, stage);
        Ok(canvas)
    }

    /// What is on the mirrors: the sum of the planes, or one plane after the other.
    fn mirrors(&mut self, canvas: &mut Canvas, window: &[FallenLight], seen: &SeenLight, stage: FilmStage) {
        let rig = self.rig.clone();
        let raster = rig.camera.raster;
        let plane_bytes = raster.plane_bytes();
        let planes = rig.schedule.planes();
        if !stage.shows_planes || self.planes.next >= planes.len() {
            self.planes.next = 0;
        }
        if self.planes.next == 0 {
            self.planes.planes.clone_from(&seen.planes);
        }
        let k = self.planes.next;
        let (width, height) = (raster.width() as usize, raster.height() as usize);
        let last = window.last();
        let is_on = |x: usize, y: usize| {
            let byte = self.planes.planes.get(k * plane_bytes + y * width.div_ceil(8) + x / 8);
            byte.is_some_and(|byte| byte >> (7 - x % 8) & 1 == 1)
        };
        let colour = match planes[k].channel {
            Channel::Red => Vec3::new(1.0, 0.15, 0.1),
            Channel::Green => Vec3::new(0.2, 1.0, 0.2),
            Channel::Blue => Vec3::new(0.2, 0.4, 1.0),
            Channel::White => Vec3::ONE,
        };
        let shown = |x: usize, y: usize| {
            if stage.shows_planes {
                colour * f32::from(u8::from(is_on(x, y)))
            } else {
                let code = last.map_or([0; 3], |slot| slot.light.codes[y * width + x]);
                Vec3::from_array(code.map(f32::from)) / 255.0 * stage.projector
            }
        };
        // Every pixel of the inset is the mean of the mirrors that lie in it.
        let [columns, rows] = fitted(MIRRORS, width, height);
        let mut small = Vec::new();
        for j in 0..rows {
            for i in 0..columns {
                let (x, y) = (span(i, columns, width), span(j, rows, height));
                let count = (x.len() * y.len()) as f32;
                small.push(
                    y.flat_map(|y| x.clone().map(move |x| (x, y))).map(|(x, y)| shown(x, y)).sum::<Vec3>()
                        / count,
                );
            }
        }
        let x0 = ROOM[0] as usize + GAP + (OBSERVER[0] as usize - columns) / 2;
        let y0 = OBSERVER[1] as usize + GAP + (ROOM[1] as usize - OBSERVER[1] as usize - GAP - rows) / 2;
        put(canvas, [x0, y0], [columns as u32, rows as u32], &to_srgb(&small, 1.0));
        border(canvas, [x0, y0], [columns, rows], if stage.shows_planes { MARKED } else { FRAME });
        let label = if stage.shows_planes {
            self.planes.next += 1;
            format!("PLANE {} OF {}", k + 1, planes.len())
        } else {
            "ON THE MIRRORS".to_owned()
        };
        canvas.write([x0 + 6, y0 + 6], 2, &label, if stage.shows_planes { MARKED } else { INK });
    }
}

/// Columns and rows of a raster of `width` x `height` within `most`, each at least 1.
fn fitted(most: [u32; 2], width: usize, height: usize) -> [usize; 2] {
    let [columns, rows] = most.map(|side| side as usize);
    let share = (columns as f64 / width as f64).min(rows as f64 / height as f64);
    [width, height].map(|side| ((side as f64 * share) as usize).max(1))
}

/// The mirrors, of `mirrors`, that lie in pixel `i` of `pixels`.
fn span(i: usize, pixels: usize, mirrors: usize) -> std::ops::Range<usize> {
    let begin = i * mirrors / pixels;
    begin..((i + 1) * mirrors / pixels).max(begin + 1)
}

fn blank() -> Canvas {
    let (width, height) = (ROOM[0] as usize + GAP + OBSERVER[0] as usize, ROOM[1] as usize);
    Canvas { width, height, rgb: [14, 15, 18].repeat(width * height) }
}

fn put(canvas: &mut Canvas, [x, y]: [usize; 2], [columns, rows]: [u32; 2], rgb: &[u8]) {
    let (columns, rows) = (columns as usize, rows as usize);
    for j in 0..rows {
        let at = ((y + j) * canvas.width + x) * 3;
        canvas.rgb[at..at + columns * 3].copy_from_slice(&rgb[j * columns * 3..(j + 1) * columns * 3]);
    }
}

fn border(canvas: &mut Canvas, [x, y]: [usize; 2], [columns, rows]: [usize; 2], colour: [u8; 3]) {
    let (x, y) = (x - 1, y - 1);
    canvas.block(x, y, columns + 2, 1, colour);
    canvas.block(x, y + rows + 1, columns + 2, 1, colour);
    canvas.block(x, y, 1, rows + 2, colour);
    canvas.block(x + columns + 1, y, 1, rows + 2, colour);
}

/// The pictures at `shares` of the film, two beside each other.
pub(super) fn strip(pictures: &[Canvas], shares: &[f64; 4]) -> Canvas {
    let (width, height) = (pictures[0].width, pictures[0].height);
    let mut strip = Canvas::new(2 * width + GAP, 2 * height + GAP);
    strip.block(0, 0, 2 * width + GAP, 2 * height + GAP, FRAME);
    for (i, share) in shares.iter().enumerate() {
        let picture = &pictures[((share * pictures.len() as f64) as usize).min(pictures.len() - 1)];
        strip.paste(i % 2 * (width + GAP), i / 2 * (height + GAP), 1, picture);
    }
    strip
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_mirror_lies_in_one_pixel_of_the_inset_or_more() {
        for (pixels, mirrors) in [(4, 4), (3, 10), (168, 1024), (10, 3)] {
            let covered: std::collections::BTreeSet<usize> =
                (0..pixels).flat_map(|i| span(i, pixels, mirrors)).collect();
            assert_eq!(covered, (0..mirrors).collect(), "{pixels} {mirrors}");
        }
    }

    #[test]
    fn the_inset_keeps_the_rasters_shape() {
        assert_eq!(fitted(MIRRORS, 1024, 768), [168, 126]);
        assert_eq!(fitted(MIRRORS, 1920, 1080), [168, 94]);
        assert_eq!(fitted(MIRRORS, 1, 10_000), [1, 126]);
    }
}
