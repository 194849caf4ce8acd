//! What an eye sees of a moving texture, plane by plane: motion times remedy.
//!
//! A card that glows by itself, so that no sample is left to chance, moves before the projector for the 31 frames of
//! 33 ms. Every plane of a frame is lit at its own instant, and the eye follows the card or rests. The error of the light
//! is compared for three ways to draw the planes: all for the middle of the exposure, all for the centre of their light,
//! and each group of them for its own instant.

use super::runs::EYE_FRAMES;
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::rng::Sampler;
use dpm_render::drive::Drive;
use dpm_render::gpu::{Gpu, GpuError};
use dpm_render::method::Method;
use dpm_render::pack::{source_bits, Halftone};
use dpm_render::warp::{plane_groups, Sweep, FOLLOW_SHARE};
use dpm_render::{
    FrameInputs, FrameSlot, Output, Overlapping, RenderError, Renderer, RendererSettings, Scale, Tracing,
};
use dpm_scene::geometry::projector::ProjectorCamera;
use dpm_scene::{shapes, Material, Scene, Texture};
use dpm_shaders::structs::PlaneGroup;
use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3, Vec3};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;
/// One frame at 947 frames/s, seconds.
const EXPOSURE_S: f64 = 1.0 / 947.0;
/// Side of the part of the picture that the eye looks at, and its first column and row, pixels.
const LOOK: usize = 64;
const LOOK_FROM: DVec2 = DVec2::new(128.0, 88.0);
/// Places in each direction at which a pixel is looked at.
const FINER: usize = 4;
/// Longest wait for a frame of this size.
const TIMEOUT_NS: u64 = 60_000_000_000;

/// How the card moves: its velocity, m/s, and its angular velocity, rad/s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CardMotion {
    /// What it is called in the table.
    pub name: &'static str,
    velocity: DVec3,
    turn: DVec3,
}

impl CardMotion {
    const fn of(name: &'static str, speed: f64, turn: DVec3) -> Self {
        // Not along a row or a column, so that all places within a pixel are passed.
        Self { name, velocity: DVec3::new(0.92 * speed, 0.39 * speed, 0.0), turn }
    }

    /// Where the card is, seconds after it was at rest in the middle of the picture.
    fn pose_at(&self, t: f64) -> DAffine3 {
        DAffine3::from_rotation_translation(DQuat::from_scaled_axis(self.turn * t), self.velocity * t)
    }
}

/// The motions of the table.
pub const MOTIONS: [CardMotion; 7] = [
    CardMotion::of("at rest", 0.0, DVec3::ZERO),
    CardMotion::of("0.25 m/s", 0.25, DVec3::ZERO),
    CardMotion::of("0.5 m/s", 0.5, DVec3::ZERO),
    CardMotion::of("1 m/s", 1.0, DVec3::ZERO),
    CardMotion::of("2 m/s", 2.0, DVec3::ZERO),
    CardMotion::of("4 m/s", 4.0, DVec3::ZERO),
    CardMotion::of("1 m/s, turning at 4 rad/s", 1.0, DVec3::new(0.0, 0.0, 4.0)),
];

/// What shows the card: the planes of its frames, and when they are lit.
#[derive(Clone, Debug)]
pub struct CardPanel {
    /// What it is called in the table.
    pub name: String,
    schedule: PlaneSchedule,
    /// Length of a frame, seconds, and how many of them an eye collects.
    frame_s: f64,
    frames: i32,
    /// From the beginning of a frame to the middle of each plane, in frames.
    middles: Vec<f64>,
    /// How far planes that follow go from the centre of the light to their own instant.
    follow: f64,
}

impl CardPanel {
    /// A bit-plane projector at 947 frames/s that shows the bits in `order`, red, green and blue of each in turn.
    ///
    /// # Panics
    /// When `order` does not name each bit once.
    pub fn of_bits(order: [u8; 8]) -> Self {
        let schedule = PlaneSchedule::rgb24_in(order).expect("each bit once");
        let middles = (0..schedule.len()).map(|i| middle_of(&schedule, i)).collect();
        let name = order.map(|bit| bit.to_string()).join(" ");
        Self { name, schedule, frame_s: EXPOSURE_S, frames: EYE_FRAMES as i32, middles, follow: FOLLOW_SHARE }
    }

