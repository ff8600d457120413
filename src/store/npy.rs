//! NumPy's `.npy` format, versions 1 to 3: reading its header, writing arrays.
//! Format: <https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>.

use std::io::{self, Write};

use crate::decode::Plane;

const MAGIC: &[u8] = b"\x93NUMPY";

/// Longest header that is read; NumPy's own default limit is 10 000 characters.
const MAX_HEADER_BYTES: usize = 1 << 16;

/// Headers are padded so that the data begins at a multiple of this.
const ALIGNMENT: usize = 64;

/// Type of an array's elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dtype {
    /// 8 bits.
    U8,
    /// 16 bits, little endian.
    U16,
    /// 16 bits, big endian.
    U16BigEndian,
    /// 32-bit floating point, little endian.
    F32,
    /// One byte, 0 or 1.
    Bool,
}

impl Dtype {
    /// Bytes of an element.
    pub fn bytes(self) -> usize {
        match self {
            Self::U8 | Self::Bool => 1,
            Self::U16 | Self::U16BigEndian => 2,
            Self::F32 => 4,
        }
    }

    fn descr(self) -> &'static str {
        match self {
            Self::U8 => "|u1",
            Self::U16 => "<u2",
            Self::U16BigEndian => ">u2",
            Self::F32 => "<f4",
            Self::Bool => "|b1",
        }
    }

    fn parse(descr: &str) -> Option<Self> {
        match descr {
            "|u1" | "u1" | "<u1" | ">u1" => Some(Self::U8),
            "<u2" => Some(Self::U16),
            ">u2" => Some(Self::U16BigEndian),
            "<f4" => Some(Self::F32),
            "|b1" | "?" | "|?" => Some(Self::Bool),
            _ => None,
        }
    }
}

/// What a header says of an array in C order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// Type of the elements.
    pub dtype: Dtype,
    /// Sizes, slowest first.
    pub shape: Vec<usize>,
    /// Where the data begins, in bytes.
    pub data_offset: usize,
}

impl Header {
    /// Length of the data in bytes, `None` where it exceeds the address space.
    pub fn data_bytes(&self) -> Option<usize> {
        self.shape.iter().try_fold(self.dtype.bytes(), |product, &side| product.checked_mul(side))
    }

    /// Reads the header at the start of `file`, which may hold more. The data itself is not looked at.
    pub fn parse(file: &[u8]) -> Result<Self, String> {
        let rest = file.strip_prefix(MAGIC).ok_or("is not a .npy: its first bytes are not NumPy's")?;
        let (&[major, _minor], rest) = rest.split_first_chunk().ok_or("ends within its header")?;
        let (length, rest) = match major {
            1 => {
                let (length, rest) = rest.split_first_chunk().ok_or("ends within its header")?;
                (usize::from(u16::from_le_bytes(*length)), rest)
            }
            2 | 3 => {
                let (length, rest) = rest.split_first_chunk().ok_or("ends within its header")?;
                (u32::from_le_bytes(*length) as usize, rest)
            }
            _ => return Err(format!("has .npy version {major}, which is newer than 3")),
        };
        if length > MAX_HEADER_BYTES {
            return Err(format!("has a header of {length} bytes, at most {MAX_HEADER_BYTES} are read"));
        }
        let text = rest.get(..length).ok_or("ends within its header")?;
        let text = std::str::from_utf8(text).map_err(|_| "has a header that is not text")?;
        let dictionary = Dictionary::parse(text)?;
        if dictionary.fortran_order {
            return Err("is in Fortran order: save it with numpy.ascontiguousarray".to_owned());
        }
        let dtype = Dtype::parse(&dictionary.descr).ok_or_else(|| {
            format!(
                "has elements of type '{}', expected uint8 or uint16 ('|u1', '<u2', '>u2')",
                dictionary.descr
            )
        })?;
        Ok(Self { dtype, shape: dictionary.shape, data_offset: file.len() - rest.len() + length })
    }

    /// The bytes of a version 1 header that ends at a multiple of 64.
    pub fn to_bytes(dtype: Dtype, shape: &[usize]) -> Vec<u8> {
        let sides: Vec<String> = shape.iter().map(usize::to_string).collect();
        let comma = if shape.len() == 1 { "," } else { "" };
        let mut text = format!(
            "{{'descr': '{}', 'fortran_order': False, 'shape': ({}{comma}), }}",
            dtype.descr(),
            sides.join(", ")
        );
        let fixed = MAGIC.len() + 4;
        let total = (fixed + text.len() + 1).next_multiple_of(ALIGNMENT);
        text.extend(std::iter::repeat_n(' ', total - fixed - text.len() - 1));
        text.push('\n');
        let mut bytes = MAGIC.to_vec();
        bytes.extend([1, 0]);
        // The text is below 1 KiB: a shape has at most three sides here.
        bytes.extend((text.len() as u16).to_le_bytes());
        bytes.extend(text.as_bytes());
        bytes
    }
}

/// The three entries of the Python dictionary that a header is.
#[derive(Default)]
struct Dictionary {
    descr: String,
    fortran_order: bool,
    shape: Vec<usize>,
}

