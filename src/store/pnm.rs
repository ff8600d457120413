//! PGM and PPM with their samples as they are stored. General image libraries scale them to the full range of 8 or 16
//! bits, which would spoil the right-aligned 10 or 12 bits that cameras write.
//! Format: <https://netpbm.sourceforge.net/doc/pgm.html>.

/// What the header says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Header {
    pub width: u32,
    pub height: u32,
    pub channels: usize,
    pub maximum: u16,
    plain: bool,
    data_offset: usize,
}

/// Whether `bytes` begin like one of the Netpbm formats.
pub(super) fn is_pnm(bytes: &[u8]) -> bool {
    matches!(bytes, [b'P', b'1'..=b'7', next, ..] if next.is_ascii_whitespace() || *next == b'#')
}

impl Header {
    /// Reads the header. The error is a sentence that follows the file's name.
    pub(super) fn parse(bytes: &[u8]) -> Result<Self, String> {
        let (channels, plain) = match bytes.get(1) {
            Some(b'2') => (1, true),
            Some(b'3') => (3, true),
            Some(b'5') => (1, false),
            Some(b'6') => (3, false),
            _ => return Err("is a bitmap or PAM: save it as PGM (P5) or PNG".to_owned()),
        };
        let mut tokens = Tokens { bytes, at: 2 };
        let width = tokens.number()?;
        let height = tokens.number()?;
        let maximum = tokens.number()?;
        let maximum = u16::try_from(maximum).ok().filter(|&level| level > 0);
        let maximum = maximum.ok_or("has a largest sample outside 1..=65535")?;
        if width == 0 || height == 0 {
            return Err("has no pixels".to_owned());
        }
        // Exactly one white space ends the header, after which binary samples begin.
        Ok(Self { width, height, channels, maximum, plain, data_offset: tokens.at + 1 })
    }

    /// Reads the samples of all pixels, channel by channel, 16 bits each.
    pub(super) fn samples(&self, bytes: &[u8]) -> Result<Vec<u16>, String> {
        let count = (self.width as usize).checked_mul(self.height as usize);
        let count = count.and_then(|count| count.checked_mul(self.channels)).ok_or("is too large")?;
        let data = bytes.get(self.data_offset..).unwrap_or_default();
        let wide = self.maximum > 255;
        // A plain sample takes a digit and a separator, but for the last.
        let needed = match (self.plain, wide) {
            (true, _) => count.saturating_mul(2) - 1,
            (false, true) => count.saturating_mul(2),
            (false, false) => count,
        };
        if data.len() < needed {
            return Err(format!("is cut off: {} bytes of samples, expected {needed}", data.len()));
        }
        let samples: Vec<u16> = match (self.plain, wide) {
            (true, _) => {
                let mut tokens = Tokens { bytes: data, at: 0 };
                let sample =
                    |_| u16::try_from(tokens.number()?).map_err(|_| "has a sample above 65535".to_owned());
                (0..count).map(sample).collect::<Result<_, String>>()?
            }
            (false, true) => {
                data[..needed].chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
            }
            (false, false) => data[..needed].iter().map(|&sample| u16::from(sample)).collect(),
        };
        match samples.iter().find(|&&sample| sample > self.maximum) {
            Some(sample) => Err(format!("has a sample {sample} above its own maximum of {}", self.maximum)),
            None => Ok(samples),
        }
    }
}

/// Numbers between white space and comments.
struct Tokens<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Tokens<'_> {
    fn number(&mut self) -> Result<u32, String> {
        loop {
            match self.bytes.get(self.at) {
                Some(byte) if byte.is_ascii_whitespace() => self.at += 1,
                Some(b'#') => {
                    while self.bytes.get(self.at).is_some_and(|&byte| byte != b'\n') {
                        self.at += 1;
                    }
                }
                _ => break,
            }
        }
        let start = self.at;
        let mut value = 0u32;
        while let Some(digit) = self.bytes.get(self.at).filter(|byte| byte.is_ascii_digit()) {
            let next = value.checked_mul(10).and_then(|value| value.checked_add(u32::from(digit - b'0')));
            value = next.ok_or("has a number that is too large")?;
            self.at += 1;
        }
        if self.at == start {
            Err("is cut off or damaged: a number is missing".to_owned())
        } else {
            Ok(value)
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn twelve_bit_samples_are_kept_as_they_are() {
        let mut file = b"P5 # by a camera\n2 1\n# right-aligned\n4095\n".to_vec();
        file.extend([0x0f, 0xff, 0x00, 0x0a]);
        let header = Header::parse(&file).unwrap();
        assert_eq!((header.width, header.height, header.channels, header.maximum), (2, 1, 1, 4095));
        assert_eq!(header.samples(&file).unwrap(), [4095, 10]);
    }

    #[test]
    fn plain_and_colour_files() {
        let plain = b"P2\n3 1 15\n0 7\n15\n";
        assert_eq!(Header::parse(plain).unwrap().samples(plain).unwrap(), [0, 7, 15]);
        let colour = b"P6\n1 1\n255\n\x01\x02\x03";
        assert_eq!(Header::parse(colour).unwrap().samples(colour).unwrap(), [1, 2, 3]);
    }

    #[test]
    fn a_short_file_or_a_lying_maximum_is_an_error() {
        let short = b"P5 2 2 255\n\x00\x00\x00";
        assert!(Header::parse(short).unwrap().samples(short).unwrap_err().contains("cut off"));
        let lying = b"P5 1 1 100\n\xff";
        assert!(Header::parse(lying).unwrap().samples(lying).unwrap_err().contains("above its own maximum"));
        let vast = b"P5 4000000000 4000000000 255\n\x00";
        assert!(Header::parse(vast).unwrap().samples(vast).is_err());
        let vast = b"P2 100000 100000 255\n0 0";
        assert!(Header::parse(vast).unwrap().samples(vast).is_err());
    }

    proptest! {
        #[test]
        fn any_bytes_give_an_answer(kind in 0u8..9, mut tail in proptest::collection::vec(any::<u8>(), 0..60)) {
            let mut bytes = vec![b'P', b'0' + kind, b' '];
            bytes.append(&mut tail);
            if let Ok(header) = Header::parse(&bytes) {
                let _ = header.samples(&bytes);
            }
        }
    }
}
