//! Bytes of a fuzzer into the commands to an emulated DLPC900.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::usb::dlpc900_controller(bytes));
