//! The library's global state: one mutex around discovery and opening, which share it.

use std::{
    ffi::{CStr, c_char, c_uint},
    sync::{Mutex, MutexGuard, PoisonError},
};

use aravis::{Camera, glib};
use aravis_sys as ffi;

// SAFETY: as the library's header declares them.
unsafe extern "C" {
    safe fn arv_get_major_version() -> c_uint;
    safe fn arv_get_minor_version() -> c_uint;
    safe fn arv_get_micro_version() -> c_uint;
}

static GLOBAL: Mutex<()> = Mutex::new(());

fn global() -> MutexGuard<'static, ()> {
    GLOBAL.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A camera that answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// Name to open it by.
    pub id: String,
    /// Maker.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Serial number.
    pub serial: String,
    /// Address on the network, or where on the bus.
    pub address: String,
    /// `GigEVision`, `USB3Vision`.
    pub protocol: String,
}

/// Text that the library owns and may leave out.
///
/// # Safety
/// `text` is null or ends with a zero, and stays until the next discovery.
// SAFETY: the caller has to hold what is written above.
unsafe fn text(text: *const c_char) -> String {
    if text.is_null() {
        return String::new();
    }
    // SAFETY: not null, and the caller promises the rest.
    unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned()
}

/// All cameras that answer; takes a second where there is a network.
pub fn discover() -> Vec<Found> {
    let _one_at_a_time = global();
    // SAFETY: the list belongs to whoever holds the mutex, and `text` copies before the list changes.
    unsafe {
        ffi::arv_update_device_list();
        (0..ffi::arv_get_n_devices())
            .map(|index| Found {
                id: text(ffi::arv_get_device_id(index)),
                vendor: text(ffi::arv_get_device_vendor(index)),
                model: text(ffi::arv_get_device_model(index)),
                serial: text(ffi::arv_get_device_serial_nbr(index)),
                address: text(ffi::arv_get_device_address(index)),
                protocol: text(ffi::arv_get_device_protocol(index)),
            })
            .collect()
    }
}

/// Opens a camera by id or address. Blocks for some seconds where it does not answer.
pub fn open(id: &str) -> Result<Camera, glib::Error> {
    let _one_at_a_time = global();
    Camera::new(Some(id))
}

/// Version of the library that runs, which need not be the one that was built against.
pub fn version() -> [u32; 3] {
    [arv_get_major_version(), arv_get_minor_version(), arv_get_micro_version()]
}
