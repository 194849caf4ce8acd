//! The program `dpm dlpc900` with its own libusb and a preloaded in-process usbfs, connected to the emulator over
//! USB/IP.

use crate::cli_common;
use crate::cli_common::{start_with, ChildProgram};
use dpm_device::time::HostTime;
use dpm_dlpc900::command::Opcode;
use dpm_dlpc900::lut::{DisplayMode, Dmd};
use hil_mock::dlpc900::{Dlpc900Model, Options, Sequencer};
use hil_mock::usb_plug::{monotonic_clock, UsbPlug};
use hil_mock::usbip::{Export, Server};
use std::path::PathBuf;
use std::process::{Command, Output};
use std::sync::{Arc, Mutex};

struct EmulatedBus {
    model: Arc<Mutex<Dlpc900Model>>,
    export: Export,
    server: Server,
    folder: PathBuf,
}

impl EmulatedBus {
    fn new(name: &str, devices: usize) -> Self {
        let folder = std::env::temp_dir().join(format!("dpm-cli-dlpc900-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let options = Options { dmd: Dmd::Dlp5500, strict: true, ..Options::default() };
        let models: Vec<_> =
            (0..devices).map(|_| Arc::new(Mutex::new(Dlpc900Model::new(options.clone())))).collect();
        let export = |(i, m): (usize, &Arc<Mutex<Dlpc900Model>>)| {
            Export::new(format!("1-{}", i + 1), Arc::new(UsbPlug::new(m.clone(), monotonic_clock())))
        };
        let exports: Vec<Export> = models.iter().enumerate().map(export).collect();
        let export = exports[0].clone();
        let server = Server::start("127.0.0.1:0", exports).unwrap();
        Self { model: models[0].clone(), export, server, folder }
    }

    /// Runs `dpm dlpc900` on the emulated bus.
    fn dpm(&self, words: &[&str]) -> Output {
        self.command(words).output().unwrap()
    }

    fn command(&self, words: &[&str]) -> Command {
        // Commands of `dpm` itself are passed as they are; everything else is a command of `dpm dlpc900`.
        let own = ["run", "pattern", "safe", "arm"].contains(&words[0]);
        let words: Vec<&str> = (!own).then_some("dlpc900").into_iter().chain(words.iter().copied()).collect();
        let mut command = cli_common::command(&words);
        command.current_dir(&self.folder).envs(self.variables());
        command
    }

    /// The variables that lead a program to the emulated bus and keep its locks and orders in this test's folder.
    fn variables(&self) -> [(&'static str, String); 5] {
        let deps = std::env::current_exe().unwrap().parent().unwrap().to_owned();
        let library = deps.join("libusbfs_fake.so");
        assert!(library.exists(), "{} is built with the tests", library.display());
        [
            ("LD_PRELOAD", library.display().to_string()),
            ("USBFS_FAKE_USBIP", self.server.address().to_string()),
            ("USBFS_FAKE_DRIVER", "usbhid".into()),
            ("DPM_RUNTIME_DIR", self.folder.join("run").display().to_string()),
            ("DPM_STATE_DIR", self.folder.join("state").display().to_string()),
        ]
    }

    /// Waits until the server has noticed that the previous program has ended; at most 20 s.
    fn until_free(&self) {
        for _ in 0..4000 {
            if !self.export.is_in_use() {
                return;
            }
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        panic!("a program still has the device");
    }

    /// A run of the rig file that continues during the test.
    fn start(&self) -> ChildProgram {
        self.until_free();
        let variables = self.variables();
        let variables: Vec<_> = variables.iter().map(|(name, value)| (*name, value.as_str())).collect();
        start_with(&["run", self.folder.join("rig.toml").to_str().unwrap()], &variables)
    }

    /// Gives an order to a running rig, which confirms it.
    fn order(&self, word: &str, run: &ChildProgram) {
        let told = self.dpm(&[word, "--pid", &run.id().to_string()]);
        let out = text(&told.stdout);
        assert!(
            told.status.success() && out.contains("ok: projector"),
            "{word}: {out}{}",
            text(&told.stderr)
        );
    }

    /// Number of times that the sequence was started.
    fn starts(&self) -> usize {
        let m = self.model.lock().unwrap();
        m.executed().iter().filter(|e| e.opcode == Opcode::START_STOP && e.data == [2]).count()
    }

    fn ok(&self, words: &[&str]) -> String {
        // The server frees the device a moment after the previous program has ended.
        let until = std::time::Instant::now() + std::time::Duration::from_secs(5);
        loop {
            let o = self.dpm(words);
            let (out, err) = (text(&o.stdout), text(&o.stderr));
            if o.status.success() {
                return out;
            }
            assert!(err.contains("in use") && std::time::Instant::now() < until, "{words:?}: {out}{err}");
        }
    }
}

impl Drop for EmulatedBus {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn pictures_are_uploaded_started_stopped_and_put_to_rest() {
    let b = EmulatedBus::new("life", 1);
    let status = b.ok(&["status"]);
    assert!(
        status.contains("DLP5500 (1024 x 768)") && status.contains("6.0.1 (DLPR900PROM-5500)"),
        "{status}"
    );
    let pictures: Vec<image::GrayImage> = (0..3u32)
        .map(|i| image::GrayImage::from_fn(1024, 768, |x, y| image::Luma([((x * (i + 1)) ^ (y / 3)) as u8])))
        .collect();
    for (i, p) in pictures.iter().enumerate() {
        p.save(b.folder.join(format!("{i}.png"))).unwrap();
    }
    let out =
        b.ok(&["upload", "0.png", "1.png", "2.png", "--depth", "8", "--exposure-us", "9000", "--start"]);
    assert!(out.starts_with("3 patterns in 1 images, "), "{out}");
    {
        let mut m = b.model.lock().unwrap();
        assert_eq!(m.mode(), DisplayMode::OnTheFly);
        assert!(matches!(m.sequencer(HostTime(0)), Sequencer::Running(..)));
        for (i, p) in pictures.iter().enumerate() {
            assert!(m.projected_grey(i).unwrap() == *p.as_raw(), "picture {i}");
        }
        assert_eq!(m.warnings(), [] as [String; 0]);
    }
    b.ok(&["stop"]);
    assert_eq!(b.model.lock().unwrap().dark_because(), Some("sequencer stopped"));
    b.ok(&["start"]);
    b.ok(&["idle"]);
    assert_eq!(b.model.lock().unwrap().dark_because(), Some("mirrors exercised"));
    b.ok(&["leave-idle"]);
    b.ok(&["park"]);
    assert!(b.ok(&["status"]).contains("parked       yes"));
    b.ok(&["unpark"]);
    b.ok(&["standby"]);
    assert_eq!(b.model.lock().unwrap().dark_because(), Some("standby"));
    b.ok(&["wake"]);
    b.ok(&["video-pattern", "--frame-hz", "60", "--patterns", "8"]);
    assert_eq!(b.model.lock().unwrap().mode(), DisplayMode::VideoPattern);
}

#[test]
fn mistakes_are_named_with_their_exit_codes() {
    let b = EmulatedBus::new("mistakes", 2);
    let several = b.dpm(&["status"]);
    let err = text(&several.stderr);
    assert!(several.status.code() == Some(2) && err.contains("2 controllers are plugged in"), "{err}");
    let absent = b.dpm(&["status", "--device", "9:99"]);
    let err = text(&absent.stderr);
    assert!(
        absent.status.code() == Some(3)
            && err.contains("DLPC900 (0451:c900) at /dev/bus/usb/009/099: none is plugged in"),
        "{err}"
    );
    let b = EmulatedBus::new("rules", 1);
    image::GrayImage::new(1024, 768).save(b.folder.join("a.png")).unwrap();
    image::GrayImage::new(64, 48).save(b.folder.join("b.png")).unwrap();
    let wrong = |words: &[&str], says: &str| {
        let until = std::time::Instant::now() + std::time::Duration::from_secs(5);
        loop {
            let o = b.dpm(words);
            let err = text(&o.stderr);
            if err.contains("in use") && std::time::Instant::now() < until {
                continue;
            }
            assert!(o.status.code() == Some(2) && err.contains(says), "{err}");
            return;
        }
    };
    wrong(&["upload", "b.png"], "b.png: 64 x 48 pixels, the DLP5500 has 1024 x 768");
    wrong(&["upload", "c.png"], "c.png: ");
    wrong(&["upload", "a.png", "--exposure-us", "0"], "LUT entry 0: exposure 0 us is below");
    wrong(&["video-pattern", "--exposure-us", "9000"], "LUT entry 1: patterns up to here take 18000 us");
    assert!(
        b.model.lock().unwrap().executed().iter().all(|e| e.error == 0 && e.flags & 0x80 != 0),
        "nothing was written"
    );
}

/// A rig on a DLPC900: rendered, loaded, shown, put to rest; and what is impossible is reported before anything is
/// rendered.
#[test]
fn a_rig_shows_its_first_frames_over_and_over_and_puts_the_controller_to_rest() {
    let b = EmulatedBus::new("run", 1);
    let rig = |panel: &str, more: &str| {
        let text = format!(
            "[projector]\nwidth = 1024\nheight = 768\nframe_rate = 30\nplanes = 8\n\
             backend = {{ kind = \"dlpc900\", panel = \"{panel}\" {more} }}\n[render]\nspp = 1\ndepth = 2\n\
             [output]\nlight_window_ms = 100\n[[scene.bodies]]\nname = \"bunny\"\n"
        );
        std::fs::write(b.folder.join("rig.toml"), text).unwrap();
    };
    rig("dlp6500", "");
    let wrong = b.dpm(&["run", "rig.toml"]);
    let told = text(&wrong.stderr);
    assert!(wrong.status.code() == Some(2) && told.contains("a DLP6500 has 1920 x 1080 mirrors"), "{told}");
    rig("dlp5500", ", device = \"9:99\"");
    let absent = b.dpm(&["run", "rig.toml"]);
    let told = text(&absent.stderr);
    assert!(
        absent.status.code() == Some(3) && told.contains("at /dev/bus/usb/009/099: none is plugged in"),
        "{told}"
    );
    rig("dlp5500", "");
    let out = b.ok(&["run", "rig.toml", "--frames", "2", "--json"]);
    let report: serde_json::Value = serde_json::from_str(&out).unwrap_or_else(|e| panic!("{e}: {out}"));
    assert_eq!((&report["frames_loaded"], &report["patterns"]), (&2.into(), &2.into()));
    assert!(report["warnings"].to_string().contains("no watchdog"), "{report}");
    // Found in use, O2: it starts once more, although it was put to rest.
    b.ok(&["run", "rig.toml", "--frames", "2", "--json"]);
    let m = b.model.lock().unwrap();
    assert_eq!(m.dark_because(), Some("mirrors exercised"));
    assert!(m.executed().iter().all(|e| e.error == 0), "no command was refused");
    assert!(m.projected_grey(0).is_none_or(|g| g.iter().any(|v| *v > 0)), "a picture was loaded");
}

/// A rig in video mode, which renders nothing.
/// Each step of a Gray code is one pattern of the controller, which shows them in turn for the time that they are held.
#[test]
fn a_pattern_is_uploaded_shown_and_ends_at_rest() {
    let b = EmulatedBus::new("pattern", 1);
    let text = "[projector]\nwidth = 1024\nheight = 768\nframe_rate = 60\n[projector.backend]\nkind = \"dlpc900\"\npanel = \"dlp5500\"\n";
    std::fs::write(b.folder.join("rig.toml"), text).unwrap();
    let out = b.ok(&["pattern", "gray-rows", "rig.toml", "--hold-ms", "250", "--seconds", "0.2", "--json"]);
    let json: serde_json::Value = serde_json::from_str(&out).unwrap_or_else(|e| panic!("{e}: {out}"));
    assert_eq!((&json["patterns"], &json["frames_loaded"]), (&20.into(), &20.into()), "{out}");
    {
        let m = b.model.lock().unwrap();
        for step in 0..20 {
            let grey = m.projected_grey(step).unwrap();
            let gray = |y: usize| (y ^ y >> 1) >> (9 - step / 2) & 1;
            let wanted = |y: usize| if gray(y) != step % 2 { 255 } else { 0 };
            assert!(
                grey.chunks_exact(1024).enumerate().all(|(y, row)| row.iter().all(|&p| p == wanted(y))),
                "{step}"
            );
        }
        assert_eq!(m.dark_because(), Some("mirrors exercised"));
    }
    let counter = b.dpm(&["pattern", "counter", "rig.toml"]);
    let err = String::from_utf8_lossy(&counter.stderr).into_owned();
    assert!(counter.status.code() == Some(2) && err.contains("cannot count frames; add --step"), "{err}");
}

fn video_rig(b: &EmulatedBus) {
    let text = "[projector]\nwidth = 1024\nheight = 768\nframe_rate = 60\nplanes = 8\n\
                backend = { kind = \"dlpc900\", panel = \"dlp5500\", mode = \"video\" }\n\
                [[scene.bodies]]\nname = \"bunny\"\n";
    std::fs::write(b.folder.join("rig.toml"), text).unwrap();
}

/// Waits until the emulator is lit, or dark; at most 20 s.
fn until_lit(b: &EmulatedBus, lit: bool) {
    for _ in 0..4000 {
        if b.model.lock().unwrap().dark_because().is_none() == lit {
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let said = std::fs::read_to_string(b.folder.join("said")).unwrap_or_default();
    panic!("never lit = {lit}: {:?}\n{said}", b.model.lock().unwrap().dark_because());
}

/// Found in use, O2: the second run of a rig was refused, forever. The test makes two in a row, one after `dpm
/// dlpc900 idle`, and one after a SIGKILL; a killed run's controller is put to rest although the device has no
/// watchdog.
#[test]
fn a_rig_in_video_mode_runs_again_and_again() {
    let b = EmulatedBus::new("again", 1);
    video_rig(&b);
    b.ok(&["run", "rig.toml", "--seconds", "0.2"]);
    assert_eq!(b.model.lock().unwrap().dark_because(), Some("mirrors exercised"));
    // Its guard process writes there too, and says what it could not do.
    let said = std::fs::File::create(b.folder.join("said")).unwrap();
    let mut run = b.command(&["run", "rig.toml"]).stderr(said).spawn().unwrap();
    until_lit(&b, true);
    run.kill().unwrap();
    run.wait().unwrap();
    let killed = std::time::Instant::now();
    until_lit(&b, false);
    let took = killed.elapsed();
    assert!(took < std::time::Duration::from_secs(5), "{took:?}");
    until_rested(&b);
    b.ok(&["idle"]);
    b.ok(&["run", "rig.toml", "--seconds", "0.2"]);
    b.ok(&["video-pattern", "--patterns", "8"]);
    let m = b.model.lock().unwrap();
    assert_eq!(m.dark_because(), None);
    assert!(m.executed().iter().all(|e| e.error == 0), "no command was refused");
    assert_eq!(m.warnings(), [] as [String; 0]);
}

/// Waits until the mirrors exercise, as after a run; at most 20 s.
fn until_rested(b: &EmulatedBus) {
    for _ in 0..4000 {
        if b.model.lock().unwrap().dark_because() == Some("mirrors exercised") {
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    panic!("not put to rest: {:?}", b.model.lock().unwrap().dark_because());
}

/// Found in use, R4, on this device, which latches nothing itself: SAFE of a run that was killed, and of one that
/// ended in order, keeps the next run dark until somebody arms it. No other command makes light meanwhile.
#[test]
fn r4_safe_stands_over_restarts_until_somebody_arms() {
    let b = EmulatedBus::new("safe", 1);
    video_rig(&b);
    let long = std::time::Duration::from_secs(60);
    let run = b.start();
    until_lit(&b, true);
    b.order("safe", &run);
    until_lit(&b, false);
    run.signal("KILL");
    assert_eq!(run.finish().0.code(), None);
    until_rested(&b);
    let started = b.starts();
    for ends in ["TERM", "the order to arm"] {
        let refused = b.dpm(&["start"]);
        let err = text(&refused.stderr);
        assert!(refused.status.code() == Some(3) && err.contains("SAFE stands since"), "{err}");
        let mut run = b.start();
        run.wait_for_line(long, |line| line.contains("SAFE stands since") && line.contains("dpm arm"));
        // Set up, with everything that a start needs.
        run.wait_for_line(long, |line| line.contains("projector: dark, latched faults"));
        for _ in 0..100 {
            assert!(b.model.lock().unwrap().dark_because().is_some() && b.starts() == started);
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        if ends == "TERM" {
            run.signal(ends);
            assert_eq!(run.finish().0.code(), Some(0));
            until_rested(&b);
            continue;
        }
        b.order("arm", &run);
        until_lit(&b, true);
        run.signal("TERM");
        assert_eq!(run.finish().0.code(), Some(0));
    }
    // The order is over: the next run lights by itself.
    until_rested(&b);
    let run = b.start();
    until_lit(&b, true);
    run.signal("TERM");
    assert_eq!(run.finish().0.code(), Some(0));
}

/// SIGTERM: dark within 50 ms (in one of three attempts, on a shared machine), and the process ends within two
/// seconds with exit code 0, also while the mirrors exercise before the start.
#[test]
fn sigterm_makes_it_dark_and_ends_the_process() {
    let b = EmulatedBus::new("term", 1);
    video_rig(&b);
    let mut took = Vec::new();
    for _ in 0..3 {
        b.until_free();
        let mut run = b.command(&["run", "rig.toml"]).stderr(std::process::Stdio::null()).spawn().unwrap();
        until_lit(&b, true);
        std::thread::sleep(std::time::Duration::from_millis(300));
        let told = std::time::Instant::now();
        let kill = Command::new("kill").args(["-TERM", &run.id().to_string()]).status().unwrap();
        assert!(kill.success());
        until_lit(&b, false);
        took.push(told.elapsed());
        let status = run.wait().unwrap();
        assert!(status.success() && told.elapsed() < std::time::Duration::from_secs(2), "{status} {took:?}");
    }
    let limit = std::time::Duration::from_millis(60);
    assert!(took.iter().any(|t| *t < limit), "dark after {took:?}");
    // During the three seconds before the start.
    b.until_free();
    let mut run = b.command(&["run", "rig.toml"]).stderr(std::process::Stdio::null()).spawn().unwrap();
    std::thread::sleep(std::time::Duration::from_millis(1500));
    let told = std::time::Instant::now();
    assert!(Command::new("kill").args(["-TERM", &run.id().to_string()]).status().unwrap().success());
    assert!(run.wait().unwrap().success() && told.elapsed() < std::time::Duration::from_secs(2));
    assert_eq!(b.model.lock().unwrap().dark_because(), Some("mirrors exercised"));
}
