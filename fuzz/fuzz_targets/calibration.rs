//! Bytes of a fuzzer into the reader of calibration files.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::calibration(bytes));
