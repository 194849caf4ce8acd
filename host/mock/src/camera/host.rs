//! The mock camera on a real socket: one thread that paints each picture and sends it when it is due.

use super::{Exposure, MockCamera, MockCameraConfig};
use crate::monotonic;
use dpm_device::picture_stream::PictureHeader;
use dpm_device::time::HostClock;
use std::io::{self, ErrorKind, Write};
use std::net::{SocketAddr, SocketAddrV4, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// What makes the pictures that a [`CameraHost`] sends.
pub trait PictureMaker: Send {
    /// Raster, rate, exposure and faults.
    fn config(&self) -> &MockCameraConfig;

    /// Picture `number`; `None` if it is lost on the way.
    fn exposure(&self, number: u64) -> Option<Exposure>;

    /// Makes a picture, rows from above. It may wait by the clock until the exposure is over.
    fn make(&mut self, exposure: &Exposure, clock: &dyn HostClock, pixels: &mut Vec<u8>);
}

impl PictureMaker for MockCamera {
    fn config(&self) -> &MockCameraConfig {
        self.config()
    }

    fn exposure(&self, number: u64) -> Option<Exposure> {
        self.exposure(number)
    }

    /// The mock knows what it will see, and paints ahead of the exposure.
    fn make(&mut self, exposure: &Exposure, _: &dyn HostClock, pixels: &mut Vec<u8>) {
        self.paint(exposure, pixels);
    }
}

/// A camera that sends its pictures until it is dropped ([`dpm_device::picture_stream`]).
pub struct CameraHost {
    stop: Arc<AtomicBool>,
    address: SocketAddr,
    thread: Option<JoinHandle<io::Result<()>>>,
}

impl CameraHost {
    /// Maximum number of clients at a time; further ones are rejected.
    pub const MAX_CLIENTS: usize = 4;
    /// A client that takes no bytes for this long is dropped.
    const PATIENCE: Duration = Duration::from_millis(500);

    /// Listens on `address` (port 0 for any). Instant 0 of `clock` is time 0 of motions and faults.
    ///
    /// # Errors
    /// The system refuses the socket or the thread.
    pub fn start(
        camera: impl PictureMaker + 'static,
        address: SocketAddrV4,
        clock: Arc<dyn HostClock>,
    ) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        let bound = listener.local_addr()?;
        let stop = Arc::new(AtomicBool::new(false));
        let over = stop.clone();
        let work = move || serve(camera, &listener, &*clock, &over);
        let thread = std::thread::Builder::new().name("camera-server".into()).spawn(work)?;
        Ok(Self { stop, address: bound, thread: Some(thread) })
    }

    /// The address bound.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// True until the thread ends, which happens only on a socket error.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|t| !t.is_finished())
    }
}

impl Drop for CameraHost {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // `is_running` shows an error or panic of the thread; nobody is left to inform here.
            let _ = thread.join();
        }
    }
}

fn serve(
    mut camera: impl PictureMaker,
    listener: &TcpListener,
    clock: &dyn HostClock,
    over: &AtomicBool,
) -> io::Result<()> {
    let epoch_ns = monotonic::now_ns() - clock.now().0;
    let mut clients: Vec<TcpStream> = Vec::new();
    let (mut next, mut pixels) = (0u64, Vec::new());
    while !over.load(Ordering::Relaxed) {
        accept(listener, &mut clients)?;
        // A machine that cannot paint in time leaves pictures out, as a camera does whose cable is too slow.
        let now = clock.now().0.max(0);
        let number = next.max(camera.config().rate.slot_at_ns(now));
        next = number + 1;
        let Some(exposure) = camera.exposure(number) else {
            rest_until(clock, camera.config().rate.slot_start_ns(next), over);
            continue;
        };
        let c = camera.config();
        let header = PictureHeader {
            width: c.optics.size[0],
            height: c.optics.size[1],
            number: number as u32,
            begin_ns: epoch_ns + exposure.begin_ns,
            exposure_ns: c.exposure_ns,
            row_ns: c.row_ns,
        };
        if clients.is_empty() {
            rest_until(clock, exposure.arrives_ns, over);
            continue;
        }
        camera.make(&exposure, clock, &mut pixels);
        rest_until(clock, exposure.arrives_ns, over);
        clients.retain_mut(|client| {
            client.write_all(&header.encode()).and_then(|()| client.write_all(&pixels)).is_ok()
        });
    }
    Ok(())
}

fn accept(listener: &TcpListener, clients: &mut Vec<TcpStream>) -> io::Result<()> {
    loop {
        match listener.accept() {
            Ok((client, _)) if clients.len() < CameraHost::MAX_CLIENTS => {
                client.set_nonblocking(false)?;
                client.set_nodelay(true)?;
                client.set_write_timeout(Some(CameraHost::PATIENCE))?;
                clients.push(client);
            }
            Ok(_) => {}
            Err(e) if e.kind() == ErrorKind::WouldBlock => return Ok(()),
            Err(e) if e.kind() == ErrorKind::Interrupted || e.kind() == ErrorKind::ConnectionAborted => {}
            Err(e) => return Err(e),
        }
    }
}

/// Sleeps until an instant of the clock, or until the server is stopped.
fn rest_until(clock: &dyn HostClock, at_ns: i64, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let left = at_ns - clock.now().0;
        if left <= 0 {
            return;
        }
        std::thread::sleep(Duration::from_nanos(left.min(20_000_000) as u64));
    }
}
