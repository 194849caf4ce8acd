//! The C library's names that libusb calls: what concerns USB is served here, everything else goes straight to the kernel.
#![allow(unsafe_code)]

use std::collections::BTreeMap;
use std::ffi::{c_char, c_int, c_ulong, c_void, CStr, CString};
use std::mem::size_of;
use std::os::unix::ffi::OsStrExt;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use dpm_handoff::path;

use crate::bus::{self, lock};
use crate::file::OpenFile;

/// The system calls themselves, with `errno` as the C library sets it. Calling the C library here would come back to us.
pub(crate) mod raw {
    use std::ffi::{c_char, c_int, c_long, c_ulong, c_void};

    fn as_int(r: c_long) -> c_int {
        r as c_int
    }

    pub(crate) fn open(path: *const c_char, flags: c_int, mode: c_int) -> c_int {
        // SAFETY: the kernel checks the path.
        as_int(unsafe { libc::syscall(libc::SYS_openat, libc::AT_FDCWD, path, flags, mode) })
    }
    pub(crate) fn close(fd: c_int) -> c_int {
        // SAFETY: closing a descriptor touches no memory of ours.
        as_int(unsafe { libc::syscall(libc::SYS_close, fd) })
    }
    pub(crate) fn ioctl(fd: c_int, request: c_ulong, argument: *mut c_void) -> c_int {
        // SAFETY: passed through as the caller gave it.
        as_int(unsafe { libc::syscall(libc::SYS_ioctl, fd, request, argument) })
    }
    pub(crate) fn socket(domain: c_int, kind: c_int, protocol: c_int) -> c_int {
        // SAFETY: plain numbers.
        as_int(unsafe { libc::syscall(libc::SYS_socket, domain, kind, protocol) })
    }
    pub(crate) fn bind(fd: c_int, address: *const libc::sockaddr, length: libc::socklen_t) -> c_int {
        // SAFETY: the kernel checks the address.
        as_int(unsafe { libc::syscall(libc::SYS_bind, fd, address, length) })
    }
    pub(crate) fn recvmsg(fd: c_int, message: *mut libc::msghdr, flags: c_int) -> isize {
        // SAFETY: passed through as the caller gave it.
        unsafe { libc::syscall(libc::SYS_recvmsg, fd, message, flags) as isize }
    }
}

fn fail(errno: c_int) -> c_int {
    // SAFETY: the C library's errno of this thread.
    unsafe { *libc::__errno_location() = errno };
    -1
}

/// One flag per descriptor below this number, so that `close` and `ioctl` on anything else take no lock.
const MOST_FDS: usize = 1 << 16;
static OURS: [AtomicBool; MOST_FDS] = [const { AtomicBool::new(false) }; MOST_FDS];
static FILES: Mutex<BTreeMap<c_int, Arc<OpenFile>>> = Mutex::new(BTreeMap::new());
/// libusb's end of the hot-plug socket and ours.
static EVENTS: Mutex<(c_int, c_int)> = Mutex::new((-1, -1));
static EVENT_FD: AtomicI32 = AtomicI32::new(-1);

fn is_ours(fd: c_int) -> bool {
    usize::try_from(fd).ok().and_then(|i| OURS.get(i)).is_some_and(|f| f.load(Ordering::Acquire))
}

/// Makes `fd` answer as a device file.
pub(crate) fn register(fd: c_int, file: Arc<OpenFile>) {
    lock(&FILES).insert(fd, file);
    if let Some(flag) = usize::try_from(fd).ok().and_then(|i| OURS.get(i)) {
        flag.store(true, Ordering::Release);
    }
}

/// Runs `f` when the process exits in order.
pub(crate) fn at_exit(f: fn()) {
    static AT_EXIT: Mutex<Option<fn()>> = Mutex::new(None);
    extern "C" fn run() {
        if let Some(f) = *lock(&AT_EXIT) {
            f();
        }
    }
    *lock(&AT_EXIT) = Some(f);
    // SAFETY: `run` has the C ABI and touches only the static above.
    unsafe { libc::atexit(run) };
}

