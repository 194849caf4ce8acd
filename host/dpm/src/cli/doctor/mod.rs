//! `dpm doctor`: what this machine can do, line by line, and how to fix what is missing; with a rig file also whether that
//! rig can run here.

mod devices;
#[cfg(feature = "display")]
mod displays;
mod rig;

use super::os;
use super::rig_args::RigArgs;
use super::watch::print;
use dpm_common::realtime::awake::CoresAwake;
use dpm_common::realtime::{self, RightRefusal};
use dpm_render::gpu::{DeviceSummary, GpuOptions};
use dpm_rig::failure::{Failure, FailureKind};
#[cfg(feature = "alp")]
use dpm_rig::projectors::alp_library;
use dpm_rig::telemetry::report::to_json;
use std::fs;
use std::path::PathBuf;

/// Flags of `dpm doctor`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct DoctorArgs {
    /// A rig file: its scene and calibration are read, its tracker is listened to for three seconds, and its projector
    /// is asked whether it can show the rig's frames; it stays dark
    #[arg(value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    #[command(flatten)]
    flags: RigArgs,
    /// Load the library that the rig file names for an ALP, which runs its code, and ask the device; without this the
    /// library is only looked at
    #[arg(long)]
    load_libraries: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// The severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Severity {
    /// As it should be.
    Ok,
    /// Works, but at a cost.
    Warning,
    /// Something cannot be used.
    Missing,
    /// Information.
    Info,
}

/// One finding.
#[derive(Clone, Debug, serde::Serialize)]
pub(crate) struct Finding {
    /// The subject.
    pub name: String,
    /// Its state.
    pub state: Severity,
    /// What was found.
    pub found: String,
    /// What to do; empty if nothing is to be done.
    pub remedy: String,
}

impl Finding {
    pub(super) fn new(
        name: &str,
        state: Severity,
        found: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Self { name: name.into(), state, found: found.into(), remedy: remedy.into() }
    }
}

/// Everything that was found.
#[derive(Debug, serde::Serialize)]
pub(super) struct Findings {
    /// True if the main task can run, which needs a Vulkan device.
    pub can_render: bool,
    /// True if nothing is missing that the rig needs; absent without a rig file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub can_run: Option<bool>,
    /// Findings in the order of a frame's path.
    pub findings: Vec<Finding>,
}

/// Runs the command.
///
/// # Errors
/// [`FailureKind::NoGpu`] if there is no usable Vulkan device. [`FailureKind::CheckFailed`] if something is missing that
/// the rig of the file needs, [`FailureKind::BadInput`] if the file is wrong. What else is missing on this machine is only
/// reported.
pub(super) fn execute(args: &DoctorArgs) -> Result<(), Failure> {
    args.flags.refuse("dpm doctor", &["--frames", "--seconds", "--no-prediction"])?;
    let config = args.rig.as_deref().map(|path| args.flags.rig_at_rest(Some(path))).transpose()?;
    let system = System::this();
    let mut findings = Vec::new();
    let can_render = vulkan(&mut findings);
    findings.push(cores(std::thread::available_parallelism().map_or(1, usize::from)));
    findings.push(simd());
    let fifo = briefly(|| realtime::os::set_fifo_priority(FRAME_PATH_PRIORITY));
    findings.push(right("real-time priority", "SCHED_FIFO granted", fifo));
    findings.push(right("locked memory", "granted", briefly(lock_and_unlock)));
    findings.push(idle_cores(CoresAwake::hold().map(|held| held.is_some())));
    findings.extend(system.throttling());
    findings.extend(system.governor());
    findings.extend(system.clock());
    findings.extend(system.usb());
    findings.push(system.serial_ports());
    #[cfg(feature = "display")]
    findings.extend(displays::findings());
    #[cfg(feature = "alp")]
    findings.push(alp_libraries(&system.root));
    let with = |keys: &[&str]| args.flags.with_keys(args.rig.as_deref(), keys);
    let of_rig = config.as_ref().map(|config| rig::findings(config, args.load_libraries, &with));
    let missing = |of: &[Finding]| {
        of.iter().filter(|f| f.state == Severity::Missing).map(|f| f.name.clone()).collect::<Vec<_>>()
    };
    let missing = of_rig.as_deref().map(missing);
    findings.extend(of_rig.into_iter().flatten());
    let can_run = missing.as_ref().map(|names| can_render && names.is_empty());
    let all = Findings { can_render, can_run, findings };
    print(&if args.json { to_json(&all) + "\n" } else { table(&all.findings) });
    if !all.can_render {
        let told = "no usable Vulkan device: nothing can be rendered on this machine";
        return Err(Failure::new(FailureKind::NoGpu, told));
    }
    match missing {
        Some(names) if !names.is_empty() => {
            let told = format!("this rig cannot run yet: {} (see MISSING above)", names.join(", "));
            Err(Failure::new(FailureKind::CheckFailed, told))
        }
        _ => Ok(()),
    }
}

