//! `dpm calibrate projector --sensor`: the wand's light sensor is moved through coded planes while everything is recorded;
//! lens, pose, tip and latency are solved afterwards.

use super::dialogue::Dialogue;
use super::poses::Poses;
use super::results::Results;
use dpm_calibration::file::{LatencySection, ProjectorSection, WandSection};
use dpm_calibration::projector::{Known, Priors, Volume};
use dpm_calibration::sensor::{decode, solve, Block, Code, Settings, Solution, Timing, PLANES};
use dpm_calibration::trajectory::{Stamped, Trajectory};
use dpm_common::clock::{Clock, MonotonicClock};
use dpm_device::planes::PlaneSchedule;
use dpm_device::sensor::client::{SensorClient, SensorConfig};
use dpm_device::sensor::wire::PERIOD_ONE;
use dpm_device::time::HostTime;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pack::source::{Canvas, PatternSource};
use dpm_rig::pattern::run_pattern_stamped;
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunMonitor};
use glam::DVec3;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Time between two polls of the sensor, nanoseconds.
const POLL_EVERY_NS: i64 = 1_000_000;
/// Samples in a block.
const BLOCK: u16 = 250;
/// Most samples that are kept: ten minutes at 100 kS/s.
const MOST_SAMPLES: usize = 60_000_000;
/// How long the projector and the sensor may take until both work.
const READY_WITHIN: Duration = Duration::from_secs(10);
/// Slots whose light falls later than the others say by more than this, nanoseconds, are left out of the timing.
const LATE_NS: f64 = 100_000.0;

/// Shows the sensor's code. Only the bit of identity differs from frame to frame, so there are two pictures.
struct CodeSource(Code);

impl PatternSource for CodeSource {
    fn picture(&self, _: u64, slot: u64) -> u64 {
        u64::from(self.0.identity(slot))
    }

    fn schedule(&self) -> Option<PlaneSchedule> {
        Some(PlaneSchedule::equal24())
    }

    fn draw(&self, picture: u64, canvas: &mut Canvas<'_>) {
        let raster = canvas.raster();
        // Any frame with this bit of identity.
        let frame = (0..64).find(|f| u64::from(self.0.identity(*f)) == picture).unwrap_or(0);
        let (row_bytes, plane_bytes) = (raster.row_bytes(), raster.plane_bytes());
        let bytes = canvas.planes().bytes_mut();
        for (plane, bytes) in bytes.chunks_exact_mut(plane_bytes).take(PLANES).enumerate() {
            for (y, row) in (0..).zip(bytes.chunks_exact_mut(row_bytes)) {
                row.fill(0);
                for x in (0..raster.width()).filter(|x| self.0.lit(frame, plane, *x, y)) {
                    row[x as usize / 8] |= 0x80 >> (x % 8);
                }
            }
        }
    }
}

/// What is measured with.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Serial port of the sensor.
    pub port: String,
    /// Bits per second of the port.
    pub baud: u32,
    /// Name of the wand in the tracking software.
    pub wand: String,
    /// Seconds of motion.
    pub seconds: f64,
    /// Diameter of the sensor's aperture, metres.
    pub aperture_m: f64,
    /// What is known of the projector's place.
    pub known: Known,
}

