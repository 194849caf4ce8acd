//! Bytes of a fuzzer into USB/IP messages, both ends.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::usbip_stream(bytes));
