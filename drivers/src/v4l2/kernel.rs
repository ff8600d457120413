//! A video node and its buffers: the calls of the kernel, laid out as `linux/videodev2.h` has them.
//!
//! Only what is needed: one plane, memory of the driver's mapped into this process. A wait that ends without a frame
//! leaves the stream as it is, a flagged buffer is handed out with its flags, and closing never panics.
//!
//! The file is long because the layouts by which its calls are safe stand beside them.

use std::{
    fs::File,
    io,
    os::fd::AsFd,
    path::Path,
    ptr::{NonNull, null_mut},
    sync::Arc,
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    fs::{Mode, OFlags},
    io::Errno,
    ioctl::{Opcode, Updater, ioctl, opcode},
    mm::{MapFlags, ProtFlags, mmap, munmap},
};

/// Type of all buffers here: frames from a camera.
const VIDEO_CAPTURE: u32 = 1;

/// Buffers lie in memory of the driver's.
const MEMORY_MMAP: u32 = 1;

/// Enumerate: the next control after this id.
const NEXT_CONTROL: u32 = 0x8000_0000;

/// Ability: frames from a camera, one plane.
pub const CAN_CAPTURE: u32 = 0x0000_0001;
/// Ability: streaming by buffers.
pub const CAN_STREAM: u32 = 0x0400_0000;
/// Ability: [`Capability::device_caps`] counts rather than [`Capability::capabilities`].
const HAS_DEVICE_CAPS: u32 = 0x8000_0000;

/// Flag of a buffer whose frame is damaged.
pub const BUFFER_ERROR: u32 = 0x0000_0040;
/// Bits of a buffer's flags that name the clock of its stamp.
pub const CLOCK_MASK: u32 = 0x0000_e000;
/// The clock is the machine's monotonic one.
pub const CLOCK_MONOTONIC: u32 = 0x0000_2000;
/// `struct v4l2_capability`
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct Capability {
    driver: [u8; 16],
    card: [u8; 32],
    bus_info: [u8; 32],
    version: u32,
    capabilities: u32,
    device_caps: u32,
    reserved: [u32; 3],
}

impl Capability {
    /// What this node can do.
    pub fn abilities(&self) -> u32 {
        if self.capabilities & HAS_DEVICE_CAPS != 0 { self.device_caps } else { self.capabilities }
    }

    /// Model as the kernel's driver names it.
    pub fn card(&self) -> String {
        text(&self.card)
    }

    /// Where it is connected.
    pub fn bus(&self) -> String {
        text(&self.bus_info)
    }
}

/// `struct v4l2_pix_format`
#[repr(C)]
#[derive(Clone, Copy, Default, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Code of the sample format.
    pub fourcc: u32,
    /// Interlacing; 1 is none.
    pub field: u32,
    /// Bytes from one row to the next.
    pub stride: u32,
    /// Bytes of a frame.
    pub size: u32,
    colorspace: u32,
    private: u32,
    flags: u32,
    encoding: u32,
    quantization: u32,
    transfer: u32,
}

impl Picture {
    /// A wish for these columns and rows, without interlacing.
    pub fn wish(fourcc: u32, width: u32, height: u32) -> Self {
        Self { width, height, fourcc, field: 1, ..Self::default() }
    }

    /// Whether brightness is said to use all values, rather than 16 to 235.
    pub fn is_full_range(&self) -> bool {
        self.quantization == 1
    }
}

/// `struct v4l2_format`
#[repr(C, align(8))]
struct Format {
    kind: u32,
    pad: u32,
    picture: Picture,
    rest: [u8; 152],
}

/// `struct v4l2_fmtdesc`
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Description {
    index: u32,
    kind: u32,
    flags: u32,
    description: [u8; 32],
    fourcc: u32,
    bus_code: u32,
    reserved: [u32; 3],
}

/// `struct v4l2_frmsizeenum`
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct FrameSize {
    index: u32,
    fourcc: u32,
    /// 1 where the size stands alone.
    kind: u32,
    width: u32,
    height: u32,
    rest: [u32; 6],
}

/// `struct v4l2_streamparm`
#[repr(C)]
struct StreamParameters {
    kind: u32,
    capability: u32,
    mode: u32,
    numerator: u32,
    denominator: u32,
    rest: [u32; 46],
}