/// The priority that `packaging/99-dpm-limits.conf` grants.
const FRAME_PATH_PRIORITY: u32 = 80;

fn vulkan(findings: &mut Vec<Finding>) -> bool {
    let devices = match dpm_render::gpu::Gpu::list() {
        Ok(devices) => devices,
        Err(e) => {
            findings.push(Finding::new("Vulkan", Severity::Missing, e.to_string(), ""));
            return false;
        }
    };
    let mut usable = false;
    for (i, device) in devices.iter().enumerate() {
        let kind = if device.software { ", software" } else { "" };
        let rays = if device.ray_query { "ray query" } else { "no ray query" };
        let found = format!(
            "{} ({}, Vulkan {}{kind}), {} MiB, subgroup {}, {rays}",
            device.name, device.driver, device.api_version, device.memory_mib, device.subgroup_size
        );
        usable |= device.refused.is_none();
        let (state, remedy) = match &device.refused {
            Some(reason) => (Severity::Missing, format!("cannot be used: {reason}")),
            None if device.software => {
                let advice = "runs at virtual pace with a small raster; install your GPU vendor's driver for real time";
                (Severity::Warning, advice.to_string())
            }
            None => device
                .advice
                .clone()
                .map_or((Severity::Ok, String::new()), |advice| (Severity::Warning, advice)),
        };
        findings.push(Finding::new(&format!("Vulkan device {i}"), state, found, remedy));
    }
    findings.extend(priority_of_frames(&devices));
    if devices.is_empty() {
        let remedy =
            "install the GPU vendor's driver, or software Vulkan: apt-get install mesa-vulkan-drivers";
        findings.push(Finding::new(
            "Vulkan",
            Severity::Missing,
            "found a Vulkan loader but no device",
            remedy,
        ));
    }
    usable
}

/// Whether frames go before the work of other programs on the GPU that a run takes if its rig file names none.
fn priority_of_frames(devices: &[DeviceSummary]) -> Option<Finding> {
    devices.iter().find(|device| !device.software && device.refused.is_none())?;
    let gpu = dpm_render::gpu::Gpu::open(&GpuOptions::default()).ok()?;
    let (found, remedy) = if gpu.goes_first() {
        ("frames go before the work of other programs", "")
    } else {
        (
            "frames share the GPU with other programs as equals",
            "on a machine with a desktop: give the service AmbientCapabilities=CAP_SYS_NICE",
        )
    };
    Some(Finding::new("GPU priority", Severity::Info, found, remedy))
}

fn cores(count: usize) -> Finding {
    let found = format!("{count} usable");
    if count >= 4 {
        Finding::new("cores", Severity::Ok, found, "")
    } else {
        let remedy = "threads park instead of spinning (real_time.wait = \"auto\"): hand-offs take about 30 us, not 0.5 us";
        Finding::new("cores", Severity::Warning, found, remedy)
    }
}

