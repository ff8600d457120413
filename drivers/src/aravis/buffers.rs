//! Frames in the library's own buffers, lent to whoever decodes them and given back when dropped.

use std::{slice, sync::mpsc::Sender};

use aravis::Buffer;

use crate::frame::{PixelStore, Pixels};

/// What a buffer has received, as bytes.
pub fn received(buffer: &Buffer) -> &[u8] {
    let (bytes, length) = buffer.data();
    if bytes.is_null() {
        return &[];
    }
    // SAFETY: the library allocated `length` bytes and more, and whoever has the buffer out of its stream is alone with it.
    unsafe { slice::from_raw_parts(bytes, length) }
}

/// A buffer that was taken out of its stream and holds a whole frame of samples in native form.
pub struct Lent {
    /// Gone only while this is dropped.
    buffer: Option<Buffer>,
    samples: *const u8,
    count: usize,
    wide: bool,
    home: Sender<Buffer>,
}

// SAFETY: the samples are not written while the buffer is out of its stream, and the buffer itself, which may travel
// between threads, is touched by nobody but the one that drops this.
unsafe impl Send for Lent {}
// SAFETY: as above; shared access reads samples and nothing else.
unsafe impl Sync for Lent {}

impl Lent {
    /// Lends `count` samples of one byte, or two where `wide`. The buffer comes back where it is too short, or where
    /// its samples lie across words.
    pub fn new(buffer: Buffer, count: usize, wide: bool, home: Sender<Buffer>) -> Result<Self, Buffer> {
        let bytes = received(&buffer);
        let (samples, length) = (bytes.as_ptr(), bytes.len());
        if length < count << u8::from(wide) || wide && !samples.cast::<u16>().is_aligned() {
            return Err(buffer);
        }
        Ok(Self { buffer: Some(buffer), samples, count, wide, home })
    }
}

impl PixelStore for Lent {
    fn pixels(&self) -> Pixels<'_> {
        if self.wide {
            // SAFETY: `new` has seen that as many samples are there and aligned; the buffer outlives the borrow.
            Pixels::U16(unsafe { slice::from_raw_parts(self.samples.cast(), self.count) })
        } else {
            // SAFETY: as above.
            Pixels::U8(unsafe { slice::from_raw_parts(self.samples, self.count) })
        }
    }
}

impl Drop for Lent {
    fn drop(&mut self) {
        if let Some(buffer) = self.buffer.take() {
            // A camera that is gone wants nothing back.
            let _ = self.home.send(buffer);
        }
    }
}
