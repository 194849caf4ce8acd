//! Serves USB devices to a kernel's `vhci_hcd` (or any USB/IP client) over a stream.

use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::wire::{import_reply, list_reply, DeviceRecord, Operation, Urb, URB_HEADER};
use crate::usb_model::{endpoints, interfaces};
use crate::usb_plug::{Completion, Request, Status, UsbCable};

const SHORT_NOT_OK: u32 = 1;
const ZERO_PACKET: u32 = 0x40;
const EREMOTEIO: i32 = -121;
const EINVAL: i32 = -22;
/// Set in the identifiers of zero-length packets; identifiers of transfers are a session number and a u32.
const ZERO_PACKET_IDS: u64 = 1 << 63;
static SESSIONS: AtomicU64 = AtomicU64::new(0);

/// An exported device.
#[derive(Clone)]
pub struct Export {
    /// Bus identifier, such as `1-1`.
    pub bus_id: String,
    /// The device.
    pub cable: Arc<dyn UsbCable>,
    /// One client at a time.
    in_use: Arc<AtomicBool>,
}

impl Export {
    /// Exports `cable` as `bus_id`.
    pub fn new(bus_id: impl Into<String>, cable: Arc<dyn UsbCable>) -> Self {
        Self { bus_id: bus_id.into(), cable, in_use: Arc::default() }
    }

    /// True while a client uses it, and briefly after that client is gone.
    pub fn is_in_use(&self) -> bool {
        self.in_use.load(Ordering::Acquire)
    }

    /// Its record for clients.
    pub fn record(&self) -> DeviceRecord {
        let d = self.cable.descriptors();
        let byte = |i: usize| d.get(i).copied().unwrap_or(0);
        let id = |i: usize| u16::from_le_bytes([byte(i), byte(i + 1)]);
        let mut numbers = self.bus_id.split('-').map(|n| n.parse().unwrap_or(1));
        DeviceRecord {
            path: format!("/sys/devices/emulated/{}", self.bus_id),
            bus_id: self.bus_id.clone(),
            bus: numbers.next().unwrap_or(1),
            device: numbers.next().unwrap_or(1),
            speed: self.cable.speed() as u32,
            ids: [id(8), id(10), id(12)],
            bytes: [byte(4), byte(5), byte(6), byte(18 + 5), byte(17), byte(18 + 4)],
        }
    }

    fn interfaces(&self) -> Vec<(u8, u8, u8)> {
        let d = self.cable.descriptors();
        interfaces(&d[18.min(d.len())..])
    }
}

/// A stream that can be cut from another thread.
pub trait Link: Read + Write + Send + Sized + 'static {
    /// Another handle on the same stream.
    fn another(&self) -> io::Result<Self>;
    /// Ends reading and writing for every handle.
    fn cut(&self);
}

impl Link for TcpStream {
    fn another(&self) -> io::Result<Self> {
        self.try_clone()
    }
    fn cut(&self) {
        // The stream may have been cut before.
        let _ = self.shutdown(Shutdown::Both);
    }
}

impl Link for UnixStream {
    fn another(&self) -> io::Result<Self> {
        self.try_clone()
    }
    fn cut(&self) {
        let _ = self.shutdown(Shutdown::Both);
    }
}

/// A listening server. Dropping it stops listening; connections end with their devices.
pub struct Server {
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    exports: Arc<Mutex<Vec<Export>>>,
}

