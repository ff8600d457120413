use proptest::prelude::*;

use super::*;

fn stream(frames: &[Vec<u16>], height: usize, width: usize) -> Vec<u8> {
    let mut stream = FrameStream::new(Vec::new(), frames.len(), height, width, 12).unwrap();
    for frame in frames {
        stream.push(Plane::U16(frame)).unwrap();
    }
    stream.finish().unwrap()
}

fn with_header(version: u8, text: &str) -> Vec<u8> {
    let mut bytes = MAGIC.to_vec();
    bytes.extend([version, 0]);
    match version {
        1 => bytes.extend((text.len() as u16).to_le_bytes()),
        _ => bytes.extend((text.len() as u32).to_le_bytes()),
    }
    bytes.extend(text.as_bytes());
    bytes
}

#[test]
fn the_header_is_the_one_that_numpy_writes() {
    // As numpy.save writes numpy.zeros((44, 1200, 1600), numpy.uint16).
    let bytes = Header::to_bytes(Dtype::U16, &[44, 1200, 1600]);
    let mut expected =
        b"\x93NUMPY\x01\x00\x76\x00{'descr': '<u2', 'fortran_order': False, 'shape': (44, 1200, 1600), }"
            .to_vec();
    expected.resize(127, b' ');
    expected.push(b'\n');
    assert_eq!(bytes, expected);
}

#[test]
fn headers_of_all_versions_and_spellings_are_read() {
    let dictionary = "{'descr': '>u2', 'fortran_order': False, 'shape': (2, 3, 4), }   \n";
    for version in 1..=3 {
        let bytes = with_header(version, dictionary);
        let header = Header::parse(&bytes).unwrap();
        assert_eq!((header.dtype, header.shape.as_slice()), (Dtype::U16BigEndian, [2, 3, 4].as_slice()));
        assert_eq!(header.data_offset, bytes.len());
        assert_eq!(header.data_bytes(), Some(48));
    }
    let other = with_header(1, "{\"shape\":(2L,3L,4L),\"fortran_order\":False,\"descr\":\"|u1\"}");
    assert_eq!(Header::parse(&other).unwrap().shape, [2, 3, 4]);
}

#[test]
fn what_cannot_be_read_says_why() {
    let cases = [
        (with_header(1, "{'descr': '<u2', 'fortran_order': True, 'shape': (2,), }"), "Fortran"),
        (with_header(1, "{'descr': '<f8', 'fortran_order': False, 'shape': (2,), }"), "'<f8'"),
        (with_header(1, "{'descr': [('a', '<u2')], 'fortran_order': False, 'shape': (2,), }"), "records"),
        (with_header(1, "{'descr': '<u2', 'shape': (2,), }"), "without"),
        (with_header(1, "{'descr': '<u2', 'fortran_order': False, 'shape': (-2,), }"), "a size"),
        (with_header(9, "{}"), "version 9"),
        (b"\x89PNG....".to_vec(), "NumPy"),
        (Vec::new(), "NumPy"),
    ];
    for (bytes, part) in cases {
        let error = Header::parse(&bytes).unwrap_err();
        assert!(error.contains(part), "{error}");
    }
    let vast =
        with_header(1, "{'descr': '<u2', 'fortran_order': False, 'shape': (4294967296, 4294967296, 2), }");
    assert_eq!(Header::parse(&vast).unwrap().data_bytes(), None);
}

#[test]
fn a_stream_refuses_what_its_header_does_not_say() {
    let mut stream = FrameStream::new(Vec::new(), 1, 2, 2, 12).unwrap();
    assert!(stream.push(Plane::U8(&[0; 4])).is_err());
    assert!(stream.push(Plane::U16(&[0; 3])).is_err());
    stream.push(Plane::U16(&[0; 4])).unwrap();
    assert!(stream.push(Plane::U16(&[0; 4])).is_err());
    assert!(FrameStream::new(Vec::new(), 1, 2, 2, 8).unwrap().finish().is_err());
}

proptest! {
    #[test]
    fn frames_come_back(height in 1usize..6, width in 1usize..6, frames in 0usize..4, seed in any::<u16>()) {
        let sample = |index: usize| (index as u16).wrapping_mul(40_503).wrapping_add(seed);
        let planes: Vec<Vec<u16>> = (0..frames)
            .map(|frame| (0..height * width).map(|pixel| sample(frame * 100 + pixel)).collect())
            .collect();
        let bytes = stream(&planes, height, width);
        let header = Header::parse(&bytes).unwrap();
        prop_assert_eq!(&header.shape, &[frames, height, width]);
        prop_assert_eq!(header.data_offset % 64, 0);
        let data: Vec<u16> =
            bytes[header.data_offset..].chunks(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect();
        prop_assert_eq!(data, planes.concat());
    }

    #[test]
    fn any_bytes_give_an_answer(version in 0u8..5, text in "[ -~\n]{0,60}|\\{('[a-z_]{1,6}': ?\\(?[0-9L, ]{0,8}\\)?,? ?){0,4}\\}") {
        let _ = Header::parse(&with_header(version, &text));
    }

    #[test]
    fn damage_never_panics(at in 0usize..128, value in any::<u8>(), cut in 0usize..130) {
        let mut bytes = Header::to_bytes(Dtype::F32, &[3, 4]);
        bytes[at] = value;
        bytes.truncate(cut);
        if let Ok(header) = Header::parse(&bytes) {
            prop_assert!(header.data_offset <= bytes.len());
        }
    }
}
