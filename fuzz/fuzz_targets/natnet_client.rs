//! Bytes of a fuzzer into the answers of a NatNet server.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::trackers::natnet_client(bytes));