/// Delivers a hot-plug event to libusb, if it listens.
pub(crate) fn send_event(message: &[u8]) {
    let ours = lock(&EVENTS).1;
    if ours >= 0 {
        // SAFETY: the message is as long as said; the socket does not block.
        unsafe {
            libc::send(ours, message.as_ptr().cast(), message.len(), libc::MSG_DONTWAIT | libc::MSG_NOSIGNAL)
        };
    }
}

/// Names every function below, so that the linker keeps them in a test binary.
pub(crate) fn keep_linked() {
    let names: [*const (); 31] = [
        fopen as *const (),
        fopen64 as *const (),
        openat as *const (),
        openat64 as *const (),
        __openat_2 as *const (),
        __openat64_2 as *const (),
        stat as *const (),
        stat64 as *const (),
        lstat as *const (),
        lstat64 as *const (),
        __xstat as *const (),
        __xstat64 as *const (),
        __lxstat as *const (),
        __lxstat64 as *const (),
        readlink as *const (),
        readlinkat as *const (),
        scandir as *const (),
        open as *const (),
        open64 as *const (),
        __open_2 as *const (),
        __open64_2 as *const (),
        opendir as *const (),
        ioctl as *const (),
        close as *const (),
        socket as *const (),
        bind as *const (),
        recvmsg as *const (),
        statfs as *const (),
        statfs64 as *const (),
        access as *const (),
        crate::remote::attach_from_environment as *const (),
    ];
    std::hint::black_box(names);
    crate::udev::keep_linked();
}

enum Place {
    Elsewhere,
    Redirected(CString),
    Device(u8, u8),
}

/// What a path means here. Nothing is allocated for paths that do not concern USB.
fn place(path: *const c_char) -> Place {
    if path.is_null() {
        return Place::Elsewhere;
    }
    // SAFETY: a path is a C string.
    let bytes = unsafe { CStr::from_ptr(path) }.to_bytes();
    const PREFIXES: [&[u8]; 3] =
        [b"/dev/bus/usb", b"/sys/bus/usb/devices", b"/sys/module/usbcore/parameters"];
    if !PREFIXES.iter().any(|p| bytes.starts_with(p)) {
        return Place::Elsewhere;
    }
    crate::remote::attach_from_environment();
    if let Some(node) = bytes.strip_prefix(b"/dev/bus/usb/") {
        let numbers = std::str::from_utf8(node).ok().and_then(|s| s.split_once('/'));
        if let Some((Ok(bus), Ok(address))) = numbers.map(|(b, a)| (b.parse(), a.parse())) {
            return Place::Device(bus, address);
        }
    }
    let mut redirected = bus::root().as_os_str().as_bytes().to_vec();
    redirected.extend_from_slice(bytes);
    CString::new(redirected).map_or(Place::Elsewhere, Place::Redirected)
}

fn open_any(path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    match place(path) {
        Place::Elsewhere => raw::open(path, flags, mode),
        Place::Redirected(p) => raw::open(p.as_ptr(), flags, mode),
        Place::Device(bus, address) => {
            let writing = flags & libc::O_ACCMODE != libc::O_RDONLY;
            bus::open_device(bus, address, writing).unwrap_or_else(fail)
        }
    }
}

/// `open(2)`. The third argument of the C function is variadic; on the targets this runs on it arrives like a plain one.
#[no_mangle]
pub(crate) extern "C" fn open(path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    open_any(path, flags, mode)
}

/// `open64(3)`, the same on 64-bit targets.
#[no_mangle]
pub(crate) extern "C" fn open64(path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    open_any(path, flags, mode)
}

/// `open` as fortified programs call it.
#[no_mangle]
pub(crate) extern "C" fn __open_2(path: *const c_char, flags: c_int) -> c_int {
    open_any(path, flags, 0)
}

