//! The USB descriptors of the emulated DLPC900.

/// A vendor-defined usage with one 64-byte input and one 64-byte output report, no report ID.
#[rustfmt::skip]
pub(super) const REPORT: [u8; 25] = [
    0x06, 0x00, 0xff, // usage page, vendor defined
    0x09, 0x01,       // usage 1
    0xa1, 0x01,       // collection, application
    0x15, 0x00,       // logical minimum 0
    0x26, 0xff, 0x00, // logical maximum 255
    0x75, 0x08,       // report size 8 bits
    0x95, 0x40,       // report count 64
    0x09, 0x01,       // usage 1
    0x81, 0x02,       // input
    0x09, 0x01,       // usage 1
    0x91, 0x02,       // output
    0xc0,
];

/// USB 1.1, class by interface, 64-byte control packets, 0451:c900.
#[rustfmt::skip]
pub(super) const DEVICE: [u8; 18] = [
    18, 1, 0x10, 0x01, 0, 0, 0, 64, 0x51, 0x04, 0x00, 0xc9, 0x00, 0x01, 1, 2, 3, 1,
];

/// Strings 1 to 3.
pub(super) const STRINGS: [&str; 3] = ["Texas Instruments", "DLPC900", "LCR900-EMULATED"];

/// The HID descriptor: HID 1.11, one report descriptor.
pub(super) const HID: [u8; 9] = [9, 0x21, 0x11, 0x01, 0, 1, 0x22, REPORT.len() as u8, 0];

/// The configuration with one or two HID interfaces (some boards enumerate two; endpoints 1 belong to interface 0).
pub(super) fn configuration(interfaces: u8) -> Vec<u8> {
    let mut c = vec![9, 2, 0, 0, interfaces, 1, 0, 0xc0, 50];
    for i in 0..interfaces {
        c.extend([9, 4, i, 0, 2, 3, 0, 0, 0]);
        c.extend(HID);
        // Interrupt endpoints of 64 bytes, every millisecond.
        for address in [0x81 + i, 0x01 + i] {
            c.extend([7, 5, address, 3, 64, 0, 1]);
        }
    }
    let total = (c.len() as u16).to_le_bytes();
    c[2..4].copy_from_slice(&total);
    c
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::usb_model::{endpoints, interfaces};

    #[test]
    fn golden_configuration() {
        #[rustfmt::skip]
        let golden = [
            9, 2, 41, 0, 1, 1, 0, 0xc0, 50,
            9, 4, 0, 0, 2, 3, 0, 0, 0,
            9, 0x21, 0x11, 0x01, 0, 1, 0x22, 25, 0,
            7, 5, 0x81, 3, 64, 0, 1,
            7, 5, 0x01, 3, 64, 0, 1,
        ];
        assert_eq!(configuration(1), golden);
        let two = configuration(2);
        assert_eq!(u16::from_le_bytes([two[2], two[3]]) as usize, two.len());
        assert_eq!(interfaces(&two), [(3, 0, 0); 2]);
        assert_eq!(endpoints(&two).iter().map(|e| e.0).collect::<Vec<_>>(), [0x81, 0x01, 0x82, 0x02]);
    }
}
