//! Picks a device and opens it.

use super::error::{Context as _, GpuError};
use ash::{ext, khr, vk};
use std::ffi::{c_void, CStr, CString};
use std::mem::ManuallyDrop;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// How to open the GPU.
#[derive(Clone, Debug, Default)]
pub struct GpuOptions {
    /// Validation layers with synchronisation validation; ignored with a message when they are not installed.
    pub validation: bool,
    /// Part of the name of the device to use; `None`: the fastest kind there is.
    pub device: Option<String>,
}

/// A device as `dpm doctor` lists it.
#[derive(Clone, Debug)]
pub struct DeviceSummary {
    /// The driver's name for it.
    pub name: String,
    /// Driver name and version text.
    pub driver: String,
    /// Vulkan version.
    pub api_version: String,
    /// Runs on the CPU.
    pub software: bool,
    /// Why dpm cannot use it, if so.
    pub refused: Option<String>,
    /// Ray queries are there.
    pub ray_query: bool,
    /// Device-local memory in MiB.
    pub memory_mib: u64,
    /// Nanoseconds per time-stamp tick; 0: no time stamps.
    pub timestamp_period_ns: f32,
    /// Lanes in a subgroup.
    pub subgroup_size: u32,
}

static VALIDATION_COUNT: AtomicU64 = AtomicU64::new(0);
static VALIDATION_TEXT: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Number of validation messages (warnings and errors) in this process so far, and the first few of them.
pub fn validation_messages() -> (u64, Vec<String>) {
    let text = VALIDATION_TEXT.lock().map(|t| t.clone()).unwrap_or_default();
    (VALIDATION_COUNT.load(Ordering::Relaxed), text)
}

/// # Safety
/// Called by the validation layer with a valid message for the duration of the call.
unsafe extern "system" fn on_message(
    _severity: vk::DebugUtilsMessageSeverityFlagsEXT,
    _kind: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    _user: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes a valid structure; the message may be null.
    let text = unsafe {
        data.as_ref()
            .filter(|d| !d.p_message.is_null())
            .map(|d| CStr::from_ptr(d.p_message).to_string_lossy().into_owned())
    };
    if let Some(text) = text {
        if VALIDATION_COUNT.fetch_add(1, Ordering::Relaxed) < 16 {
            if let Ok(mut all) = VALIDATION_TEXT.lock() {
                all.push(text);
            }
        }
    }
    vk::FALSE
}

/// An open device. Shared by everything made from it; closed when the last of them is gone.
pub struct Gpu {
    pub(super) device: ash::Device,
    pub(super) queue: Mutex<vk::Queue>,
    pub(super) queue_family: u32,
    pub(super) memory: vk::PhysicalDeviceMemoryProperties,
    pub(super) limits: vk::PhysicalDeviceLimits,
    summary: DeviceSummary,
    debug: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    instance: ash::Instance,
    entry: ManuallyDrop<ash::Entry>,
    /// The device did not finish in time: it may use everything it was given for as long as it likes, so nothing is taken from it any more.
    abandoned: AtomicBool,
}

impl std::fmt::Debug for Gpu {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Gpu").field("device", &self.summary.name).finish()
    }
}

fn load() -> Result<ash::Entry, GpuError> {
    // SAFETY: loading libvulkan runs its initialisers; it is the system's loader.
    unsafe { ash::Entry::load() }.map_err(|e| GpuError::NoLoader(e.to_string()))
}

fn version_text(v: u32) -> String {
    format!("{}.{}.{}", vk::api_version_major(v), vk::api_version_minor(v), vk::api_version_patch(v))
}

fn create_instance(
    entry: &ash::Entry,
    validation: bool,
) -> Result<(ash::Instance, Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>), GpuError> {
    let application =
        vk::ApplicationInfo::default().application_name(c"dpm").api_version(vk::make_api_version(0, 1, 2, 0));
    let layer = c"VK_LAYER_KHRONOS_validation";
    // SAFETY: plain enumeration.
    let layers = unsafe { entry.enumerate_instance_layer_properties() }.unwrap_or_default();
    let have_layer = layers.iter().any(|l| l.layer_name_as_c_str() == Ok(layer));
    let validate = validation && have_layer;
    if validation && !have_layer {
        tracing::warn!(
            "validation asked for, but the layer is not installed (apt-get install vulkan-validationlayers)"
        );
    }
    let layer_names = if validate { vec![layer.as_ptr()] } else { vec![] };
    let extensions = if validate { vec![ext::debug_utils::NAME.as_ptr()] } else { vec![] };
    let enable = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&enable);
    let mut info = vk::InstanceCreateInfo::default()
        .application_info(&application)
        .enabled_layer_names(&layer_names)
        .enabled_extension_names(&extensions);
    if validate {
        info = info.push_next(&mut features);
    }
    // SAFETY: `info` and what it points to live until the call returns.
    let instance = unsafe { entry.create_instance(&info, None) }.map_err(|e| match e {
        vk::Result::ERROR_INCOMPATIBLE_DRIVER => GpuError::NoDriver(format!("{e:?}")),
        result => GpuError::Vulkan { operation: "creating the Vulkan instance", result },
    })?;
    let debug = if validate {
        let loader = ext::debug_utils::Instance::new(entry, &instance);
        let info = vk::DebugUtilsMessengerCreateInfoEXT::default()
            .message_severity(
                vk::DebugUtilsMessageSeverityFlagsEXT::ERROR | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING,
            )
            .message_type(
                vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION
                    | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE,
            )
            .pfn_user_callback(Some(on_message));
        // SAFETY: the callback is a plain function that outlives the instance.
        let messenger = unsafe { loader.create_debug_utils_messenger(&info, None) }
            .context("creating the debug messenger")?;
        Some((loader, messenger))
    } else {
        None
    };
    Ok((instance, debug))
}

