//! Full-field levels of each channel in turn: which slot shows which level, and what a sensor at rest makes of them.
//!
//! Every level stands between two of full white, its references, so that a slow change of the light is divided out. The
//! levels go round and round, so a level is a function of the slot alone, whenever the measurement begins.

use super::recorder::TimedBlock;
use super::showing::Showing;
use dpm_calibration::light::{steady, Channels, Next, ResponseSession, Steady};
use dpm_calibration::sensor::SampleBlock;
use dpm_device::link::{breaks_limit, mean_luminance, FULL_LUMINANCE};
use dpm_device::planes::{Channel, PlaneSchedule, Raster};
use dpm_device::time::FrameRate;
use dpm_render::pack::{pack_codes, BitPlaneFrame, Kernel};
use dpm_rig::pack::source::{Canvas, PatternSource};
use std::collections::BTreeMap;

/// A level stands for this long at least, seconds, and for so many frames.
const HOLD_S: f64 = 0.25;
const HOLD_FRAMES: u64 = 40;
/// Longest time for a level, seconds: the limiter looks back for one second.
const LONGEST_HOLD_S: f64 = 2.0;
/// Full white.
const WHITE: u32 = 0x00ff_ffff;
/// At both ends of a level so much is left out, seconds: the clocks are known to a millisecond or two.
const MARGIN_S: f64 = 0.01;
/// A frame counts when this share of it was sampled.
const LEAST_SAMPLED: f64 = 0.98;
/// A level counts when so many of its slots were seen whole with a frame of their own.
const LEAST_FRAMES: usize = 24;
/// References before and after a level agree within this share.
const MOST_DRIFT: f64 = 0.03;

/// How a level is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LevelField {
    /// On the whole raster, for as long as a limit of flashes a second demands; `None` for no limit.
    Full(Option<u8>),
    /// On every other one of 8 x 6 tiles, and its complement on those between, so that the light of the whole picture never
    /// changes. A display is shown levels like this: its light comes some frames late, too.
    Tiles {
        /// On those tiles that have their complement otherwise.
        is_exchanged: bool,
    },
}

/// Columns and rows of tiles.
const TILES: [u32; 2] = [8, 6];
/// At both ends of a level of tiles so much is left out, seconds: displays are late by up to a quarter of a second.
const TILES_MARGIN_S: f64 = 0.3;
/// The dark tile's light is less than this share of the lit one's.
const MOST_DARK: f64 = 0.25;

/// What a step shows: the code of each of red, green and blue.
#[derive(Clone, Copy, Debug, PartialEq)]
struct LevelStep {
    what: Next,
    code: u32,
}

/// The order of the levels.
#[derive(Clone, Debug)]
pub struct Levels {
    steps: Vec<LevelStep>,
    hold: u64,
    channels: usize,
    schedule: PlaneSchedule,
    rate: FrameRate,
    field: LevelField,
    mean: f64,
}

impl Levels {
    /// Levels for the planes of a projector: white alone, or red, green and blue, `codes` of each.
    ///
    /// # Errors
    /// Planes of which no level can be measured, or a limit that no hold keeps; one sentence.
    pub fn new(
        schedule: &PlaneSchedule,
        rate: FrameRate,
        field: LevelField,
        codes: u32,
    ) -> Result<Self, String> {
        let has = |channel| schedule.planes().iter().any(|p| p.channel == channel);
        let colours = [Channel::Red, Channel::Green, Channel::Blue].map(has);
        let channels = match (has(Channel::White), colours) {
            (true, [false, false, false]) => 1,
            (false, [true, true, true]) => 3,
            _ => return Err(
                "the projector's planes are neither red, green and blue nor white alone; their levels do \
                            not add up by channel, so no response can be measured"
                    .into(),
            ),
        };
        let mut levels = vec![LevelStep { what: Next::Black, code: 0 }];
        for channel in 0..channels {
            levels.extend((1..=codes).rev().map(|i| {
                let value = (255 * i + codes / 2) / codes;
                let code = if channels == 1 { value * 0x01_0101 } else { value << (8 * channel) };
                LevelStep { what: Next::Code { channel, code: f64::from(value) / 255.0 }, code }
            }));
        }
        Self::of(levels, channels, schedule, rate, field)
    }

