//! A tracked wand with a photodiode at its tip in the beam of the mock projector: from the planes that are shown, and
//! when, to the levels that its converter samples.
//!
//! The wand's motion, its tip, the projector's place and lens are true and known only here. [`SensorWand`] has no clock
//! and no I/O: light and time are arguments, so it also runs at virtual time inside a test. [`mod@line`] serves it on a
//! serial port.

mod aperture;
pub mod line;
mod optics;

use crate::hand::Hand;
use crate::motion::Motion;
use crate::projector::Shown;
use aperture::Aperture;
use dpm_device::planes::{Channel, PlaneSpec, Raster};
use dpm_device::pose::Pose;
use dpm_device::rng::Draws;
use dpm_device::sensor::wire::LevelBits;
use dpm_device::time::HostTime;
pub use optics::ProjectorOptics;
use optics::{dot, length, minus, place, rotate};
use std::sync::Arc;

/// The wand, its sensor, and what disturbs it.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorWandConfig {
    /// Seed of noise and obstruction.
    pub seed: u64,
    /// The projector whose light it sees.
    pub optics: ProjectorOptics,
    /// The sensor in the space of the tracked body, metres.
    pub tip_m: [f64; 3],
    /// The direction in which it looks, in the same space.
    pub looks: [f64; 3],
    /// Diameter of its aperture, metres, above 0 and at most 0.1.
    pub aperture_m: f64,
    /// Frequency at which its amplifier has lost half of the power, hertz, 100 to 1e8.
    pub bandwidth_hz: f64,
    /// Samples a second by its own clock, 1 to 10,000,000; a divisor of `ticks_per_second`.
    pub samples_per_second: u32,
    /// Rate of its clock.
    pub ticks_per_second: u32,
    /// How much faster its clock runs than it says, parts per million, within 1000.
    pub clock_ppm: f64,
    /// Its clock at instant 0.
    pub start_ticks: u64,
    /// Bits of its levels.
    pub bits: LevelBits,
    /// Share of the converter's range for a fully lit plane of full white at 1 m, looked at straight on.
    pub responsivity: f64,
    /// Its sensitivity to red, green and blue as shares of that to white; they add up to 1.
    pub colours: [f64; 3],
    /// Share of the converter's range for the light of the room.
    pub ambient: f64,
    /// Amplitude of the flicker of the room's light as a share of it.
    pub flicker: f64,
    /// Its frequency, hertz.
    pub flicker_hz: f64,
    /// Standard deviation of a sample as a share of the converter's range.
    pub noise: f64,
    /// The projector shows the code value of each pixel for the whole frame, as a display does, in place of its planes one
    /// after the other.
    pub is_held: bool,
    /// Light of a dark mirror as a share of that of a lit one.
    pub leak: f64,
    /// Share of its light that the LED loses in planes of bit 7, as LEDs do at high currents; planes of lower bits lose
    /// half as much for each bit.
    pub droop: f64,
    /// How much darker the picture is at its corners, as a share: the loss grows with the square of the distance from the
    /// centre.
    pub vignetting: f64,
    /// Share of the time in which something stands in the beam.
    pub obstructed: f64,
    /// How long it stands there, nanoseconds, above 0.
    pub obstruction_ns: i64,
}

impl SensorWandConfig {
    /// A sensor of 3 mm and 100,000 samples a second, 0.12 m from the body's origin, in a lit room. Planes of
    /// [`dpm_device::planes::PlaneSchedule::equal24`] fill a third of its range at 1 m. Noise is one hundredth of that.
    pub fn new(optics: ProjectorOptics) -> Self {
        Self {
            seed: 1,
            optics,
            tip_m: [0.0, 0.0, 0.12],
            looks: [0.0, 0.0, 1.0],
            aperture_m: 0.003,
            bandwidth_hz: 150e3,
            samples_per_second: 100_000,
            ticks_per_second: 1_000_000,
            clock_ppm: 20.0,
            start_ticks: 1_000,
            bits: LevelBits::Twelve,
            responsivity: 0.33 * 255.0 / 8.0,
            colours: [0.35, 0.4, 0.25],
            ambient: 0.05,
            flicker: 0.3,
            flicker_hz: 100.0,
            noise: 0.0033,
            is_held: false,
            leak: 0.001,
            droop: 0.0,
            vignetting: 0.15,
            obstructed: 0.0,
            obstruction_ns: 40_000_000,
        }
    }
}

