//! The client end of USB/IP as a cable: drives a device of a USB/IP server without a kernel.

use crossbeam::channel::{unbounded, RecvTimeoutError};
use std::collections::BTreeMap;
use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::server::Link;
use super::wire::{read_import_reply, read_list_reply, DeviceRecord, Operation, Urb, URB_HEADER};
use crate::usb_model::{Setup, Speed};
use crate::usb_plug::{Completion, Request, Status, UsbCable};

/// Longest wait for a standard request.
const PATIENCE: Duration = Duration::from_secs(5);

/// The devices that a server offers.
pub fn list(server: impl ToSocketAddrs) -> io::Result<Vec<DeviceRecord>> {
    let mut stream = TcpStream::connect(server)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.write_all(&Operation::List.encode())?;
    read_list_reply(&mut stream)
}

/// An imported device. Dropping the last handle detaches it.
pub struct RemoteCable {
    shared: Arc<ClientState>,
    record: DeviceRecord,
    descriptors: Vec<u8>,
}

struct ClientState {
    state: Mutex<State>,
    devid: u32,
}

struct State {
    out: TcpStream,
    next: u32,
    pending: BTreeMap<u32, Request>,
    gone: bool,
    signalled: bool,
    listeners: Vec<Box<dyn FnOnce() + Send>>,
}

impl RemoteCable {
    /// Imports `bus_id` from `server` and reads its descriptors.
    pub fn import(server: impl ToSocketAddrs, bus_id: &str) -> io::Result<Self> {
        let mut stream = TcpStream::connect(server)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.write_all(&Operation::Import(bus_id.to_owned()).encode())?;
        let record = read_import_reply(&mut stream)?;
        stream.set_read_timeout(None)?;
        let state = State {
            out: stream.try_clone()?,
            next: 1,
            pending: BTreeMap::new(),
            gone: false,
            signalled: false,
            listeners: Vec::new(),
        };
        let shared =
            Arc::new(ClientState { state: Mutex::new(state), devid: record.bus << 16 | record.device });
        let reader = shared.clone();
        std::thread::Builder::new().name("usbip-read".into()).spawn(move || reader.read(stream))?;
        let mut this = Self { shared, record, descriptors: Vec::new() };
        let mut descriptors = this.descriptor(1, 18)?;
        let head = this.descriptor(2, 9)?;
        let total = head.get(2..4).map_or(9, |b| u16::from_le_bytes([b[0], b[1]]));
        descriptors.extend(this.descriptor(2, total)?);
        this.descriptors = descriptors;
        Ok(this)
    }

    fn descriptor(&self, kind: u8, length: u16) -> io::Result<Vec<u8>> {
        let setup = Setup { request_type: 0x80, request: 6, value: u16::from(kind) << 8, index: 0, length };
        self.control(setup)
    }

    /// A control transfer without OUT data; blocks until it completes.
    pub fn control(&self, setup: Setup) -> io::Result<Vec<u8>> {
        let (tx, rx) = unbounded();
        let done = Box::new(move |c: Completion| drop(tx.send((c.status, c.buffer, c.actual))));
        // The identifiers of our own requests are beyond those that a front end uses.
        let request = Request {
            id: u64::MAX,
            endpoint: 0,
            setup: Some(setup),
            buffer: vec![0; usize::from(setup.length)],
            done,
        };
        self.submit(request).map_err(|_| io::Error::from(io::ErrorKind::NotConnected))?;
        match rx.recv_timeout(PATIENCE) {
            Ok((Status::Ok, mut buffer, actual)) => {
                buffer.truncate(actual);
                Ok(buffer)
            }
            Ok((status, ..)) => Err(io::Error::other(format!("control request ended with {status:?}"))),
            Err(RecvTimeoutError::Timeout) => Err(io::ErrorKind::TimedOut.into()),
            Err(RecvTimeoutError::Disconnected) => Err(io::ErrorKind::NotConnected.into()),
        }
    }

    /// The server's record of the device.
    pub fn record(&self) -> &DeviceRecord {
        &self.record
    }
}

impl Drop for RemoteCable {
    fn drop(&mut self) {
        self.shared.lock().out.cut();
    }
}

impl ClientState {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn end(request: Request, status: Status, actual: usize) {
        (request.done)(Completion { id: request.id, status, actual, buffer: request.buffer });
    }

    /// The reader's loop: completes transfers until the connection ends.
    fn read(&self, mut stream: TcpStream) {
        while self.message(&mut stream).is_ok() {}
        stream.cut();
        let mut s = self.lock();
        s.gone = true;
        let left = std::mem::take(&mut s.pending);
        drop(s);
        left.into_values().for_each(|r| Self::end(r, Status::Gone, 0));
        let mut s = self.lock();
        s.signalled = true;
        let listeners = std::mem::take(&mut s.listeners);
        drop(s);
        listeners.into_iter().for_each(|f| f());
    }

