//! A display of the kernel's own (vkms): what is scanned out, by the kernel's checksum of every frame, is what was packed.
//!
//! `./x hil` runs this in a virtual machine with `DPM_VKMS=1`. The program is also the guardian of its own runs.

mod common;
// Its bad manners are for the tests of the client (`host/display/src/lease/wayland/tests.rs`).
#[allow(dead_code)]
#[path = "common/compositor.rs"]
mod compositor;
#[path = "vkms/lease.rs"]
mod lease;

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::os::fd::AsFd;
use std::path::Path;
use std::process::{Child, Command};
use std::sync::mpsc::{channel, Receiver};
use std::sync::Arc;
use std::time::{Duration, Instant};

use dpm_common::guardian;
use dpm_device::link::{HostLink, LinkSettings, LinkState};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::rng::Draws;
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::Transport;
use dpm_display::card::{cards, open_for, show_black, Card};
use dpm_display::encoding::{Encoding, PixelMap};
use dpm_display::mode::{ModeWish, Timing};
use dpm_display::scan_out::DisplayError;
use dpm_display::set_up::DisplaySettings;
use dpm_display::transport::{on_card, set_guardian, DisplayTransport};
use dpm_handoff::wake::WaitPolicy;

/// Small, because the machine is emulated: 160 x 120 at 60 frames/s.
const MODE: &str = "1.8 160 164 180 200 120 124 130 150 +hsync -vsync";
const CRC: &str = "/sys/kernel/debug/dri/0/crtc-0/crc";
const PATIENCE: Duration = Duration::from_secs(60);
/// How long a guardian of this test keeps a display.
const HOLD: Duration = Duration::from_secs(20);

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.first().map(String::as_str) {
        Some("guard") => guard(&arguments),
        Some("run") => run_for_ever(),
        Some("run-on-lease") => lease::run_for_ever(),
        _ if std::env::var_os("DPM_VKMS").is_none() => {
            println!("not in the machine of `./x hil`: nothing is tested");
        }
        _ => {
            for (name, test) in [
                ("what_is_there_is_listed_and_refused_by_name", refusals as fn()),
                ("every_frame_is_scanned_out_bit_for_bit", bits),
                ("a_killed_run_is_black", killed),
                ("what_a_desktop_lends_is_shown_lost_and_taken_up_again", lease::all),
            ] {
                println!("test {name} ...");
                test();
                println!("test {name} ... ok");
            }
            println!("HIL-VKMS-OK");
        }
    }
}

fn timing() -> Timing {
    match MODE.parse() {
        Ok(ModeWish::Exactly(timing)) => timing,
        _ => panic!("a timing"),
    }
}

fn settings(encoding: Encoding) -> DisplaySettings {
    let (width, height) = timing().size();
    DisplaySettings {
        connector: Some("Virtual-1".into()),
        mode: MODE.parse().unwrap(),
        encoding,
        without: Vec::new(),
        commit_ns: 5_000_000,
        shows_at_pulse: false,
        raster: Raster::new(width, height).unwrap(),
        schedule: PlaneSchedule::rgb24(),
        rate: timing().rate().unwrap(),
    }
}

fn open(encoding: Encoding) -> (DisplayTransport, Arc<dyn HostClock>) {
    let start = Instant::now();
    let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(start.elapsed().as_nanos() as i64));
    let opener = on_card(|| open_for(None, Some("Virtual-1")), settings(encoding));
    let mut display = DisplayTransport::open(opener, WaitPolicy::Park, 0).expect("vkms");
    display.set_clock(clock.clone());
    (display, clock)
}

/// Planes of frame `id`: any bits in the first rows of each plane, the rest a function of few draws.
fn planes(raster: Raster, id: u64) -> Vec<u8> {
    let draws = Draws::new(id + 1);
    (0..raster.plane_bytes() * 24).map(|i| draws.bits((i % 1999) as u64) as u8 ^ (i / 1999) as u8).collect()
}

