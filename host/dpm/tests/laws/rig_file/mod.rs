//! A rig file on a projector behind a pseudo-terminal, for `dpm` in a process of its own.
#![allow(dead_code)]

use crate::cli_common::TestFolder;
use crate::link_common::{raster, PtyProjector};
use hil_mock::projector::MockConfig;
use std::time::Duration;

/// The watchdog that the rig asks of its projector.
pub(crate) const WATCHDOG: Duration = Duration::from_millis(250);

/// Arguments that run the rig file `path` with prepared frames: real pace and all threads, no GPU. Its files go
/// beside the rig file.
pub(crate) fn run_words(path: &str) -> Vec<String> {
    let out = path.trim_end_matches("rig.toml").to_owned() + "out";
    ["profile", path, "--no-render", "--seconds", "1000", "--out", &out].map(str::to_owned).into()
}

/// A rig file for the projector, and the projector.
pub(crate) fn rig(name: &str) -> (TestFolder, String, PtyProjector) {
    let folder = TestFolder::new(name);
    let far = PtyProjector::new(name, MockConfig::new(raster()));
    let text = format!(
        "[projector]\nwidth = {}\nheight = {}\nframe_rate = 20\nplanes = 8\nbackend = {}\n\
         [render]\nspp = 1\n[safety]\npredict_ms = 1000\nwatchdog_ms = {}\n[output]\ndir = {:?}\nlight_window_ms = 100\n\
         [[scene.bodies]]\nname = \"bunny\"\n",
        raster().width(),
        raster().height(),
        far.backend(""),
        WATCHDOG.as_millis(),
        folder.text(),
    );
    let path = folder.write("rig.toml", &text);
    (folder, path, far)
}
