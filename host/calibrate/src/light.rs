//! `dpm calibrate light`: how bright a code value is, by a light sensor at rest; and how bright the raster is where, by a
//! sweep of it.

use super::dialogue::Dialogue;
use super::levels::{LampLight, LevelField, Levels, Readings};
use super::pace::{FrameCounter, PaceResult, RunLook, MOST_INTERRUPTIONS, SPOILT};
use super::parts::Parts;
use super::recorder::{wait_until_up, while_stamped, Port, Recorder, TimedBlock};
use super::showing::Showing;
use dpm_calibration::file::LightSection;
use dpm_calibration::light::{flat_field, steady, Channels, FlatField, LightModel, Steady};
use dpm_calibration::sensor::{Brightness, SampleBlock};
use dpm_common::clock::MonotonicClock;
use dpm_common::files::write_atomically;
use dpm_device::regular_file;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::results::Results;
use dpm_rig::telemetry::monitor::RunMonitor;
use glam::{DVec2, DVec3};
use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Time for which the room is read before there is light.
const DARK: Duration = Duration::from_millis(500);
/// Largest file of a sweep that is read: an hour at a thousand frames a second.
const MAX_BYTES: u64 = 1 << 29;

fn refused(error: impl std::fmt::Display) -> Failure {
    Failure::new(FailureKind::BadInput, error.to_string())
}

/// What has been read so far, so that a measurement may go on at another rate.
#[derive(Clone, Debug, Default)]
pub struct ReadingProgress {
    readings: Readings,
    ambient: Option<Steady>,
    /// Among tiles: whether the sensor lies on one of the complement.
    is_on_complement: Option<bool>,
    /// How often the light went off.
    interruptions: u32,
}

/// How light is measured.
#[derive(Clone, Debug)]
pub struct Ways {
    /// The sensor.
    pub port: Port,
    /// Twice the frequency of the mains, hertz.
    pub flicker_hz: f64,
    /// Codes of each channel.
    pub codes: u32,
    /// Levels are shown in tiles, as for displays.
    pub in_tiles: bool,
}

/// Shows the levels that `progress` lacks, reads the sensor at rest, and gives curves and brightness of the channels once it
/// has all.
///
/// # Errors
/// A device fails (exit code 3); planes, limits or readings of which no response comes (2, with what to do).
pub fn measure(
    config: &RigConfig,
    ways: &Ways,
    progress: &mut ReadingProgress,
    monitor: &Arc<RunMonitor>,
) -> Result<PaceResult<Option<Channels>>, Failure> {
    let flicker_hz = ways.flicker_hz;
    let all = levels_of(config, ways, progress.is_on_complement)?;
    let Some(levels) = all.missing(&progress.readings).map_err(refused)?.map(Arc::new) else {
        return Err(refused("no level is missing"));
    };
    let clock = MonotonicClock::new(0);
    let stopped = Arc::clone(monitor);
    let dialogue = Dialogue::start(move || stopped.stop_requested())?;
    let recorder = Recorder::start(&ways.port, clock)?;
    recorder.wait_until_mapped(monitor)?;
    let ambient = match progress.ambient {
        Some(ambient) => ambient,
        None => {
            // Among tiles these levels only tell where the sensor lies.
            let rest = if ways.in_tiles { levels_of(config, ways, Some(false))?.seconds() } else { 0.0 };
            let seconds = levels.seconds() + rest;
            *progress.ambient.insert(room_light(seconds, &recorder, flicker_hz, &dialogue)?)
        }
    };
    let seconds = levels.seconds();
    let read = || {
        wait_until_up(monitor)?;
        if let Some(carried_hz) = FrameCounter::of(config, monitor).try_out()? {
            return Ok(PaceResult::TooFast { carried_hz });
        }
        watch(&levels, &recorder, &dialogue, (FrameCounter::of(config, monitor), monitor))
    };
    let (watched, lights) = while_stamped(config, levels.clone(), (clock, seconds), monitor, read)?;
    watched.and_then(|(samples, is_interrupted)| {
        progress.interruptions += u32::from(is_interrupted);
        let may_repeat = is_interrupted && progress.interruptions <= MOST_INTERRUPTIONS;
        if is_interrupted {
            dialogue.tell("The light went off and is back: the levels that it has spoilt are shown again.");
        }
        let again = progress.is_on_complement.is_none() && ways.in_tiles || samples.is_empty();
        if may_repeat && again {
            return Ok(None);
        }
        let showing = Showing::of(&lights, config.projector.frame_rate)?;
        let room = LampLight { flicker_hz, ambient };
        if ways.in_tiles && progress.is_on_complement.is_none() {
            let is_on = levels.is_on_complement(&showing, &samples, room).map_err(refused)?;
            progress.is_on_complement = Some(is_on);
            return Ok(None);
        }
        let before = progress.readings.count();
        progress.readings.add(&levels, &showing, &samples, room).map_err(refused)?;
        let missing = all.count() - progress.readings.count();
        if missing > 0 && (progress.readings.count() > before || may_repeat) {
            dialogue.tell(&format!(
                "{missing} of {} levels were not seen whole; they are shown again.",
                all.count()
            ));
            return Ok(None);
        }
        progress.readings.solve(&all, room).map(Some).map_err(refused)
    })
}

