//! Ways out of a run, as the writeback connector sees them: a display that is unplugged, and a run that is killed.

use std::collections::HashMap;
use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use dpm_common::guardian;
use dpm_device::link::LinkState;
use dpm_display::card::{cards, show_black};
use dpm_display::encoding::Encoding;
use dpm_display::scan_out::DisplayError;
use dpm_display::transport::set_guardian;
use rustix::process::{pidfd_getfd, pidfd_open, Pid, PidfdFlags, PidfdGetfdFlags};

use crate::rig::{open_by, opener, pixels, stream, timing, CONNECTOR, PATIENCE};
use crate::witness::{witnessed, WitnessLog};
use crate::writeback::{driven, WritebackReader};

/// How long a guardian of this test keeps a display.
pub(crate) const HOLD: Duration = Duration::from_secs(20);
/// Between two pictures that are read beside a run: each keeps the kernel busy for a blank, and others need some too.
const BETWEEN_READS: Duration = Duration::from_millis(40);
/// How long a killed run is watched. The guardian keeps the display for longer.
const WATCHED: Duration = Duration::from_millis(1500);
/// How long the display stays unplugged.
const UNPLUGGED: Duration = Duration::from_secs(1);
/// Lit pictures that are looked at before and after.
const ENOUGH: usize = 10;

fn is_black(pixels: &[u8]) -> bool {
    pixels.iter().all(|b| *b == 0)
}

/// What the kernel says of the connector's cable, and where it is told.
fn plug(word: &str) {
    let card = cards()[0].file_name().unwrap().to_string_lossy().into_owned();
    std::fs::write(format!("/sys/class/drm/{card}-{CONNECTOR}/status"), word).expect("the kernel takes it");
}

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Phase {
    Plugged,
    Pulled,
    Unplugged(Instant, usize),
    Back(usize),
}

/// The kernel says that the display is unplugged, and later that it is back.
pub(crate) fn unplugged() {
    let log = WitnessLog::default();
    let (mut display, clock) = open_by(witnessed(opener(Encoding::Rgb8), &log));
    let mut phase = Phase::Plugged;
    let lit = |from: usize| {
        let log = log.lock();
        log.taken.iter().skip(from).filter_map(|taken| taken.pixels.as_ref()).filter(|p| !is_black(p)).count()
    };
    let sent = stream(&mut display, clock.as_ref(), Encoding::Rgb8, |_, link| {
        match phase {
            Phase::Plugged if lit(0) >= ENOUGH => {
                plug("off");
                phase = Phase::Pulled;
            }
            Phase::Pulled if link.state() == LinkState::Lost => {
                phase = Phase::Unplugged(Instant::now(), log.lock().taken.len());
            }
            Phase::Unplugged(since, taken) => {
                assert_eq!(link.state(), LinkState::Lost);
                assert_eq!(log.lock().taken.len(), taken, "nothing is shown at an unplugged display");
                if since.elapsed() > UNPLUGGED {
                    let blackened = &log.lock().blackened;
                    assert!(
                        !blackened.is_empty() && blackened.iter().all(|p| is_black(p)),
                        "unplugged: black"
                    );
                    plug("detect");
                    phase = Phase::Back(taken);
                }
            }
            _ => {}
        }
        matches!(phase, Phase::Back(before) if lit(before) >= ENOUGH)
    });
    drop(display);
    let known: HashMap<Vec<u8>, u64> =
        sent.iter().map(|(id, _)| (pixels(Encoding::Rgb8, *id), *id)).collect();
    let log = log.lock();
    let mut newest = 0;
    for pixels in log.taken.iter().filter_map(|taken| taken.pixels.as_ref()).filter(|p| !is_black(p)) {
        let id = *known.get(pixels).expect("only frames that were sent, whole");
        assert!(id >= newest, "frame {id} behind {newest}");
        newest = id;
    }
    assert!(log.blackened.iter().all(|pixels| is_black(pixels)));
    println!(
        "  {} pictures read back, {} of them on ways out, all black",
        log.taken.len(),
        log.blackened.len()
    );
}

pub(crate) fn this_program() -> OsString {
    std::env::current_exe().unwrap().into()
}

/// A run that goes on until it is killed. It says when there is light.
pub(crate) fn run_for_ever() {
    set_guardian(vec![this_program(), "guard".into()]);
    let (mut display, clock) = open_by(opener(Encoding::Rgb8));
    let mut told = false;
    stream(&mut display, clock.as_ref(), Encoding::Rgb8, |_, link| {
        if !told && link.status().is_some_and(|status| status.frames_lit > 0) {
            told = true;
            println!("light");
        }
        false
    });
}

/// The guardian of such a run.
pub(crate) fn guard(arguments: &[String]) {
    let number = |flag: &str| {
        let at = arguments.iter().position(|a| a == flag).expect(flag);
        arguments[at + 1].parse().unwrap()
    };
    if guardian::outlived() {
        let descriptor = std::io::stdout().as_fd().try_clone_to_owned().unwrap();
        match show_black(descriptor, number("--crtc"), number("--black"), HOLD) {
            // A compositor may have taken its lease back before.
            Ok(()) | Err(DisplayError::Revoked) => {}
            Err(e) => panic!("{e}"),
        }
    }
}

/// A duplicate of the descriptor with which `run` drives the display: the kernel takes commits from no other.
fn descriptor_of(run: &Child) -> OwnedFd {
    let card = &cards()[0];
    let folder = format!("/proc/{}/fd", run.id());
    let is_it = |path: &Path| std::fs::read_link(path).is_ok_and(|to| to == *card);
    let mut all = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let path = all.find(|path| is_it(path)).expect("it has the card open");
    let number = path.file_name().unwrap().to_string_lossy().parse().unwrap();
    let pid = Pid::from_raw(run.id() as i32).unwrap();
    let process = pidfd_open(pid, PidfdFlags::empty()).unwrap();
    pidfd_getfd(process, number, PidfdGetfdFlags::empty()).expect("root may")
}

/// SIGKILL ends a run in the middle of its light.
pub(crate) fn killed() {
    let mut run = Command::new(this_program()).arg("run").stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(run.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert_eq!(line, "light\n");
    let descriptor = descriptor_of(&run);
    let crtc = driven(&descriptor, timing().size()).expect("the run drives a CRTC");
    let mut reader = WritebackReader::attach(descriptor, crtc, timing().size());
    let mut read = || {
        std::thread::sleep(BETWEEN_READS);
        reader.read().expect("the run's or the guardian's display")
    };
    let limit = Instant::now() + PATIENCE;
    let light = std::iter::repeat_with(&mut read).find(|pixels| {
        assert!(Instant::now() < limit, "no light comes back");
        !is_black(pixels)
    });
    let light = light.unwrap();
    let frame = (1..10_000).find(|id| pixels(Encoding::Rgb8, *id) == light).expect("a frame of the run");
    run.kill().unwrap();
    run.wait().unwrap();
    let killed_at = Instant::now();
    let mut reads = 1;
    while !is_black(&read()) {
        assert!(Instant::now() < limit, "still light after SIGKILL");
        reads += 1;
    }
    println!(
        "  frame {frame} was lit; all pixels black {:?} after SIGKILL, in read {reads}",
        killed_at.elapsed()
    );
    // It stays so while the guardian holds the display, and another run takes it over.
    let mut more = 0;
    while killed_at.elapsed() < WATCHED || more < ENOUGH {
        assert!(is_black(&read()), "light came back");
        more += 1;
    }
    println!("  {more} more pictures read back, all black");
    drop(reader);
    let (display, _clock) = open_by(opener(Encoding::Rgb8));
    drop(display);
}
