//! The server's thread: takes connections, and lets none of them cost more than it may.

use crate::calibration::Guide;
use crate::connections::{Connection, Connections};
use crate::guard::Guard;
use crate::pictures::PictureThread;
use crate::rigs::Rigs;
use crate::routes;
use crate::shared::RunView;
use crate::site::{Door, Serves, Site};
use crate::stream::WatchedSocket;
use crate::token::Token;
use dpm_common::realtime::os::give_way;
use dpm_rig::control::orders::Orders;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_rig::telemetry::notes::Notes;
use hyper::rt::{Sleep, Timer};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{mpsc, Arc};
use std::task::{Context, Poll};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;

/// A client that has not sent the head of its request by then is disconnected.
const HEAD_WITHIN: Duration = Duration::from_secs(5);
/// Longest head of a request, bytes. (The library takes no less.)
const HEAD_BYTES: usize = 8192;
/// Most header lines of a request.
const HEAD_LINES: usize = 48;
/// Connections taken before others are served, and the rest that follows: at most a thousand a second.
const AT_ONCE: u32 = 8;
const REST: Duration = Duration::from_millis(8);
/// How often connections that stand still are looked for.
const SWEEP: Duration = Duration::from_secs(1);
/// How long the end of the page waits for its threads.
const END_WITHIN: Duration = Duration::from_millis(500);

/// What the page is, besides the run.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Where to listen; an address of this machine.
    pub address: SocketAddr,
    /// Names under which a proxy with TLS serves the page.
    pub hosts: Vec<String>,
    /// What orders must know; `None`: there are no orders.
    pub token: Option<Token>,
    /// The steps of the rig's calibration.
    pub guide: Arc<dyn Guide>,
}

impl Settings {
    /// The checks of requests, once the address that is listened on is known.
    fn guard(&self) -> impl FnOnce(SocketAddr) -> Guard {
        let (hosts, token) = (self.hosts.clone(), self.token.clone());
        move |address| Guard::new(address, &hosts, token)
    }
}

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// The address is not one of this machine alone.
    #[error("{0} can be reached from other machines, and the page has no encryption of its own; listen on 127.0.0.1")]
    NotLoopback(SocketAddr),
    /// The address cannot be listened on.
    #[error(
        "cannot listen on {address}: {source}; choose another port with page.listen, --page or --listen"
    )]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Why not.
        source: io::Error,
    },
    /// A thread cannot be started.
    #[error("cannot start a thread for the page: {0}")]
    Thread(io::Error),
}

/// The live page; it ends when this is dropped.
#[derive(Debug)]
pub struct Page {
    address: SocketAddr,
    stop: Arc<Notify>,
    over: mpsc::Receiver<()>,
    thread: Option<JoinHandle<()>>,
}

impl Page {
    /// Serves the page of the run that `monitor` watches. Orders go to `orders`; `notes` are those that the operator
    /// was told.
    ///
    /// # Errors
    /// The address can be reached from other machines, or cannot be listened on; no thread.
    pub fn serve(
        settings: Settings,
        monitor: Arc<RunMonitor>,
        orders: Arc<Orders>,
        notes: Arc<Notes>,
    ) -> Result<Self, PageError> {
        let guard = settings.guard();
        Self::start(settings.address, guard, || {
            let pictures = PictureThread::start(monitor.clone()).map_err(PageError::Thread)?;
            Ok(Serves::Run(Arc::new(RunView::new(monitor, orders, notes, pictures)), settings.guide))
        })
    }

    /// Serves the guided page of a calibration, without a run.
    ///
    /// # Errors
    /// As [`Page::serve`].
    pub fn serve_calibration(settings: Settings) -> Result<Self, PageError> {
        let guard = settings.guard();
        Self::start(settings.address, guard, || Ok(Serves::Calibration(settings.guide)))
    }

    /// Serves the overview of several rigs at `address`. It gives no orders, so it has no token.
    ///
    /// # Errors
    /// As [`Page::serve`].
    pub fn serve_rigs(address: SocketAddr, rigs: Rigs) -> Result<Self, PageError> {
        Self::start(address, Guard::of_overview, || Ok(Serves::Rigs(rigs)))
    }

