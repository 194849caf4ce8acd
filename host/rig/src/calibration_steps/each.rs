//! The steps one by one, with their needs and commands.

use super::judged::{day, FileVerdict, Part};
use super::{CalibrationStep, StepStatus, Way, SENSOR};
use crate::config::PlaneTiming;
use dpm_calibration_file::{CheckSection, Provenance};
use std::path::Path;

/// The wand's name where the commands need no flag for it.
const USUAL_WAND: &str = "wand";

/// All steps, in the order of `docs/CALIBRATION.md`.
pub(super) fn steps(judged: &FileVerdict) -> Vec<CalibrationStep> {
    let names: Vec<&str> = judged.about.config.scene.bodies.iter().map(|b| b.name.as_str()).collect();
    let mut all = vec![aim(judged), wand(judged), projector(judged)];
    all.extend(names.iter().map(|name| body(judged, name)));
    all.push(light(judged));
    all.extend(names.iter().map(|name| check(judged, name)));
    all.extend([nudge(judged, &names), export(judged), latency(judged)]);
    all
}

/// A word of a command for a shell.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./:,=+@%".contains(c);
    match !word.is_empty() && word.chars().all(is_plain) {
        true => word.to_owned(),
        false => format!("'{}'", word.replace('\'', "'\\''")),
    }
}

/// A command of `dpm`: its words before and after the rig file.
fn way(judged: &FileVerdict, told: &str, before: &[&str], after: &[&str]) -> Way {
    let rig = judged.about.rig.display().to_string();
    let words: Vec<String> =
        before.iter().copied().chain([rig.as_str()]).chain(after.iter().copied()).map(String::from).collect();
    let line = words.iter().fold("dpm".to_owned(), |line, word| line + " " + &quoted(word));
    Way { told: told.into(), words, line, answers: Vec::new() }
}

/// A command of `dpm calibrate`, with the wand's name where it is not the usual one.
fn calibrate(judged: &FileVerdict, told: &str, what: &str, after: &[&str]) -> Way {
    let name = wand_name(judged);
    let mut words = after.to_vec();
    if name != USUAL_WAND {
        words.extend(["--wand", name]);
    }
    way(judged, told, &["calibrate", what], &words)
}

impl Way {
    fn answered(mut self, answers: &[(&'static str, &'static str)]) -> Self {
        self.answers = answers.to_vec();
        self
    }
}

/// The wand by its name in the tracking software, as far as it is known.
fn wand_name<'a>(judged: &'a FileVerdict) -> &'a str {
    let device = judged.file.wand.as_ref().map(|wand| wand.provenance.device.as_str());
    device.filter(|name| !name.is_empty()).unwrap_or(USUAL_WAND)
}

/// The wand, and where it is tracked.
fn need_wand(judged: &FileVerdict) -> String {
    let from = judged.about.config.tracker.place();
    format!("the wand, which {from} reports as \"{}\"", wand_name(judged))
}

fn step(id: &str, title: &str, gives: &'static str) -> CalibrationStep {
    let (id, title) = (id.to_owned(), title.to_owned());
    let (state, told) = (StepStatus::Missing, String::new());
    CalibrationStep { id, title, gives, needs: Vec::new(), state, told, measured: None, ways: Vec::new() }
}

impl CalibrationStep {
    fn with(mut self, (state, told, measured): Part) -> Self {
        (self.state, self.told, self.measured) = (state, told, measured);
        self
    }

    /// A step that was not measured and needs the wand's tip.
    fn after_wand(mut self, judged: &FileVerdict) -> Self {
        if self.measured.is_none() && self.state == StepStatus::Missing && judged.file.wand.is_none() {
            (self.state, self.told) = (StepStatus::Waits, "It needs the wand's tip first.".into());
        }
        self
    }
}

fn aim(judged: &FileVerdict) -> CalibrationStep {
    let mut step = step("pattern", "Sharpen and aim the picture", "a sharp picture where the bodies move");
    step.state = StepStatus::Unrecorded;
    step.needs = vec!["the projector, and your eyes".into()];
    step.ways = vec![
        way(
            judged,
            "A star, to turn the lens until it is sharp. The command runs until you stop it.",
            &["pattern", "focus-star"],
            &[],
        ),
        way(judged, "A grid, to aim the projector by.", &["pattern", "grid"], &[]),
    ];
    step
}

fn wand(judged: &FileVerdict) -> CalibrationStep {
    let mut step = step("wand", "Find the tip of the wand", "where the tip is in the wand's body");
    step.needs = vec![need_wand(judged), "a small dent in which the tip can turn, for 15 s".into()];
    step.ways = vec![calibrate(judged, "Turn the wand about its tip.", "wand", &[])];
    match &judged.file.wand {
        None => step,
        Some(wand) => {
            let quality = format!("the tip is known to {:.2} mm", 1e3 * wand.tip_sigma_m);
            step.with((StepStatus::Done, String::new(), judged.measured(quality, &wand.provenance)))
        }
    }
}

