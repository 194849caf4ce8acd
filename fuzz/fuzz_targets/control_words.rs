//! Bytes of a fuzzer into what other processes say of a projector.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::control_words(bytes));