/// The checksum that the kernel computes of a picture: CRC-32 without its inversions, over pixels of 16 bits for each of
/// alpha, red, green and blue (drivers/gpu/drm/vkms/vkms_composer.c).
fn checksum(pixels: &[u8]) -> u32 {
    let mut crc = 0u32;
    let mut push = |byte: u8| {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 };
        }
    };
    for pixel in pixels.chunks_exact(4) {
        // Little-endian words of alpha, red, green, blue; eight bits become sixteen by repeating them.
        for byte in [0xff, pixel[2], pixel[1], pixel[0]] {
            push(byte);
            push(byte);
        }
    }
    crc
}

fn pixels(encoding: Encoding, id: u64) -> Vec<u8> {
    let settings = settings(encoding);
    let raster = settings.raster;
    let pitch = 4 * raster.width() as usize;
    let mut out = vec![0; pitch * raster.height() as usize];
    PixelMap::new(encoding, &settings.schedule).unwrap().write(raster, &planes(raster, id), &mut out, pitch);
    out
}

/// The kernel's checksums from now on: the count of the blank, and the sum.
fn checksums() -> Receiver<(u32, u32)> {
    File::options().write(true).open(format!("{CRC}/control")).unwrap().write_all(b"auto").unwrap();
    let data = BufReader::new(File::open(format!("{CRC}/data")).expect("the kernel's checksums"));
    let (tell, told) = channel();
    std::thread::spawn(move || {
        for line in data.lines().map_while(Result::ok) {
            // The kernel ends each line with a newline and a zero.
            let line = line.trim_matches('\0');
            let mut words =
                line.split_whitespace().map(|w| u32::from_str_radix(w.trim_start_matches("0x"), 16));
            let (Some(Ok(frame)), Some(Ok(sum))) = (words.next(), words.next()) else { continue };
            if tell.send((frame, sum)).is_err() {
                break;
            }
        }
    });
    told
}

/// Streams frames until `done`, which gets the number of frames sent. Returns the frames with their slots.
fn stream(
    display: &mut DisplayTransport,
    clock: &dyn HostClock,
    encoding: Encoding,
    mut done: impl FnMut(usize) -> bool,
) -> Vec<(u64, u64)> {
    let settings = settings(encoding);
    let mut link = HostLink::new(LinkSettings {
        raster: settings.raster,
        rate: settings.rate,
        watchdog_us: 2_000_000,
        ..common::link_settings()
    });
    link.connect();
    let limit = Instant::now() + PATIENCE;
    let (mut sent, mut next, mut id) = (Vec::new(), 0, 0);
    while !done(sent.len()) {
        assert!(Instant::now() < limit, "still {:?}, {:?}", link.state(), display.counts().map(|c| c.lost()));
        match link.poll(clock.now(), display).expect("the display stays") {
            LinkState::Ready => link.arm(0),
            LinkState::Faulted => link.arm(u32::MAX),
            LinkState::Streaming => {
                let slots = link.slots().unwrap();
                let slot = link.status().and_then(|s| slots.slot_at(s.now)).map_or(0, |slot| slot + 3);
                if slot > next {
                    (next, id) = (slot, id + 1);
                    let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 2_000_000_000));
                    let outcome = link.send_frame(
                        clock.now(),
                        id,
                        target,
                        dark_from,
                        &planes(settings.raster, id),
                        display,
                    );
                    if outcome == dpm_device::link::SendOutcome::Sent {
                        sent.push((id, slot));
                    }
                }
            }
            _ => {}
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let status = link.status().expect("streamed");
    println!(
        "  {} sent, {} lit, {} repeated, {} superseded, {} late",
        sent.len(),
        status.frames_lit,
        status.slots_repeated,
        status.frames_superseded,
        status.frames_late
    );
    sent
}

