//! The names of libudev that a distribution's libusb calls, answered from the fake bus: such a libusb enumerates and listens through
//! libudev instead of sysfs and netlink. Handles are boxes that the caller gives back with the matching `unref`.
#![allow(unsafe_code)]

use std::ffi::{c_char, c_int, c_void, CStr, CString};
use std::ptr::{null, null_mut};

use crate::{bus, hooks};

/// A USB device as libudev tells it.
pub(crate) struct Device {
    node: CString,
    name: CString,
    action: CString,
}

/// One name of a list, and the next.
pub(crate) struct Entry {
    name: CString,
    next: *const Entry,
}

/// A list of devices, made by a scan.
pub(crate) struct Enumerate {
    entries: Vec<Entry>,
}

/// The descriptor that hot-plug events arrive on.
pub(crate) struct Monitor {
    fd: c_int,
}

const DEVICES: &str = "/sys/bus/usb/devices/";

/// Names every function below, so that the linker keeps them in a preloaded library.
pub(crate) fn keep_linked() {
    let names: [*const (); 21] = [
        udev_new as *const (),
        udev_unref as *const (),
        udev_enumerate_new as *const (),
        udev_enumerate_unref as *const (),
        udev_enumerate_add_match_subsystem as *const (),
        udev_enumerate_add_match_property as *const (),
        udev_enumerate_scan_devices as *const (),
        udev_enumerate_get_list_entry as *const (),
        udev_list_entry_get_next as *const (),
        udev_list_entry_get_name as *const (),
        udev_device_new_from_syspath as *const (),
        udev_device_unref as *const (),
        udev_device_get_devnode as *const (),
        udev_device_get_sysname as *const (),
        udev_device_get_action as *const (),
        udev_monitor_new_from_netlink as *const (),
        udev_monitor_unref as *const (),
        udev_monitor_filter_add_match_subsystem_devtype as *const (),
        udev_monitor_enable_receiving as *const (),
        udev_monitor_get_fd as *const (),
        udev_monitor_receive_device as *const (),
    ];
    std::hint::black_box(names);
}

fn device(name: &str, bus: u8, address: u8, action: &str) -> *mut Device {
    let text = |s: String| CString::new(s).unwrap_or_default();
    let node = text(format!("/dev/bus/usb/{bus:03}/{address:03}"));
    Box::into_raw(Box::new(Device { node, name: text(name.into()), action: text(action.into()) }))
}

/// `udev_new(3)`: there is one library; a context needs no state.
#[no_mangle]
pub(crate) extern "C" fn udev_new() -> *mut c_void {
    crate::remote::attach_from_environment();
    std::ptr::NonNull::<u64>::dangling().as_ptr().cast()
}

/// `udev_unref(3)`.
#[no_mangle]
pub(crate) extern "C" fn udev_unref(_: *mut c_void) -> *mut c_void {
    null_mut()
}

/// `udev_enumerate_new(3)`.
#[no_mangle]
pub(crate) extern "C" fn udev_enumerate_new(_: *mut c_void) -> *mut Enumerate {
    Box::into_raw(Box::new(Enumerate { entries: Vec::new() }))
}

/// `udev_enumerate_unref(3)`.
///
/// # Safety
/// `list` is from [`udev_enumerate_new`] and is not used again.
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_enumerate_unref(list: *mut Enumerate) -> *mut Enumerate {
    if !list.is_null() {
        // SAFETY: by contract.
        drop(unsafe { Box::from_raw(list) });
    }
    null_mut()
}

/// `udev_enumerate_add_match_subsystem(3)`: there is only USB here.
#[no_mangle]
pub(crate) extern "C" fn udev_enumerate_add_match_subsystem(_: *mut Enumerate, _: *const c_char) -> c_int {
    0
}

/// `udev_enumerate_add_match_property(3)`: there are only whole devices here.
#[no_mangle]
pub(crate) extern "C" fn udev_enumerate_add_match_property(
    _: *mut Enumerate,
    _: *const c_char,
    _: *const c_char,
) -> c_int {
    0
}

/// `udev_enumerate_scan_devices(3)`.
///
/// # Safety
/// `list` is from [`udev_enumerate_new`]; entries of an earlier scan are not used again.
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_enumerate_scan_devices(list: *mut Enumerate) -> c_int {
    let names = bus::device_names();
    // SAFETY: by contract.
    let entries = unsafe { &mut (*list).entries };
    *entries = names
        .iter()
        .map(|n| Entry { name: CString::new(format!("{DEVICES}{n}")).unwrap_or_default(), next: null() })
        .collect();
    for k in 1..entries.len() {
        entries[k - 1].next = &entries[k];
    }
    0
}

/// `udev_enumerate_get_list_entry(3)`.
///
/// # Safety
/// `list` is from [`udev_enumerate_new`].
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_enumerate_get_list_entry(list: *mut Enumerate) -> *const Entry {
    // SAFETY: by contract.
    unsafe { (*list).entries.first().map_or(null(), std::ptr::from_ref) }
}

