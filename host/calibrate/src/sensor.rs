//! `dpm calibrate projector --sensor`: the wand's light sensor is moved through coded planes while everything is recorded;
//! lens, pose, tip and latency are solved afterwards.

use super::codes::{CodeSource, InverseSource};
use super::dialogue::Dialogue;
use super::pace::{FrameCounter, PaceResult, RunLook, SPOILT};
use super::parts::Parts;
use super::poses::Poses;
use super::recorder::{wait_until_up, while_stamped, Port, Recorder, TimedBlock};
use super::showing::Showing;
use dpm_calibration::file::{LatencySection, ProjectorSection, WandSection};
use dpm_calibration::model::ProjectorModel;
use dpm_calibration::pivot::trace;
use dpm_calibration::projector::{LensTerms, PlaceHint, Priors, Volume};
use dpm_calibration::sensor::{
    decode, decode_pairs, places_rested, solve, solve_latency, solve_latency_of_pairs, solve_pairs, Code,
    Coverage, DecodedPairs, Decoding, FrameLight, InverseCode, Latency, Mapped, SampleBlock, SensorError,
    Settings, Solution, Timing, FEWEST_PLACES,
};
use dpm_calibration::trajectory::{TimedPose, Trajectory};
use dpm_common::clock::MonotonicClock;
use dpm_rig::config::{PlaneTiming, RigConfig};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pack::source::PatternSource;
use dpm_rig::results::Results;
use dpm_rig::telemetry::monitor::RunMonitor;
use glam::DVec3;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What is measured with.
#[derive(Clone, Debug)]
pub struct SensorSetup {
    /// The sensor.
    pub port: Port,
    /// Name of the wand in the tracking software.
    pub wand: String,
    /// Seconds of motion.
    pub seconds: f64,
    /// Diameter of the sensor's aperture, metres.
    pub aperture_m: f64,
    /// What is known of the projector's place.
    pub known: PlaceHint,
    /// Which numbers of the lens are solved for.
    pub lens: LensTerms,
    /// Frames a second of the rig file: at a lower rate the motion takes longer.
    pub rate_hz: f64,
    /// Frames and their inverse are shown, in place of coded planes.
    pub is_held: bool,
    /// The operator has begun to move: what is repeated at another rate is not asked for again.
    pub has_begun: Arc<AtomicBool>,
}

/// Everything that was recorded while the wand moved.
struct Recording {
    blocks: Vec<TimedBlock>,
    clipped: ClipCount,
    sensor_minus_host_ns: i64,
    poses: Vec<TimedPose>,
}

/// Frames of a sweep that are worth solving: fewer tell the projector badly, however long they took.
const FRAMES: f64 = 1200.0;
/// A sweep lasts at least so many frames: the solvers need 500 with light, and some are without.
const LEAST_FRAMES: f64 = 700.0;

/// A pair needs two pictures in a row. Where the wand was held still at enough places, and fewer pictures than this share
/// came in time, the late ones may be why places were not seen, and a slower rate helps.
const CARRIED_FOR_PAIRS: f64 = 0.95;

/// What was recorded, ready for a solver.
struct RecordedSweep {
    seen: SeenCode,
    path: Trajectory,
    settings: Settings,
    clipped: ClipCount,
}

/// How many of the sensor's blocks of samples were saturated.
#[derive(Clone, Copy)]
struct ClipCount {
    blocks: usize,
    of: usize,
}

impl ClipCount {
    /// Why a sweep is refused; a saturated sensor spoils what all solvers see.
    fn refused(self, error: impl std::fmt::Display) -> Failure {
        let Self { blocks, of } = self;
        match blocks {
            0 => refused(error),
            _ => refused(format!(
                "{error}; {blocks} of {of} blocks of the sensor's samples were saturated: choose a lower --gain, or go \
                 further away"
            )),
        }
    }
}

/// A code, and what the sensor saw of it.
enum SeenCode {
    Planes(Box<Code>, Decoding),
    Frames(InverseCode, DecodedPairs, Rests),
}

/// How the wand was held still.
#[derive(Clone, Copy)]
struct Rests {
    /// At how many places it was still for a round of the code.
    places: usize,
}