/// Features that every shader relies on.
fn missing_features(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Option<String> {
    let mut scalar = vk::PhysicalDeviceScalarBlockLayoutFeatures::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut scalar);
    // SAFETY: `features` chains valid structures.
    unsafe { instance.get_physical_device_features2(physical, &mut features) };
    // SAFETY: plain query.
    let props = unsafe { instance.get_physical_device_properties(physical) };
    let mut missing = Vec::new();
    if props.api_version < vk::make_api_version(0, 1, 2, 0) {
        missing.push(format!("Vulkan 1.2 (has {})", version_text(props.api_version)));
    }
    if scalar.scalar_block_layout == 0 {
        missing.push("scalarBlockLayout".to_owned());
    }
    if compute_family(instance, physical).is_none() {
        missing.push("a compute queue".to_owned());
    }
    (!missing.is_empty()).then(|| format!("lacks {}", missing.join(", ")))
}

fn compute_family(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Option<u32> {
    // SAFETY: plain query.
    let families = unsafe { instance.get_physical_device_queue_family_properties(physical) };
    let compute = |f: &vk::QueueFamilyProperties| f.queue_flags.contains(vk::QueueFlags::COMPUTE);
    // A family without graphics is not disturbed by a desktop.
    families
        .iter()
        .position(|f| {
            compute(f) && !f.queue_flags.contains(vk::QueueFlags::GRAPHICS) && f.timestamp_valid_bits > 0
        })
        .or_else(|| families.iter().position(compute))
        .map(|i| i as u32)
}

fn summarise(instance: &ash::Instance, physical: vk::PhysicalDevice) -> DeviceSummary {
    let mut driver = vk::PhysicalDeviceDriverProperties::default();
    let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
    let mut props = vk::PhysicalDeviceProperties2::default().push_next(&mut driver).push_next(&mut subgroup);
    // SAFETY: `props` chains valid structures; the rest are plain queries.
    unsafe { instance.get_physical_device_properties2(physical, &mut props) };
    let base = props.properties;
    // SAFETY: plain query.
    let memory = unsafe { instance.get_physical_device_memory_properties(physical) };
    // SAFETY: plain query.
    let extensions = unsafe { instance.enumerate_device_extension_properties(physical) }.unwrap_or_default();
    let text = |r: Result<&CStr, _>| r.map(|c: &CStr| c.to_string_lossy().into_owned()).unwrap_or_default();
    DeviceSummary {
        name: text(base.device_name_as_c_str().map_err(|_| ())),
        driver: format!(
            "{} {}",
            text(driver.driver_name_as_c_str().map_err(|_| ())),
            text(driver.driver_info_as_c_str().map_err(|_| ()))
        ),
        api_version: version_text(base.api_version),
        software: base.device_type == vk::PhysicalDeviceType::CPU,
        refused: missing_features(instance, physical),
        ray_query: extensions.iter().any(|e| e.extension_name_as_c_str() == Ok(khr::ray_query::NAME)),
        memory_mib: memory.memory_heaps[..memory.memory_heap_count as usize]
            .iter()
            .filter(|h| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL))
            .map(|h| h.size >> 20)
            .max()
            .unwrap_or(0),
        timestamp_period_ns: if base.limits.timestamp_compute_and_graphics != 0 {
            base.limits.timestamp_period
        } else {
            0.0
        },
        subgroup_size: subgroup.subgroup_size,
    }
}

impl Gpu {
    /// All devices that the loader knows.
    ///
    /// # Errors
    /// [`GpuError::NoLoader`], [`GpuError::NoDriver`].
    pub fn list() -> Result<Vec<DeviceSummary>, GpuError> {
        let entry = load()?;
        let (instance, _) = create_instance(&entry, false)?;
        // SAFETY: the instance lives until the end of this function and nothing made from it does longer.
        unsafe {
            let all = instance.enumerate_physical_devices().context("listing Vulkan devices")?;
            let out = all.iter().map(|&p| summarise(&instance, p)).collect();
            instance.destroy_instance(None);
            Ok(out)
        }
    }