/// Reads the room while the projector is dark.
fn room_light(
    seconds: f64,
    recorder: &Recorder,
    flicker_hz: f64,
    dialogue: &Dialogue,
) -> Result<Steady, Failure> {
    dialogue.tell(&format!(
        "Put the wand down in the beam, near the middle of the picture, so that its sensor looks at the lens. Nobody may\n\
         move it or walk through the light for {seconds:.0} s. The projector is still dark: the light of the room is read \
         first."
    ));
    dialogue.ask("Press Enter to begin.")?;
    recorder.take();
    std::thread::sleep(DARK);
    let dark: Vec<SampleBlock> = recorder.take().0.into_iter().map(|timed| timed.block).collect();
    steady(&dark, flicker_hz).map_err(refused)
}

/// The levels for the rig's planes, within its limits.
fn levels_of(config: &RigConfig, ways: &Ways, is_on_complement: Option<bool>) -> Result<Levels, Failure> {
    let (projector, safety) = (&config.projector, &config.safety);
    let limit = u8::try_from(safety.flashes_per_second.min(255)).ok().filter(|&n| n > 0);
    let (schedule, rate) = (projector.schedule(), projector.frame_rate);
    let levels = match (ways.in_tiles, is_on_complement) {
        (false, _) => Levels::new(&schedule, rate, LevelField::Full(limit), ways.codes),
        (true, None) => Levels::two(&schedule, rate),
        (true, Some(is_exchanged)) => {
            Levels::new(&schedule, rate, LevelField::Tiles { is_exchanged }, ways.codes)
        }
    };
    let levels = levels.map_err(refused)?;
    let limits = &safety.limits;
    if limits.full_white_s > 0.0 && limits.full_white_s < levels.full_white_s() {
        return Err(refused(format!(
            "safety.limits.full_white_s = {} is shorter than the {:.2} s for which full white must stand as a reference; \
             raise it for this measurement with --set",
            limits.full_white_s,
            levels.hold_s()
        )));
    }
    if limits.mean_level > 0.0 && limits.mean_level < levels.mean() {
        return Err(refused(format!(
            "safety.limits.mean_level = {} is below the {:.2} that the levels have on average; raise it for this \
             measurement with --set",
            limits.mean_level,
            levels.mean()
        )));
    }
    Ok(levels)
}