/// A sensor that is read by a thread of its own until this is dropped.
struct Recorder {
    shared: Arc<Mutex<Recorded>>,
    is_over: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

#[derive(Default)]
struct Recorded {
    blocks: Vec<Block>,
    samples: usize,
    /// The sensor's clock less the host's, nanoseconds, once it is known.
    sensor_minus_host_ns: Option<i64>,
    saturated: usize,
    status: String,
}

impl Recorder {
    fn start(setup: &Setup, clock: MonotonicClock) -> Result<Self, Failure> {
        let config = SensorConfig {
            port: setup.port.clone(),
            baud: setup.baud,
            gain: 0,
            block: BLOCK,
            samples_per_second: 0,
        };
        let sleeping = clock.sleeping();
        let mut client = SensorClient::open(config, Arc::new(move || sleeping.now()))
            .map_err(|e| Failure::new(FailureKind::BadInput, e))?;
        let shared = Arc::new(Mutex::new(Recorded::default()));
        let (to, is_over) = (Arc::clone(&shared), Arc::new(AtomicBool::new(false)));
        let over = Arc::clone(&is_over);
        let work = move || {
            let mut fresh = Vec::new();
            while !over.load(Ordering::Relaxed) {
                let now = sleeping.now();
                client.poll(now, &mut |block| {
                    fresh.push((block.head, block.levels.iter().map(f32::from).collect()))
                });
                let tick_ns = client.hello().map_or(0.0, |h| 1e9 / f64::from(h.ticks_per_second.max(1)));
                let mut shared = to.lock().unwrap_or_else(PoisonError::into_inner);
                for (head, levels) in fresh.drain(..) {
                    let levels: Vec<f32> = levels;
                    let start_ns = (head.first as f64 * tick_ns) as i64;
                    if let Some(at) = client.sampled_at(&head, 0) {
                        shared.sensor_minus_host_ns = Some(start_ns - at.at.0);
                    }
                    shared.saturated += usize::from(head.cut_above);
                    if shared.samples < MOST_SAMPLES {
                        shared.samples += levels.len();
                        let interval_ns = f64::from(head.period) / f64::from(PERIOD_ONE) * tick_ns;
                        shared.blocks.push(Block { start_ns, interval_ns, levels });
                    }
                }
                shared.status = client.status();
                drop(shared);
                sleeping.wait_until(now.plus_ns(POLL_EVERY_NS));
            }
        };
        let thread = std::thread::Builder::new()
            .name("dpm-sensor".into())
            .spawn(work)
            .map_err(|e| Failure::new(FailureKind::Device, format!("cannot start a thread: {e}")))?;
        Ok(Self { shared, is_over, thread: Some(thread) })
    }

