//! A UDP socket with features that trackers need and the standard library lacks: options before binding, multicast by
//! source, the kernel's arrival stamps, and a filter by source address inside the kernel.
#![allow(unsafe_code)]

use crate::time::HostClock;
use std::io;
use std::mem::{size_of, zeroed};
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::{AsRawFd, FromRawFd, RawFd};
use std::time::Duration;

/// A received datagram; the bytes lie in the caller's buffer.
#[derive(Clone, Copy, Debug)]
pub struct Arrival {
    /// Bytes stored.
    pub len: usize,
    /// Sender.
    pub from: SocketAddrV4,
    /// When the kernel took it in, nanoseconds of `CLOCK_REALTIME`; `None` when the kernel gave no stamp.
    pub kernel_ns: Option<i64>,
    /// True when the datagram was longer than the buffer.
    pub cut: bool,
}

/// What a client needs of a UDP socket. [`UdpPort`] is one of the operating system; a simulator brings its own.
pub trait Datagrams: Send {
    /// Stores the oldest waiting datagram in `buffer`; `None` if none waits. Never blocks.
    ///
    /// # Errors
    /// Those of the operating system.
    fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<Arrival>>;

    /// Sends one datagram.
    ///
    /// # Errors
    /// Those of the operating system.
    fn send(&self, bytes: &[u8], to: SocketAddrV4) -> io::Result<()>;

    /// From now on datagrams of other senders are dropped before they are queued; without `ports` all ports of
    /// `source` may send.
    ///
    /// # Errors
    /// The system has no such filter.
    fn keep_only(&self, source: Ipv4Addr, ports: &[u16]) -> io::Result<()>;

    /// Reverses [`Datagrams::keep_only`].
    ///
    /// # Errors
    /// Those of the operating system.
    fn keep_all(&self) -> io::Result<()>;

    /// The address that the socket is bound to.
    ///
    /// # Errors
    /// Those of the operating system.
    fn local(&self) -> io::Result<SocketAddrV4>;

    /// The descriptor whose readability announces a datagram; `None` if there is none to wait for.
    fn descriptor(&self) -> Option<RawFd> {
        None
    }

    /// What `clock` shows now minus the clock of [`Arrival::kernel_ns`], nanoseconds.
    fn realtime_offset_ns(&self, clock: &dyn HostClock) -> i64 {
        realtime_offset_ns(clock)
    }
}

impl Datagrams for UdpPort {
    fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<Arrival>> {
        Self::receive(self, buffer)
    }

    fn send(&self, bytes: &[u8], to: SocketAddrV4) -> io::Result<()> {
        Self::send(self, bytes, to)
    }

    fn keep_only(&self, source: Ipv4Addr, ports: &[u16]) -> io::Result<()> {
        Self::keep_only(self, source, ports)
    }

    fn keep_all(&self) -> io::Result<()> {
        Self::keep_all(self)
    }

    fn local(&self) -> io::Result<SocketAddrV4> {
        Self::local(self)
    }

    fn descriptor(&self) -> Option<RawFd> {
        Some(self.socket.as_raw_fd())
    }
}

/// Waits until one of the descriptors has something to read or `timeout` is over; true if one has.
///
/// # Errors
/// Those of the operating system.
pub fn wait_for_any(descriptors: [Option<RawFd>; 2], timeout: Duration) -> io::Result<bool> {
    // A negative descriptor is passed over.
    let mut waiting =
        descriptors.map(|fd| libc::pollfd { fd: fd.unwrap_or(-1), events: libc::POLLIN, revents: 0 });
    let limit = libc::timespec {
        tv_sec: timeout.as_secs().min(3600) as libc::time_t,
        tv_nsec: i64::from(timeout.subsec_nanos()),
    };
    // SAFETY: two live pollfds and their count, a live timespec, and no signal mask.
    let n = unsafe { libc::ppoll(waiting.as_mut_ptr(), 2, &limit, std::ptr::null()) };
    match n {
        0.. => Ok(n > 0),
        _ if io::Error::last_os_error().kind() == io::ErrorKind::Interrupted => Ok(false),
        _ => Err(io::Error::last_os_error()),
    }
}

/// A non-blocking IPv4 UDP socket.
pub struct UdpPort {
    socket: UdpSocket,
}

/// Requested receive buffer: a tenth of a second of the largest frames at 500 Hz; the kernel may grant less.
const RECEIVE_BUFFER_BYTES: libc::c_int = 4 << 20;

