//! The client against a small X server that knows the requests of RandR which a lease needs, with the kernel's own rules:
//! what is on lease looks like nothing, and cannot be lent again.

use std::io::Read;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use x11rb::protocol::randr;
use x11rb::protocol::xproto;
use x11rb::rust_connection::{DefaultStream, RustConnection};
use x11rb::x11_utils::Serialize;

use super::super::compositor::send;
use super::super::socket::tests::HandedSocket;
use super::{lease_of, BoundedStream, Lease, LeaseRefusal};

/// Its number of the extension's requests.
const RANDR: u8 = 140;
/// Its number of the property's name.
const CONNECTOR_ID: u32 = 99;
const ROOT: u32 = 0x55;
const BAD_MATCH: u8 = 8;
const BAD_ACCESS: u8 = 10;

/// An output of the fake server.
#[derive(Clone, Debug)]
struct FakeOutput {
    name: &'static str,
    connector_id: Option<u32>,
    /// Shows the desktop with this CRTC; 0 if it does not.
    crtc: u32,
    crtcs: Vec<u32>,
    is_leased: bool,
}

/// How the server behaves.
#[derive(Clone, Debug)]
struct Manner {
    has_randr: bool,
    version: (u32, u32),
    /// The driver has no leases.
    cannot_lend: bool,
    /// It answers nothing from this request of RandR on.
    silent_at: Option<u8>,
    /// It goes away at this request of RandR.
    vanishes_at: Option<u8>,
    /// CRTCs on lease, which look free.
    leased_crtcs: Vec<u32>,
    outputs: Vec<FakeOutput>,
}

/// What the client did.
#[derive(Debug, Default, PartialEq, Eq)]
struct ClientLog {
    /// The output and the CRTC of the lease.
    lent: Option<(u32, u32)>,
    /// The lease was given back, and ended with it.
    has_given_back: bool,
}

struct XServer {
    stream: UnixStream,
    manner: Manner,
    given: Option<OwnedFd>,
    lid: u32,
    sequence: u16,
    is_silent: bool,
    seen: ClientLog,
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_ne_bytes(bytes[at..at + 4].try_into().unwrap())
}

impl XServer {
    fn reply(&self, mut bytes: Vec<u8>) {
        bytes.resize(bytes.len().max(32).next_multiple_of(4), 0);
        let length = u32::try_from((bytes.len() - 32) / 4).unwrap();
        bytes[2..4].copy_from_slice(&self.sequence.to_ne_bytes());
        bytes[4..8].copy_from_slice(&length.to_ne_bytes());
        send(&self.stream, &bytes, None);
    }

    fn error(&self, code: u8, minor: u8, value: u32) {
        let mut bytes = [0; 32];
        bytes[1] = code;
        bytes[2..4].copy_from_slice(&self.sequence.to_ne_bytes());
        bytes[4..8].copy_from_slice(&value.to_ne_bytes());
        bytes[8] = minor;
        bytes[10] = RANDR;
        send(&self.stream, &bytes, None);
    }

    /// The greeting: the client's comes first.
    fn greet(&mut self) -> Option<()> {
        let mut head = [0; 12];
        self.stream.read_exact(&mut head).ok()?;
        let lengths = [head[6], head[8]].map(|n| usize::from(n).next_multiple_of(4));
        self.stream.read_exact(&mut vec![0; lengths.iter().sum()]).ok()?;
        let screen = xproto::Screen {
            root: ROOT,
            default_colormap: 0,
            white_pixel: 1,
            black_pixel: 0,
            current_input_masks: xproto::EventMask::NO_EVENT,
            width_in_pixels: 640,
            height_in_pixels: 480,
            width_in_millimeters: 100,
            height_in_millimeters: 100,
            min_installed_maps: 1,
            max_installed_maps: 1,
            root_visual: 0,
            backing_stores: xproto::BackingStore::NOT_USEFUL,
            save_unders: false,
            root_depth: 24,
            allowed_depths: Vec::new(),
        };
        let setup = xproto::Setup {
            status: 1,
            protocol_major_version: 11,
            protocol_minor_version: 0,
            length: 0,
            release_number: 1,
            resource_id_base: 0x20_0000,
            resource_id_mask: 0x1f_ffff,
            motion_buffer_size: 0,
            maximum_request_length: 65535,
            image_byte_order: xproto::ImageOrder::LSB_FIRST,
            bitmap_format_bit_order: xproto::ImageOrder::LSB_FIRST,
            bitmap_format_scanline_unit: 32,
            bitmap_format_scanline_pad: 32,
            min_keycode: 8,
            max_keycode: 255,
            vendor: Vec::new(),
            pixmap_formats: Vec::new(),
            roots: vec![screen],
        };
        let mut bytes = setup.serialize();
        let length = u16::try_from((bytes.len() - 8) / 4).unwrap();
        bytes[6..8].copy_from_slice(&length.to_ne_bytes());
        send(&self.stream, &bytes, None);
        Some(())
    }