/// `open64` as fortified programs call it.
#[no_mangle]
pub(crate) extern "C" fn __open64_2(path: *const c_char, flags: c_int) -> c_int {
    open_any(path, flags, 0)
}

/// True for the path that a call relative to `folder` resolves without it, which is how libraries name sysfs.
fn is_absolute(path: *const c_char) -> bool {
    // SAFETY: a path is a C string; its first byte is there, be it the zero.
    !path.is_null() && unsafe { *path } == b'/' as c_char
}

fn openat_any(folder: c_int, path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    if is_absolute(path) {
        return open_any(path, flags, mode);
    }
    // SAFETY: the kernel checks descriptor and path.
    unsafe { libc::syscall(libc::SYS_openat, folder, path, flags, mode) as c_int }
}

/// `openat(2)`; variadic like `open`.
#[no_mangle]
pub(crate) extern "C" fn openat(folder: c_int, path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    openat_any(folder, path, flags, mode)
}

/// `openat64(3)`, the same on 64-bit targets.
#[no_mangle]
pub(crate) extern "C" fn openat64(folder: c_int, path: *const c_char, flags: c_int, mode: c_int) -> c_int {
    openat_any(folder, path, flags, mode)
}

/// `openat` as fortified programs call it.
#[no_mangle]
pub(crate) extern "C" fn __openat_2(folder: c_int, path: *const c_char, flags: c_int) -> c_int {
    openat_any(folder, path, flags, 0)
}

/// `openat64` as fortified programs call it.
#[no_mangle]
pub(crate) extern "C" fn __openat64_2(folder: c_int, path: *const c_char, flags: c_int) -> c_int {
    openat_any(folder, path, flags, 0)
}

/// The C library's own function of this name, which ours stands in front of.
///
/// # Safety
/// `F` must be the type of the C function.
unsafe fn next<F: Copy>(name: &CStr) -> Option<F> {
    assert_eq!(size_of::<F>(), size_of::<*mut c_void>());
    // SAFETY: a C string; the result is a function of type `F` by the caller's promise, or null.
    unsafe {
        let found = libc::dlsym(libc::RTLD_NEXT, name.as_ptr());
        (!found.is_null()).then(|| std::mem::transmute_copy(&found))
    }
}

type Fopen = extern "C" fn(*const c_char, *const c_char) -> *mut libc::FILE;

fn fopen_any(name: &CStr, path: *const c_char, mode: *const c_char) -> *mut libc::FILE {
    // Kept for the time of the call.
    let redirected = match place(path) {
        Place::Redirected(p) => Some(p),
        // Device files are not read through streams; the kernel may say so.
        Place::Elsewhere | Place::Device(..) => None,
    };
    let path = redirected.as_ref().map_or(path, |p| p.as_ptr());
    // SAFETY: this is the type of fopen.
    match unsafe { next::<Fopen>(name) } {
        Some(real) => real(path, mode),
        None => {
            fail(libc::ENOSYS);
            std::ptr::null_mut()
        }
    }
}

/// `fopen(3)`, by which libusb up to 1.0.21 reads sysfs.
#[no_mangle]
pub(crate) extern "C" fn fopen(path: *const c_char, mode: *const c_char) -> *mut libc::FILE {
    fopen_any(c"fopen", path, mode)
}

/// `fopen64(3)`, the same on 64-bit targets.
#[no_mangle]
pub(crate) extern "C" fn fopen64(path: *const c_char, mode: *const c_char) -> *mut libc::FILE {
    fopen_any(c"fopen64", path, mode)
}

/// `struct stat` of a path, filled by the kernel; the C library's has the same layout on 64-bit targets.
fn stat_any(path: *const c_char, out: *mut libc::stat, flags: c_int) -> c_int {
    let redirected = match place(path) {
        Place::Redirected(p) => Some(p),
        Place::Device(bus, address) => {
            let node = format!("{}/dev/bus/usb/{bus:03}/{address:03}", bus::root().display());
            CString::new(node).ok()
        }
        Place::Elsewhere => None,
    };
    let path = redirected.as_ref().map_or(path, |p| p.as_ptr());
    // SAFETY: the kernel checks path and `out`.
    unsafe { libc::syscall(libc::SYS_newfstatat, libc::AT_FDCWD, path, out, flags) as c_int }
}