/// `struct v4l2_requestbuffers`
#[repr(C)]
struct Request {
    count: u32,
    kind: u32,
    memory: u32,
    capabilities: u32,
    flags: u32,
}

/// `struct v4l2_buffer`
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Buffer {
    index: u32,
    kind: u32,
    bytes_used: u32,
    flags: u32,
    field: u32,
    pad: u32,
    seconds: i64,
    microseconds: i64,
    timecode: [u32; 4],
    sequence: u32,
    memory: u32,
    offset: u64,
    length: u32,
    reserved: [u32; 2],
    end: u32,
}

/// `struct v4l2_queryctrl`
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct Query {
    id: u32,
    kind: u32,
    name: [u8; 32],
    minimum: i32,
    maximum: i32,
    step: i32,
    default: i32,
    flags: u32,
    reserved: [u32; 2],
}

/// `struct v4l2_control`
#[repr(C)]
struct Value {
    id: u32,
    value: i32,
}

const _: () = assert!(
    size_of::<Capability>() == 104
        && size_of::<Format>() == 208
        && size_of::<Description>() == 64
        && size_of::<FrameSize>() == 44
        && size_of::<StreamParameters>() == 204
        && size_of::<Request>() == 20
        && size_of::<Buffer>() == 88
        && size_of::<Query>() == 68
        && size_of::<Value>() == 8
);

/// A control as the kernel describes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Control {
    /// Number of the control.
    pub id: u32,
    /// 1 integer, 2 boolean, 3 menu; others are not used here.
    pub kind: u32,
    /// Name for people; a driver may write what it likes.
    pub name: String,
    /// Least value.
    pub minimum: i32,
    /// Greatest value.
    pub maximum: i32,
    /// Step between values.
    pub step: i32,
    /// Bits: 1 disabled, 4 read only, 16 inactive.
    pub flags: u32,
}

/// What came with a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Arrival {
    /// Which buffer; to be given back by [`Stream::give_back`].
    pub index: u32,
    /// Bytes of it that were written.
    pub length: usize,
    /// Flags of the buffer.
    pub flags: u32,
    /// Number of the frame; wraps.
    pub sequence: u32,
    /// Stamp in nanoseconds, of the clock that the flags name.
    pub stamp_ns: u64,
}

/// What a wait brought.
#[derive(Debug)]
pub enum Waited {
    /// A frame.
    Frame(Arrival),
    /// Nothing in time.
    Nothing,
}

/// An open video node.
#[derive(Debug)]
pub struct Node(File);

fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|&byte| byte == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).trim().to_owned()
}

/// `_IOR`, `_IOW` and `_IOWR` of the group `V`.
const fn both<T>(number: u8) -> Opcode {
    opcode::read_write::<T>(b'V', number)
}

impl Node {
    /// Opens a node without waiting for anything.
    pub fn open(path: &Path) -> io::Result<Self> {
        let flags = OFlags::RDWR | OFlags::NONBLOCK | OFlags::CLOEXEC;
        Ok(Self(File::from(rustix::fs::open(path, flags, Mode::empty())?)))
    }

    /// One call of the kernel, again where a signal came between.
    fn call<const CODE: Opcode, T>(&self, value: &mut T) -> Result<(), Errno> {
        rustix::io::retry_on_intr(|| {
            // SAFETY: each code below is made of the very type that it is called with, laid out as the kernel has it; a
            // buffer's memory is not passed by pointer.
            unsafe { ioctl(&self.0, Updater::<CODE, T>::new(value)) }
        })
    }

    /// Who it is and what it can do.
    pub fn capability(&self) -> io::Result<Capability> {
        let mut capability = Capability::default();
        self.call::<{ opcode::read::<Capability>(b'V', 0) }, _>(&mut capability)?;
        Ok(capability)
    }

    /// Codes of the sample formats that it offers.
    pub fn formats(&self) -> Vec<u32> {
        let one = |index| {
            let mut description = Description { index, kind: VIDEO_CAPTURE, ..Description::default() };
            self.call::<{ both::<Description>(2) }, _>(&mut description).ok()?;
            Some(description.fourcc)
        };
        (0..256).map_while(one).collect()
    }