    fn serve(mut self) -> ClientLog {
        if self.greet().is_none() {
            return self.seen;
        }
        loop {
            let mut head = [0; 4];
            if self.stream.read_exact(&mut head).is_err() {
                return self.seen;
            }
            let length = usize::from(u16::from_ne_bytes([head[2], head[3]])) * 4;
            let mut request = head.to_vec();
            request.resize(length, 0);
            if self.stream.read_exact(&mut request[4..]).is_err() {
                return self.seen;
            }
            self.sequence = self.sequence.wrapping_add(1);
            self.is_silent |= request[0] == RANDR && Some(request[1]) == self.manner.silent_at;
            match request[0] {
                _ if self.is_silent => {}
                xproto::QUERY_EXTENSION_REQUEST => self.extension(&request),
                xproto::INTERN_ATOM_REQUEST => {
                    let tells = self.manner.outputs.iter().any(|o| o.connector_id.is_some());
                    let atom = if tells { CONNECTOR_ID } else { 0 };
                    self.reply(xproto::InternAtomReply { sequence: 0, length: 0, atom }.serialize().to_vec());
                }
                xproto::GET_INPUT_FOCUS_REQUEST => self.reply(vec![1]),
                RANDR if Some(request[1]) == self.manner.vanishes_at => return self.seen,
                RANDR => self.randr(&request),
                other => panic!("request {other} is not known here"),
            }
        }
    }

    fn extension(&self, request: &[u8]) {
        let present = self.manner.has_randr && request[8..].starts_with(b"RANDR");
        let reply = xproto::QueryExtensionReply {
            sequence: 0,
            length: 0,
            present,
            major_opcode: RANDR,
            first_event: 100,
            first_error: 150,
        };
        self.reply(reply.serialize().to_vec());
    }

    fn randr(&mut self, request: &[u8]) {
        match request[1] {
            randr::QUERY_VERSION_REQUEST => {
                let (major_version, minor_version) = self.manner.version;
                let reply = randr::QueryVersionReply { sequence: 0, length: 0, major_version, minor_version };
                self.reply(reply.serialize().to_vec());
            }
            randr::GET_SCREEN_RESOURCES_CURRENT_REQUEST => {
                let reply = randr::GetScreenResourcesCurrentReply {
                    outputs: (1..).take(self.manner.outputs.len()).collect(),
                    crtcs: vec![11, 12],
                    ..Default::default()
                };
                self.reply(reply.serialize());
            }
            randr::GET_OUTPUT_INFO_REQUEST => self.output_info(word(request, 4)),
            randr::GET_OUTPUT_PROPERTY_REQUEST => {
                let id = self.output(word(request, 4)).connector_id;
                let data = id.map(|id| id.to_ne_bytes().to_vec()).unwrap_or_default();
                let reply = randr::GetOutputPropertyReply {
                    format: if id.is_some() { 32 } else { 0 },
                    type_: u32::from(xproto::AtomEnum::INTEGER),
                    num_items: u32::from(id.is_some()),
                    data,
                    ..Default::default()
                };
                self.reply(reply.serialize());
            }
            randr::GET_CRTC_INFO_REQUEST => {
                let crtc = word(request, 4);
                let is_used = self.manner.outputs.iter().any(|output| output.crtc == crtc);
                let reply = randr::GetCrtcInfoReply {
                    mode: if is_used { 3 } else { 0 },
                    outputs: if is_used { vec![1] } else { Vec::new() },
                    ..Default::default()
                };
                self.reply(reply.serialize());
            }
            randr::CREATE_LEASE_REQUEST => self.create_lease(request),
            randr::FREE_LEASE_REQUEST => {
                self.seen.has_given_back |= word(request, 4) == self.lid && request[8] == 1;
            }
            other => panic!("request {other} of RandR is not known here"),
        }
    }

