//! Bytes of a fuzzer into both ends of a ZMTP connection.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::gaze::pupil_stream(bytes));
