//! Vulkan results into messages an operator can act on.

use ash::vk;
use std::sync::Arc;

/// What went wrong with the GPU: during which operation, on which device, and what to do.
#[derive(Clone, Debug, thiserror::Error)]
pub enum GpuError {
    /// libvulkan is not installed.
    #[error(
        "no Vulkan loader: {0}. Install it (Debian, Ubuntu: apt-get install libvulkan1 mesa-vulkan-drivers)"
    )]
    NoLoader(String),
    /// The loader found no driver that starts.
    #[error(
        "no Vulkan driver works: {0}. Install your GPU vendor's driver, or software Vulkan (Debian, Ubuntu: apt-get install \
         mesa-vulkan-drivers); VK_ICD_FILENAMES and VK_DRIVER_FILES, if set, must name existing files"
    )]
    NoDriver(String),
    /// There are drivers, but no usable device.
    #[error("no usable Vulkan device. Found: {found}. Needed: {needed}")]
    NoDevice {
        /// Devices and why each was refused.
        found: String,
        /// What dpm needs.
        needed: String,
    },
    /// The process may not use as much address space as software Vulkan needs, which would crash without it.
    #[error(
        "{device} runs on the CPU and needs {needed_mib} MiB of address space, but this process is limited to {limit_mib} MiB \
         (RLIMIT_AS). Raise the limit (`ulimit -v unlimited`; as a service: LimitAS=infinity), or use a hardware GPU"
    )]
    AddressSpace {
        /// The software device.
        device: Arc<str>,
        /// Address space that it needs together with what the process uses already.
        needed_mib: u64,
        /// The limit of the process.
        limit_mib: u64,
    },
    /// Memory ran out.
    #[error(
        "out of {pool} memory on {device} while {operation}{}. Use a smaller scene, fewer textures or a smaller raster, or end other \
         programs that use it",
        needs(*needed_mib, *heap_mib)
    )]
    OutOfMemory {
        /// What was being done, with the name of the buffer if there is one.
        operation: String,
        /// On which device.
        device: Arc<str>,
        /// Whose memory.
        pool: MemoryPool,
        /// Size asked for; `None` where the driver wanted memory for itself.
        needed_mib: Option<u64>,
        /// Size of the device's largest heap.
        heap_mib: u64,
    },
    /// The device cannot find itself what a ray meets.
    #[error(
        "{device} has no ray query (VK_KHR_ray_query with acceleration structures). Set render.tracing to \"auto\" or to \"walk\", or \
         choose another device with render.gpu"
    )]
    NoRayQuery {
        /// Which device.
        device: Arc<str>,
    },
    /// A limit of the device is too small.
    #[error("{what}: {needed} is beyond this device's limit of {limit}; {}", smaller(what))]
    Limit {
        /// What is too large.
        what: String,
        /// Wanted.
        needed: u64,
        /// Allowed.
        limit: u64,
    },
    /// The wait ended before the GPU had finished. The device is not lost: wait again, or give it up ([`super::Gpu::give_up`]).
    #[error(
        "{device} did not finish within {waited_ms} ms. It is too slow for this scene (lower render.spp or the raster), or it hangs \
         (see the kernel's log: dmesg)"
    )]
    Timeout {
        /// Which device.
        device: Arc<str>,
        /// How long the wait was.
        waited_ms: u64,
    },
    /// The driver reports that the device is lost. Nothing that was made from it works any more.
    #[error(
        "{device} was lost while {operation}: its driver gave it up (reset, unplugged, switched off, or a fault; the kernel's log tells \
         more: dmesg). It must be opened anew"
    )]
    DeviceLost {
        /// What was being done.
        operation: &'static str,
        /// Which device.
        device: Arc<str>,
    },
    /// The program gave the device up because it did not finish. The device is not used any more.
    #[error(
        "{device} was given up because it did not finish what it was given, and is not used for {operation}; see the kernel's log \
         (dmesg). It must be opened anew"
    )]
    GivenUp {
        /// What would have been done.
        operation: &'static str,
        /// Which device.
        device: Arc<str>,
    },
    /// The slot's last submission has not ended.
    #[error("a frame was submitted to {device} while the one before it in the same memory is still being made; wait for that first")]
    InFlight {
        /// Which device.
        device: Arc<str>,
    },
    /// A lost device could not be opened again, and there is no other one.
    #[error("{device} was lost and there is no other device to go on with: {tried}. Look at the kernel's log (dmesg), then start again")]
    NoneLeft {
        /// The device that was lost.
        device: Arc<str>,
        /// What was tried, and how each failed.
        tried: String,
    },
    /// Any other result.
    #[error("{operation} failed on {device}: {result:?}. Look at the kernel's log (dmesg); try another device with render.gpu")]
    Vulkan {
        /// What was being done.
        operation: &'static str,
        /// On which device.
        device: Arc<str>,
        /// Vulkan's code.
        result: vk::Result,
    },
}

