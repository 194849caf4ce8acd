//! The client against a small compositor that offers, lends, refuses, vanishes, says nothing or says nonsense.

use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::super::compositor::{Compositor, LeaseLog, Manner, Request, FIRST};
use super::super::socket::tests::HandedSocket;
use super::{lease_over, socket_of, Lease, LeaseRefusal};

const OFFERS: [(&str, u32); 2] = [("DP-1", 33), ("HDMI-A-1", 44)];

/// A compositor on a thread of its own, and the client's end of its socket.
fn compositor(
    manner: Manner,
    offers: &[(&'static str, u32)],
    given: Option<OwnedFd>,
) -> (UnixStream, JoinHandle<LeaseLog>) {
    let (client, stream) = UnixStream::pair().unwrap();
    // The card is none: what connectors are called, only the compositor can say then.
    let card = std::fs::File::open("/dev/null").unwrap().into();
    let (mut given, offers, seen) = (given, offers.to_vec(), LeaseLog::default());
    let compositor = Compositor { stream, manner, offers, card, lend: Box::new(move || given.take()), seen };
    (client, std::thread::spawn(move || compositor.serve()))
}

fn ask(stream: UnixStream, connector: Option<&str>, patience: Duration) -> Result<Lease, LeaseRefusal> {
    lease_over(stream, connector, "a fake".into(), Instant::now() + patience)
}

fn refused(manner: Manner, offers: &[(&'static str, u32)], connector: Option<&str>) -> LeaseRefusal {
    let (stream, thread) = compositor(manner, offers, None);
    let start = Instant::now();
    let refusal = ask(stream, connector, Duration::from_millis(400)).err().expect("refused");
    assert!(start.elapsed() < Duration::from_secs(5), "{manner:?}: {:?}", start.elapsed());
    thread.join().unwrap();
    refusal
}

#[test]
fn the_connector_that_is_named_is_lent_and_given_back() {
    let handed = HandedSocket::new();
    let (stream, thread) = compositor(Manner::Lends, &OFFERS, Some(handed.given.try_clone().unwrap()));
    let lease = ask(stream, Some("HDMI-A-1"), Duration::from_secs(10)).expect("lent");
    assert!(!thread.is_finished(), "the connection stays as long as the lease does");
    let Lease { descriptor, back, lender } = lease;
    assert!(handed.is(descriptor), "the compositor's own descriptor");
    assert_eq!(lender, "a fake");
    drop(back);
    let seen = thread.join().unwrap();
    let expected = LeaseLog { asked: Some(FIRST + 1), has_released_device: true, has_destroyed_lease: true };
    assert_eq!(seen, expected);
}

#[test]
fn the_only_connector_needs_no_name_and_several_do() {
    let handed = HandedSocket::new();
    let (stream, thread) = compositor(Manner::Lends, &OFFERS[..1], Some(handed.given.try_clone().unwrap()));
    drop(ask(stream, None, Duration::from_secs(10)).expect("lent"));
    assert_eq!(thread.join().unwrap().asked, Some(FIRST));
    let told = refused(Manner::Lends, &OFFERS, None);
    assert!(
        told.what.contains("DP-1, HDMI-A-1") && told.what.contains("projector.backend.connector"),
        "{told:?}"
    );
    assert!(!told.is_lent);
}

#[test]
fn every_refusal_says_what_to_do() {
    let told = refused(Manner::Plain, &OFFERS, Some("DP-1"));
    assert!(told.what.contains("wp_drm_lease_device_v1") && told.what.contains("bare console"), "{told:?}");
    let told = refused(Manner::Lends, &[], Some("DP-1"));
    assert!(told.what.contains("offers no connector") && told.is_lent, "{told:?}");
    let told = refused(Manner::Withdraws, &OFFERS, Some("DP-1"));
    assert!(told.what.contains("offers no connector"), "{told:?}");
    let told = refused(Manner::Lends, &OFFERS, Some("DP-9"));
    assert!(told.what.contains("does not offer DP-9, but DP-1, HDMI-A-1") && told.is_lent, "{told:?}");
    let told = refused(Manner::Refuses, &OFFERS, Some("DP-1"));
    assert!(told.what.contains("refused DP-1") && told.is_lent, "{told:?}");
}

#[test]
fn a_compositor_that_vanishes_or_talks_nonsense_is_told_at_once() {
    for request in [Request::List, Request::Bind, Request::Submit] {
        let told = refused(Manner::VanishesAt(request), &OFFERS, Some("DP-1"));
        assert!(told.what.contains("went away"), "{request:?}: {told:?}");
    }
    let told = refused(Manner::Nonsense, &OFFERS, Some("DP-1"));
    assert!(told.what.contains("does not keep to the protocol"), "{told:?}");
}

#[test]
fn a_compositor_that_says_nothing_is_given_up_in_time() {
    for request in [Request::List, Request::Bind, Request::Submit] {
        let told = refused(Manner::SilentAt(request), &OFFERS, Some("DP-1"));
        assert!(told.what.contains("does not answer in time"), "{request:?}: {told:?}");
    }
}

#[test]
fn the_environment_says_where_the_compositor_listens() {
    let at = |display: Option<&str>, folder: Option<&str>| {
        socket_of(display.map(Into::into), folder.map(Into::into)).map(|path| path.display().to_string())
    };
    assert_eq!(at(Some("wayland-3"), Some("/run/user/7")), Ok("/run/user/7/wayland-3".into()));
    assert_eq!(at(None, Some("/run/user/7")), Ok("/run/user/7/wayland-0".into()));
    assert_eq!(at(Some("/tmp/there"), None), Ok("/tmp/there".into()));
    assert!(at(Some("wayland-3"), None).unwrap_err().what.contains("XDG_RUNTIME_DIR"));
}
