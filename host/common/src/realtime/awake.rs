//! Idle cores that do not sleep: the kernel's quality of service for the latency of processors.
//!
//! An idle core enters deeper sleep the longer it expects to be idle, and takes 0.1 ms and more to come back from it. A stage that sleeps until
//! its frame is due, or is woken by the stage before it, waits for that. The kernel never chooses a sleep that takes longer to come back from
//! than the shortest time that any open `/dev/cpu_dma_latency` holds.

use super::RightRefusal;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::Path;

/// The kernel's device, below the root of the file system. A request holds for as long as its file is open, so it also ends with a killed
/// process.
const DEVICE: &str = "dev/cpu_dma_latency";
/// Who puts idle cores to sleep.
const DRIVER: &str = "sys/devices/system/cpu/cpuidle/current_driver";
/// What the cores are.
const CORES: &str = "proc/cpuinfo";

/// What is requested on a machine of its own, us: the first sleep of its cores (C1), which takes less power than spinning. The kernel's tables
/// say that they come back from it in 1 or 2 us.
const FIRST_SLEEP_US: i32 = 2;

/// Keeps idle cores awake, or in a sleep that ends within 2 us, while it lives.
#[derive(Debug)]
pub struct CoresAwake {
    _held: File,
}

impl CoresAwake {
    /// Requests it from the kernel. `None` if this system has no such request: another kernel, or a container without the device.
    ///
    /// # Errors
    /// The kernel has the device and does not let this user write to it.
    pub fn hold() -> Result<Option<Self>, RightRefusal> {
        Self::hold_below(Path::new("/"))
    }

    fn hold_below(root: &Path) -> Result<Option<Self>, RightRefusal> {
        let request = |mut file: File| file.write_all(&latency_us(root).to_ne_bytes()).map(|()| file);
        match OpenOptions::new().write(true).open(root.join(DEVICE)).and_then(request) {
            Ok(held) => Ok(Some(Self { _held: held })),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(RightRefusal {
                what: "keeping idle cores awake".into(),
                reason: format!("/{DEVICE}: {e}"),
                remedy: "install packaging/60-dpm.rules and add this user to the group dpm (`sudo usermod -aG dpm USER`), or set \
                         real_time.keep_awake = false"
                    .into(),
            }),
        }
    }
}

/// The longest time that an idle core may take to come back, us. A virtual machine says 1 us of the sleep in which it gives its processor back
/// to the host, which takes as long as the host likes, so there no sleep is allowed at all.
fn latency_us(root: &Path) -> i32 {
    let read = |path| std::fs::read_to_string(root.join(path)).unwrap_or_default();
    let has_host =
        |line: &str| line.starts_with("flags") && line.split_whitespace().any(|flag| flag == "hypervisor");
    if read(DRIVER).trim() == "haltpoll" || read(CORES).lines().any(has_host) {
        0
    } else {
        FIRST_SLEEP_US
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    /// A file system with the device, the driver `named` and cores with these flags.
    fn machine(name: &str, named: &str, flags: &str) -> PathBuf {
        let root = std::env::temp_dir().join(format!("dpm-awake-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&root);
        for (file, text) in [
            (DEVICE, String::new()),
            (DRIVER, format!("{named}\n")),
            (CORES, format!("model name\t: of no hypervisor\nflags\t\t: fpu {flags}\n")),
        ] {
            std::fs::create_dir_all(root.join(file).parent().unwrap()).unwrap();
            std::fs::write(root.join(file), text).unwrap();
        }
        root
    }

    #[test]
    fn a_virtual_machine_is_not_believed_and_a_processor_may_take_its_first_sleep() {
        for (name, driver, flags, us) in [
            ("haltpoll", "haltpoll", "sse2", 0),
            ("guest", "acpi_idle", "sse2 hypervisor avx2", 0),
            ("intel", "intel_idle", "sse2", 2),
            ("acpi", "acpi_idle", "sse2", 2),
        ] {
            let root = machine(name, driver, flags);
            let held = CoresAwake::hold_below(&root).unwrap();
            assert!(held.is_some());
            assert_eq!(std::fs::read(root.join(DEVICE)).unwrap(), i32::to_ne_bytes(us), "{name}");
            std::fs::remove_dir_all(&root).unwrap();
        }
    }

    #[test]
    fn a_system_without_the_device_is_asked_for_nothing_and_a_refusal_has_a_remedy() {
        let root = machine("none", "none", "");
        std::fs::remove_file(root.join(DEVICE)).unwrap();
        assert!(CoresAwake::hold_below(&root).unwrap().is_none());
        // A folder cannot be written to, not even by root.
        std::fs::create_dir(root.join(DEVICE)).unwrap();
        let told = CoresAwake::hold_below(&root).unwrap_err().to_string();
        assert!(told.contains("/dev/cpu_dma_latency") && told.contains("60-dpm.rules"), "{told}");
        assert!(told.contains("real_time.keep_awake = false"), "{told}");
        std::fs::remove_dir_all(&root).unwrap();
    }

    /// The kernel reports the shortest time that anybody holds. Whoever may not write to the device is told so.
    #[cfg(target_os = "linux")]
    #[test]
    fn the_kernel_holds_what_was_requested() {
        use std::io::Read;
        match CoresAwake::hold() {
            Ok(Some(_held)) => {
                let mut now = [0; 4];
                File::open("/dev/cpu_dma_latency").unwrap().read_exact(&mut now).unwrap();
                assert!((0..=FIRST_SLEEP_US).contains(&i32::from_ne_bytes(now)), "{now:?}");
            }
            Ok(None) => assert!(!Path::new("/dev/cpu_dma_latency").exists()),
            Err(refusal) => assert!(refusal.to_string().contains("60-dpm.rules"), "{refusal}"),
        }
    }
}
