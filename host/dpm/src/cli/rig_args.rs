//! The flags of every command that takes a rig, and how they become a checked [`RigConfig`].

use dpm_rig::config::{Overrides, Purpose, RigConfig};
use dpm_rig::control::set_rig_name;
use dpm_rig::failure::{Failure, FailureKind};
use std::path::{Path, PathBuf};

/// Flags that override the rig file. Each is a short form of `--set`.
#[derive(clap::Args, Clone, Debug, Default)]
pub(crate) struct RigArgs {
    /// glTF 2.0, OBJ, PLY or STL file to show instead of the rig's scene
    #[arg(long, value_name = "FILE")]
    pub scene: Option<PathBuf>,

    /// Columns and rows to trace and project, for example 640x480
    #[arg(long, value_name = "WxH")]
    pub raster: Option<String>,

    /// Frames to light
    #[arg(long, value_name = "N", conflicts_with = "seconds")]
    pub frames: Option<u64>,

    /// Seconds to run: of the wall clock at real pace, of the rig's own clock at virtual pace
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,

    /// Clock of the run: real (the wall clock) or virtual (a clock that advances one slot per frame)
    #[arg(long, value_name = "PACE", value_parser = ["real", "virtual"])]
    pub pace: Option<String>,

    /// Run with the mocks instead of the rig file's tracker and projector, whatever their kind
    #[arg(long)]
    pub simulate: bool,

    /// Show the newest tracker sample without prediction
    #[arg(long)]
    pub no_prediction: bool,

    /// Folder for images, report and trace
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,

    /// Set a key of the rig file, for example render.spp=4; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

impl RigArgs {
    /// The flags as texts for `--set`. Explicit `--set` flags come last and override the others.
    fn flags(&self) -> Result<Vec<String>, Failure> {
        let mut flags = Vec::new();
        let quoted = |path: &Path| toml::Value::String(path.display().to_string()).to_string();
        if let Some(scene) = &self.scene {
            flags.push(format!("scene.file={}", quoted(scene)));
        }
        if let Some(raster) = &self.raster {
            let sides = raster.split_once(['x', 'X']).and_then(|(w, h)| Some((number(w)?, number(h)?)));
            let Some((width, height)) = sides else {
                let told = format!("--raster {raster}: write columns x rows, for example 640x480");
                return Err(Failure::new(FailureKind::BadInput, told));
            };
            flags.push(format!("projector.width={width}"));
            flags.push(format!("projector.height={height}"));
            flags.push(format!("render.software_raster=[{width}, {height}]"));
        }
        if let Some(frames) = self.frames {
            flags.push(format!("run.frames={frames}"));
        }
        if let Some(pace) = &self.pace {
            flags.push(format!("real_time.pace={pace}"));
        }
        if self.no_prediction {
            flags.push("prediction.on=false".into());
        }
        if let Some(out) = &self.out {
            flags.push(format!("output.dir={}", quoted(out)));
        }
        flags.extend(self.set.iter().cloned());
        Ok(flags)
    }

    /// Refuses those of the flags `meaningless`, named as on the command line, that `command` would accept and then
    /// ignore.
    ///
    /// # Errors
    /// One of them is given.
    pub(super) fn refuse(&self, command: &str, meaningless: &[&str]) -> Result<(), Failure> {
        let given = [
            ("--frames", self.frames.is_some()),
            ("--seconds", self.seconds.is_some()),
            ("--pace", self.pace.is_some()),
            ("--no-prediction", self.no_prediction),
            ("--out", self.out.is_some()),
        ];
        match given.iter().find(|(flag, given)| *given && meaningless.contains(flag)) {
            None => Ok(()),
            Some((flag, _)) => {
                let told =
                    format!("{flag} means nothing to {command}: leave it out; --help lists what it takes");
                Err(Failure::new(FailureKind::BadInput, told))
            }
        }
    }

    /// Reads the rig file `path`, or the demo's if there is none, for a run. The environment and these flags override
    /// it.
    ///
    /// # Errors
    /// Every mistake in file, environment and flags.
    pub(super) fn rig(&self, path: Option<&Path>) -> Result<RigConfig, Failure> {
        self.rig_for(path, Purpose::default())
    }