fn projector(judged: &FileVerdict) -> CalibrationStep {
    let config = &judged.about.config.projector;
    let mut step = step(
        "projector",
        "Find the projector's lens and pose",
        "lens, pose, and with the sensor the latency",
    );
    let how = match config.plane_timing() {
        PlaneTiming::Equal => "With the wand's light sensor: move it through the whole volume for 30 s.",
        _ => "With the wand's light sensor: hold it still at 8 to 20 places, near and far, for 75 s in all.",
    };
    step.needs = vec![need_wand(judged), "its light sensor, or 12 crosses to aim at by hand".into()];
    let by_sensor = calibrate(judged, how, "projector", &["--sensor", SENSOR]);
    // The sensor's codes need light without gaps.
    step.ways = config.is_lit_without_gap().then_some(by_sensor).into_iter().collect();
    step.ways.push(
        calibrate(judged, "By hand: hold the tip into one cross after another.", "projector", &[])
            .answered(&[("u", "take the last point back"), ("d", "done")]),
    );
    if let Some(section) = &judged.file.projector {
        let checks: Vec<&CheckSection> = judged.file.checks.values().collect();
        let quality = format!(
            "light within {:.2} px in 99 of 100 places, as predicted; residual {:.2} px",
            section.predicted_p99_px, section.residual_px
        );
        let part = judged.of_projector((quality, &section.provenance), Some(section.size), &checks);
        return step.with(part);
    }
    if let Some(file) = &config.calibration {
        let told = format!("Lens and pose come from {} (projector.calibration).", file.display());
        return step.with((StepStatus::Given, told, None));
    }
    step.after_wand(judged)
}

fn body(judged: &FileVerdict, name: &str) -> CalibrationStep {
    let title = format!("Find the mesh in \"{name}\"");
    let mut step =
        step(&format!("body:{name}"), &title, "where the mesh is in the body that the tracker reports");
    step.needs = vec![need_wand(judged), format!("\"{name}\", in reach of the wand")];
    let told = "Touch 4 points of it or more, then move the tip over all of it.";
    step.ways =
        vec![calibrate(judged, told, "body", &["--body", name])
            .answered(&[("s", "another point"), ("d", "done")])];
    if let Some(section) = judged.file.bodies.get(name) {
        let checks: Vec<&CheckSection> = judged.file.checks.get(name).into_iter().collect();
        let quality = section
            .residual_m
            .map_or("no residual is known".into(), |m| format!("residual {:.2} mm", 1e3 * m));
        let (state, told) = judged.by_age(&section.provenance, &checks);
        return step.with((state, told, judged.measured(quality, &section.provenance)));
    }
    let own = judged.about.config.scene.bodies.iter().find(|b| b.name == name);
    if own.is_some_and(|b| b.mesh_to_body != Default::default()) {
        let told = "The rig file gives its place (scene.bodies[].mesh_to_body).";
        return step.with((StepStatus::Given, told.into(), None));
    }
    step.after_wand(judged)
}

fn light(judged: &FileVerdict) -> CalibrationStep {
    let config = &judged.about.config.projector;
    let mut step = step(
        "light",
        "Measure the light of each code value",
        "response, brightness of the channels, black and ambient light, flat field",
    );
    step.needs = vec![
        "the wand's light sensor, put down in the beam for a minute".into(),
        "a sweep of the projector's step before it, for the flat field".into(),
    ];
    let told = "The sensor lies still near the middle of the picture. If it saturates, choose a lower gain.";
    step.ways = vec![calibrate(judged, told, "light", &["--sensor", SENSOR])];
    if let Some(section) = &judged.file.light {
        let quality = format!("levels within {:.2} % of full white", 1e2 * section.uncertainty);
        return step.with(judged.of_projector((quality, &section.provenance), None, &[]));
    }
    if config.response != Default::default() || config.flat_field.is_some() {
        let told = "The rig file gives it (projector.response, projector.flat_field).";
        return step.with((StepStatus::Given, told.into(), None));
    }
    let told = "Without it light counts as proportional to the code value, and as even over the picture.";
    step.with((StepStatus::Optional, told.into(), None))
}

