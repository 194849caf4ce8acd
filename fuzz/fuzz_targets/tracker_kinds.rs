//! Bytes of a fuzzer into the decoders of all kinds of trackers.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::tracker_kinds(bytes));
