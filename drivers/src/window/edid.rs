//! What a display says of itself, in the 128 bytes of an EDID base block (VESA E-EDID 1.4).

/// Who a display is.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Identity {
    /// Three letters of the maker.
    pub maker: String,
    /// Name, where the display states one.
    pub name: String,
    /// Serial number, as text where the display states one, else the number.
    pub serial: String,
}

const HEADER: [u8; 8] = [0, 255, 255, 255, 255, 255, 255, 0];
const NAME: u8 = 0xfc;
const SERIAL: u8 = 0xff;

/// Reads the base block; `None` where the bytes are none.
pub fn identity(edid: &[u8]) -> Option<Identity> {
    let block = edid.get(..128)?;
    let sum = block.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte));
    if !block.starts_with(&HEADER) || sum != 0 {
        return None;
    }
    let packed = u16::from_be_bytes([block[8], block[9]]);
    let letter = |shift: u32| char::from(b'A' - 1 + ((packed >> shift) & 31) as u8);
    let product = u16::from_le_bytes([block[10], block[11]]);
    let number = u32::from_le_bytes([block[12], block[13], block[14], block[15]]);
    let text = |kind: u8| {
        let descriptors = block[54..126].chunks_exact(18);
        let found = descriptors.into_iter().find(|bytes| bytes[..3] == [0, 0, 0] && bytes[3] == kind)?;
        let text = found[5..].split(|byte| *byte == b'\n').next()?;
        let text: String = text.iter().map(|byte| char::from(*byte)).filter(|c| !c.is_control()).collect();
        Some(text.trim().to_owned()).filter(|text| !text.is_empty())
    };
    Some(Identity {
        maker: [letter(10), letter(5), letter(0)].into_iter().collect(),
        name: text(NAME).unwrap_or_else(|| format!("{product:04X}")),
        serial: text(SERIAL).or_else(|| (number != 0).then(|| number.to_string())).unwrap_or_default(),
    })
}

#[cfg(test)]
mod tests {
    use proptest::{collection::vec, prelude::*};

    use super::*;

    /// A base block with these descriptors, built by the standard's layout.
    fn block(maker: &str, product: u16, number: u32, texts: &[(u8, &str)]) -> Vec<u8> {
        let mut edid = vec![0; 128];
        edid[..8].copy_from_slice(&HEADER);
        let packed = maker.bytes().fold(0u16, |packed, letter| packed << 5 | u16::from(letter - b'@'));
        edid[8..10].copy_from_slice(&packed.to_be_bytes());
        edid[10..12].copy_from_slice(&product.to_le_bytes());
        edid[12..16].copy_from_slice(&number.to_le_bytes());
        for (at, (kind, text)) in texts.iter().enumerate() {
            let descriptor = &mut edid[54 + 18 * at..][..18];
            descriptor[3] = *kind;
            descriptor[5..].fill(b' ');
            descriptor[5..5 + text.len()].copy_from_slice(text.as_bytes());
            if text.len() < 13 {
                descriptor[5 + text.len()] = b'\n';
            }
        }
        edid[127] = edid.iter().fold(0u8, |sum, byte| sum.wrapping_sub(*byte));
        edid
    }

    fn of(maker: &str, name: &str, serial: &str) -> Identity {
        Identity { maker: maker.into(), name: name.into(), serial: serial.into() }
    }

    #[test]
    fn a_display_is_known_by_its_texts() {
        let edid = block("SEC", 0x4f41, 77, &[(NAME, "EPSON PJ"), (SERIAL, "X4JK0412345ab")]);
        assert_eq!(identity(&edid), Some(of("SEC", "EPSON PJ", "X4JK0412345ab")));
    }

    #[test]
    fn where_there_is_no_text_the_numbers_do() {
        assert_eq!(identity(&block("SEC", 0x4f41, 77, &[])), Some(of("SEC", "4F41", "77")));
        assert_eq!(identity(&block("SEC", 0x4f41, 0, &[(NAME, "")])), Some(of("SEC", "4F41", "")));
    }

    #[test]
    fn one_wrong_bit_is_noticed() {
        let edid = block("SEC", 1, 77, &[(NAME, "EPSON PJ")]);
        for bit in 0..8 * 128 {
            let mut damaged = edid.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(identity(&damaged), None, "bit {bit}");
        }
        assert_eq!(identity(&edid[..127]), None);
    }

    proptest! {
        #[test]
        fn noise_does_no_harm(mut noise in vec(any::<u8>(), 128)) {
            noise[..8].copy_from_slice(&HEADER);
            noise[127] = 0;
            noise[127] = noise.iter().fold(0u8, |sum, byte| sum.wrapping_sub(*byte));
            let found = identity(&noise).expect("header and sum are right");
            prop_assert!(!found.name.is_empty() && !found.name.contains('\n'));
        }
    }
}
