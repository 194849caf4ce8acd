//! Contacts that open, close, hang and lie.

use super::*;
use crate::config::{KeyInterlockConfig, LineInterlockConfig, NoInterlockConfig, ProcessInterlockConfig};
use std::path::PathBuf;
use std::process::{Child, Command};
use std::time::Instant;

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("dpm-interlock-{}-{name}", std::process::id()));
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn of(config: InterlockConfig) -> Interlock {
    Interlock::of_config(&config, true).unwrap().unwrap()
}

/// Longer than a busy machine takes for anything.
const PATIENCE: Duration = Duration::from_secs(20);

/// Waits until the interlock has the given state. Returns the time that this test's thread was served meanwhile: a
/// sleep of a millisecond counts as two at most.
fn becomes(interlock: &Interlock, closed: bool) -> Duration {
    let (begin, mut served) = (Instant::now(), Duration::ZERO);
    while interlock.is_closed() != closed {
        assert!(begin.elapsed() < PATIENCE, "{} never became {closed}", interlock.what());
        let step = Instant::now();
        std::thread::sleep(Duration::from_millis(1));
        served += step.elapsed().min(Duration::from_millis(2));
    }
    served
}

fn stays(interlock: &Interlock, closed: bool) {
    for _ in 0..100 {
        assert_eq!(interlock.is_closed(), closed, "{}", interlock.what());
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A process that lives until it is killed.
fn sleeper() -> Child {
    Command::new("sleep").arg("600").spawn().unwrap()
}

fn signal(child: &Child, signal: &str) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
}

fn process(limit: Duration) {
    let dir = folder("process");
    let file = dir.join("guard.pid");
    let interlock = of(InterlockConfig::Process(ProcessInterlockConfig {
        pid_file: Some(file.clone()),
        ..Default::default()
    }));
    assert!(!interlock.is_closed(), "no file");
    std::fs::write(&file, "not a number").unwrap();
    stays(&interlock, false);
    let mut child = sleeper();
    std::fs::write(&file, format!("{}\n", child.id())).unwrap();
    becomes(&interlock, true);
    stays(&interlock, true);
    // A stopped process cannot confirm anything.
    signal(&child, "-STOP");
    assert!(becomes(&interlock, false) < limit);
    signal(&child, "-CONT");
    becomes(&interlock, true);
    // Killed but not yet reaped: a zombie does not count as alive.
    child.kill().unwrap();
    assert!(becomes(&interlock, false) < limit);
    child.wait().unwrap();
    stays(&interlock, false);
    // Another process, with the file rewritten.
    let mut child = sleeper();
    std::fs::write(&file, child.id().to_string()).unwrap();
    becomes(&interlock, true);
    std::fs::remove_file(&file).unwrap();
    assert!(becomes(&interlock, false) < limit);
    child.kill().unwrap();
    child.wait().unwrap();
    std::fs::remove_dir_all(dir).unwrap();
}

#[test]
fn a_process_closes_it_while_it_lives_and_runs() {
    process(PATIENCE);
}

fn named_process(limit: Duration) {
    // A process name that only this test uses: the program under another file name.
    let dir = folder("name");
    let program = dir.join(format!("dg{}", std::process::id()));
    std::os::unix::fs::symlink("/bin/sleep", &program).unwrap();
    let name = program.file_name().unwrap().to_str().unwrap().to_owned();
    let interlock =
        of(InterlockConfig::Process(ProcessInterlockConfig { name: Some(name), ..Default::default() }));
    assert!(!interlock.is_closed());
    for _ in 0..2 {
        let mut child = Command::new(&program).arg("600").spawn().unwrap();
        becomes(&interlock, true);
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(becomes(&interlock, false) < limit);
    }
    std::fs::remove_dir_all(dir).unwrap();
}

#[test]
fn a_process_is_found_by_its_name_and_looked_for_again() {
    named_process(PATIENCE);
}

fn file(limit: Duration) {
    let dir = folder("file");
    let file = dir.join("value");
    let interlock =
        of(InterlockConfig::Line(LineInterlockConfig { file: Some(file.clone()), ..Default::default() }));
    assert!(!interlock.is_closed());
    for closed in ["1", "1\n", " 1 \n"] {
        std::fs::write(&file, closed).unwrap();
        becomes(&interlock, true);
        for open in ["0", "", "11", "on", "1 1"] {
            std::fs::write(&file, open).unwrap();
            assert!(becomes(&interlock, false) < limit, "{open:?}");
            std::fs::write(&file, closed).unwrap();
            becomes(&interlock, true);
        }
    }
    std::fs::remove_file(&file).unwrap();
    becomes(&interlock, false);
    // A pipe without a writer, and a folder: nothing hangs, and nothing counts as closed.
    assert!(Command::new("mkfifo").arg(&file).status().unwrap().success());
    stays(&interlock, false);
    drop(interlock);
    std::fs::remove_dir_all(dir).unwrap();
}

#[test]
fn a_file_closes_it_while_it_holds_a_one() {
    file(PATIENCE);
}

#[test]
fn a_port_that_is_not_there_or_has_no_lines_is_open() {
    let (_ours, path, _held) = dpm_mock::serial_server::pseudo_terminal().unwrap();
    for port in ["/dev/no-such-port".to_owned(), path] {
        let line = LineInterlockConfig { port: Some(port), ..Default::default() };
        stays(&of(InterlockConfig::Line(line)), false);
    }
}

#[test]
fn a_key_closes_it_while_it_repeats() {
    let key = KeyInterlockConfig { key: " ".into(), release_ms: 200 };
    let interlock = of(InterlockConfig::Key(key.clone()));
    assert!(!interlock.key_pressed(b'x'), "another key");
    assert!(interlock.key_pressed(b' '));
    // One press is not a hold. A keyboard starts to repeat only after half a second.
    stays(&interlock, false);
    let mut was_closed = false;
    for _ in 0..30 {
        interlock.key_pressed(b' ');
        std::thread::sleep(Duration::from_millis(10));
        was_closed |= interlock.is_closed();
    }
    assert!(was_closed);
    becomes(&interlock, false);
    // Without a terminal it is refused, and the message names the alternatives.
    let told = Interlock::of_config(&InterlockConfig::Key(key), false).unwrap_err().to_string();
    assert!(told.contains("safety.interlock") && told.contains("terminal"), "{told}");
    assert!(Interlock::of_config(&InterlockConfig::None(NoInterlockConfig {}), false).unwrap().is_none());
}

/// A contact that is closed, and hangs or panics on request.
struct Fails(Arc<AtomicI64>);

impl Contact for Fails {
    fn is_closed(&mut self) -> bool {
        match self.0.load(Ordering::Relaxed) {
            0 => true,
            1 => {
                while self.0.load(Ordering::Relaxed) == 1 {
                    std::thread::sleep(Duration::from_millis(1));
                }
                true
            }
            _ => panic!("a contact that fails"),
        }
    }
}

fn hung_thread(limit: Duration) {
    let mode = Arc::new(AtomicI64::new(0));
    let interlock = Interlock::with_contact("a test", Fails(mode.clone())).unwrap();
    becomes(&interlock, true);
    mode.store(1, Ordering::Relaxed);
    let took = becomes(&interlock, false);
    assert!(took <= limit, "{took:?}");
    mode.store(0, Ordering::Relaxed);
    becomes(&interlock, true);
    mode.store(2, Ordering::Relaxed);
    becomes(&interlock, false);
    stays(&interlock, false);
}

#[test]
fn a_thread_that_hangs_or_dies_opens_it() {
    hung_thread(PATIENCE);
}

/// How soon an interlock opens, on a machine with nothing else to do.
mod real_pace {
    use super::*;

    const LIMIT: Duration = Duration::from_millis(50);

    #[test]
    fn a_process_that_ends_opens_it_within_50_ms() {
        process(LIMIT);
    }

    #[test]
    fn a_named_process_that_ends_opens_it_within_50_ms() {
        named_process(LIMIT);
    }

    #[test]
    fn a_file_opens_it_within_50_ms() {
        file(LIMIT);
    }

    #[test]
    fn a_thread_that_hangs_opens_it_within_220_ms() {
        hung_thread(Duration::from_millis(2 * 110));
    }
}
