//! Bytes of a fuzzer into packets with right checksums to a projector that is armed.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::link::projector(bytes));