    /// The same for a command that runs nothing, or that determines the number of frames itself: the end of a run in
    /// the file does not matter.
    ///
    /// # Errors
    /// As [`RigArgs::rig`].
    pub(crate) fn rig_at_rest(&self, path: Option<&Path>) -> Result<RigConfig, Failure> {
        self.rig_for(path, Purpose { at_rest: true, ..Purpose::default() })
    }

    /// The same of a rig file that is part of the program. The files that it names are relative to the working folder.
    ///
    /// # Errors
    /// As [`RigArgs::rig`].
    #[cfg(feature = "lab")]
    pub(super) fn rig_of_text(&self, name: &str, text: &str) -> Result<RigConfig, Failure> {
        let overrides = Overrides::from_environment(self.flags()?);
        let purpose = Purpose { at_rest: true, simulate: self.simulate, ..Purpose::default() };
        Ok(RigConfig::parse_for(name, text, Path::new(""), &overrides, purpose)?)
    }

    /// The same with other `keys`, as `--set` takes them; `None` if the rig file refuses them.
    pub(super) fn with_keys(&self, path: Option<&Path>, keys: &[&str]) -> Option<RigConfig> {
        let mut other = self.clone();
        other.set.extend(keys.iter().map(|key| (*key).to_owned()));
        other.rig_at_rest(path).ok()
    }

    /// The same for a command that measures what the calibration file will hold.
    ///
    /// # Errors
    /// As [`RigArgs::rig`].
    pub(super) fn rig_to_calibrate(&self, path: &Path) -> Result<RigConfig, Failure> {
        self.rig_for(Some(path), Purpose { at_rest: true, calibrates: true, ..Purpose::default() })
    }

    /// Reads the rig file `path` for a command that uses nothing but its projector, until it is stopped: the end of a
    /// run in the file does not matter, and what the scene and the tracker are does not either. `at_rest`: nothing
    /// runs.
    ///
    /// # Errors
    /// As [`RigArgs::rig`].
    pub(super) fn rig_of_projector(&self, path: &Path, at_rest: bool) -> Result<RigConfig, Failure> {
        let purpose = Purpose { at_rest, projector_only: true, ..Purpose::default() };
        let mut endless = self.clone();
        if self.frames.is_none() && self.seconds.is_none() {
            endless.set.splice(0..0, ["run.frames=0".to_owned(), "run.seconds=0.0".to_owned()]);
        }
        endless.rig_for(Some(path), purpose)
    }

