//! Bytes of a fuzzer into the serial pose decoder.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::picture_header(bytes));
