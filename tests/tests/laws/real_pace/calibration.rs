//! `dpm calibrate` as an operator uses it, with the projector, the tracker and the light sensor in a process of their own.

use dpm_calibration::file::{self, CalibrationFile};
use dpm_tests::programs::{program, RunFolder, Talk};
use dpm_tests::sensor_wand::SensorWandMock as Mock;
use glam::{DAffine3, DQuat, DVec3};
use hil_mock::sensor_wand::ProjectorOptics;
use std::io::Write;
use std::process::{Child, Output, Stdio};
use std::time::Duration;

/// A folder for the commands of `dpm`.
struct Folder(RunFolder);

impl Folder {
    fn new(name: &str) -> Self {
        Self(RunFolder::new(&format!("calibration-{name}")))
    }

    fn write(&self, name: &str, text: &str) {
        std::fs::write(self.0.path().join(name), text).unwrap();
    }

    fn spawn(&self, arguments: &[&str]) -> Child {
        self.0
            .command(program("dpm"))
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    }

    /// Runs `dpm` here, to talk with it.
    fn talk(&self, arguments: &[&str]) -> Talk {
        Talk::with(self.spawn(arguments))
    }

    /// Runs `dpm` here with a line on its standard input.
    fn dpm(&self, arguments: &[&str]) -> Output {
        let mut child = self.spawn(arguments);
        let mut input = child.stdin.take().unwrap();
        // A command that refuses what it was given may have ended before the line was there for it.
        if let Err(e) = input.write_all(b"\n") {
            assert_eq!(e.kind(), std::io::ErrorKind::BrokenPipe, "{e}");
        }
        let output = child.wait_with_output().unwrap();
        drop(input);
        output
    }

    /// As [`Folder::dpm`], for a command that succeeds; gives what it said.
    fn done(&self, arguments: &[&str]) -> String {
        let output = self.dpm(arguments);
        let told = text(&output);
        assert!(output.status.success(), "{arguments:?}: {told}");
        told
    }

