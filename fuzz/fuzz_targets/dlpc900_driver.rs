//! Bytes of a fuzzer into the replies of a DLPC900.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::usb::dlpc900_driver(bytes));
