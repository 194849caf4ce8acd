//! The system calls behind [`super`], for Linux only. On other systems every right is refused with a reason.
#![allow(unsafe_code)]

use super::RightRefusal;
#[cfg(target_os = "linux")]
use std::io::Error;

/// Lines for `/etc/security/limits.d`, as shipped in `packaging/99-dpm-limits.conf`.
const LIMITS_FILE: &str = "/etc/security/limits.d/99-dpm-limits.conf";

/// `reason` is read first of all: whoever looks for a remedy makes system calls that overwrite it.
#[cfg(target_os = "linux")]
fn refusal(reason: Error, what: String, remedy: String) -> RightRefusal {
    RightRefusal { what, reason: reason.to_string(), remedy }
}

#[cfg(target_os = "linux")]
fn user() -> String {
    std::env::var("USER").ok().filter(|u| !u.is_empty()).unwrap_or_else(|| "@dpm".into())
}

/// Cores that this process may run on (after taskset and container limits), at least 1.
pub fn usable_cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Puts the calling thread under SCHED_FIFO with a priority from 1 to 99. Threads that it creates later start under
/// the normal scheduler, so that helpers do not inherit real-time rights by accident.
#[cfg(target_os = "linux")]
pub fn set_fifo_priority(priority: u32) -> Result<(), RightRefusal> {
    let wanted = priority.clamp(1, 99);
    // SAFETY: sched_param is plain integers, for which all zero bits are valid (musl has more fields than glibc).
    let mut param: libc::sched_param = unsafe { std::mem::zeroed() };
    param.sched_priority = wanted as libc::c_int;
    // SAFETY: pid 0 is the calling thread; `param` outlives the call.
    let rc = unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &param) };
    if rc == 0 {
        return Ok(());
    }
    Err(refusal(
        Error::last_os_error(),
        format!("SCHED_FIFO priority {wanted}"),
        priority_remedy(wanted, std::path::Path::new(LIMITS_FILE).exists()),
    ))
}

/// What to do for a priority that is refused. `is_installed`: the file of limits is there, with its line for a group.
#[cfg(target_os = "linux")]
fn priority_remedy(wanted: u32, is_installed: bool) -> String {
    if is_installed {
        return format!(
            "add this user to a group that {LIMITS_FILE} names (`sudo usermod -aG dpm USER`) and log in again, or set \
             LimitRTPRIO={wanted} in dpm.service"
        );
    }
    format!(
        "put \"{} - rtprio {wanted}\" into {LIMITS_FILE} and log in again, or set LimitRTPRIO={wanted} in dpm.service",
        user()
    )
}

/// The SCHED_FIFO or SCHED_RR priority of the calling thread; 0 under the normal scheduler.
#[cfg(test)]
#[cfg(target_os = "linux")]
pub(crate) fn real_time_priority() -> u32 {
    // SAFETY: as in `set_fifo_priority`.
    let mut param: libc::sched_param = unsafe { std::mem::zeroed() };
    // SAFETY: pid 0 is the calling thread; `param` is written during the call only.
    let (policy, rc) = unsafe { (libc::sched_getscheduler(0), libc::sched_getparam(0, &mut param)) };
    let real_time = [libc::SCHED_FIFO, libc::SCHED_RR].contains(&(policy & !libc::SCHED_RESET_ON_FORK));
    if rc == 0 && real_time {
        param.sched_priority.unsigned_abs()
    } else {
        0
    }
}

/// Binds the calling thread to one core.
#[cfg(target_os = "linux")]
pub(crate) fn pin_to_core(core: u32) -> Result<(), RightRefusal> {
    let what = format!("core {core}");
    let limit = libc::CPU_SETSIZE as u32;
    if core >= limit {
        return Err(RightRefusal {
            what,
            reason: format!("the kernel's set holds {limit} cores"),
            remedy: "set real_time.affinity to cores that exist".into(),
        });
    }
    // SAFETY: cpu_set_t is a bit array, for which all zero bits are valid; `core` is inside it.
    let rc = unsafe {
        let mut set: libc::cpu_set_t = std::mem::zeroed();
        libc::CPU_SET(core as usize, &mut set);
        libc::sched_setaffinity(0, std::mem::size_of_val(&set), &set)
    };
    if rc == 0 {
        return Ok(());
    }
    Err(refusal(
        Error::last_os_error(),
        what,
        format!(
            "set real_time.affinity to cores among those in /proc/thread-self/status, Cpus_allowed_list ({})",
            allowed_cores()
        ),
    ))
}

