//! Bytes of a fuzzer into the map of a device's clock.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::clock_map(bytes));
