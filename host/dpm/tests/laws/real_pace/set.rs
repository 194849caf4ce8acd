//! `dpm set` on a running rig with software Vulkan: values are shown, changed, refused, taken back and saved, and a limit
//! on light holds whatever is set.

use crate::cli_common::{code, dpm, err, out, start, TestFolder};
use std::time::Duration;

const LONG: Duration = Duration::from_secs(120);

#[test]
fn parameters_change_a_running_rig_and_no_value_voids_a_limit_on_light() {
    let folder = TestFolder::new("set");
    // The picture is nearly black, so the limit is far.
    let text = include_str!("../../../../../rigs/demo.toml");
    let path = folder.write("rig.toml", text);
    let mut args = vec!["run", path.as_str(), "--raster", "160x120", "--pace", "real"];
    for key in [
        "run.frames=0",
        "output.images=false",
        "render.exposure=0.001",
        "safety.limits.mean_level=0.01",
        "safety.limits.mean_window_s=0.5",
        "safety.flashes_per_second=0",
    ] {
        args.extend(["--set", key]);
    }
    let mut run = start(&args);
    run.wait_for_line(LONG, |line| line.contains("projector: up"));
    let id = run.id().to_string();
    let set = |words: &[&str]| dpm(&[&["set", "--pid", id.as_str()], words].concat(), &[]);
    // The first frame may wait for the driver.
    let begin = std::time::Instant::now();
    let shown = loop {
        let told = set(&[]);
        if code(&told) == 0 {
            break out(&told);
        }
        assert!(begin.elapsed() < LONG, "{}{}", out(&told), err(&told));
        std::thread::sleep(Duration::from_millis(100));
    };
    assert!(shown.contains("exposure = 0.001") && shown.contains("body.bunny = 0,0,0,0,0,0"), "{shown}");
    for (bad, word) in
        [("exposure=NaN", "NaN is not allowed"), ("x=1", "no parameter is named"), ("exposure", "NAME=VALUE")]
    {
        let told = set(&[bad]);
        assert!(code(&told) == 2 && err(&told).contains(word), "{bad}: {}", err(&told));
    }
    let told = set(&["exposure=1000"]);
    assert!(code(&told) == 0 && out(&told).contains("ok: exposure is 1000, from frame "), "{}", err(&told));
    run.wait_for_line(LONG, |line| line.contains("safety.limits.mean_level"));
    let told = set(&["--undo"]);
    assert!(code(&told) == 0 && out(&told).contains("exposure is 0.001"), "{}", err(&told));
    // Light comes back after the rest, and stays.
    run.wait_for_line(LONG, |line| line.contains("projector: up"));
    let told = set(&["exposure=0.002", "--save"]);
    assert!(code(&told) == 0 && out(&told).contains("rig.toml.1.old"), "{}{}", out(&told), err(&told));
    let written = std::fs::read_to_string(folder.path("rig.toml")).unwrap();
    assert!(written.contains("exposure = 0.002"), "{written}");
    assert_eq!(std::fs::read_to_string(folder.path("rig.toml.1.old")).unwrap(), text);
    run.signal("TERM");
    run.finish();
    let gone = set(&["exposure=1"]);
    assert!(code(&gone) == 3 && err(&gone).contains("no running rig listens"), "{}", err(&gone));
}
