//! A short soak, as `./x soak` runs it for hours.

use std::path::Path;
use std::process::Command;

#[test]
#[ignore = "takes minutes with the build, and judges times that a busy machine does not keep: run ./x soak HOURS"]
fn a_rig_survives_half_a_minute_of_orders_and_faults() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let status = Command::new("./x").args(["soak", "0.01"]).current_dir(root).status();
    assert!(status.expect("the script starts").success());
}
