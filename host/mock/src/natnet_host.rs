//! The NatNet server on real sockets: one thread that answers commands and sends each report when it is due.

use crate::natnet_server::{NatNetServer, Streaming};
use dpm_device::time::HostClock;
use dpm_device::tracker::udp::UdpPort;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// A NatNet server that runs until it is dropped.
pub struct NatNetHost {
    stop: Arc<AtomicBool>,
    sent: Arc<AtomicU64>,
    address: SocketAddrV4,
    thread: Option<JoinHandle<io::Result<()>>>,
}

impl NatNetHost {
    /// Maximum number of commands answered between two checks for due frames: a flood of commands must not delay poses.
    const MAX_COMMANDS: usize = 64;

    /// Binds `command` (port 0 for any) exclusively, and starts the server. Multicast leaves through the interface of
    /// that address, which must then be given. `clock` is the clock of the server's sample source.
    pub fn start(
        server: NatNetServer,
        streaming: Streaming,
        command: SocketAddrV4,
        clock: Arc<dyn HostClock>,
    ) -> io::Result<Self> {
        // Not shared: with two servers on one port, the system would pass each command to only one of them.
        let port = UdpPort::bind(command, false)?;
        if let Streaming::Multicast(_) = streaming {
            let interface = if command.ip().is_unspecified() { Ipv4Addr::LOCALHOST } else { *command.ip() };
            port.multicast_from(interface, 1)?;
        }
        let address = port.local()?;
        let stop = Arc::new(AtomicBool::new(false));
        let sent = Arc::new(AtomicU64::new(0));
        let thread = {
            let (stop, sent) = (stop.clone(), sent.clone());
            let run = move || run(server, &port, &*clock, &stop, &sent);
            std::thread::Builder::new().name("natnet-server".into()).spawn(run)?
        };
        Ok(Self { stop, sent, address, thread: Some(thread) })
    }

    /// The command address bound.
    pub fn address(&self) -> SocketAddrV4 {
        self.address
    }

    /// Reports sent so far.
    pub fn frames_sent(&self) -> u64 {
        self.sent.load(Ordering::Relaxed)
    }

    /// True until the thread ends, which happens only on a socket error.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|t| !t.is_finished())
    }
}

/// A UDP port that nobody on this machine uses now: for frames, where the usual one may be taken by a rig.
///
/// # Errors
/// The system has none.
pub fn free_port() -> io::Result<u16> {
    Ok(UdpPort::bind(SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0), false)?.local()?.port())
}

impl Drop for NatNetHost {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // `is_running` shows an error or panic of the thread; nobody is left to inform here.
            let _ = thread.join();
        }
    }
}

fn run(
    mut server: NatNetServer,
    port: &UdpPort,
    clock: &dyn HostClock,
    stop: &AtomicBool,
    sent: &AtomicU64,
) -> io::Result<()> {
    let mut buffer = vec![0; 2048];
    // A failed send (no route, no listener) concerns one receiver and one datagram, as on a real network.
    let mut send = |bytes: &[u8], to: SocketAddrV4| drop(port.send(bytes, to));
    while !stop.load(Ordering::Relaxed) {
        let wait_ns = server.next_due().ns_since(clock.now()).clamp(0, 20_000_000);
        if port.wait(Duration::from_nanos(wait_ns as u64))? {
            for _ in 0..NatNetHost::MAX_COMMANDS {
                let Some(arrival) = port.receive(&mut buffer)? else { break };
                server.on_datagram(&buffer[..arrival.len], arrival.from, clock.now(), &mut send);
            }
        }
        server.stream(clock.now(), &mut send);
        sent.store(server.frames_sent(), Ordering::Relaxed);
    }
    Ok(())
}
