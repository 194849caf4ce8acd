//! Bytes of a fuzzer into the answers and messages of Pupil.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::gaze::pupil_gaze(bytes));
