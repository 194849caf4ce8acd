//! The client against a small compositor that is written from the protocol: it offers, lends, refuses, vanishes, says nothing
//! or says nonsense.

use std::io::Read;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::super::tests::{send, Handed};
use super::{lease_over, socket_of, Lease, Refusal};

/// How the compositor behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Manner {
    Lends,
    Refuses,
    /// It goes away instead of an answer to this request.
    VanishesAt(Request),
    /// It answers everything but this request.
    SilentAt(Request),
    /// It answers the request for a list with bytes of no protocol.
    Nonsense,
    /// It withdraws what it has offered before it has listed everything.
    Withdraws,
    /// It has no such protocol.
    Plain,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Request {
    List,
    Bind,
    Submit,
}

/// The objects of a client, by their numbers.
#[derive(Default)]
struct Objects {
    registry: u32,
    device: u32,
    request: u32,
    lease: u32,
}

/// What the client did after its lease.
#[derive(Debug, Default, PartialEq, Eq)]
struct Seen {
    /// The connector that it asked for.
    asked: Option<u32>,
    has_released_device: bool,
    has_destroyed_lease: bool,
}

struct Compositor {
    stream: UnixStream,
    manner: Manner,
    offers: Vec<(&'static str, u32)>,
    given: Option<OwnedFd>,
    seen: Seen,
}

/// The compositor's own numbers begin here.
const FIRST: u32 = 0xff00_0000;
/// Its number of the global.
const GLOBAL: u32 = 7;

fn string(text: &str) -> Vec<u8> {
    let mut bytes = u32::try_from(text.len() + 1).unwrap().to_ne_bytes().to_vec();
    bytes.extend(text.as_bytes());
    bytes.push(0);
    bytes.resize(bytes.len().next_multiple_of(4), 0);
    bytes
}

fn number(n: u32) -> Vec<u8> {
    n.to_ne_bytes().to_vec()
}

impl Compositor {
    fn event(&self, object: u32, opcode: u32, arguments: &[u8]) {
        self.event_with(object, opcode, arguments, None);
    }

    fn event_with(&self, object: u32, opcode: u32, arguments: &[u8], descriptor: Option<&OwnedFd>) {
        let size = u32::try_from(8 + arguments.len()).unwrap();
        let mut bytes = number(object);
        bytes.extend(number(size << 16 | opcode));
        bytes.extend(arguments);
        send(&self.stream, &bytes, descriptor.map(AsFd::as_fd));
    }

    /// Reads one request: object, opcode and arguments. `None` when the client has gone.
    fn read(&mut self) -> Option<(u32, u32, Vec<u32>)> {
        let mut head = [0; 8];
        self.stream.read_exact(&mut head).ok()?;
        let word = |bytes: &[u8]| u32::from_ne_bytes(bytes.try_into().unwrap());
        let (object, word_2) = (word(&head[..4]), word(&head[4..]));
        let mut rest = vec![0; (word_2 >> 16) as usize - 8];
        self.stream.read_exact(&mut rest).ok()?;
        Some((object, word_2 & 0xffff, rest.chunks_exact(4).map(word).collect()))
    }

    fn serve(mut self) -> Seen {
        let mut objects = Objects::default();
        while let Some((object, opcode, arguments)) = self.read() {
            let last = arguments.last().copied().unwrap_or(0);
            let is_gone = match (object, opcode) {
                (1, 1) => {
                    objects.registry = last;
                    false
                }
                (1, 0) => self.list(objects.registry, last),
                (o, 0) if o == objects.registry => {
                    objects.device = last;
                    self.offer(last)
                }
                (o, 0) if o == objects.device => {
                    objects.request = last;
                    false
                }
                (o, 1) if o == objects.device => {
                    self.seen.has_released_device = true;
                    false
                }
                (o, 0) if o == objects.request => {
                    self.seen.asked = Some(last);
                    false
                }
                (o, 1) if o == objects.request => {
                    objects.lease = last;
                    self.answer(last)
                }
                (o, 0) if o == objects.lease => {
                    self.seen.has_destroyed_lease = true;
                    false
                }
                _ => false,
            };
            if is_gone {
                break;
            }
        }
        self.seen
    }