#[cfg(target_os = "linux")]
fn allowed_cores() -> String {
    let status = std::fs::read_to_string("/proc/thread-self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("Cpus_allowed_list:"));
    line.map_or_else(|| "unknown".into(), |l| l.trim().to_owned())
}

/// Keeps all pages of the process resident, including those mapped later, so that no page fault delays a frame.
#[cfg(target_os = "linux")]
pub fn lock_memory() -> Result<(), RightRefusal> {
    // With a finite limit MCL_FUTURE would make later allocations fail instead of this call, far from the cause.
    // SAFETY: `limit` is two integers and written during the call only.
    let limit = unsafe {
        let mut limit: libc::rlimit = std::mem::zeroed();
        libc::getrlimit(libc::RLIMIT_MEMLOCK, &mut limit);
        limit.rlim_cur
    };
    let remedy = || {
        format!("put \"{} - memlock unlimited\" into {LIMITS_FILE} and log in again, or set LimitMEMLOCK=infinity in dpm.service", user())
    };
    // SAFETY: takes no pointers.
    if limit != libc::RLIM_INFINITY && unsafe { libc::geteuid() } != 0 {
        return Err(RightRefusal {
            what: "locking memory".into(),
            reason: format!("the limit is {} KiB", limit / 1024),
            remedy: remedy(),
        });
    }
    // SAFETY: takes no pointers; only changes residency.
    if unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) } == 0 {
        return Ok(());
    }
    Err(refusal(Error::last_os_error(), "locking memory".into(), remedy()))
}

/// Undoes [`lock_memory`].
#[cfg(target_os = "linux")]
pub fn unlock_memory() {
    // SAFETY: takes no pointers; only changes residency.
    unsafe { libc::munlockall() };
}

/// Sets the timer slack: sleeps of the calling thread end at most this many nanoseconds late through the kernel's
/// batching of timers.
#[cfg(target_os = "linux")]
pub fn set_timer_slack_ns(slack_ns: u64) -> Result<(), RightRefusal> {
    // SAFETY: PR_SET_TIMERSLACK takes one integer.
    if unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, slack_ns as libc::c_ulong, 0, 0, 0) } == 0 {
        return Ok(());
    }
    Err(refusal(
        Error::last_os_error(),
        "a shorter timer slack".into(),
        "sleeps may end 50 us late; allow prctl in the sandbox".into(),
    ))
}

/// `struct sched_attr` of the kernel, first version.
#[cfg(target_os = "linux")]
#[repr(C)]
#[derive(Default)]
struct SchedAttr {
    size: u32,
    policy: u32,
    flags: u64,
    nice: i32,
    priority: u32,
    runtime: u64,
    deadline: u64,
    period: u64,
}

/// Requests time slices of `slice_ns` (0.1 to 100 ms) from the normal scheduler for the calling thread, which keeps
/// its niceness. A thread that needs little time at once then comes before threads that need much. Needs no right.
/// Kernels before 6.12 have one slice for all threads and ignore the request silently.
#[cfg(target_os = "linux")]
pub(crate) fn set_slice_ns(slice_ns: u64) -> Result<(), RightRefusal> {
    let size = std::mem::size_of::<SchedAttr>() as u32;
    let mut attr = SchedAttr::default();
    // SAFETY: pid 0 is the calling thread; `attr` has the `size` bytes that the kernel may write and outlives the calls.
    let rc = unsafe {
        if libc::syscall(libc::SYS_sched_getattr, 0, &raw mut attr, size, 0) == 0 {
            attr.size = size;
            attr.runtime = slice_ns.clamp(100_000, 100_000_000);
            libc::syscall(libc::SYS_sched_setattr, 0, &raw const attr, 0)
        } else {
            -1
        }
    };
    if rc == 0 {
        return Ok(());
    }
    Err(refusal(
        Error::last_os_error(),
        "a shorter time slice".into(),
        "allow sched_setattr in the sandbox".into(),
    ))
}

