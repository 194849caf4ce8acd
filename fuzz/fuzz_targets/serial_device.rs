//! Bytes of a fuzzer into the messages of a serial tracker's host.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::trackers::serial_device(bytes));