fn simd() -> Finding {
    let kernel = dpm_render::pack::Kernel::best();
    let (state, remedy) = match kernel {
        dpm_render::pack::Kernel::Scalar => {
            (Severity::Warning, "packing on this CPU is slow: prefer a GPU or a CPU with AVX2")
        }
        _ => (Severity::Ok, ""),
    };
    Finding::new("bit-plane packing", state, kernel.name(), remedy)
}

/// The ALP libraries below `root`.
#[cfg(feature = "alp")]
fn alp_libraries(root: &std::path::Path) -> Finding {
    let found = alp_library::installed(root);
    if found.is_empty() {
        let remedy = "needed only for a ViALUX ALP: install the vendor's ALP for Linux";
        return Finding::new("ALP library", Severity::Info, "none", remedy);
    }
    let found: Vec<String> = found.iter().map(|file| file.display().to_string()).collect();
    Finding::new("ALP library", Severity::Ok, found.join(", "), "")
}

/// The result of trying a right on a thread that ended at once.
fn right(name: &str, granted: &str, tried: Result<(), RightRefusal>) -> Finding {
    match tried {
        Ok(()) => Finding::new(name, Severity::Ok, granted, ""),
        Err(r) => {
            Finding::new(name, Severity::Warning, format!("{} was refused ({})", r.what, r.reason), r.remedy)
        }
    }
}

/// Whether a run may keep idle cores awake; the result of trying.
fn idle_cores(tried: Result<bool, RightRefusal>) -> Finding {
    let name = "idle cores";
    match tried {
        Ok(false) => {
            let remedy = "in a container: pass /dev/cpu_dma_latency into it, or stages may wake 0.1 ms late";
            Finding::new(
                name,
                Severity::Info,
                "this system has no /dev/cpu_dma_latency to keep them awake",
                remedy,
            )
        }
        tried => right(name, "can be kept awake", tried.map(drop)),
    }
}

/// Runs `ask` on a thread that ends at once, so that this thread keeps nothing.
fn briefly(ask: fn() -> Result<(), RightRefusal>) -> Result<(), RightRefusal> {
    let refused =
        |reason: String| Err(RightRefusal { what: "a right".into(), reason, remedy: String::new() });
    match std::thread::Builder::new().spawn(ask) {
        Ok(thread) => {
            thread.join().unwrap_or_else(|_| refused("the thread that tested it panicked".to_string()))
        }
        Err(e) => refused(format!("cannot start a thread to test it: {e}")),
    }
}

fn lock_and_unlock() -> Result<(), RightRefusal> {
    realtime::os::lock_memory()?;
    realtime::os::unlock_memory();
    Ok(())
}

/// The kernel's files in `/proc`, `/sys` and `/dev`, below a root that tests can replace.
struct System {
    root: PathBuf,
}

impl System {
    /// The machine that this program runs on.
    fn this() -> Self {
        Self { root: PathBuf::from("/") }
    }

    fn read(&self, path: &str) -> Option<String> {
        Some(fs::read_to_string(self.root.join(path)).ok()?.trim().to_string())
    }

    /// Sorted names in a folder; empty if it does not exist.
    fn names(&self, path: &str) -> Vec<String> {
        let Ok(entries) = fs::read_dir(self.root.join(path)) else { return Vec::new() };
        let mut names: Vec<String> = entries.filter_map(|e| e.ok()?.file_name().into_string().ok()).collect();
        names.sort();
        names
    }

    fn throttling(&self) -> Option<Finding> {
        let runtime: i64 = self.read("proc/sys/kernel/sched_rt_runtime_us")?.parse().ok()?;
        let period: i64 = self.read("proc/sys/kernel/sched_rt_period_us")?.parse().ok()?;
        let name = "real-time throttling";
        Some(if runtime < 0 || runtime >= period {
            Finding::new(name, Severity::Ok, "off", "")
        } else {
            let gap_ms = (period - runtime) as f64 / 1e3;
            Finding::new(
                name,
                Severity::Warning,
                format!("the kernel stops a spinning real-time thread for {gap_ms:.0} ms in every {:.0} ms", period as f64 / 1e3),
                "on a machine for the rig alone: sysctl kernel.sched_rt_runtime_us=-1; else real_time.wait = \"park\"",
            )
        })
    }

