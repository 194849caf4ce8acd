//! Bytes of a fuzzer into the messages of NatNet clients.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::trackers::natnet_server(bytes));
