//! A stream between `arm` and `disarm`: buffers in, frames out, everything counted.

use std::{
    collections::{BTreeMap, HashSet},
    sync::{
        Arc,
        mpsc::{Receiver, Sender, channel},
    },
    time::Duration,
};

use aravis::{
    Buffer, BufferPayloadType, BufferStatus, GvStream, GvStreamSocketBuffer, Stream,
    glib::{
        object::{Cast as _, ObjectType},
        types::Type,
    },
    prelude::*,
};

use super::{
    buffers::{self, Lent},
    checklist::Applied,
    features::Features,
    identity::{FrameIds, Pairing},
};
use crate::{
    camera::StreamStatistics,
    clock::{Clock, Timestamp},
    error::DeviceError,
    frame::{Frame, FrameStamp, PixelStore},
};

/// Buffers beyond the frames that will be asked for. With as few of them left, frames are copied rather than lent.
const SPARE_BUFFERS: usize = 6;

/// Most buffers of one stream, whatever is asked for.
const MOST_BUFFERS: usize = 256;

/// Least room for packets on their way from the network to the library, in bytes.
const SOCKET_BUFFER: i32 = 1 << 20;

/// What a camera may send with a picture of any size, in bytes.
const PAYLOAD_SLACK: usize = 1 << 20;

/// Longest that a frame takes from the end of its readout to this machine, less than whoever waits for it is patient for.
const DELIVERY: Duration = Duration::from_millis(200);

/// Buffers that outlive a stream: the same ones are used over and over.
#[derive(Debug)]
pub struct Pool {
    buffers: Vec<Buffer>,
    /// Addresses of those that are lent to somebody.
    lent: HashSet<usize>,
    size: usize,
    home: Sender<Buffer>,
    returned: Receiver<Buffer>,
}

fn address(buffer: &Buffer) -> usize {
    buffer.as_ptr() as usize
}

impl Pool {
    /// An empty pool.
    pub fn new() -> Self {
        let (home, returned) = channel();
        Self { buffers: Vec::new(), lent: HashSet::new(), size: 0, home, returned }
    }

    /// Makes buffers of `size` bytes for `frames` frames, those that are lent not counted.
    fn prepare(&mut self, size: usize, frames: usize) {
        while self.returned.try_recv().is_ok_and(|buffer| self.lent.remove(&address(&buffer))) {}
        if size != self.size {
            *self = Self { size, ..Self::new() };
        }
        let wanted = (frames + SPARE_BUFFERS).min(MOST_BUFFERS) + self.lent.len();
        while self.buffers.len() < wanted {
            self.buffers.push(Buffer::new_allocate(size));
        }
    }

    fn free(&self) -> impl Iterator<Item = &Buffer> {
        self.buffers.iter().filter(|buffer| !self.lent.contains(&address(buffer)))
    }

    /// A buffer that has come back.
    fn take_returned(&mut self) -> Option<Buffer> {
        let buffer = self.returned.try_recv().ok()?;
        self.lent.remove(&address(&buffer));
        Some(buffer)
    }
}

/// A stream that runs.
pub struct Running {
    /// Dropped first, and before the camera.
    stream: Stream,
    applied: Applied,
    arrivals: Sender<Result<Frame, DeviceError>>,
    device: String,
    clock: Arc<dyn Clock>,
    ids: FrameIds,
    pairing: Pairing,
    frames: u64,
    failed: u64,
    copied: u64,
    /// Before this the sensor is busy.
    ready: Timestamp,
}

/// Bytes of a frame as the camera announces them, where they can be meant: what follows the picture is small. A camera
/// that is just starting may announce anything, and the library ends the program where memory for it cannot be had.
fn usable_payload(announced: u32, least: usize) -> Result<usize, String> {
    let announced = announced as usize;
    if announced < least {
        return Err(format!("announces frames of {announced} bytes, {least} are needed"));
    }
    if announced > 2 * least + PAYLOAD_SLACK {
        return Err(format!(
            "announces frames of {announced} bytes where {least} are needed; let it start up or power it off and on, \
             then try again"
        ));
    }
    Ok(announced)
}

