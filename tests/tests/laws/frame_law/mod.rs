//! Watches the law of the frame path in a whole process: system calls, allocations and locks, by the thread that makes
//! them and by whose code makes them: our own, or a library's that it called.
//!
//! System calls: a filter of the kernel (seccomp) turns every call that is not in a short list into a signal. The
//! signal's handler looks at the mark of the thread (`dpm_handoff::path`), counts the call, makes it in the thread's
//! place and continues. Allocations: the functions of the C library are defined here, so that those of C libraries are
//! seen like those of Rust. Locks: ours count themselves; those of C libraries pass `pthread_mutex_lock`, defined here.
#![allow(unsafe_code, dead_code)]

use dpm_handoff::path::{self, place, Place};
use std::cell::Cell;
use std::collections::BTreeMap;
use std::ffi::{c_int, c_void};
use std::fmt::Write as _;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Calls that a stage may make: to sleep, to be woken and to wake; and to read the time, where that requires a call.
/// They are not counted.
const WAITING: [i64; 5] = [
    libc::SYS_futex,
    libc::SYS_clock_nanosleep,
    libc::SYS_nanosleep,
    libc::SYS_sched_yield,
    libc::SYS_clock_gettime,
];
/// Calls that the C library makes while signals are blocked, at the beginning and the end of a thread, and the return
/// from a handler. None of them could replace a call that a frame might make: memory comes from other calls, or from
/// the functions of the C library.
const AROUND_THREADS: [i64; 11] = [
    libc::SYS_rt_sigreturn,
    libc::SYS_rt_sigprocmask,
    libc::SYS_clone,
    libc::SYS_clone3,
    libc::SYS_set_robust_list,
    libc::SYS_rseq,
    libc::SYS_madvise,
    // The stack of a thread that is not joined.
    libc::SYS_munmap,
    libc::SYS_gettid,
    libc::SYS_exit,
    libc::SYS_exit_group,
];

/// Names of the calls that occur; others are told by their number.
const NAMES: [(i64, &str); 26] = [
    (libc::SYS_futex, "futex"),
    (libc::SYS_clock_nanosleep, "clock_nanosleep"),
    (libc::SYS_sched_yield, "sched_yield"),
    (libc::SYS_read, "read"),
    (libc::SYS_write, "write"),
    (libc::SYS_writev, "writev"),
    (libc::SYS_poll, "poll"),
    (libc::SYS_ppoll, "ppoll"),
    (libc::SYS_ioctl, "ioctl"),
    (libc::SYS_recvmsg, "recvmsg"),
    (libc::SYS_sendto, "sendto"),
    (libc::SYS_sendmsg, "sendmsg"),
    (libc::SYS_mmap, "mmap"),
    (libc::SYS_mprotect, "mprotect"),
    (libc::SYS_brk, "brk"),
    (libc::SYS_openat, "openat"),
    (libc::SYS_close, "close"),
    (libc::SYS_fcntl, "fcntl"),
    (libc::SYS_newfstatat, "newfstatat"),
    (libc::SYS_statx, "statx"),
    (libc::SYS_timerfd_settime, "timerfd_settime"),
    (libc::SYS_getpid, "getpid"),
    (libc::SYS_sched_getparam, "sched_getparam"),
    (libc::SYS_sched_getscheduler, "sched_getscheduler"),
    (libc::SYS_sched_setscheduler, "sched_setscheduler"),
    (libc::SYS_getrandom, "getrandom"),
];

/// Threads whose frames are watched, by the end of their names. All others together come last.
const STAGES: [&str; 5] = ["tracking", "plan", "pack", "link", "other"];
/// System calls of every number, and two rows for what is no system call.
const EVENTS: usize = 514;
const ALLOCATED: usize = 512;
const LOCKED: usize = 513;

/// What happened on the frame path, by stage, place and event.
static COUNTED: [AtomicU64; STAGES.len() * Place::ALL.len() * EVENTS] =
    [const { AtomicU64::new(0) }; STAGES.len() * Place::ALL.len() * EVENTS];
/// System calls and allocations beside the frame path, as proof that the watch is in use.
static CALLS_BESIDE: AtomicU64 = AtomicU64::new(0);
static ALLOCATIONS_BESIDE: AtomicU64 = AtomicU64::new(0);
/// How many allocations of our own are still shown with their place.
static SHOWN: AtomicU64 = AtomicU64::new(3);
static IS_WATCHING: AtomicBool = AtomicBool::new(false);

