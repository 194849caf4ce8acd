//! A projector in a process of its own, behind a pseudo-terminal, at rates that such a line carries: frames are lit, and
//! no limit of the projector latches, however busy the machine is. docs/lab/LATENCY.md says how steady the light is.

use dpm_tests::programs::{program, RunFolder, Talk};
use std::process::{Command, Stdio};

/// Seconds of a run.
const SECONDS: u64 = 4;

#[test]
fn a_projector_in_a_process_of_its_own_latches_no_fault_for_what_frames_do() {
    for rate in [60, 120] {
        let mock = Command::new(program("hil-mock"))
            .args(["serve", "projector", "--port", "pty", "--raster", "320x240"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a program that was built");
        let mut mock = Talk::with(mock);
        mock.until("/dev/pts/");
        let number = mock.until("\n");
        let number: String = number.chars().take_while(char::is_ascii_digit).collect();
        let folder = RunFolder::new(&format!("own-process-{rate}"));
        let backend = format!("projector.backend={{kind=\"serial\",port=\"/dev/pts/{number}\"}}");
        let done = folder
            .command(program("dpm"))
            .args([
                "profile",
                concat!(env!("CARGO_MANIFEST_DIR"), "/../rigs/demo.toml"),
                "--no-render",
                "--json",
            ])
            .args(["--seconds", &SECONDS.to_string(), "--raster", "320x240", "--set", &backend])
            .args(["--set", &format!("projector.frame_rate={rate}")])
            .output()
            .expect("a program that was built");
        let told = String::from_utf8_lossy(&done.stderr).into_owned();
        assert_eq!(done.status.code(), Some(0), "{rate}: {told}");
        assert!(!told.contains("flash limit"), "{rate}: {told}");
        let report: serde_json::Value = serde_json::from_slice(&done.stdout).expect("a report");
        let number = |path: &str| report.pointer(path).and_then(serde_json::Value::as_f64).expect(path);
        // Where the projector's process gets no core the light flickers, and the host rests before the projector's own limit
        // latches.
        assert_eq!(number("/ordered_dark/fault") as u64, 0, "{rate}: {told}");
        assert!(number("/frames_lit") > f64::from(rate) / 4.0, "{rate}: {told}");
    }
}