/// `stat(2)`.
#[no_mangle]
pub(crate) extern "C" fn stat(path: *const c_char, out: *mut libc::stat) -> c_int {
    stat_any(path, out, 0)
}

/// `stat64(3)`, the same on 64-bit targets.
#[no_mangle]
pub(crate) extern "C" fn stat64(path: *const c_char, out: *mut libc::stat) -> c_int {
    stat_any(path, out, 0)
}

/// `lstat(2)`.
#[no_mangle]
pub(crate) extern "C" fn lstat(path: *const c_char, out: *mut libc::stat) -> c_int {
    stat_any(path, out, libc::AT_SYMLINK_NOFOLLOW)
}

/// `lstat64(3)`, the same on 64-bit targets.
#[no_mangle]
pub(crate) extern "C" fn lstat64(path: *const c_char, out: *mut libc::stat) -> c_int {
    stat_any(path, out, libc::AT_SYMLINK_NOFOLLOW)
}

/// `stat` as programs built against C libraries before 2.33 call it.
#[no_mangle]
pub(crate) extern "C" fn __xstat(_version: c_int, path: *const c_char, out: *mut libc::stat) -> c_int {
    stat_any(path, out, 0)
}

/// `stat64` as programs built against C libraries before 2.33 call it.
#[no_mangle]
pub(crate) extern "C" fn __xstat64(_version: c_int, path: *const c_char, out: *mut libc::stat) -> c_int {
    stat_any(path, out, 0)
}

/// `lstat` as programs built against C libraries before 2.33 call it.
#[no_mangle]
pub(crate) extern "C" fn __lxstat(_version: c_int, path: *const c_char, out: *mut libc::stat) -> c_int {
    stat_any(path, out, libc::AT_SYMLINK_NOFOLLOW)
}

/// `lstat64` as programs built against C libraries before 2.33 call it.
#[no_mangle]
pub(crate) extern "C" fn __lxstat64(_version: c_int, path: *const c_char, out: *mut libc::stat) -> c_int {
    stat_any(path, out, libc::AT_SYMLINK_NOFOLLOW)
}

fn readlink_any(folder: c_int, path: *const c_char, out: *mut c_char, length: usize) -> isize {
    let redirected = match place(path) {
        Place::Redirected(p) => Some(p),
        _ => None,
    };
    let path = redirected.as_ref().map_or(path, |p| p.as_ptr());
    // SAFETY: the kernel checks path and buffer, whose length is the caller's word.
    unsafe { libc::syscall(libc::SYS_readlinkat, folder, path, out, length) as isize }
}

/// `readlink(2)`.
#[no_mangle]
pub(crate) extern "C" fn readlink(path: *const c_char, out: *mut c_char, length: usize) -> isize {
    readlink_any(libc::AT_FDCWD, path, out, length)
}

/// `readlinkat(2)`.
#[no_mangle]
pub(crate) extern "C" fn readlinkat(
    folder: c_int,
    path: *const c_char,
    out: *mut c_char,
    length: usize,
) -> isize {
    readlink_any(folder, path, out, length)
}

type Scandir =
    extern "C" fn(*const c_char, *mut *mut *mut libc::dirent, *const c_void, *const c_void) -> c_int;

/// `scandir(3)`; filter and order are the caller's functions, passed on.
#[no_mangle]
pub(crate) extern "C" fn scandir(
    path: *const c_char,
    names: *mut *mut *mut libc::dirent,
    filter: *const c_void,
    order: *const c_void,
) -> c_int {
    let redirected = match place(path) {
        Place::Redirected(p) => Some(p),
        _ => None,
    };
    let path = redirected.as_ref().map_or(path, |p| p.as_ptr());
    // SAFETY: this is the type of scandir, its function pointers as plain addresses.
    match unsafe { next::<Scandir>(c"scandir") } {
        Some(real) => real(path, names, filter, order),
        None => fail(libc::ENOSYS),
    }
}