thread_local! {
    /// The thread's place in `STAGES`; `u8::MAX` while it is not known.
    static STAGE: Cell<u8> = const { Cell::new(u8::MAX) };
}

/// Uses only atomics, thread-locals without destructors and one system call.
fn stage() -> usize {
    let known = STAGE.try_with(Cell::get).unwrap_or(STAGES.len() as u8 - 1);
    if known != u8::MAX {
        return known as usize;
    }
    let mut name = [0u8; 16];
    // SAFETY: the kernel writes at most 16 bytes.
    unsafe { dpm_test_gate(libc::SYS_prctl, libc::PR_GET_NAME.into(), name.as_mut_ptr() as i64, 0, 0, 0, 0) };
    let end = name.iter().position(|b| *b == 0).unwrap_or(name.len());
    let found = STAGES.iter().position(|s| name[..end].strip_prefix(b"dpm-") == Some(s.as_bytes()));
    let stage = found.unwrap_or(STAGES.len() - 1);
    let _ = STAGE.try_with(|s| s.set(stage as u8));
    stage
}

fn count(place: Place, event: usize) {
    if IS_WATCHING.load(Ordering::Relaxed) {
        let at = (stage() * Place::ALL.len() + place as usize) * EVENTS + event.min(EVENTS - 1);
        COUNTED[at].fetch_add(1, Ordering::Relaxed);
    }
}

fn count_memory() {
    match place() {
        Place::Beside => {
            ALLOCATIONS_BESIDE.fetch_add(1, Ordering::Relaxed);
        }
        Place::Own => {
            count(Place::Own, ALLOCATED);
            let is_shown = IS_WATCHING.load(Ordering::Relaxed)
                && SHOWN.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1)).is_ok();
            if is_shown {
                path::enter(false);
                eprintln!("our own code on the frame path:\n{}", std::backtrace::Backtrace::force_capture());
                path::enter(true);
            }
        }
        library => count(library, ALLOCATED),
    }
}

extern "C" {
    fn __libc_malloc(bytes: usize) -> *mut c_void;
    fn __libc_calloc(count: usize, bytes: usize) -> *mut c_void;
    fn __libc_realloc(memory: *mut c_void, bytes: usize) -> *mut c_void;
    fn __libc_free(memory: *mut c_void);
    fn __libc_memalign(align: usize, bytes: usize) -> *mut c_void;
}

/// The C library's, counted.
#[no_mangle]
extern "C" fn malloc(bytes: usize) -> *mut c_void {
    count_memory();
    // SAFETY: the caller's arguments; the same holds below.
    unsafe { __libc_malloc(bytes) }
}

#[no_mangle]
extern "C" fn calloc(count: usize, bytes: usize) -> *mut c_void {
    count_memory();
    // SAFETY: as above.
    unsafe { __libc_calloc(count, bytes) }
}

#[no_mangle]
unsafe extern "C" fn realloc(memory: *mut c_void, bytes: usize) -> *mut c_void {
    count_memory();
    // SAFETY: as above.
    unsafe { __libc_realloc(memory, bytes) }
}

#[no_mangle]
unsafe extern "C" fn free(memory: *mut c_void) {
    if !memory.is_null() {
        count_memory();
    }
    // SAFETY: as above.
    unsafe { __libc_free(memory) }
}

#[no_mangle]
extern "C" fn memalign(align: usize, bytes: usize) -> *mut c_void {
    count_memory();
    // SAFETY: as above.
    unsafe { __libc_memalign(align, bytes) }
}

#[no_mangle]
extern "C" fn aligned_alloc(align: usize, bytes: usize) -> *mut c_void {
    count_memory();
    // SAFETY: as above.
    unsafe { __libc_memalign(align, bytes) }
}

#[no_mangle]
unsafe extern "C" fn posix_memalign(out: *mut *mut c_void, align: usize, bytes: usize) -> c_int {
    count_memory();
    // SAFETY: as above; `out` is the caller's.
    unsafe {
        let memory = __libc_memalign(align, bytes);
        if memory.is_null() {
            return libc::ENOMEM;
        }
        *out = memory;
    }
    0
}

