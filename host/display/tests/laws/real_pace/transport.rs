//! The thread of a display at real pace: unplugged and plugged in again, refused, and ended.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::common::{link_settings, lit, run, settings, shared, with, PATIENCE};
use dpm_device::link::{HostLink, LinkState};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::transport::{Transport, TransportError};
use dpm_display::encoding::Encoding;
use dpm_display::fake::{FakeKms, Shared};
use dpm_display::kms::Kms;
use dpm_display::scan_out::DisplayError;
use dpm_display::transport::{on_card, DisplayTransport};
use dpm_handoff::wake::WaitPolicy;

fn open(shared: &Shared) -> (Result<DisplayTransport, TransportError>, Arc<dyn HostClock>) {
    let start = Instant::now();
    let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(start.elapsed().as_nanos() as i64));
    let (state, on) = (shared.clone(), clock.clone());
    let card = move || Ok(Box::new(FakeKms::new(state.clone(), on.clone())) as Box<dyn Kms>);
    let mut opened = DisplayTransport::open(on_card(card, settings(Encoding::Rgb8)), WaitPolicy::Park, 0);
    if let Ok(display) = &mut opened {
        display.set_clock(clock.clone());
    }
    (opened, clock)
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
    let opener = on_card(|| Err(DisplayError::InUse("/dev/dri/card0".into())), settings(Encoding::Rgb8));
    let told = DisplayTransport::open(opener, WaitPolicy::Park, 0);
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