impl Running {
    /// Starts a stream of `applied` for `frames` frames that go to `arrivals`.
    pub fn start(
        features: &Features,
        pool: &mut Pool,
        applied: &Applied,
        frames: usize,
        device: &str,
        clock: Arc<dyn Clock>,
        arrivals: Sender<Result<Frame, DeviceError>>,
    ) -> Result<Self, DeviceError> {
        let failed = |what: &str, error: aravis::glib::Error| DeviceError::Unavailable {
            device: device.to_owned(),
            detail: format!("{what} failed ({}); check cable and power, then try again", error.message()),
        };
        let camera = features.camera();
        let payload = camera.payload().map_err(|error| failed("reading the size of a frame", error))?;
        let least = applied.wire.bytes(applied.region.width as usize * applied.region.height as usize);
        let payload = usable_payload(payload, least)
            .map_err(|detail| DeviceError::BadData { device: device.to_owned(), detail })?;
        pool.prepare(payload, frames);
        let stream = camera.create_stream().map_err(|error| failed("opening the stream", error))?;
        stream.set_emit_signals(false);
        if let Some(stream) = stream.downcast_ref::<GvStream>() {
            // Room for a frame and its bookkeeping, as far as the system allows it, from the first packet on. The size that
            // the library chooses by itself is less than what the system starts with where frames are small.
            stream.set_socket_buffer(GvStreamSocketBuffer::Fixed);
            stream.set_socket_buffer_size(
                i32::try_from(payload).unwrap_or(i32::MAX).saturating_mul(2).max(SOCKET_BUFFER),
            );
        }
        for buffer in pool.free() {
            stream.push_buffer(buffer.clone());
        }
        camera.start_acquisition().map_err(|error| failed("starting the acquisition", error))?;
        Ok(Self {
            stream,
            applied: applied.clone(),
            arrivals,
            device: device.to_owned(),
            clock,
            ids: FrameIds::new(camera.is_gv_device()),
            pairing: Pairing::new(
                microseconds(applied.settings.settings.exposure_us)
                    + microseconds(applied.settings.readout_us)
                    + DELIVERY,
            ),
            frames: 0,
            failed: 0,
            copied: 0,
            ready: Timestamp(0),
        })
    }

    /// When a trigger for `at` can be sent.
    pub fn earliest(&self, at: Timestamp) -> Timestamp {
        at.max(self.ready).max(self.clock.now())
    }

    /// A trigger was sent for `start`.
    pub fn triggered(&mut self, start: Timestamp) {
        let settings = &self.applied.settings;
        // One frame is read out while the next is exposed, but not two at once.
        let exposure = microseconds(settings.settings.exposure_us);
        self.ready = start + exposure.max(microseconds(settings.readout_us));
        self.pairing.sent(start);
    }

    /// Waits for a buffer and passes on what is in it; whether that was a whole frame.
    pub fn poll(&mut self, pool: &mut Pool, timeout: Duration) -> bool {
        while let Some(buffer) = pool.take_returned() {
            self.stream.push_buffer(buffer);
        }
        let Some(buffer) = self.stream.timeout_pop_buffer(timeout.as_micros() as u64) else { return false };
        let received = self.clock.now();
        let raw = buffer.frame_id();
        let frame_id = self.ids.enter(raw);
        let device_ns = Some(buffer.timestamp()).filter(|&ns| ns != 0);
        let (trigger, exposure_start) = self.pairing.answer(device_ns, received);
        if let Some(fault) = self.fault(&buffer) {
            self.stream.push_buffer(buffer);
            self.failed += 1;
            let detail = format!("frame {frame_id} (number {raw} of the camera): {fault}");
            let _ = self.arrivals.send(Err(DeviceError::BadData { device: self.device.clone(), detail }));
            return false;
        }
        self.frames += 1;
        let settings = &self.applied.settings;
        let frame = Frame {
            width: settings.width,
            height: settings.height,
            bit_depth: settings.settings.format.bit_depth(),
            stamp: FrameStamp { frame_id, trigger, exposure_start, received, device_time_ns: device_ns },
            store: self.store(buffer, pool),
        };
        let _ = self.arrivals.send(Ok(frame));
        true
    }