type MutexLock = unsafe extern "C" fn(*mut libc::pthread_mutex_t) -> c_int;

/// The C library's, counted where a library locks on the frame path. Rust's own mutexes do not pass here.
#[no_mangle]
unsafe extern "C" fn pthread_mutex_lock(mutex: *mut libc::pthread_mutex_t) -> c_int {
    static REAL: AtomicU64 = AtomicU64::new(0);
    if place() != Place::Beside {
        count(place(), LOCKED);
    }
    let mut real = REAL.load(Ordering::Relaxed);
    if real == 0 {
        // SAFETY: a C string.
        real = unsafe { libc::dlsym(libc::RTLD_NEXT, c"pthread_mutex_lock".as_ptr()) } as u64;
        REAL.store(real, Ordering::Relaxed);
    }
    // SAFETY: the C library has the function, and it has this type.
    unsafe { std::mem::transmute::<*const c_void, MutexLock>(real as *const c_void)(mutex) }
}

// The only place from which the filter permits every call: a C function that takes the number and six arguments.
std::arch::global_asm!(
    "dpm_test_gate:",
    "mov rax, rdi",
    "mov rdi, rsi",
    "mov rsi, rdx",
    "mov rdx, rcx",
    "mov r10, r8",
    "mov r8, r9",
    "mov r9, [rsp + 8]",
    "syscall",
    "dpm_test_gate_end:",
    "ret",
);

extern "C" {
    fn dpm_test_gate(number: i64, a: i64, b: i64, c: i64, d: i64, e: i64, f: i64) -> i64;
    static dpm_test_gate_end: u8;
}

/// Counts the call and makes it. Uses only atomics and thread-locals without destructors.
extern "C" fn on_call(_: c_int, _: *mut libc::siginfo_t, context: *mut c_void) {
    // SAFETY: the kernel gives a handler with SA_SIGINFO its thread's context, to which nothing else has access.
    let registers = unsafe { &mut (*context.cast::<libc::ucontext_t>()).uc_mcontext.gregs };
    let number = registers[libc::REG_RAX as usize];
    match place() {
        Place::Beside => {
            CALLS_BESIDE.fetch_add(1, Ordering::Relaxed);
        }
        place => count(place, number.clamp(0, ALLOCATED as i64 - 1) as usize),
    }
    let argument = |register: i32| registers[register as usize];
    // SAFETY: the same call that the thread was about to make.
    let result = unsafe {
        dpm_test_gate(
            number,
            argument(libc::REG_RDI),
            argument(libc::REG_RSI),
            argument(libc::REG_RDX),
            argument(libc::REG_R10),
            argument(libc::REG_R8),
            argument(libc::REG_R9),
        )
    };
    registers[libc::REG_RAX as usize] = result;
}

/// Puts the calling thread, and those that it creates from now on, under the watch. With `DPM_COUNT_WAITS=1` in the
/// environment the calls that wait are counted too. That is for measurements: a thread that ends waits with signals
/// blocked, which the filter then ends the process for.
pub(crate) fn watch() {
    install().expect("the kernel has seccomp filters");
    // SAFETY: takes no arguments.
    let parent = unsafe { libc::getppid() };
    assert!(parent > 0 && CALLS_BESIDE.load(Ordering::Relaxed) > 0, "the filter sees calls and makes them");
    assert!(ALLOCATIONS_BESIDE.load(Ordering::Relaxed) > 0, "the allocator is the one above");
    IS_WATCHING.store(true, Ordering::Relaxed);
}

