//! `dpm snapshot FILE`: everything that one frame of a rig, or of a scene by itself, was made from, as pictures.

use super::rig_args::RigArgs;
use super::watch::print;
use dpm_lab::snapshot::{snapshot, FittedView, SnapshotImage, SnapshotReport, SnapshotRequest, SnapshotView};
use dpm_rig::failure::{Failure, FailureKind};
use dpm_rig::telemetry::report::to_json;
use std::path::{Path, PathBuf};

/// Flags of `dpm snapshot`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct SnapshotArgs {
    /// A rig file, or a scene to show by itself, without motion: a .glb, .gltf, .obj, .ply or .stl file; default: the
    /// built-in demo
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
    /// Number of the frame; the frames before it are also played, so that histories settle
    #[arg(long, value_name = "N", default_value_t = 32)]
    frame: u32,
    /// Pictures to write, separated by commas; default: all that the method has
    #[arg(long, value_name = "NAME", value_enum, value_delimiter = ',')]
    what: Vec<SnapshotImage>,
    /// From where the pictures are taken
    #[arg(long, value_name = "VIEW", value_enum, default_value = "auto")]
    view: SnapshotView,
    /// Print the list of files as one JSON object
    #[arg(long)]
    json: bool,
}

/// Ends of the names of scene files.
const SCENES: [&str; 5] = ["glb", "gltf", "obj", "ply", "stl"];

/// Writes the pictures.
///
/// # Errors
/// Bad rig file or scene, no GPU.
pub(super) fn execute(args: &SnapshotArgs) -> Result<(), Failure> {
    args.flags.refuse("dpm snapshot", &["--frames", "--seconds", "--no-prediction"])?;
    let mut flags = args.flags.clone();
    let mut rig = args.file.as_deref();
    let end = rig.and_then(Path::extension).and_then(|end| end.to_str()).map(str::to_ascii_lowercase);
    if let (Some(file), Some(end)) = (rig, end.as_deref().filter(|end| *end != "toml")) {
        if !SCENES.contains(&end) && !file.exists() {
            let told = format!(
                "{}: there is no such file; name a rig file (.toml) or a scene: .{}. What other programs write can be \
                 exported as glTF 2.0 (.glb)",
                file.display(),
                SCENES.join(", .")
            );
            return Err(Failure::new(FailureKind::BadInput, told));
        }
    }
    if end.is_some_and(|end| SCENES.contains(&end.as_str())) {
        if let Some(other) = flags.scene.replace(rig.take().unwrap_or(Path::new("")).to_owned()) {
            let told =
                format!("--scene {}: there is a scene before it; leave one of them out", other.display());
            return Err(Failure::new(FailureKind::BadInput, told));
        }
    }
    let still = rig.is_none() && flags.scene.is_some();
    if still {
        // The bodies of the demo, and how they move, are not those of another scene.
        flags.set.insert(0, "scene.bodies=[]".into());
    }
    let rig = flags.rig_at_rest(rig)?;
    let dir = flags.out.clone().unwrap_or_else(|| rig.output.dir.join("snapshot"));
    let request = SnapshotRequest { frame: args.frame, what: args.what.clone(), view: args.view, still };
    let report = snapshot(&rig, &request, &dir)?;
    print(&if args.json { to_json(&report) + "\n" } else { text(&report) });
    Ok(())
}

fn text(report: &SnapshotReport) -> String {
    let [width, height] = report.raster;
    let mut text = format!("method {}, frame {}, {width} x {height}\n", report.method, report.frame);
    report.warnings.iter().for_each(|w| text += &format!("note: {w}\n"));
    text += &report.view.as_ref().map_or(String::new(), view);
    report.files.iter().for_each(|f| text += &format!("{}\n", f.display()));
    report.not_made.iter().for_each(|n| text += &format!("no {}: {}\n", n.image, n.why));
    text
}

/// From this exposure on, surfaces that are black look grey.
const FAR_BRIGHTER: f64 = 4.0;

/// What a rig file says that has the same view.
fn view(view: &FittedView) -> String {
    let [lower, upper] = view.bounds;
    let sides = [0, 1, 2].map(|axis| upper[axis] - lower[axis]);
    let longest = sides.into_iter().fold(0.0, f64::max);
    let numbers = |list: [f64; 3], scale: f64| list.map(|x| rounded(x, scale)).join(", ");
    let [position, look_at] = [view.position, view.look_at].map(|p| numbers(p, longest));
    let sides = sides.map(|side| rounded(side, longest)).join(" x ");
    let intensity = view.max_intensity;
    let (intensity, exposure) = (numbers(intensity, intensity[0]), rounded(view.exposure, view.exposure));
    let brighter = match view.exposure > FAR_BRIGHTER {
        true => format!("note: the scene is dark, so its pictures are {exposure} times as bright; --set render.exposure=E chooses another factor\n"),
        false => String::new(),
    };
    format!(
        "{brighter}note: the view was chosen to show the bodies, which fill {sides} m; --view rig takes the rig's. In a rig file:\n      \
         [projector]\n      position = [{position}]\n      look_at = [{look_at}]\n      \
         max_intensity = [{intensity}]\n      [observer]\n      position = [{position}]\n      \
         [render]\n      exposure = {exposure}\n",
    )
}

/// `x` in decimals, to four digits of a length `scale`.
fn rounded(x: f64, scale: f64) -> String {
    let decimals = (3.0 - scale.abs().max(1e-12).log10().floor()).clamp(1.0, 15.0);
    // No minus stands before a zero.
    let step = 10f64.powf(decimals);
    // The zero that is added takes the sign from one that was rounded.
    format!("{:.*}", decimals as usize, (x * step).round() / step + 0.0)
}