/// Waits while the levels are shown, and gives the samples, and whether the light went off: then those of before.
fn watch(
    levels: &Levels,
    recorder: &Recorder,
    dialogue: &Dialogue,
    (mut pace, monitor): (FrameCounter<'_>, &RunMonitor),
) -> Result<PaceResult<(Vec<TimedBlock>, bool)>, Failure> {
    recorder.take();
    let (begin, mut told) = (Instant::now(), 0);
    let mut parts = Parts::new(Duration::from_secs_f64(levels.seconds()));
    let all = |parts: Parts<Vec<TimedBlock>>| parts.all().flatten().collect::<Vec<_>>();
    while begin.elapsed().as_secs_f64() < levels.seconds() {
        if monitor.stop_requested() {
            return Err(refused("the measurement was interrupted; run the same command again"));
        }
        std::thread::sleep(Duration::from_millis(50));
        let before = begin.elapsed();
        match pace.look()? {
            RunLook::Enough => {}
            RunLook::TooFew(carried_hz) => return Ok(PaceResult::TooFast { carried_hz }),
            RunLook::Interrupted => {
                parts.spoil(before.saturating_sub(SPOILT), begin.elapsed());
                return Ok(PaceResult::Done((all(parts), true)));
            }
        }
        if begin.elapsed() >= parts.next() {
            parts.add(recorder.take().0, begin.elapsed());
        }
        // Full white comes up within two levels.
        let (_, saturated) = recorder.counts();
        if saturated > 0 {
            return Err(refused(format!(
                "the sensor is saturated ({saturated} blocks of samples): choose a lower --gain, move it away from the \
                 projector, or put a grey filter before it"
            )));
        }
        let tens = begin.elapsed().as_secs() / 10;
        if tens > told {
            told = tens;
            dialogue.tell(&format!("{:3} of {:.0} s", 10 * tens, levels.seconds()));
        }
    }
    parts.add(recorder.take().0, begin.elapsed());
    Ok(PaceResult::Done((all(parts), false)))
}

/// Writes the brightness along a sweep: column, row, distance in metres, direction to the lens in the wand's body, level.
///
/// # Errors
/// The file cannot be written.
pub fn save_sweep(path: &Path, sweep: &[Brightness]) -> Result<(), Failure> {
    write_atomically(path, |out| {
        sweep.iter().try_for_each(|b| {
            let (p, t) = (b.pixel, b.towards);
            writeln!(out, "{} {} {} {} {} {} {}", p.x, p.y, b.distance_m, t.x, t.y, t.z, b.level)
        })
    })
    .map_err(|e| refused(format!("{}: {e}", path.display())))
}

/// Reads what [`save_sweep`] wrote; `None` if there is no such file.
///
/// # Errors
/// The file cannot be read, or has a line that is not seven numbers.
pub fn load_sweep(path: &Path) -> Result<Option<Vec<Brightness>>, Failure> {
    if !path.exists() {
        return Ok(None);
    }
    let bad = |e: String| refused(format!("{}: {e}; delete it and sweep again", path.display()));
    let text = regular_file::read_text(path, MAX_BYTES).map_err(|e| bad(e.to_string()))?;
    let brightness = |(number, line): (usize, &str)| {
        let numbers: Option<Vec<f64>> =
            line.split_whitespace().map(|w| w.parse().ok().filter(|v: &f64| v.is_finite())).collect();
        let seven: Option<[f64; 7]> = numbers.and_then(|n| n.try_into().ok());
        let Some([column, row, distance_m, x, y, z, level]) = seven else {
            return Err(bad(format!("line {} is not seven numbers", number + 1)));
        };
        let (pixel, towards) = (DVec2::new(column, row), DVec3::new(x, y, z));
        Ok(Brightness { pixel, distance_m, towards, level })
    };
    text.lines().enumerate().map(brightness).collect::<Result<_, _>>().map(Some)
}

/// Where a flat field comes from.
#[derive(Clone, Debug)]
pub enum FlatSource {
    /// Brightness along a sweep, and the direction into which a flat sensor looks, in the wand's body.
    Sweep(Vec<Brightness>, Option<DVec3>),
    /// What the calibration file has already, else an even field.
    Former,
}

/// Puts curves and flat field into the results, and says what there is to say of them.
pub fn keep(results: &mut Results, config: &RigConfig, channels: Channels, source: FlatSource) -> String {
    let raster = config.projector.raster();
    let same_raster = |s: &&LightSection| s.size == [raster.width(), raster.height()];
    let former =
        || results.file.light.as_ref().filter(same_raster).and_then(LightSection::model).map(|m| m.flat);
    let measured = match source {
        FlatSource::Sweep(sweep, looks) => {
            Some(flat_field(raster, &sweep, looks).map(|flat| (flat, sweep.len())))
        }
        FlatSource::Former => None,
    };
    let (flat, told) = match (measured, former()) {
        (Some(Ok((flat, frames))), _) => {
            let told = format!("flat field of {frames} frames, {}", of_corners(&flat));
            (flat, told)
        }
        // The levels are good all the same, and took a minute.
        (Some(Err(why)), former) => {
            let kept = if former.is_some() { "kept as it was" } else { "taken as even" };
            let told = format!("flat field {kept}: {why}");
            (former.unwrap_or_else(|| FlatField::even(raster)), told)
        }
        (None, Some(flat)) => (flat, "flat field kept from the calibration file".to_owned()),
        (None, None) => {
            let told = "flat field taken as even: run `dpm calibrate projector --sensor` first, or give --sweep 30, to \
                        measure it";
            (FlatField::even(raster), told.to_owned())
        }
    };
    let shares: Vec<String> = channels.intensity.iter().map(|i| format!("{:.1} %", 100.0 * i)).collect();
    let halves: Vec<String> = (0..channels.intensity.len())
        .map(|c| format!("{:.3}", channels.level(c, 0.5) / channels.level(c, 1.0).max(1e-12)))
        .collect();
    let light = format!(
        "channels give {} of full white; at half code {} of their full light; black {:.3} %, ambient {:.2} % of full \
         white; levels known to {:.2} %",
        shares.join(", "),
        halves.join(", "),
        100.0 * channels.black,
        100.0 * channels.ambient,
        300.0 * channels.sigma
    );
    let data = format!("full-field levels on a light sensor at rest; {told}");
    let provenance =
        results.provenance(config, "", data, "levels between references of full white, by frame");
    let weights = Some(config.projector.weights.word().to_owned());
    let section = LightSection::new(&LightModel { channels, flat }, provenance);
    results.file.light = Some(LightSection { weights, ..section });
    format!("{light}\n{told}")
}

/// The darkest and the brightest of the corners.
fn of_corners(flat: &FlatField) -> String {
    let (w, h) = (f64::from(flat.raster.width()), f64::from(flat.raster.height()));
    let corners = [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)].map(|(x, y)| flat.at(DVec2::new(x, y)));
    let (low, high) = corners.iter().fold((f64::INFINITY, 0.0f64), |(a, b), v| (a.min(*v), b.max(*v)));
    format!(
        "corners at {:.0} to {:.0} % of the middle, known to {:.2} %",
        100.0 * low,
        100.0 * high,
        100.0 * flat.sigma
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sweep_comes_back_from_its_file_and_damage_is_named() {
        let path = std::env::temp_dir().join(format!("dpm-sweep-{}", std::process::id()));
        let _ = std::fs::remove_file(&path);
        assert!(load_sweep(&path).unwrap().is_none());
        let at = |i: f64| Brightness {
            pixel: DVec2::new(i / 3.0, 700.0 - i),
            distance_m: 1.0 + i * 1e-3,
            towards: DVec3::new(0.1, -0.2, i).normalize(),
            level: 0.7 * i,
        };
        let sweep: Vec<Brightness> = (0..50).map(|i| at(f64::from(i))).collect();
        save_sweep(&path, &sweep).unwrap();
        assert_eq!(load_sweep(&path).unwrap(), Some(sweep));
        for bad in ["1 2 3 4 5 6", "1 2 3 4 5 6 nan", "1 2 3 4 5 6 x", "1 2 3 4 5 6 7 8"] {
            std::fs::write(&path, format!("1 2 3 4 5 6 7\n{bad}\n")).unwrap();
            assert!(load_sweep(&path).unwrap_err().message.contains("line 2"), "{bad}");
        }
        std::fs::remove_file(path).unwrap();
    }
}
