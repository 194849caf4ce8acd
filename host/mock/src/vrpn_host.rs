//! The VRPN server on real sockets: one thread that accepts, answers and sends each report when it is due.

use crate::faults::FaultKind;
use crate::vrpn_server::{VrpnConnection, VrpnNames, VrpnReports};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::udp::{realtime_ns, UdpPort};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, SocketAddrV4, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// A VRPN server that runs until it is dropped.
pub struct VrpnHost {
    stop: Arc<AtomicBool>,
    clients: Arc<AtomicUsize>,
    address: SocketAddr,
    thread: Option<JoinHandle<io::Result<()>>>,
}

struct VrpnPeer {
    stream: TcpStream,
    connection: VrpnConnection,
    out: Vec<u8>,
    since: HostTime,
}

impl VrpnHost {
    /// Maximum number of clients at a time; further ones are rejected.
    pub const MAX_CLIENTS: usize = 32;
    /// Maximum number of bytes that wait for a client that does not read; with more it is dropped.
    const MAX_BACKLOG: usize = 256 * 1024;
    /// A connection without a greeting after this time is dropped.
    const GREETING_NS: i64 = 2_000_000_000;

    /// Listens on `address` (port 0 for any), by TCP and by UDP for clients that ask to be called back. `clock` is the clock of
    /// the reports' source; stamps on the wire are wall-clock time.
    pub fn start(
        names: VrpnNames,
        reports: VrpnReports,
        address: SocketAddrV4,
        clock: Arc<dyn HostClock>,
    ) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        let bound = listener.local_addr()?;
        let calls = UdpPort::bind(SocketAddrV4::new(*address.ip(), bound.port()), false)?;
        let stop = Arc::new(AtomicBool::new(false));
        let clients = Arc::new(AtomicUsize::new(0));
        let mut server = Server {
            names,
            reports,
            wall_offset_ns: realtime_ns() - clock.now().0,
            clock,
            clients: Vec::new(),
            last: HostTime(i64::MIN),
        };
        let thread = {
            let (stop, count) = (stop.clone(), clients.clone());
            std::thread::Builder::new().name("vrpn-server".into()).spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    server.turn(&listener, &calls)?;
                    count.store(server.clients.len(), Ordering::Relaxed);
                }
                Ok(())
            })?
        };
        Ok(Self { stop, clients, address: bound, thread: Some(thread) })
    }

    /// The address bound.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Clients connected now.
    pub fn client_count(&self) -> usize {
        self.clients.load(Ordering::Relaxed)
    }

    /// True until the thread ends, which happens only on a socket error.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|t| !t.is_finished())
    }
}

impl Drop for VrpnHost {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // `is_running` shows an error or panic of the thread; nobody is left to inform here.
            let _ = thread.join();
        }
    }
}

struct Server {
    names: VrpnNames,
    reports: VrpnReports,
    clock: Arc<dyn HostClock>,
    /// Wall clock minus host clock, fixed at the start so that stamps keep the source's exact spacing.
    wall_offset_ns: i64,
    clients: Vec<VrpnPeer>,
    last: HostTime,
}

impl Server {
    fn turn(&mut self, listener: &TcpListener, calls: &UdpPort) -> io::Result<()> {
        // Half a millisecond bounds the wait: pings must not wait for the next report.
        let wait_ns = self.reports.next_due().ns_since(self.clock.now()).clamp(0, 500_000);
        calls.wait(Duration::from_nanos(wait_ns as u64))?;
        let now = self.clock.now();
        let start = self.reports.source().config().start;
        let faults = self.reports.source().config().faults.clone();
        let (before, t) = (self.last.ns_since(start), now.ns_since(start));
        self.last = now;
        let away = faults.is_on(FaultKind::Unplug, t);
        if away || faults.starts_within(FaultKind::Reset, before, t) {
            self.clients.clear();
        }
        self.welcome(listener, calls, now, away)?;
        let due = self.reports.take_due(now);
        let offset = self.wall_offset_ns;
        let wall_us_at = move |t: HostTime| t.0.saturating_add(offset).max(0) as u64 / 1000;
        let (names, reports) = (&self.names, &self.reports);
        self.clients.retain_mut(|client| {
            let is_read = read(client, names, wall_us_at(now));
            if !client.connection.is_greeted() {
                return is_read && now.ns_since(client.since) < VrpnHost::GREETING_NS && write(client);
            }
            let whole = due
                .iter()
                .all(|k| reports.put_report(*k, names, &mut client.connection, &wall_us_at, &mut client.out));
            write(client) && is_read && whole
        });
        Ok(())
    }

    fn welcome(
        &mut self,
        listener: &TcpListener,
        calls: &UdpPort,
        now: HostTime,
        away: bool,
    ) -> io::Result<()> {
        // A few at a time: a storm of connections must not delay reports.
        for _ in 0..8 {
            match listener.accept() {
                Ok((stream, _)) if !away => self.add(stream, now),
                Ok(_) => {}
                Err(e) if e.kind() == ErrorKind::WouldBlock => break,
                // The client disconnected before it was accepted; running out of descriptors passes too.
                Err(_) => break,
            }
        }
        let mut buffer = [0; 256];
        // One call back at a time, with a short timeout: an address that does not answer must not delay reports either.
        if let Some(call) = calls.receive(&mut buffer)? {
            // "address port\0": only the port is used, so nobody can direct a call to a third machine.
            let text = String::from_utf8_lossy(&buffer[..call.len]);
            let port =
                text.trim_end_matches('\0').split_whitespace().nth(1).and_then(|p| p.parse::<u16>().ok());
            let Some(port) = port.filter(|_| !away) else { return Ok(()) };
            let address = SocketAddr::from((*call.from.ip(), port));
            if let Ok(stream) = TcpStream::connect_timeout(&address, Duration::from_millis(20)) {
                self.add(stream, now);
            }
        }
        Ok(())
    }

    fn add(&mut self, stream: TcpStream, now: HostTime) {
        let is_ready = stream.set_nonblocking(true).and_then(|()| stream.set_nodelay(true)).is_ok();
        if is_ready && self.clients.len() < VrpnHost::MAX_CLIENTS {
            let mut out = Vec::new();
            let connection = VrpnConnection::new(&self.names, &mut out);
            self.clients.push(VrpnPeer { stream, connection, out, since: now });
        }
    }
}

/// Reads the client's input; false if it is gone or sends invalid data.
fn read(client: &mut VrpnPeer, names: &VrpnNames, wall_us: u64) -> bool {
    let mut buffer = [0; 4096];
    for _ in 0..4 {
        match client.stream.read(&mut buffer) {
            Ok(0) => return false,
            Ok(n) => {
                if client.connection.on_bytes(names, &buffer[..n], wall_us, &mut client.out).is_err() {
                    return false;
                }
            }
            Err(e) => return e.kind() == ErrorKind::WouldBlock || e.kind() == ErrorKind::Interrupted,
        }
    }
    true
}

/// Sends waiting bytes; false if the client is gone or reads too slowly.
fn write(client: &mut VrpnPeer) -> bool {
    while !client.out.is_empty() {
        match client.stream.write(&client.out) {
            Ok(0) => return false,
            Ok(n) => drop(client.out.drain(..n)),
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) => return e.kind() == ErrorKind::WouldBlock && client.out.len() <= VrpnHost::MAX_BACKLOG,
        }
    }
    true
}
