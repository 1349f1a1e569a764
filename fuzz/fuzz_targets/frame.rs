#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| ambience_fuzz::frame(data));