/// The time slice of the calling thread under the normal scheduler, ns; 0 if the kernel has one slice for all
/// threads.
#[cfg(test)]
#[cfg(target_os = "linux")]
pub(crate) fn slice_ns() -> u64 {
    let size = std::mem::size_of::<SchedAttr>() as u32;
    let mut attr = SchedAttr::default();
    // SAFETY: as in `set_slice_ns`.
    let rc = unsafe { libc::syscall(libc::SYS_sched_getattr, 0, &raw mut attr, size, 0) };
    if rc == 0 {
        attr.runtime
    } else {
        0
    }
}

/// The cores that the calling thread may run on, in order.
#[cfg(target_os = "linux")]
pub(crate) fn allowed_core_list() -> Vec<u32> {
    // SAFETY: cpu_set_t is a bit array, for which all zero bits are valid and which is written during the call only.
    let set = unsafe {
        let mut set: libc::cpu_set_t = std::mem::zeroed();
        if libc::sched_getaffinity(0, std::mem::size_of_val(&set), &mut set) != 0 {
            return Vec::new();
        }
        set
    };
    // SAFETY: every core asked for is inside the set.
    (0..libc::CPU_SETSIZE as u32).filter(|&core| unsafe { libc::CPU_ISSET(core as usize, &set) }).collect()
}

/// The calling thread's id in the operating system.
#[cfg(target_os = "linux")]
pub fn thread_id() -> i32 {
    // SAFETY: gettid takes no arguments and cannot fail.
    unsafe { libc::gettid() }
}

/// What a thread of this process is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Standing {
    /// It runs, or is ready to run.
    pub ready: bool,
    /// Processor time that it has used, nanoseconds.
    pub ran_ns: i64,
    /// Time for which it was ready and got no core, nanoseconds. What it waits now is added when it runs.
    pub waited_ns: i64,
}

impl Standing {
    /// For how long of the last `span_ns` it was ready to run and got no core, nanoseconds; `before`: as it stood at the beginning of them, if that
    /// is known.
    pub fn starved_ns(self, before: Option<Self>, span_ns: i64) -> i64 {
        let before = before.unwrap_or(Self { ready: true, ..self });
        let waited_ns = self.waited_ns - before.waited_ns;
        // A thread that waits now, and did not run meanwhile, has probably waited for all of it.
        let waits_ns = if self.ready { span_ns - (self.ran_ns - before.ran_ns) } else { 0 };
        waited_ns.max(waits_ns).clamp(0, span_ns.max(0))
    }
}

/// What the thread `id` of this process is doing; `None` if the kernel does not say or the thread is gone. Allocates
/// nothing.
#[cfg(target_os = "linux")]
pub fn standing_of(id: i32) -> Option<Standing> {
    let mut text = [0u8; 256];
    let stat = read_of_thread(id, "stat", &mut text)?;
    // The name, in brackets, may contain any character.
    let state = stat.rsplit(')').next()?.split_whitespace().next()?;
    let ready = state == "R";
    let mut text = [0u8; 96];
    let mut counts = read_of_thread(id, "schedstat", &mut text)?.split_whitespace();
    let ran_ns = counts.next()?.parse().ok()?;
    Some(Standing { ready, ran_ns, waited_ns: counts.next()?.parse().ok()? })
}

/// The threads of this process, each with its id and its name.
#[cfg(target_os = "linux")]
pub fn threads(mut each: impl FnMut(i32, &str)) {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else { return };
    for id in tasks.flatten().filter_map(|task| task.file_name().to_str()?.parse().ok()) {
        let mut text = [0u8; 32];
        if let Some(name) = read_of_thread(id, "comm", &mut text) {
            each(id, name.trim_end());
        }
    }
}

/// Share of the last ten seconds in which some program of this machine was ready to run and got no core, 0 to 1 (pressure stall
/// information); `None` if the kernel does not say.
#[cfg(target_os = "linux")]
pub fn processor_pressure() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/pressure/cpu").ok()?;
    let some = text.lines().find_map(|line| line.strip_prefix("some "))?;
    let percent: f64 = some.split(' ').find_map(|word| word.strip_prefix("avg10="))?.parse().ok()?;
    Some(percent / 100.0)
}