    fn governor(&self) -> Option<Finding> {
        let governor = self.read("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")?;
        let name = "clock frequency";
        Some(if governor == "performance" {
            Finding::new(name, Severity::Ok, "governor performance", "")
        } else {
            let remedy =
                "cpupower frequency-set -g performance, so that a frame does not start on a slow core";
            Finding::new(name, Severity::Warning, format!("governor {governor}"), remedy)
        })
    }

    fn clock(&self) -> Option<Finding> {
        let source = self.read("sys/devices/system/clocksource/clocksource0/current_clocksource")?;
        let name = "clock source";
        Some(
            if matches!(
                source.as_str(),
                "tsc" | "kvm-clock" | "arch_sys_counter" | "hyperv_clocksource_tsc_page"
            ) {
                Finding::new(name, Severity::Ok, source, "")
            } else {
                let remedy = "reading the time takes a system call of about 1 us; boot with clocksource=tsc if the CPU's is stable";
                Finding::new(name, Severity::Warning, source, remedy)
            },
        )
    }

    fn usb(&self) -> Vec<Finding> {
        let mut out = Vec::new();
        if !self.root.join("dev/bus/usb").is_dir() {
            out.push(Finding::new(
                "USB",
                Severity::Info,
                "no USB bus on this machine",
                "needed only for projectors on USB",
            ));
            return out;
        }
        let frame_mb = 2.36;
        if let Some(mb) =
            self.read("sys/module/usbcore/parameters/usbfs_memory_mb").and_then(|t| t.parse::<u32>().ok())
        {
            let frames = if mb == 0 {
                "any number of".into()
            } else {
                format!("{:.0}", (f64::from(mb) / frame_mb).floor())
            };
            let found = format!("usbfs_memory_mb = {mb}: {frames} frames of 1024 x 768 x 24 in flight");
            out.push(if mb == 0 || mb >= 64 {
                Finding::new("USB memory", Severity::Ok, found, "")
            } else {
                let remedy = "echo 256 > /sys/module/usbcore/parameters/usbfs_memory_mb, or usbcore.usbfs_memory_mb=256 at boot";
                Finding::new("USB memory", Severity::Warning, found, remedy)
            });
        }
        for name in self.names("sys/bus/usb/devices") {
            let field = |f: &str| self.read(&format!("sys/bus/usb/devices/{name}/{f}"));
            let (Some(vendor), Some(product)) = (field("idVendor"), field("idProduct")) else { continue };
            let Some(what) = known_projector(&vendor, &product) else { continue };
            let node = match (field("busnum"), field("devnum")) {
                (Some(bus), Some(dev)) => format!("dev/bus/usb/{bus:0>3}/{dev:0>3}"),
                _ => continue,
            };
            let found = format!("{what} ({vendor}:{product}) at /{node}");
            out.push(if os::may_read_and_write(&self.root.join(&node)) {
                Finding::new("USB projector", Severity::Ok, found, "")
            } else {
                Finding::new(
                    "USB projector",
                    Severity::Missing,
                    format!("{found}: no permission"),
                    udev_rule(&vendor, &product),
                )
            });
        }
        if out.iter().all(|f| f.name != "USB projector") {
            out.push(Finding::new("USB projector", Severity::Info, "none plugged in", ""));
        }
        out
    }

    /// Names of serial ports in `dev`.
    fn ports(&self) -> Vec<String> {
        let is_port = |name: &String| ["ttyUSB", "ttyACM", "ttyAMA"].iter().any(|p| name.starts_with(p));
        self.names("dev").into_iter().filter(is_port).collect()
    }

