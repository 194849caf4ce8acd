//! Frames that the demo packs, into files for `tests/hil/run`, whose machine has no GPU and shows them on its display.
//!
//! `demo_frames FOLDER` runs the demo against the mock projector with the raster and the rate of that display, once for
//! each encoding of a display, and writes the planes that arrived on the mirrors. Each file is named by its encoding and
//! begins with a line that says what it is: the raster, what the bits of a pixel mean, whether the planes share the full
//! light, and the channel and bit of each plane. Then comes frame after frame, plane after plane, as on the link.

use dpm_common::keys::read::ConfigValue;
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_render::gpu::{Gpu, GpuOptions};
use dpm_rig::config::{Overrides, Pace, RigConfig};
use dpm_rig::pipeline::projector::panel;
use dpm_rig::pipeline::{self, RunOptions};
use dpm_rig::projectors::display::{DisplayConfig, DisplayEncoding};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::live::SeenLight;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// As `MODE` in `host/display/tests/vkms/rig.rs`.
const SIZE: (u32, u32) = (160, 120);
/// Of every rig; the size is that of the panel of a DLPC900, and the raster above takes its place.
const SETTINGS: [&str; 4] = [
    "projector.frame_rate=\"60\"",
    "projector.width=1920",
    "projector.height=1080",
    "real_time.pace=\"real\"",
];
/// Frames of a file.
const FRAMES: usize = 8;
/// How long they may take on a busy machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// A display of a rig file, and the planes that the rig sends to it.
struct Case {
    name: String,
    encoding: String,
    rig: Arc<Rig>,
}

/// The case of `backend`, with the mock in the display's place.
fn case(name: String, settings: &[&str]) -> Result<Case, String> {
    let flags = SETTINGS.iter().chain(settings).map(|s| (*s).to_owned()).collect();
    let mut config = RigConfig::demo(&Overrides { variables: vec![], flags }).map_err(|e| e.to_string())?;
    let raster = Raster::new(SIZE.0, SIZE.1).ok_or("no raster")?;
    let display: Option<&DisplayConfig> = config.projector.backend.keys();
    let display = display.ok_or(format!("{name}: no display"))?;
    let settings = display.settings(&panel(&config, raster)).map_err(|e| e.to_string())?;
    config.simulate();
    config.real_time.pace = Pace::Virtual;
    let rig = Rig::build(&config, Some(raster)).map_err(|e| e.to_string())?;
    let rig = Arc::new(Rig { schedule: settings.schedule, ..rig });
    Ok(Case { name, encoding: format!("{:?}", settings.encoding), rig })
}

/// Every encoding of a display by itself and in front of a DLPC900.
fn cases() -> Result<Vec<Case>, String> {
    let display = |more: &str| format!("projector.backend={{kind=\"display\",{more}}}");
    let mut all = vec![
        case("rgb8".into(), &[&display("encoding=\"rgb8\"")])?,
        case("planes24".into(), &[&display("encoding=\"planes24\"")])?,
        case("planes24-equal".into(), &[&display("encoding=\"planes24\""), "projector.weights=\"equal\""])?,
    ];
    for word in DisplayEncoding::kind().split(" | ") {
        let name = format!("dlpc900-{}", word.trim_matches('"'));
        all.push(case(name, &[&display(&format!("encoding={word},dlpc900={{}}"))])?);
    }
    Ok(all)
}

/// The planes of frames of a run of `rig`.
fn frames(gpu: &Arc<Gpu>, rig: &Arc<Rig>) -> Result<Vec<Vec<u8>>, String> {
    let bytes = rig.camera.raster.plane_bytes() * rig.schedule.len();
    let monitor = Arc::new(RunMonitor::default());
    let (rig, gpu, seen_by) = (rig.clone(), gpu.clone(), monitor.clone());
    let options = RunOptions { frames: u64::MAX, ..RunOptions::default() };
    let run = std::thread::spawn(move || pipeline::run(rig, &gpu, options, &seen_by));
    let limit = Instant::now() + PATIENCE;
    let mut frames: Vec<Vec<u8>> = Vec::new();
    let (mut light, mut newest) = (SeenLight::default(), None);
    monitor.live().want_light();
    while frames.len() < FRAMES && Instant::now() < limit && !run.is_finished() {
        std::thread::sleep(Duration::from_millis(1));
        if monitor.live().take_light(&mut light) {
            let is_new = light.frame.is_some() && light.frame != newest && light.planes.len() == bytes;
            if is_new && light.planes.iter().any(|b| *b != 0) && frames.last() != Some(&light.planes) {
                newest = light.frame;
                frames.push(light.planes.clone());
            }
            monitor.live().want_light();
        }
    }
    monitor.request_stop();
    let outcome = run.join().map_err(|_| "the run panicked")?.map_err(|e| e.to_string())?;
    match (frames.len(), outcome.light_mismatches) {
        (FRAMES, 0) => Ok(frames),
        (n, 0) => Err(format!("only {n} of {FRAMES} frames came in {PATIENCE:?}")),
        (_, n) => Err(format!("{n} frames of the run are not what was rendered")),
    }
}

/// The line that says what a file is.
fn head(encoding: &str, schedule: &PlaneSchedule) -> String {
    let light = if schedule.fills() { "filling" } else { "weighted" };
    let planes: Vec<String> =
        schedule.planes().iter().map(|spec| format!("{:?}{}", spec.channel, spec.bit)).collect();
    format!("dpm demo frames, {} x {}, {encoding}, {light}, {}\n", SIZE.0, SIZE.1, planes.join(" "))
}

fn write(folder: &Path) -> Result<(), String> {
    let gpu = Gpu::open(&GpuOptions::default()).map_err(|e| e.to_string())?;
    std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    for Case { name, encoding, rig } in cases()? {
        let frames = frames(&gpu, &rig).map_err(|e| format!("{name}: {e}"))?;
        let bytes = [head(&encoding, &rig.schedule).into_bytes(), frames.concat()].concat();
        let path = folder.join(&name);
        std::fs::write(&path, bytes).map_err(|e| format!("{}: {e}", path.display()))?;
        let lit: u32 = frames.iter().flatten().map(|b| b.count_ones()).sum();
        println!("{}: {} frames, {} lit bits each", path.display(), frames.len(), lit / frames.len() as u32);
    }
    Ok(())
}

fn main() -> ExitCode {
    dpm_dlpc900_rig::register();
    let Some(folder) = std::env::args_os().nth(1) else {
        eprintln!("usage: demo_frames FOLDER");
        return ExitCode::from(2);
    };
    match write(Path::new(&folder)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("demo_frames: {e}");
            ExitCode::FAILURE
        }
    }
}
