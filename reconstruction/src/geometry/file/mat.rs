//! MATLAB's MAT-file level 5, as far as small named arrays go. Format: "MAT-File Format", The MathWorks.
//!
//! Every length in the file is checked against the bytes that are there, and compressed elements are inflated only as
//! far as a small array can reach, so that neither a wrong length nor a zip bomb costs memory.

use std::io::Read;

use flate2::read::ZlibDecoder;

use super::value::{Array, MAX_ELEMENTS, MAX_VARIABLES, Node, Nodes};

const HEADER: usize = 128;
/// An array of `MAX_ELEMENTS` doubles with its tags and name.
const MAX_ARRAY_BYTES: usize = MAX_ELEMENTS * 8 + 1024;
const COMPRESSED: u32 = 15;
const MATRIX: u32 = 14;
const COMPLEX: u32 = 0x0800;
const CHAR: u32 = 4;
/// Classes double, single, and the integers of 8 to 64 bits.
const NUMERIC: std::ops::RangeInclusive<u32> = 6..=15;

/// Reads all small arrays of numbers and short texts; others are passed over.
pub(super) fn read(bytes: &[u8]) -> Result<Nodes, String> {
    let big_endian = match bytes.get(124..HEADER) {
        Some([_, 1, b'I', b'M']) => false,
        Some([1, _, b'M', b'I']) => true,
        _ => return Err("it is no MAT-file of level 5 (save it with -v7 or -v6, not -v7.3)".to_owned()),
    };
    let mut nodes = Nodes::new();
    let mut cursor = Cursor { bytes: &bytes[HEADER..], big_endian };
    let mut elements = 0;
    while !cursor.bytes.is_empty() {
        elements += 1;
        if elements > MAX_VARIABLES {
            return Err(format!("it holds more than {MAX_VARIABLES} variables"));
        }
        let at = bytes.len() - cursor.bytes.len();
        let (kind, length, small) = cursor.tag().ok_or_else(|| format!("it is cut short at byte {at}"))?;
        if small || length > cursor.bytes.len() {
            return Err(format!("the element at byte {at} is longer than the file"));
        }
        let (body, rest) = cursor.bytes.split_at(length);
        // Compressed elements alone are not padded to 8 bytes.
        let padding = if kind == COMPRESSED { 0 } else { (8 - length % 8) % 8 };
        cursor.bytes = rest.get(padding..).unwrap_or_default();
        let found = match kind {
            COMPRESSED => inflate(body, big_endian).map_err(|e| format!("the element at byte {at} {e}"))?,
            MATRIX => array(body, big_endian),
            _ => None,
        };
        if let Some((name, node)) = found {
            nodes.insert(name, node);
        }
    }
    if nodes.is_empty() {
        return Err("it holds no array of numbers".to_owned());
    }
    Ok(nodes)
}

/// The array in a compressed element; `None` for a large one.
fn inflate(body: &[u8], big_endian: bool) -> Result<Option<(String, Node)>, String> {
    let mut inflated = Vec::new();
    let read = ZlibDecoder::new(body).take(MAX_ARRAY_BYTES as u64).read_to_end(&mut inflated);
    let mut cursor = Cursor { bytes: &inflated, big_endian };
    let tag = cursor.tag();
    if let Some((MATRIX, length, false)) = tag
        && length > MAX_ARRAY_BYTES - 8
    {
        return Ok(None);
    }
    read.map_err(|error| format!("cannot be inflated: {error}"))?;
    match tag {
        Some((MATRIX, length, false)) => match cursor.bytes.get(..length) {
            Some(body) => Ok(array(body, big_endian)),
            None => Err("is shorter than it says".to_owned()),
        },
        Some(_) => Ok(None),
        None => Err("is empty".to_owned()),
    }
}

/// Name and value of a matrix element. `None` for kinds that are not needed and for malformed ones: what is needed
/// and not found is reported by name later.
fn array(body: &[u8], big_endian: bool) -> Option<(String, Node)> {
    let mut cursor = Cursor { bytes: body, big_endian };
    let (_, flags) = cursor.element()?;
    let flags = Cursor { bytes: flags, big_endian }.u32()?;
    let class = flags & 0xff;
    if flags & COMPLEX != 0 || !(NUMERIC.contains(&class) || class == CHAR) {
        return None;
    }
    let (_, dimensions) = cursor.element()?;
    let mut dimensions = Cursor { bytes: dimensions, big_endian };
    let (rows, columns) = (dimensions.u32()? as usize, dimensions.u32()? as usize);
    if !dimensions.bytes.is_empty() || rows.checked_mul(columns)? > MAX_ELEMENTS {
        return None;
    }
    let (_, name) = cursor.element()?;
    let name = std::str::from_utf8(name).ok()?.trim_end_matches('\0').to_owned();
    let (kind, values) = cursor.element()?;
    let columnwise = numbers(kind, values, big_endian)?;
    if columnwise.len() != rows * columns {
        return None;
    }
    if class == CHAR {
        let text = columnwise.iter().map(|&v| char::from_u32(v as u32).unwrap_or('\u{fffd}')).collect();
        return Some((name, Node::Text(text)));
    }
    let data = (0..rows * columns).map(|k| columnwise[(k % columns) * rows + k / columns]).collect();
    Some((name, Node::Array(Array { rows, columns, data })))
}

/// Values of a data element, whatever type MATLAB stored them in to save space.
fn numbers(kind: u32, bytes: &[u8], big_endian: bool) -> Option<Vec<f64>> {
    macro_rules! read {
        ($type:ty) => {{
            const SIZE: usize = size_of::<$type>();
            bytes
                .chunks_exact(SIZE)
                .map(|chunk| {
                    let mut array = [0; SIZE];
                    array.copy_from_slice(chunk);
                    (if big_endian { <$type>::from_be_bytes(array) } else { <$type>::from_le_bytes(array) })
                        as f64
                })
                .collect()
        }};
    }
    Some(match kind {
        1 => read!(i8),
        // UTF-8 text counts as bytes: the names and notes of the toolbox are ASCII.
        2 | 16 => read!(u8),
        3 => read!(i16),
        4 | 17 => read!(u16),
        5 => read!(i32),
        6 => read!(u32),
        7 => read!(f32),
        9 => read!(f64),
        12 => read!(i64),
        13 => read!(u64),
        _ => return None,
    })
}

struct Cursor<'a> {
    bytes: &'a [u8],
    big_endian: bool,
}

impl<'a> Cursor<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (head, rest) = self.bytes.split_at_checked(count)?;
        self.bytes = rest;
        Some(head)
    }

    fn u32(&mut self) -> Option<u32> {
        let bytes: [u8; 4] = self.take(4)?.try_into().ok()?;
        Some(if self.big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
    }

    /// Type, length, and whether the data sits inside the tag (the small format, length in the upper half).
    fn tag(&mut self) -> Option<(u32, usize, bool)> {
        let word = self.u32()?;
        if word >> 16 != 0 {
            return Some((word & 0xffff, (word >> 16) as usize, true));
        }
        Some((word, self.u32()? as usize, false))
    }

    /// Type and data of a sub-element, passing over its padding.
    fn element(&mut self) -> Option<(u32, &'a [u8])> {
        let (kind, length, small) = self.tag()?;
        if small {
            let data = self.take(4)?;
            return Some((kind, data.get(..length)?));
        }
        let data = self.take(length)?;
        // The last element of an array may miss its padding.
        let padding = ((8 - length % 8) % 8).min(self.bytes.len());
        self.take(padding)?;
        Some((kind, data))
    }
}