fn install() -> std::io::Result<()> {
    let op = |code: u32, jt: usize, jf: usize, k: u32| libc::sock_filter {
        code: code as u16,
        jt: jt as u8,
        jf: jf as u8,
        k,
    };
    let load = |offset| op(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0, offset);
    let equal = |k, jt, jf| op(libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K, jt, jf, k);
    let end = |k| op(libc::BPF_RET | libc::BPF_K, 0, 0, k);
    let gate = &raw const dpm_test_gate_end as u64;
    let counts_waits = std::env::var_os("DPM_COUNT_WAITS").is_some();
    let waiting = WAITING.into_iter().filter(|_| !counts_waits);
    let allowed: Vec<i64> = waiting.chain(AROUND_THREADS).collect();
    // Offsets in `struct seccomp_data`: the call's number at 0, the address behind it at 8.
    let mut program = vec![
        load(8),
        equal(gate as u32, 0, 2),
        load(12),
        equal((gate >> 32) as u32, allowed.len() + 2, 0),
        load(0),
    ];
    for (i, &number) in allowed.iter().enumerate() {
        program.push(equal(number as u32, allowed.len() - i, 0));
    }
    program.extend([end(libc::SECCOMP_RET_TRAP), end(libc::SECCOMP_RET_ALLOW)]);
    let filter = libc::sock_fprog { len: program.len() as u16, filter: program.as_mut_ptr() };
    // SAFETY: plain integers, for which all zero bits are valid; the handler has the form that SA_SIGINFO requires;
    // `filter` points to `program`, and both outlive the calls.
    let rc = unsafe {
        let mut action: libc::sigaction = std::mem::zeroed();
        action.sa_sigaction = on_call as extern "C" fn(_, _, _) as usize;
        action.sa_flags = libc::SA_SIGINFO | libc::SA_NODEFER;
        match libc::sigaction(libc::SIGSYS, &action, std::ptr::null_mut()) {
            0 => match libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) {
                0 => libc::prctl(libc::PR_SET_SECCOMP, libc::SECCOMP_MODE_FILTER, &raw const filter),
                rc => rc,
            },
            rc => rc,
        }
    };
    if rc == 0 {
        Ok(())
    } else {
        Err(std::io::Error::last_os_error())
    }
}

/// What was counted: by stage and place, each event with its number.
pub(crate) struct Seen(BTreeMap<(&'static str, u8, String), u64>);

/// What was counted so far.
pub(crate) fn seen() -> Seen {
    let mut all = BTreeMap::new();
    for (at, n) in COUNTED.iter().enumerate() {
        let n = n.load(Ordering::Relaxed);
        if n > 0 {
            let (event, rest) = (at % EVENTS, at / EVENTS);
            let (place, stage) = (rest % Place::ALL.len(), STAGES[rest / Place::ALL.len()]);
            let name = match event {
                ALLOCATED => "memory".to_owned(),
                LOCKED => "pthread_mutex_lock".to_owned(),
                number => NAMES
                    .iter()
                    .find(|(n, _)| *n == number as i64)
                    .map_or_else(|| format!("call {number}"), |(_, name)| (*name).to_owned()),
            };
            all.insert((stage, place as u8, name), n);
        }
    }
    Seen(all)
}

impl Seen {
    /// Fails if our own code did anything on the frame path but the calls that are named for its stage, or if a
    /// library did anything that is not listed for its place.
    pub(crate) fn check(&self, named: &[(&str, &[&str])], libraries: &[(Place, &[&str])]) {
        let waits = ["futex", "clock_nanosleep", "sched_yield"];
        let is_allowed = |(stage, place, event): &(&str, u8, String)| {
            let own = named.iter().find(|(s, _)| s == stage).map(|(_, events)| *events);
            let library = libraries.iter().find(|(p, _)| *p as u8 == *place).map(|(_, events)| *events);
            let list = if *place == Place::Own as u8 { own } else { library };
            waits.contains(&event.as_str()) || list.is_some_and(|l| l.contains(&event.as_str()))
        };
        let new: Vec<_> = self.0.iter().filter(|(key, _)| !is_allowed(key)).collect();
        assert!(new.is_empty(), "not named: {new:?}\n{}", self.table(1));
        assert_eq!(path::locks_taken(), 0, "locks that our own code took on the frame path");
    }

    /// Number of an event, in all stages.
    pub(crate) fn number(&self, place: Place, event: &str) -> u64 {
        self.0.iter().filter(|((_, p, e), _)| *p == place as u8 && e == event).map(|(_, n)| n).sum()
    }

    /// A table of everything, with the number for each of `frames` frames.
    pub(crate) fn table(&self, frames: u64) -> String {
        let mut text = String::from("stage     whose   event                     number  per frame\n");
        for ((stage, place, event), n) in &self.0 {
            let place = format!("{:?}", Place::ALL[usize::from(*place)]);
            let per_frame = *n as f64 / frames as f64;
            let _ = writeln!(text, "{stage:<9} {place:<7} {event:<22} {n:>9} {per_frame:>10.3}");
        }
        text
    }
}
