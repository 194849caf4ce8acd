//! Bytes of a fuzzer into the messages of a VRPN client.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::trackers::vrpn_server(bytes));