/// The beginning of a file about the thread `id`.
#[cfg(target_os = "linux")]
fn read_of_thread<'a>(id: i32, name: &str, text: &'a mut [u8]) -> Option<&'a str> {
    use std::io::{Read, Write};
    let mut path = [0u8; 48];
    let mut rest = &mut path[..];
    write!(rest, "/proc/self/task/{id}/{name}").ok()?;
    let left = rest.len();
    let used = path.len() - left;
    let n = std::fs::File::open(std::str::from_utf8(&path[..used]).ok()?).ok()?.read(text).ok()?;
    std::str::from_utf8(&text[..n]).ok()
}

/// Makes the calling thread give way to others under the normal scheduler: `by` is 1 to 19, the steps of nice(2).
/// Without an effect if it is refused, which no kernel does.
#[cfg(target_os = "linux")]
pub fn give_way(by: i32) {
    // SAFETY: setpriority takes plain numbers; 0 is the calling thread on Linux.
    unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, by.clamp(1, 19)) };
}

/// Nanoseconds of processor time the calling thread has used.
#[cfg(target_os = "linux")]
pub fn thread_cpu_ns() -> i64 {
    let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `t` is written during the call only.
    unsafe { libc::clock_gettime(libc::CLOCK_THREAD_CPUTIME_ID, &mut t) };
    #[allow(clippy::unnecessary_cast)] // 32 bits on some targets
    let ns = t.tv_sec as i64 * 1_000_000_000 + t.tv_nsec as i64;
    ns
}

#[cfg(not(target_os = "linux"))]
mod elsewhere {
    use super::RightRefusal;

    fn not_here(what: &str) -> RightRefusal {
        RightRefusal {
            what: what.into(),
            reason: "not implemented for this system".into(),
            remedy: "run on Linux, or set it to off in [real_time]".into(),
        }
    }