/// A setting of the wand that makes no sense.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("sensor wand: `{field}` is {value}; it must be {rule}")]
pub struct SensorWandError {
    /// Field of [`SensorWandConfig`].
    pub field: &'static str,
    /// Its value.
    pub value: f64,
    /// Its range.
    pub rule: &'static str,
}

/// A sample of the converter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SensorSample {
    /// Counts the samples since instant 0.
    pub number: u64,
    /// The sensor's clock when it was taken.
    pub ticks: u64,
    /// Its level.
    pub level: u16,
}

/// The wand and its sensor.
#[derive(Clone, Debug)]
pub struct SensorWand {
    scene: Scene,
    converter: Converter,
}

/// What does not change while it samples.
#[derive(Clone, Debug)]
struct Scene {
    config: SensorWandConfig,
    motion: Motion,
    /// What moves the wand in place of `motion`.
    hand: Option<Arc<Hand>>,
    raster: Raster,
    draws: Draws,
}

/// Amplifier and converter.
#[derive(Clone, Debug)]
struct Converter {
    gain: f64,
    /// The next sample's number.
    next: u64,
    /// Output of the amplifier, and the true time for which it holds, nanoseconds.
    signal: f64,
    at_ns: f64,
}

impl SensorWand {
    /// A wand that moves by `motion` in the beam of a projector of `raster`.
    ///
    /// # Errors
    /// A setting is out of its range.
    pub fn new(config: SensorWandConfig, motion: Motion, raster: Raster) -> Result<Self, SensorWandError> {
        let c = &config;
        let within = |field, value: f64, from: f64, to: f64, rule| {
            if (from..=to).contains(&value) {
                Ok(())
            } else {
                Err(SensorWandError { field, value, rule })
            }
        };
        within("aperture_m", c.aperture_m, 1e-6, 0.1, "above 0 and at most 0.1 m")?;
        within("bandwidth_hz", c.bandwidth_hz, 100.0, 1e8, "100 to 1e8 Hz")?;
        within("samples_per_second", c.samples_per_second.into(), 1.0, 1e7, "1 to 10,000,000")?;
        within("clock_ppm", c.clock_ppm, -1000.0, 1000.0, "within 1000 ppm")?;
        within("responsivity", c.responsivity, 0.0, 1e6, "0 to 1e6")?;
        within("obstruction_ns", c.obstruction_ns as f64, 1.0, 1e15, "above 0")?;
        for (field, value) in [
            ("ambient", c.ambient),
            ("flicker", c.flicker),
            ("noise", c.noise),
            ("leak", c.leak),
            ("droop", c.droop),
            ("vignetting", c.vignetting),
            ("obstructed", c.obstructed),
        ] {
            within(field, value, 0.0, 1.0, "0 to 1")?;
        }
        within("flicker_hz", c.flicker_hz, 0.0, 1e6, "0 to 1e6 Hz")?;
        within("looks", length(c.looks), 1e-9, 1e9, "a direction")?;
        within("tip_m", length(c.tip_m), 0.0, 10.0, "within 10 m")?;
        if c.ticks_per_second == 0 || !c.ticks_per_second.is_multiple_of(c.samples_per_second) {
            let rule = "a multiple of samples_per_second";
            return Err(SensorWandError {
                field: "ticks_per_second",
                value: c.ticks_per_second.into(),
                rule,
            });
        }
        let draws = Draws::new(config.seed).stream(0x7761_6e64);
        let converter = Converter { gain: 1.0, next: 0, signal: 0.0, at_ns: 0.0 };
        Ok(Self { scene: Scene { config, motion, hand: None, raster, draws }, converter })
    }

