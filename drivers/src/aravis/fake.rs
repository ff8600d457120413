//! A GigE Vision camera in software, on the loopback network of this machine: it answers the real driver by the real
//! protocol, and frames are painted by whoever made it. For rehearsals and tests.

use std::{
    ffi::c_void,
    fs::File,
    io,
    path::Path,
    slice,
    sync::{Arc, Mutex, PoisonError},
};

use aravis::{Buffer, FakeCamera, GvFakeCamera, glib::translate::*};
use aravis_sys as ffi;

/// Where the camera listens. Its port is fixed by the protocol, so there is one at a time on a machine.
pub const ADDRESS: &str = "127.0.0.1";

/// What is exposed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exposure {
    /// Exposures before this one.
    pub number: u64,
    /// Exposure time in microseconds.
    pub exposure_us: u32,
    /// Code of the pixel format.
    pub format: u32,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// Paints a frame into the bytes that travel.
pub type Painter = dyn FnMut(Exposure, &mut [u8]) + Send;

struct Studio {
    paint: Box<Painter>,
    exposures: u64,
}

/// The camera. It vanishes from the network when dropped.
pub struct Fake {
    camera: GvFakeCamera,
    /// Given to the library, which calls back until the camera is gone.
    studio: Arc<Mutex<Studio>>,
    /// Kept from other processes while this is.
    _port: File,
}

/// Called by the library's thread for each exposure.
// SAFETY: only the library calls it, with what `Fake::on` gave it and a buffer of its own.
unsafe extern "C" fn fill(
    buffer: *mut ffi::ArvBuffer,
    studio: *mut c_void,
    exposure_us: u32,
    _gain: u32,
    format: u32,
) {
    // SAFETY: the library passes what `Fake::new` gave it, which outlives the camera's thread, and a buffer of its own.
    let (studio, buffer): (&Mutex<Studio>, Buffer) =
        unsafe { (&*studio.cast_const().cast(), from_glib_none(buffer)) };
    let (width, height) = (buffer.image_width().max(0) as usize, buffer.image_height().max(0) as usize);
    // Nothing has been received, so that the library states a length of 0; it allocated what the format needs.
    let length = width * height * (format >> 16 & 0xff) as usize / 8;
    let (bytes, _) = buffer.data();
    if bytes.is_null() {
        return;
    }
    // SAFETY: as many bytes were allocated for the payload, and the camera's thread waits for this call.
    let bytes = unsafe { slice::from_raw_parts_mut(bytes, length) };
    let mut studio = studio.lock().unwrap_or_else(PoisonError::into_inner);
    let number = studio.exposures;
    studio.exposures += 1;
    (studio.paint)(Exposure { number, exposure_us, format, width, height }, bytes);
}

impl Fake {
    /// A camera called `serial` with the library's own features, or those that the file `genicam` describes. Waits for
    /// another process that has one.
    pub fn new(
        serial: &str,
        genicam: Option<&Path>,
        paint: impl FnMut(Exposure, &mut [u8]) + Send + 'static,
    ) -> io::Result<Self> {
        let port = File::options()
            .create(true)
            .truncate(false)
            .write(true)
            .open(std::env::temp_dir().join("polscan-fake-camera.lock"))?;
        port.lock()?;
        Self::on(port, serial, genicam, Arc::new(Mutex::new(Studio { paint: Box::new(paint), exposures: 0 })))
    }

    fn on(port: File, serial: &str, genicam: Option<&Path>, studio: Arc<Mutex<Studio>>) -> io::Result<Self> {
        let genicam = genicam.map(|path| path.to_string_lossy().into_owned());
        let camera = GvFakeCamera::new_full(Some(ADDRESS), Some(serial), genicam.as_deref());
        if !camera.is_running() {
            return Err(io::Error::new(
                io::ErrorKind::AddrInUse,
                format!("no camera can listen on {ADDRESS}"),
            ));
        }
        let fake = Self { camera, studio, _port: port };
        let inside = fake.inside()?;
        let data = Arc::as_ptr(&fake.studio).cast_mut().cast();
        // SAFETY: the camera is dropped before the studio, and its thread ends with it.
        unsafe { ffi::arv_fake_camera_set_fill_pattern(inside.to_glib_none().0, Some(fill), data) };
        inside.set_trigger_frequency(1000.0);
        Ok(fake)
    }

    fn inside(&self) -> io::Result<FakeCamera> {
        self.camera
            .fake_camera()
            .ok_or_else(|| io::Error::other("the library made a camera without an inside"))
    }

    /// How often in a second the camera looks for triggers; two in between are one exposure.
    pub fn look_for_triggers(&self, hz: f64) {
        if let Ok(inside) = self.inside() {
            inside.set_trigger_frequency(hz);
        }
    }

    /// Share of packets that are lost on the way.
    pub fn lose_packets(&self, share: f64) {
        self.camera.set_gvsp_lost_ratio(share);
    }

    /// Writes a register behind everybody's back.
    pub fn poke(&self, address: u32, value: u32) {
        if let Ok(inside) = self.inside() {
            inside.write_register(address, value);
        }
    }

    /// Reads a register.
    pub fn peek(&self, address: u32) -> Option<u32> {
        self.inside().ok()?.read_register(address)
    }

    /// Exposures so far.
    pub fn exposures(&self) -> u64 {
        self.studio.lock().unwrap_or_else(PoisonError::into_inner).exposures
    }
}
