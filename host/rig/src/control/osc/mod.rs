//! OSC over UDP: what the tools of artists speak. It takes light away; who gives the rig file's token also changes
//! parameters and holds the light. It never gives ARM, and it has no answer but the rig's notes.
//!
//! UDP knows no users. Who may send is a list of addresses, which a hostile network can forge, and the token can be read
//! on the wire; that is why nothing here can make more light than the operator has permitted.

pub mod decode;

use super::answer::answer_to;
use super::orders::{Orders, Ticket};
use super::parameters;
use crate::order::Order;
use crate::parameters::ParameterCommand;
use crate::standing::By;
use crate::telemetry::monitor::RunMonitor;
use decode::{decode, OscRequest, Said};
use dpm_common::realtime::os::give_way;
use std::io;
use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// How long a wait for a datagram lasts.
const WAIT: Duration = Duration::from_millis(50);
/// The same while an order waits for its answer.
const WAIT_SHORT: Duration = Duration::from_millis(2);
/// Datagrams that are read in a row, and the rest that follows: at most a thousand a second.
const AT_ONCE: u32 = 8;
const REST: Duration = Duration::from_millis(8);
/// Largest datagram that is read whole.
const MAX_DATAGRAM: usize = 8192;
/// Orders that wait for their answers; the light has them already.
const WAITING: usize = 16;
/// Shortest time between two notes about refusals.
const NOTE_EVERY: Duration = Duration::from_secs(1);