    /// Serves at `wanted`. `guard` makes the checks of requests for the address that is listened on, and `serves` what
    /// is served, when it is known that there can be a page.
    fn start(
        wanted: SocketAddr,
        guard: impl FnOnce(SocketAddr) -> Guard,
        serves: impl FnOnce() -> Result<Serves, PageError>,
    ) -> Result<Self, PageError> {
        if !wanted.ip().is_loopback() {
            return Err(PageError::NotLoopback(wanted));
        }
        let listen = || {
            let listener = std::net::TcpListener::bind(wanted)?;
            listener.set_nonblocking(true)?;
            let address = listener.local_addr()?;
            Ok((listener, address))
        };
        let (listener, address) = listen().map_err(|source| PageError::Listen { address: wanted, source })?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .build()
            .map_err(PageError::Thread)?;
        let site = Arc::new(Site { door: Door::new(guard(address)), serves: serves()? });
        let stop = Arc::new(Notify::new());
        let (ended, over) = mpsc::channel::<()>();
        let thread = std::thread::Builder::new()
            .name("dpm-page".into())
            .spawn({
                let stop = stop.clone();
                move || {
                    // Dropped at the end of the thread, whatever ends it.
                    let _ended = ended;
                    // The stages of the rig come first where there are no real-time rights.
                    give_way(5);
                    runtime.block_on(async {
                        if let Serves::Rigs(rigs) = &site.serves {
                            rigs.follow();
                        }
                        tokio::spawn(take_connections(listener, site));
                        stop.notified().await;
                    });
                    runtime.shutdown_background();
                }
            })
            .map_err(PageError::Thread)?;
        Ok(Self { address, stop, over, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        self.stop.notify_one();
        let ended = self.over.recv_timeout(END_WITHIN) == Err(mpsc::RecvTimeoutError::Disconnected);
        if let Some(thread) = self.thread.take().filter(|_| ended) {
            let _ = thread.join();
        }
    }
}

async fn take_connections(listener: std::net::TcpListener, site: Arc<Site>) {
    let Ok(listener) = TcpListener::from_std(listener) else { return };
    let mut all = Connections::default();
    let mut taken = 0u32;
    loop {
        let next = tokio::time::timeout(SWEEP, listener.accept()).await;
        all.sweep();
        let stream = match next {
            Err(_) => continue,
            Ok(Ok((stream, _))) => stream,
            Ok(Err(_)) => {
                // Out of descriptors, for example.
                all.make_room();
                tokio::time::sleep(REST).await;
                continue;
            }
        };
        if all.make_room() {
            let connection = Connection::new();
            let task = tokio::spawn(serve(stream, connection.clone(), site.clone()));
            all.take(connection, task.abort_handle());
        }
        taken += 1;
        if taken.is_multiple_of(AT_ONCE) {
            tokio::time::sleep(REST).await;
        }
    }
}

async fn serve(stream: TcpStream, connection: Arc<Connection>, site: Arc<Site>) {
    let _ = stream.set_nodelay(true);
    let io = WatchedSocket::new(stream, connection.clone());
    let service = service_fn(|request| routes::answer(request, connection.clone(), site.clone()));
    // An error is the client's: it went away, or sent no HTTP.
    let _ = http1::Builder::new()
        .timer(Clock)
        .header_read_timeout(HEAD_WITHIN)
        .max_buf_size(HEAD_BYTES)
        .max_headers(HEAD_LINES)
        .serve_connection(io, service)
        .await;
}

/// The runtime's clock, for the HTTP library.
#[derive(Clone, Debug)]
struct Clock;

struct SleepLog(Pin<Box<tokio::time::Sleep>>);

impl Future for SleepLog {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        self.0.as_mut().poll(cx)
    }
}

impl Sleep for SleepLog {}

impl Timer for Clock {
    fn sleep(&self, duration: Duration) -> Pin<Box<dyn Sleep>> {
        Box::pin(SleepLog(Box::pin(tokio::time::sleep(duration))))
    }

    fn sleep_until(&self, deadline: Instant) -> Pin<Box<dyn Sleep>> {
        Box::pin(SleepLog(Box::pin(tokio::time::sleep_until(deadline.into()))))
    }
}