impl Rests {
    /// Frames a second that were carried, if their number may be why too few places were seen.
    fn carried_too_few(self, error: &SensorError, carried: f64, rate_hz: f64) -> Option<f64> {
        let &SensorError::TooFewPlaces { need, .. } = error else { return None };
        (self.places >= need && carried < CARRIED_FOR_PAIRS).then_some(carried * rate_hz)
    }

    /// What was seen, beside the reason why it was too little.
    fn told(self, error: &SensorError, decoded: &DecodedPairs) -> String {
        let Self { places } = self;
        let lit = decoded.pairs.len();
        let share = 100.0 * lit as f64 / (lit + decoded.dropped).max(1) as f64;
        match error {
            SensorError::TooFewPlaces { .. } => format!(
                "{error} (by the tracker it was held still at {places} places; {:.0} % of the pictures came in time, and \
                 the sensor was in the light during {share:.0} % of these)",
                100.0 * decoded.carried
            ),
            _ => error.to_string(),
        }
    }
}

/// Shows the code, records, and solves. `tip` comes from `dpm calibrate wand`.
///
/// # Errors
/// A device fails (exit code 3), or what was recorded does not determine the projector (2, with what to do).
pub fn calibrate(
    config: &RigConfig,
    setup: &SensorSetup,
    tip: (DVec3, f64),
    monitor: &Arc<RunMonitor>,
) -> Result<PaceResult<Solution>, Failure> {
    let swept = match sweep(config, setup, tip, monitor)? {
        PaceResult::Done(swept) => swept,
        PaceResult::TooFast { carried_hz } => return Ok(PaceResult::TooFast { carried_hz }),
    };
    let solved = match &swept.seen {
        SeenCode::Planes(code, decoded) => solve(code, decoded, &swept.path, &swept.settings),
        SeenCode::Frames(code, decoded, _) => solve_pairs(code, decoded, &swept.path, &swept.settings),
    };
    match (solved, &swept.seen) {
        (Ok(solution), _) => Ok(PaceResult::Done(solution)),
        (Err(error), SeenCode::Planes(..)) => Err(swept.clipped.refused(error)),
        (Err(error), SeenCode::Frames(_, decoded, rests)) => {
            match rests.carried_too_few(&error, decoded.carried, config.projector.frame_rate.hz()) {
                Some(carried_hz) => Ok(PaceResult::TooFast { carried_hz }),
                None => Err(swept.clipped.refused(rests.told(&error, decoded))),
            }
        }
    }
}

/// Shows the code, records, and finds the latency of the projector `model`, which is known.
///
/// # Errors
/// As [`calibrate`].
pub fn latency(
    config: &RigConfig,
    setup: &SensorSetup,
    tip: (DVec3, f64),
    model: &ProjectorModel,
    monitor: &Arc<RunMonitor>,
) -> Result<PaceResult<Latency>, Failure> {
    sweep(config, setup, tip, monitor)?.and_then(|s| {
        let solved = match &s.seen {
            SeenCode::Planes(code, decoded) => solve_latency(code, decoded, &s.path, &s.settings, model),
            SeenCode::Frames(code, decoded, _) => {
                solve_latency_of_pairs(code, decoded, &s.path, &s.settings, model)
            }
        };
        solved.map_err(|e| s.clipped.refused(e))
    })
}

fn refused(error: impl std::fmt::Display) -> Failure {
    Failure::new(FailureKind::BadInput, error.to_string())
}