impl Dictionary {
    fn parse(text: &str) -> Result<Self, String> {
        let mut cursor = Cursor { rest: text };
        let (mut descr, mut fortran_order, mut shape) = (None, None, None);
        cursor.expect('{')?;
        while !cursor.accept('}') {
            let key = cursor.string()?;
            cursor.expect(':')?;
            match key {
                "descr" if cursor.peek() == Some('[') => {
                    return Err("has records as elements, expected uint8 or uint16".to_owned());
                }
                "descr" => descr = Some(cursor.string()?.to_owned()),
                "fortran_order" => fortran_order = Some(cursor.boolean()?),
                "shape" => shape = Some(cursor.tuple()?),
                other => return Err(format!("has a header with the unknown key '{other}'")),
            }
            if !cursor.accept(',') && cursor.peek() != Some('}') {
                return Err(cursor.wrong("a comma"));
            }
        }
        match (descr, fortran_order, shape) {
            (Some(descr), Some(fortran_order), Some(shape)) => Ok(Self { descr, fortran_order, shape }),
            _ => Err("has a header without descr, fortran_order or shape".to_owned()),
        }
    }
}

/// Reads the few forms of Python literals that headers are made of.
struct Cursor<'a> {
    rest: &'a str,
}

impl<'a> Cursor<'a> {
    fn peek(&mut self) -> Option<char> {
        self.rest = self.rest.trim_start();
        self.rest.chars().next()
    }

    fn accept(&mut self, wanted: char) -> bool {
        let found = self.peek() == Some(wanted);
        if found {
            self.rest = &self.rest[wanted.len_utf8()..];
        }
        found
    }

    fn expect(&mut self, wanted: char) -> Result<(), String> {
        if self.accept(wanted) { Ok(()) } else { Err(self.wrong(&format!("'{wanted}'"))) }
    }

    fn wrong(&self, wanted: &str) -> String {
        let found: String = self.rest.chars().take(12).collect();
        format!("has a damaged header: expected {wanted}, found {found:?}")
    }

    fn string(&mut self) -> Result<&'a str, String> {
        let quote =
            self.peek().filter(|mark| matches!(mark, '\'' | '"')).ok_or_else(|| self.wrong("a string"))?;
        let inner = &self.rest[1..];
        let end = inner.find(quote).ok_or_else(|| self.wrong("the end of a string"))?;
        self.rest = &inner[end + 1..];
        Ok(&inner[..end])
    }

    fn boolean(&mut self) -> Result<bool, String> {
        self.peek();
        for (word, value) in [("True", true), ("False", false)] {
            if let Some(rest) = self.rest.strip_prefix(word) {
                self.rest = rest;
                return Ok(value);
            }
        }
        Err(self.wrong("True or False"))
    }

    fn tuple(&mut self) -> Result<Vec<usize>, String> {
        self.expect('(')?;
        let mut sides = Vec::new();
        while !self.accept(')') {
            self.peek();
            let end = self.rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(self.rest.len());
            sides.push(self.rest[..end].parse().map_err(|_| self.wrong("a size"))?);
            self.rest = &self.rest[end..];
            // Python 2 wrote long integers with a suffix.
            self.accept('L');
            if !self.accept(',') && self.peek() != Some(')') {
                return Err(self.wrong("a comma"));
            }
        }
        Ok(sides)
    }
}

/// Writes an array of frames one by one.
#[derive(Debug)]
pub struct FrameStream<W> {
    out: W,
    dtype: Dtype,
    samples: usize,
    frames: usize,
    written: usize,
}

impl<W: Write> FrameStream<W> {
    /// Begins an array of shape (frames, height, width): uint8 up to a `bit_depth` of 8, else uint16.
    pub fn new(mut out: W, frames: usize, height: usize, width: usize, bit_depth: u8) -> io::Result<Self> {
        let dtype = if bit_depth <= 8 { Dtype::U8 } else { Dtype::U16 };
        out.write_all(&Header::to_bytes(dtype, &[frames, height, width]))?;
        Ok(Self { out, dtype, samples: height * width, frames, written: 0 })
    }

    /// Appends a frame. Refuses one too many, and one of another size or sample type, as `InvalidInput`.
    pub fn push(&mut self, plane: Plane<'_>) -> io::Result<()> {
        let (dtype, samples) = match plane {
            Plane::U8(samples) => (Dtype::U8, samples.len()),
            Plane::U16(samples) => (Dtype::U16, samples.len()),
        };
        if self.written == self.frames || samples != self.samples || dtype != self.dtype {
            let detail = format!(
                "frame {} of {} has {samples} samples of type {}, expected {} of type {}",
                self.written,
                self.frames,
                dtype.descr(),
                self.samples,
                self.dtype.descr()
            );
            return Err(io::Error::new(io::ErrorKind::InvalidInput, detail));
        }
        match plane {
            Plane::U8(samples) => self.out.write_all(samples)?,
            Plane::U16(samples) => write_u16_le(&mut self.out, samples)?,
        }
        self.written += 1;
        Ok(())
    }

    /// Ends the array; all frames must have been written.
    pub fn finish(self) -> io::Result<W> {
        if self.written != self.frames {
            let detail = format!("{} of {} frames were written", self.written, self.frames);
            return Err(io::Error::new(io::ErrorKind::InvalidInput, detail));
        }
        Ok(self.out)
    }
}

fn write_u16_le(out: &mut impl Write, samples: &[u16]) -> io::Result<()> {
    if cfg!(target_endian = "little") {
        return out.write_all(bytemuck::cast_slice(samples));
    }
    let mut buffer = Vec::with_capacity(1 << 16);
    for chunk in samples.chunks(1 << 15) {
        buffer.clear();
        buffer.extend(chunk.iter().flat_map(|sample| sample.to_le_bytes()));
        out.write_all(&buffer)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
