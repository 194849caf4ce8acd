//! A camera of this machine as the whole program sees it: the device file is a fake one, behind a preloaded library.

use crate::cli_common::{command, out, NO_DRIVER};
use dpm_device::pose::Pose;
use dpm_device::time::{FrameRate, HostClock, HostTime};
use dpm_device::tracker::record::Recording;
use hil_mock::camera::{two_tags, CameraHost, CameraOptics, MarkedBody, MockCamera, MockCameraConfig};
use hil_mock::motion::{Motion, MotionSpec};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

const SIZE: [u32; 2] = [640, 400];
const HZ: u32 = 30;

/// A mock camera before a body, a rig file that names a device file, and the file that says what lies there.
struct CameraBench {
    folder: PathBuf,
    host: CameraHost,
}

impl CameraBench {
    fn new(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("dpm-camera-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).unwrap();
        let config = MockCameraConfig {
            optics: CameraOptics::pinhole(SIZE, 60.0),
            pose: Pose { position_m: [0.0, 0.0, 1.2], ..Pose::IDENTITY },
            rate: FrameRate::new(HZ, 1).unwrap(),
            ..MockCameraConfig::default()
        };
        let motion = Motion::new(&MotionSpec::Still {}, Pose::IDENTITY).unwrap();
        let body = MarkedBody { motion, tags: two_tags(0).to_vec(), markers: vec![] };
        let epoch = Instant::now();
        let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(epoch.elapsed().as_nanos() as i64));
        let any = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0);
        let host = CameraHost::start(MockCamera::new(config, vec![body]).unwrap(), any, clock).unwrap();
        let bench = Self { folder, host };
        let tags = two_tags(0).map(|tag| tag.as_toml("Hare")).join(", ");
        let rig = format!(
            "[real_time]\npace = \"real\"\n[tracker]\nkind = \"camera\"\ndevice = {:?}\nsize = {SIZE:?}\n\
             rate_hz = {HZ}\nexposure_us = 2000\nview_deg = 60\ntags = [{tags}]\n\
             [[scene.bodies]]\nname = \"Hare\"\nnode = \"bunny\"\n",
            bench.device().display().to_string()
        );
        std::fs::write(bench.folder.join("rig.toml"), rig).unwrap();
        bench
    }

    fn device(&self) -> PathBuf {
        self.folder.join("video0")
    }

    /// Plugs in a camera with more words, or pulls it.
    fn plug(&self, more: Option<&str>) {
        let line = more.map(|more| {
            let (device, from) = (self.device(), self.host.address());
            format!("path={} from={from} size={}x{} rates={HZ} {more}\n", device.display(), SIZE[0], SIZE[1])
        });
        let aside = self.folder.join("cameras.aside");
        std::fs::write(&aside, line.unwrap_or_default()).unwrap();
        std::fs::rename(aside, self.folder.join("cameras")).unwrap();
    }

    fn command(&self, words: &[&str]) -> Command {
        let deps = std::env::current_exe().unwrap().parent().unwrap().to_owned();
        let library = deps.join("libfake_v4l2.so");
        assert!(library.exists(), "{} is built with the tests", library.display());
        let mut command = command(words);
        command.current_dir(&self.folder).env("LD_PRELOAD", library);
        command.env("FAKE_V4L2", self.folder.join("cameras"));
        command
    }

    /// State, what was found and the remedy of a part, by `dpm doctor`.
    fn doctor(&self, part: &str) -> [String; 3] {
        let output = self.command(&["doctor", "rig.toml", "--json"]).envs(NO_DRIVER).output().unwrap();
        let json: serde_json::Value = serde_json::from_str(&out(&output)).unwrap();
        let findings = json["findings"].as_array().unwrap();
        let finding = findings.iter().find(|f| f["name"] == part);
        let finding = finding.unwrap_or_else(|| panic!("{part} in {json:#}"));
        ["state", "found", "remedy"].map(|key| finding[key].as_str().unwrap().to_owned())
    }
}

impl Drop for CameraBench {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

#[test]
fn the_doctor_judges_the_camera_of_a_rig() {
    let b = CameraBench::new("doctor");
    b.plug(None);
    let [state, found, remedy] = b.doctor("camera");
    assert!(state == "missing" && found.contains("there is no "), "{found}");
    assert!(remedy.contains("/dev/v4l/by-id"), "{remedy}");

    b.plug(Some("card=Eye_of_software formats=YUYV"));
    let [state, found, _] = b.doctor("camera");
    assert!(
        state == "ok" && found.contains("Eye of software") && found.contains("640 x 400 YUYV"),
        "{found}"
    );
    let [state, found, _] = b.doctor("tracker");
    // The scene's other body carries no tags.
    assert!(state == "warning" && found.contains("\"Hare\" ") && found.contains("times a second"), "{found}");

    b.plug(Some("rates=15"));
    let [state, found, remedy] = b.doctor("camera");
    assert!(state == "missing" && found.contains("no 30 pictures a second"), "{found}");
    assert!(remedy.contains("tracker.rate_hz"), "{remedy}");
    b.plug(Some("stamp=no-clock"));
    assert!(b.doctor("camera")[1].contains("does not say by which clock"));
    let [state, found, remedy] = b.doctor("tracker");
    assert!(state == "missing" && found.contains("is not seen"), "{found}");
    assert!(remedy.contains("none is used"), "{remedy}");
}

/// A camera is pulled and plugged in again while its poses are recorded: the poses stop and go on, where the body is.
#[test]
fn poses_of_a_camera_go_on_after_its_plug_was_pulled() {
    let b = CameraBench::new("record");
    b.plug(Some(""));
    let mut child = b.command(&["record", "a.dpmt", "--rig", "rig.toml", "--seconds", "6"]).spawn().unwrap();
    let grown = |least: u64| {
        let begin = Instant::now();
        let size = || std::fs::metadata(b.folder.join("a.dpmt")).map_or(0, |m| m.len());
        while size() < least {
            assert!(begin.elapsed() < Duration::from_secs(60), "{} bytes", size());
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    grown(1_000);
    b.plug(None);
    std::thread::sleep(Duration::from_millis(700));
    b.plug(Some(""));
    assert!(child.wait().unwrap().success());
    let recording = Recording::read(&b.folder.join("a.dpmt")).unwrap();
    let seen: Vec<_> = recording.samples.iter().filter(|s| s.tracked).collect();
    let gaps: Vec<usize> = (1..seen.len())
        .filter(|i| seen[*i].captured_at.ns_since(seen[i - 1].captured_at) > 500_000_000)
        .collect();
    assert_eq!(gaps.len(), 1, "one gap of half a second or more, in {} samples", seen.len());
    assert!(gaps[0] >= 5 && seen.len() - gaps[0] >= 30, "{gaps:?} of {}", seen.len());
    for sample in seen {
        let p = sample.pose.position_m;
        let off = (p[0].powi(2) + p[1].powi(2) + (p[2] + 1.2).powi(2)).sqrt();
        assert!(off < 0.01, "{p:?}");
    }
}