    /// White and black alone, by which a sensor among tiles is told on which it lies.
    ///
    /// # Errors
    /// As [`Levels::new`].
    pub fn two(schedule: &PlaneSchedule, rate: FrameRate) -> Result<Self, String> {
        let field = LevelField::Tiles { is_exchanged: false };
        Self::of(vec![LevelStep { what: Next::Black, code: 0 }], 1, schedule, rate, field)
    }

    /// Whether the sensor lies on a tile of the complement, from samples of [`Levels::two`].
    ///
    /// # Errors
    /// Too few samples, or a sensor on the border of two tiles; one sentence with what to do.
    pub fn is_on_complement(
        &self,
        showing: &Showing,
        samples: &[TimedBlock],
        room: LampLight,
    ) -> Result<bool, String> {
        let mut levels = [None; 2];
        for (run, frames) in by_run(self, showing, samples) {
            if frames.len() >= LEAST_FRAMES {
                let reading = steady(&frames, room.flicker_hz).map_err(|e| e.to_string())?;
                levels[self.step_of(run) % 2] = Some(reading.level - room.ambient.level);
            }
        }
        let [Some(white), Some(black)] = levels else {
            return Err("too few frames were seen; look at `dpm link-test` and at the sensor's cable".into());
        };
        if white.min(black) > MOST_DARK * white.max(black) {
            return Err(
                "the sensor sees both of two neighbouring tiles, or no light at all: move it by a few \
                        centimetres within the picture"
                    .into(),
            );
        }
        Ok(black > white)
    }

    fn of(
        levels: Vec<LevelStep>,
        channels: usize,
        schedule: &PlaneSchedule,
        rate: FrameRate,
        field: LevelField,
    ) -> Result<Self, String> {
        let reference = LevelStep { what: Next::White, code: WHITE };
        let steps: Vec<LevelStep> = levels.into_iter().flat_map(|level| [reference, level]).collect();
        let whole = |code: u32| match field {
            LevelField::Full(_) => luminance(schedule, code),
            // Both kinds of tiles cover the same part of the raster, but for a row or a column of pixels.
            LevelField::Tiles { .. } => (luminance(schedule, code) + luminance(schedule, WHITE - code)) / 2,
        };
        let light: Vec<u32> = steps.iter().map(|s| whole(s.code)).collect();
        let mean = light.iter().map(|l| f64::from(*l)).sum::<f64>()
            / (light.len().max(1) as f64 * f64::from(FULL_LUMINANCE));
        let slots = |s: f64| (s * rate.hz()).ceil() as u64;
        let mut hold = slots(HOLD_S).max(HOLD_FRAMES);
        if let LevelField::Tiles { .. } = field {
            hold += 2 * slots(TILES_MARGIN_S);
        }
        if let LevelField::Full(Some(limit)) = field {
            while flashes_too_often(&light, schedule, hold, (rate, limit)) {
                hold += hold / 10;
                if hold > slots(LONGEST_HOLD_S).max(2 * HOLD_FRAMES) {
                    return Err(format!(
                        "levels would flash more often than {limit} times a second, however long they stand"
                    ));
                }
            }
            // The second that the limiter looks at may begin anywhere, and so may the levels.
            hold += hold / 8;
        }
        Ok(Self { steps, hold, channels, schedule: *schedule, rate, field, mean })
    }

    /// Those of the levels that `readings` lacks; `None` if it has all.
    ///
    /// # Errors
    /// As [`Levels::new`].
    pub fn missing(&self, readings: &Readings) -> Result<Option<Self>, String> {
        let lacks = |s: &&LevelStep| !readings.of.contains_key(&s.code);
        let levels: Vec<LevelStep> = self.levels().filter(lacks).copied().collect();
        if levels.is_empty() {
            return Ok(None);
        }
        Self::of(levels, self.channels, &self.schedule, self.rate, self.field).map(Some)
    }

    fn levels(&self) -> impl Iterator<Item = &LevelStep> {
        self.steps.iter().skip(1).step_by(2)
    }

    /// Time for which every level is shown at least once, whenever it begins, seconds.
    pub fn seconds(&self) -> f64 {
        (self.steps.len() as u64 + 2) as f64 * self.hold as f64 / self.rate.hz()
    }

    /// Longest time for which all mirrors are lit, seconds.
    pub fn full_white_s(&self) -> f64 {
        match self.field {
            LevelField::Full(_) => self.hold_s(),
            LevelField::Tiles { .. } => 0.0,
        }
    }

    /// Time for which a level stands, seconds.
    pub fn hold_s(&self) -> f64 {
        self.hold as f64 / self.rate.hz()
    }