    /// Puts the wand into a hand, which moves it in place of its motion.
    pub fn held_by(mut self, hand: Arc<Hand>) -> Self {
        self.scene.hand = Some(hand);
        self
    }

    /// The settings.
    pub fn config(&self) -> &SensorWandConfig {
        &self.scene.config
    }

    /// Ticks from sample to sample.
    pub fn period_ticks(&self) -> u32 {
        self.scene.period_ticks()
    }

    /// Sets the amplification, 1 at the beginning.
    pub fn set_gain(&mut self, gain: f64) {
        self.converter.gain = gain.clamp(0.0, 1e6);
    }

    /// The sensor's clock at a true instant.
    pub fn ticks_at(&self, now: HostTime) -> u64 {
        let ticks = now.0.max(0) as f64 * self.scene.ticks_per_ns();
        self.scene.config.start_ticks.wrapping_add(ticks as u64)
    }

    /// True instant of sample `number`, nanoseconds.
    pub fn sampled_at_ns(&self, number: u64) -> f64 {
        self.scene.sampled_at_ns(number)
    }

    /// Where the sensor truly is at an instant.
    pub fn sensor_at(&self, t_ns: i64) -> [f64; 3] {
        place(&self.scene.pose_at(t_ns), self.scene.config.tip_m)
    }

    /// The place on the raster whose light truly hits the sensor at an instant; `None` outside the lens's view.
    pub fn pixel_at(&self, t_ns: i64) -> Option<[f64; 2]> {
        self.scene.config.optics.pixel_of(self.sensor_at(t_ns))
    }

    /// Samples without light of the projector, up to `until`.
    pub fn dark(&mut self, until: HostTime, sink: &mut dyn FnMut(SensorSample)) {
        self.converter.advance(&self.scene, until.0 as f64, &mut |_| 0.0, sink);
    }

    /// Samples of a lit slot; between the last one and this it was dark.
    pub fn shine(&mut self, shown: &Shown, sink: &mut dyn FnMut(SensorSample)) {
        self.dark(shown.event.first_photon_at, sink);
        let (from, end) = (shown.event.first_photon_at.0, shown.planes_end_at.0);
        let specs = shown.schedule.planes();
        let plane_bytes = self.scene.raster.plane_bytes();
        if end <= from || shown.planes.len() != plane_bytes * specs.len() {
            return;
        }
        let planes: Vec<(PlaneSpec, &[u8])> =
            specs.iter().copied().zip(shown.planes.chunks_exact(plane_bytes)).collect();
        let last = (shown.event.last_photon_at.0 as f64).min(end as f64);
        let mut seen = Aperture::default();
        // All planes at once for the whole frame, or each for its share of it.
        let at_once = if self.scene.config.is_held { planes.len() } else { 1 };
        let share = if self.scene.config.is_held { 1.0 / planes.len() as f64 } else { 1.0 };
        let steps = planes.len() / at_once.max(1);
        let step_ns = (end - from) as f64 / steps.max(1) as f64;
        for (k, lit) in planes.chunks(at_once.max(1)).enumerate() {
            let until = (from as f64 + (k + 1) as f64 * step_ns).min(last);
            let mut light = |t_ns: f64| share * self.scene.projected(lit, t_ns as i64, &mut seen);
            self.converter.advance(&self.scene, until, &mut light, sink);
        }
    }
}

impl Converter {
    /// Lets time pass to `until_ns` with the projector's light `light` at each instant, and takes the samples that are
    /// due.
    fn advance(
        &mut self,
        scene: &Scene,
        until_ns: f64,
        light: &mut dyn FnMut(f64) -> f64,
        sink: &mut dyn FnMut(SensorSample),
    ) {
        loop {
            let due_ns = scene.sampled_at_ns(self.next);
            let is_due = due_ns <= until_ns;
            self.settle(&scene.config, if is_due { due_ns } else { until_ns }, light);
            if !is_due {
                return;
            }
            let number = self.next;
            self.next += 1;
            let noise = scene.config.noise * scene.draws.stream(1).normal(number);
            let highest = f64::from(scene.config.bits.highest());
            let level = ((self.gain * self.signal + noise) * highest).round().clamp(0.0, highest) as u16;
            let ticks = number.wrapping_mul(u64::from(scene.period_ticks()));
            sink(SensorSample { number, ticks: scene.config.start_ticks.wrapping_add(ticks), level });
        }
    }

