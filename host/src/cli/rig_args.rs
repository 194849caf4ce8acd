//! Flags that every command with a rig takes, into a checked [`RigConfig`].

use crate::config::{Overrides, RigConfig};
use crate::control::set_rig_name;
use crate::failure::{Failure, FailureKind};
use std::path::{Path, PathBuf};

/// Flags over the rig file. Each is a short form of `--set`.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct RigArgs {
    /// glTF 2.0 file (.glb or .gltf) to show in place of the rig's scene
    #[arg(long, value_name = "FILE")]
    pub scene: Option<PathBuf>,

    /// Columns and rows to trace and project, for example 640x480
    #[arg(long, value_name = "WxH")]
    pub raster: Option<String>,

    /// Frames to light
    #[arg(long, value_name = "N", conflicts_with = "seconds")]
    pub frames: Option<u64>,

    /// Rig time to run for, in seconds
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,

    /// Show the newest tracker sample as it is
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
    /// The flags as texts for `--set`; what the user sets explicitly comes last and wins.
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
        if self.no_prediction {
            flags.push("prediction.on=false".into());
        }
        if let Some(out) = &self.out {
            flags.push(format!("output.dir={}", quoted(out)));
        }
        flags.extend(self.set.iter().cloned());
        Ok(flags)
    }

    /// Reads the rig file `path`, or the demo's when there is none, with the environment and these flags over it.
    ///
    /// # Errors
    /// Every mistake in file, environment and flags.
    pub fn rig(&self, path: Option<&Path>) -> Result<RigConfig, Failure> {
        // Whoever gives orders to this process is told which rig it is.
        path.into_iter().for_each(set_rig_name);
        let read = |flags: Vec<String>| {
            let overrides = Overrides::from_environment(flags);
            match path {
                Some(path) => RigConfig::load(path, &overrides),
                None => RigConfig::demo(&overrides),
            }
        };
        let flags = self.flags()?;
        let Some(seconds) = self.seconds else { return Ok(read(flags)?) };
        if !(seconds > 0.0 && seconds <= 1e9) {
            let told = format!("--seconds {seconds:?}: must be above 0 and at most 1e9");
            return Err(Failure::new(FailureKind::BadInput, told));
        }
        // How many frames a time is only the rate tells, which may itself come from the file or a flag.
        let probe = read([flags.clone(), vec!["run.frames=1".into()]].concat())?;
        let frames = probe.projector.frame_rate.slot_at_ns((seconds * 1e9) as i64).max(1);
        Ok(read([flags, vec![format!("run.frames={frames}")]].concat())?)
    }
}

/// A side of a raster as the flag says it; range and zero are the configuration's business.
fn number(text: &str) -> Option<u64> {
    text.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn seconds_become_frames_at_the_rigs_own_rate() {
        assert_eq!(rig(|a| a.seconds = Some(1.0)).unwrap().run.frames, 947);
        let slow = rig(|a| {
            a.seconds = Some(10.0);
            a.set = vec!["projector.frame_rate=\"60000/1001\"".into()];
        });
        assert_eq!(slow.unwrap().run.frames, 599);
        assert_eq!(rig(|a| a.seconds = Some(1e-9)).unwrap().run.frames, 1);
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
}