/// `opendir(3)`.
#[no_mangle]
pub(crate) extern "C" fn opendir(path: *const c_char) -> *mut libc::DIR {
    let flags = libc::O_RDONLY | libc::O_DIRECTORY | libc::O_CLOEXEC | libc::O_NONBLOCK;
    let fd = match place(path) {
        Place::Redirected(p) => raw::open(p.as_ptr(), flags, 0),
        _ => raw::open(path, flags, 0),
    };
    if fd < 0 {
        return std::ptr::null_mut();
    }
    // SAFETY: `fd` is an open folder that the stream owns from here on.
    unsafe { libc::fdopendir(fd) }
}

/// `access(2)`.
#[no_mangle]
pub(crate) extern "C" fn access(path: *const c_char, mode: c_int) -> c_int {
    let redirected = match place(path) {
        Place::Redirected(p) => Some(p),
        _ => None,
    };
    let path = redirected.as_ref().map_or(path, |p| p.as_ptr());
    // SAFETY: the kernel checks the path.
    unsafe { libc::syscall(libc::SYS_faccessat, libc::AT_FDCWD, path, mode) as c_int }
}

/// `ioctl(2)`.
#[no_mangle]
pub(crate) extern "C" fn ioctl(fd: c_int, request: c_ulong, argument: *mut c_void) -> c_int {
    // usbfs numbers its requests with the letter U.
    if !is_ours(fd) || (request >> 8) & 0xff != c_ulong::from(b'U') {
        return raw::ioctl(fd, request, argument);
    }
    if path::place() == path::Place::Libusb {
        IOCTLS[usize::from(request as u8)].fetch_add(1, Ordering::Relaxed);
    }
    // From here on this is the kernel.
    path::beside(|| {
        let Some(file) = lock(&FILES).get(&fd).cloned() else { return fail(libc::EBADF) };
        // SAFETY: `argument` is what libusb passes for this request.
        unsafe { file.ioctl(request as u8, argument) }.unwrap_or_else(fail)
    })
}

/// Requests that libusb made on the frame path, by number.
static IOCTLS: [AtomicU64; 256] = [const { AtomicU64::new(0) }; 256];

/// Requests to usbfs that libusb made on the frame path: each with the number of its name in `linux/usbdevice_fs.h`,
/// and how often.
pub fn ioctls_on_frame_path() -> Vec<(u8, u64)> {
    let counted = IOCTLS.iter().enumerate().map(|(number, n)| (number as u8, n.load(Ordering::Relaxed)));
    counted.filter(|(_, n)| *n > 0).collect()
}

/// `close(2)`.
#[no_mangle]
pub(crate) extern "C" fn close(fd: c_int) -> c_int {
    if is_ours(fd) {
        OURS[fd as usize].store(false, Ordering::Release);
        let file = lock(&FILES).remove(&fd);
        if let Some(f) = file {
            f.close();
        }
    } else if fd >= 0 && EVENT_FD.load(Ordering::Acquire) == fd {
        let mut events = lock(&EVENTS);
        raw::close(events.1);
        *events = (-1, -1);
        EVENT_FD.store(-1, Ordering::Release);
    }
    raw::close(fd)
}

/// `socket(2)`: a uevent socket becomes one end of a socket pair.
#[no_mangle]
pub(crate) extern "C" fn socket(domain: c_int, kind: c_int, protocol: c_int) -> c_int {
    if domain != libc::AF_NETLINK || protocol != libc::NETLINK_KOBJECT_UEVENT {
        return raw::socket(domain, kind, protocol);
    }
    let mut pair = [0; 2];
    let kind = libc::SOCK_DGRAM | (kind & (libc::SOCK_NONBLOCK | libc::SOCK_CLOEXEC));
    // SAFETY: room for two descriptors.
    if unsafe { libc::socketpair(libc::AF_UNIX, kind, 0, pair.as_mut_ptr()) } != 0 {
        return -1;
    }
    *lock(&EVENTS) = (pair[0], pair[1]);
    EVENT_FD.store(pair[0], Ordering::Release);
    pair[0]
}

