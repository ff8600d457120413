//! Arrays: npy headers, npz archives, PLY.
#![no_main]

use libfuzzer_sys::fuzz_target;
use polscan::{
    cloud::read_ply,
    store::{maps::Maps, npy::Header, npz},
};

fuzz_target!(|bytes: &[u8]| {
    let Some((kind, bytes)) = bytes.split_first() else { return };
    match kind % 4 {
        0 => {
            if let Ok(header) = Header::parse(bytes) {
                let _ = header.data_bytes();
            }
        }
        1 => drop(npz::read(std::io::Cursor::new(bytes))),
        2 => drop(Maps::read(std::io::Cursor::new(bytes))),
        _ => drop(read_ply(bytes)),
    }
});
