//! A part of a cloud that is small enough to be sent often.

use std::io::{self, Read, Write};

use thiserror::Error;

use super::{Head, MAX_HEADER, PlyError, VERTEX_BYTES, length_differs};

/// Bytes that are read at once, a multiple of [`VERTEX_BYTES`].
const BATCH: usize = VERTEX_BYTES << 13;

/// Its multiples fall evenly into 0 to 1, however many there are.
const GOLDEN_SECTION: f64 = 0.618_033_988_749_894_9;

/// Why there is no sample.
#[derive(Debug, Error)]
pub enum SampleError {
    /// What is read is no cloud of ours.
    #[error(transparent)]
    Content(#[from] PlyError),
    /// It cannot be read.
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// Writes at most `most` vertices of the file of [`write_ply`](super::write_ply) that `source` gives, byte for byte and in their
/// order; returns how many. All of them where there are no more; else one of each of `most` stretches of equal length, at a
/// place in it that steps by the golden section, so that the columns of the camera leave no pattern.
///
/// # Errors
/// [`SampleError::Content`] where the file is another one, [`SampleError::Io`] where it cannot be read or `out` not written.
pub fn sample_ply(mut source: impl Read, most: usize, mut out: impl Write) -> Result<usize, SampleError> {
    let mut batch = Vec::with_capacity(BATCH);
    source.by_ref().take(MAX_HEADER as u64).read_to_end(&mut batch)?;
    let head = Head::read(&batch)?;
    let (before, vertices, taken) = (head.bytes, head.vertices, most.min(head.vertices));
    out.write_all(with_vertices(&head, taken).as_bytes())?;
    let mut wanted = (0..taken).map(|number| place(number, taken, vertices)).peekable();
    batch.drain(..before);
    let mut first = 0;
    loop {
        let more = (BATCH - batch.len() % BATCH) as u64;
        source.by_ref().take(more).read_to_end(&mut batch)?;
        let whole = batch.len() / VERTEX_BYTES;
        while let Some(place) = wanted.next_if(|place| *place < first + whole) {
            let at = (place - first) * VERTEX_BYTES;
            out.write_all(&batch[at..at + VERTEX_BYTES])?;
        }
        first += whole;
        batch.drain(..whole * VERTEX_BYTES);
        if whole == 0 {
            break;
        }
    }
    if first != vertices || !batch.is_empty() {
        return Err(length_differs().into());
    }
    Ok(taken)
}

/// The header of a file that holds `taken` of its vertices.
fn with_vertices(head: &Head<'_>, taken: usize) -> String {
    let mut text = String::with_capacity(head.bytes + 64);
    for line in head.text.lines() {
        if line.starts_with("element vertex ") {
            if taken < head.vertices {
                text.push_str(&format!("comment an even sample of {} vertices\n", head.vertices));
            }
            text.push_str(&format!("element vertex {taken}\n"));
        } else {
            text.push_str(line);
            text.push('\n');
        }
    }
    text.push_str("end_header\n");
    text
}

/// The vertex that is the `number`-th of `taken`, of `vertices`: in the stretch of that number.
fn place(number: usize, taken: usize, vertices: usize) -> usize {
    let bound = |number: usize| (number as u128 * vertices as u128 / taken as u128) as usize;
    let (begin, end) = (bound(number), bound(number + 1));
    let share = (number as f64 * GOLDEN_SECTION).fract();
    // A share of nearly one may round to the next stretch's beginning.
    begin + ((share * (end - begin) as f64) as usize).min(end - begin - 1)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{
        cloud::{Cloud, CloudFrame, PlyPoint, read_ply, write_ply},
        grid::Grid,
    };

    fn file(vertices: usize) -> Vec<u8> {
        let row = |value: fn(usize) -> f32| (0..vertices).map(value).collect::<Vec<_>>();
        let points = (0..vertices).map(|number| [number as f32, -1.5, 1000.25]).collect();
        let cloud = Cloud {
            point_mm: Grid::from_vec(vertices, 1, points),
            normal: Grid::filled(vertices, 1, [0.0, 0.6, -0.8]),
            sigma_z_mm: Grid::from_vec(vertices, 1, row(|number| number as f32 / 8.0)),
            flags: Grid::filled(vertices, 1, 5),
        };
        let mut bytes = Vec::new();
        write_ply(&mut bytes, &cloud, &Grid::filled(vertices, 1, 77), CloudFrame::World).unwrap();
        bytes
    }

    fn sampled(bytes: &[u8], most: usize) -> Vec<PlyPoint> {
        let mut out = Vec::new();
        let taken = sample_ply(bytes, most, &mut out).unwrap();
        let points = read_ply(&out).unwrap();
        assert_eq!(points.len(), taken);
        points
    }

    proptest! {
        #[test]
        fn a_sample_has_one_vertex_of_each_stretch(vertices in 1_usize..60_000, most in 1_usize..2000) {
            let whole = read_ply(&file(vertices)).unwrap();
            let taken = sampled(&file(vertices), most);
            prop_assert_eq!(taken.len(), most.min(vertices));
            for (number, point) in taken.iter().enumerate() {
                let place = point.point_mm[0] as usize;
                prop_assert_eq!(point, &whole[place]);
                let bound = |number: usize| number * vertices / taken.len();
                prop_assert!((bound(number)..bound(number + 1)).contains(&place), "{} at {}", number, place);
            }
        }
    }

    #[test]
    fn a_small_cloud_is_sent_as_it_is() {
        for (vertices, most) in [(0, 1), (1, 1), (30, 30), (30, 31), (BATCH / VERTEX_BYTES, 1 << 20)] {
            let bytes = file(vertices);
            let mut out = Vec::new();
            assert_eq!(sample_ply(&bytes[..], most, &mut out).unwrap(), vertices);
            assert!(out == bytes, "{vertices}");
        }
        assert_eq!(sampled(&file(30), 0), []);
    }

    #[test]
    fn a_sample_says_what_it_is_and_keeps_the_frame() {
        let mut out = Vec::new();
        sample_ply(&file(30)[..], 10, &mut out).unwrap();
        let text = String::from_utf8_lossy(&out);
        assert!(text.contains("comment an even sample of 30 vertices\nelement vertex 10\n"), "{text}");
        assert!(text.contains("comment frame world"), "{text}");
    }

    #[test]
    fn damaged_files_are_refused() {
        let bytes = file(40);
        for cut in 0..bytes.len() {
            let error = sample_ply(&bytes[..cut], 10, io::sink()).unwrap_err();
            assert!(matches!(error, SampleError::Content(_)), "{cut}: {error}");
        }
        let longer = [&bytes[..], &[0; VERTEX_BYTES]].concat();
        assert!(sample_ply(&longer[..], 10, io::sink()).is_err());
    }
}