    /// True if the compositor goes away now; `None` if it says nothing.
    fn mood(&self, request: Request) -> Option<bool> {
        match self.manner {
            Manner::VanishesAt(at) if at == request => Some(true),
            Manner::SilentAt(at) if at == request => None,
            _ => Some(false),
        }
    }

    fn list(&self, registry: u32, callback: u32) -> bool {
        match self.mood(Request::List) {
            Some(false) => {}
            other => return other.unwrap_or(false),
        }
        if self.manner == Manner::Nonsense {
            send(&self.stream, &[0xff; 64], None);
            return false;
        }
        let mut globals = vec![("wl_output", 3)];
        if self.manner != Manner::Plain {
            globals.push(("wp_drm_lease_device_v1", GLOBAL));
        }
        for (interface, name) in globals {
            let mut arguments = number(name);
            arguments.extend(string(interface));
            arguments.extend(number(1));
            self.event(registry, 0, &arguments);
        }
        self.event(callback, 0, &number(0));
        false
    }

    fn offer(&self, device: u32) -> bool {
        // A descriptor that is no card: what connectors are called, only the compositor can say then.
        let card: OwnedFd = std::fs::File::open("/dev/null").unwrap().into();
        self.event_with(device, 0, &[], Some(&card));
        for (place, (name, id)) in (0..).zip(&self.offers) {
            let connector = FIRST + place;
            self.event(device, 1, &number(connector));
            self.event(connector, 0, &string(name));
            self.event(connector, 1, &string("a display"));
            self.event(connector, 2, &number(*id));
            self.event(connector, 3, &[]);
        }
        match self.mood(Request::Bind) {
            Some(false) => {}
            other => return other.unwrap_or(false),
        }
        if self.manner == Manner::Withdraws {
            (0..).zip(&self.offers).for_each(|(place, _)| self.event(FIRST + place, 4, &[]));
        }
        self.event(device, 2, &[]);
        false
    }

    fn answer(&mut self, lease: u32) -> bool {
        match self.mood(Request::Submit) {
            Some(false) => {}
            other => return other.unwrap_or(false),
        }
        match (self.manner, self.given.take()) {
            (Manner::Lends, Some(given)) => self.event_with(lease, 0, &[], Some(&given)),
            _ => self.event(lease, 1, &[]),
        }
        false
    }
}

const OFFERS: [(&str, u32); 2] = [("DP-1", 33), ("HDMI-A-1", 44)];

/// A compositor on a thread of its own, and the client's end of its socket.
fn compositor(
    manner: Manner,
    offers: &[(&'static str, u32)],
    given: Option<OwnedFd>,
) -> (UnixStream, JoinHandle<Seen>) {
    let (client, server) = UnixStream::pair().unwrap();
    let compositor =
        Compositor { stream: server, manner, offers: offers.to_vec(), given, seen: Seen::default() };
    (client, std::thread::spawn(move || compositor.serve()))
}

fn ask(stream: UnixStream, connector: Option<&str>, patience: Duration) -> Result<Lease, Refusal> {
    lease_over(stream, connector, "a fake".into(), Instant::now() + patience)
}

fn refused(manner: Manner, offers: &[(&'static str, u32)], connector: Option<&str>) -> Refusal {
    let (stream, thread) = compositor(manner, offers, None);
    let start = Instant::now();
    let refusal = ask(stream, connector, Duration::from_millis(400)).err().expect("refused");
    assert!(start.elapsed() < Duration::from_secs(5), "{manner:?}: {:?}", start.elapsed());
    thread.join().unwrap();
    refusal
}

#[test]
fn the_connector_that_is_named_is_lent_and_given_back() {
    let handed = Handed::new();
    let (stream, thread) = compositor(Manner::Lends, &OFFERS, Some(handed.given.try_clone().unwrap()));
    let lease = ask(stream, Some("HDMI-A-1"), Duration::from_secs(10)).expect("lent");
    assert!(!thread.is_finished(), "the connection stays as long as the lease does");
    let Lease { descriptor, back, lender } = lease;
    assert!(handed.is(descriptor), "the compositor's own descriptor");
    assert_eq!(lender, "a fake");
    drop(back);
    let seen = thread.join().unwrap();
    let expected = Seen { asked: Some(FIRST + 1), has_released_device: true, has_destroyed_lease: true };
    assert_eq!(seen, expected);
}

#[test]
fn the_only_connector_needs_no_name_and_several_do() {
    let handed = Handed::new();
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