impl Server {
    /// Listens on `address` and serves `exports`, one thread per connection.
    pub fn start(address: impl ToSocketAddrs, exports: Vec<Export>) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        let (address, stop) = (listener.local_addr()?, Arc::new(AtomicBool::new(false)));
        let exports = Arc::new(Mutex::new(exports));
        let (stopped, offered) = (stop.clone(), exports.clone());
        std::thread::Builder::new().name("usbip-listen".into()).spawn(move || {
            for stream in listener.incoming() {
                if stopped.load(Ordering::Acquire) {
                    return;
                }
                let Ok(stream) = stream else { continue };
                let exports = offered.lock().unwrap_or_else(PoisonError::into_inner).clone();
                let connection = std::thread::Builder::new().name("usbip-serve".into()).spawn(move || {
                    // Small messages must not wait for each other; a client that does not read is dropped.
                    let _ = stream.set_nodelay(true);
                    let _ = stream.set_write_timeout(Some(Duration::from_secs(10)));
                    // A client that violates the protocol loses its connection, without effect on others.
                    let _ = serve(stream, &exports);
                });
                if let Err(e) = connection {
                    // Its stream is closed by now; the next client may find a thread.
                    let _ =
                        writeln!(std::io::stderr(), "a USB/IP client is turned away: no thread for it: {e}");
                }
            }
        })?;
        Ok(Self { address, stop, exports })
    }

    /// Exports other devices from now on (after an unplug: the same model on a new plug). Existing connections
    /// continue.
    pub fn set_exports(&self, exports: Vec<Export>) {
        *self.exports.lock().unwrap_or_else(PoisonError::into_inner) = exports;
    }

    /// The address on which it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        // Wakes the listener.
        let _ = TcpStream::connect_timeout(&self.address, Duration::from_millis(200));
    }
}

/// Serves one connection until it ends: a list, or an import followed by URBs.
pub fn serve<L: Link>(mut link: L, exports: &[Export]) -> io::Result<()> {
    match Operation::read(&mut link)? {
        Operation::List => {
            let devices: Vec<_> = exports.iter().map(|e| (e.record(), e.interfaces())).collect();
            link.write_all(&list_reply(&devices))
        }
        Operation::Import(bus_id) => {
            let found = exports.iter().find(|e| e.bus_id == bus_id);
            let free = found.filter(|e| !e.in_use.swap(true, Ordering::AcqRel));
            match free {
                None => link.write_all(&import_reply(None)),
                Some(e) => {
                    let result = link
                        .write_all(&import_reply(Some(&e.record())))
                        .and_then(|()| Session::run(link, e.cable.clone()));
                    e.in_use.store(false, Ordering::Release);
                    result
                }
            }
        }
    }
}

/// Serves URBs of an import that was made elsewhere, until it ends: for a socket that is passed to `vhci_hcd` directly.
pub fn serve_imported<L: Link>(link: L, cable: Arc<dyn UsbCable>) -> io::Result<()> {
    Session::run(link, cable)
}

/// One imported device.
struct Session<L> {
    number: u64,
    state: Mutex<State<L>>,
}

struct State<L> {
    out: L,
    /// Unanswered transfers, with the unlink that requested the cancellation of each.
    pending: BTreeMap<u32, Option<u32>>,
}

impl<L: Link> Session<L> {
    /// Identifier of a transfer on the plug, which outlives the session.
    fn id(&self, seqnum: u32) -> u64 {
        (self.number & 0x3fff_ffff) << 32 | u64::from(seqnum)
    }

    fn lock(&self) -> MutexGuard<'_, State<L>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Serves URBs on `link` until either side closes.
    pub(crate) fn run(mut link: L, cable: Arc<dyn UsbCable>) -> io::Result<()> {
        let state = Mutex::new(State { out: link.another()?, pending: BTreeMap::new() });
        let number = SESSIONS.fetch_add(1, Ordering::Relaxed);
        let session = Arc::new(Self { number, state });
        let on_gone = link.another()?;
        cable.on_unplug(Box::new(move || on_gone.cut()));
        let result = session.serve(&mut link, &cable);
        // The client is gone: its transfers are cancelled.
        let left: Vec<_> = session.lock().pending.keys().copied().collect();
        for seqnum in left {
            cable.cancel(session.id(seqnum));
        }
        link.cut();
        result
    }