    fn output(&self, id: u32) -> &FakeOutput {
        &self.manner.outputs[id as usize - 1]
    }

    fn output_info(&self, id: u32) {
        let output = self.output(id);
        let connection =
            if output.is_leased { randr::Connection::DISCONNECTED } else { randr::Connection::CONNECTED };
        let reply = randr::GetOutputInfoReply {
            crtc: output.crtc,
            connection,
            crtcs: if output.is_leased { Vec::new() } else { output.crtcs.clone() },
            name: output.name.into(),
            ..Default::default()
        };
        self.reply(reply.serialize());
    }

    fn create_lease(&mut self, request: &[u8]) {
        assert_eq!(word(request, 4), ROOT);
        let (lid, counts) = (word(request, 8), word(request, 12));
        assert_eq!(counts, 1 | 1 << 16, "one CRTC and one output");
        let (crtc, output) = (word(request, 16), word(request, 20));
        let minor = request[1];
        if self.manner.leased_crtcs.contains(&crtc) {
            return self.error(BAD_ACCESS, minor, crtc);
        }
        let (false, Some(given)) = (self.manner.cannot_lend, self.given.take()) else {
            return self.error(BAD_MATCH, minor, 0);
        };
        (self.lid, self.seen.lent) = (lid, Some((output, crtc)));
        let mut bytes = [0; 32];
        (bytes[0], bytes[1]) = (1, 1);
        bytes[2..4].copy_from_slice(&self.sequence.to_ne_bytes());
        send(&self.stream, &bytes, Some(given.as_fd()));
    }
}

/// A desktop on the first of two outputs; the second is free, and either of two CRTCs can drive it.
fn desktop() -> Manner {
    let output =
        |name, crtc| FakeOutput { name, connector_id: None, crtc, crtcs: vec![11, 12], is_leased: false };
    Manner {
        has_randr: true,
        version: (1, 6),
        cannot_lend: false,
        silent_at: None,
        vanishes_at: None,
        leased_crtcs: Vec::new(),
        outputs: vec![output("eDP-1", 11), output("HDMI-1", 0)],
    }
}

fn start(manner: Manner, given: Option<OwnedFd>) -> (UnixStream, JoinHandle<ClientLog>) {
    let (client, stream) = UnixStream::pair().unwrap();
    let server =
        XServer { stream, manner, given, lid: 0, sequence: 0, is_silent: false, seen: ClientLog::default() };
    (client, std::thread::spawn(move || server.serve()))
}

fn ask(
    stream: UnixStream,
    connector: Option<&str>,
    kernel: &[(u32, String)],
    patience: Duration,
) -> Result<Lease, LeaseRefusal> {
    let (stream, _) = DefaultStream::from_unix_stream(stream).unwrap();
    let stream = BoundedStream::new(stream, Instant::now() + patience);
    let server = RustConnection::connect_to_stream(stream, 0).expect("greeted");
    lease_of(server, 0, connector, kernel, "a fake".into())
}

/// What the server lends of `manner`, with the number of CRTC and output.
fn lent(manner: Manner, connector: Option<&str>, kernel: &[(u32, String)]) -> Option<(u32, u32)> {
    let handed = HandedSocket::new();
    let (stream, thread) = start(manner, Some(handed.given.try_clone().unwrap()));
    let Lease { descriptor, back, .. } =
        ask(stream, connector, kernel, Duration::from_secs(10)).unwrap_or_else(|e| panic!("{e:?}"));
    assert!(handed.is(descriptor), "the server's own descriptor");
    drop(back);
    let seen = thread.join().unwrap();
    assert!(seen.has_given_back);
    seen.lent
}

fn refused(manner: Manner, connector: Option<&str>) -> LeaseRefusal {
    let (stream, thread) = start(manner, None);
    let start = Instant::now();
    let refusal = ask(stream, connector, &[], Duration::from_millis(400)).err().expect("refused");
    assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
    assert_eq!(thread.join().unwrap().lent, None);
    refusal
}