    /// A bit-plane projector at 947 frames/s that shows 24 planes whose highest bit is split.
    pub fn of_split() -> Self {
        let schedule = PlaneSchedule::split_rgb24();
        let middles = (0..schedule.len()).map(|i| middle_of(&schedule, i)).collect();
        let (frame_s, frames) = (EXPOSURE_S, EYE_FRAMES as i32);
        Self { name: "split".into(), schedule, frame_s, frames, middles, follow: 1.0 }
    }

    /// The same, with planes that go this share of their way from the centre of the light to their own instant, 0 to 1.
    pub fn following(self, share: f64) -> Self {
        Self { follow: share, ..self }
    }

    /// A DLPC900 behind a display of 60 frames/s that shows 24 halftones of one bit, red, green and blue in turn, 620 us each.
    pub fn of_binary24() -> Self {
        let (schedule, frame_s) = (PlaneSchedule::equal_rgb24().filled(), 1.0 / 60.0);
        let middles = (0..schedule.len()).map(|i| (i as f64 + 0.5) * 620e-6 / frame_s).collect();
        Self { name: "binary24, 60 Hz".into(), schedule, frame_s, frames: 2, middles, follow: 1.0 }
    }

    /// The centre of the light of a frame, in frames from its beginning on.
    fn centre(&self) -> f64 {
        let light = |i: usize| f64::from(1u32 << self.schedule.planes()[i].bit);
        let all: f64 = (0..self.schedule.len()).map(light).sum();
        self.middles.iter().enumerate().map(|(i, middle)| middle * light(i)).sum::<f64>() / all
    }

    /// The middle of the time in which a frame is lit.
    fn middle(&self) -> f64 {
        (self.middles[0] + self.middles[self.middles.len() - 1]) / 2.0
    }
}

/// Errors of one motion and one kind of planes: root of the mean square over the pixels, full light is 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanesRow {
    /// What is on the card.
    pub texture: String,
    /// How the card moves.
    pub motion: String,
    /// The bits in the order in which they are lit, or what shows them.
    pub planes: String,
    /// An eye that follows the card.
    pub follows: Remedies,
    /// An eye that rests.
    pub rests: Remedies,
}

/// The errors by what the planes are drawn for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Remedies {
    /// All for the middle of the exposure.
    pub middle: f64,
    /// All for the centre of their light.
    pub centre: f64,
    /// Each group for its own instant.
    pub own: f64,
}

/// What is on the card.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CardPattern {
    /// White noise of the full contrast, in grains of 6 x 8 mirrors: hardly a surface has more detail.
    Noise,
    /// Overlapping patches of 6 to 40 mirrors a side, mottled with noise that grows with its wavelength, as pictures of
    /// surfaces are made up of \[Lee01\].
    Patches,
}

/// How the planes of a frame are drawn.
#[derive(Clone, Copy, PartialEq)]
enum Drawing {
    /// All for one instant.
    Once,
    /// Once, and each group of them is warped to its own instant.
    Warped,
    /// Each group of three planes of a bit by itself for its own instant: more than any warp can do.
    Anew,
}

/// A card before a part of 320 x 240 mirrors of a projector of 1024 x 768: one mirror is 0.58 mm.
pub struct TestCard {
    pattern: CardPattern,
    gpu: Arc<Gpu>,
    scene: Scene,
    camera: ProjectorCamera,
    /// Red code values at rest, from [`FINER`] times as many mirrors in each direction.
    texture: Vec<u32>,
}

/// Words that the planes of a frame show, and the map from a place of the picture at rest to where it is at the middle of
/// each plane.
type LitFrame = (Vec<u32>, Vec<DMat3>);

impl TestCard {
    /// Draws the card at rest, with `pattern` on it.
    ///
    /// # Errors
    /// The renderer's.
    ///
    /// # Panics
    /// Never: the raster and the projector are given.
    pub fn new(gpu: &Arc<Gpu>, pattern: CardPattern) -> Result<Self, RenderError> {
        let mut scene = Scene::default();
        let texture = match pattern {
            CardPattern::Noise => shapes::noise_texture(40, 5, 5, 255, false),
            CardPattern::Patches => patches(),
        };
        let glow = shapes::use_texture(&mut scene, texture);
        let card = shapes::quad(Vec3::new(-0.15, -0.15, 0.0), Vec3::X * 0.3, Vec3::Y * 0.3);
        shapes::add(
            &mut scene,
            card,
            Material { emissive_texture: glow, ..shapes::emitter(Vec3::splat(0.7)) },
        );
        let raster = Raster::new(WIDTH, HEIGHT).expect("a small raster");
        let angle = 2.0 * (f64::from(WIDTH) / 2.0 * 0.58e-3 / 1.1).atan();
        let camera = ProjectorCamera::look_at(raster, DVec3::Z * 1.1, DVec3::ZERO, DVec3::Y, angle)
            .expect("a projector before the card");
        let mut card = Self { pattern, gpu: gpu.clone(), scene, camera, texture: Vec::new() };
        let finer = Raster::new(WIDTH * FINER as u32, HEIGHT * FINER as u32).expect("a small raster");
        let fine = card.camera.at_raster(finer);
        let mut frames = card.frames(&fine, &[], None)?;
        card.texture = frames.draw(DAffine3::IDENTITY, None)?;
        Ok(card)
    }

