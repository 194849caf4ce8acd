//! Bytes of a fuzzer into the bit-plane link's decoder.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::link_stream(bytes));