impl UdpPort {
    /// Binds `local`. `shared` allows other programs on the same address and port, as several clients of one group need.
    pub fn bind(local: SocketAddrV4, shared: bool) -> io::Result<Self> {
        // SAFETY: plain system call; the descriptor, if not negative, is new and owned by nobody else.
        let fd = unsafe {
            libc::socket(libc::AF_INET, libc::SOCK_DGRAM | libc::SOCK_NONBLOCK | libc::SOCK_CLOEXEC, 0)
        };
        if fd < 0 {
            return Err(io::Error::last_os_error());
        }
        // SAFETY: `fd` was just created above and is handed over whole; the socket closes it on every path from here on.
        let port = Self { socket: unsafe { UdpSocket::from_raw_fd(fd) } };
        if shared {
            port.set(libc::SOL_SOCKET, libc::SO_REUSEADDR, &1i32)?;
        }
        // Arrival stamps and a larger buffer are improvements, not requirements.
        let _ = port.set(libc::SOL_SOCKET, libc::SO_TIMESTAMPNS, &1i32);
        let _ = port.set(libc::SOL_SOCKET, libc::SO_RCVBUF, &RECEIVE_BUFFER_BYTES);
        // Only groups joined by this very socket, not those of other programs on this machine.
        let _ = port.set(libc::IPPROTO_IP, libc::IP_MULTICAST_ALL, &0i32);
        let address = raw_address(local);
        // SAFETY: `address` is a whole `sockaddr_in` that lives across the call, and its true size is given.
        let rc = unsafe {
            let pointer = std::ptr::from_ref(&address).cast::<libc::sockaddr>();
            libc::bind(port.socket.as_raw_fd(), pointer, size_of::<libc::sockaddr_in>() as libc::socklen_t)
        };
        if rc < 0 {
            return Err(io::Error::last_os_error());
        }
        Ok(port)
    }

    /// Joins `group` on the interface with address `interface`. With a `source`, only its datagrams are received.
    pub fn join(&self, group: Ipv4Addr, source: Option<Ipv4Addr>, interface: Ipv4Addr) -> io::Result<()> {
        let raw = |a: Ipv4Addr| libc::in_addr { s_addr: u32::from(a).to_be() };
        match source {
            Some(source) => {
                let request = libc::ip_mreq_source {
                    imr_multiaddr: raw(group),
                    imr_interface: raw(interface),
                    imr_sourceaddr: raw(source),
                };
                self.set(libc::IPPROTO_IP, libc::IP_ADD_SOURCE_MEMBERSHIP, &request)
            }
            None => self.socket.join_multicast_v4(&group, &interface),
        }
    }

    /// Sends multicast through the interface with address `interface`, across at most `hops` routers; this machine
    /// receives it too.
    pub fn multicast_from(&self, interface: Ipv4Addr, hops: u8) -> io::Result<()> {
        let raw = libc::in_addr { s_addr: u32::from(interface).to_be() };
        self.set(libc::IPPROTO_IP, libc::IP_MULTICAST_IF, &raw)?;
        self.socket.set_multicast_ttl_v4(u32::from(hops))?;
        self.socket.set_multicast_loop_v4(true)
    }

    /// Waits until a datagram has arrived or `timeout` is over; true if one has arrived.
    pub fn wait(&self, timeout: Duration) -> io::Result<bool> {
        wait_for_any([Some(self.socket.as_raw_fd()), None], timeout)
    }

    /// Lets the kernel drop, before they are queued, all datagrams that are not from `source`, and, if `ports` is not
    /// empty, those that are not from one of these ports. A later call replaces the filter of an earlier one.
    pub fn keep_only(&self, source: Ipv4Addr, ports: &[u16]) -> io::Result<()> {
        // Classic BPF. SKF_NET_OFF (-0x100000) addresses the IP header; the source address is its word at 12. Without an offset, a
        // filter of a UDP socket reads from the UDP header on, whose first half-word is the source port.
        const NET_HEADER: u32 = (-0x10_0000i32) as u32;
        let op = |code, jt, jf, k| libc::sock_filter { code, jt, jf, k };
        let is = (libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K) as u16;
        let end = (libc::BPF_RET | libc::BPF_K) as u16;
        let mut program = vec![
            op((libc::BPF_LD | libc::BPF_W | libc::BPF_ABS) as u16, 0, 0, NET_HEADER + 12),
            op(is, 1, 0, u32::from(source)),
            op(end, 0, 0, 0),
        ];
        if !ports.is_empty() {
            program.push(op((libc::BPF_LD | libc::BPF_H | libc::BPF_ABS) as u16, 0, 0, 0));
            for port in ports {
                program.extend([op(is, 0, 1, u32::from(*port)), op(end, 0, 0, u32::MAX)]);
            }
            program.push(op(end, 0, 0, 0));
        }
        program.push(op(end, 0, 0, u32::MAX));
        let filter = libc::sock_fprog { len: program.len() as u16, filter: program.as_mut_ptr() };
        self.set(libc::SOL_SOCKET, libc::SO_ATTACH_FILTER, &filter)
    }

    /// Removes the filter of [`UdpPort::keep_only`].
    pub fn keep_all(&self) -> io::Result<()> {
        self.set(libc::SOL_SOCKET, libc::SO_DETACH_FILTER, &0i32)
    }