fn sweep(
    config: &RigConfig,
    setup: &SensorSetup,
    (tip, tip_sigma_m): (DVec3, f64),
    monitor: &Arc<RunMonitor>,
) -> Result<PaceResult<RecordedSweep>, Failure> {
    let raster = config.projector.raster();
    if !config.projector.is_lit_without_gap() {
        return Err(refused(
            "the codes of a light sensor need light without gaps, and this projector is dark for a part of every frame; \
             calibrate by hand: leave --sensor out",
        ));
    }
    let settings = |timing: Timing, poses: &[TimedPose]| {
        let tips = poses.iter().map(|p| p.place(tip));
        let volume = Volume::around(tips).ok_or_else(|| refused("the wand was not tracked"))?;
        Ok::<_, Failure>(Settings {
            timing,
            tip,
            tip_sigma_m,
            aperture_m: setup.aperture_m,
            priors: Priors::many_points(raster).with_lens(setup.lens),
            known: setup.known,
            volume,
            seed: 1,
        })
    };
    if setup.is_held {
        let code = InverseCode::new(raster);
        let hold_s = code.hold_s(1e9 / config.projector.frame_rate.hz());
        let guide = Guide::Rests { hold_s, tip };
        let source = Arc::new(InverseSource::new(code.clone()));
        return record(config, setup, (source, guide), monitor)?.and_then(|(recording, showing)| {
            let clipped = recording.clipped;
            let blocks = recording.blocks.into_iter();
            let mapped: Vec<Mapped> =
                blocks.filter_map(|t| Some((t.block, t.sensor_minus_host_ns?))).collect();
            let shown = |slot| showing.made_for(slot);
            let light = plane_light(config);
            let light = light.as_deref().map_or(FrameLight::Held, FrameLight::Planes);
            let decoded = decode_pairs(&code, (&showing.timing, light), &mapped, &shown)
                .map_err(|e| clipped.refused(e))?;
            let settings = settings(showing.timing, &recording.poses)?;
            let rests = Rests { places: places_rested(&recording.poses, tip, hold_s) };
            let seen = SeenCode::Frames(code.clone(), decoded, rests);
            Ok(RecordedSweep { seen, path: Trajectory::new(&recording.poses), settings, clipped })
        });
    }
    let code = Code::new(raster).map_err(refused)?;
    let guide = Guide::Coverage(Box::new(Coverage::new(code.clone())));
    let source = Arc::new(CodeSource::new(code.clone()));
    record(config, setup, (source, guide), monitor)?.and_then(|(recording, showing)| {
        let (offset_ns, timing) = (recording.sensor_minus_host_ns, showing.timing);
        let shown = |slot| showing.made_for(slot);
        let blocks: Vec<SampleBlock> = recording.blocks.into_iter().map(|timed| timed.block).collect();
        let clipped = recording.clipped;
        let decoded = decode(&code, &timing, &blocks, offset_ns, &shown).map_err(|e| clipped.refused(e))?;
        let settings = settings(timing, &recording.poses)?;
        let seen = SeenCode::Planes(Box::new(code.clone()), decoded);
        Ok(RecordedSweep { seen, path: Trajectory::new(&recording.poses), settings, clipped })
    })
}

/// How bright each plane of a white frame is, one after the other; `None` where a frame's light is even.
fn plane_light(config: &RigConfig) -> Option<Vec<f64>> {
    let schedule = config.projector.schedule();
    let is_uneven = config.projector.plane_timing() == PlaneTiming::Equal;
    is_uneven.then(|| schedule.planes().iter().map(|plane| f64::from(1u32 << plane.bit)).collect())
}

fn record(
    config: &RigConfig,
    setup: &SensorSetup,
    (source, guide): (Arc<dyn PatternSource>, Guide),
    monitor: &Arc<RunMonitor>,
) -> Result<PaceResult<(Recording, Showing)>, Failure> {
    let clock = MonotonicClock::new(0);
    let stopped = Arc::clone(monitor);
    let dialogue = Dialogue::start(move || stopped.stop_requested())?;
    let poses = Poses::start(config, std::slice::from_ref(&setup.wand), clock)?;
    let recorder = Recorder::start(&setup.port, clock)?;
    poses.wait_until_seen()?;
    let rate = config.projector.frame_rate;
    let frames = (setup.seconds * setup.rate_hz).clamp(LEAST_FRAMES, FRAMES);
    let is_again = setup.has_begun.load(Ordering::Relaxed);
    let least_s = if is_again { guide.least_s() } else { 0.0 };
    let seconds = setup.seconds.max(frames / rate.hz()).max(least_s);
    let moved = || {
        wait_until_up(monitor)?;
        recorder.wait_until_mapped(monitor)?;
        if let Some(carried_hz) = FrameCounter::of(config, monitor).try_out()? {
            return Ok(PaceResult::TooFast { carried_hz });
        }
        if is_again {
            dialogue.tell(&guide.again(seconds));
        } else {
            dialogue.tell(&guide.task(seconds));
            dialogue.ask("Press Enter to begin.")?;
            setup.has_begun.store(true, Ordering::Relaxed);
        }
        poses.take();
        recorder.take();
        let pace = FrameCounter::of(config, monitor);
        let sweeping = Sweeping { poses: &poses, recorder: &recorder, dialogue: &dialogue };
        sweeping.follow((seconds, 1e9 / rate.hz()), guide, pace, monitor)?.and_then(
            |(blocks, clipped, poses)| {
                let sensor_minus_host_ns = recorder.sensor_minus_host_ns()?;
                let clipped = ClipCount { blocks: clipped, of: blocks.len() };
                Ok(Recording { blocks, clipped, sensor_minus_host_ns, poses })
            },
        )
    };
    let (recording, lights) = while_stamped(config, source, (clock, seconds), monitor, moved)?;
    recording.and_then(|recording| Ok((recording, Showing::of(&lights, rate)?)))
}