/// `bind(2)`: the uevent socket needs none.
#[no_mangle]
pub(crate) extern "C" fn bind(fd: c_int, address: *const libc::sockaddr, length: libc::socklen_t) -> c_int {
    if fd >= 0 && EVENT_FD.load(Ordering::Acquire) == fd {
        return 0;
    }
    raw::bind(fd, address, length)
}

/// `recvmsg(2)`: on the uevent socket the message comes from the kernel, user 0.
#[no_mangle]
pub(crate) extern "C" fn recvmsg(fd: c_int, message: *mut libc::msghdr, flags: c_int) -> isize {
    if fd < 0 || EVENT_FD.load(Ordering::Acquire) != fd || message.is_null() {
        return raw::recvmsg(fd, message, flags);
    }
    // SAFETY: libusb passes a valid message header whose buffers have the lengths it says; the sender is written only where it fits.
    unsafe {
        let m = &mut *message;
        let mut inner = libc::msghdr {
            msg_name: std::ptr::null_mut(),
            msg_namelen: 0,
            msg_control: std::ptr::null_mut(),
            msg_controllen: 0,
            ..*m
        };
        let n = raw::recvmsg(fd, &mut inner, flags);
        if n < 0 {
            return n;
        }
        m.msg_flags = inner.msg_flags & !libc::MSG_CTRUNC;
        if !m.msg_name.is_null() && m.msg_namelen as usize >= size_of::<libc::sockaddr_nl>() {
            let mut from: libc::sockaddr_nl = std::mem::zeroed();
            from.nl_family = libc::AF_NETLINK as u16;
            from.nl_groups = 1;
            std::ptr::write_unaligned(m.msg_name.cast(), from);
        }
        let header = libc::CMSG_FIRSTHDR(m);
        let space = libc::CMSG_SPACE(size_of::<libc::ucred>() as u32) as usize;
        if !header.is_null() && m.msg_controllen >= space {
            (*header).cmsg_len = libc::CMSG_LEN(size_of::<libc::ucred>() as u32) as _;
            (*header).cmsg_level = libc::SOL_SOCKET;
            (*header).cmsg_type = libc::SCM_CREDENTIALS;
            let kernel = libc::ucred { pid: 0, uid: 0, gid: 0 };
            std::ptr::write_unaligned(libc::CMSG_DATA(header).cast(), kernel);
        }
        n
    }
}

/// `struct statfs`, filled by the kernel; `/sys` is always a sysfs here, even where none is mounted.
fn statfs_any(path: *const c_char, out: *mut libc::statfs) -> c_int {
    const SYSFS_MAGIC: i64 = 0x6265_6572;
    // SAFETY: a path is a C string; the kernel checks `out`.
    unsafe {
        let is_sys = !path.is_null() && CStr::from_ptr(path).to_bytes() == b"/sys";
        let r = libc::syscall(libc::SYS_statfs, if is_sys { c"/".as_ptr() } else { path }, out) as c_int;
        if is_sys && r == 0 {
            (*out).f_type = SYSFS_MAGIC as _;
        }
        r
    }
}

/// `statfs(2)`.
#[no_mangle]
pub(crate) extern "C" fn statfs(path: *const c_char, out: *mut libc::statfs) -> c_int {
    statfs_any(path, out)
}

/// `statfs64(3)`, the same on 64-bit targets.
#[no_mangle]
pub(crate) extern "C" fn statfs64(path: *const c_char, out: *mut libc::statfs) -> c_int {
    statfs_any(path, out)
}

/// Where a test can see what libusb sees.
pub fn root_folder() -> PathBuf {
    bus::root().to_path_buf()
}