    /// Measures one motion with one kind of planes.
    ///
    /// # Errors
    /// The renderer's.
    pub fn measure(&self, motion: &CardMotion, panel: &CardPanel) -> Result<PlanesRow, RenderError> {
        let (mut follows, mut rests) = (Remedies::default(), Remedies::default());
        let (middle, centre) = (panel.middle(), panel.centre());
        let ways = [(middle, Drawing::Once), (centre, Drawing::Once), (centre, Drawing::Warped)];
        for (way, (aim, drawing)) in ways.into_iter().enumerate() {
            let frames = self.lit_frames(panel, motion, aim, drawing)?;
            for (remedies, eye_follows) in [(&mut follows, true), (&mut rests, false)] {
                let error = self.error_of_light(&frames, panel, eye_follows);
                *[&mut remedies.middle, &mut remedies.centre, &mut remedies.own][way] = error;
            }
        }
        let texture = match self.pattern {
            CardPattern::Noise => "noise",
            CardPattern::Patches => "patches",
        };
        let (texture, motion, planes) = (texture.into(), motion.name.into(), panel.name.clone());
        Ok(PlanesRow { texture, motion, planes, follows, rests })
    }

    /// The errors of an eye that follows and of one that rests if the planes of every bit were drawn by themselves for their
    /// own instant, which costs eight times as much. What a warp has beyond that is its own error.
    ///
    /// # Errors
    /// The renderer's.
    pub fn measure_drawn_anew(
        &self,
        motion: &CardMotion,
        panel: &CardPanel,
    ) -> Result<[f64; 2], RenderError> {
        let frames = self.lit_frames(panel, motion, panel.centre(), Drawing::Anew)?;
        Ok([true, false].map(|eye_follows| self.error_of_light(&frames, panel, eye_follows)))
    }

    fn frames(
        &self,
        camera: &ProjectorCamera,
        groups: &[PlaneGroup],
        halftone: Option<Halftone>,
    ) -> Result<Frames, RenderError> {
        let settings = RendererSettings {
            raster: camera.raster,
            scale: Scale::WHOLE,
            depth: 2,
            seed: 1,
            clamp_indirect: None,
            drive: Drive::even(1.0),
            lens: None,
            camera_is_eye: false,
            leave_nothing_out: false,
            method: Method::full(1),
            halftone,
            plane_groups: groups.to_vec(),
            output: Output::Codes,
            overlap: Overlapping::Never,
            tracing: Tracing::Auto,
            most_live_texels: usize::MAX,
        };
        let renderer = Renderer::new(&self.gpu, &self.scene, settings)?;
        let slot = renderer.create_slot(false)?;
        Ok(Frames { renderer, slot, camera: *camera, drawn: 0 })
    }

    /// The frames of 33 ms, drawn for the instant `aim`, in frames from their beginning.
    fn lit_frames(
        &self,
        panel: &CardPanel,
        motion: &CardMotion,
        aim: f64,
        drawing: Drawing,
    ) -> Result<Vec<LitFrame>, RenderError> {
        let CardPanel { schedule, middles, .. } = panel;
        let instants: Vec<f64> = middles.iter().map(|middle| (middle - aim) * panel.follow).collect();
        let groups = if drawing == Drawing::Warped { plane_groups(schedule, &instants) } else { Vec::new() };
        let mut frames = self.frames(&self.camera, &groups, Halftone::of(schedule))?;
        let at_rest = self.picture_of(&DAffine3::IDENTITY).inverse();
        (0..panel.frames)
            .map(|k| {
                // The card is in the middle of the picture in the middle of the run, so that it stays on the raster.
                let begin = f64::from(k - panel.frames / 2) * panel.frame_s;
                let pose = |share: f64| motion.pose_at(begin + share * panel.frame_s);
                let mut codes = frames.draw(pose(aim), Some([pose(0.0), pose(1.0)]))?;
                if drawing == Drawing::Anew {
                    for group in plane_groups(schedule, middles) {
                        let then = frames.draw(pose(f64::from(group.instant) / 65536.0), None)?;
                        for (code, then) in codes.iter_mut().zip(then) {
                            *code = *code & !group.mask | then & group.mask;
                        }
                    }
                }
                let moved = |middle: &f64| self.picture_of(&pose(*middle)) * at_rest;
                Ok((codes, middles.iter().map(moved).collect()))
            })
            .collect()
    }

