//! `dpm calibrate projector --sensor`: the wand's light sensor is moved through coded planes while everything is recorded;
//! lens, pose, tip and latency are solved afterwards.

use super::dialogue::Dialogue;
use super::pace::{Pace, Paced};
use super::poses::Poses;
use super::recorder::{wait_until_up, while_stamped, Port, Recorder};
use super::results::Results;
use super::showing::Showing;
use dpm_calibration::file::{LatencySection, ProjectorSection, WandSection};
use dpm_calibration::model::ProjectorModel;
use dpm_calibration::pivot::trace;
use dpm_calibration::projector::{Known, Priors, Volume};
use dpm_calibration::sensor::{
    decode, solve, solve_latency, Block, Code, Coverage, Decoded, Latency, Settings, Solution, PLANES,
};
use dpm_calibration::trajectory::{Stamped, Trajectory};
use dpm_common::clock::MonotonicClock;
use dpm_device::planes::PlaneSchedule;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pack::source::{Canvas, PatternSource};
use dpm_rig::telemetry::monitor::RunMonitor;
use glam::DVec3;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Shows the sensor's code. Only the bit of identity differs from frame to frame, so there are two pictures; they are drawn
/// before there is light, since drawing takes longer than a frame.
struct CodeSource {
    code: Code,
    pictures: [Box<[u8]>; 2],
}

impl CodeSource {
    fn new(code: Code) -> Self {
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

/// What is measured with.
#[derive(Clone, Debug)]
pub struct Setup {
    /// The sensor.
    pub port: Port,
    /// Name of the wand in the tracking software.
    pub wand: String,
    /// Seconds of motion.
    pub seconds: f64,
    /// Diameter of the sensor's aperture, metres.
    pub aperture_m: f64,
    /// What is known of the projector's place.
    pub known: Known,
    /// Frames a second of the rig file: at a lower rate the motion takes longer.
    pub rate_hz: f64,
    /// The operator has begun to move: what is repeated at another rate is not asked for again.
    pub has_begun: Arc<AtomicBool>,
}

/// Everything that was recorded while the wand moved.
struct Recording {
    blocks: Vec<Block>,
    sensor_minus_host_ns: i64,
    poses: Vec<Stamped>,
}

/// Frames of a sweep that are worth solving: fewer tell the projector badly, however long they took.
const FRAMES: f64 = 1200.0;

/// What was recorded, ready for a solver.
struct Sweep {
    code: Code,
    decoded: Decoded,
    path: Trajectory,
    settings: Settings,
}

/// Shows the code, records, and solves. `tip` comes from `dpm calibrate wand`.
///
/// # Errors
/// A device fails (exit code 3), or what was recorded does not determine the projector (2, with what to do).
pub fn calibrate(
    config: &RigConfig,
    setup: &Setup,
    tip: (DVec3, f64),
    monitor: &Arc<RunMonitor>,
) -> Result<Paced<Solution>, Failure> {
    sweep(config, setup, tip, monitor)?
        .and_then(|s| solve(&s.code, &s.decoded, &s.path, &s.settings).map_err(refused))
}

/// Shows the code, records, and finds the latency of the projector `model`, which is known.
///
/// # Errors
/// As [`calibrate`].
pub fn latency(
    config: &RigConfig,
    setup: &Setup,
    tip: (DVec3, f64),
    model: &ProjectorModel,
    monitor: &Arc<RunMonitor>,
) -> Result<Paced<Latency>, Failure> {
    sweep(config, setup, tip, monitor)?
        .and_then(|s| solve_latency(&s.code, &s.decoded, &s.path, &s.settings, model).map_err(refused))
}

fn refused(error: impl std::fmt::Display) -> Failure {
    Failure::new(FailureKind::BadInput, error.to_string())
}

fn sweep(
    config: &RigConfig,
    setup: &Setup,
    (tip, tip_sigma_m): (DVec3, f64),
    monitor: &Arc<RunMonitor>,
) -> Result<Paced<Sweep>, Failure> {
    let raster = config.projector.raster();
    let code = Code::new(raster).map_err(refused)?;
    record(config, setup, &code, monitor)?.and_then(|(recording, showing)| {
        let (offset_ns, timing) = (recording.sensor_minus_host_ns, showing.timing);
        let shown = |slot| showing.made_for(slot);
        let decoded = decode(&code, &timing, &recording.blocks, offset_ns, &shown).map_err(refused)?;
        let path = Trajectory::new(&recording.poses);
        let tips = recording.poses.iter().map(|p| p.place(tip));
        let volume = Volume::around(tips).ok_or_else(|| refused("the wand was not tracked"))?;
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
        Ok(Sweep { code: code.clone(), decoded, path, settings })
    })
}

fn record(
    config: &RigConfig,
    setup: &Setup,
    code: &Code,
    monitor: &Arc<RunMonitor>,
) -> Result<Paced<(Recording, Showing)>, Failure> {
    let clock = MonotonicClock::new(0);
    let stopped = Arc::clone(monitor);
    let dialogue = Dialogue::start(move || stopped.stop_requested())?;
    let poses = Poses::start(config, std::slice::from_ref(&setup.wand), clock)?;
    let recorder = Recorder::start(&setup.port, clock)?;
    poses.wait_until_seen()?;
    let source = Arc::new(CodeSource::new(code.clone()));
    let rate = config.projector.frame_rate;
    let frames = FRAMES.min(setup.seconds * setup.rate_hz);
    let seconds = setup.seconds.max(frames / rate.hz());
    let moved = || {
        wait_until_up(monitor)?;
        recorder.wait_until_mapped(monitor)?;
        if let Some(carried_hz) = Pace::of(config, monitor).try_out()? {
            return Ok(Paced::TooFast { carried_hz });
        }
        if setup.has_begun.swap(true, Ordering::Relaxed) {
            dialogue.tell(&format!("Go on moving for {seconds:.0} s."));
        } else {
            dialogue.tell(&format!(
                "Move the wand through the whole beam for {seconds:.0} s, sensor towards the projector, near and far, at \
                 0.2 to 0.8 m/s,\nand turn it a little all the time."
            ));
            dialogue.ask("Press Enter to begin.")?;
        }
        poses.take();
        recorder.take();
        let pace = Pace::of(config, monitor);
        let sweeping = Sweeping { poses: &poses, recorder: &recorder, dialogue: &dialogue, code };
        sweeping.follow(seconds, 1e9 / rate.hz(), pace, monitor)?.and_then(|(blocks, poses)| {
            let sensor_minus_host_ns = recorder.sensor_minus_host_ns()?;
            Ok(Recording { blocks, sensor_minus_host_ns, poses })
        })
    };
    let (recording, lights) = while_stamped(config, source, (clock, seconds), monitor, moved)?;
    recording.and_then(|recording| Ok((recording, Showing::of(&lights, rate)?)))
}

/// Samples and poses.
type Collected = (Vec<Block>, Vec<Stamped>);

/// What a sweep goes on with.
struct Sweeping<'a> {
    poses: &'a Poses,
    recorder: &'a Recorder,
    dialogue: &'a Dialogue,
    code: &'a Code,
}

impl Sweeping<'_> {
    /// Collects samples and poses for `seconds`, and says every five how it goes and where to go next.
    fn follow(
        &self,
        seconds: f64,
        frame_ns: f64,
        mut pace: Pace<'_>,
        monitor: &RunMonitor,
    ) -> Result<Paced<Collected>, Failure> {
        let (begin, mut told) = (Instant::now(), 0);
        let (mut path, mut blocks) = (Vec::new(), Vec::new());
        let mut coverage = Coverage::new(self.code.clone());
        while begin.elapsed().as_secs_f64() < seconds {
            if monitor.stop_requested() {
                return Err(refused("the measurement was interrupted; run the same command again"));
            }
            std::thread::sleep(Duration::from_millis(50));
            if let Some(carried_hz) = pace.look()? {
                return Ok(Paced::TooFast { carried_hz });
            }
            path.extend(self.poses.take().into_iter().flatten());
            let fives = begin.elapsed().as_secs() / 5;
            if fives > told {
                told = fives;
                let (_, clipped) = self.recorder.counts();
                let fresh = self.recorder.take();
                let new = blocks.len();
                blocks.extend(fresh.into_iter().map(|timed| timed.block));
                let next = match coverage.add(frame_ns, &blocks[new..]) {
                    _ if clipped > 0 => {
                        format!("{clipped} blocks are saturated: turn the sensor's gain down")
                    }
                    Ok(_) => coverage.advice(),
                    Err(why) => why.to_string(),
                };
                self.dialogue.tell(&format!("{:3} of {seconds:.0} s: {next}", 5 * fives));
            }
        }
        path.extend(self.poses.take().into_iter().flatten());
        blocks.extend(self.recorder.take().into_iter().map(|timed| timed.block));
        Ok(Paced::Done((blocks, path)))
    }
}