    /// Asks for a picture; what the driver made of it.
    pub fn set_picture(&self, picture: Picture) -> io::Result<Picture> {
        let mut format = Format { kind: VIDEO_CAPTURE, pad: 0, picture, rest: [0; 152] };
        self.call::<{ both::<Format>(5) }, _>(&mut format)?;
        Ok(format.picture)
    }

    /// The picture that it has.
    fn picture(&self) -> io::Result<Picture> {
        let mut format = Format { kind: VIDEO_CAPTURE, pad: 0, picture: Picture::default(), rest: [0; 152] };
        self.call::<{ both::<Format>(4) }, _>(&mut format)?;
        Ok(format.picture)
    }

    /// Columns and rows of the largest frames that are not scaled: of the sizes that a camera has the largest, and where it
    /// makes any size, that of its source, which it has until another is set.
    pub fn natural_size(&self, fourcc: u32) -> io::Result<(u32, u32)> {
        let one = |index| {
            let mut size = FrameSize { index, fourcc, ..FrameSize::default() };
            self.call::<{ both::<FrameSize>(74) }, _>(&mut size).ok()?;
            (size.kind == 1).then_some((size.width, size.height))
        };
        let largest =
            (0..1024).map_while(one).max_by_key(|&(width, height)| u64::from(width) * u64::from(height));
        match largest {
            Some(size) => Ok(size),
            None => self.picture().map(|picture| (picture.width, picture.height)),
        }
    }

    /// Time between frames in seconds, where the driver knows it.
    pub fn period_s(&self) -> Option<f64> {
        let mut parameters = StreamParameters {
            kind: VIDEO_CAPTURE,
            capability: 0,
            mode: 0,
            numerator: 0,
            denominator: 0,
            rest: [0; 46],
        };
        self.call::<{ both::<StreamParameters>(21) }, _>(&mut parameters).ok()?;
        let (numerator, denominator) = (parameters.numerator, parameters.denominator);
        (numerator > 0 && denominator > 0).then(|| f64::from(numerator) / f64::from(denominator))
    }

    /// All controls but disabled ones.
    pub fn controls(&self) -> Vec<Control> {
        let mut found: Vec<Control> = Vec::new();
        let mut id = 0;
        loop {
            let mut query = Query { id: id | NEXT_CONTROL, ..Query::default() };
            let asked = self.call::<{ both::<Query>(36) }, _>(&mut query);
            // A driver that does not move on would be asked for ever.
            if asked.is_err() || query.id <= id {
                return found;
            }
            id = query.id;
            if query.flags & 1 == 0 {
                let Query { kind, minimum, maximum, step, flags, .. } = query;
                found.push(Control { id, kind, name: text(&query.name), minimum, maximum, step, flags });
            }
        }
    }

    /// Value of a control.
    pub fn control(&self, id: u32) -> io::Result<i32> {
        let mut value = Value { id, value: 0 };
        self.call::<{ both::<Value>(27) }, _>(&mut value)?;
        Ok(value.value)
    }

    /// Sets a control.
    pub fn set_control(&self, id: u32, value: i32) -> io::Result<()> {
        let mut value = Value { id, value };
        Ok(self.call::<{ both::<Value>(28) }, _>(&mut value)?)
    }

    /// Asks for buffers; how many there are. With 0 all are given back.
    fn request(&self, count: u32) -> io::Result<u32> {
        let mut request =
            Request { count, kind: VIDEO_CAPTURE, memory: MEMORY_MMAP, capabilities: 0, flags: 0 };
        self.call::<{ both::<Request>(8) }, _>(&mut request)?;
        Ok(request.count)
    }
}

/// Memory of one buffer, mapped for reading.
#[derive(Debug)]
struct Mapping {
    start: NonNull<u8>,
    length: usize,
}

// SAFETY: the memory belongs to the mapping alone and is not bound to a thread.
unsafe impl Send for Mapping {}

impl Mapping {
    fn new(node: &Node, offset: u64, length: usize) -> io::Result<Self> {
        // SAFETY: a new mapping at a place of the kernel's choice touches no memory that is in use.
        let start =
            unsafe { mmap(null_mut(), length, ProtFlags::READ, MapFlags::SHARED, node.0.as_fd(), offset) }?;
        let start = NonNull::new(start.cast()).ok_or_else(|| io::Error::other("a buffer at address 0"))?;
        Ok(Self { start, length })
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped by `new` with this length, and no slice of it outlives it. A failure leaves it mapped, no more.
        let _ = unsafe { munmap(self.start.as_ptr().cast(), self.length) };
    }
}

