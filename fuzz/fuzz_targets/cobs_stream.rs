//! Bytes of a fuzzer into the COBS deframer.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::cobs_stream(bytes));
