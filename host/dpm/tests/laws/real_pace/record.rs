//! `dpm record` as a program with mock trackers: it writes what was sent, and `tracker.kind = "replay"` plays it.

use crate::cli_common;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::record::Recording;
use dpm_device::tracker::{BodyIndex, TrackerSample};
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::rig::Rig;
use dpm_rig::tracks::open_for;
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::natnet_host::NatNetHost;
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig, Streaming, UnicastTo};
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A folder with a rig file, and a NatNet server of two bodies that the rig names.
struct RecordingBench {
    folder: PathBuf,
    server: Option<NatNetHost>,
}

fn source() -> SampleSource {
    let rest = dpm_device::pose::Pose { position_m: [0.1, 0.2, 1.5], ..dpm_device::pose::Pose::IDENTITY };
    let motions = vec![
        Motion::new(&MotionSpec::paper_translation(), rest).unwrap(),
        Motion::new(&MotionSpec::Still {}, rest).unwrap(),
    ];
    SampleSource::new(MockTrackerConfig::default(), motions).unwrap()
}

impl RecordingBench {
    fn new(name: &str, serves: bool) -> Self {
        let folder = std::env::temp_dir().join(format!("dpm-record-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).unwrap();
        let mut config = NatNetServerConfig::new(&["Hare", "Bust"]);
        config.streaming = Streaming::Unicast(UnicastTo::CommandSocket);
        let epoch = Instant::now();
        let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(epoch.elapsed().as_nanos() as i64));
        let streaming = config.streaming;
        let any = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0);
        let server =
            NatNetHost::start(NatNetServer::new(config, source()).unwrap(), streaming, any, clock).unwrap();
        let port = server.address().port();
        let bench = Self { folder, server: serves.then_some(server) };
        let text = format!(
            "[tracker]\nkind = \"natnet\"\nserver = \"127.0.0.1\"\nlocal = \"127.0.0.1\"\ncommand_port = {port}\ndata_port = {port}\n\
             [[scene.bodies]]\nname = \"Hare\"\nnode = \"bunny\"\n[[scene.bodies]]\nname = \"Bust\"\nnode = \"venus\"\n"
        );
        std::fs::write(bench.folder.join("rig.toml"), text).unwrap();
        bench
    }

    fn command(&self, words: &[&str]) -> Command {
        let mut command = cli_common::command(&[&["record"], words].concat());
        command.current_dir(&self.folder);
        command
    }

    fn record(&self, words: &[&str]) -> Output {
        self.command(words).output().unwrap()
    }

    fn read(&self, name: &str) -> Recording {
        Recording::read(&self.folder.join(name)).unwrap()
    }
}

