//! Bytes of a fuzzer into the plane decoder of the link.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::link_rle(bytes));
