//! Fields of messages as bytes.

use thiserror::Error;

use super::protocol::HEADER;
use crate::projector::ReceiptMethod;

/// Why bytes are no message.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum BadMessage {
    /// It is longer than any message.
    #[error("a message of {0} bytes is longer than any is")]
    TooLong(usize),
    /// It ends too early.
    #[error("a message of kind {0} ends too early")]
    Short(u8),
    /// It goes on after its last field.
    #[error("a message of kind {0} goes on after its end")]
    Long(u8),
    /// Nobody says that.
    #[error("no message has the kind {0}")]
    Kind(u8),
    /// A field has a value that it cannot have.
    #[error("a message of kind {0} has a field with an impossible value")]
    Value(u8),
}

/// Ways of knowing a flip, by their number in a message.
pub(super) const METHODS: [ReceiptMethod; 5] = [
    ReceiptMethod::Simulated,
    ReceiptMethod::X11Present,
    ReceiptMethod::WaylandPresentation,
    ReceiptMethod::Guessed,
    ReceiptMethod::Recorded,
];

/// A message that is being written.
pub(super) struct Writer {
    pub(super) bytes: Vec<u8>,
}

impl Writer {
    pub(super) fn new(kind: u8) -> Self {
        Self { bytes: vec![0, 0, 0, 0, kind] }
    }

    pub(super) fn u8(mut self, value: u8) -> Self {
        self.bytes.push(value);
        self
    }

    pub(super) fn u16(mut self, value: u16) -> Self {
        self.bytes.extend(value.to_le_bytes());
        self
    }

    pub(super) fn u32(mut self, value: u32) -> Self {
        self.bytes.extend(value.to_le_bytes());
        self
    }

    pub(super) fn u64(mut self, value: u64) -> Self {
        self.bytes.extend(value.to_le_bytes());
        self
    }

    pub(super) fn text(mut self, text: &str) -> Self {
        self = self.u32(text.len() as u32);
        self.bytes.extend(text.as_bytes());
        self
    }

    pub(super) fn method(self, method: ReceiptMethod) -> Self {
        self.u8(METHODS.iter().position(|known| *known == method).unwrap_or_default() as u8)
    }

    pub(super) fn option<T>(self, value: Option<T>, write: impl FnOnce(Self, T) -> Self) -> Self {
        match value {
            None => self.u8(0),
            Some(value) => write(self.u8(1), value),
        }
    }

    pub(super) fn list<T>(self, values: &[T], write: impl Fn(Self, &T) -> Self) -> Self {
        values.iter().fold(self.u32(values.len() as u32), write)
    }

    /// The whole message, with its length before it.
    pub(super) fn done(mut self) -> Vec<u8> {
        let length = (self.bytes.len() - HEADER) as u32;
        self.bytes[..4].copy_from_slice(&length.to_le_bytes());
        self.bytes
    }
}

/// The fields of a message that are not read yet.
pub(super) struct Reader<'a> {
    pub(super) kind: u8,
    pub(super) rest: &'a [u8],
}

impl Reader<'_> {
    pub(super) fn array<const N: usize>(&mut self) -> Result<[u8; N], BadMessage> {
        let (value, rest) = self.rest.split_first_chunk().ok_or(BadMessage::Short(self.kind))?;
        self.rest = rest;
        Ok(*value)
    }

    pub(super) fn u8(&mut self) -> Result<u8, BadMessage> {
        Ok(u8::from_le_bytes(self.array()?))
    }

    pub(super) fn u16(&mut self) -> Result<u16, BadMessage> {
        Ok(u16::from_le_bytes(self.array()?))
    }

    pub(super) fn u32(&mut self) -> Result<u32, BadMessage> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    pub(super) fn u64(&mut self) -> Result<u64, BadMessage> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    pub(super) fn text(&mut self) -> Result<String, BadMessage> {
        let length = self.u32()? as usize;
        let (text, rest) = self.rest.split_at_checked(length).ok_or(BadMessage::Short(self.kind))?;
        self.rest = rest;
        String::from_utf8(text.to_vec()).map_err(|_| BadMessage::Value(self.kind))
    }

    pub(super) fn method(&mut self) -> Result<ReceiptMethod, BadMessage> {
        METHODS.get(usize::from(self.u8()?)).copied().ok_or(BadMessage::Value(self.kind))
    }

    pub(super) fn option<T>(
        &mut self,
        read: impl FnOnce(&mut Self) -> Result<T, BadMessage>,
    ) -> Result<Option<T>, BadMessage> {
        match self.u8()? {
            0 => Ok(None),
            1 => read(self).map(Some),
            _ => Err(BadMessage::Value(self.kind)),
        }
    }

    /// As many values as the message says. A number without the values after it takes no memory.
    pub(super) fn list<T>(
        &mut self,
        read: impl Fn(&mut Self) -> Result<T, BadMessage>,
    ) -> Result<Vec<T>, BadMessage> {
        let count = self.u32()?;
        let mut values = Vec::new();
        for _ in 0..count {
            values.push(read(self)?);
        }
        Ok(values)
    }

    pub(super) fn end<T>(self, message: T) -> Result<T, BadMessage> {
        if self.rest.is_empty() { Ok(message) } else { Err(BadMessage::Long(self.kind)) }
    }
}
