//! A hundred thousand frames through the whole pipeline at real pace: on the frame path nothing is allocated, and the
//! only system calls are those that wait, wake and read the time.
//!
//! The kernel itself checks this: a filter (seccomp) turns every other call of every thread into a signal. The
//! signal's handler checks whether the thread is on the frame path, makes the call in its place and continues.
#![cfg(all(target_os = "linux", target_arch = "x86_64"))]
#![allow(unsafe_code)]

use counting_allocator::Counting;
use dpm_rig::pipeline::{on_frame_path, run_prepared, RunOptions};
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_tests::rigs::demo_rig;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::sync::Arc;

/// Calls that a stage may make: to sleep, to be woken and to wake; and to read the time, where that requires a call.
const LISTED: [i64; 5] = [
    libc::SYS_futex,
    libc::SYS_clock_nanosleep,
    libc::SYS_nanosleep,
    libc::SYS_sched_yield,
    libc::SYS_clock_gettime,
];
/// Calls that the C library makes while signals are blocked, at the beginning and the end of a thread, and the return
/// from a handler. None of them could replace a call that a frame might make: memory comes from other calls, or from
/// the counting allocator.
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

/// Calls of neither kind, anywhere and on the frame path; and the numbers of the first few on the frame path.
static ELSEWHERE: AtomicU64 = AtomicU64::new(0);
static ON_THE_PATH: AtomicU64 = AtomicU64::new(0);
static FIRST: [AtomicI64; 8] = [const { AtomicI64::new(-1) }; 8];
/// Allocations and releases on the frame path.
static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);

#[global_allocator]
static ALLOCATOR: Counting = Counting::telling(|_| {
    if on_frame_path() {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
    }
});

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

/// Records the call and makes it. Uses only atomics and a thread-local without destructor.
extern "C" fn on_call(_: libc::c_int, _: *mut libc::siginfo_t, context: *mut libc::c_void) {
    // SAFETY: the kernel gives a handler with SA_SIGINFO its thread's context, to which nothing else has access.
    let registers = unsafe { &mut (*context.cast::<libc::ucontext_t>()).uc_mcontext.gregs };
    let number = registers[libc::REG_RAX as usize];
    if on_frame_path() {
        let at = ON_THE_PATH.fetch_add(1, Ordering::Relaxed) as usize;
        if let Some(first) = FIRST.get(at) {
            first.store(number, Ordering::Relaxed);
        }
    } else {
        ELSEWHERE.fetch_add(1, Ordering::Relaxed);
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

/// Puts the calling thread, and those that it creates from now on, under the filter.
fn watch_calls() -> std::io::Result<()> {
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
    let allowed: Vec<i64> = LISTED.into_iter().chain(AROUND_THREADS).collect();
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

/// Several rigs in parallel, so that the test takes seconds: a panel of eight planes can show 2800 frames per second.
const RIGS: u64 = 4;
const FRAMES: u64 = 25_000;

#[test]
fn a_hundred_thousand_frames_only_wait_and_wake() {
    watch_calls().expect("the kernel has seccomp filters");
    // SAFETY: takes no arguments.
    let parent = unsafe { libc::getppid() };
    assert!(
        parent > 0 && ELSEWHERE.load(Ordering::Relaxed) > 0,
        "the filter sees calls and lets them be made"
    );
    let planned: u64 = std::thread::scope(|scope| {
        let runs: Vec<_> = (0..RIGS)
            .map(|_| {
                scope.spawn(|| {
                    let settings =
                        ["real_time.pace=\"real\"", "projector.frame_rate=\"2800\"", "projector.planes=8"];
                    let rig = demo_rig(32, 16, &settings);
                    let monitor = Arc::new(RunMonitor::default());
                    let options = RunOptions { frames: FRAMES, ..RunOptions::default() };
                    let outcome = run_prepared(rig, options, &monitor).unwrap_or_else(|e| panic!("{e}"));
                    assert_eq!((outcome.frames_torn, outcome.frames_reordered), (0, 0));
                    assert!(outcome.report.frames_lit > FRAMES / 50, "{} lit", outcome.report.frames_lit);
                    monitor.counts().frames_planned
                })
            })
            .collect();
        runs.into_iter().map(|run| run.join().expect("the run ended")).sum()
    });
    assert_eq!(planned, RIGS * FRAMES);
    let first: Vec<i64> = FIRST.iter().map(|n| n.load(Ordering::Relaxed)).filter(|n| *n >= 0).collect();
    let (calls, allocations) = (ON_THE_PATH.load(Ordering::Relaxed), ALLOCATIONS.load(Ordering::Relaxed));
    assert_eq!((calls, allocations), (0, 0), "calls {first:?} and allocations on the frame path");
}
