//! Bytes of a fuzzer into the messages of a light sensor's host.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::sensor::sensor_device(bytes));