fn refusals() {
    let paths = cards();
    println!("  cards: {paths:?}");
    let mine = Card::open(&paths[0]).expect("a card that nobody drives");
    assert!(matches!(Card::open(&paths[0]), Err(DisplayError::InUse(_))), "one program at a time");
    drop(mine);
    let refused = |change: &dyn Fn(&mut DisplaySettings)| {
        let mut settings = settings(Encoding::Planes24);
        change(&mut settings);
        let opener = on_card(|| open_for(None, Some("Virtual-1")), settings);
        DisplayTransport::open(opener, WaitPolicy::Park, 0).err().expect("refused").to_string()
    };
    let told = refused(&|s| s.mode = "1024x768@200".parse().unwrap());
    println!("  {told}");
    assert!(told.contains("1024x768@60"), "{told}");
    let told = refused(&|s| s.mode = "1024x768@60".parse().unwrap());
    assert!(told.contains("projector.width = 160"), "{told}");
    assert!(refused(&|s| s.connector = Some("DP-1".into())).contains("Virtual-1"));
    let nowhere = Card::open(Path::new("/dev/dri/card9"));
    assert!(matches!(nowhere, Err(DisplayError::NoCard(_))));
}

fn bits() {
    for encoding in [Encoding::Rgb8, Encoding::Planes24] {
        let (mut display, clock) = open(encoding);
        let told = checksums();
        let sent = stream(&mut display, clock.as_ref(), encoding, |sent| sent >= 120);
        let counts = display.counts().unwrap();
        let missed = counts.missed.load(std::sync::atomic::Ordering::Relaxed);
        let taken = counts.taken.load(std::sync::atomic::Ordering::Relaxed);
        println!("  {taken} pictures taken, {missed} blanks missed");
        let black = checksum(&vec![0; pixels(encoding, 0).len()]);
        let known: BTreeMap<u32, u64> =
            sent.iter().map(|(id, _)| (checksum(&pixels(encoding, *id)), *id)).collect();
        let (mut seen, mut blacks, mut newest) = (std::collections::BTreeSet::new(), 0, 0);
        for (blank, sum) in told.try_iter() {
            if sum == black {
                blacks += 1;
                continue;
            }
            let id = *known
                .get(&sum)
                .unwrap_or_else(|| panic!("blank {blank}: {sum:08x} is no frame that was sent"));
            assert!(id >= newest, "frame {id} behind {newest}");
            newest = id;
            seen.insert(id);
        }
        println!("  {} of {} frames seen by the kernel's checksum, {blacks} black", seen.len(), sent.len());
        assert!(seen.len() * 2 >= sent.len(), "most frames were scanned out");
        drop(display);
    }
}

fn this_program() -> OsString {
    std::env::current_exe().unwrap().into()
}

/// A run that goes on until it is killed.
fn run_for_ever() {
    set_guardian(vec![this_program(), "guard".into()]);
    let (mut display, clock) = open(Encoding::Rgb8);
    stream(&mut display, clock.as_ref(), Encoding::Rgb8, |_| false);
}

fn guard(arguments: &[String]) {
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

/// The next checksums until `wanted`, within the patience.
fn wait_for(told: &Receiver<(u32, u32)>, what: &str, wanted: impl Fn(u32) -> bool) -> u32 {
    let limit = Instant::now() + PATIENCE;
    let mut looked = 0;
    loop {
        let left = limit.saturating_duration_since(Instant::now());
        let (_, sum) = told.recv_timeout(left).unwrap_or_else(|e| panic!("{what}: {e}"));
        looked += 1;
        if wanted(sum) {
            return looked;
        }
    }
}

fn killed() {
    let mut run: Child = Command::new(this_program()).arg("run").spawn().unwrap();
    // The checksums need a display that is on.
    std::thread::sleep(Duration::from_secs(2));
    let told = checksums();
    let black = checksum(&vec![0; pixels(Encoding::Rgb8, 0).len()]);
    wait_for(&told, "light", |sum| sum != black);
    run.kill().unwrap();
    run.wait().unwrap();
    let frames = wait_for(&told, "black after SIGKILL", |sum| sum == black);
    println!("  black {frames} frames after SIGKILL");
    // It stays so while the guardian holds the display, and another run takes it over.
    let (display, _clock) = open(Encoding::Rgb8);
    drop(display);
}
