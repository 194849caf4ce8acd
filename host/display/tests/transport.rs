//! The thread of a display at real pace: unplugged and plugged in again, refused, and ended.

mod common;

use std::sync::Arc;
use std::time::{Duration, Instant};

use common::{link_settings, planes, settings, shared, with};
use dpm_device::link::{HostLink, LinkState, SendOutcome};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::{Transport, TransportError};
use dpm_display::encoding::Encoding;
use dpm_display::fake::{FakeKms, Shared};
use dpm_display::kms::{Kms, KmsError};
use dpm_display::transport::{DisplayTransport, Opener};
use dpm_handoff::wake::WaitPolicy;

const PATIENCE: Duration = Duration::from_secs(20);

fn open(shared: &Shared) -> (Result<DisplayTransport, TransportError>, Arc<dyn HostClock>) {
    let start = Instant::now();
    let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(start.elapsed().as_nanos() as i64));
    let (state, on) = (shared.clone(), clock.clone());
    let opener: Opener =
        Arc::new(move || Ok(Box::new(FakeKms::new(state.clone(), on.clone())) as Box<dyn Kms>));
    let mut opened = DisplayTransport::open(opener, settings(Encoding::Rgb8), WaitPolicy::Park, 0);
    if let Ok(display) = &mut opened {
        display.set_clock(clock.clone());
    }
    (opened, clock)
}

/// Polls, arms, and sends a frame for every slot, until `done`.
fn run(
    link: &mut HostLink,
    display: &mut DisplayTransport,
    clock: &dyn HostClock,
    mut done: impl FnMut(&HostLink) -> bool,
) {
    let limit = Instant::now() + PATIENCE;
    let mut next = 0;
    while !done(link) {
        assert!(Instant::now() < limit, "still {:?}, {:?}", link.state(), display.counts().map(|c| c.lost()));
        match link.poll(clock.now(), display) {
            Ok(LinkState::Ready) => link.arm(0),
            Ok(LinkState::Faulted) => link.arm(u32::MAX),
            Ok(LinkState::Streaming) => {
                // The slot is taken from what the display told last.
                let slots = link.slots().unwrap();
                let slot = link.status().and_then(|s| slots.slot_at(s.now)).map_or(0, |slot| slot + 3);
                if slot > next {
                    next = slot;
                    let (target, dark_from) = (slots.start(slot), slots.dark_from(slot, 1_000_000_000));
                    let sent = link.send_frame(clock.now(), slot, target, dark_from, &planes(slot), display);
                    assert!(!matches!(sent, SendOutcome::Sent) || target < dark_from);
                }
            }
            Ok(LinkState::Lost | LinkState::Closed) | Err(_) if link.state() == LinkState::Closed => {
                link.connect()
            }
            _ => {}
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn lit(link: &HostLink) -> u32 {
    link.status().map_or(0, |s| s.frames_lit)
}

#[test]
fn an_unplugged_display_is_taken_up_again_and_every_way_out_is_black() {
    let shared = shared();
    let (display, clock) = open(&shared);
    let mut display = display.unwrap();
    assert!(with(&shared, |s| s.is_black), "starts dark");
    let mut link = HostLink::new(link_settings());
    link.connect();
    run(&mut link, &mut display, clock.as_ref(), |link| lit(link) >= 20);
    assert!(!with(&shared, |s| s.is_black));

    with(&shared, |s| s.is_plugged = false);
    run(&mut link, &mut display, clock.as_ref(), |link| link.state() == LinkState::Lost);
    assert!(with(&shared, |s| s.is_black), "pulled: dark");
    // It stays lost while nothing is there.
    let until = Instant::now() + Duration::from_millis(400);
    run(&mut link, &mut display, clock.as_ref(), |link| {
        assert_eq!(link.state(), LinkState::Lost);
        Instant::now() > until
    });
    with(&shared, |s| s.is_plugged = true);
    run(&mut link, &mut display, clock.as_ref(), |link| {
        link.state() == LinkState::Streaming && lit(link) >= 10
    });
    assert_eq!(with(&shared, |s| (s.starts, s.torn)), (2, 0));
    assert!(!with(&shared, |s| s.is_black));
    drop(display);
    assert!(with(&shared, |s| s.is_black), "ended: dark");
}

#[test]
fn what_cannot_be_opened_is_told_with_its_reason() {
    let state = shared();
    with(&state, |s| s.refuses = true);
    let told = open(&state).0.err().expect("refused").to_string();
    assert!(told.contains("display HDMI-A-1") && told.contains("set the mode"), "{told}");
    with(&state, |s| (s.refuses, s.is_plugged) = (false, false));
    let told = open(&state).0.err().expect("nothing there").to_string();
    assert!(told.contains("no display answers there"), "{told}");
    let opener: Opener = Arc::new(|| Err(KmsError::InUse("/dev/dri/card0".into())));
    let told = DisplayTransport::open(opener, settings(Encoding::Rgb8), WaitPolicy::Park, 0);
    assert!(told.err().expect("in use").to_string().contains("bare console"));
}

/// A display that runs at another rate than its mode says is named, not called unplugged.
#[test]
fn a_rate_that_is_not_the_modes_is_told() {
    let state = shared();
    with(&state, |s| s.ppm = 60_000);
    let (display, clock) = open(&state);
    let mut display = display.unwrap();
    let limit = Instant::now() + PATIENCE;
    let error = loop {
        match display.receive(clock.now(), &mut |_, _, _| {}) {
            Err(e) => break e,
            Ok(()) => assert!(Instant::now() < limit),
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    assert!(error.to_string().contains("variable refresh"), "{error}");
}