/// A running stream. Dropping it stops the stream and gives all buffers back.
#[derive(Debug)]
pub struct Stream {
    node: Arc<Node>,
    mappings: Vec<Mapping>,
}

impl Stream {
    /// Takes and gives back a buffer: whether anybody else has a stream.
    pub fn probe(node: &Node) -> io::Result<()> {
        node.request(1)?;
        node.request(0).map(drop)
    }

    /// Maps about `count` buffers, queues all and starts.
    pub fn start(node: &Arc<Node>, count: u32) -> io::Result<Self> {
        let count = node.request(count)?;
        let mut stream = Self { node: node.clone(), mappings: Vec::new() };
        for index in 0..count {
            let mut buffer = described(index);
            node.call::<{ both::<Buffer>(9) }, _>(&mut buffer)?;
            let offset = buffer.offset & u64::from(u32::MAX);
            stream.mappings.push(Mapping::new(node, offset, buffer.length as usize)?);
            stream.give_back(index)?;
        }
        let mut kind = VIDEO_CAPTURE;
        node.call::<{ opcode::write::<u32>(b'V', 18) }, _>(&mut kind)?;
        Ok(stream)
    }

    /// Buffers of the stream.
    pub fn buffers(&self) -> usize {
        self.mappings.len()
    }

    /// Waits for a frame for at most `milliseconds`. An error means that the stream is over.
    pub fn wait(&self, milliseconds: u32) -> io::Result<Waited> {
        let timeout = Timespec {
            tv_sec: i64::from(milliseconds / 1000),
            tv_nsec: i64::from(milliseconds % 1000) * 1_000_000,
        };
        let mut descriptors = [PollFd::new(&self.node.0, PollFlags::IN)];
        match poll(&mut descriptors, Some(&timeout)) {
            Ok(0) | Err(Errno::INTR) => return Ok(Waited::Nothing),
            Ok(_) => {}
            Err(error) => return Err(error.into()),
        }
        let broken = descriptors[0].revents().intersects(PollFlags::ERR | PollFlags::HUP);
        let mut buffer = described(0);
        match self.node.call::<{ both::<Buffer>(17) }, _>(&mut buffer) {
            Ok(()) => Ok(Waited::Frame(Arrival {
                index: buffer.index,
                length: buffer.bytes_used as usize,
                flags: buffer.flags,
                sequence: buffer.sequence,
                stamp_ns: buffer.seconds as u64 * 1_000_000_000 + buffer.microseconds as u64 * 1000,
            })),
            Err(Errno::AGAIN) if !broken => Ok(Waited::Nothing),
            Err(error) => Err(error.into()),
        }
    }

    /// The bytes of a frame that has arrived and was not given back yet.
    pub fn bytes(&self, arrival: &Arrival) -> &[u8] {
        let Some(mapping) = self.mappings.get(arrival.index as usize) else { return &[] };
        // SAFETY: the mapping lives as long as the stream, and its length bounds the slice. The driver writes to it again only
        // after it is queued, which the borrow of the stream by `give_back` keeps apart.
        unsafe { std::slice::from_raw_parts(mapping.start.as_ptr(), arrival.length.min(mapping.length)) }
    }

    /// Queues a buffer to be filled again.
    pub fn give_back(&mut self, index: u32) -> io::Result<()> {
        let mut buffer = described(index);
        Ok(self.node.call::<{ both::<Buffer>(15) }, _>(&mut buffer)?)
    }
}

impl Drop for Stream {
    fn drop(&mut self) {
        // On a camera that was unplugged both fail, and there is nothing left to stop.
        let mut kind = VIDEO_CAPTURE;
        let _ = self.node.call::<{ opcode::write::<u32>(b'V', 19) }, _>(&mut kind);
        self.mappings.clear();
        let _ = self.node.request(0);
    }
}

fn described(index: u32) -> Buffer {
    Buffer { index, kind: VIDEO_CAPTURE, memory: MEMORY_MMAP, ..Buffer::default() }
}
