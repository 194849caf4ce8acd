//! Bytes of a fuzzer into the messages of a USB/IP client.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::usb::usbip_server(bytes));