    /// From places on the card to places in the picture, both homogeneous.
    fn picture_of(&self, pose: &DAffine3) -> DMat3 {
        let c = &self.camera;
        let of = |x: f64, y: f64| {
            let q = c.to_projector_space(pose.transform_point3(DVec3::new(x, y, 0.0)));
            DVec3::new(c.fx * q.x - c.cx * q.z, -c.fy * q.y - c.cy * q.z, -q.z)
        };
        let origin = of(0.0, 0.0);
        DMat3::from_cols(of(1.0, 0.0) - origin, of(0.0, 1.0) - origin, origin)
    }

    /// By how much the red light that an eye sees differs from that of the texture. In every plane a mirror shows the bit
    /// of some code value; the texture is that of the place on the card that is at the middle of this mirror.
    fn error_of_light(&self, frames: &[LitFrame], panel: &CardPanel, follows: bool) -> f64 {
        let schedule = &panel.schedule;
        let bits = source_bits(schedule);
        let full = 255.0 / f64::from(schedule.white_weight());
        let mut off = vec![0.0; LOOK * LOOK];
        for (words, moved) in frames {
            for i in (0..schedule.len()).filter(|i| bits[*i] < 8) {
                let back = moved[i].inverse();
                let light = full * f64::from(1u32 << schedule.planes()[i].bit);
                // Of every mirror once, and only of those that are looked at.
                let mut off_at = vec![f64::NAN; words.len()];
                for fine in 0..LOOK * FINER * LOOK * FINER {
                    let (x, y) = (fine % (LOOK * FINER), fine / (LOOK * FINER));
                    let place = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) / FINER as f64 + LOOK_FROM;
                    let mirror = if follows { mapped(&moved[i], place) } else { place }.floor();
                    let at = mirror.y as usize * WIDTH as usize + mirror.x as usize;
                    if off_at[at].is_nan() {
                        let texture = self.texture_at(mapped(&back, mirror + 0.5)) / 8.0;
                        off_at[at] = f64::from(words[at] >> bits[i] & 1) * light - texture;
                    }
                    off[y / FINER * LOOK + x / FINER] += off_at[at];
                }
            }
        }
        let whole = (FINER * FINER * frames.len()) as f64 * 255.0;
        (off.iter().map(|e| (e / whole).powi(2)).sum::<f64>() / off.len() as f64).sqrt()
    }

    /// The red code value of a place of the picture at rest.
    fn texture_at(&self, place: DVec2) -> f64 {
        let at = place * FINER as f64 - 0.5;
        let (from, part) = (at.floor(), at - at.floor());
        let code = |dx: usize, dy: usize| {
            let row = (from.y as usize + dy) * WIDTH as usize * FINER;
            f64::from(self.texture[row + from.x as usize + dx] & 0xff)
        };
        let row = |dy: usize| code(0, dy) * (1.0 - part.x) + code(1, dy) * part.x;
        row(0) * (1.0 - part.y) + row(1) * part.y
    }
}

/// Texels of one side of the patches, about as wide as a mirror.
const PATCHES: usize = 256;

/// The texture of [`CardPattern::Patches`].
fn patches() -> Texture {
    let mut random = Sampler::new(4, 0);
    let grey = mottled(&mut random, 0.16);
    let tints = [(); 3].map(|()| mottled(&mut random, 0.07));
    let mut factors = vec![1.0; PATCHES * PATCHES];
    let mut between = |low: f64, high: f64| low + (high - low) * random.uniform();
    // Enough to cover every texel several times.
    for _ in 0..1500 {
        let [width, height] = [(); 2].map(|()| between(6.0, 40.0) as usize);
        let [left, top] = [(); 2].map(|()| between(0.0, PATCHES as f64) as usize);
        let factor = if between(0.0, 1.0) < 0.8 { between(0.25, 1.25) } else { 0.0 };
        for i in 0..width * height {
            let (x, y) = ((left + i % width) % PATCHES, (top + i / width) % PATCHES);
            factors[y * PATCHES + x] = factor;
        }
    }
    let value = |i: usize, channel: usize| {
        let light = (0.45 + grey[i] + tints[channel][i]) * factors[i];
        (light.clamp(0.0, 1.0) * 255.0).round() as u8
    };
    let texels = (0..PATCHES * PATCHES).map(|i| [value(i, 0), value(i, 1), value(i, 2), 255]).collect();
    let size = PATCHES as u32;
    Texture::repeated([size; 2], texels, false)
}

