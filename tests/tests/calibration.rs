//! `dpm calibrate` as an operator uses it, with the projector, the tracker and the light sensor in a process of their own.

use dpm_calibration::file::{self, CalibrationFile};
use glam::DVec3;
use hil_mock::sensor_wand::ProjectorOptics;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

/// A program of this workspace that the build of all tests has made.
fn program(name: &str) -> PathBuf {
    let here = std::env::current_exe().unwrap();
    let path = here.parent().and_then(Path::parent).unwrap().join(name);
    assert!(path.exists(), "{} is missing: cargo build -p dpm -p hil-mock", path.display());
    path
}

/// A folder that is removed afterwards.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("dpm-calibration-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        for part in ["run", "state"] {
            std::fs::create_dir_all(path.join(part)).unwrap();
            let private = <std::fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o700);
            std::fs::set_permissions(path.join(part), private).unwrap();
        }
        Self(path)
    }

    fn write(&self, name: &str, text: &str) {
        std::fs::write(self.0.join(name), text).unwrap();
    }

    /// Runs `dpm` here with a line on its standard input.
    fn dpm(&self, arguments: &[&str]) -> Output {
        let mut child = Command::new(program("dpm"))
            .args(arguments)
            .current_dir(&self.0)
            .env("DPM_RUNTIME_DIR", self.0.join("run"))
            .env("DPM_STATE_DIR", self.0.join("state"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut input = child.stdin.take().unwrap();
        input.write_all(b"\n").unwrap();
        let output = child.wait_with_output().unwrap();
        drop(input);
        output
    }

    fn calibration(&self) -> CalibrationFile {
        file::load(&self.0.join("calibration.toml")).unwrap_or_else(|e| panic!("{e}"))
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

/// `hil-mock serve sensor-wand`, ended with this.
struct Mock {
    child: Child,
    projector: String,
    sensor: String,
}

impl Mock {
    fn start(arguments: &[&str]) -> Self {
        let mut child = Command::new(program("hil-mock"))
            .args(["serve", "sensor-wand", "--port", "pty"])
            .args(arguments)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let mut after = |words: &str| loop {
            let line = lines.next().expect("the mock says where its ports are").unwrap();
            if let Some(path) = line.strip_prefix(words) {
                return path.trim().to_owned();
            }
        };
        let sensor = after("light sensor on ");
        let projector = after("bit-plane projector on ");
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, projector, sensor }
    }
}

impl Drop for Mock {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The mock's projector as its arguments say: an oracle that shares nothing with the solvers.
fn truth(width: u32, height: u32, focal_px: f64) -> ProjectorOptics {
    let brown = [-0.06, 0.02, 0.0005, -0.0003, 0.0];
    ProjectorOptics { brown, ..ProjectorOptics::along_z([0.0, 0.0, 1.4], focal_px, width, height) }
}

#[test]
fn a_wand_with_a_sensor_finds_lens_pose_tip_and_latency() {
    let mock =
        Mock::start(&["--raster", "128x96", "--focal", "225", "--command-port", "15710", "--seed", "7"]);
    let folder = Folder::new("sensor");
    folder.write(
        "rig.toml",
        &format!(
            "[projector]\nwidth = 128\nheight = 96\nframe_rate = \"48\"\n\
             backend = {{ kind = \"serial\", port = \"{}\" }}\n\
             [tracker]\nkind = \"natnet\"\ncommand_port = 15710\ndata_port = 15711\n\
             [real_time]\npace = \"real\"\n",
            mock.projector
        ),
    );
    let ruler = folder.dpm(&["calibrate", "wand", "rig.toml", "--tip", "11,-4,119"]);
    assert!(ruler.status.success(), "{}", text(&ruler));
    let solved =
        folder.dpm(&["calibrate", "projector", "rig.toml", "--sensor", &mock.sensor, "--seconds", "20"]);
    assert!(solved.status.success(), "{}", text(&solved));
    println!("{}", text(&solved));
    let file = folder.calibration();
    let (section, truth) = (file.projector.unwrap(), truth(128, 96, 225.0));
    let camera = section.camera().unwrap();
    let mut errors: Vec<f64> = Vec::new();
    for i in 0..1000u32 {
        let part = |k: u32| f64::from(i / k % 10) / 9.0 - 0.5;
        // Where the mock's hand was.
        let world = DVec3::new(0.3 * part(1), 0.22 * part(10), 0.12 + 0.2 * part(100));
        let should = truth.pixel_of(world.to_array()).unwrap();
        let is = camera.project(world).unwrap();
        errors.push((is.x - should[0]).hypot(is.y - should[1]));
    }
    errors.sort_by(f64::total_cmp);
    let (p50, p99) = (errors[500], errors[989]);
    println!("light off by {p50:.4} px median, {p99:.4} px 99th percentile of 128 x 96");
    // A pixel of this raster is 6 mm wide, and most of the error is that of the sensor's place in the wand, which the
    // prediction knows. It covers 98 of 100 draws; half as much again covers a busy machine, too.
    let predicted = section.predicted_p99_px;
    assert!(predicted < 0.4, "the prediction is worth nothing: {predicted} px");
    assert!(p99 < 1.5 * predicted, "{p50} px, {p99} px, predicted {predicted} px");
    let wand = file.wand.unwrap();
    let off = (DVec3::from_array(wand.tip) - DVec3::new(0.01, -0.005, 0.12)).length();
    assert!(off < 1.5e-3, "the sensor is {:.2} mm beside its place", 1e3 * off);
    let latency = file.latency.unwrap();
    assert!(latency.latency_us.abs() < 500.0, "{latency:?}");
}

/// Points of a projector with a lens, as an operator might have measured them: `x y z column row`.
fn points(deep: bool) -> String {
    let truth = truth(1024, 768, 1800.0);
    let mut lines = String::new();
    for i in 0..24u32 {
        let part = |k: f64| (f64::from(i) * k).fract() - 0.5;
        let z = if deep { 0.8 * part(0.381) } else { 0.1 };
        let world = [0.6 * part(0.618), 0.45 * part(0.755), z];
        let [x, y] = truth.pixel_of(world).unwrap();
        // Half the error of aiming by hand, to either side.
        let (dx, dy) = (0.3 * part(0.123), 0.3 * part(0.877));
        lines += &format!("{} {} {} {} {}\n", world[0], world[1], world[2], x + dx, y + dy);
    }
    lines
}

#[test]
fn points_become_a_projector_that_the_rig_uses_and_flat_ones_are_refused() {
    let folder = Folder::new("points");
    folder.write("rig.toml", "[projector]\nframe_rate = \"60\"\n");
    folder.write("points.txt", &points(true));
    folder.write("flat.txt", &points(false));
    let flat = folder.dpm(&["calibrate", "projector", "rig.toml", "--points", "flat.txt"]);
    assert_eq!(flat.status.code(), Some(2), "{}", text(&flat));
    assert!(text(&flat).contains("plane"), "{}", text(&flat));
    let solved = folder.dpm(&["calibrate", "projector", "rig.toml", "--points", "points.txt"]);
    assert!(solved.status.success(), "{}", text(&solved));
    let again = folder.dpm(&["calibrate", "projector", "rig.toml", "--points", "points.txt"]);
    assert!(text(&again).contains("calibration.toml.1.old"), "the old file is kept: {}", text(&again));
    folder
        .write("rig.toml", "[projector]\nframe_rate = \"60\"\n[calibration]\nfile = \"calibration.toml\"\n");
    let exported = folder.dpm(&["calibrate", "export", "rig.toml", "out.yml"]);
    assert!(exported.status.success(), "{}", text(&exported));
    let camera = folder.calibration().projector.unwrap().camera().unwrap();
    let written = std::fs::read_to_string(folder.0.join("out.yml")).unwrap();
    assert!(
        written.contains(&format!("{:?}", camera.fx)),
        "the rig's projector is the measured one: {written}"
    );
    let truth = truth(1024, 768, 1800.0);
    for world in [[0.0, 0.0, 0.0], [0.2, 0.1, -0.3], [-0.2, -0.15, 0.3]] {
        let (is, should) =
            (camera.project(DVec3::from_array(world)).unwrap(), truth.pixel_of(world).unwrap());
        let off = (is.x - should[0]).hypot(is.y - should[1]);
        assert!(off < 0.5, "{world:?}: {off} px");
    }
}