    /// The next waiting datagram, or `None`. Never blocks.
    pub fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<Arrival>> {
        let mut control = [0u64; 8];
        let mut from: libc::sockaddr_in = unset();
        let mut piece = libc::iovec { iov_base: buffer.as_mut_ptr().cast(), iov_len: buffer.len() };
        let mut message: libc::msghdr = unset();
        message.msg_name = std::ptr::from_mut(&mut from).cast();
        message.msg_namelen = size_of::<libc::sockaddr_in>() as libc::socklen_t;
        message.msg_iov = &mut piece;
        message.msg_iovlen = 1;
        message.msg_control = control.as_mut_ptr().cast();
        message.msg_controllen = size_of::<[u64; 8]>() as _;
        // SAFETY: every pointer in `message` refers to a live local or to `buffer`, each with its true length, and the kernel
        // keeps none of them beyond the call.
        let n = unsafe { libc::recvmsg(self.socket.as_raw_fd(), &mut message, libc::MSG_DONTWAIT) };
        if n < 0 {
            let error = io::Error::last_os_error();
            return match error.kind() {
                // ConnectionRefused reports an earlier send that found no listener; the protocol's timeouts handle
                // that.
                io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted | io::ErrorKind::ConnectionRefused => {
                    Ok(None)
                }
                _ => Err(error),
            };
        }
        let address = Ipv4Addr::from(u32::from_be(from.sin_addr.s_addr));
        Ok(Some(Arrival {
            len: n as usize,
            from: SocketAddrV4::new(address, u16::from_be(from.sin_port)),
            kernel_ns: kernel_stamp(&message),
            cut: message.msg_flags & libc::MSG_TRUNC != 0,
        }))
    }

    /// Sends one datagram; a full buffer or an unreachable peer is an error and does not block.
    pub fn send(&self, bytes: &[u8], to: SocketAddrV4) -> io::Result<()> {
        self.socket.send_to(bytes, to).map(drop)
    }

    /// The address bound.
    pub fn local(&self) -> io::Result<SocketAddrV4> {
        match self.socket.local_addr()? {
            std::net::SocketAddr::V4(a) => Ok(a),
            std::net::SocketAddr::V6(_) => Err(io::ErrorKind::Unsupported.into()),
        }
    }

    fn set<T>(&self, level: libc::c_int, name: libc::c_int, value: &T) -> io::Result<()> {
        let size = size_of::<T>() as libc::socklen_t;
        // SAFETY: `value` is a live, initialised plain-data struct of the type that option `name` takes (see the callers), and its
        // true size is given; the kernel copies it before the call returns.
        let rc = unsafe {
            libc::setsockopt(self.socket.as_raw_fd(), level, name, std::ptr::from_ref(value).cast(), size)
        };
        if rc < 0 {
            Err(io::Error::last_os_error())
        } else {
            Ok(())
        }
    }
}

/// `CLOCK_REALTIME` now, nanoseconds: the clock of the kernel's stamps.
pub fn realtime_ns() -> i64 {
    let mut t: libc::timespec = unset();
    // SAFETY: `t` is a live timespec; CLOCK_REALTIME exists on every Linux.
    unsafe { libc::clock_gettime(libc::CLOCK_REALTIME, &mut t) };
    t.tv_sec * 1_000_000_000 + t.tv_nsec
}

/// `clock` minus the clock of the kernel's stamps, nanoseconds, by the tightest of three readings.
pub fn realtime_offset_ns(clock: &dyn HostClock) -> i64 {
    let mut best = (i64::MAX, 0);
    for _ in 0..3 {
        let before = clock.now().0;
        let real = realtime_ns();
        let width = clock.now().0.saturating_sub(before);
        if width < best.0 {
            best = (width, before + width / 2 - real);
        }
        if width < 5_000 {
            break;
        }
    }
    best.1
}

/// A C struct of all zeros.
fn unset<T: Copy>() -> T {
    // SAFETY: used in this file for `sockaddr_in`, `msghdr` and `timespec` only, plain C structs of integers and pointers for which
    // all-zero bytes are a value.
    unsafe { zeroed() }
}

fn raw_address(a: SocketAddrV4) -> libc::sockaddr_in {
    let mut raw: libc::sockaddr_in = unset();
    raw.sin_family = libc::AF_INET as libc::sa_family_t;
    raw.sin_port = a.port().to_be();
    raw.sin_addr.s_addr = u32::from(*a.ip()).to_be();
    raw
}

/// The arrival stamp among the control messages.
fn kernel_stamp(message: &libc::msghdr) -> Option<i64> {
    // SAFETY: the CMSG functions walk inside `msg_control`, whose length the kernel has just set, and return null at its end; a
    // header they return is whole, and SCM_TIMESTAMPNS carries one timespec, read unaligned.
    unsafe {
        let mut header = libc::CMSG_FIRSTHDR(message);
        while !header.is_null() {
            if (*header).cmsg_level == libc::SOL_SOCKET && (*header).cmsg_type == libc::SCM_TIMESTAMPNS {
                let t = std::ptr::read_unaligned(libc::CMSG_DATA(header).cast::<libc::timespec>());
                return Some(t.tv_sec * 1_000_000_000 + t.tv_nsec);
            }
            header = libc::CMSG_NXTHDR(message, header);
        }
    }
    None
}
