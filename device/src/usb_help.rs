//! Turns errors of libusb into instructions for an operator.

use rusb::{Device, Error, UsbContext};

/// The remedy for an error of libusb, for an operator who stands beside the device.
pub const fn remedy(e: Error) -> &'static str {
    match e {
        Error::Io => "the cable or a hub failed: plug the device straight into the machine, try another cable, and see `dmesg`",
        Error::Access => "this user may not open it: copy packaging/60-dpm.rules to /etc/udev/rules.d/ and plug it in again",
        Error::NoDevice => "it was unplugged or lost power: check cable and supply",
        Error::NotFound => "it has no such interface or endpoint: `lsusb -v` tells whether it is the device that is meant, and its firmware",
        Error::Busy => "another program or driver holds it: end that one (`fuser -v` on the device file names it)",
        Error::Timeout => "it does not answer: switch it off and on, then check the cable",
        Error::Overflow => "it sent more than was asked for: its firmware speaks something else; switch it off and on, or update it",
        Error::Pipe => "it refused the request: switch it off and on; if it does so again its firmware speaks something else",
        Error::Interrupted => "a signal came between: start again",
        Error::NoMem => "the kernel has no memory left for transfers: raise /sys/module/usbcore/parameters/usbfs_memory_mb (`dpm doctor` says how far)",
        Error::NotSupported => "this system cannot do it: `dpm doctor` says what is there; in a container or a virtual machine pass /dev/bus/usb through",
        Error::InvalidParam | Error::BadDescriptor => {
            "what it says of itself is broken: unplug it, switch it off and on, and plug it in again; see `dmesg`"
        }
        Error::Other => {
            "libusb gives no reason: see `dmesg`, unplug the device and plug it in again; in a container or a virtual machine pass \
             /dev/bus/usb through"
        }
    }
}

/// The path of the device file, in the form that `lsusb` and `fuser` use.
pub fn node(bus: u8, address: u8) -> String {
    format!("/dev/bus/usb/{bus:03}/{address:03}")
}

/// The device file of `device`.
pub fn node_of<T: UsbContext>(device: &Device<T>) -> String {
    node(device.bus_number(), device.address())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::TransportError;

    /// Every error that rusb has.
    const ALL: [Error; 14] = [
        Error::Io,
        Error::InvalidParam,
        Error::Access,
        Error::NoDevice,
        Error::NotFound,
        Error::Busy,
        Error::Timeout,
        Error::Overflow,
        Error::Pipe,
        Error::Interrupted,
        Error::NoMem,
        Error::NotSupported,
        Error::BadDescriptor,
        Error::Other,
    ];

    #[test]
    fn every_error_says_what_failed_where_and_what_to_do() {
        for e in ALL {
            let device = format!("USB projector 1209:000d at {}", node(3, 12));
            let told = TransportError::of_usb("send to", device, e).to_string();
            assert!(told.contains("1209:000d at /dev/bus/usb/003/012"), "{told}");
            // The text contains advice, in the imperative, besides libusb's own message.
            let advice = [
                "check",
                "see `dmesg`",
                "switch it",
                "end it",
                "end that",
                "copy",
                "lsusb",
                "start again",
                "raise",
                "doctor",
            ];
            assert!(advice.iter().any(|word| told.contains(word)), "{e:?}: {told}");
        }
    }

    #[test]
    fn what_can_be_told_apart_is_told_apart() {
        use TransportError as T;
        let of = |e| TransportError::of_usb("open", "a device".into(), e);
        assert!(matches!(of(Error::NoDevice), T::Unplugged { .. }));
        assert!(matches!(of(Error::Busy), T::InUse { .. }));
        assert!(matches!(of(Error::Access), T::PermissionDenied { .. }));
        assert!(matches!(of(Error::Other), T::Usb { .. }));
        let told: std::collections::BTreeSet<_> = ALL.into_iter().map(|e| of(e).to_string()).collect();
        assert_eq!(told.len(), ALL.len(), "no two read the same");
    }
}