/// `udev_list_entry_get_next(3)`.
///
/// # Safety
/// `entry` belongs to a list that is still there.
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_list_entry_get_next(entry: *const Entry) -> *const Entry {
    // SAFETY: by contract.
    unsafe { entry.as_ref().map_or(null(), |e| e.next) }
}

/// `udev_list_entry_get_name(3)`.
///
/// # Safety
/// As [`udev_list_entry_get_next`].
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_list_entry_get_name(entry: *const Entry) -> *const c_char {
    // SAFETY: by contract.
    unsafe { entry.as_ref().map_or(null(), |e| e.name.as_ptr()) }
}

/// `udev_device_new_from_syspath(3)`.
///
/// # Safety
/// `path` is a C string.
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_device_new_from_syspath(
    _: *mut c_void,
    path: *const c_char,
) -> *mut Device {
    // SAFETY: by contract.
    let path = unsafe { CStr::from_ptr(path) }.to_string_lossy();
    let Some(name) = path.strip_prefix(DEVICES) else { return null_mut() };
    bus::place_of(name).map_or(null_mut(), |(bus, address)| device(name, bus, address, ""))
}

/// `udev_device_unref(3)`.
///
/// # Safety
/// `device` is from a function here and is not used again.
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_device_unref(device: *mut Device) -> *mut Device {
    if !device.is_null() {
        // SAFETY: by contract.
        drop(unsafe { Box::from_raw(device) });
    }
    null_mut()
}

/// `udev_device_get_devnode(3)`.
///
/// # Safety
/// `device` is from a function here.
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_device_get_devnode(device: *const Device) -> *const c_char {
    // SAFETY: by contract.
    unsafe { (*device).node.as_ptr() }
}

/// `udev_device_get_sysname(3)`.
///
/// # Safety
/// `device` is from a function here.
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_device_get_sysname(device: *const Device) -> *const c_char {
    // SAFETY: by contract.
    unsafe { (*device).name.as_ptr() }
}

/// `udev_device_get_action(3)`.
///
/// # Safety
/// `device` is from a function here.
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_device_get_action(device: *const Device) -> *const c_char {
    // SAFETY: by contract.
    unsafe { (*device).action.as_ptr() }
}

/// `udev_monitor_new_from_netlink(3)`.
#[no_mangle]
pub(crate) extern "C" fn udev_monitor_new_from_netlink(_: *mut c_void, _: *const c_char) -> *mut Monitor {
    let kind = libc::SOCK_DGRAM | libc::SOCK_NONBLOCK | libc::SOCK_CLOEXEC;
    match hooks::socket(libc::AF_NETLINK, kind, libc::NETLINK_KOBJECT_UEVENT) {
        fd if fd < 0 => null_mut(),
        fd => Box::into_raw(Box::new(Monitor { fd })),
    }
}

/// `udev_monitor_unref(3)`.
///
/// # Safety
/// `monitor` is from [`udev_monitor_new_from_netlink`] and is not used again.
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_monitor_unref(monitor: *mut Monitor) -> *mut Monitor {
    if !monitor.is_null() {
        // SAFETY: by contract.
        let monitor = unsafe { Box::from_raw(monitor) };
        hooks::close(monitor.fd);
    }
    null_mut()
}

/// `udev_monitor_filter_add_match_subsystem_devtype(3)`: only USB devices are told of here.
#[no_mangle]
pub(crate) extern "C" fn udev_monitor_filter_add_match_subsystem_devtype(
    _: *mut Monitor,
    _: *const c_char,
    _: *const c_char,
) -> c_int {
    0
}

/// `udev_monitor_enable_receiving(3)`.
#[no_mangle]
pub(crate) extern "C" fn udev_monitor_enable_receiving(_: *mut Monitor) -> c_int {
    0
}

/// `udev_monitor_get_fd(3)`.
///
/// # Safety
/// `monitor` is from [`udev_monitor_new_from_netlink`].
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_monitor_get_fd(monitor: *mut Monitor) -> c_int {
    // SAFETY: by contract.
    unsafe { (*monitor).fd }
}

/// `udev_monitor_receive_device(3)`: the device of the next event, or null.
///
/// # Safety
/// `monitor` is from [`udev_monitor_new_from_netlink`].
#[no_mangle]
pub(crate) unsafe extern "C" fn udev_monitor_receive_device(monitor: *mut Monitor) -> *mut Device {
    let mut message = [0u8; 1024];
    // SAFETY: by contract; the buffer is as long as said.
    let n =
        unsafe { libc::recv((*monitor).fd, message.as_mut_ptr().cast(), message.len(), libc::MSG_DONTWAIT) };
    let Ok(n) = usize::try_from(n) else { return null_mut() };
    let text = String::from_utf8_lossy(&message[..n]);
    let value = |key: &str| text.split('\0').find_map(|field| field.strip_prefix(key)?.strip_prefix('='));
    let name = value("DEVPATH").and_then(|p| p.rsplit('/').next());
    let number = |key: &str| value(key).and_then(|v| v.parse().ok());
    match (name, number("BUSNUM"), number("DEVNUM"), value("ACTION")) {
        (Some(name), Some(bus), Some(address), Some(action)) => device(name, bus, address, action),
        _ => null_mut(),
    }
}
