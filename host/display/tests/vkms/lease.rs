//! The kernel's display on lease: a small desktop drives the card and lends its connector by the protocol of Wayland, and the
//! lease is the kernel's own. What the desktop takes back is dark and told, and is asked for again.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixListener;
use std::path::PathBuf;
use std::process::{Child, Command};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::Transport;
use dpm_display::card::{cards, let_go, Card, CardDescriptor};
use dpm_display::encoding::Encoding;
use dpm_display::lease::{opener, Access, Lender};
use dpm_display::scan_out::DisplayError;
use dpm_display::transport::{on_card, set_guardian, DisplayTransport};
use dpm_handoff::wake::WaitPolicy;
use drm::control::{connector, crtc, plane, Device as ControlDevice, LeaseId, RawResourceHandle};
use drm::{ClientCapability, Device};

use crate::checksum::{checksum, checksums, wait_for};
use crate::compositor::{Compositor, LeaseLog, Manner};
use crate::rig::{pixels, settings, stream, CONNECTOR, PATIENCE};
use crate::ways_out::{this_program, HOLD};

/// A desktop that shows nothing, and lends its only connector.
struct Desktop {
    node: CardDescriptor,
    connector: connector::Handle,
    crtc: crtc::Handle,
    plane: plane::Handle,
    lent: Mutex<Option<LeaseId>>,
    /// Leases so far.
    leases: AtomicUsize,
    /// It takes a lease back when the program that has it goes away, as Wayland compositors do and X servers do not.
    takes_back: AtomicBool,
}

impl Desktop {
    /// Drives the card, and listens where the environment says from now on.
    fn start() -> Arc<Self> {
        let node = CardDescriptor(File::options().read(true).write(true).open(&cards()[0]).unwrap().into());
        // The guardian of an earlier test looks from time to time whether the card is taken.
        until("nobody else drives the card", || node.acquire_master_lock().is_ok());
        node.set_client_capability(ClientCapability::UniversalPlanes, true).unwrap();
        let resources = node.resource_handles().unwrap();
        let is_it = |c: &&connector::Handle| node.get_connector(**c, false).unwrap().to_string() == CONNECTOR;
        let connector = *resources.connectors().iter().find(is_it).unwrap();
        let crtc = resources.crtcs()[0];
        let is_primary = |plane: &&plane::Handle| {
            let all = node.get_properties(**plane).unwrap();
            let (handles, values) = all.as_props_and_values();
            handles.iter().zip(values).any(|(handle, value)| {
                node.get_property(*handle).unwrap().name().to_bytes() == b"type" && *value == 1
            })
        };
        let plane = *node.plane_handles().unwrap().iter().find(is_primary).unwrap();
        let desktop = Arc::new(Self {
            node,
            connector,
            crtc,
            plane,
            lent: Mutex::new(None),
            leases: AtomicUsize::new(0),
            takes_back: AtomicBool::new(true),
        });
        let folder = PathBuf::from("/tmp/vkms-lease");
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).unwrap();
        let listener = UnixListener::bind(folder.join("wayland-7")).unwrap();
        std::env::set_var("XDG_RUNTIME_DIR", folder);
        std::env::set_var("WAYLAND_DISPLAY", "wayland-7");
        let served = desktop.clone();
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let desktop = served.clone();
                std::thread::spawn(move || desktop.serve(stream));
            }
        });
        desktop
    }

    fn serve(self: &Arc<Self>, stream: std::os::unix::net::UnixStream) {
        let desktop = self.clone();
        let compositor = Compositor {
            stream,
            manner: Manner::Lends,
            // By its number, not by this name.
            offers: vec![("Projector", self.connector.into())],
            card: File::options().read(true).write(true).open(&cards()[0]).unwrap().into(),
            lend: Box::new(move || desktop.lend()),
            seen: LeaseLog::default(),
        };
        compositor.serve();
        if self.takes_back.load(Ordering::Relaxed) {
            self.take_back();
        }
    }

    fn lend(&self) -> Option<OwnedFd> {
        let objects: [RawResourceHandle; 3] = [self.connector.into(), self.crtc.into(), self.plane.into()];
        // The kernel refuses what is on lease already.
        let (id, descriptor) = self.node.create_lease(&objects, 0).ok()?;
        self.leases.fetch_add(1, Ordering::Relaxed);
        *self.lent.lock().unwrap() = Some(id);
        Some(descriptor)
    }

    fn take_back(&self) {
        if let Some(id) = self.lent.lock().unwrap().take() {
            let _ = self.node.revoke_lease(id);
        }
    }

    /// A picture is scanned out.
    fn is_shown(&self) -> bool {
        self.node.get_plane(self.plane).unwrap().framebuffer().is_some()
    }

    fn leases(&self) -> usize {
        self.leases.load(Ordering::Relaxed)
    }

    /// Programs that have a lease at this moment, even one that was taken back.
    fn lessees(&self) -> usize {
        self.node.list_lessees().unwrap().len()
    }
}

/// Waits until `is_so`.
fn until(what: &str, is_so: impl Fn() -> bool) {
    let limit = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < limit, "{what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn open(access: Access) -> (DisplayTransport, Arc<dyn HostClock>) {
    let start = Instant::now();
    let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(start.elapsed().as_nanos() as i64));
    let opener = on_card(opener(None, Some(CONNECTOR.into()), access), settings(Encoding::Rgb8));
    let mut display = DisplayTransport::open(opener, WaitPolicy::Park, 0).unwrap_or_else(|e| panic!("{e}"));
    display.set_clock(clock.clone());
    (display, clock)
}

