//! Bytes of a fuzzer into the decoder of a USB camera's pictures.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::motion_jpeg(bytes));