    fn rig_for(&self, path: Option<&Path>, purpose: Purpose) -> Result<RigConfig, Failure> {
        // Clients that give orders to this process are informed which rig it is.
        path.into_iter().for_each(set_rig_name);
        let read = |flags: Vec<String>, at_rest: bool| {
            let overrides = Overrides::from_environment(flags);
            let purpose = Purpose { simulate: self.simulate, at_rest, ..purpose };
            match path {
                Some(path) => RigConfig::load_for(path, &overrides, purpose),
                None => RigConfig::demo_for(&overrides, purpose),
            }
        };
        let mut flags = self.flags()?;
        if self.raster.is_some() {
            // A calibration refers to the raster in the file, which is visible only without the flag.
            let without = Self { raster: None, ..self.clone() }.flags()?;
            let calibrated = read(without, true).ok().map(|rig| rig.projector);
            if let Some(p) = calibrated.filter(|p| p.calibration.is_some() && p.calibration_raster.is_none())
            {
                flags.insert(0, format!("projector.calibration_raster=[{}, {}]", p.width, p.height));
            }
        }
        let Some(seconds) = self.seconds else { return Ok(read(flags, purpose.at_rest)?) };
        if !(seconds > 0.0 && seconds <= 1e9) {
            let told = format!("--seconds {seconds:?}: must be above 0 and at most 1e9");
            return Err(Failure::new(FailureKind::BadInput, told));
        }
        flags.extend(["run.frames=0".to_owned(), format!("run.seconds={seconds:?}")]);
        Ok(read(flags, purpose.at_rest)?)
    }
}

/// A side of a raster, as given in the flag. The configuration checks its range.
fn number(text: &str) -> Option<u64> {
    text.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::rig::Rig;
    use dpm_scene::geometry::projector::ProjectorCamera;
    use glam::DVec3;

    fn rig(change: impl FnOnce(&mut RigArgs)) -> Result<RigConfig, Failure> {
        let mut args = RigArgs::default();
        change(&mut args);
        args.rig(None)
    }

    #[test]
    fn flags_reach_their_keys_and_set_wins() {
        let rig = rig(|a| {
            a.raster = Some("64x48".into());
            a.frames = Some(9);
            a.no_prediction = true;
            a.out = Some("a \"b\"".into());
            a.set = vec!["projector.height=50".into()];
        })
        .unwrap();
        assert_eq!((rig.projector.width, rig.projector.height, rig.run.frames), (64, 50, 9));
        assert_eq!(rig.render.software_raster, [64, 48]);
        assert!(!rig.prediction.on);
        assert_eq!(rig.output.dir, Path::new("a \"b\""));
    }

    /// Found in use, O9: `--seconds` counted frames, so a slow renderer ran for an arbitrary time. Seconds are slots,
    /// however many frames that makes.
    #[test]
    fn seconds_become_slots_at_the_rigs_own_rate() {
        let slots = |seconds: f64, set: &[&str]| {
            let rig = rig(|a| {
                a.seconds = Some(seconds);
                a.set = set.iter().map(|s| (*s).to_owned()).collect();
            })
            .unwrap();
            assert_eq!(rig.run.frames, 0, "the demo's own number of frames does not end the run");
            rig.slots_to_run()
        };
        assert_eq!(slots(1.0, &[]), 947);
        assert_eq!(slots(10.0, &["projector.frame_rate=\"60000/1001\""]), 599);
        assert_eq!(slots(1e-9, &[]), 1);
        assert_eq!(slots(3.0, &["real_time.pace=real"]), 2841);
        assert_eq!(rig(|_| {}).unwrap().slots_to_run(), 0);
    }

    /// Found in use, O11: a rig file with real devices could not be tried without them. Its keys are still checked.
    #[test]
    fn any_rig_can_be_simulated() {
        let dir = std::env::temp_dir().join(format!("dpm-simulate-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let path = dir.join("rig.toml");
        let real = "[projector.backend]\nkind = \"usb\"\nserial_number = \"7\"\n[tracker]\nkind = \"natnet\"\nserver = \"10.0.0.9\"\nrate_hz = 240\n\
                    [[scene.bodies]]\nname = \"bunny\"\n[[scene.bodies]]\nname = \"venus\"\n";
        std::fs::write(&path, real).unwrap();
        let read = |change: fn(&mut RigArgs)| {
            let mut args = RigArgs { frames: Some(4), ..RigArgs::default() };
            change(&mut args);
            args.rig(Some(&path)).map_err(|f| f.message)
        };
        let told = read(|a| a.pace = Some("virtual".into())).unwrap_err();
        assert!(told.contains("natnet") && told.contains("usb"), "{told}");
        for pace in ["real", "virtual"] {
            let mut args =
                RigArgs { simulate: true, frames: Some(4), pace: Some(pace.into()), ..RigArgs::default() };
            let rig = args.rig(Some(&path)).unwrap();
            assert!(rig.tracker.is_mock() && rig.tracker.rate_hz() == Some(240));
            assert!(rig.projector.backend.is_mock());
            assert_eq!(rig.real_time.pace.word(), pace);
            args.set = vec!["scene.bodies.0.motion={kind=\"still\"}".into()];
            args.rig(Some(&path)).unwrap();
            args.set = vec!["tracker.server=\"nowhere\"".into()];
            assert!(args.rig(Some(&path)).unwrap_err().message.contains("tracker.server"));
        }
        // A command that runs nothing needs no end.
        let still = RigArgs { simulate: true, pace: Some("virtual".into()), ..RigArgs::default() };
        assert!(still.rig(Some(&path)).unwrap_err().message.contains("never end"));
        assert_eq!(still.rig_at_rest(Some(&path)).unwrap().run.frames, 0);
        std::fs::remove_dir_all(dir).unwrap();
    }

    /// Found in use, a sibling of R13: commands accepted flags and ignored them.
    #[test]
    fn flags_without_a_meaning_are_refused_by_name() {
        let args = RigArgs { seconds: Some(1.0), ..RigArgs::default() };
        let told = args.refuse("dpm bench", &["--frames", "--seconds"]).unwrap_err();
        assert!(told.message.contains("--seconds") && told.message.contains("dpm bench"), "{}", told.message);
        assert_eq!(told.kind.exit_code(), 2);
        args.refuse("dpm bench", &["--frames", "--out"]).unwrap();
    }

    #[test]
    fn bad_flags_are_bad_input() {
        let told = |change: fn(&mut RigArgs)| {
            let failure = rig(change).unwrap_err();
            assert_eq!(failure.kind.exit_code(), 2);
            failure.message
        };
        assert!(told(|a| a.raster = Some("640".into())).contains("for example 640x480"));
        assert!(told(|a| a.raster = Some("0x480".into()))
            .contains("`projector.width`: is 0, must be 1 to 8192 px"));
        assert!(told(|a| a.raster = Some("99999x480".into())).contains("must be 1 to 8192"));
        assert!(told(|a| a.seconds = Some(f64::NAN)).contains("--seconds NaN"));
        assert!(told(|a| a.seconds = Some(-1.0)).contains("above 0"));
        assert!(told(|a| a.scene = Some("no.glb".into())).contains("no.glb: No such file"));
    }

    /// Found in use, O1: `--raster` cropped the view of a calibrated projector instead of dividing it into other
    /// pixels. Every point of the world falls on the same place in the picture, whatever its pixels are.
    #[test]
    fn a_calibrated_view_stays_when_its_raster_changes() {
        let dir = std::env::temp_dir().join(format!("dpm-calibrated-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let calibration = dir.join("procam.yml");
        // Off-centre and not square, so that nothing falls on its own place by chance.
        let text = "%YAML:1.0\n---\nproj_K: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [ 1890., 0., 530.25, 0., 1910., 371.5, 0., 0., 1. ]\n\
                    R: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [ 1., 0., 0., 0., -1., 0., 0., 0., -1. ]\n\
                    T: !!opencv-matrix\n  rows: 3\n  cols: 1\n  dt: d\n  data: [ 0.02, 0.1, 1.1 ]\n";
        std::fs::write(&calibration, text).unwrap();
        let file = format!(
            "[projector]\ncalibration = {:?}\ncalibration_unit = \"metre\"\n[run]\nframes = 1\n",
            calibration.display().to_string()
        );
        let path = dir.join("rig.toml");
        std::fs::write(&path, file).unwrap();
        let camera = |raster: Option<&str>| {
            let args = RigArgs { raster: raster.map(str::to_owned), ..Default::default() };
            let config = args.rig(Some(&path)).unwrap_or_else(|e| panic!("{e}"));
            Rig::build(&config, None).unwrap_or_else(|e| panic!("{e}")).camera
        };
        let full = camera(None);
        assert_eq!((full.raster.width(), full.raster.height()), (1024, 768));
        for (flag, width, height) in
            [("320x240", 320.0, 240.0), ("64x48", 64.0, 48.0), ("1024x300", 1024.0, 300.0)]
        {
            let small = camera(Some(flag));
            assert_eq!((f64::from(small.raster.width()), f64::from(small.raster.height())), (width, height));
            let mut seen = 0;
            for i in 0..1000 {
                let part = |prime: i32| f64::from(i * prime % 1009) / 1009.0 - 0.5;
                let point = DVec3::new(0.6 * part(7), 0.5 * part(11), 0.3 * part(13));
                let (Some(a), Some(b)) = (full.project(point), small.project(point)) else { continue };
                let apart = (a.x / 1024.0 - b.x / width).abs().max((a.y / 768.0 - b.y / height).abs());
                assert!(apart < 1e-12, "{flag}: {point} at {a} and {b}");
                seen += 1;
            }
            assert!(seen > 900, "{seen}");
            // The corner of the picture is the corner of the panel. Pixels are areas, and their centres lie half a
            // pixel inside.
            let corner = |camera: &ProjectorCamera| camera.ray(glam::DVec2::ZERO).direction.normalize();
            assert!((corner(&full) - corner(&small)).length() < 1e-12);
        }
        std::fs::remove_dir_all(dir).unwrap();
    }
}
