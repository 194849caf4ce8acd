//! Every name of the C library by which a libusb, of whatever age, looks at sysfs and the device files finds the fake bus.
#![allow(unsafe_code)]

use std::ffi::{c_char, c_int, CStr, CString};
use std::sync::{Arc, Mutex};

use hil_mock::dlpc900::{Dlpc900Model, Options};
use hil_mock::usb_plug::{monotonic_clock, UsbPlug};

// What the libc crate does not declare.
extern "C" {
    fn __open_2(path: *const c_char, flags: c_int) -> c_int;
    fn __open64_2(path: *const c_char, flags: c_int) -> c_int;
    fn __openat_2(folder: c_int, path: *const c_char, flags: c_int) -> c_int;
    fn __xstat(version: c_int, path: *const c_char, out: *mut libc::stat) -> c_int;
    fn __lxstat64(version: c_int, path: *const c_char, out: *mut libc::stat) -> c_int;
    fn scandir(
        path: *const c_char,
        names: *mut *mut *mut libc::dirent,
        filter: *const std::ffi::c_void,
        order: *const std::ffi::c_void,
    ) -> c_int;
}

/// Found in use, C6: libusb 1.0.21, which the wheel of hidapi on PyPI carries, reads sysfs by `fopen`, which went past the hooks, and asks
/// for folders by `__xstat`.
#[test]
fn sysfs_is_found_by_every_name_of_the_c_library() {
    let model = Arc::new(Mutex::new(Dlpc900Model::new(Options::default())));
    let plug = Arc::new(UsbPlug::new(model, monotonic_clock()));
    let socket = usbfs_fake::plug_in(plug, usbfs_fake::Options::default());
    let device = format!("/sys/bus/usb/devices/{}-{}", socket.bus_number(), socket.address());
    let node =
        CString::new(format!("/dev/bus/usb/{:03}/{:03}", socket.bus_number(), socket.address())).unwrap();
    let folder = c"/sys/bus/usb/devices";
    let speed = CString::new(format!("{device}/speed")).unwrap();
    let read = |fd: c_int| {
        assert!(fd >= 0, "{}", std::io::Error::last_os_error());
        let mut bytes = [0u8; 16];
        // SAFETY: the buffer is as long as said; the descriptor is this closure's.
        let n = unsafe { libc::read(fd, bytes.as_mut_ptr().cast(), bytes.len()) };
        // SAFETY: as above.
        unsafe { libc::close(fd) };
        String::from_utf8_lossy(&bytes[..usize::try_from(n).expect("read")]).into_owned()
    };
    // Full speed.
    let wanted = "12\n";
    // SAFETY: every path is a C string, every buffer as long as said, every stream and list is freed by those who made it.
    unsafe {
        for stream in
            [libc::fopen(speed.as_ptr(), c"r".as_ptr()), libc::fopen64(speed.as_ptr(), c"re".as_ptr())]
        {
            assert!(!stream.is_null(), "{}", std::io::Error::last_os_error());
            let mut megabits: c_int = 0;
            assert_eq!(libc::fscanf(stream, c"%d".as_ptr(), &mut megabits), 1);
            assert_eq!(megabits, 12);
            libc::fclose(stream);
        }
        assert_eq!(read(libc::open(speed.as_ptr(), libc::O_RDONLY)), wanted);
        assert_eq!(read(libc::open64(speed.as_ptr(), libc::O_RDONLY)), wanted);
        assert_eq!(read(__open_2(speed.as_ptr(), libc::O_RDONLY)), wanted);
        assert_eq!(read(__open64_2(speed.as_ptr(), libc::O_RDONLY)), wanted);
        assert_eq!(read(libc::openat(libc::AT_FDCWD, speed.as_ptr(), libc::O_RDONLY)), wanted);
        assert_eq!(read(libc::openat64(libc::AT_FDCWD, speed.as_ptr(), libc::O_RDONLY)), wanted);
        assert_eq!(read(__openat_2(libc::AT_FDCWD, speed.as_ptr(), libc::O_RDONLY)), wanted);
        let mut stat: libc::stat = std::mem::zeroed();
        let is_folder = |result: c_int, stat: &libc::stat| {
            assert_eq!(result, 0, "{}", std::io::Error::last_os_error());
            assert_eq!(stat.st_mode & libc::S_IFMT, libc::S_IFDIR);
        };
        is_folder(libc::stat(folder.as_ptr(), &mut stat), &stat);
        is_folder(libc::lstat(folder.as_ptr(), &mut stat), &stat);
        is_folder(__xstat(1, folder.as_ptr(), &mut stat), &stat);
        is_folder(__lxstat64(1, folder.as_ptr(), &mut stat), &stat);
        assert_eq!(libc::stat(node.as_ptr(), &mut stat), 0, "the device file is there");
        assert_eq!(libc::access(speed.as_ptr(), libc::R_OK), 0);
        // No link: EINVAL, where a path that is not there has ENOENT.
        let mut bytes = [0; 64];
        for n in [
            libc::readlink(speed.as_ptr(), bytes.as_mut_ptr(), bytes.len()),
            libc::readlinkat(libc::AT_FDCWD, speed.as_ptr(), bytes.as_mut_ptr(), bytes.len()),
        ] {
            assert_eq!((n, std::io::Error::last_os_error().raw_os_error()), (-1, Some(libc::EINVAL)));
        }
        let mut list = std::ptr::null_mut();
        let n = scandir(folder.as_ptr(), &mut list, std::ptr::null(), std::ptr::null());
        let names: Vec<_> = (0..usize::try_from(n).expect("a folder"))
            .map(|i| CStr::from_ptr((**list.add(i)).d_name.as_ptr()).to_string_lossy().into_owned())
            .collect();
        (0..names.len()).for_each(|i| libc::free((*list.add(i)).cast()));
        libc::free(list.cast());
        assert!(
            names.iter().any(|n| device.ends_with(n.as_str())) && names.contains(&"usb1".into()),
            "{names:?}"
        );
        // What does not concern USB goes to the system's own files.
        let stream = libc::fopen(c"/proc/self/comm".as_ptr(), c"r".as_ptr());
        assert!(!stream.is_null());
        libc::fclose(stream);
        assert_eq!(libc::stat(c"/proc/self".as_ptr(), &mut stat), 0);
        assert!(libc::fopen(c"/nowhere/at/all".as_ptr(), c"r".as_ptr()).is_null());
        let mut target = [0; 256];
        assert!(libc::readlink(c"/proc/self/exe".as_ptr(), target.as_mut_ptr(), target.len()) > 0);
    }
}
