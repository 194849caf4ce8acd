//! Bytes of a fuzzer into the readers of rig and calibration files.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::texts(bytes));
