//! A window on a real X server (Xvfb): what its pixels are, when they are told, what is refused, and what happens when the
//! window is closed or the server ends.
//!
//! Without Xvfb these tests fail. `./x test --all` installs it, and leaves them out by name where it cannot be had.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::common::{link_settings, lit, pixels, raster, run, PATIENCE};
use dpm_device::link::{HostLink, LinkState, Verb};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{FrameRate, HostClock, HostTime};
use dpm_device::transport::{Transport, TransportError};
use dpm_display::encoding::Encoding;
use dpm_display::lease::{self, Access, Lender};
use dpm_display::transport::DisplayTransport;
use dpm_display::window::{opener, WindowSettings};
use dpm_handoff::wake::WaitPolicy;
use x11rb::connection::Connection as _;
use x11rb::protocol::randr::{ConnectionExt as _, Rotation};
use x11rb::protocol::xproto::{ClientMessageEvent, ConnectionExt as _, EventMask, ImageFormat, Window};
use x11rb::rust_connection::RustConnection;

/// The screen of the server, and the name that it gives to its only monitor.
const SCREEN: (u32, u32) = (320, 240);
const MONITOR: &str = "screen";

/// An X server without a screen that anybody sees.
struct Server {
    child: Child,
    name: String,
}

impl Server {
    fn start() -> Self {
        let screen = format!("{}x{}x24", SCREEN.0, SCREEN.1);
        let mut child = Command::new("Xvfb")
            .args(["-displayfd", "1", "-noreset", "-nolisten", "tcp", "-screen", "0", &screen])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("this test needs an X server without a screen (Debian: apt-get install xvfb)");
        let mut number = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut number).expect("Xvfb tells its number");
        Self { child, name: format!(":{}", number.trim()) }
    }

    fn look(&self) -> Looker {
        let (server, screen) = RustConnection::connect(Some(&self.name)).expect("a second client");
        let root = server.setup().roots[screen].root;
        Looker { server, root }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Another client of the server, which looks at the window.
struct Looker {
    server: RustConnection,
    root: Window,
}

impl Looker {
    fn window(&self) -> Option<Window> {
        let all = self.server.query_tree(self.root).unwrap().reply().unwrap().children;
        assert!(all.len() <= 1, "one window at a time");
        all.first().copied()
    }

    /// The pixels of the window, blue, green, red and an unused byte, which is made 0.
    fn pixels(&self) -> Vec<u8> {
        let window = self.window().expect("the window is there");
        let (width, height) = (raster().width() as u16, raster().height() as u16);
        let image = self.server.get_image(ImageFormat::Z_PIXMAP, window, 0, 0, width, height, u32::MAX);
        let mut bytes = image.unwrap().reply().unwrap().data;
        bytes.chunks_exact_mut(4).for_each(|pixel| pixel[3] = 0);
        bytes
    }

    /// Asks the window to close, as a desktop's button does.
    fn close(&self) {
        let window = self.window().expect("the window is there");
        let atom = |name: &[u8]| self.server.intern_atom(false, name).unwrap().reply().unwrap().atom;
        let event = ClientMessageEvent::new(
            32,
            window,
            atom(b"WM_PROTOCOLS"),
            [atom(b"WM_DELETE_WINDOW"), 0, 0, 0, 0],
        );
        self.server.send_event(false, window, EventMask::NO_EVENT, event).unwrap();
        self.server.flush().unwrap();
    }
}

fn settings(server: &Server) -> WindowSettings {
    WindowSettings {
        server: Some(server.name.clone()),
        monitor: None,
        // Xvfb counts a blank from half a frame before it on.
        commit_ns: 12_000_000,
        raster: raster(),
        schedule: PlaneSchedule::rgb24(),
        rate: FrameRate::new(60, 1).unwrap(),
    }
}

/// A window, the clock of its run, and how often it was closed.
fn open(server: &Server) -> (DisplayTransport, Arc<dyn HostClock>, Arc<AtomicU32>) {
    let start = Instant::now();
    let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(start.elapsed().as_nanos() as i64));
    let closed = Arc::new(AtomicU32::new(0));
    let counted = closed.clone();
    let opener = opener(settings(server), move || {
        counted.fetch_add(1, Ordering::SeqCst);
    });
    let mut window = DisplayTransport::open(opener, WaitPolicy::Park, 0).expect("a window");
    window.set_clock(clock.clone());
    (window, clock, closed)
}