    fn serve(self: &Arc<Self>, link: &mut L, cable: &Arc<dyn UsbCable>) -> io::Result<()> {
        let mut header = [0; URB_HEADER];
        loop {
            match link.read_exact(&mut header) {
                Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => return Ok(()),
                other => other?,
            }
            match Urb::decode(&header)? {
                Urb::Submit { seqnum, endpoint, is_in, flags, length, packets, setup, .. } => {
                    let mut buffer = vec![0; length as usize];
                    if !is_in {
                        link.read_exact(&mut buffer)?;
                    }
                    let isochronous = packets != 0 && packets != u32::MAX;
                    let control = endpoint == 0;
                    if control {
                        // The stack may request less or more than the setup packet says; the buffer's length counts.
                        buffer.resize(usize::from(setup.length), 0);
                    }
                    if isochronous || self.lock().pending.insert(seqnum, None).is_some() {
                        self.answer(seqnum, EINVAL, 0, &[])?;
                        continue;
                    }
                    let session = self.clone();
                    let done = Box::new(move |c: Completion| {
                        session.completed(seqnum, c, is_in, flags, length as usize);
                    });
                    let bytes = buffer.len();
                    let setup = control.then_some(setup);
                    let request = Request { id: self.id(seqnum), endpoint, setup, buffer, done };
                    if cable.submit(request).is_err() {
                        return Ok(());
                    }
                    if flags & ZERO_PACKET != 0 && !is_in && !control && bytes > 0 {
                        self.end_by_a_zero_packet(cable, seqnum, endpoint, bytes);
                    }
                }
                Urb::Unlink { seqnum, victim, .. } => {
                    let mut s = self.lock();
                    match s.pending.get_mut(&victim) {
                        Some(asked) => {
                            *asked = Some(seqnum);
                            drop(s);
                            // Its completion, whatever its status, also answers the unlink.
                            cable.cancel(self.id(victim));
                        }
                        None => s.out.write_all(&Urb::Unlinked { seqnum, status: 0 }.encode())?,
                    }
                }
                other => {
                    return Err(io::Error::new(io::ErrorKind::InvalidData, format!("{other:?} from a host")))
                }
            }
        }
    }

    /// Sends a packet of no bytes behind `bytes` that end with a whole packet.
    fn end_by_a_zero_packet(&self, cable: &Arc<dyn UsbCable>, seqnum: u32, endpoint: u8, bytes: usize) {
        let d = cable.descriptors();
        let known = endpoints(&d[18.min(d.len())..]).into_iter().find(|e| e.0 == endpoint);
        let packet = known.map_or(0, |e| usize::from(e.2));
        if packet > 0 && bytes.is_multiple_of(packet) {
            let id = ZERO_PACKET_IDS | self.id(seqnum);
            let zero = Request { id, endpoint, setup: None, buffer: Vec::new(), done: Box::new(|_| ()) };
            // Refused only if the device is gone, which the next read reports.
            let _ = cable.submit(zero);
        }
    }

    fn answer(&self, seqnum: u32, status: i32, actual: u32, data: &[u8]) -> io::Result<()> {
        let mut s = self.lock();
        s.out.write_all(&Urb::Submitted { seqnum, status, actual }.encode())?;
        s.out.write_all(data)
    }

    fn completed(&self, seqnum: u32, c: Completion, is_in: bool, flags: u32, asked: usize) {
        let mut s = self.lock();
        let Some(unlink) = s.pending.remove(&seqnum) else { return };
        let mut result = Ok(());
        if unlink.is_none() || c.status != Status::Cancelled {
            let actual = c.actual.min(asked);
            let short = is_in && flags & SHORT_NOT_OK != 0 && actual < asked;
            let status = if c.status == Status::Ok && short { EREMOTEIO } else { c.status.errno() };
            let header = Urb::Submitted { seqnum, status, actual: actual as u32 }.encode();
            let data = if is_in { &c.buffer[..actual.min(c.buffer.len())] } else { &[] };
            result = s.out.write_all(&[&header[..], data].concat());
        }
        if let Some(seqnum) = unlink {
            let status = if c.status == Status::Cancelled { c.status.errno() } else { 0 };
            result = result.and(s.out.write_all(&Urb::Unlinked { seqnum, status }.encode()));
        }
        if result.is_err() {
            // The client does not read or is gone: the reader ends the session.
            s.out.cut();
        }
    }
}