    /// Why what is in a buffer is not a frame as it was configured.
    fn fault(&self, buffer: &Buffer) -> Option<String> {
        let status = match buffer.status() {
            BufferStatus::Success => None,
            BufferStatus::Timeout | BufferStatus::MissingPackets => {
                Some("packets were lost on the way; check cable, switch and packet size")
            }
            BufferStatus::SizeMismatch => Some("it is of another size than announced"),
            BufferStatus::Aborted => Some("it was cut off"),
            BufferStatus::WrongPacketId => Some("its packets are numbered wrongly"),
            BufferStatus::PayloadNotSupported => Some("it is of a kind that cannot be read"),
            _ => Some("it did not arrive whole"),
        };
        if let Some(fault) = status {
            return Some(format!("{fault} ({:?})", buffer.status()));
        }
        let Applied { wire, region, .. } = &self.applied;
        if buffer.payload_type() != BufferPayloadType::Image {
            return Some(format!("it holds {:?}, not an image", buffer.payload_type()));
        }
        let code = buffer.image_pixel_format().raw();
        if code != wire.code() {
            return Some(format!("its samples are of format {code:#x}, {} was configured", wire.name()));
        }
        let (x, y, width, height) = buffer.image_region();
        let configured = [region.x, region.y, region.width, region.height].map(i64::from);
        if [x, y, width, height].map(i64::from) != configured {
            return Some(format!("its region is {width} x {height} at ({x}, {y}), not the configured one"));
        }
        if buffer.image_padding() != (0, 0) {
            return Some("its rows are padded".to_owned());
        }
        let (length, needed) = (buffers::received(buffer).len(), wire.bytes(self.samples()));
        (length < needed).then(|| format!("it has {length} bytes, {needed} are needed"))
    }

    fn samples(&self) -> usize {
        self.applied.region.width as usize * self.applied.region.height as usize
    }

    /// Lends the buffer where its samples can be used as they lie and enough others are left, else copies.
    fn store(&mut self, buffer: Buffer, pool: &mut Pool) -> Arc<dyn PixelStore> {
        let (wire, samples) = (self.applied.wire, self.samples());
        let (waiting, done) = self.stream.n_buffers();
        let enough = waiting + done >= SPARE_BUFFERS as i32 / 2;
        let buffer = if wire.is_native() && enough {
            let home = address(&buffer);
            match Lent::new(buffer, samples, wire.bytes(1) == 2, pool.home.clone()) {
                Ok(lent) => {
                    pool.lent.insert(home);
                    return Arc::new(lent);
                }
                Err(buffer) => buffer,
            }
        } else {
            buffer
        };
        let unpacked = wire.unpack(buffers::received(&buffer), samples);
        self.copied += 1;
        self.stream.push_buffer(buffer);
        Arc::new(unpacked)
    }

    /// Counters so far, those of the library with them.
    pub fn statistics(&self) -> StreamStatistics {
        let mut counters = BTreeMap::from([("copied_frames".to_owned(), self.copied)]);
        for id in 0..self.stream.n_infos() {
            if let Some(name) = self.stream.info_name(id).filter(|_| self.stream.info_type(id) == Type::U64) {
                counters.insert(name.to_string(), self.stream.info_uint64(id));
            }
        }
        StreamStatistics {
            triggers: self.pairing.count(),
            frames: self.frames,
            failed: self.failed,
            counters,
        }
    }

    /// Tells whoever waits for frames that none will come.
    pub fn fail(&self, error: &DeviceError) {
        let _ = self.arrivals.send(Err(error.clone()));
    }
}

/// A length that a camera gives; none where it is no number.
fn microseconds(us: f64) -> Duration {
    Duration::try_from_secs_f64(1e-6 * us).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_as_large_as_its_picture_and_a_little() {
        let picture = 1600 * 1200;
        for usable in [picture, picture + 64, 2 * picture] {
            assert_eq!(usable_payload(usable as u32, picture), Ok(usable));
        }
        assert!(usable_payload(picture as u32 - 1, picture).unwrap_err().contains("1920000 are needed"));
        assert!(usable_payload(u32::MAX, picture).unwrap_err().contains("power it off and on"));
    }
}
