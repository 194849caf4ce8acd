//! The loader of Vulkan, with the validation layer and what it says.

use super::error::GpuError;
use ash::{ext, vk};
use std::ffi::{c_void, CStr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::Mutex;

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

/// An instance with its messenger and the loader, destroyed in this order.
pub(super) struct Instance {
    debug: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    pub(super) handle: ash::Instance,
    _entry: ash::Entry,
}

impl std::ops::Deref for Instance {
    type Target = ash::Instance;

    fn deref(&self) -> &ash::Instance {
        &self.handle
    }
}

impl Drop for Instance {
    fn drop(&mut self) {
        // SAFETY: devices made from it are gone (`Gpu` closes its own first), and the loader outlives this call.
        unsafe {
            if let Some((loader, messenger)) = &self.debug {
                loader.destroy_debug_utils_messenger(*messenger, None);
            }
            self.handle.destroy_instance(None);
        }
    }
}

fn load() -> Result<ash::Entry, GpuError> {
    // SAFETY: loading libvulkan runs its initialisers; it is the system's loader.
    unsafe { ash::Entry::load() }.map_err(|e| GpuError::NoLoader(e.to_string()))
}

/// The loader with an instance; with the validation layer if it is asked for and installed.
///
/// # Errors
/// There is no loader, or no driver.
pub(super) fn create_instance(validation: bool) -> Result<Instance, GpuError> {
    let entry = load()?;
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
    let handle = unsafe { entry.create_instance(&info, None) }.map_err(|e| match e {
        vk::Result::ERROR_INCOMPATIBLE_DRIVER => {
            GpuError::NoDriver(format!("{e:?}: {}", super::manifests::told()))
        }
        result => GpuError::without_device("creating the Vulkan instance")(result),
    })?;
    let mut instance = Instance { debug: None, handle, _entry: entry };
    if validate {
        let loader = ext::debug_utils::Instance::new(&instance._entry, &instance.handle);
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
            .map_err(GpuError::without_device("creating the debug messenger"))?;
        instance.debug = Some((loader, messenger));
    }
    Ok(instance)
}
