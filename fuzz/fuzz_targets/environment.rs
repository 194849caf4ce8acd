//! Bytes of a fuzzer into the reader of environment maps.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::files::environment(bytes));
