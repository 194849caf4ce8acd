//! The steps of a rig's calibration for its guided page.

use super::doctor::serial_ports;
use super::session::Runner;
use dpm_page::calibration::{Act, Guide, StepSession};
use dpm_rig::calibration_steps::{calibration_file, About, CalibrationStep, Steps};
use dpm_rig::config::RigConfig;
use dpm_rig::control::rig_name;
use std::path::Path;
use std::time::SystemTime;

/// The steps of the rig of this process.
#[derive(Debug)]
pub(super) struct RigGuide {
    config: RigConfig,
    running_since: Option<SystemTime>,
    /// What does the steps; `None` while the rig runs.
    runner: Option<Runner>,
}

impl RigGuide {
    /// For a rig that runs from now on.
    pub(super) fn of_run(config: &RigConfig) -> Self {
        Self { config: config.clone(), running_since: Some(SystemTime::now()), runner: None }
    }

    /// For a rig that does not run, so that its steps can be done. `flags` are those of `--set`.
    pub(super) fn at_rest(config: &RigConfig, flags: &[String]) -> Self {
        let file = calibration_file(Path::new(rig_name()), config);
        Self { config: config.clone(), running_since: None, runner: Some(Runner::new(file, flags)) }
    }

    /// The steps by the rig's calibration file, or by another one.
    fn steps_by(&self, file: Option<&Path>) -> Steps {
        Steps::of(&About {
            rig: Path::new(rig_name()),
            config: &self.config,
            file,
            now: SystemTime::now(),
            running_since: self.running_since,
        })
    }

    /// What a step has measured that differs from the rig's calibration file.
    fn proposed(&self, trial: &Path) -> Vec<(String, String, String)> {
        let (old, new) = (self.steps(), self.steps_by(Some(trial)));
        let quality =
            |step: &CalibrationStep| step.measured.as_ref().map_or_else(String::new, |m| m.quality.clone());
        let pairs = old.steps.iter().zip(&new.steps).filter(|(old, new)| old.measured != new.measured);
        pairs.map(|(old, new)| (new.title.clone(), quality(old), quality(new))).collect()
    }
}

impl Guide for RigGuide {
    fn steps(&self) -> Steps {
        self.steps_by(None)
    }

    fn session(&self) -> Option<StepSession> {
        let (mut session, trial) = self.runner.as_ref()?.session();
        if let Some(trial) = trial {
            session.proposed = self.proposed(&trial);
        }
        Some(session)
    }

    fn act(&self, act: Act) -> Result<(), String> {
        let told = "the rig runs, and needs its projector for itself; end it, and use `dpm calibrate page`";
        let runner = self.runner.as_ref().ok_or(told)?;
        match act {
            Act::Start { step, way, sensor, gain } => {
                let steps = self.steps();
                let known = steps.steps.iter().find(|s| s.id == step).ok_or("there is no such step")?;
                let chosen = known.ways.get(way).ok_or("there is no such way to do this step")?;
                runner.start((&step, way), &chosen.words, sensor.as_deref(), gain)
            }
            Act::Answer(line) => runner.answer(&line),
            Act::Stop => runner.stop(),
            Act::Keep => runner.keep(),
            Act::Discard => runner.discard(),
        }
    }

    fn ports(&self) -> Vec<String> {
        let projector = self.config.projector.backend.port();
        let tracker = self.config.tracker.port();
        let is_taken = |port: &String| [projector, tracker].contains(&Some(port));
        serial_ports().into_iter().filter(|port| !is_taken(port)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::config::{Overrides, Purpose};

    fn guide() -> RigGuide {
        let text = "[projector]\nbackend = { kind = \"serial\", port = \"/dev/ttyACM1\" }\n[tracker]\nkind = \"natnet\"\n\
                    [real_time]\npace = \"real\"\n[[scene.bodies]]\nname = \"hare\"\n[[scene.bodies]]\nname = \"the fox\"\n";
        let purpose = Purpose { at_rest: true, calibrates: true, ..Purpose::default() };
        let config = RigConfig::parse_for("rig.toml", text, Path::new(""), &Overrides::default(), purpose);
        RigGuide::of_run(&config.unwrap())
    }

    #[test]
    fn every_command_of_a_step_is_one_that_the_program_takes() {
        let steps = guide().steps().steps;
        let mut commands = 0;
        for way in steps.iter().flat_map(|step| &step.ways) {
            let words = std::iter::once("dpm").chain(way.words.iter().map(String::as_str));
            if let Err(e) = crate::cli::command().try_get_matches_from(words) {
                panic!("{}: {e}", way.line);
            }
            commands += 1;
        }
        assert!(commands >= 14, "{commands}");
    }

    #[test]
    fn a_rig_that_runs_does_no_step() {
        let guide = guide();
        assert_eq!(guide.session(), None);
        for act in [Act::Stop, Act::Keep, Act::Start { step: "wand".into(), way: 0, sensor: None, gain: 0 }] {
            assert!(guide.act(act).unwrap_err().contains("the rig runs"));
        }
    }
}