/// What the operator is told of a solution.
pub fn told_of(s: &Solution) -> String {
    let (p, [x, y, z]) = (&s.predicted, s.tip.to_array().map(|v| 1e3 * v));
    let at = p.worst;
    format!(
        "predicted error {:.3} px (99th percentile over the volume of the motion, for a tracker without bias);\n\
         it is least certain at ({:.2}, {:.2}, {:.2}) m: to make it better, run this again and move there, too;\n\
         residual {:.3} px rms of {} frames; sensor at ({x:.2}, {y:.2}, {z:.2}) mm in the wand's body;\n\
         latency {:.3} ms, known to {:.3} ms",
        p.p99_px,
        at.x,
        at.y,
        at.z,
        s.rms_px,
        s.frames,
        1e-6 * s.latency_ns as f64,
        1e-6 * s.latency_sigma_ns
    )
}

/// Puts a solution into the results: projector, tip and latency.
pub fn keep(results: &mut Results, config: &RigConfig, (wand, bias_m): (&str, f64), s: &Solution) {
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
    let section = ProjectorSection::new(raster, &s.model, s.predicted.p99_px, s.rms_px, projector)
        .assuming(&s.predicted, bias_m);
    results.file.projector = Some(section);
    results.file.wand = Some(WandSection {
        tip: s.tip.to_array(),
        tip_sigma_m: trace(&s.tip_covariance).sqrt(),
        provenance: tip,
    });
    results.file.latency = Some(LatencySection {
        latency_us: 1e-3 * s.latency_ns as f64,
        sigma_us: 1e-3 * s.latency_sigma_ns,
        provenance: latency,
    });
}

/// What the operator is told of a latency.
pub fn told_of_latency(l: &Latency) -> String {
    format!(
        "latency {:.3} ms, known to {:.3} ms; residual {:.3} px rms of {} frames",
        1e-6 * l.latency_ns as f64,
        1e-6 * l.sigma_ns,
        l.rms_px,
        l.frames
    )
}

/// Puts a latency into the results.
pub fn keep_latency(results: &mut Results, config: &RigConfig, wand: &str, l: &Latency) {
    let data = format!("{} frames of a light sensor on \"{wand}\"", l.frames);
    let method = "levels of coded planes by least squares, lens and pose held";
    let provenance = results.provenance(config, "", data, method);
    let (latency_us, sigma_us) = (1e-3 * l.latency_ns as f64, 1e-3 * l.sigma_ns);
    results.file.latency = Some(LatencySection { latency_us, sigma_us, provenance });
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
}
