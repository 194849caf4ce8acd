//! Bytes of a fuzzer into the settings of the environment and of flags, and into plans of faults.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::settings(bytes));
