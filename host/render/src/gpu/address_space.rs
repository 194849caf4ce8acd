//! Whether software Vulkan fits into what the process may use of its address space.
//!
//! Software Vulkan compiles shaders and keeps stacks and heaps for its threads. If a limit (`ulimit -v`) leaves too little for that, Mesa does
//! not report an error, so the limit is checked before. Otherwise the program would end at random by a crash inside Mesa, by an abort when memory
//! runs out, or by a panic and exit code 3. Measured with Mesa 22.3 and the demo at 160 x 120, as a whole process: 2 threads fail at 900 MB and
//! run at 1,000 MB; 8 fail at 1,400 MB and run at 1,600 MB; 16 fail at 1,400 MB and run at 1,600 MB.

use super::error::GpuError;
use std::sync::Arc;

/// What software Vulkan needs without its threads, bytes.
const BASE: u64 = 1 << 30;
/// What each of its threads needs: a stack, a heap, and room for the shader that it compiles.
const PER_THREAD: u64 = 96 << 20;
/// Most threads that it starts.
const MOST_THREADS: usize = 32;

/// The limit is too small.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shortage {
    /// What is needed, the present use of the process included, bytes.
    needed: u64,
    /// What is allowed, bytes.
    limit: u64,
}

impl Shortage {
    /// As an error of this device.
    pub(super) fn on(self, device: &Arc<str>) -> GpuError {
        GpuError::AddressSpace {
            device: device.clone(),
            needed_mib: self.needed.div_ceil(1 << 20),
            limit_mib: self.limit >> 20,
        }
    }
}

/// What buffers may use beside software Vulkan itself, bytes; `None` if there is no limit.
///
/// # Errors
/// Not even software Vulkan itself fits.
pub(super) fn for_buffers() -> Result<Option<u64>, Shortage> {
    match limit() {
        Some(limit) => left(limit, in_use(), threads()).map(Some),
        None => Ok(None),
    }
}

/// The limit is too small by so many bytes.
pub(super) fn short_of(missing: u64) -> Shortage {
    let limit = limit().unwrap_or(0);
    Shortage { needed: limit.saturating_add(missing), limit }
}

fn left(limit: u64, in_use: u64, threads: u64) -> Result<u64, Shortage> {
    let needed = in_use.saturating_add(BASE).saturating_add(PER_THREAD.saturating_mul(threads));
    limit.checked_sub(needed).ok_or(Shortage { needed, limit })
}

/// Threads that software Vulkan will start.
fn threads() -> u64 {
    let told = std::env::var("LP_NUM_THREADS").ok().and_then(|n| n.trim().parse().ok());
    let cores = || std::thread::available_parallelism().map_or(1, usize::from);
    told.unwrap_or_else(cores).clamp(1, MOST_THREADS) as u64
}

fn limit() -> Option<u64> {
    // SAFETY: a plain query into a structure that we own.
    unsafe {
        let mut limit: libc::rlimit = std::mem::zeroed();
        let told = libc::getrlimit(libc::RLIMIT_AS, &mut limit) == 0 && limit.rlim_cur != libc::RLIM_INFINITY;
        told.then_some(limit.rlim_cur)
    }
}

/// Address space that the process uses, bytes; 0 if the system does not report it.
fn in_use() -> u64 {
    // SAFETY: a plain query.
    let page = unsafe { libc::sysconf(libc::_SC_PAGESIZE) }.max(0) as u64;
    let text = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    text.split(' ').next().and_then(|pages| pages.parse::<u64>().ok()).unwrap_or(0) * page
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Found in use, R18: `ulimit -v 800000` ended in a crash inside software Vulkan.
    #[test]
    fn limits_that_fail_are_refused_and_roomy_ones_are_not() {
        let kb = |n: u64| n * 1024;
        for (threads, failed) in [(2, 900_000), (8, 1_400_000), (16, 1_400_000)] {
            let shortage = left(kb(failed), 0, threads).expect_err("refused");
            assert!(shortage.needed > shortage.limit && shortage.limit == kb(failed));
        }
        // Address space in use is not available to Vulkan; the remainder is available for buffers.
        let whole = left(kb(4_000_000), 0, 2).unwrap();
        assert_eq!(left(kb(4_000_000), 1000, 2), Ok(whole - 1000));
        assert!(left(kb(4_000_000), kb(4_000_000), 2).is_err());
        assert!(left(u64::MAX, u64::MAX, u64::MAX).is_ok_and(|left| left == 0), "sums saturate");
        assert!(in_use() > 1 << 20, "a process of Linux uses more than a MiB");
        let text = short_of(5 << 20).on(&"llvmpipe".into()).to_string();
        assert!(text.contains("llvmpipe") && text.contains("ulimit -v"), "{text}");
    }
}