    fn locked(&self) -> std::sync::MutexGuard<'_, Recorded> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Everything that was recorded while the wand moved.
struct Recording {
    blocks: Vec<Block>,
    sensor_minus_host_ns: i64,
    poses: Vec<Stamped>,
    lights: Vec<(u64, HostTime)>,
}

/// Shows the code, records, and solves. `tip` comes from `dpm calibrate wand`.
///
/// # Errors
/// A device fails (exit code 3), or what was recorded does not determine the projector (2, with what to do).
pub fn calibrate(
    config: &RigConfig,
    setup: &Setup,
    (tip, tip_sigma_m): (DVec3, f64),
    monitor: &Arc<RunMonitor>,
) -> Result<Solution, Failure> {
    let refused = |e: &dyn std::fmt::Display| Failure::new(FailureKind::BadInput, e.to_string());
    let raster = config.projector.raster();
    let code = Code::new(raster).map_err(|e| refused(&e))?;
    let recording = record(config, setup, &code, monitor)?;
    let timing = timing_of(&recording.lights)?;
    let decoded =
        decode(&code, &timing, &recording.blocks, recording.sensor_minus_host_ns).map_err(|e| refused(&e))?;
    let path = Trajectory::new(&recording.poses);
    let tips = recording.poses.iter().map(|p| p.place(tip));
    let volume = Volume::around(tips).ok_or_else(|| refused(&"the wand was not tracked"))?;
    let settings = Settings {
        timing,
        tip,
        tip_sigma_m,
        aperture_m: setup.aperture_m,
        priors: Priors::many_points(raster),
        known: setup.known,
        volume,
        seed: 1,
    };
    solve(&code, &decoded, &path, &settings).map_err(|e| refused(&e))
}

fn record(
    config: &RigConfig,
    setup: &Setup,
    code: &Code,
    monitor: &Arc<RunMonitor>,
) -> Result<Recording, Failure> {
    let clock = MonotonicClock::new(0);
    let stopped = Arc::clone(monitor);
    let dialogue = Dialogue::start(move || stopped.stop_requested())?;
    let poses = Poses::start(config, std::slice::from_ref(&setup.wand), clock)?;
    let recorder = Recorder::start(setup, clock)?;
    poses.wait_until_seen()?;
    let frames = (config.projector.frame_rate.hz() * (setup.seconds + 60.0)) as usize;
    let source = Arc::new(CodeSource(code.clone()));
    std::thread::scope(|scope| {
        let runs = scope.spawn(|| run_pattern_stamped(config, source, (clock, frames), monitor));
        let moved = (|| {
            wait_until_ready(monitor, &recorder)?;
            dialogue.tell(&format!(
                "Move the wand through the whole beam for {:.0} s, sensor towards the projector, near and far, at 0.2 to 0.8 m/s,\n\
                 and turn it a little all the time.",
                setup.seconds
            ));
            dialogue.ask("Press Enter to begin.")?;
            poses.take();
            take_blocks(&recorder);
            let (begin, mut told) = (Instant::now(), 0);
            let mut path = Vec::new();
            while begin.elapsed().as_secs_f64() < setup.seconds && !monitor.stop_requested() {
                std::thread::sleep(Duration::from_millis(50));
                path.extend(poses.take().into_iter().flatten());
                let second = begin.elapsed().as_secs() / 5;
                if second > told {
                    told = second;
                    let shared = recorder.locked();
                    let (samples, clipped) = (shared.samples, shared.saturated);
                    dialogue.tell(&format!(
                        "{:3} s: {samples} samples, {} poses{}",
                        5 * second,
                        path.len(),
                        match clipped {
                            0 => String::new(),
                            n => format!("; {n} blocks are saturated: turn the sensor's gain down"),
                        }
                    ));
                }
            }
            let blocks = take_blocks(&recorder);
            let shared = recorder.locked();
            let sensor_minus_host_ns = shared.sensor_minus_host_ns.ok_or_else(|| {
                Failure::new(
                    FailureKind::Device,
                    format!("the sensor's clock was never mapped: {}", shared.status),
                )
            })?;
            Ok((blocks, sensor_minus_host_ns, path))
        })();
        monitor.request_stop();
        let ended = runs.join().unwrap_or_else(|_| {
            Err(Failure::new(FailureKind::Device, "the projector's thread ended by a panic (see above)"))
        });
        match (moved, ended) {
            (Ok((blocks, sensor_minus_host_ns, poses)), Ok(lights)) => {
                Ok(Recording { blocks, sensor_minus_host_ns, poses, lights })
            }
            (_, Err(failure)) | (Err(failure), _) => Err(failure),
        }
    })
}

fn take_blocks(recorder: &Recorder) -> Vec<Block> {
    let mut shared = recorder.locked();
    shared.samples = 0;
    std::mem::take(&mut shared.blocks)
}

/// Waits until the projector is up and the sensor's clock is mapped.
fn wait_until_ready(monitor: &RunMonitor, recorder: &Recorder) -> Result<(), Failure> {
    let begin = Instant::now();
    loop {
        let is_up = monitor.projector() == ProjectorHealth::Up;
        let shared = recorder.locked();
        if is_up && shared.sensor_minus_host_ns.is_some() {
            return Ok(());
        }
        if begin.elapsed() > READY_WITHIN || monitor.stop_requested() {
            let told = match is_up {
                true => format!("the light sensor does not answer: {}", shared.status),
                false => format!("the projector is not up: {}", monitor.projector()),
            };
            return Err(Failure::new(FailureKind::Device, told));
        }
        drop(shared);
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// When the slots begin, by a line through the first photons of all lit frames. Frames whose light came late are left out.
fn timing_of(lights: &[(u64, HostTime)]) -> Result<Timing, Failure> {
    let few = || {
        let told = format!(
            "only {} frames were lit; is the link fast enough? `dpm link-test` measures it",
            lights.len()
        );
        Failure::new(FailureKind::Device, told)
    };
    let mut used: Vec<(f64, f64)> = Vec::with_capacity(lights.len());
    let Some(&(slot_0, at_0)) = lights.first() else { return Err(few()) };
    used.extend(lights.iter().map(|(slot, at)| (*slot as f64 - slot_0 as f64, at.ns_since(at_0) as f64)));
    let mut line = (0.0, 0.0);
    for _ in 0..3 {
        if used.len() < 100 {
            return Err(few());
        }
        line = line_through(&used);
        used.retain(|(x, y)| (y - line.0 - line.1 * x).abs() < LATE_NS);
    }
    let frame_zero_ns = at_0.0 + (line.0 - line.1 * slot_0 as f64).round() as i64;
    Ok(Timing { frame_zero_ns, frame_ns: line.1 })
}

/// Offset and slope by least squares.
fn line_through(points: &[(f64, f64)]) -> (f64, f64) {
    let n = points.len() as f64;
    let (mx, my) = points.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + x / n, b + y / n));
    let (mut xx, mut xy) = (0.0, 0.0);
    for (x, y) in points {
        xx += (x - mx) * (x - mx);
        xy += (x - mx) * (y - my);
    }
    let slope = if xx > 0.0 { xy / xx } else { 0.0 };
    (my - slope * mx, slope)
}

/// What the operator is told of a solution.
pub fn told_of(s: &Solution) -> String {
    let (p, [x, y, z]) = (&s.predicted, s.tip.to_array().map(|v| 1e3 * v));
    format!(
        "predicted error {:.3} px (99th percentile over the volume of the motion, for a tracker without bias), largest {:.3} px;\n\
         residual {:.3} px rms of {} frames; sensor at ({x:.2}, {y:.2}, {z:.2}) mm in the wand's body;\n\
         latency {:.3} ms, known to {:.3} ms",
        p.p99_px,
        p.worst_px,
        s.rms_px,
        s.frames,
        1e-6 * s.latency_ns as f64,
        1e-6 * s.latency_sigma_ns
    )
}

/// Puts a solution into the results: projector, tip and latency.
pub fn keep(results: &mut Results, config: &RigConfig, wand: &str, s: &Solution) {
    let data = format!("{} frames of a light sensor on \"{wand}\"", s.frames);
    let of = |device: &str| {
        results.provenance(
            config,
            device,
            data.clone(),
            "levels of coded planes, plane by plane, by least squares",
        )
    };
    let (projector, tip, latency) = (of(""), of(wand), of(""));
    let raster = config.projector.raster();
    let section = ProjectorSection::new(raster, &s.model, s.predicted.p99_px, s.rms_px, projector);
    let variance = s.tip_covariance.x_axis.x + s.tip_covariance.y_axis.y + s.tip_covariance.z_axis.z;
    results.file.projector = Some(section);
    results.file.wand =
        Some(WandSection { tip: s.tip.to_array(), tip_sigma_m: variance.sqrt(), provenance: tip });
    results.file.latency = Some(LatencySection {
        latency_us: 1e-3 * s.latency_ns as f64,
        sigma_us: 1e-3 * s.latency_sigma_ns,
        provenance: latency,
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::Raster;
    use dpm_render::pack::{BitPlaneFrame, Kernel};
    use dpm_rig::pack::source::PatternPainter;

    #[test]
    fn the_planes_are_those_of_the_code() {
        let raster = Raster::new(100, 60).unwrap();
        let code = Code::new(raster).unwrap();
        let source = Arc::new(CodeSource(code.clone()));
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
    fn timing_is_the_line_of_the_frames_that_came_in_time() {
        let frame_ns = 1_055_966.2;
        let at = |slot: u64| HostTime(5_000_000_000 + (slot as f64 * frame_ns) as i64);
        let mut lights: Vec<(u64, HostTime)> =
            (1000..9000).filter(|s| s % 7 != 0).map(|s| (s, at(s))).collect();
        lights[100].1 = lights[100].1.plus_ns(900_000);
        let timing = timing_of(&lights).unwrap();
        assert!((timing.frame_ns - frame_ns).abs() < 1e-3, "{}", timing.frame_ns);
        assert!((timing.instant(5000, 0.0).0 - at(5000).0).abs() < 300);
        assert!(timing_of(&lights[..50]).is_err());
    }
}
