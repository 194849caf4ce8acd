//! A small Wayland compositor that is written from the protocol wp_drm_lease_device_v1: it offers, lends, refuses, vanishes,
//! says nothing or says nonsense. The tests of the client and those in the kernel's machine share it.

use std::io::{IoSlice, Read};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixStream;

use rustix::net::{sendmsg, SendAncillaryBuffer, SendAncillaryMessage, SendFlags};

/// How the compositor behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Manner {
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
pub(crate) enum Request {
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
pub(crate) struct LeaseLog {
    /// The connector that it asked for.
    pub(crate) asked: Option<u32>,
    /// It will ask for nothing else.
    pub(crate) has_released_device: bool,
    /// It has given the lease back.
    pub(crate) has_destroyed_lease: bool,
}

/// A compositor with one client.
pub(crate) struct Compositor {
    /// Its end of the socket.
    pub(crate) stream: UnixStream,
    /// How it behaves.
    pub(crate) manner: Manner,
    /// Names and the kernel's numbers of the connectors that it offers.
    pub(crate) offers: Vec<(&'static str, u32)>,
    /// A descriptor to look at the card with.
    pub(crate) card: OwnedFd,
    /// Lends the first connector.
    pub(crate) lend: Box<dyn FnMut() -> Option<OwnedFd> + Send>,
    /// What the client did.
    pub(crate) seen: LeaseLog,
}

/// The compositor's own numbers begin here.
pub(crate) const FIRST: u32 = 0xff00_0000;
/// Its number of the global.
const GLOBAL: u32 = 7;

/// Sends bytes, a descriptor beside them.
pub(crate) fn send(stream: &UnixStream, bytes: &[u8], descriptor: Option<BorrowedFd<'_>>) {
    let mut space = [MaybeUninit::uninit(); 64];
    let mut beside = SendAncillaryBuffer::new(&mut space);
    let descriptors: Vec<BorrowedFd<'_>> = descriptor.into_iter().collect();
    if !descriptors.is_empty() {
        assert!(beside.push(SendAncillaryMessage::ScmRights(&descriptors)));
    }
    // A client that has gone has judged already.
    let _ = sendmsg(stream.as_fd(), &[IoSlice::new(bytes)], &mut beside, SendFlags::NOSIGNAL);
}

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

    /// Answers until the client goes away.
    pub(crate) fn serve(mut self) -> LeaseLog {
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
        self.event_with(device, 0, &[], Some(&self.card));
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
        let given = if self.manner == Manner::Lends { (self.lend)() } else { None };
        match given {
            Some(given) => self.event_with(lease, 0, &[], Some(&given)),
            None => self.event(lease, 1, &[]),
        }
        false
    }
}