impl Drop for RecordingBench {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

fn told(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned() + &String::from_utf8_lossy(&output.stdout)
}

/// Everything that a rig with `tracker.kind = "replay"` gets from the file, through the tracker that `dpm run` opens.
fn replayed(folder: &Path, file: &str, start: HostTime) -> Vec<TrackerSample> {
    let text = format!(
        "[tracker]\nkind = \"replay\"\nfile = \"{file}\"\n\
         [[scene.bodies]]\nname = \"Hare\"\nnode = \"bunny\"\n[[scene.bodies]]\nname = \"Bust\"\nnode = \"venus\"\n"
    );
    let config = RigConfig::parse("replay.toml", &text, folder, &Overrides::default()).expect("a valid rig");
    let rig = Rig::build(&config, None).unwrap();
    let mut tracker = open_for(&rig, Arc::new(|| HostTime(0)), start).unwrap();
    let mut samples = Vec::new();
    tracker.poll(HostTime(i64::MAX), &mut |s| samples.push(*s)).unwrap();
    samples
}

/// Found in use, C9 and O5: no command made the recordings that `tracker.kind = "replay"` plays. From a NatNet
/// server: each sample that was sent during the recording is in it, where the body truly was, and the replay gives
/// the same samples, bit for bit.
#[test]
fn a_recording_holds_what_was_sent_and_replay_gives_it_back() {
    let b = RecordingBench::new("round", true);
    let o = b.record(&["a.dpmt", "--rig", "rig.toml", "--seconds", "1.5"]);
    assert!(o.status.success(), "{}", told(&o));
    let recording = b.read("a.dpmt");
    assert_eq!((recording.bodies.clone(), recording.torn_bytes), (vec!["Hare".into(), "Bust".into()], 0));
    assert!(told(&o).contains(&format!("{} samples of 2 bodies", recording.samples.len())), "{}", told(&o));
    // 1,500 in 1.5 s, minus the start of a program on a busy machine.
    assert!(recording.samples.len() > 700, "{}", told(&o));
    let truth = source();
    let mut next = [None; 2];
    for s in &recording.samples {
        let expected = next[usize::from(s.body.0)].replace(s.sequence + 1);
        assert!(expected.is_none_or(|e| e == s.sequence), "a sample is missing before {s:?}");
        let p = truth.sample(s.body, u64::from(s.sequence)).expect("sent").pose.position_m;
        assert_eq!(s.pose.position_m, p.map(|c| f64::from(c as f32)), "{s:?}");
        assert!(s.tracked && s.captured_at <= s.received_at);
    }
    let start = HostTime(77_000_000_000);
    let shift = start.ns_since(recording.start);
    let expected: Vec<_> = recording
        .samples
        .iter()
        .map(|s| TrackerSample {
            captured_at: s.captured_at.plus_ns(shift),
            received_at: s.received_at.plus_ns(shift),
            ..*s
        })
        .collect();
    assert_eq!(replayed(&b.folder, "a.dpmt", start), expected);
    // An existing file is not overwritten.
    let again = b.record(&["a.dpmt", "--rig", "rig.toml", "--seconds", "1"]);
    assert!(again.status.code() == Some(2) && told(&again).contains("not overwritten"), "{}", told(&again));
    assert_eq!(b.read("a.dpmt"), recording);
}

/// At most 100 ms are lost by a SIGKILL (in one of three attempts, on a shared machine), and the rest can be played.
#[test]
fn a_killed_recording_lacks_its_last_tenth_of_a_second_at_most() {
    let b = RecordingBench::new("kill", true);
    let mut missing = Vec::new();
    for name in ["a.dpmt", "b.dpmt", "c.dpmt"] {
        let mut run = b.command(&[name, "--rig", "rig.toml"]).stderr(Stdio::null()).spawn().unwrap();
        let file = b.folder.join(name);
        let limit = Instant::now() + Duration::from_secs(60);
        while Recording::read(&file).map_or(0, |r| r.samples.len()) < 400 {
            assert!(Instant::now() < limit, "it never records");
            std::thread::sleep(Duration::from_millis(20));
        }
        run.kill().unwrap();
        let sent = b.server.as_ref().unwrap().frames_sent();
        run.wait().unwrap();
        let recording = b.read(name);
        let last = recording.samples.last().expect("samples").sequence;
        missing.push(2 * (sent as i64 - i64::from(last)));
        assert!(!replayed(&b.folder, name, HostTime(0)).is_empty());
    }
    assert!(missing.iter().any(|ms| *ms <= 100), "{missing:?} ms are missing");
}

/// A full disk ends the recording at once, with the reason and exit code 3, and what was written before can be
/// played. SIGTERM ends it in order.
#[test]
fn a_full_disk_and_a_signal_end_a_recording_clearly() {
    let b = RecordingBench::new("full", true);
    // No file may grow beyond 32 KiB, which is the same as a full disk for the writer.
    let words = ["record", "a.dpmt", "--rig", "rig.toml", "--seconds", "60"];
    let started = Instant::now();
    let mut limited = cli_common::command_after("trap '' XFSZ; ulimit -f 32", &words);
    let o = limited.current_dir(&b.folder).output().unwrap();
    assert_eq!(o.status.code(), Some(3), "{}", told(&o));
    assert!(told(&o).contains("a.dpmt") && told(&o).contains("can be played"), "{}", told(&o));
    assert!(
        started.elapsed() < Duration::from_secs(40),
        "it ended when the file was full, not when the time was over"
    );
    let recording = b.read("a.dpmt");
    assert!(recording.samples.len() > 100, "{}", recording.samples.len());
    assert_eq!(replayed(&b.folder, "a.dpmt", recording.start), recording.samples);

    let mut run = b.command(&["t.dpmt", "--rig", "rig.toml"]).stderr(Stdio::null()).spawn().unwrap();
    let limit = Instant::now() + Duration::from_secs(60);
    while Recording::read(&b.folder.join("t.dpmt")).map_or(0, |r| r.samples.len()) < 100 {
        assert!(Instant::now() < limit, "it never records");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(Command::new("kill").args(["-TERM", &run.id().to_string()]).status().unwrap().success());
    assert_eq!(run.wait().unwrap().code(), Some(0));
    assert_eq!(b.read("t.dpmt").torn_bytes, 0);
}

/// A tracker that delivers nothing is an error with the tracker's own explanation, and so is a missing folder. The
/// mock, which any rig has, can be recorded as well.
#[test]
fn silence_is_an_error_and_any_tracker_can_be_recorded() {
    let b = RecordingBench::new("silent", false);
    let o = b.record(&["a.dpmt", "--rig", "rig.toml", "--seconds", "0.5"]);
    assert_eq!(o.status.code(), Some(3), "{}", told(&o));
    assert!(told(&o).contains("no sample") && told(&o).contains("did not answer"), "{}", told(&o));
    let o = b.record(&["none/a.dpmt", "--rig", "rig.toml", "--seconds", "0.5"]);
    assert!(o.status.code() == Some(2) && told(&o).contains("none/a.dpmt"), "{}", told(&o));
    let o =
        b.record(&["m.dpmt", "--rig", "rig.toml", "--set", "tracker={kind=\"mock\"}", "--seconds", "0.5"]);
    assert!(o.status.success(), "{}", told(&o));
    let mock = b.read("m.dpmt");
    assert!(mock.samples.iter().any(|s| s.body == BodyIndex(1)) && mock.samples.len() > 100);
}