    /// Mean light over full white.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// Levels, references not counted.
    pub fn count(&self) -> usize {
        self.steps.len() / 2
    }

    /// The run of equal slots that a slot belongs to; the step is its remainder.
    fn run_of(&self, slot: u64) -> u64 {
        slot / self.hold
    }

    fn step_of(&self, run: u64) -> usize {
        (run % self.steps.len() as u64) as usize
    }
}

impl PatternSource for Levels {
    fn picture(&self, _: u64, slot: u64) -> u64 {
        self.step_of(self.run_of(slot)) as u64
    }

    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>) {
        let code = self.steps[picture as usize % self.steps.len()].code;
        let raster = canvas.raster();
        let LevelField::Tiles { is_exchanged } = self.field else {
            return canvas.codes(|codes| codes.fill(code));
        };
        let complement = WHITE - code;
        let (even, odd) = if is_exchanged { (complement, code) } else { (code, complement) };
        canvas.codes(|codes| {
            for (y, row) in (0..).zip(codes.chunks_exact_mut(raster.width() as usize)) {
                let of_row = y * TILES[1] / raster.height();
                for (x, pixel) in (0..).zip(row) {
                    let tile = x * TILES[0] / raster.width() + of_row;
                    *pixel = if tile.is_multiple_of(2) { even } else { odd };
                }
            }
        });
    }
}

/// Mean light of a full field, as the limiter sees it.
fn luminance(schedule: &PlaneSchedule, code: u32) -> u32 {
    // Every pixel is the same, so a small raster has the light of a large one.
    let Some(raster) = Raster::new(8, 1) else { return 0 };
    let mut planes = BitPlaneFrame::new(raster, *schedule);
    pack_codes(Kernel::Scalar, &[code; 8], &mut planes);
    mean_luminance(raster, schedule, planes.bytes())
}

/// True if levels of light, each for `hold` slots, over and over, break the limit.
fn flashes_too_often(light: &[u32], schedule: &PlaneSchedule, hold: u64, limit: (FrameRate, u8)) -> bool {
    let around = light.iter().chain(light).flat_map(|l| std::iter::repeat_n(*l, hold as usize));
    breaks_limit(limit, schedule, around)
}

/// Frequency of the lamps, and the light without the projector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LampLight {
    /// Twice that of the mains, hertz.
    pub flicker_hz: f64,
    /// The light.
    pub ambient: Steady,
}

/// Levels that were read so far, in one or more passes.
#[derive(Clone, Debug, Default)]
pub struct Readings {
    /// By code: what it is, and its level as if full white had been what it was in the first pass.
    of: BTreeMap<u32, (Next, Steady)>,
    /// Full white of the first pass.
    white: Option<Steady>,
}

impl Readings {
    /// Adds what was sampled while `levels` were shown.
    ///
    /// # Errors
    /// Why the samples are no levels of a projector; one sentence with what to do.
    pub fn add(
        &mut self,
        levels: &Levels,
        showing: &Showing,
        samples: &[TimedBlock],
        room: LampLight,
    ) -> Result<(), String> {
        let mut readings = BTreeMap::new();
        for (run, frames) in by_run(levels, showing, samples) {
            // The first and the last run may be cut off.
            if frames.len() >= LEAST_FRAMES {
                readings.insert(run, steady(&frames, room.flicker_hz).map_err(|e| e.to_string())?);
            }
        }
        let whites: Vec<Steady> = readings
            .iter()
            .filter(|(run, _)| levels.step_of(**run).is_multiple_of(2))
            .map(|(_, r)| *r)
            .collect();
        if whites.is_empty() {
            return Ok(());
        }
        let ambient = room.ambient.level;
        let white = self.white.get_or_insert_with(|| Steady {
            level: whites.iter().map(|r| r.level).sum::<f64>() / whites.len() as f64,
            sigma: whites.iter().map(|r| r.sigma).fold(0.0, f64::max),
            flicker: 0.0,
        });
        for (run, reading) in readings.iter().filter(|(run, _)| levels.step_of(**run) % 2 == 1) {
            let around = run.checked_sub(1).and_then(|b| readings.get(&b)).zip(readings.get(&(run + 1)));
            let Some((before, after)) = around else { continue };
            let reference = 0.5 * (before.level + after.level);
            if (before.level - after.level).abs() > MOST_DRIFT * (reference - ambient).abs() {
                return Err(format!(
                    "full white changed by {:.1} % within {:.1} s: do not move or shade the sensor, let the projector \
                     warm up, and switch off whatever adapts its light",
                    100.0 * (before.level - after.level).abs() / (reference - ambient).abs(),
                    2.0 * levels.hold_s()
                ));
            }
            // Ambient light has no part in the projector's drift.
            let scale = (white.level - ambient) / (reference - ambient);
            let level = ambient + (reading.level - ambient) * scale;
            let step = levels.steps[levels.step_of(*run)];
            self.of.insert(step.code, (step.what, Steady { level, ..*reading }));
        }
        Ok(())
    }