    /// Opens a device: discrete before integrated before software, or the one whose name contains `options.device`.
    ///
    /// # Errors
    /// No loader, no driver, no device that has what is needed (the text lists them), or Vulkan's own.
    pub fn open(options: &GpuOptions) -> Result<Arc<Self>, GpuError> {
        let entry = load()?;
        let (instance, debug) = create_instance(&entry, options.validation)?;
        // SAFETY: plain enumeration.
        let all = unsafe { instance.enumerate_physical_devices() }.context("listing Vulkan devices")?;
        let mut candidates: Vec<_> = all.iter().map(|&p| (p, summarise(&instance, p))).collect();
        let found = candidates
            .iter()
            .map(|(_, s)| format!("{} ({})", s.name, s.refused.as_deref().unwrap_or("usable")))
            .collect::<Vec<_>>()
            .join("; ");
        if candidates.is_empty() {
            return Err(GpuError::NoDriver("the loader lists no device".into()));
        }
        candidates.retain(|(_, s)| {
            s.refused.is_none()
                && options
                    .device
                    .as_ref()
                    .is_none_or(|want| s.name.to_lowercase().contains(&want.to_lowercase()))
        });
        let rank = |p: vk::PhysicalDevice| {
            // SAFETY: plain query.
            match unsafe { instance.get_physical_device_properties(p) }.device_type {
                vk::PhysicalDeviceType::DISCRETE_GPU => 0,
                vk::PhysicalDeviceType::VIRTUAL_GPU => 1,
                vk::PhysicalDeviceType::INTEGRATED_GPU => 2,
                _ => 3,
            }
        };
        candidates.sort_by_key(|&(p, _)| rank(p));
        let Some((physical, summary)) = candidates.into_iter().next() else {
            let name = options
                .device
                .as_ref()
                .map_or(String::new(), |d| format!(" and a name that contains \"{d}\""));
            return Err(GpuError::NoDevice {
                found,
                needed: format!("Vulkan 1.2 with scalarBlockLayout{name}"),
            });
        };
        let queue_family = compute_family(&instance, physical)
            .ok_or_else(|| GpuError::NoDevice { found, needed: "a compute queue".into() })?;
        let priorities = [1.0];
        let queues = [vk::DeviceQueueCreateInfo::default()
            .queue_family_index(queue_family)
            .queue_priorities(&priorities)];
        let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default().scalar_block_layout(true);
        let info = vk::DeviceCreateInfo::default().queue_create_infos(&queues).push_next(&mut vulkan12);
        // SAFETY: `info` and what it points to live until the call returns.
        let device =
            unsafe { instance.create_device(physical, &info, None) }.context("opening the Vulkan device")?;
        // SAFETY: family and index were asked for above.
        let queue = unsafe { device.get_device_queue(queue_family, 0) };
        // SAFETY: plain queries.
        let (memory, limits) = unsafe {
            (
                instance.get_physical_device_memory_properties(physical),
                instance.get_physical_device_properties(physical).limits,
            )
        };
        Ok(Arc::new(Self {
            device,
            queue: Mutex::new(queue),
            queue_family,
            memory,
            limits,
            summary,
            debug,
            instance,
            entry: ManuallyDrop::new(entry),
            abandoned: AtomicBool::new(false),
        }))
    }

    /// What this device is.
    pub fn summary(&self) -> &DeviceSummary {
        &self.summary
    }

    /// Most elements of a texel buffer.
    pub fn max_texel_elements(&self) -> u64 {
        u64::from(self.limits.max_texel_buffer_elements)
    }

    /// Largest buffer that shaders can be given whole, bytes: as storage, and on software Vulkan also as texels of 16 bytes.
    pub fn max_buffer_bytes(&self) -> u64 {
        let storage = u64::from(self.limits.max_storage_buffer_range);
        if self.summary.software {
            storage.min(self.max_texel_elements() * 16)
        } else {
            storage
        }
    }

    pub(super) fn name(text: &str) -> CString {
        CString::new(text).unwrap_or_default()
    }
}

impl Gpu {
    /// Leaves the device what it holds: a submission is not over and nobody waits for it any longer.
    pub(super) fn abandon(&self) {
        self.abandoned.store(true, Ordering::Relaxed);
    }

    /// True when nothing of this device may be destroyed.
    pub(super) fn is_abandoned(&self) -> bool {
        self.abandoned.load(Ordering::Relaxed)
    }
}

impl Drop for Gpu {
    fn drop(&mut self) {
        if self.is_abandoned() {
            return;
        }
        // SAFETY: everything made from the device holds an Arc to this, so it is all gone; the loader goes last.
        unsafe {
            let _ = self.device.device_wait_idle();
            self.device.destroy_device(None);
            if let Some((loader, messenger)) = &self.debug {
                loader.destroy_debug_utils_messenger(*messenger, None);
            }
            self.instance.destroy_instance(None);
            ManuallyDrop::drop(&mut self.entry);
        }
    }
}