    fn serial_ports(&self) -> Finding {
        let ports = self.ports();
        if ports.is_empty() {
            return Finding::new("serial ports", Severity::Info, "none", "");
        }
        let barred: Vec<&String> =
            ports.iter().filter(|p| !os::may_read_and_write(&self.root.join("dev").join(p))).collect();
        let found = ports.iter().map(|p| format!("/dev/{p}")).collect::<Vec<_>>().join(", ");
        if barred.is_empty() {
            Finding::new("serial ports", Severity::Ok, found, "")
        } else {
            let remedy = "no permission: usermod -aG dialout $USER, then log in again";
            Finding::new("serial ports", Severity::Missing, found, remedy)
        }
    }
}

/// The device files of this machine's serial ports.
pub(super) fn serial_ports() -> Vec<String> {
    System::this().ports().iter().map(|name| format!("/dev/{name}")).collect()
}

/// The name of a USB device with these ids (four hexadecimal digits each), if it is a projector that this program
/// drives.
fn known_projector(vendor: &str, product: &str) -> Option<&'static str> {
    let number = |text: &str| u16::from_str_radix(text, 16).ok();
    let asked = (number(vendor)?, number(product)?);
    let devices = dpm_rig::projectors::kinds().into_iter().filter_map(|kind| kind.usb);
    devices.into_iter().find(|(vendor, product, _)| (*vendor, *product) == asked).map(|(.., name)| name)
}

fn udev_rule(vendor: &str, product: &str) -> String {
    format!(
        "put `SUBSYSTEM==\"usb\", ATTR{{idVendor}}==\"{vendor}\", ATTR{{idProduct}}==\"{product}\", TAG+=\"uaccess\"` into \
         /etc/udev/rules.d/70-dpm.rules, then: udevadm control --reload, and plug it in again"
    )
}

