//! Vulkan results into messages an operator can act on.

use ash::vk;

/// What went wrong with the GPU.
#[derive(Debug, thiserror::Error)]
pub enum GpuError {
    /// libvulkan is not installed.
    #[error(
        "no Vulkan loader: {0}. Install it (Debian, Ubuntu: apt-get install libvulkan1 mesa-vulkan-drivers)"
    )]
    NoLoader(String),
    /// The loader found no driver.
    #[error(
        "no Vulkan driver: {0}. Install your GPU vendor's driver, or software Vulkan (Debian, Ubuntu: apt-get install \
         mesa-vulkan-drivers); VK_ICD_FILENAMES and VK_DRIVER_FILES, if set, must name existing files"
    )]
    NoDriver(String),
    /// Drivers exist but no device will do.
    #[error("no usable Vulkan device. Found: {found}. Needed: {needed}")]
    NoDevice {
        /// Devices and why each was refused.
        found: String,
        /// What dpm needs.
        needed: String,
    },
    /// Memory ran out.
    #[error("out of GPU memory: {what} needs {needed_mib} MiB; the largest heap has {heap_mib} MiB. Use a smaller scene, fewer textures or a smaller raster")]
    OutOfMemory {
        /// Buffer.
        what: String,
        /// Size asked for.
        needed_mib: u64,
        /// Size of the largest heap.
        heap_mib: u64,
    },
    /// A limit of the device is too small.
    #[error(
        "{what}: {needed} is beyond this device's limit of {limit}; use a smaller scene or a smaller raster"
    )]
    Limit {
        /// What is too large.
        what: String,
        /// Wanted.
        needed: u64,
        /// Allowed.
        limit: u64,
    },
    /// The wait ended before the GPU did. Not a loss: wait again or give up.
    #[error("the GPU did not finish within {0} ms")]
    Timeout(u64),
    /// The device is lost; everything made from it is dead.
    #[error("the GPU was lost while {0}; restart the renderer")]
    DeviceLost(&'static str),
    /// Any other result.
    #[error("{operation} failed: {result:?}")]
    Vulkan {
        /// What was being done.
        operation: &'static str,
        /// Vulkan's code.
        result: vk::Result,
    },
}

/// Attaches the operation to a Vulkan result.
pub(super) trait Context<T> {
    /// Converts, keeping device loss apart.
    fn context(self, operation: &'static str) -> Result<T, GpuError>;
}

impl<T> Context<T> for Result<T, vk::Result> {
    fn context(self, operation: &'static str) -> Result<T, GpuError> {
        self.map_err(|result| match result {
            vk::Result::ERROR_DEVICE_LOST => GpuError::DeviceLost(operation),
            result => GpuError::Vulkan { operation, result },
        })
    }
}