#[test]
fn a_free_output_is_lent_with_a_free_crtc_and_given_back() {
    let named = lent(desktop(), Some("HDMI-A-1"), &[]);
    assert_eq!(named, Some((2, 12)), "HDMI-1, and the CRTC that the desktop does not use");
    assert_eq!(lent(desktop(), None, &[]), Some((2, 12)), "the only one that is free");
    let mut other_crtcs = desktop();
    other_crtcs.outputs[1].crtcs = vec![11, 13, 14];
    other_crtcs.leased_crtcs = vec![13];
    assert_eq!(lent(other_crtcs, Some("HDMI-A-1"), &[]), Some((2, 14)), "13 looks free, and is on lease");
}

#[test]
fn the_kernels_number_finds_an_output_of_any_name() {
    let mut manner = desktop();
    (manner.outputs[0].connector_id, manner.outputs[1].connector_id) = (Some(33), Some(44));
    manner.outputs[1].name = "Projector";
    assert_eq!(lent(manner, Some("HDMI-A-1"), &[(44, "HDMI-A-1".into())]), Some((2, 12)));
}

#[test]
fn every_refusal_says_what_to_do() {
    let told = refused(desktop(), Some("eDP-1"));
    assert!(told.what.contains("xrandr --output eDP-1 --off") && !told.is_lent, "{told:?}");
    let told = refused(desktop(), Some("DP-7"));
    assert!(told.what.contains("(eDP-1, HDMI-1)") && told.what.contains("DP-7"), "{told:?}");
    let mut leased = desktop();
    leased.outputs[1].is_leased = true;
    let told = refused(leased.clone(), Some("HDMI-A-1"));
    assert!(told.what.contains("dpm display guard") && told.is_lent, "{told:?}");
    assert!(refused(leased, None).is_lent, "it looks like an output without a display");
    let busy = Manner { leased_crtcs: vec![12], ..desktop() };
    let told = refused(busy, Some("HDMI-A-1"));
    assert!(told.what.contains("on lease") && told.is_lent, "{told:?}");
    let mut full = desktop();
    full.outputs[1].crtcs = vec![11];
    let told = refused(full, Some("HDMI-A-1"));
    assert!(told.what.contains("no CRTC is free") && told.what.contains("HDMI-1"), "{told:?}");
    let told = refused(Manner { cannot_lend: true, ..desktop() }, Some("HDMI-A-1"));
    assert!(told.what.contains("has no leases") && told.what.contains("bare console"), "{told:?}");
    let told = refused(Manner { version: (1, 5), ..desktop() }, Some("HDMI-A-1"));
    assert!(told.what.contains("RandR 1.5"), "{told:?}");
    let told = refused(Manner { has_randr: false, ..desktop() }, Some("HDMI-A-1"));
    assert!(told.what.contains("no extension RandR"), "{told:?}");
    let mut two = desktop();
    two.outputs[0].crtc = 0;
    assert!(refused(two, None).what.contains("projector.backend.connector"));
}

#[test]
fn a_server_that_vanishes_or_says_nothing_is_told_in_time() {
    let requests = [
        randr::QUERY_VERSION_REQUEST,
        randr::GET_SCREEN_RESOURCES_CURRENT_REQUEST,
        randr::GET_OUTPUT_INFO_REQUEST,
        randr::GET_CRTC_INFO_REQUEST,
        randr::CREATE_LEASE_REQUEST,
    ];
    for request in requests {
        let told = refused(Manner { vanishes_at: Some(request), ..desktop() }, Some("HDMI-A-1"));
        assert!(told.what.contains("went away"), "{request}: {told:?}");
        let told = refused(Manner { silent_at: Some(request), ..desktop() }, Some("HDMI-A-1"));
        assert!(told.what.contains("no answer in time"), "{request}: {told:?}");
    }
}

#[test]
fn a_server_that_is_silent_at_the_end_holds_nobody_up() {
    let handed = HandedSocket::new();
    let manner = Manner { silent_at: Some(randr::FREE_LEASE_REQUEST), ..desktop() };
    let (stream, thread) = start(manner, Some(handed.given.try_clone().unwrap()));
    let lease = ask(stream, Some("HDMI-A-1"), &[], Duration::from_secs(10)).expect("lent");
    let start = Instant::now();
    drop(lease);
    assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
    thread.join().unwrap();
}