fn table(findings: &[Finding]) -> String {
    let width = findings.iter().map(|f| f.name.len()).max().unwrap_or(0);
    let mut out = String::new();
    for f in findings {
        let state = match f.state {
            Severity::Ok => "ok     ",
            Severity::Warning => "warning",
            Severity::Missing => "MISSING",
            Severity::Info => "       ",
        };
        out += &format!("{state}  {:width$}  {}\n", f.name, f.found);
        if !f.remedy.is_empty() {
            out += &format!("         {:width$}  -> {}\n", "", f.remedy);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Root(PathBuf);

    impl Root {
        fn new(name: &str, files: &[(&str, &str)]) -> (Self, System) {
            crate::satellites::register();
            let root = std::env::temp_dir().join(format!("dpm-doctor-{}-{name}", std::process::id()));
            for (path, text) in files {
                let path = root.join(path);
                fs::create_dir_all(path.parent().unwrap_or(std::path::Path::new("/"))).unwrap();
                fs::write(path, text).unwrap();
            }
            (Self(root.clone()), System { root })
        }
    }

    impl Drop for Root {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn throttling_names_the_gap() {
        let files = |runtime| {
            [
                ("proc/sys/kernel/sched_rt_runtime_us", runtime),
                ("proc/sys/kernel/sched_rt_period_us", "1000000\n"),
            ]
        };
        let (_root, system) = Root::new("throttled", &files("950000\n"));
        let finding = system.throttling().unwrap();
        assert_eq!(finding.state, Severity::Warning);
        assert!(finding.found.contains("50 ms in every 1000 ms"), "{}", finding.found);
        let (_root, system) = Root::new("free", &files("-1\n"));
        assert_eq!(system.throttling().unwrap().state, Severity::Ok);
    }

    /// Found in use: the doctor looked for USB ids that no projector of the link has.
    #[test]
    fn a_projector_is_known_by_the_numbers_that_its_driver_opens() {
        use dpm_device::transport::usb as link;
        crate::satellites::register();
        let known =
            |vendor: u16, product: u16| known_projector(&format!("{vendor:04x}"), &format!("{product:04x}"));
        assert_eq!(known(link::VENDOR_ID, link::PRODUCT_ID), Some("bit-plane projector"));
        let numbers: Vec<_> = dpm_rig::projectors::kinds().iter().filter_map(|kind| kind.usb).collect();
        assert!(numbers.len() > 1, "{numbers:?}");
        for (vendor, product, name) in numbers {
            assert_eq!(known(vendor, product), Some(name));
        }
        assert_eq!(known(link::VENDOR_ID, link::PRODUCT_ID + 1), None);
        assert_eq!(known_projector("", "000d"), None);
    }

    #[test]
    fn usb_memory_is_counted_in_frames_and_projectors_are_found() {
        let (_root, system) = Root::new(
            "usb",
            &[
                ("sys/module/usbcore/parameters/usbfs_memory_mb", "16\n"),
                ("sys/bus/usb/devices/1-2/idVendor", "0451\n"),
                ("sys/bus/usb/devices/1-2/idProduct", "c900\n"),
                ("sys/bus/usb/devices/1-2/busnum", "1\n"),
                ("sys/bus/usb/devices/1-2/devnum", "7\n"),
                ("sys/bus/usb/devices/1-3/idVendor", "046d\n"),
                ("sys/bus/usb/devices/1-3/idProduct", "c077\n"),
                ("dev/bus/usb/001/007", ""),
            ],
        );
        let findings = system.usb();
        assert_eq!(findings.len(), 2, "{findings:?}");
        assert!(findings[0].found.contains("16: 6 frames"), "{}", findings[0].found);
        assert_eq!((findings[0].state, findings[1].state), (Severity::Warning, Severity::Ok));
        assert!(findings[1].found.contains("TI DLPC900 (0451:c900) at /dev/bus/usb/001/007"));
    }

    #[test]
    fn a_projector_without_permission_gets_its_udev_rule() {
        let (_root, system) = Root::new(
            "barred",
            &[
                ("sys/bus/usb/devices/1-2/idVendor", "0451\n"),
                ("sys/bus/usb/devices/1-2/idProduct", "c900\n"),
                ("sys/bus/usb/devices/1-2/busnum", "1\n"),
                ("sys/bus/usb/devices/1-2/devnum", "9\n"),
                ("dev/bus/usb/001/001", ""),
            ],
        );
        // The device node does not exist, which counts as inaccessible, like one without permission (also for root).
        let findings = system.usb();
        assert_eq!(findings[0].state, Severity::Missing);
        assert!(findings[0].remedy.contains("ATTR{idProduct}==\"c900\", TAG+=\"uaccess\""));
    }

    #[test]
    fn a_machine_without_anything_is_told_so() {
        let (_root, system) = Root::new("bare", &[("dev/null", "")]);
        assert!(system.throttling().is_none() && system.governor().is_none() && system.clock().is_none());
        assert_eq!(system.usb()[0].state, Severity::Info);
        assert_eq!(system.serial_ports().found, "none");
    }

    #[test]
    fn a_refused_right_says_what_to_set() {
        let refusal = RightRefusal {
            what: "SCHED_FIFO priority 80".into(),
            reason: "Operation not permitted".into(),
            remedy: "set rtprio".into(),
        };
        let finding = right("real-time priority", "granted", Err(refusal));
        assert_eq!(finding.state, Severity::Warning);
        assert!(finding.found.contains("priority 80 was refused (Operation not permitted)"));
        assert_eq!(finding.remedy, "set rtprio");
        assert_eq!(right("x", "granted", Ok(())).state, Severity::Ok);
        let refusal = RightRefusal { what: "awake".into(), reason: "denied".into(), remedy: "a rule".into() };
        let states = [Ok(true), Ok(false), Err(refusal)].map(|tried| idle_cores(tried).state);
        assert_eq!(states, [Severity::Ok, Severity::Info, Severity::Warning]);
    }

    #[test]
    fn serial_ports_are_listed_but_not_other_terminals() {
        let (_root, system) =
            Root::new("serial", &[("dev/ttyUSB0", ""), ("dev/ttyACM3", ""), ("dev/tty7", "")]);
        let finding = system.serial_ports();
        assert_eq!((finding.state, finding.found.as_str()), (Severity::Ok, "/dev/ttyACM3, /dev/ttyUSB0"));
    }
}
