//! Bytes of a fuzzer into packets with right checksums to a projector that no host has greeted.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::link::projector_hello(bytes));
