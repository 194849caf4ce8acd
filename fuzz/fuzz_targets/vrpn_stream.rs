//! Bytes of a fuzzer into the VRPN decoders.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::vrpn_stream(bytes));
