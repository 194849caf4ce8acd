//! Bytes of a fuzzer into a tracker's recording.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::recording(bytes));
