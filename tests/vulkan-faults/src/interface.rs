//! What the Vulkan loader and its layers say to each other (`vk_layer.h`, which the registry does not hold), and the two C functions by
//! which a test in the same process speaks to the layer.
#![allow(unsafe_code)]

use ash::vk;
use std::ffi::{c_char, c_int, c_void, CStr};

/// `VK_LAYER_LINK_INFO`.
pub(crate) const LINK_INFO: c_int = 0;
/// `VK_LOADER_DATA_CALLBACK`.
pub(crate) const LOADER_DATA_CALLBACK: c_int = 1;

/// `VkNegotiateLayerInterface`.
#[repr(C)]
pub(crate) struct NegotiateInterface {
    s_type: c_int,
    p_next: *mut c_void,
    version: u32,
    get_instance_proc_addr: Option<vk::PFN_vkGetInstanceProcAddr>,
    get_device_proc_addr: Option<vk::PFN_vkGetDeviceProcAddr>,
    get_physical_device_proc_addr: Option<vk::PFN_vkGetInstanceProcAddr>,
}

/// `VkLayerInstanceLink`.
#[repr(C)]
pub(crate) struct InstanceLink {
    pub next: *mut InstanceLink,
    pub get_instance_proc_addr: vk::PFN_vkGetInstanceProcAddr,
    pub get_physical_device_proc_addr: Option<vk::PFN_vkGetInstanceProcAddr>,
}

/// `VkLayerDeviceLink`.
#[repr(C)]
pub(crate) struct DeviceLink {
    pub next: *mut DeviceLink,
    pub get_instance_proc_addr: vk::PFN_vkGetInstanceProcAddr,
    pub get_device_proc_addr: vk::PFN_vkGetDeviceProcAddr,
}

/// `VkLayerInstanceCreateInfo` and `VkLayerDeviceCreateInfo`, whose unions are pointers in every case that is read here.
#[repr(C)]
pub(crate) struct LayerCreateInfo {
    s_type: vk::StructureType,
    p_next: *const c_void,
    function: c_int,
    pub u: *mut c_void,
}

/// Every structure that may be chained to another one begins so.
#[repr(C)]
struct Chained {
    s_type: vk::StructureType,
    p_next: *const c_void,
}

/// The loader's structure of a kind in a chain.
///
/// # Safety
/// `p_next` is the chain of a valid create info that the loader handed to a layer.
pub(crate) unsafe fn find_in_chain(
    mut p_next: *const c_void,
    s_type: vk::StructureType,
    function: c_int,
) -> Option<*mut LayerCreateInfo> {
    while !p_next.is_null() {
        // SAFETY: every chained structure begins with its type and the next pointer.
        let head = unsafe { &*p_next.cast::<Chained>() };
        if head.s_type == s_type {
            let info = p_next.cast::<LayerCreateInfo>().cast_mut();
            // SAFETY: this type is the loader's own structure.
            if unsafe { (*info).function } == function {
                return Some(info);
            }
        }
        p_next = head.p_next;
    }
    None
}

/// The first call of the loader: which functions of this library it may ask for.
///
/// # Safety
/// Called by the loader with a valid structure.
#[no_mangle]
#[allow(non_snake_case)]
pub(crate) unsafe extern "system" fn vkNegotiateLoaderLayerInterfaceVersion(
    interface: *mut NegotiateInterface,
) -> vk::Result {
    // SAFETY: see above; null is checked.
    let Some(interface) = (unsafe { interface.as_mut() }) else {
        return vk::Result::ERROR_INITIALIZATION_FAILED;
    };
    if interface.version < 2 {
        return vk::Result::ERROR_INITIALIZATION_FAILED;
    }
    stay_loaded();
    interface.version = 2;
    interface.get_instance_proc_addr = Some(crate::layer::get_instance_proc_addr);
    interface.get_device_proc_addr = Some(crate::layer::get_device_proc_addr);
    interface.get_physical_device_proc_addr = None;
    vk::Result::SUCCESS
}

/// The loader unloads its layers with the last instance; what was counted must outlive that, or a fault that strikes once would strike a
/// device that was opened anew.
fn stay_loaded() {
    let mut info = std::mem::MaybeUninit::<libc::Dl_info>::zeroed();
    // SAFETY: the address lies in this library; `info` is filled where dladdr succeeds. RTLD_NODELETE keeps what is mapped already.
    unsafe {
        let here = stay_loaded as fn() as *const c_void;
        if libc::dladdr(here, info.as_mut_ptr()) != 0 {
            let path = info.assume_init().dli_fname;
            libc::dlopen(path, libc::RTLD_LAZY | libc::RTLD_NODELETE | libc::RTLD_NOLOAD);
        }
    }
}

/// Reads CLOCK_MONOTONIC.
pub(crate) fn read_monotonic_clock(t: &mut libc::timespec) {
    // SAFETY: plain query into a structure that we own.
    unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, t) };
}

/// Puts a plan in force: 0 when it is understood, else -1.
///
/// # Safety
/// `text` is a C string.
#[no_mangle]
pub(crate) unsafe extern "C" fn dpm_vk_faults_set(text: *const c_char) -> c_int {
    // SAFETY: see above.
    let text = unsafe { CStr::from_ptr(text) }.to_string_lossy();
    if crate::state::replace(&text) {
        0
    } else {
        -1
    }
}

/// Calls with this word since the plan was given; [`u64::MAX`] for a word that is none.
///
/// # Safety
/// `word` is a C string.
#[no_mangle]
pub(crate) unsafe extern "C" fn dpm_vk_faults_count(word: *const c_char) -> u64 {
    // SAFETY: see above.
    let word = unsafe { CStr::from_ptr(word) }.to_string_lossy();
    crate::state::count(&word).unwrap_or(u64::MAX)
}

/// The two functions above in the library as the loader has it, which is not the copy that is linked into a test.
#[derive(Clone, Copy)]
pub(crate) struct Loaded {
    set: unsafe extern "C" fn(*const c_char) -> c_int,
    count: unsafe extern "C" fn(*const c_char) -> u64,
}

impl Loaded {
    /// Opens the library; it stays open.
    pub(crate) fn open(path: &CStr) -> Option<Self> {
        // SAFETY: the library is this crate's, and the two symbols have the types above; both are checked for null.
        unsafe {
            let library = libc::dlopen(path.as_ptr(), libc::RTLD_NOW | libc::RTLD_LOCAL);
            if library.is_null() {
                return None;
            }
            let set = libc::dlsym(library, c"dpm_vk_faults_set".as_ptr());
            let count = libc::dlsym(library, c"dpm_vk_faults_count".as_ptr());
            if set.is_null() || count.is_null() {
                return None;
            }
            Some(Self {
                set: std::mem::transmute::<*mut c_void, unsafe extern "C" fn(*const c_char) -> c_int>(set),
                count: std::mem::transmute::<*mut c_void, unsafe extern "C" fn(*const c_char) -> u64>(count),
            })
        }
    }

    /// Puts a plan in force; false when it is not understood.
    pub(crate) fn set(self, text: &CStr) -> bool {
        // SAFETY: a C string.
        unsafe { (self.set)(text.as_ptr()) == 0 }
    }

    /// Calls with this word since then.
    pub(crate) fn count(self, word: &CStr) -> u64 {
        // SAFETY: a C string.
        unsafe { (self.count)(word.as_ptr()) }
    }
}