/// Noise with the root of the mean square `rms`, of six octaves from 2 to 64 texels whose power grows with the wavelength.
fn mottled(random: &mut Sampler, rms: f64) -> Vec<f64> {
    let mut sum = vec![0.0; PATCHES * PATCHES];
    for period in [2, 4, 8, 16, 32, 64] {
        let cells = PATCHES / period;
        let values: Vec<f64> = (0..cells * cells).map(|_| 2.0 * random.uniform() - 1.0).collect();
        let at = |x: usize, y: usize| values[y % cells * cells + x % cells];
        for (i, sum) in sum.iter_mut().enumerate() {
            let (x, y) = (i % PATCHES, i / PATCHES);
            let [u, v] = [x, y].map(|c| (c % period) as f64 / period as f64);
            let (x, y) = (x / period, y / period);
            let row = |y: usize| at(x, y) * (1.0 - u) + at(x + 1, y) * u;
            *sum += (row(y) * (1.0 - v) + row(y + 1) * v) * (period as f64).sqrt();
        }
    }
    let mean = sum.iter().sum::<f64>() / sum.len() as f64;
    let spread = (sum.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / sum.len() as f64).sqrt();
    sum.iter().map(|s| (s - mean) / spread * rms).collect()
}

/// A renderer of the card.
struct Frames {
    renderer: Renderer,
    slot: FrameSlot,
    camera: ProjectorCamera,
    /// Frames drawn before: halftones differ from one to the next.
    drawn: u32,
}

impl Frames {
    /// Code values of the card at `pose`, which moves from the first to the last pose of `sweep`.
    fn draw(&mut self, pose: DAffine3, sweep: Option<[DAffine3; 2]>) -> Result<Vec<u32>, GpuError> {
        let ends = sweep.map(|ends| ends.map(|end| [end]));
        let poses = [pose];
        let frame = self.drawn;
        self.drawn = self.drawn.wrapping_add(1);
        let inputs = FrameInputs {
            frame,
            sweep: ends.as_ref().map(|[first, last]| Sweep { first, last }),
            ..FrameInputs::new(&self.camera, (self.camera.position(), DVec3::ZERO), &poses)
        };
        self.renderer.submit(&mut self.slot, &inputs)?;
        self.slot.wait(TIMEOUT_NS)?;
        Ok(self.slot.codes().to_vec())
    }
}

/// A place of the picture through a homogeneous map.
fn mapped(map: &DMat3, place: DVec2) -> DVec2 {
    let p = *map * place.extend(1.0);
    p.truncate() / p.z
}

/// The middle of a plane of a frame whose planes last equally long, in exposures from the first photon on.
pub fn middle_of(schedule: &PlaneSchedule, plane: usize) -> f64 {
    (plane as f64 + 0.5) / schedule.len() as f64
}

/// The centre of the light of such a frame, in exposures from the first photon on.
pub fn centre_of(schedule: &PlaneSchedule) -> f64 {
    let light = |i: usize| f64::from(1u32 << schedule.planes()[i].bit);
    let all: f64 = (0..schedule.len()).map(light).sum();
    (0..schedule.len()).map(|i| middle_of(schedule, i) * light(i)).sum::<f64>() / all
}

/// The rows as a Markdown table.
pub fn markdown(rows: &[PlanesRow]) -> String {
    let mut out = String::from(
        "| texture | motion | planes | eye | all for mid-exposure | all for the light's centre | \
         on the way to its own instant |\n|---|---|---|---|---:|---:|---:|\n",
    );
    for row in rows {
        for (eye, errors) in [("follows", row.follows), ("rests", row.rests)] {
            let Remedies { middle, centre, own } = errors;
            let PlanesRow { texture, motion, planes, .. } = row;
            out += &format!(
                "| {texture} | {motion} | {planes} | {eye} | {middle:.4} | {centre:.4} | {own:.4} |\n"
            );
        }
    }
    out
}