/// Whose memory ran out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MemoryPool {
    /// The GPU's.
    Device,
    /// The computer's.
    Host,
}

impl std::fmt::Display for MemoryPool {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Device => "GPU",
            Self::Host => "main",
        })
    }
}

fn needs(needed_mib: Option<u64>, heap_mib: u64) -> String {
    match needed_mib {
        Some(needed) => format!(", which needs {needed} MiB; the largest heap has {heap_mib} MiB"),
        None => format!("; the largest heap has {heap_mib} MiB"),
    }
}

impl GpuError {
    /// What `result` means.
    /// The error of a call that does not concern a device yet.
    pub(super) fn without_device(operation: &'static str) -> impl Fn(vk::Result) -> Self {
        move |result| Self::from_result(result, operation, &"the Vulkan loader".into(), 0)
    }

    pub(super) fn from_result(
        result: vk::Result,
        operation: &'static str,
        device: &Arc<str>,
        heap_mib: u64,
    ) -> Self {
        let device = device.clone();
        let out_of = |pool, device| Self::OutOfMemory {
            operation: operation.to_owned(),
            device,
            pool,
            needed_mib: None,
            heap_mib,
        };
        match result {
            vk::Result::ERROR_DEVICE_LOST => Self::DeviceLost { operation, device },
            vk::Result::ERROR_OUT_OF_DEVICE_MEMORY => out_of(MemoryPool::Device, device),
            vk::Result::ERROR_OUT_OF_HOST_MEMORY => out_of(MemoryPool::Host, device),
            result => Self::Vulkan { operation, device, result },
        }
    }

    /// Whether the device is gone, so that only [`super::Gpu::reopen`] may help. False for a timeout, after which the caller may continue to wait.
    pub fn is_loss(&self) -> bool {
        matches!(self, Self::DeviceLost { .. } | Self::GivenUp { .. })
    }
}

/// What to do about a limit.
fn smaller(what: &str) -> &'static str {
    if what.starts_with("textures") {
        "use smaller or fewer textures, or another device with render.gpu"
    } else {
        "use a smaller scene or a smaller raster"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Found in use (R12): when a GPU fails, every message names the device and the operation.
    #[test]
    fn every_failure_names_device_and_operation_and_only_a_loss_is_one() {
        let device: Arc<str> = "Some GPU".into();
        let of = |result| GpuError::from_result(result, "submitting a frame", &device, 4096);
        for (result, word, loss) in [
            (vk::Result::ERROR_DEVICE_LOST, "lost", true),
            (vk::Result::ERROR_OUT_OF_DEVICE_MEMORY, "out of GPU memory", false),
            (vk::Result::ERROR_OUT_OF_HOST_MEMORY, "out of main memory", false),
            (vk::Result::ERROR_INITIALIZATION_FAILED, "ERROR_INITIALIZATION_FAILED", false),
        ] {
            let error = of(result);
            let text = error.to_string();
            for word in [word, "Some GPU", "submitting a frame"] {
                assert!(text.contains(word), "{word} in {text}");
            }
            assert_eq!(error.is_loss(), loss, "{text}");
        }
        let timeout = GpuError::Timeout { device: device.clone(), waited_ms: 100 };
        assert!(!timeout.is_loss() && timeout.to_string().contains("Some GPU"));
        let limit = |what: &str| GpuError::Limit { what: what.into(), needed: 2, limit: 1 }.to_string();
        assert!(limit("textures (bytes)").contains("smaller or fewer textures"));
        assert!(limit("history (bytes)").contains("a smaller raster"));
        let given_up = GpuError::GivenUp { operation: "submitting a frame", device };
        assert!(given_up.is_loss() && given_up.to_string().contains("Some GPU"));
    }
}
