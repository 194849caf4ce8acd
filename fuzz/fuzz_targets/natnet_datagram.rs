//! Bytes of a fuzzer into the NatNet decoders.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dpm_tests::decoders::natnet_datagram(bytes));