    /// The amplifier follows the light with one time constant until `until_ns`.
    fn settle(&mut self, c: &SensorWandConfig, until_ns: f64, light: &mut dyn FnMut(f64) -> f64) {
        let span_ns = until_ns - self.at_ns;
        if span_ns <= 0.0 {
            return;
        }
        let middle_ns = self.at_ns + span_ns / 2.0;
        let turn = std::f64::consts::TAU * c.flicker_hz * middle_ns * 1e-9;
        let room = c.ambient * (1.0 + c.flicker * libm::sin(turn));
        let target = room + light(middle_ns);
        let constant_ns = 1e9 / (std::f64::consts::TAU * c.bandwidth_hz);
        self.signal = target + (self.signal - target) * libm::exp(-span_ns / constant_ns);
        self.at_ns = until_ns;
    }
}

impl Scene {
    fn pose_at(&self, t_ns: i64) -> Pose {
        self.hand.as_ref().map_or_else(|| self.motion.pose_at(t_ns), |hand| hand.pose_at(t_ns))
    }

    fn period_ticks(&self) -> u32 {
        self.config.ticks_per_second / self.config.samples_per_second
    }

    fn ticks_per_ns(&self) -> f64 {
        f64::from(self.config.ticks_per_second) * 1e-9 * (1.0 + self.config.clock_ppm * 1e-6)
    }

    fn sampled_at_ns(&self, number: u64) -> f64 {
        number as f64 * f64::from(self.period_ticks()) / self.ticks_per_ns()
    }

    /// The light of planes that are shown at once on the sensor at an instant, as a share of the converter's range.
    fn projected(&self, planes: &[(PlaneSpec, &[u8])], t_ns: i64, seen: &mut Aperture) -> f64 {
        let (c, raster) = (&self.config, self.raster);
        let index = t_ns.max(0) / c.obstruction_ns;
        if self.draws.stream(2).happens(index as u64, c.obstructed) {
            return 0.0;
        }
        let pose = self.pose_at(t_ns);
        let sensor = place(&pose, c.tip_m);
        let Some(pixel) = c.optics.pixel_of(sensor) else { return 0.0 };
        let towards = minus(c.optics.pose.position_m, sensor);
        let distance = length(towards);
        let looks = rotate(pose.rotation_xyzw, c.looks);
        let facing = dot(looks, towards) / (length(looks) * distance);
        if facing <= 0.0 {
            return 0.0;
        }
        let depth = -c.optics.inward(sensor)[2];
        seen.look(raster, pixel, c.aperture_m / 2.0 * c.optics.focal_px[0] / depth);
        let light = |(spec, plane): &(PlaneSpec, &[u8])| {
            let lit = seen.lit(plane);
            let colour = match spec.channel {
                Channel::White => 1.0,
                channel => c.colours[channel as usize],
            };
            let current = f64::from(1u32 << spec.bit);
            let led = colour * current / 255.0 * (1.0 - c.droop * current / 128.0);
            led * (lit + c.leak * (1.0 - lit))
        };
        let light: f64 = planes.iter().map(light).sum();
        let off_x = pixel[0] / f64::from(raster.width()) - 0.5;
        let off_y = pixel[1] / f64::from(raster.height()) - 0.5;
        let flat = (1.0 - c.vignetting * 2.0 * (off_x * off_x + off_y * off_y)).max(0.0);
        c.responsivity * light * flat * facing / (distance * distance)
    }
}

#[cfg(test)]
mod tests;