fn connected() -> HostLink {
    let mut link =
        HostLink::new(dpm_device::link::LinkSettings { watchdog_us: 5_000_000, ..link_settings() });
    link.connect();
    link
}

#[test]
fn every_picture_of_a_window_is_a_frame_that_was_sent() {
    let server = Server::start();
    let looker = server.look();
    let (mut window, clock, _) = open(&server);
    assert!(looker.pixels().iter().all(|byte| *byte == 0), "starts dark");
    let mut link = connected();
    let (mut seen, mut newest) = (BTreeSet::new(), 0);
    run(&mut link, &mut window, clock.as_ref(), |link| {
        let now = looker.pixels();
        if now.iter().any(|byte| *byte != 0) {
            // Frames are numbered by their slots, and those of the last second are enough to find it.
            let last = link.status().map_or(0, |s| u64::from(s.last_whole_frame));
            let from = newest.max(last.saturating_sub(60));
            newest = (from..last + 5)
                .find(|id| pixels(*id, Encoding::Rgb8) == now)
                .expect("whole frames in their order");
            seen.insert(newest);
        }
        seen.len() >= 40
    });
    link.command(clock.now(), Verb::Black, &mut window).expect("the window is there");
    let limit = Instant::now() + PATIENCE;
    while looker.pixels().iter().any(|byte| *byte != 0) {
        assert!(Instant::now() < limit, "still lit after BLACK");
        link.poll(clock.now(), &mut window).expect("the window stays");
        std::thread::sleep(Duration::from_millis(1));
    }
    drop(window);
    // The server may answer others before it sees that a program has gone.
    while looker.window().is_some() {
        assert!(Instant::now() < limit, "the window goes with its run");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// The slots of the link are the server's frames: as many in two seconds as the server shows.
#[test]
fn light_is_told_when_the_server_shows_it() {
    let server = Server::start();
    let (mut window, clock, _) = open(&server);
    let mut link = connected();
    run(&mut link, &mut window, clock.as_ref(), |link| lit(link) >= 10);
    let slots = |link: &HostLink| link.status().map_or(0, |s| s.slots);
    let (first, since) = (slots(&link), clock.now());
    run(&mut link, &mut window, clock.as_ref(), |_| clock.now().ns_since(since) >= 2_000_000_000);
    let rate = f64::from(slots(&link) - first) * 1e9 / clock.now().ns_since(since) as f64;
    assert!((rate - 60.0).abs() < 1.5, "{rate} slots/s");
    let counts = window.counts().expect("it runs");
    let (taken, missed) = (counts.taken.load(Ordering::SeqCst), counts.missed.load(Ordering::SeqCst));
    assert!(taken > 100 && missed < taken / 4, "{taken} pictures taken, {missed} blanks late");
}

#[test]
fn a_window_that_is_closed_stays_closed() {
    let server = Server::start();
    let looker = server.look();
    let (mut window, clock, closed) = open(&server);
    let mut link = connected();
    run(&mut link, &mut window, clock.as_ref(), |link| lit(link) >= 5);
    looker.close();
    run(&mut link, &mut window, clock.as_ref(), |link| link.state() == LinkState::Lost);
    let until = Instant::now() + Duration::from_millis(500);
    run(&mut link, &mut window, clock.as_ref(), |_| Instant::now() > until);
    assert_eq!(closed.load(Ordering::SeqCst), 1, "the run is told once");
    assert_eq!(looker.window(), None, "no window opens by itself");
}

#[test]
fn a_server_that_ends_is_told_as_unplugged() {
    let mut server = Server::start();
    let (mut window, clock, closed) = open(&server);
    let mut link = connected();
    run(&mut link, &mut window, clock.as_ref(), |link| lit(link) >= 5);
    server.child.kill().unwrap();
    let since = Instant::now();
    run(&mut link, &mut window, clock.as_ref(), |link| link.state() == LinkState::Lost);
    assert!(since.elapsed() < Duration::from_secs(3));
    drop(window);
    assert_eq!(closed.load(Ordering::SeqCst), 0);
}

#[test]
fn what_does_not_fit_the_desk_is_refused_by_name() {
    let server = Server::start();
    let why = |change: &dyn Fn(&mut WindowSettings)| {
        let mut settings = settings(&server);
        change(&mut settings);
        let opened = DisplayTransport::open(opener(settings, || ()), WaitPolicy::Park, 0);
        opened.err().expect("refused").to_string()
    };
    let told = why(&|s| s.server = Some(":4711".into()));
    assert!(told.contains("\":4711\"") && told.contains("Xwayland"), "{told}");
    let told = why(&|s| s.monitor = Some("HDMI-7".into()));
    assert!(told.contains(&format!("{MONITOR:?} 320 x 240")), "{told}");
    let told = why(&|s| s.monitor = Some(MONITOR.into()));
    assert!(told.contains("projector.width = 70"), "{told}");
    let told = why(&|s| s.commit_ns = 16_000_000);
    assert!(told.contains("write 14999 at most"), "{told}");

    // A rate that the server does not show is found by its stamps.
    let (width, height) = SCREEN;
    let whole = WindowSettings {
        monitor: Some(MONITOR.into()),
        raster: Raster::new(width, height).unwrap(),
        rate: FrameRate::new(50, 1).unwrap(),
        ..settings(&server)
    };
    let mut window =
        DisplayTransport::open(opener(whole, || ()), WaitPolicy::Park, 0).expect("the monitor's size");
    let start = Instant::now();
    let error: TransportError = loop {
        let now = HostTime(start.elapsed().as_nanos() as i64);
        match window.receive(now, &mut |_, _, _| {}) {
            Err(e) => break e,
            Ok(()) => assert!(start.elapsed() < PATIENCE),
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    assert!(error.to_string().contains("says 50.000"), "{error}");
}

/// Xvfb speaks RandR 1.6, and has one output, which its desktop uses, and no leases.
#[test]
fn a_server_without_leases_lends_nothing_and_says_so() {
    let server = Server::start();
    let why = |display: &str, connector: &str| {
        std::env::set_var("DISPLAY", display);
        let open = lease::opener(None, Some(connector.into()), Access::Lent(Lender::X11));
        let told = open().err().expect("refused").to_string();
        println!("  {told}");
        told
    };
    let told = why(&server.name, MONITOR);
    assert!(told.contains(&format!("{:?}", server.name)), "{told}");
    assert!(told.contains("xrandr --output screen --off"), "{told}");
    assert!(why(&server.name, "HDMI-A-1").contains("outputs (screen)"));
    assert!(why(&format!("{}.7", server.name), MONITOR).contains("no screen 7"));
    assert!(why(":4711", MONITOR).contains("does not answer"));
    assert!(why("somewhere:0", MONITOR).contains("another machine"));
    assert!(why("nonsense", MONITOR).contains("DISPLAY"));
    let desk = server.look();
    let resources = desk.server.randr_get_screen_resources_current(desk.root).unwrap().reply().unwrap();
    let off = desk.server.randr_set_crtc_config(resources.crtcs[0], 0, 0, 0, 0, 0, Rotation::ROTATE0, &[]);
    off.unwrap().reply().expect("the desktop leaves its output");
    let told = why(&server.name, MONITOR);
    assert!(told.contains("has no leases") && told.contains("Match"), "{told}");
    std::env::remove_var("DISPLAY");
}