/// Nobody rests to the instant: so much longer than a place takes is asked for, seconds.
const SPARE_S: f64 = 0.5;
/// From one place to the next, seconds.
const WAY_S: f64 = 1.0;

/// What the operator is told while the wand moves.
enum Guide {
    /// How much of the raster was seen.
    Coverage(Box<Coverage>),
    /// At how many places the wand was held still for so long, where its tip is in its body.
    Rests { hold_s: f64, tip: DVec3 },
}

impl Guide {
    fn task(&self, seconds: f64) -> String {
        match self {
            Self::Coverage(_) => format!(
                "Move the wand through the whole beam for {seconds:.0} s, sensor towards the projector, near and far, at \
                 0.2 to 0.8 m/s,\nand turn it a little all the time."
            ),
            Self::Rests { hold_s, .. } => format!(
                "For {seconds:.0} s, hold the wand still for {:.1} s at one place of the beam after another, sensor towards \
                 the projector, near and far\nand tilted differently at each, and go slowly from one to the next. \
                 {FEWEST_PLACES} places are needed, twenty are good.",
                hold_s + SPARE_S
            ),
        }
    }

    /// A sweep that needs no more places than the least number of them takes so long, with some to spare, seconds.
    fn least_s(&self) -> f64 {
        match self {
            Self::Coverage(_) => 0.0,
            Self::Rests { hold_s, .. } => 1.5 * FEWEST_PLACES as f64 * (hold_s + SPARE_S + WAY_S),
        }
    }

    /// What is told where the rate was lowered: a round of the code takes longer then.
    fn again(&self, seconds: f64) -> String {
        match self {
            Self::Coverage(_) => format!("Go on for {seconds:.0} s."),
            Self::Rests { hold_s, .. } => {
                let hold_s = hold_s + SPARE_S;
                format!(
                    "Go on for {seconds:.0} s, and hold the wand still for {hold_s:.1} s at each place now."
                )
            }
        }
    }

    /// What is next, from new samples and all poses.
    fn next(&mut self, frame_ns: f64, fresh: &[TimedBlock], poses: &[TimedPose]) -> String {
        match self {
            Self::Coverage(coverage) => {
                let fresh: Vec<SampleBlock> = fresh.iter().map(|timed| timed.block.clone()).collect();
                match coverage.add(frame_ns, &fresh) {
                    Ok(_) => coverage.advice(),
                    Err(why) => why.to_string(),
                }
            }
            Self::Rests { hold_s, tip } => {
                format!("held still at {} places", places_rested(poses, *tip, *hold_s))
            }
        }
    }
}

/// Samples, how many blocks of them are saturated, and poses.
type Collected = (Vec<TimedBlock>, usize, Vec<TimedPose>);

/// What a sweep goes on with.
struct Sweeping<'a> {
    poses: &'a Poses,
    recorder: &'a Recorder,
    dialogue: &'a Dialogue,
}

