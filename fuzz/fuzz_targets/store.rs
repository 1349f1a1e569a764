#![no_main]

// redb may panic on files it did not write, and the journal contains that; libFuzzer's hook would end the process first.
libfuzzer_sys::fuzz_target!(init: std::panic::set_hook(Box::new(|_| ())), |data: &[u8]| ambience_fuzz::store(data));