/// Listens for OSC until it is dropped.
#[derive(Debug)]
pub struct OscSocket {
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl OscSocket {
    /// Listens at `address` to datagrams from the addresses `from`, or from this machine if there are none. Whoever gives
    /// `token` may do more than make dark; without one nobody may.
    ///
    /// # Errors
    /// The address cannot be listened on, or there is no thread.
    pub fn serve(
        address: SocketAddr,
        from: Vec<IpAddr>,
        token: Option<String>,
        monitor: Arc<RunMonitor>,
        orders: Arc<Orders>,
    ) -> io::Result<Self> {
        let socket = UdpSocket::bind(address)?;
        let address = socket.local_addr()?;
        let stop = Arc::new(AtomicBool::new(false));
        let mut ear = Ear {
            socket,
            door: Doorkeeper { from, token },
            monitor,
            orders,
            waiting: Vec::with_capacity(WAITING),
            refused: Refusals::default(),
        };
        let thread = std::thread::Builder::new().name("dpm-osc".into()).spawn({
            let stop = stop.clone();
            move || {
                // The stages of the rig come first where there are no real-time rights.
                give_way(5);
                while !stop.load(Ordering::Relaxed) {
                    ear.turn();
                }
            }
        })?;
        Ok(Self { address, stop, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for OscSocket {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // It looks within a wait.
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// An order whose answer is due.
struct Waiting {
    order: Order,
    ticket: Ticket,
    since: Instant,
    from: SocketAddr,
}

/// Refusals since the last note about them.
#[derive(Default)]
struct Refusals {
    count: u64,
    last: String,
    told_at: Option<Instant>,
}

/// Who may say what.
#[derive(Debug, Default)]
pub struct Doorkeeper {
    /// Addresses that are heard; empty: those of this machine.
    pub from: Vec<IpAddr>,
    /// Whoever gives it may do more than make dark; without one nobody may.
    pub token: Option<String>,
}

struct Ear {
    socket: UdpSocket,
    door: Doorkeeper,
    monitor: Arc<RunMonitor>,
    orders: Arc<Orders>,
    waiting: Vec<Waiting>,
    refused: Refusals,
}

impl Ear {
    /// Reads a few datagrams, and tells what became of the orders before.
    fn turn(&mut self) {
        let wait = if self.waiting.is_empty() { WAIT } else { WAIT_SHORT };
        let _ = self.socket.set_read_timeout(Some(wait));
        let mut bytes = [0u8; MAX_DATAGRAM];
        let mut read = 0;
        while read < AT_ONCE {
            match self.socket.recv_from(&mut bytes) {
                Ok((n, from)) => self.hear(&bytes[..n], from),
                Err(e) if matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => break,
                // The network is down, for example: a later wait may do better.
                Err(_) => {
                    std::thread::sleep(WAIT);
                    break;
                }
            }
            read += 1;
        }
        self.answer();
        self.refused.tell(&self.monitor);
        if read == AT_ONCE {
            std::thread::sleep(REST);
        }
    }

    fn hear(&mut self, bytes: &[u8], from: SocketAddr) {
        let ip = from.ip().to_canonical();
        for heard in self.door.hear(bytes, ip) {
            let done = match heard {
                Ok(OscRequest::Order(order)) => {
                    self.order(order, from);
                    Ok(())
                }
                Ok(OscRequest::Nothing) => Ok(()),
                Ok(OscRequest::Set { name, numbers }) => {
                    let command = ParameterCommand::Set { name, numbers };
                    let given = parameters::give(&self.monitor, &command, &format!("osc {ip}"));
                    given.map(|_| ()).map_err(|e| format!("{ip}: {e}"))
                }
                Err(why) => Err(why),
            };
            if let Err(why) = done {
                self.refused.add(why);
            }
        }
    }

    fn order(&mut self, order: Order, from: SocketAddr) {
        let ticket = self.orders.give(order, By::Osc { from: from.ip() });
        if self.waiting.len() < WAITING {
            self.waiting.push(Waiting { order, ticket, since: Instant::now(), from });
        }
    }

    fn answer(&mut self) {
        let Self { waiting, monitor, orders, .. } = self;
        waiting.retain(|w| {
            let Some(answer) = answer_to(w.order, w.ticket, w.since.elapsed(), monitor, orders) else {
                return true;
            };
            monitor.note(format!("osc {}: {}: {}", w.from.ip(), w.order.word(), answer.text));
            false
        });
    }
}

impl Doorkeeper {
    /// What is to be done after a datagram from `ip`, and why the rest of it is refused.
    pub fn hear(&self, bytes: &[u8], ip: IpAddr) -> Vec<Result<OscRequest, String>> {
        let may_send = if self.from.is_empty() { ip.is_loopback() } else { self.from.contains(&ip) };
        if !may_send {
            return vec![Err(format!("{ip} is not in osc.from"))];
        }
        let mut all = Vec::new();
        let end = decode(bytes, &mut |one| all.push(one));
        let judged = all.into_iter().chain(end.err().map(Err)).map(|heard| {
            let said = heard.map_err(|wrong| format!("{ip}: {wrong}"))?;
            match (self.permits(&said), said.heard) {
                // The decoder knows no ARM; this holds it whatever becomes of the decoder.
                (_, OscRequest::Order(Order::Arm)) => Err(format!("{ip}: OSC never arms")),
                (permitted, OscRequest::Order(order)) if permitted.is_ok() || order.is_dark() => {
                    Ok(OscRequest::Order(order))
                }
                (_, OscRequest::Nothing) => Ok(OscRequest::Nothing),
                (Ok(()), heard) => Ok(heard),
                (Err(why), _) => Err(format!("{ip}: {why}")),
            }
        });
        judged.collect()
    }

    /// Whether the sender of a message may do more than make dark.
    fn permits(&self, said: &Said) -> Result<(), &'static str> {
        match (&self.token, &said.token) {
            (None, _) => Err("OSC only makes dark, because the rig file has no osc.token"),
            (Some(_), None) => Err("without the token of the rig file (osc.token) OSC only makes dark"),
            (Some(right), Some(told)) if is_same(right, told) => Ok(()),
            (Some(_), Some(_)) => Err("the token is not that of the rig file (osc.token)"),
        }
    }
}

/// True if the texts are equal. The time that this takes does not depend on where they differ.
fn is_same(right: &str, told: &str) -> bool {
    let differs = right.bytes().zip(told.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
    right.len() == told.len() && std::hint::black_box(differs) == 0
}

impl Refusals {
    fn add(&mut self, why: String) {
        self.count += 1;
        self.last = why;
    }

    /// One note a second at most, so that no flood fills the operator's list.
    fn tell(&mut self, monitor: &RunMonitor) {
        if self.count == 0 || self.told_at.is_some_and(|at| at.elapsed() < NOTE_EVERY) {
            return;
        }
        let more = if self.count > 1 { format!(" (and {} more)", self.count - 1) } else { String::new() };
        monitor.note(format!("osc refused: {}{more}", self.last));
        *self = Self { told_at: Some(Instant::now()), ..Self::default() };
    }
}

#[cfg(test)]
mod tests;