impl Sweeping<'_> {
    /// Collects samples and poses for some seconds, and says every five how it goes and what is next.
    fn follow(
        &self,
        (seconds, frame_ns): (f64, f64),
        mut guide: Guide,
        mut pace: FrameCounter<'_>,
        monitor: &RunMonitor,
    ) -> Result<PaceResult<Collected>, Failure> {
        let begin = Instant::now();
        let mut path = Vec::new();
        let mut parts = Parts::new(Duration::from_secs_f64(seconds));
        while !parts.are_over(begin.elapsed()) {
            if monitor.stop_requested() {
                return Err(refused("the measurement was interrupted; run the same command again"));
            }
            std::thread::sleep(Duration::from_millis(50));
            let before = begin.elapsed();
            match pace.look()? {
                RunLook::Enough => {}
                RunLook::TooFew(carried_hz) => return Ok(PaceResult::TooFast { carried_hz }),
                RunLook::Interrupted => {
                    self.recorder.take();
                    let again = parts.spoil(before.saturating_sub(SPOILT), begin.elapsed());
                    self.dialogue.tell(&format!(
                        "The light went off and is back: the last {:.0} s are repeated, go on.",
                        again.as_secs_f64()
                    ));
                }
            }
            path.extend(self.poses.take().into_iter().flatten());
            if begin.elapsed() >= parts.next() {
                let (fresh, fresh_clipped) = self.recorder.take();
                let next = match fresh_clipped {
                    0 => guide.next(frame_ns, &fresh, &path),
                    n => format!("{n} blocks are saturated: choose a lower --gain, or go further away"),
                };
                let done = parts.add((fresh, fresh_clipped), begin.elapsed());
                self.dialogue.tell(&format!("{:3.0} of {seconds:.0} s: {next}", done.as_secs_f64()));
            }
        }
        path.extend(self.poses.take().into_iter().flatten());
        parts.add(self.recorder.take(), begin.elapsed());
        let (mut blocks, mut clipped) = (Vec::new(), 0);
        for (fresh, fresh_clipped) in parts.all() {
            blocks.extend(fresh);
            clipped += fresh_clipped;
        }
        Ok(PaceResult::Done((blocks, clipped, path)))
    }
}

/// What the operator is told of a solution.
pub fn told_of(s: &Solution) -> String {
    let (p, [x, y, z]) = (&s.predicted, s.tip.to_array().map(|v| 1e3 * v));
    let at = p.worst;
    let lens = match s.is_lens_open {
        true => "no light was seen near the border of the picture, where a usual lens is taken: move there, too, if light is needed there;\n",
        false => "",
    };
    format!(
        "predicted error {:.3} px (99th percentile over the volume of the motion, for a tracker without bias);\n\
         it is least certain at ({:.2}, {:.2}, {:.2}) m: to make it better, run this again and move there, too;\n\
         {lens}residual {:.3} px rms of {} frames; sensor at ({x:.2}, {y:.2}, {z:.2}) mm in the wand's body;\n\
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

    #[test]
    fn a_slower_rate_is_tried_where_late_pictures_are_why_places_were_not_seen() {
        let short = SensorError::TooFewPlaces { places: 6, need: FEWEST_PLACES };
        let rests = Rests { places: FEWEST_PLACES };
        assert_eq!(rests.carried_too_few(&short, 0.5, 120.0), Some(60.0));
        assert_eq!(rests.carried_too_few(&short, 0.99, 120.0), None, "the pictures came");
        let moved = Rests { places: FEWEST_PLACES - 1 };
        assert_eq!(moved.carried_too_few(&short, 0.5, 120.0), None, "the wand did not rest");
        let other = SensorError::LatencyUncertain { us: 2000.0 };
        assert_eq!(rests.carried_too_few(&other, 0.5, 120.0), None);
    }

    /// At a lower rate the operator sees the new time per place, and the recording allows half as many places again.
    #[test]
    fn a_lower_rate_asks_for_longer_rests_and_leaves_time_for_them() {
        let code = InverseCode::new(dpm_device::planes::Raster::new(128, 96).unwrap());
        for (hz, told) in [(120.0, "1.1 s at each place"), (41.0, "1.6 s at each place")] {
            let hold_s = code.hold_s(1e9 / hz);
            let guide = Guide::Rests { hold_s, tip: DVec3::ZERO };
            assert!(guide.again(30.0).contains(told), "{}", guide.again(30.0));
            // The way to a place takes a second, and nobody rests to the instant.
            assert!((guide.least_s() / (hold_s + 1.5) - 1.5 * FEWEST_PLACES as f64).abs() < 1e-9);
        }
    }
}