    fn calibration(&self) -> CalibrationFile {
        file::load(&self.0.path().join("calibration.toml")).unwrap_or_else(|e| panic!("{e}"))
    }
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

/// The mock's projector as its arguments say: an oracle that shares nothing with the solvers.
fn truth(width: u32, height: u32, focal_px: f64) -> ProjectorOptics {
    let brown = [-0.06, 0.02, 0.0005, -0.0003, 0.0];
    ProjectorOptics { brown, ..ProjectorOptics::along_z([0.0, 0.0, 1.4], focal_px, width, height) }
}

/// How far light falls from where it belongs where the mock's hand was, pixels, in order.
fn errors_in_the_beam(file: &CalibrationFile, truth: &ProjectorOptics) -> Vec<f64> {
    let camera = file.projector.as_ref().unwrap().camera().unwrap();
    let mut errors: Vec<f64> = (0..1000u32)
        .map(|i| {
            let part = |k: u32| f64::from(i / k % 10) / 9.0 - 0.5;
            let world = DVec3::new(0.3 * part(1), 0.22 * part(10), 0.12 + 0.2 * part(100));
            let should = truth.pixel_of(world.to_array()).unwrap();
            let is = camera.project(world).unwrap();
            (is.x - should[0]).hypot(is.y - should[1])
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    errors
}

#[test]
fn a_wand_with_a_sensor_finds_lens_pose_tip_and_latency() {
    let mock =
        Mock::start(&["--raster", "128x96", "--focal", "225", "--command-port", "15710", "--seed", "7"]);
    let folder = Folder::new("sensor");
    folder.write("rig.toml", &mock.rig([128, 96], 72, 15710));
    folder.done(&["calibrate", "wand", "rig.toml", "--tip", "11,-4,119"]);
    let told =
        folder.done(&["calibrate", "projector", "rig.toml", "--sensor", &mock.sensor, "--seconds", "14"]);
    println!("{told}");
    let file = folder.calibration();
    let errors = errors_in_the_beam(&file, &truth(128, 96, 225.0));
    let section = file.projector.unwrap();
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

/// The light of binary planes lies unevenly in the frame, and the latency must be that of the light nevertheless.
#[test]
fn frames_and_their_inverse_do_the_same_on_a_projector_of_binary_planes() {
    let mut mock =
        Mock::start(&["--raster", "128x96", "--focal", "225", "--command-port", "15740", "--seed", "5"]);
    let folder = Folder::new("frames");
    folder.write("rig.toml", &mock.rig([128, 96], 120, 15740));
    folder.done(&["calibrate", "wand", "rig.toml", "--tip", "11,-4,119"]);
    mock.order("visit");
    let sensor = mock.sensor.clone();
    let mut held_as_told = |arguments: &[&str]| {
        let mut talk = folder.talk(arguments);
        talk.say("");
        // A machine with other work makes it try lower rates, at which a place takes longer.
        while talk.until_one(&["and hold the wand still for ", "written: ", "error: "]).0 == 0 {
            mock.order(&format!("visit {}", talk.until(" s at each place")));
        }
        let (code, told) = talk.end();
        assert_eq!(code, Some(0), "{arguments:?}: {told}");
        told
    };
    let frames = ["calibrate", "projector", "rig.toml", "--sensor", &sensor, "--code", "frames"];
    let too_bright = folder.dpm(&[&frames[..], &["--seconds", "6"]].concat());
    assert_eq!(too_bright.status.code(), Some(2), "{}", text(&too_bright));
    assert!(text(&too_bright).contains("choose a lower --gain"), "{}", text(&too_bright));
    let told = held_as_told(&[&frames[..], &["--gain", "6", "--seconds", "42"]].concat());
    let file = folder.calibration();
    let errors = errors_in_the_beam(&file, &truth(128, 96, 225.0));
    let predicted = file.projector.as_ref().unwrap().predicted_p99_px;
    let latency = file.latency.unwrap();
    println!(
        "{told}light off by {:.3} px median, {:.3} px 99th percentile; {latency:?}",
        errors[500], errors[989]
    );
    // As above, half as much again covers a busy machine.
    assert!(predicted < 1.0 && errors[989] < 1.5 * predicted, "{}, predicted {predicted}", errors[989]);
    // On an idle machine it is a tenth of a millisecond; builds beside it made it 0.18 ms. The middle of the slot instead of the
    // centre of its light would be 2.6 ms off.
    assert!(latency.latency_us.abs() < 600.0 && latency.sigma_us < 300.0, "{latency:?}");
}

/// Points all over the picture of a wide lens, aimed at with an error of 0.05 pixels: `x y z column row`.
fn points_of_a_wide_lens(truth: &ProjectorOptics) -> String {
    let mut lines = String::new();
    for i in 0..600u32 {
        let part = |k: f64| (f64::from(i) * k).fract();
        let pixel = [1024.0 * part(0.618_034), 768.0 * part(0.754_878)];
        let world = truth.lit_near(pixel, [0.0, 0.0, 0.4 - 0.8 * part(0.380_197)]).unwrap();
        let noise = |k: f64| 0.17 * (part(k) - 0.5);
        lines += &format!(
            "{} {} {} {} {}\n",
            world[0],
            world[1],
            world[2],
            pixel[0] + noise(0.123_7),
            pixel[1] + noise(0.877_3)
        );
    }
    lines
}

#[test]
fn a_rational_lens_is_kept_where_the_points_tell_it_and_refused_where_they_do_not() {
    let folder = Folder::new("rational");
    folder.write("rig.toml", "[projector]\nframe_rate = \"60\"\n");
    let wide = ProjectorOptics {
        brown: [0.6, 0.1, 1e-3, -1e-3, 0.02],
        quotient: [0.8, 0.2, 0.01],
        ..truth(1024, 768, 520.0)
    };
    folder.write("wide.txt", &points_of_a_wide_lens(&wide));
    folder.write("narrow.txt", &points(true));
    let solve = |points: &'static str, lens: &'static str| {
        ["calibrate", "projector", "rig.toml", "--points", points, "--lens", lens]
    };
    let narrow = folder.dpm(&solve("narrow.txt", "rational"));
    assert_eq!(narrow.status.code(), Some(2), "{}", text(&narrow));
    assert!(text(&narrow).contains("--lens"), "{}", text(&narrow));
    let worst = || {
        let camera = folder.calibration().projector.unwrap().camera().unwrap();
        let places = (0..48u32).map(|i| [f64::from(i % 8) * 128.0 + 60.0, f64::from(i / 8) * 128.0 + 60.0]);
        let off = places.map(|pixel| {
            let world = wide.lit_near(pixel, [0.0, 0.0, 0.3]).unwrap();
            (camera.project(DVec3::from_array(world)).unwrap() - glam::DVec2::from_array(pixel)).length()
        });
        off.fold(0.0, f64::max)
    };
    // Five numbers do not fit such a lens: what they give is refused, or far worse.
    let brown = folder.dpm(&solve("wide.txt", "brown")).status.success().then(worst);
    folder.done(&solve("wide.txt", "rational"));
    let rational = worst();
    println!("light off by {rational:.3} px at most with eight numbers, {brown:?} with five");
    assert!(rational < 0.1 && brown.is_none_or(|px| px > 3.0 * rational), "{brown:?}, {rational} px");
    // What is written for OpenCV has them all.
    assert_eq!(folder.calibration().projector.unwrap().lens.len(), 8);
    folder.done(&[
        "calibrate",
        "export",
        "rig.toml",
        "out.yml",
        "--set",
        "calibration.file=\"calibration.toml\"",
    ]);
    let out = std::fs::read_to_string(folder.0.path().join("out.yml")).unwrap();
    let k6 = folder.calibration().projector.unwrap().lens[7];
    assert!(out.contains(&format!("{k6:?}")), "{k6} is not in {out}");
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
    // The rig file names the calibration file that will come.
    folder
        .write("rig.toml", "[projector]\nframe_rate = \"60\"\n[calibration]\nfile = \"calibration.toml\"\n");
    let none = folder.dpm(&["calibrate", "export", "rig.toml", "out.yml"]);
    assert_eq!(none.status.code(), Some(2), "there is nothing to export: {}", text(&none));
    folder.write("points.txt", &points(true));
    folder.write("flat.txt", &points(false));
    let flat = folder.dpm(&["calibrate", "projector", "rig.toml", "--points", "flat.txt"]);
    assert_eq!(flat.status.code(), Some(2), "{}", text(&flat));
    assert!(text(&flat).contains("plane"), "{}", text(&flat));
    folder.done(&["calibrate", "projector", "rig.toml", "--points", "points.txt"]);
    let again = folder.done(&["calibrate", "projector", "rig.toml", "--points", "points.txt"]);
    assert!(again.contains("calibration.toml.1.old"), "the old file is kept: {again}");
    folder.done(&["calibrate", "export", "rig.toml", "out.yml"]);
    let camera = folder.calibration().projector.unwrap().camera().unwrap();
    let written = std::fs::read_to_string(folder.0.path().join("out.yml")).unwrap();
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

/// Where the mesh truly is in the body, which only the hand with the wand knows.
fn mesh_in_body() -> DAffine3 {
    DAffine3::from_rotation_translation(
        DQuat::from_rotation_y(0.2) * DQuat::from_rotation_x(-0.1),
        DVec3::new(0.02, -0.01, 0.03),
    )
}

const BODY_AT: DVec3 = DVec3::new(0.03, 0.02, 0.05);

/// The numbers in the last brackets of a question.
fn place_in(question: &str) -> DVec3 {
    let inside = question.rsplit('(').next().unwrap().split(')').next().unwrap();
    let numbers: Vec<f64> = inside.split(',').map(|n| n.trim().parse().unwrap()).collect();
    DVec3::from_slice(&numbers)
}

fn words(p: DVec3) -> String {
    format!("{} {} {}", p.x, p.y, p.z)
}

/// A folder with the rig file of a projector of 256 x 192 pixels, with a bunny whose mesh is not at its tracked place, and the mock of both.
fn with_bunny(name: &str, rate: u32, command_port: u16, more: &[&str]) -> (Folder, Mock) {
    let (port, body) = (command_port.to_string(), format!("bunny:{}", words(BODY_AT).replace(' ', ",")));
    let optics = ["--raster", "256x192", "--focal", "450", "--command-port", &port, "--body", &body];
    let mock = Mock::start(&[&optics[..], more].concat());
    let folder = Folder::new(name);
    let tail = "[[scene.bodies]]\nname = \"bunny\"\n";
    folder.write("rig.toml", &(mock.rig([256, 192], rate, command_port) + tail));
    (folder, mock)
}

/// Touches the points of the mesh that are asked for.
fn touch_body(folder: &Folder, mock: &mut Mock, points: usize) -> Talk {
    let mut dpm = folder.talk(&["calibrate", "body", "rig.toml", "--body", "bunny", "--wander", "0"]);
    for _ in 0..points {
        dpm.until("\npoint ");
        let mesh = place_in(&dpm.until(" m:"));
        mock.order(&format!("touch bunny {}", words(mesh_in_body().transform_point3(mesh))));
        dpm.say("");
        dpm.until_one(&["noted", "residual"]);
    }
    dpm
}

/// Holds the tip into each dot, then to the point of the body that was meant.
fn check_light(folder: &Folder, mock: &mut Mock, points: usize) -> (Option<i32>, String) {
    let count = points.to_string();
    let mut dpm = folder.talk(&["calibrate", "check", "rig.toml", "--points", &count, "--limit", "1.5"]);
    for _ in 0..points {
        dpm.until(", at ");
        let place = mesh_in_body().transform_point3(place_in(&dpm.until(" of the mesh: tip into the dot:")));
        // The dot of the point before may still be shown for some frames.
        std::thread::sleep(Duration::from_millis(300));
        mock.order(&format!("dot {}", words(BODY_AT + place)));
        dpm.say("");
        dpm.until("now touch this point of the body:");
        mock.order(&format!("touch bunny {}", words(place)));
        dpm.say("");
    }
    dpm.end()
}

/// How far light on the body falls from where it belongs, pixels: by the calibration file, and by the mock's own optics.
fn errors(file: &CalibrationFile, truth: &ProjectorOptics) -> Vec<f64> {
    let camera = file.projector.as_ref().unwrap().camera().unwrap();
    let mesh_to_body = file.bodies["bunny"].mesh_to_body.to_affine();
    let mut errors: Vec<f64> = (0..27u32)
        .map(|i| {
            let part = |k: u32| f64::from(i / k % 3) - 1.0;
            let mesh = 0.08 * DVec3::new(part(1), part(3), part(9));
            let should =
                truth.pixel_of((BODY_AT + mesh_in_body().transform_point3(mesh)).to_array()).unwrap();
            let is = camera.project(BODY_AT + mesh_to_body.transform_point3(mesh)).unwrap();
            (is.x - should[0]).hypot(is.y - should[1])
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    errors
}

/// The whole chain, in the order of the manual's page, against lens, pose, tip, place of the mesh, latency and droop that
/// only the mock and the hand know.
#[test]
fn from_a_wand_to_checked_light() {
    let (folder, mut mock) = with_bunny("chain", 90, 15720, &["--seed", "3", "--droop", "0.1"]);
    let sensor = mock.sensor.clone();

    mock.order("pivot 0 0 0.1");
    folder.done(&["calibrate", "wand", "rig.toml", "--seconds", "4"]);

    mock.order("wander");
    folder.done(&["calibrate", "projector", "rig.toml", "--sensor", &sensor, "--seconds", "12"]);

    let mut dpm = touch_body(&folder, &mut mock, 4);
    dpm.say("d");
    let (code, told) = dpm.end();
    assert_eq!(code, Some(0), "{told}");

    mock.order("wander");
    folder.done(&["calibrate", "latency", "rig.toml", "--sensor", &sensor, "--seconds", "7"]);

    mock.order("tip 0 0 0");
    let light = ["calibrate", "light", "rig.toml", "--sensor", &sensor, "--gain", "6", "--codes", "4"];
    folder.done(&[&light[..], &["--set", "projector.frame_rate=160"]].concat());

    let (code, told) = check_light(&folder, &mut mock, 2);
    assert_eq!(code, Some(0), "{told}");
    assert!(told.contains("no error is larger"), "{told}");

    let file = folder.calibration();
    let errors = errors(&file, &truth(256, 192, 450.0));
    let predicted = file.projector.as_ref().unwrap().predicted_p99_px;
    println!(
        "light off by {:.3} px median, {:.3} px at most; {predicted:.3} px predicted",
        errors[13], errors[26]
    );
    // A pixel of this raster is 3 mm wide.
    assert!(errors[26] < 0.5 && errors[26] < 2.0 * predicted, "{errors:?}, predicted {predicted}");
    let late = file.latency.unwrap();
    assert!(late.latency_us.abs() < 500.0, "{late:?}");
    let light = file.light.unwrap().model().unwrap();
    for (channel, colour) in [0.35, 0.4, 0.25].into_iter().enumerate() {
        let intensity = light.channels.intensity[channel];
        assert!((intensity - colour).abs() < 0.01, "channel {channel}: {intensity}");
        // Code 128 is the plane of bit 7 alone, which loses a tenth.
        let half = light.channels.level(channel, 128.0 / 255.0) / light.channels.level(channel, 1.0);
        let plane = |bit: u32| f64::from(1u32 << bit) * (1.0 - 0.1 * f64::from(1u32 << bit) / 128.0);
        let should = plane(7) / (0..8).map(plane).sum::<f64>();
        assert!((half - should).abs() < 0.01, "channel {channel}: {half}, {should}");
    }
}

#[test]
fn a_mesh_that_was_moved_by_hand_is_found_by_the_next_check() {
    let (folder, mut mock) = with_bunny("nudge", 60, 15730, &[]);
    let truth = truth(256, 192, 450.0);
    let points: String = (0..64u32)
        .map(|i| {
            let part = |k: u32| f64::from(i / k % 4) / 3.0 - 0.5;
            let world = [0.5 * part(1), 0.4 * part(4), 0.6 * part(16)];
            let [x, y] = truth.pixel_of(world).unwrap();
            format!("{} {} {} {x} {y}\n", world[0], world[1], world[2])
        })
        .collect();
    folder.write("points.txt", &points);
    folder.done(&["calibrate", "wand", "rig.toml", "--tip", "10,-5,120"]);
    folder.done(&["calibrate", "projector", "rig.toml", "--points", "points.txt"]);
    // An interrupted session goes on where it stopped.
    drop(touch_body(&folder, &mut mock, 2));
    let mut dpm = touch_body(&folder, &mut mock, 2);
    dpm.say("d");
    let (code, told) = dpm.end();
    assert_eq!(code, Some(0), "{told}");
    assert!(told.contains("Going on with 2 points"), "{told}");
    let mut dpm = folder.talk(&["calibrate", "nudge", "rig.toml", "--body", "bunny", "--step", "20"]);
    dpm.until("degrees:");
    dpm.say("xxXxw");
    dpm.until("written");
    dpm.say("q");
    let (code, told) = dpm.end();
    assert_eq!(code, Some(0), "{told}");
    let (code, told) = check_light(&folder, &mut mock, 2);
    assert_eq!(code, Some(1), "{told}");
    assert!(told.contains("the mesh in the body"), "{told}");
}