    /// Levels that were read.
    pub fn count(&self) -> usize {
        self.of.len()
    }

    /// Curves and brightness of the channels of `levels`, all of which must have been read.
    ///
    /// # Errors
    /// What the readings lack, or why they are no levels of a projector; one sentence with what to do.
    pub fn solve(&self, levels: &Levels, room: LampLight) -> Result<Channels, String> {
        let missed = levels.levels().filter(|s| !self.of.contains_key(&s.code)).count();
        let Some(white) = self.white.filter(|_| missed == 0) else {
            return Err(format!(
                "{missed} of {} levels were not seen whole: frames were dark or samples were lost; look at `dpm \
                 link-test`, at the limits of light, and at the sensor's cable",
                levels.count()
            ));
        };
        let mut session = ResponseSession::new(levels.channels);
        let all = [(Next::Ambient, room.ambient), (Next::White, white)];
        for (what, reading) in all.iter().chain(self.of.values()) {
            session.add(*what, *reading).map_err(|e| e.to_string())?;
        }
        session.solve().map_err(|e| e.to_string())
    }
}

/// The mean level of each lit frame that was sampled whole, by run. Planes come and go far faster than lamps flicker, so
/// whole frames only are looked at.
fn by_run(levels: &Levels, showing: &Showing, samples: &[TimedBlock]) -> BTreeMap<u64, Vec<SampleBlock>> {
    let timing = &showing.timing;
    let margin_s = match levels.field {
        LevelField::Full(_) => MARGIN_S,
        LevelField::Tiles { .. } => TILES_MARGIN_S,
    };
    let margin = (margin_s * levels.rate.hz()).ceil().max(2.0) as u64;
    let is_inside = |slot: &u64| {
        let in_run = (margin..levels.hold.saturating_sub(margin)).contains(&(slot % levels.hold));
        // A frame that came late may show the level before.
        in_run && levels.run_of(showing.made_for(*slot)) == levels.run_of(*slot)
    };
    // Slot by slot, the time that was sampled and the integral of the level over it, in frames.
    let mut sums: BTreeMap<u64, (f64, f64)> =
        showing.fresh().filter(is_inside).map(|s| (s, (0.0, 0.0))).collect();
    for TimedBlock { block, sensor_minus_host_ns } in samples {
        let Some(offset) = sensor_minus_host_ns else { continue };
        let since = block.start_ns.saturating_sub(*offset).saturating_sub(timing.frame_zero_ns) as f64;
        let length = block.interval_ns / timing.frame_ns;
        // A sample stands for the time around it.
        for (i, level) in block.levels.iter().enumerate() {
            let from = since / timing.frame_ns + (i as f64 - 0.5) * length;
            if !(from >= 0.0 && length > 0.0 && length < 1.0) {
                continue;
            }
            let slot = from.floor() as u64;
            let beyond = (from + length - (slot + 1) as f64).max(0.0);
            for (slot, part) in [(slot, length - beyond), (slot + 1, beyond)] {
                if let Some(sum) = sums.get_mut(&slot).filter(|_| part > 0.0) {
                    *sum = (sum.0 + part, sum.1 + part * f64::from(*level));
                }
            }
        }
    }
    let mut runs: BTreeMap<u64, Vec<SampleBlock>> = BTreeMap::new();
    for (slot, (time, integral)) in sums.into_iter().filter(|(_, (time, _))| *time >= LEAST_SAMPLED) {
        let start_ns = timing.instant(slot, 0.0).0;
        let block =
            SampleBlock { start_ns, interval_ns: timing.frame_ns, levels: vec![(integral / time) as f32] };
        runs.entry(levels.run_of(slot)).or_default().push(block);
    }
    runs
}

#[cfg(test)]
#[path = "levels_tests.rs"]
mod tests;
