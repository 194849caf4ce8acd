//! Bytes of a fuzzer into packets with right checksums to a host that streams.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::link::host_link(bytes));