fn check(judged: &FileVerdict, name: &str) -> CalibrationStep {
    let title = format!("Check the light on \"{name}\"");
    let mut step =
        step(&format!("check:{name}"), &title, "the error of the light, and what to measure again");
    step.needs = vec![need_wand(judged), format!("\"{name}\", at rest in the light")];
    let told = "Hold the tip into each dot, then onto the point of the body that was meant.";
    step.ways = vec![calibrate(judged, told, "check", &["--body", name])
        .answered(&[("s", "leave this point out"), ("d", "done")])];
    let Some(section) = judged.file.checks.get(name) else {
        let is_ready = judged.dates_of(name).next().is_some() && judged.file.wand.is_some();
        if !is_ready {
            let told = "It needs the wand's tip, and a projector or a body that was measured.";
            step = step.with((StepStatus::Waits, told.into(), None));
        }
        return step;
    };
    let quality = format!(
        "error of the light {:.2} px in the median, {:.2} px at most, of {} points",
        section.p50_px, section.largest_px, section.points
    );
    let measured = judged.measured(quality, &section.provenance);
    // Dates of one form are in the order of their letters.
    let newer = judged.dates_of(name).find(|date| *date > section.provenance.date.as_str());
    let (state, told) = match newer {
        Some(date) => {
            (StepStatus::Missing, format!("It was measured again on {}, after this check.", day(date)))
        }
        None if !section.is_within() => {
            let told = format!(
                "An error was larger than {} px. Measure again what the check named.",
                section.limit_px
            );
            (StepStatus::Wrong, told)
        }
        None => judged.by_age(&section.provenance, &[]),
    };
    step.with((state, told, measured))
}

fn nudge(judged: &FileVerdict, names: &[&str]) -> CalibrationStep {
    let mut step =
        step("nudge", "Move things by eye", "a mesh or a projector that was moved until its outlines fit");
    step.needs = vec!["your eyes, and a body at rest in the light".into()];
    let keys: Vec<(&'static str, &'static str)> = KEYS.to_vec();
    let told = "Moves the mesh of one body.";
    step.ways =
        names.iter().map(|name| way(judged, told, &["calibrate", "nudge"], &["--body", name])).collect();
    step.ways.push(way(judged, "Moves the projector.", &["calibrate", "nudge"], &["--projector"]));
    step.ways.iter_mut().for_each(|way| way.answers.clone_from(&keys));
    let places = judged.file.bodies.values().map(|b| &b.provenance);
    let all: Vec<&Provenance> = judged.file.projector.iter().map(|p| &p.provenance).chain(places).collect();
    let newest = all.into_iter().filter(|p| p.is_by_eye()).max_by(|a, b| a.date.cmp(&b.date));
    match newest {
        Some(from) => step.with((StepStatus::Given, format!("Done on {}, by eye.", day(&from.date)), None)),
        None => {
            let told = "Only where a check finds a shift, or outlines do not fit. A running rig has the same motions among its parameters.";
            step.with((StepStatus::Optional, told.into(), None))
        }
    }
}

/// What a nudge takes.
const KEYS: [(&str, &str); 15] = [
    ("x", "+x"),
    ("X", "-x"),
    ("y", "+y"),
    ("Y", "-y"),
    ("z", "+z"),
    ("Z", "-z"),
    ("a", "turn about x"),
    ("A", "and back"),
    ("b", "turn about y"),
    ("B", "and back"),
    ("c", "turn about z"),
    ("C", "and back"),
    ("u", "take the last one back"),
    ("w", "write"),
    ("q", "end"),
];

fn export(judged: &FileVerdict) -> CalibrationStep {
    let mut step = step("export", "Write lens and pose for OpenCV", "a file that other programs read");
    let out = judged.about.rig.with_file_name("projector.yml");
    step.ways = vec![way(judged, "", &["calibrate", "export"], &[&out.display().to_string()])];
    step.needs = vec!["a projector that was measured".into()];
    let told = match Path::exists(&out) {
        true => format!("{} is there.", out.display()),
        false => "Only where another program needs it.".into(),
    };
    step.with((StepStatus::Optional, told, None))
}

fn latency(judged: &FileVerdict) -> CalibrationStep {
    let mut step = step(
        "latency",
        "Measure the latency alone",
        "how late the tracker's samples and the light are together",
    );
    step.needs = vec!["the wand's light sensor, for 10 s".into()];
    let told = "Later, when settings of the tracker or of the projector have changed.";
    step.ways = vec![calibrate(judged, told, "latency", &["--sensor", SENSOR])];
    if let Some(section) = &judged.file.latency {
        let quality =
            format!("{:.3} ms, known to {:.3} ms", 1e-3 * section.latency_us, 1e-3 * section.sigma_us);
        return step.with(judged.of_projector((quality, &section.provenance), None, &[]));
    }
    if judged.about.config.tracker.frame().is_some_and(|(_, latency_us)| latency_us != 0) {
        return step.with((StepStatus::Given, "The rig file gives it (tracker.latency_us).".into(), None));
    }
    if judged.file.projector.is_none() {
        return step.with((StepStatus::Waits, "It needs the projector first.".into(), None));
    }
    step.with((
        StepStatus::Optional,
        "The projector's step with the light sensor measures it, too.".into(),
        None,
    ))
}
