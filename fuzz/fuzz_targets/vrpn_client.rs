//! Bytes of a fuzzer into the messages of a VRPN server.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::conversations::trackers::vrpn_client(bytes));