    fn message(&self, stream: &mut TcpStream) -> io::Result<()> {
        let mut header = [0; URB_HEADER];
        stream.read_exact(&mut header)?;
        match Urb::decode(&header)? {
            Urb::Submitted { seqnum, status, actual } => {
                let unknown = || {
                    io::Error::new(
                        io::ErrorKind::InvalidData,
                        format!("an answer to {seqnum}, which was not asked"),
                    )
                };
                let mut request = self.lock().pending.remove(&seqnum).ok_or_else(unknown)?;
                let is_in = request.setup.map_or(request.endpoint & 0x80 != 0, |s| s.is_in());
                let actual = actual as usize;
                if is_in {
                    let room = request.buffer.get_mut(..actual).ok_or_else(unknown)?;
                    stream.read_exact(room)?;
                }
                let status = match status {
                    0 => Status::Ok,
                    -32 => Status::Stall,
                    -75 => Status::Babble,
                    -104 => Status::Cancelled,
                    -108 => Status::Gone,
                    _ => Status::BusError,
                };
                Self::end(request, status, actual);
            }
            Urb::Unlinked { seqnum, status } => {
                // The unlink's number identifies its victim: see `cancel`.
                let victim = self.lock().pending.remove(&(seqnum & !UNLINK));
                if let Some(request) = victim {
                    let status = if status == 0 { Status::Ok } else { Status::Cancelled };
                    Self::end(request, status, 0);
                }
            }
            other => {
                return Err(io::Error::new(io::ErrorKind::InvalidData, format!("{other:?} from a device")))
            }
        }
        Ok(())
    }
}

/// Set in the number of an unlink, whose other bits are its victim's.
const UNLINK: u32 = 0x8000_0000;

impl UsbCable for RemoteCable {
    fn descriptors(&self) -> Vec<u8> {
        self.descriptors.clone()
    }

    fn speed(&self) -> Speed {
        match self.record.speed {
            5.. => Speed::Super,
            3 | 4 => Speed::High,
            _ => Speed::Full,
        }
    }

    fn submit(&self, request: Request) -> Result<(), Request> {
        let mut s = self.shared.lock();
        if s.gone {
            return Err(request);
        }
        let seqnum = s.next;
        s.next = (s.next + 1) & !UNLINK;
        let is_in = request.setup.map_or(request.endpoint & 0x80 != 0, |p| p.is_in());
        let header = Urb::Submit {
            seqnum,
            devid: self.shared.devid,
            endpoint: request.endpoint,
            is_in,
            flags: 0,
            length: request.buffer.len() as u32,
            packets: u32::MAX,
            interval: 0,
            setup: request.setup.unwrap_or(Setup::from_bytes([0; 8])),
        };
        let data = if is_in { &[][..] } else { &request.buffer[..] };
        let message = [&header.encode()[..], data].concat();
        s.pending.insert(seqnum, request);
        if s.out.write_all(&message).is_err() {
            // The reader ends every transfer, this one included.
            s.out.cut();
        }
        Ok(())
    }

    fn cancel(&self, id: u64) -> bool {
        let mut s = self.shared.lock();
        let Some(victim) = s.pending.iter().find(|(_, r)| r.id == id).map(|(n, _)| *n) else { return false };
        let unlink = Urb::Unlink { seqnum: victim | UNLINK, devid: self.shared.devid, victim };
        if s.out.write_all(&unlink.encode()).is_err() {
            s.out.cut();
        }
        true
    }

    fn clear_halt(&self, endpoint: u8) {
        let setup = Setup { request_type: 0x02, request: 1, value: 0, index: endpoint.into(), length: 0 };
        // A refusal means that there is no such endpoint or device: the next transfer reports it.
        let _ = self.control(setup);
    }

    fn reset(&self, configuration: u8) {
        // USB/IP has no message for a reset; selecting the configuration again ends every halt.
        self.set_configuration(configuration);
    }

    fn set_configuration(&self, value: u8) {
        let setup = Setup { request_type: 0x00, request: 9, value: value.into(), index: 0, length: 0 };
        let _ = self.control(setup);
    }

    fn on_unplug(&self, f: Box<dyn FnOnce() + Send>) {
        let mut s = self.shared.lock();
        if s.signalled {
            drop(s);
            f();
        } else {
            s.listeners.push(f);
        }
    }

    fn unplug(&self) {
        self.shared.lock().out.cut();
    }
}
