//! Orders that outlive the program, and the ownership of rigs: `dpm run` as a process on a projector behind a
//! pseudo-terminal.
#![allow(unsafe_code)]

use crate::cli_common::{code, command, dpm, err, out, own_folder, start_with, ChildProgram, TestFolder};
use crate::link_common::{raster, Projector, PtyProjector};
use crate::rig_file::{rig, run_words, WATCHDOG};
use dpm_device::link::{faults, DeviceState};
use hil_mock::projector::MockConfig;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::{chown, symlink, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const LONG: Duration = Duration::from_secs(60);
const NOBODY: u32 = 65534;

fn is_root() -> bool {
    // SAFETY: the call has no arguments and cannot fail.
    unsafe { libc::geteuid() == 0 }
}

/// A rig with a state folder of its own.
struct StateFolderRig {
    _folder: TestFolder,
    path: String,
    far: PtyProjector,
    state: PathBuf,
}

impl StateFolderRig {
    fn new(name: &str) -> Self {
        let (folder, path, far) = rig(name);
        let state = folder.path("state");
        Self { _folder: folder, path, far, state }
    }

    fn start(&self) -> ChildProgram {
        start_with(&run_words(&self.path), &[("DPM_STATE_DIR", self.state.to_str().unwrap())])
    }

    /// A run that lights a projector that has just been switched on.
    fn lit(&self) -> ChildProgram {
        self.power_cycle();
        let mut run = self.start();
        let begin = Instant::now();
        while !(self.far.is_lit() && self.far.status().frames_lit >= 3) {
            if begin.elapsed() > LONG {
                panic!("no light: {:?}, {:#?}", self.far.status(), run.rest_of_lines(Duration::ZERO));
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        run
    }

    /// The only file of a standing order; `None` if no order stands.
    fn kept(&self) -> Option<PathBuf> {
        let files = fs::read_dir(&self.state).into_iter().flatten().filter_map(Result::ok).map(|e| e.path());
        let files: Vec<_> = files.filter(|p| p.extension().is_some_and(|e| e == "order")).collect();
        assert!(files.len() <= 1, "{files:?}");
        files.into_iter().next()
    }

    /// A run that was killed with `order` standing.
    fn killed_after(&self, order: &str) {
        let run = self.lit();
        self.order(order, &run, 0);
        assert!(self.kept().is_some());
        run.signal("KILL");
        assert_eq!(run.finish().0.code(), None);
    }

    fn order(&self, word: &str, run: &ChildProgram, wanted: i32) -> String {
        let told = dpm(&[word, "--pid", &run.id().to_string()], &[]);
        assert_eq!(code(&told), wanted, "{word}: {}{}", out(&told), err(&told));
        out(&told)
    }

    /// The next run reports that `word` stands, stays dark over ten slots of its frames, and lights when it is armed.
    fn comes_up_dark_until_armed(&self, word: &str) {
        let mut run = self.start();
        run.wait_for_line(LONG, |line| line.contains(word) && line.contains("dpm arm"));
        run.wait_for_line(LONG, |line| {
            // A watchdog that has bitten after the kill is a passing fault.
            line.contains("projector: dark, ") || line.contains("projector: black")
        });
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_millis(500) {
            let s = self.far.status();
            assert!(!s.lit && s.state != DeviceState::Armed, "{s:?}");
            std::thread::sleep(Duration::from_millis(1));
        }
        self.order("arm", &run, 0);
        self.far.until(LONG, "light after the order", &mut |s| s.lit);
        assert_eq!(self.kept(), None);
        run.signal("TERM");
        assert_eq!(run.finish().0.code(), Some(0));
        // The order is over: the next run lights by itself.
        let run = self.lit();
        run.signal("INT");
        assert_eq!(run.finish().0.code(), Some(0));
    }

    /// The projector loses its power and with it everything that it had latched.
    fn power_cycle(&self) {
        self.far.unplug();
        self.far.exchange(MockConfig::new(raster()));
        self.far.plug_in();
    }
}

/// Found in use, R4: `dpm safe`, `kill -9`, `dpm run` brought the light back without anybody's order.
#[test]
fn r4_safe_holds_over_kill_and_a_projector_without_power_until_somebody_arms() {
    let bench = StateFolderRig::new("safe");
    bench.killed_after("safe");
    let text = fs::read_to_string(bench.kept().unwrap()).unwrap();
    assert!(text.contains("\"order\":\"safe\"") && text.contains("over the control socket"), "{text}");
    bench.power_cycle();
    bench.comes_up_dark_until_armed("SAFE stands since");
}

/// Found in use, R4: the projector's own latch counts without a file, whatever faults the rig file acknowledges.
#[test]
fn r4_safe_that_only_the_projector_remembers_holds_too() {
    let bench = StateFolderRig::new("latched");
    bench.killed_after("safe");
    fs::remove_file(bench.kept().unwrap()).unwrap();
    assert_eq!(bench.far.status().faults & faults::HOST_SAFE, faults::HOST_SAFE);
    let state = bench.state.to_str().unwrap().to_owned();
    let mut args = run_words(&bench.path);
    args.extend(["--set".into(), "safety.acknowledge_faults=true".into()]);
    let mut run = start_with(&args, &[("DPM_STATE_DIR", &state)]);
    run.wait_for_line(LONG, |line| line.contains("projector: dark, latched faults"));
    // From now on the host knows it too, should the projector lose its power.
    let begin = Instant::now();
    while bench.kept().is_none() {
        assert!(begin.elapsed() < LONG && !bench.far.is_lit());
        std::thread::sleep(Duration::from_millis(1));
    }
    run.signal("KILL");
    run.finish();
    bench.power_cycle();
    bench.comes_up_dark_until_armed("SAFE stands since");
}

/// Found in use, R4: a state file that cannot be read counts as SAFE.
#[test]
fn r4_a_damaged_state_file_keeps_the_next_run_dark() {
    let bench = StateFolderRig::new("damaged");
    bench.killed_after("black");
    let path = bench.kept().unwrap();
    let half = fs::read(&path).unwrap();
    fs::write(&path, &half[..half.len() / 2]).unwrap();
    bench.power_cycle();
    bench.comes_up_dark_until_armed("counts as SAFE");
}

/// Found in use, R4 and R3: BLACK of a run that died remains, and whoever restarts a service brings no light back.
#[test]
fn r3_orders_outlive_a_run_that_died_and_one_that_ended() {
    let bench = StateFolderRig::new("black");
    bench.killed_after("black");
    bench.comes_up_dark_until_armed("BLACK stands since");
    for (order, told) in [("black", "BLACK stands since"), ("safe", "SAFE stands since")] {
        let run = bench.lit();
        bench.order(order, &run, 0);
        run.signal("TERM");
        assert_eq!(run.finish().0.code(), Some(0));
        bench.power_cycle();
        bench.comes_up_dark_until_armed(told);
    }
}

/// Found in use, R1 and R6: SAFE by a link of the port did not hold a run by the port itself, and a second program by
/// the other name came as far as the port.
#[test]
fn r1_a_link_of_the_port_is_the_same_projector() {
    let bench = StateFolderRig::new("link");
    let link = bench._folder.path("port");
    symlink(&bench.far.path, &link).unwrap();
    let by_link = bench._folder.path("link.toml");
    let text = fs::read_to_string(&bench.path).unwrap();
    let [real, linked] = [&bench.far.path, &link].map(|path| path.display().to_string());
    assert!(text.contains(&real));
    fs::write(&by_link, text.replace(&real, &linked)).unwrap();
    let state = [("DPM_STATE_DIR", bench.state.to_str().unwrap())];
    let run = start_with(&run_words(by_link.to_str().unwrap()), &state);
    bench.far.until(LONG, "light", &mut |s| s.lit);
    // Another folder of locks, as another user has.
    let elsewhere = bench._folder.path("locks");
    let told = dpm(&["run", &bench.path], &[state[0], ("DPM_RUNTIME_DIR", elsewhere.to_str().unwrap())]);
    assert_eq!(code(&told), 3, "{}", err(&told));
    assert!(err(&told).contains("is in use by another dpm"), "{}", err(&told));
    bench.order("safe", &run, 0);
    run.signal("KILL");
    run.finish();
    bench.power_cycle();
    bench.comes_up_dark_until_armed("SAFE stands since");
}

/// Found in use again: BLACK for another projector at the same port replaced SAFE for the first one.
#[test]
fn orders_for_two_projectors_at_one_port_stand_side_by_side() {
    let bench = StateFolderRig::new("two-projectors");
    let plug = |serial| {
        bench.far.unplug();
        bench.far.exchange(MockConfig { serial, ..MockConfig::new(raster()) });
        bench.far.plug_in();
    };
    let dark_after = |run: &mut ChildProgram, word: &str| {
        run.wait_for_line(LONG, |line| line.contains(word));
        // ARM is for the projector that has told who it is.
        bench.far.until(LONG, "a session", &mut |s| {
            matches!(s.state, DeviceState::Configured | DeviceState::Faulted)
        });
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_millis(500) {
            let s = bench.far.status();
            assert!(!s.lit && s.state != DeviceState::Armed, "{s:?}");
            std::thread::sleep(Duration::from_millis(1));
        }
    };
    plug(0xa1);
    let run = bench.start();
    bench.far.until(LONG, "light of the first one", &mut |s| s.lit);
    bench.order("safe", &run, 0);
    run.signal("KILL");
    run.finish();
    // The other one, which a person arms and makes dark.
    plug(0xb2);
    let mut run = bench.start();
    dark_after(&mut run, "SAFE stands since");
    bench.order("arm", &run, 0);
    bench.far.until(LONG, "light of the other one", &mut |s| s.lit);
    bench.order("black", &run, 0);
    run.signal("KILL");
    run.finish();
    // The first one is back, without power meanwhile.
    plug(0xa1);
    let mut run = bench.start();
    dark_after(&mut run, "SAFE stands since");
    bench.order("arm", &run, 0);
    bench.far.until(LONG, "light of the first one", &mut |s| s.lit);
    // Within one run, too: nobody has armed the other one.
    plug(0xb2);
    dark_after(&mut run, "stands for the one with this serial number");
    bench.order("arm", &run, 0);
    bench.far.until(LONG, "light of the other one", &mut |s| s.lit);
    bench.order("black", &run, 0);
    plug(0xa1);
    bench.far.until(LONG, "a session with the first one", &mut |s| s.state == DeviceState::Configured);
    bench.order("arm", &run, 0);
    bench.far.until(LONG, "light of the first one", &mut |s| s.lit);
    plug(0xb2);
    dark_after(&mut run, "stands for the one with this serial number");
    run.signal("TERM");
    assert_eq!(run.finish().0.code(), Some(0));
}

#[test]
fn a_start_by_hand_is_dark_until_somebody_arms() {
    let bench = StateFolderRig::new("by-hand");
    let mut args = run_words(&bench.path);
    args.extend(["--set".into(), "safety.start=\"by hand\"".into()]);
    let mut run = start_with(&args, &[("DPM_STATE_DIR", bench.state.to_str().unwrap())]);
    run.wait_for_line(LONG, |line| line.contains("(safety.start)") && line.contains("dpm arm"));
    run.wait_for_line(LONG, |line| line.contains("projector: black"));
    assert!(!bench.far.is_lit() && bench.kept().is_none());
    bench.order("arm", &run, 0);
    bench.far.until(LONG, "light after the order", &mut |s| s.lit);
    run.signal("TERM");
    assert_eq!(run.finish().0.code(), Some(0));
}

/// Found in use, R4: without a folder in which SAFE can be kept, a real projector is not run.
#[test]
fn r4_a_real_projector_without_a_state_folder_is_refused() {
    let bench = StateFolderRig::new("no-state");
    fs::write(&bench.state, b"a file").unwrap();
    let told = dpm(&["run", &bench.path], &[("DPM_STATE_DIR", bench.state.to_str().unwrap())]);
    assert_eq!(code(&told), 2, "{}", err(&told));
    assert!(
        err(&told).contains("SAFE could not be kept") && err(&told).contains("DPM_STATE_DIR"),
        "{}",
        err(&told)
    );
    assert_eq!(bench.far.status().state, DeviceState::Idle);
}

/// Found in use, R9: a thousand silent clients of the same user delayed `dpm safe`, which then reported "delivered".
#[test]
fn r9_a_thousand_silent_connections_hold_no_emergency_up() {
    let bench = StateFolderRig::new("flood");
    let run = bench.lit();
    let socket = own_folder("run").join(format!("run-{}.sock", run.id()));
    // SAFETY: plain numbers in places that outlive the calls.
    unsafe {
        let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
        assert_eq!(libc::getrlimit(libc::RLIMIT_NOFILE, &raw mut limit), 0);
        limit.rlim_cur = limit.rlim_max.min(4096);
        assert_eq!(libc::setrlimit(libc::RLIMIT_NOFILE, &raw const limit), 0);
    }
    let folder = fs::File::open(socket.parent().unwrap()).unwrap();
    let short = format!("/proc/self/fd/{}/run-{}.sock", std::os::fd::AsRawFd::as_raw_fd(&folder), run.id());
    let mut silent: Vec<UnixStream> = (0..1000).map(|_| UnixStream::connect(&short).unwrap()).collect();
    let asked = Instant::now();
    let told = bench.order("safe", &run, 0);
    assert!(told.contains("ok: projector dark") && told.contains("rig.toml"), "{told}");
    assert!(asked.elapsed() < Duration::from_secs(2), "{:?}", asked.elapsed());
    assert_eq!(bench.far.status().state, DeviceState::Faulted);
    // The disconnected clients have come back.
    silent.extend((0..500).map(|_| UnixStream::connect(&short).unwrap()));
    bench.order("arm", &run, 0);
    bench.far.until(LONG, "light", &mut |s| s.lit);
    run.signal("TERM");
    assert_eq!(run.finish().0.code(), Some(0));
}

/// Found in use, R7: root's run wrote its process id into a file of root to which the user nobody had placed a link
/// in the lock folder.
#[test]
fn r7_a_lock_folder_of_others_and_planted_links_are_refused() {
    let bench = StateFolderRig::new("links");
    let runtime = bench._folder.path("runtime");
    fs::create_dir(&runtime).unwrap();
    let victim = bench._folder.path("victim");
    fs::write(&victim, b"precious").unwrap();
    // The name of the lock, from a run that created it.
    let run = |wanted: &str| {
        let told = dpm(&["run", &bench.path], &[("DPM_RUNTIME_DIR", runtime.to_str().unwrap())]);
        assert_eq!(code(&told), 2, "{}{}", out(&told), err(&told));
        assert!(err(&told).contains(wanted) && err(&told).contains("DPM_RUNTIME_DIR"), "{}", err(&told));
        assert_eq!(fs::read(&victim).unwrap(), b"precious");
        assert_eq!(bench.far.status().state, DeviceState::Idle, "the projector was not even opened");
    };
    let [major, minor] = dpm_common::unix::device_number(&fs::metadata(&bench.far.path).unwrap());
    let lock = runtime.join(format!("projector-on-device-{major}-{minor}.lock"));
    symlink(&victim, &lock).unwrap();
    run("is a link");
    fs::remove_file(&lock).unwrap();
    fs::hard_link(&victim, &lock).unwrap();
    run("has 2 names");
    fs::remove_file(&lock).unwrap();
    fs::set_permissions(&runtime, fs::Permissions::from_mode(0o777)).unwrap();
    run("can be written by others");
    fs::set_permissions(&runtime, fs::Permissions::from_mode(0o755)).unwrap();
    if is_root() {
        chown(&runtime, Some(NOBODY), None).unwrap();
        run("belongs to");
        chown(&runtime, Some(0), None).unwrap();
    }
    let elsewhere = bench._folder.path("elsewhere");
    fs::rename(&runtime, &elsewhere).unwrap();
    symlink(&elsewhere, &runtime).unwrap();
    run("is a link or a file");
}

/// What `r8_...` runs as another user: a socket that answers like a rig.
#[test]
#[ignore = "a part of the test below"]
fn impostor() {
    let folder = std::env::var("IMPOSTOR").expect("run by the test below");
    fs::create_dir_all(&folder).unwrap();
    let listener = UnixListener::bind(Path::new(&folder).join("run-4242.sock")).unwrap();
    println!("listening");
    for stream in listener.incoming().map_while(Result::ok) {
        let mut stream = stream;
        let mut word = [0; 16];
        let _ = stream.read(&mut word);
        let _ = stream.write_all(b"heard /etc/dpm/rig.toml\nok: projector black\n");
    }
}

/// Found in use, R8: a process of the user nobody answered in the place of root's rig, and root's `dpm black` ended
/// with 0.
#[test]
fn r8_another_users_word_is_not_taken_for_a_rigs() {
    if !is_root() {
        eprintln!("needs root to be somebody else; the same rule is tested in control::client without");
        return;
    }
    let folder = TestFolder::new("impostor");
    fs::set_permissions(folder.text(), fs::Permissions::from_mode(0o777)).unwrap();
    let program = folder.path("program");
    fs::copy(std::env::current_exe().unwrap(), &program).unwrap();
    let theirs = folder.path("dpm-0");
    let mut child = Command::new(&program)
        .args(["--ignored", "--exact", "real_pace::standing::impostor", "--nocapture"])
        .env("IMPOSTOR", &theirs)
        .uid(NOBODY)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
    assert!(lines.into_iter().any(|line| line.contains("listening")));
    let told = command(&["black"]).env("DPM_RUNTIME_DIR", &theirs).output().unwrap();
    let _ = child.kill();
    let _ = child.wait();
    assert_eq!(code(&told), 3, "{}{}", out(&told), err(&told));
    assert!(
        out(&told).contains("process 4242 of nobody") && out(&told).contains("says (unverified)"),
        "{}",
        out(&told)
    );
    assert!(err(&told).contains("reached no rig of user root"), "{}", err(&told));
}

/// Only a running rig can be armed, and the message says what still stands.
#[test]
fn without_a_running_rig_arm_clears_nothing() {
    let bench = StateFolderRig::new("arm");
    bench.killed_after("safe");
    let variables = [("DPM_STATE_DIR", bench.state.to_str().unwrap())];
    let alone = bench._folder.path("alone");
    let told = dpm(&["arm"], &[variables[0], ("DPM_RUNTIME_DIR", alone.to_str().unwrap())]);
    assert_eq!(code(&told), 3);
    assert!(err(&told).contains("only a running rig can be armed"), "{}", err(&told));
    assert!(bench.kept().is_some());
    // A command that would light without a rig that could be armed does not light either.
    let told = dpm(&["link-test", &bench.path, "--prepared", "--for", "1"], &variables);
    assert_eq!(code(&told), 3, "{}", err(&told));
    assert!(err(&told).contains("SAFE stands since"), "{}", err(&told));
    std::thread::sleep(WATCHDOG);
    assert!(!bench.far.is_lit());
}