/// A run on a lease that goes on until it is killed.
pub(super) fn run_for_ever() {
    set_guardian(vec![this_program(), "guard".into()]);
    let (mut display, clock) = open(Access::Lent(Lender::Wayland));
    stream(&mut display, clock.as_ref(), Encoding::Rgb8, |_, _| false);
}

/// Every test, with one desktop.
pub(super) fn all() {
    let desktop = Desktop::start();
    assert!(matches!(Card::open(&cards()[0]), Err(DisplayError::InUse(_))), "the desktop drives it");
    shown_taken_back_and_taken_up_again(&desktop);
    killed(&desktop);
    kept_by_the_guardian(&desktop);
    std::env::remove_var("WAYLAND_DISPLAY");
}

fn shown_taken_back_and_taken_up_again(desktop: &Arc<Desktop>) {
    let (mut display, clock) = open(Access::Auto);
    println!("  {}", display.name());
    assert!(display.name().contains("lent by the Wayland compositor"), "{}", display.name());
    let told = checksums();
    let sent = stream(&mut display, clock.as_ref(), Encoding::Rgb8, |sent, _| sent >= 60);
    let known: BTreeMap<u32, u64> =
        sent.iter().map(|(id, _)| (checksum(&pixels(Encoding::Rgb8, *id)), *id)).collect();
    let black = checksum(&vec![0; pixels(Encoding::Rgb8, 0).len()]);
    let mut seen = BTreeSet::new();
    for (blank, sum) in told.try_iter().filter(|(_, sum)| *sum != black) {
        seen.insert(*known.get(&sum).unwrap_or_else(|| panic!("blank {blank}: {sum:08x} was never sent")));
    }
    println!("  {} of {} frames seen by the kernel's checksum", seen.len(), sent.len());
    assert!(seen.len() * 2 >= sent.len(), "most frames were scanned out through the lease");
    drop(told);
    assert_eq!((desktop.leases(), desktop.lessees()), (1, 1));
    desktop.take_back();
    let limit = Instant::now() + PATIENCE;
    let lost = loop {
        if let Err(e) = display.receive(clock.now(), &mut |_, _, _| {}) {
            break e.to_string();
        }
        assert!(Instant::now() < limit, "the loss is told");
        std::thread::sleep(Duration::from_millis(5));
    };
    println!("  {lost}");
    assert!(lost.contains("taken the display back"), "{lost}");
    until("dark without the lease", || !desktop.is_shown());
    // The desktop shows another console. The card must be free when it returns, although nobody drives it now.
    desktop.node.release_master_lock().unwrap();
    let away = Instant::now();
    while away.elapsed() < Duration::from_secs(4) {
        assert!(display.reopen().is_err(), "there is nobody to ask");
        std::thread::sleep(Duration::from_millis(100));
    }
    desktop.node.acquire_master_lock().expect("the card is the desktop's");
    // As the link does, until the display is back.
    let reopen = |display: &mut DisplayTransport| {
        let limit = Instant::now() + PATIENCE;
        while let Err(e) = display.reopen() {
            assert!(Instant::now() < limit, "{e}");
            std::thread::sleep(Duration::from_millis(100));
        }
    };
    reopen(&mut display);
    assert_eq!(desktop.leases(), 2, "it was asked again");
    stream(&mut display, clock.as_ref(), Encoding::Rgb8, |sent, _| sent >= 20);
    assert!(desktop.is_shown());
    // As after unplugging: what is still lent is not asked for again.
    reopen(&mut display);
    assert_eq!(desktop.leases(), 2, "it was kept");
    stream(&mut display, clock.as_ref(), Encoding::Rgb8, |sent, _| sent >= 20);
    drop(display);
    until("given back at the end", || desktop.lessees() == 0);
    assert!(!desktop.is_shown());
}

/// Starts a run on a lease, and waits for its light.
fn run(desktop: &Arc<Desktop>) -> Child {
    let run = Command::new(this_program()).arg("run-on-lease").spawn().unwrap();
    until("the run shows something", || desktop.is_shown());
    // The checksums need a display that is on.
    std::thread::sleep(Duration::from_secs(2));
    run
}

/// A compositor takes the lease of a dead program back: nothing is shown.
fn killed(desktop: &Arc<Desktop>) {
    let mut run = run(desktop);
    run.kill().unwrap();
    run.wait().unwrap();
    until("dark after SIGKILL", || !desktop.is_shown());
    until("the guardian has nothing to keep", || desktop.lessees() == 0);
}

/// An X server leaves it to whoever holds it: the guardian shows black, until the next run asks for the lease.
fn kept_by_the_guardian(desktop: &Arc<Desktop>) {
    desktop.takes_back.store(false, Ordering::Relaxed);
    let mut run = run(desktop);
    let told = checksums();
    let black = checksum(&vec![0; pixels(Encoding::Rgb8, 0).len()]);
    wait_for(&told, "light", |sum| sum != black);
    run.kill().unwrap();
    run.wait().unwrap();
    let frames = wait_for(&told, "black after SIGKILL", |sum| sum == black);
    println!("  black {frames} frames after SIGKILL, on a lease that lives on");
    assert_eq!(desktop.lessees(), 1);
    assert!(desktop.lend().is_none(), "the kernel lends nothing twice");
    drop(told);
    until("the guardian lets go when it is asked", || let_go(Some(CONNECTOR)));
    let asked = Instant::now();
    until("the lease ends with the guardian", || desktop.lessees() == 0);
    assert!(asked.elapsed() < HOLD / 2, "{:?}", asked.elapsed());
    let leases = desktop.leases();
    let (display, _clock) = open(Access::Lent(Lender::Wayland));
    assert_eq!(desktop.leases(), leases + 1);
    drop(display);
    until("given back at the end", || desktop.lessees() == 0);
}
