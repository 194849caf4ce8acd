//! `dpm pattern` on a DLPC900: the pattern's pictures are uploaded as a sequence, as `dpm dlpc900 upload` does, and
//! supervised as in `dpm run`.

use super::keys::NO_WATCHDOG;
use super::pictures::planes_of;
use super::run::{check_panel, opener, present, Dlpc900Report, Show};
use dpm_device::planes::Channel;
use dpm_dlpc900::image::PlaneOrder;
use dpm_dlpc900::lut::{led, Dmd};
use dpm_dlpc900::sequence::{BitPattern as Plates, PatternSequence, Repeat, SequenceBuilder};
use dpm_dlpc900::usb::UsbPlace;
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::pattern::{Pattern, PatternShow};
use dpm_rig::telemetry::monitor::RunMonitor;

/// Shows the pattern on the controller that `config` names until its run is over or `monitor` requests a stop.
///
/// # Errors
/// A pattern that the controller cannot hold (exit code 2), or a controller that fails (3).
pub(crate) fn run_pattern_dlpc900(
    config: &RigConfig,
    show: &PatternShow,
    monitor: &RunMonitor,
) -> Result<Dlpc900Report, Failure> {
    let backend = super::keys_of(&config.projector.backend)?;
    let place = backend.device.as_deref().map(str::parse::<UsbPlace>).transpose();
    let place =
        place.map_err(|e| Failure::new(FailureKind::BadInput, format!("projector.backend.device: {e}")))?;
    let dmd = backend.panel.dmd();
    let rate = config.projector.frame_rate;
    let frame_us = (1_000_000 * u64::from(rate.den()) / u64::from(rate.num().max(1))) as u32;
    let sequence = sequence_of(show, dmd, frame_us)?;
    let mut open = opener(place, monitor);
    check_panel(&mut open, backend)?;
    let seconds = match config.run.frames {
        0 => Some(config.run.seconds).filter(|s| *s > 0.0),
        frames => Some(frames as f64 / rate.hz()),
    };
    let pictures = show.pictures().len();
    let mut report = present(&mut open, &Show::Preloaded(sequence), seconds, monitor)?;
    report.frames_loaded = Some(pictures);
    report.warnings = vec![NO_WATCHDOG.to_owned()];
    Ok(report)
}

/// One pattern for each picture: of one bit if the pictures are black and white, of eight bits otherwise. Pictures of
/// a stepping pattern are exposed for as long as they are held, and others for `frame_us` microseconds.
fn sequence_of(show: &PatternShow, dmd: Dmd, frame_us: u32) -> Result<PatternSequence, Failure> {
    let bad = |told: String| Failure::new(FailureKind::BadInput, told);
    if show.pattern() == Pattern::Counter && show.pictures() == (0..1) {
        let told = "a DLPC900 repeats the pictures that were uploaded and cannot count frames; add --step N to show one number";
        return Err(bad(told.into()));
    }
    let raster = show.raster();
    if raster != dmd.raster() {
        let told = format!("the {} has {:?} mirrors, the pattern {raster:?}", dmd.name(), dmd.raster());
        return Err(bad(told));
    }
    let depth = if show.is_binary() { 1 } else { 8 };
    let several = show.pictures().len() > 1;
    let hold_us = show.hold_ms().saturating_mul(1000).min(u64::from(u32::MAX)) as u32;
    let exposure_us = if several { hold_us } else { frame_us.max(dmd.min_exposure_us(depth).unwrap_or(1)) };
    let leds = match show.ink().channel {
        Some(Channel::Red) => led::RED,
        Some(Channel::Green) => led::GREEN,
        Some(Channel::Blue) => led::BLUE,
        Some(Channel::White) | None => led::WHITE,
    };
    let mut codes = vec![0u32; raster.pixel_count()];
    let level = |code: &u32| code.to_le_bytes().into_iter().max().unwrap_or(0);
    let mut planes_of_picture = |picture| {
        show.fill(picture, &mut codes);
        planes_of(&codes.iter().map(level).collect::<Vec<u8>>(), raster, depth)
    };
    let all: Vec<Vec<Vec<u8>>> = show.pictures().map(&mut planes_of_picture).collect();
    let mut builder = SequenceBuilder::new(dmd);
    for planes in &all {
        builder.push(&Plates {
            planes: planes.iter().map(Vec::as_slice).collect(),
            exposure_us,
            dark_us: 0,
            leds,
            wait_trigger: false,
            no_trigger_out2: false,
        });
    }
    let finished = builder.finish(Repeat::Forever, PlaneOrder::default(), None);
    finished.map_err(|e| bad(format!("{e}; hold each step for another time with --hold-ms")))
}