    /// Refused.
    pub fn set_fifo_priority(_priority: u32) -> Result<(), RightRefusal> {
        Err(not_here("real-time priority"))
    }
    /// Always the normal scheduler.
    pub(crate) fn real_time_priority() -> u32 {
        0
    }
    /// Refused.
    pub(crate) fn pin_to_core(_core: u32) -> Result<(), RightRefusal> {
        Err(not_here("binding to a core"))
    }
    /// Refused.
    pub fn lock_memory() -> Result<(), RightRefusal> {
        Err(not_here("locking memory"))
    }
    /// Nothing to undo.
    pub fn unlock_memory() {}
    /// Refused.
    pub fn set_timer_slack_ns(_slack_ns: u64) -> Result<(), RightRefusal> {
        Err(not_here("a shorter timer slack"))
    }
    /// Refused.
    pub(crate) fn set_slice_ns(_slice_ns: u64) -> Result<(), RightRefusal> {
        Err(not_here("a shorter time slice"))
    }
    /// Unknown.
    pub(crate) fn slice_ns() -> u64 {
        0
    }
    /// No effect.
    pub fn give_way(_by: i32) {}
    /// Unknown.
    pub(crate) fn allowed_core_list() -> Vec<u32> {
        Vec::new()
    }
    /// Unknown.
    pub fn thread_cpu_ns() -> i64 {
        0
    }
    /// Unknown.
    pub fn thread_id() -> i32 {
        0
    }
    /// None.
    pub fn threads(_each: impl FnMut(i32, &str)) {}
    /// Unknown.
    pub fn processor_pressure() -> Option<f64> {
        None
    }
    /// Unknown.
    pub fn standing_of(_id: i32) -> Option<super::Standing> {
        None
    }
}
#[cfg(not(target_os = "linux"))]
pub use elsewhere::*;

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    /// A file of limits that is there names a group already, so it is the user that is missing.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_priority_is_had_by_the_file_of_limits_or_by_its_group() {
        let (without, with) = (priority_remedy(50, false), priority_remedy(50, true));
        assert!(without.contains(" - rtprio 50") && !without.contains("usermod"), "{without}");
        assert!(with.contains("usermod -aG dpm USER") && !with.contains(" - rtprio"), "{with}");
        assert!([with, without].iter().all(|told| told.contains("LimitRTPRIO=50 in dpm.service")));
    }

    /// Runs `f` on a thread of its own, because rights stay with the thread.
    fn apart<R: Send + 'static>(f: impl FnOnce() -> R + Send + 'static) -> R {
        std::thread::spawn(f).join().unwrap()
    }

    #[test]
    fn priority_is_granted_or_refused_with_the_limit_to_set() {
        apart(|| match set_fifo_priority(10) {
            Ok(()) => assert_eq!(real_time_priority(), 10),
            Err(refusal) => {
                assert_eq!(real_time_priority(), 0);
                let text = refusal.to_string();
                assert!(text.contains("rtprio 10") && text.contains("LimitRTPRIO=10"), "{text}");
            }
        });
    }

    /// The file of limits is looked for as well, and that it is not there is no reason of the kernel's.
    #[test]
    fn a_refused_priority_has_the_reason_of_the_kernel() {
        apart(|| {
            // SAFETY: plain numbers. Unlike the function of the C library, the system call changes this thread alone. Root may do anything,
            // so it becomes nobody; for anybody else the call is refused, and the priority is refused all the same.
            unsafe { libc::syscall(libc::SYS_setresuid, 65534, 65534, 65534) };
            if let Err(refusal) = set_fifo_priority(10) {
                assert!(refusal.reason.contains("os error 1)"), "{refusal}");
            }
        });
    }

    #[test]
    fn pinning_works_for_an_allowed_core_and_names_the_allowed_ones() {
        apart(|| {
            let allowed = allowed_cores();
            let first: u32 = allowed.split(['-', ',']).next().unwrap().parse().unwrap();
            pin_to_core(first).unwrap();
            assert_eq!(allowed_cores(), first.to_string());
            assert_eq!(usable_cores(), 1);
            let absent = pin_to_core(1023).unwrap_err().to_string();
            assert!(absent.contains("core 1023") && absent.contains("real_time.affinity"), "{absent}");
            assert!(absent.contains("os error 22"), "{absent}");
            assert!(pin_to_core(1 << 20).is_err());
        });
    }

    #[test]
    fn a_short_slice_stays_with_its_thread_and_keeps_the_scheduler() {
        let before = apart(slice_ns);
        let after = apart(|| {
            set_slice_ns(100_000).unwrap();
            (slice_ns(), real_time_priority())
        });
        assert!(after == (100_000, 0) || (before == 0 && after.0 == 0), "{before}, then {after:?}");
        assert_eq!(apart(slice_ns), before, "other threads keep theirs");
    }

    #[test]
    fn the_list_of_cores_is_the_one_that_the_kernel_reports() {
        apart(|| {
            let cores = allowed_core_list();
            assert_eq!(cores.len(), usable_cores());
            let last = *cores.last().unwrap();
            pin_to_core(last).unwrap();
            assert_eq!(allowed_core_list(), [last]);
            assert_eq!(allowed_cores(), last.to_string());
        });
    }

    #[test]
    fn slack_shortens_sleeps_and_cpu_time_counts_work_only() {
        apart(|| {
            set_timer_slack_ns(1).unwrap();
            let before = thread_cpu_ns();
            std::thread::sleep(std::time::Duration::from_millis(20));
            let slept = thread_cpu_ns() - before;
            assert!(slept < 10_000_000, "sleeping used {slept} ns of processor time");
            let mut x = 1u64;
            let before = thread_cpu_ns();
            while thread_cpu_ns() - before < 2_000_000 {
                x = std::hint::black_box(x.wrapping_mul(3));
            }
            assert_ne!(x, 0);
        });
    }

    /// Found in use, R1: the system distinguishes a thread that sleeps or was stopped from one that waits for a core.
    #[test]
    fn the_system_tells_who_is_ready() {
        let this = standing_of(thread_id()).expect("Linux tells");
        assert!(this.ready, "it asks for itself");
        let (to_test, from_thread) = std::sync::mpsc::channel();
        let (to_thread, from_test) = std::sync::mpsc::channel::<()>();
        let thread = std::thread::spawn(move || {
            to_test.send(thread_id()).unwrap();
            let _ = from_test.recv();
        });
        let other = from_thread.recv().unwrap();
        while standing_of(other).expect("Linux tells").ready {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        drop(to_thread);
        thread.join().unwrap();
    }
}
